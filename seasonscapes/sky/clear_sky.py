"""Illumination by clear or hazy skies at any solar elevation: sky radiance, sun and moon, and aerial perspective.

`atmosphere_tables` computes the expensive, time-independent tables of an atmosphere. Every luminary is described by its
direction and its extraterrestrial spectral irradiance relative to the sun's (``irradiance``); the sky radiances of
several luminaries are added.

Polarisation is neglected (a scalar theory errs by some per cent of a clear sky's radiance in single directions),
and so is absorption by water vapour and oxygen, whose lines lie at wavelengths of low luminous efficiency.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.frames import angles_from_direction
from seasonscapes.images import atomic_path
from seasonscapes.sky.aerial_perspective import airlight, tabulate_aerial_perspective
from seasonscapes.sky.atmosphere import Atmosphere, optics
from seasonscapes.sky.curved_rays import SUN_RADIUS_DEG, SunColumns, sun_transfer
from seasonscapes.sky.ephemeris import refraction_deg, standard_pressure_hpa
from seasonscapes.sky.illumination import Illumination, Luminary
from seasonscapes.sky.observer_radiance import ScatteredRadiance, observed_sky, observer_view, sky_radiance_grid
from seasonscapes.sky.scattering import AtmosphereTables, atmosphere_tables
from seasonscapes.sky.sh_moments import ShMoments, sun_index
from seasonscapes.sky.spectrum import WAVELENGTHS_NM, rgb_from_transfer

__all__ = [
    "TABLES_REVISION",
    "Atmosphere",
    "AtmosphereTables",
    "LuminarySource",
    "atmosphere_tables",
    "illumination_from_atmosphere",
    "load_tables",
    "save_tables",
    "sky_radiance_map",
    "sun_luminary",
    "true_elevation_deg",
]

# Increment whenever the tables of an unchanged atmosphere change.
TABLES_REVISION = 5
# A luminary of less normal illuminance is omitted [lx].
_MIN_NORMAL_LX = 1e-6
# Nor does it light the air from below this true elevation [deg]: the sun's light is then less than 6e-4 of the night sky's
# in any direction, and 2e-5 of its mean.
LOWEST_SHINING_DEG = -25.0


@dataclass(frozen=True)
class LuminarySource:
    """Luminary above the atmosphere.

    Parameters
    ----------
    direction
        Apparent unit vector towards the luminary ``(3,)``.
    irradiance
        Extraterrestrial spectral irradiance over that of the sun at 1 au; a number or ``(9,)`` bands.
    angular_radius_deg
        Angular radius of the disc [deg].
    """

    direction: np.ndarray
    irradiance: ArrayLike
    angular_radius_deg: float


def true_elevation_deg(atmosphere: Atmosphere, apparent_elevation_deg: ArrayLike, height_m: float) -> np.ndarray:
    """Compute the true elevation of a body from its apparent elevation; the inverse of `ephemeris.refraction_deg`.

    Parameters
    ----------
    atmosphere
        Atmosphere; without refraction the elevation is returned unchanged.
    apparent_elevation_deg
        Apparent elevation ``(...)`` [deg].
    height_m
        Height of the observer [m].

    Returns
    -------
    ndarray
        Elevation without refraction ``(...)`` [deg].
    """
    apparent = np.asarray(apparent_elevation_deg, float)
    if not atmosphere.refraction:
        return apparent
    true = np.concatenate([np.linspace(-90.0, -8.0, 10), np.linspace(-7.5, 3.0, 400), np.linspace(3.1, 90.0, 400)])
    pressure_hpa = float(standard_pressure_hpa(min(height_m, 3e4)))  # the formula is undefined at greater heights
    lifted = true + refraction_deg(true, pressure_hpa=pressure_hpa)
    return np.interp(apparent, lifted, true)


def sky_radiance_map(
    tables: AtmosphereTables,
    sun_direction: ArrayLike,
    observer_height_m: float,
    *,
    shape: tuple[int, int] = (128, 256),
    irradiance: ArrayLike = 1.0,
) -> np.ndarray:
    """Compute the map of sky radiance around an observer, without the luminary's disc.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    sun_direction
        Apparent unit vector ``(3,)`` towards the sun, or towards another luminary.
    observer_height_m
        Height of the observer, in the datum of the atmosphere's ground [m]; raised to one metre above that ground.
    shape
        Rows and columns of the equirectangular map.
    irradiance
        Extraterrestrial spectral irradiance over that of the sun at 1 au; a number or ``(9,)`` bands.

    Returns
    -------
    ndarray
        ``shape + (3,)`` float32, photometric linear Rec.709 [cd/m²]. Rows below the horizon hold the radiance of the
        model's sunlit ground through the air.

    Raises
    ------
    ValueError
        If the direction is not a unit vector, or the observer is not below the top of the atmosphere.
    """
    direction, view = _unit(sun_direction), observer_view(tables, observer_height_m)
    true_rad = _true_rad(tables.atmosphere, direction, observer_height_m)
    light = observed_sky(tables, view, direction, true_rad, _bands(irradiance))
    return _radiance_map((light,), shape)


def sun_luminary(
    tables: AtmosphereTables,
    sun_direction: ArrayLike,
    observer_height_m: float,
    distance_au: float = 1.0,
    *,
    irradiance: ArrayLike = 1.0,
    angular_radius_deg: float | None = None,
) -> Luminary | None:
    """Compute the directional source of the sun, or of another luminary, attenuated by the atmosphere.

    Only the fraction of the disc above the horizon of the model's ground contributes, so that the luminary sets
    gradually. Limb darkening is neglected.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    sun_direction, observer_height_m, irradiance
        As in `sky_radiance_map`.
    distance_au
        Distance by which the irradiance and the angular radius of the sun are scaled [au].
    angular_radius_deg
        Angular radius of a luminary other than the sun [deg].

    Returns
    -------
    Luminary or None
        ``None`` if the luminary is below the horizon or its normal illuminance is below one microlux.

    Raises
    ------
    ValueError
        If the direction is not a unit vector.
    """
    direction = _unit(sun_direction)
    radius = SUN_RADIUS_DEG / distance_au if angular_radius_deg is None else angular_radius_deg
    transfer = _direct_transfer(tables, direction, observer_height_m, radius)
    illuminance = rgb_from_transfer() @ (transfer * np.asarray(irradiance) / distance_au**2)
    if illuminance.max() < _MIN_NORMAL_LX:
        return None
    return Luminary(direction, illuminance, radius)


def illumination_from_atmosphere(
    tables: AtmosphereTables,
    sun_direction: ArrayLike,
    observer_height_m: float,
    *,
    distance_au: float = 1.0,
    moon: LuminarySource | None = None,
    shape: tuple[int, int] = (128, 256),
    with_aerial_perspective: bool = True,
) -> Illumination:
    """Compute the illumination of one instant for an observer: sun, sky, moon and aerial perspective.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    sun_direction
        Apparent unit vector towards the sun ``(3,)``.
    observer_height_m
        As in `sky_radiance_map` [m].
    distance_au
        Distance of the sun [au].
    moon
        The moon as a source above the atmosphere, or ``None``.
    shape
        Rows and columns of the sky map; ``(0, 0)`` where the map is not wanted.
    with_aerial_perspective
        Whether to compute the aerial perspective, which takes most of the time; otherwise it is ``None``.

    Returns
    -------
    Illumination
        Illumination without frame and time.

    Raises
    ------
    ValueError
        If a direction is not a unit vector, or the observer is not below the top of the atmosphere.
    """
    sources = [LuminarySource(_unit(sun_direction), 1.0 / distance_au**2, SUN_RADIUS_DEG / distance_au)]
    if moon is not None:
        sources.append(replace(moon, direction=_unit(moon.direction)))
    directions = [source.direction for source in sources]
    irradiances = [_bands(source.irradiance) for source in sources]
    view = observer_view(tables, observer_height_m)
    true_rad = [_true_rad(tables.atmosphere, direction, observer_height_m) for direction in directions]
    # Those that light the air.
    shining = [
        (direction, true, irradiance)
        for direction, true, irradiance in zip(directions, true_rad, irradiances, strict=True)
        if true > np.radians(LOWEST_SHINING_DEG)
    ]
    lights = tuple(observed_sky(tables, view, *each) for each in shining)
    radiance = _radiance_map(lights, shape)
    luminaries = [
        sun_luminary(
            tables,
            source.direction,
            observer_height_m,
            irradiance=irradiance,
            angular_radius_deg=source.angular_radius_deg,
        )
        for source, irradiance in zip(sources, irradiances, strict=True)
    ]
    aerial_perspective = None
    if with_aerial_perspective:
        illuminant = np.asarray(
            sum(
                irradiance * surface_transfer(tables, direction, observer_height_m, true)
                for direction, irradiance, true in zip(directions, irradiances, true_rad, strict=True)
            )
        )
        components = [airlight(tables, view, true, irradiance) for _, true, irradiance in shining]
        aerial_perspective = tabulate_aerial_perspective(
            view, tuple(zip(lights, components, strict=True)), illuminant + 1e-12
        )
    return Illumination(
        sky_radiance=radiance,
        sun=luminaries[0],
        moon=luminaries[1] if moon is not None else None,
        aerial_perspective=aerial_perspective,
        model={"kind": "atmosphere", "observer_height_m": float(observer_height_m), **asdict(tables.atmosphere)},
    )


def save_tables(path: str | PathLike[str], tables: AtmosphereTables) -> None:
    """Write tables to one ``.npz`` file, atomically; ``diffuse_of``, ``day_of`` and ``moon_of`` are not stored.

    Parameters
    ----------
    path
        Destination.
    tables
        Tables of an atmosphere.
    """
    with atomic_path(path) as temporary:
        np.savez_compressed(
            temporary,
            revision=TABLES_REVISION,
            atmosphere=json.dumps(asdict(tables.atmosphere)),
            lowest_rad=tables.sun_columns.lowest_rad,
            log_columns=tables.sun_columns.log_columns,
            log_mean=tables.moments.log_mean,
            ratio=tables.moments.ratio,
            ground_irradiance=tables.moments.ground_irradiance,
        )


def load_tables(path: str | PathLike[str]) -> AtmosphereTables:
    """Read tables of `save_tables`.

    Parameters
    ----------
    path
        ``.npz`` file.

    Returns
    -------
    AtmosphereTables
        Tables without ``diffuse_of``, ``day_of`` and ``moon_of``.

    Raises
    ------
    ValueError
        If the file was written by another revision and must be recomputed.
    """
    with np.load(path, allow_pickle=False) as file:
        if "revision" not in file or int(file["revision"]) != TABLES_REVISION:
            raise ValueError(f"{path}: atmosphere tables of another revision than {TABLES_REVISION}")
        fields = json.loads(str(file["atmosphere"]))
        if isinstance(fields["ground_albedo"], list):
            fields["ground_albedo"] = tuple(fields["ground_albedo"])
        return AtmosphereTables(
            Atmosphere(**fields),
            SunColumns(file["lowest_rad"], file["log_columns"]),
            ShMoments(file["log_mean"], file["ratio"], file["ground_irradiance"]),
        )


def _unit(direction: ArrayLike) -> np.ndarray:
    direction = np.asarray(direction, float)
    if direction.shape != (3,) or not abs(np.linalg.norm(direction) - 1.0) < 1e-3:
        raise ValueError(f"direction: got {direction}, expected a unit vector (3,)")
    return direction / np.linalg.norm(direction)


def _bands(irradiance: ArrayLike) -> np.ndarray:
    return np.broadcast_to(np.asarray(irradiance, float), WAVELENGTHS_NM.shape)


def _true_rad(atmosphere: Atmosphere, direction: np.ndarray, height_m: float) -> float:
    _, apparent_deg = angles_from_direction(direction)
    return float(np.radians(true_elevation_deg(atmosphere, apparent_deg, height_m)))


def _radiance_map(lights: tuple[ScatteredRadiance, ...], shape: tuple[int, int]) -> np.ndarray:
    """Sky map of 2 × 2 samples per pixel, which antialiases the row at the horizon and the solar aureole."""
    height, width = shape
    if not height:
        return np.zeros((0, 0, 3), np.float32)
    elevation_deg = 90.0 - (np.arange(2 * height) + 0.5) * (90.0 / height)
    azimuth_deg = (np.arange(2 * width) + 0.5) * (180.0 / width)
    radiance = np.zeros((2 * height, 2 * width, 3), np.float32)
    for light in lights:
        radiance += sky_radiance_grid(light, elevation_deg, azimuth_deg)
    # Colours outside the Rec.709 gamut have a negative channel; clip, as radiance must not be negative.
    return np.maximum(radiance.reshape(height, 2, width, 2, 3).mean(axis=(1, 3)), 0.0).astype(np.float32)


def _direct_transfer(tables: AtmosphereTables, direction: np.ndarray, height_m: float, radius_deg: float) -> np.ndarray:
    true_rad = _true_rad(tables.atmosphere, direction, height_m)
    height = max(float(height_m), tables.atmosphere.ground_height_m)
    return sun_transfer(
        tables.atmosphere,
        tables.sun_columns,
        optics(tables.atmosphere),
        np.asarray(height),
        true_rad,
        radius_deg=radius_deg,
    )


def surface_transfer(tables: AtmosphereTables, direction: np.ndarray, height_m: float, true_rad: float) -> np.ndarray:
    """Irradiance transfer ``(B,)`` of a steep surface near the observer: half of the direct and the whole diffuse one.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    direction
        Apparent unit vector towards the luminary ``(3,)``.
    height_m
        Height of the observer [m].
    true_rad
        True elevation of the luminary [rad].
    """
    index, fraction = sun_index(np.sin(true_rad))
    table = tables.moments.ground_irradiance
    diffuse = table[index] * (1.0 - fraction) + table[index + 1] * fraction
    return 0.5 * _direct_transfer(tables, direction, height_m, SUN_RADIUS_DEG) + diffuse
