"""The clear and hazy sky of every hour: radiance map, sun or moon, and the air between viewer and mountain.

`atmosphere_tables` does the slow part once for an atmosphere; everything that knows a time is quick. Any luminary goes
the same way: a direction and its spectral irradiance above the air as a share of the sun's (`irradiance`), and the
skies of several luminaries add up.

Polarisation is left out (a scalar theory errs by up to 5 % of a clear sky's radiance in single directions), and so are
water vapour and oxygen, whose lines lie where the eye hardly sees.
"""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from os import PathLike

import numpy as np

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
    "atmosphere_tables",
    "illumination_from_atmosphere",
    "load_tables",
    "save_tables",
    "sky_radiance_map",
    "sun_luminary",
    "true_elevation_deg",
]

# Raised whenever the tables of an equal atmosphere change.
TABLES_REVISION = 4
# Below this normal illuminance a luminary casts no visible shadow [lx].
_FAINTEST_LX = 1e-6


def true_elevation_deg(atmosphere: Atmosphere, apparent_elevation_deg, height_m: float) -> np.ndarray:
    """Elevation without refraction of a body that appears at an elevation [deg]: the inverse of the ephemeris' lift."""
    apparent = np.asarray(apparent_elevation_deg, float)
    if not atmosphere.refraction:
        return apparent
    true = np.concatenate([np.linspace(-90.0, -8.0, 10), np.linspace(-7.5, 3.0, 400), np.linspace(3.1, 90.0, 400)])
    pressure_hpa = float(standard_pressure_hpa(min(height_m, 3e4)))  # whose formula ends there
    lifted = true + refraction_deg(true, pressure_hpa=pressure_hpa)
    return np.interp(apparent, lifted, true)


def sky_radiance_map(
    tables: AtmosphereTables,
    sun_direction,
    observer_height_m: float,
    *,
    shape: tuple[int, int] = (128, 256),
    irradiance=1.0,
) -> np.ndarray:
    """Radiance of the whole sphere around an observer, without the sun's disc.

    Parameters
    ----------
    sun_direction
        Apparent unit vector ``(3,)`` towards the sun, or towards another luminary.
    observer_height_m
        In the heights of the atmosphere's ground [m]; lifted to a metre above that ground.
    shape
        Rows and columns of the equirectangular map.
    irradiance
        Spectral irradiance above the air over the sun's at 1 au, a number or ``(9,)`` bands.

    Returns
    -------
    ndarray
        ``shape + (3,)`` float32, photometric linear Rec.709 [cd/m²]. Below the horizon: the model's sunlit ground
        through the air.
    """
    direction, view = _unit(sun_direction), observer_view(tables, observer_height_m)
    true_rad = _true_rad(tables.atmosphere, direction, observer_height_m)
    light = observed_sky(tables, view, direction, true_rad, _bands(irradiance))
    return _map_of((light,), shape)


def sun_luminary(
    tables: AtmosphereTables,
    sun_direction,
    observer_height_m: float,
    distance_au: float = 1.0,
    *,
    irradiance=1.0,
    angular_radius_deg: float | None = None,
) -> Luminary | None:
    """The sun (or another luminary) as it shines through the air on a plane facing it.

    The share of its disc below the horizon of the model's ground is taken away, so that it sets gradually; limb
    darkening is left out.

    Parameters
    ----------
    distance_au
        Irradiance falls with its square, and the sun's disc with it.
    irradiance
        As in `sky_radiance_map`.
    angular_radius_deg
        Of a luminary other than the sun [deg].

    Returns
    -------
    Luminary or None
        ``None`` where it has set or gives less than a microlux.
    """
    direction = _unit(sun_direction)
    radius = SUN_RADIUS_DEG / distance_au if angular_radius_deg is None else angular_radius_deg
    transfer = _direct_transfer(tables, direction, observer_height_m, radius)
    illuminance = rgb_from_transfer() @ (transfer * np.asarray(irradiance) / distance_au**2)
    if illuminance.max() < _FAINTEST_LX:
        return None
    return Luminary(direction, illuminance, radius)


def illumination_from_atmosphere(
    tables: AtmosphereTables,
    sun_direction,
    observer_height_m: float,
    *,
    distance_au: float = 1.0,
    moon: tuple | None = None,
    shape: tuple[int, int] = (128, 256),
    with_air: bool = True,
) -> Illumination:
    """All the light of one instant for an observer: sun, sky, moon and aerial perspective.

    Parameters
    ----------
    sun_direction
        Apparent unit vector ``(3,)`` towards the sun.
    observer_height_m
        As in `sky_radiance_map`.
    distance_au
        Of the sun.
    moon
        Apparent direction ``(3,)``, irradiance above the air over the sun's at 1 au, and angular radius [deg] of the
        moon; left out, there is none.
    shape
        Of the radiance map.
    with_air
        Whether to work out the aerial perspective too, the larger part of the time; without, it is ``None``.
    """
    sources = [(_unit(sun_direction), _bands(1.0 / distance_au**2), SUN_RADIUS_DEG / distance_au)]
    if moon is not None:
        sources.append((_unit(moon[0]), _bands(moon[1]), moon[2]))
    view = observer_view(tables, observer_height_m)
    true_rad = [_true_rad(tables.atmosphere, direction, observer_height_m) for direction, _, _ in sources]
    # numpy lets go of the interpreter while it works: sky and air of each luminary side by side.
    with ThreadPoolExecutor(2) as pool:
        skies = [
            pool.submit(observed_sky, tables, view, direction, true, irradiance)
            for (direction, irradiance, _), true in zip(sources, true_rad, strict=True)
        ]
        near = [
            pool.submit(airlight, tables, view, true, irradiance)
            for (_, irradiance, _), true in zip(sources, true_rad, strict=True)
            if with_air
        ]
        lights = tuple(sky.result() for sky in skies)
        radiance = _map_of(lights, shape)
        airs = tuple(air.result() for air in near)
    luminaries = [
        sun_luminary(tables, direction, observer_height_m, irradiance=irradiance, angular_radius_deg=radius)
        for direction, irradiance, radius in sources
    ]
    illuminant = sum(
        irradiance * _surface_transfer(tables, direction, observer_height_m, true)
        for (direction, irradiance, _), true in zip(sources, true_rad, strict=True)
    )
    return Illumination(
        sky_radiance=radiance,
        sun=luminaries[0],
        moon=luminaries[1] if moon is not None else None,
        aerial_perspective=tabulate_aerial_perspective(view, tuple(zip(lights, airs, strict=True)), illuminant + 1e-12)
        if with_air
        else None,
        model={"kind": "atmosphere", "observer_height_m": float(observer_height_m), **asdict(tables.atmosphere)},
    )


def save_tables(path: str | PathLike, tables: AtmosphereTables) -> None:
    """Write tables to one ``.npz`` file, atomically."""
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


def load_tables(path: str | PathLike) -> AtmosphereTables:
    """Tables of `save_tables`.

    Raises
    ------
    ValueError
        For a file of another revision; compute it anew.
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


def _unit(direction) -> np.ndarray:
    direction = np.asarray(direction, float)
    if direction.shape != (3,) or not abs(np.linalg.norm(direction) - 1.0) < 1e-3:
        raise ValueError(f"direction: got {direction}, expected a unit vector (3,)")
    return direction / np.linalg.norm(direction)


def _bands(irradiance) -> np.ndarray:
    return np.broadcast_to(np.asarray(irradiance, float), WAVELENGTHS_NM.shape)


def _true_rad(atmosphere: Atmosphere, direction: np.ndarray, height_m: float) -> float:
    _, apparent_deg = angles_from_direction(direction)
    return float(np.radians(true_elevation_deg(atmosphere, apparent_deg, height_m)))


def _map_of(lights: tuple[ScatteredRadiance, ...], shape: tuple[int, int]) -> np.ndarray:
    """Pixel means over two by two directions, which settles the horizon's row and the sun's aureole."""
    height, width = shape
    elevation_deg = 90.0 - (np.arange(2 * height) + 0.5) * (90.0 / height)
    azimuth_deg = (np.arange(2 * width) + 0.5) * (180.0 / width)
    radiance = sum(sky_radiance_grid(light, elevation_deg, azimuth_deg) for light in lights)
    # Colours outside Rec.709 have a negative channel; no light of a map may be negative.
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


def _surface_transfer(tables: AtmosphereTables, direction: np.ndarray, height_m: float, true_rad: float) -> np.ndarray:
    """Light on a steep grey surface near the observer: half of the sun, and the sky's ground irradiance."""
    index, share = sun_index(np.sin(true_rad))
    table = tables.moments.ground_irradiance
    diffuse = table[index] * (1.0 - share) + table[index + 1] * share
    return 0.5 * _direct_transfer(tables, direction, height_m, SUN_RADIUS_DEG) + diffuse
