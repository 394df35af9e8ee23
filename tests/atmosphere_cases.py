"""Atmospheres, tables and comparisons that tests/test_atmosphere*.py and benchmarks/sky.py share."""

from __future__ import annotations

from functools import cache

import numpy as np
from oracles_atmosphere import Walk, many_times_scattered, observer, once_scattered

from seasonscapes.frames import angles_from_direction, direction_from_angles
from seasonscapes.sky.atmosphere import TOP_HEIGHT_M, Atmosphere, delta_scaled, gas_phase, optics
from seasonscapes.sky.aureole import spread_aerosol_phase
from seasonscapes.sky.clear_sky import (
    atmosphere_tables,
    illumination_from_atmosphere,
    sky_radiance_map,
    sun_luminary,
    true_elevation_deg,
)
from seasonscapes.sky.curved_rays import slant_columns_to_sun, sun_transfer, trace_curved_rays
from seasonscapes.sky.illumination import diffuse_horizontal_illuminance, direct_horizontal_illuminance, luminance
from seasonscapes.sky.observer_radiance import observed_sky, observer_view, sky_radiance
from seasonscapes.sky.ray_cells import sample_cells, scattering_per_m
from seasonscapes.sky.scattering import AtmosphereTables
from seasonscapes.sky.sh_moments import HARMONIC_ORDER, SUN_ELEVATION_KNOTS_DEG, diffuse_source, sun_geometry
from seasonscapes.sky.spectrum import RGB_FROM_XYZ, WAVELENGTHS_NM, rgb_from_transfer

# What SPECTRL2 takes its aerosol to be, at the eye's wavelengths (Bird & Riordan 1986; the defaults of
# pvlib's `spectrl2`).
SPECTRL2_AEROSOL = {"angstrom_exponent": 1.14, "single_scattering_albedo": 0.94, "asymmetry": 0.65}


@cache
def tables_of(*, max_orders: int = 40, **fields) -> AtmosphereTables:
    """Tables of an `Atmosphere` with the given fields, once a process."""
    return atmosphere_tables(Atmosphere(**fields), max_orders=max_orders)


def chromaticity(rgb) -> np.ndarray:
    """CIE 1931 x, y of linear Rec.709."""
    xyz = np.linalg.solve(RGB_FROM_XYZ, np.asarray(rgb, float))
    return xyz[:2] / xyz.sum()


def spectrl2_illuminance_lx(
    elevation_deg: float, optical_depth_500nm: float, height_m: float, *, angstrom_exponent: float = 1.14
) -> tuple[float, float]:
    """Direct normal and diffuse horizontal illuminance [lx] by pvlib's SPECTRL2 weighted by V(λ), at 1 au."""
    import colour
    import pvlib

    day = 94  # the only thing it does to the result is the distance, which is divided out again
    spectra = pvlib.spectrum.spectrl2(
        apparent_zenith=90.0 - elevation_deg,
        aoi=90.0 - elevation_deg,
        surface_tilt=0.0,
        ground_albedo=0.2,
        surface_pressure=pvlib.atmosphere.alt2pres(height_m),
        relative_airmass=pvlib.atmosphere.get_relative_airmass(90.0 - elevation_deg, "kastenyoung1989"),
        precipitable_water=0.5,
        ozone=0.32,
        aerosol_turbidity_500nm=optical_depth_500nm,
        dayofyear=day,
        alpha=angstrom_exponent,
    )
    sensitivity = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    distance = pvlib.irradiance.get_extra_radiation(day, solar_constant=1.0, method="spencer")
    return tuple(
        float(
            683.0
            / distance
            * np.sum(
                np.interp(sensitivity.wavelengths, spectra["wavelength"], np.ravel(spectra[key]))
                * sensitivity.values[:, 1]
            )
        )
        for key in ("dni", "dhi")
    )


def our_illuminance_lx(tables: AtmosphereTables, elevation_deg: float, height_m: float) -> tuple[float, float]:
    """Direct normal and diffuse horizontal illuminance [lx] at an apparent elevation of the sun."""
    sun = direction_from_angles(180.0, elevation_deg)
    luminary = sun_luminary(tables, sun, height_m)
    diffuse = diffuse_horizontal_illuminance(sky_radiance_map(tables, sun, height_m, shape=(64, 128)))
    return 0.0 if luminary is None else float(luminance(luminary.normal_illuminance_lx)), float(luminance(diffuse))


def global_illuminance_lx(tables: AtmosphereTables, elevation_deg: float, height_m: float = 0.0) -> float:
    """Global horizontal illuminance [lx] at an apparent elevation of the sun."""
    sun = direction_from_angles(180.0, elevation_deg)
    sky = diffuse_horizontal_illuminance(sky_radiance_map(tables, sun, height_m, shape=(32, 64)))
    return float(luminance(sky + direct_horizontal_illuminance(sun_luminary(tables, sun, height_m))))


def steps_beyond_trend(illuminance_lx: np.ndarray) -> np.ndarray:
    """Relative steps between neighbours, less the mean of the steps before and after: zero for a smooth course."""
    step = np.diff(np.log(illuminance_lx))
    return np.abs(step[1:-1] - 0.5 * (step[:-2] + step[2:]))


def against_oracle(
    tables: AtmosphereTables,
    sun_elevation_deg: float,
    direction: np.ndarray,
    *,
    paths: int,
    seed: int,
    height_m: float = 500.0,
    distance_m: float = np.inf,
) -> tuple[float, float]:
    """Relative deviation in luminance from the brute-force oracle, and the oracle's own relative standard error.

    The tables' atmosphere must not refract. The sun stands in the north.
    """
    sun = direction_from_angles(0.0, sun_elevation_deg)
    walk, place = Walk(tables.atmosphere, sun), observer(tables.atmosphere, height_m)
    once = once_scattered(walk, place, direction, distance_m=distance_m)
    many, error = many_times_scattered(walk, place, direction, paths=paths, seed=seed, distance_m=distance_m)
    weights = np.array([0.2126390, 0.7151687, 0.0721923]) @ rgb_from_transfer()
    truth = weights @ (once + many)
    if np.isinf(distance_m):
        light = observed_sky(tables, observer_view(tables, height_m), sun, np.radians(sun_elevation_deg), np.ones(9))
        ours = luminance(sky_radiance(light, direction))
    else:
        air = illumination_from_atmosphere(tables, sun, height_m, shape=(2, 4)).aerial_perspective
        ours = luminance(air(np.array(distance_m), direction)[1])
    # The bands' noise is common to a path: no band is independent of the others.
    return float(ours / truth - 1.0), float(np.abs(weights) @ error / truth)


def dense_airlight(
    tables: AtmosphereTables,
    sun_direction: np.ndarray,
    height_m: float,
    direction: np.ndarray,
    distance_m: float,
    *,
    cells: int = 400,
) -> np.ndarray:
    """Airlight ``(3,)`` [cd/m²] up to a distance, integrated along this one ray alone with many cells."""
    atmosphere, (azimuth_deg, elevation_deg) = tables.atmosphere, angles_from_direction(direction)
    sun_azimuth_deg, apparent_deg = angles_from_direction(sun_direction)
    true_rad = np.radians(true_elevation_deg(atmosphere, apparent_deg, height_m))
    plain = optics(atmosphere)
    scaled = delta_scaled(plain, HARMONIC_ORDER)
    floor_m = atmosphere.ground_height_m - 2000.0
    paths = trace_curved_rays(atmosphere, height_m, np.radians([elevation_deg]), floor_m=floor_m)
    edges = np.linspace(0.0, 1.0, cells + 1)[None] ** 1.5 * min(distance_m, paths.distance_m[0, -1])
    samples = sample_cells(atmosphere, scaled, paths, edges)
    turn = np.radians([azimuth_deg - sun_azimuth_deg])
    geometry = sun_geometry(samples, np.radians([elevation_deg]), np.array([true_rad]), turn)
    column, visible = slant_columns_to_sun(
        atmosphere, tables.sun_columns, samples.height_m[..., None], np.arcsin(geometry.sun_sine)
    )
    arriving = (np.exp(-(column @ scaled.extinction)) * visible[..., None])[0, :, 0]
    sigma = (scattering_per_m(atmosphere, plain, samples.height_m) * samples.weight)[:, 0]
    diffuse = (diffuse_source(atmosphere, scaled, tables.moments, samples, geometry)[0, :, 0] * samples.weight[0]).sum(
        0
    )
    cosine = direction @ sun_direction
    passed = (column[0, :, 0, 1] + samples.aerosol_column[0])[:, None]
    green = passed * np.interp(550.0, WAVELENGTHS_NM, plain.scattering[1])
    phase = spread_aerosol_phase(np.full(cells, cosine), np.repeat(green, 3, 1), atmosphere.asymmetry, HARMONIC_ORDER)
    once = (arriving * (sigma[0] * gas_phase(cosine) + sigma[1] * phase[:, 1:2])).sum(axis=0)
    return rgb_from_transfer() @ (once + diffuse)


def energy_imbalance(tables: AtmosphereTables) -> np.ndarray:
    """What a conservative atmosphere over a white ground loses of the sun's light ``(B,)``; 0 is perfect.

    All that falls on the top of the spherical air must leave it: scattered, or straight through its limb.
    """
    atmosphere = tables.atmosphere
    knots, sine = np.sin(np.radians(SUN_ELEVATION_KNOTS_DEG)), np.linspace(-0.45, 1.0, 20001)
    # Net outward flux is the first moment about the vertical of what comes from below.
    outward = -np.exp(tables.moments.log_mean[-1].astype(float)) * tables.moments.ratio[-1, :, 1, 0]
    outward = outward * np.sqrt(4.0 * np.pi / 3.0)
    scattered = np.array([2.0 * np.trapezoid(np.interp(sine, knots, band), sine) for band in outward.T])
    scaled = delta_scaled(optics(atmosphere), HARMONIC_ORDER)
    limb = np.linspace(-0.3, 0.0, 20001)
    through = sun_transfer(
        atmosphere, tables.sun_columns, scaled, np.full(limb.shape, TOP_HEIGHT_M), np.arcsin(limb), radius_deg=1e-3
    )
    straight = 2.0 * np.trapezoid(through * -limb[:, None], limb, axis=0)
    return 1.0 - scattered - straight


def homogeneous(visibility_m: float) -> Atmosphere:
    """A grey atmosphere of the same aerosol at every height, with a meteorological range."""
    return Atmosphere(
        3.912 / visibility_m * TOP_HEIGHT_M,
        0.0,
        np.inf,
        ozone_du=0.0,
        pressure_hpa=0.0,
        refraction=False,
        single_scattering_albedo=0.9,
    )
