"""From a declared sky model and the places of sun and moon to the light of an instant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np

from seasonscapes.sky.atmosphere import Atmosphere
from seasonscapes.sky.clear_sky import AtmosphereTables, atmosphere_tables, illumination_from_atmosphere
from seasonscapes.sky.clouds import with_clouds
from seasonscapes.sky.ephemeris import LunarPosition, SolarPosition
from seasonscapes.sky.illumination import Illumination, diffuse_horizontal_illuminance, luminance
from seasonscapes.sky.models import AtmosphereModel, HosekModel, OvercastModel, SkyModel, atmosphere_of, check_valid
from seasonscapes.sky.night import moon_to_sun_ratio, night_sky_radiance
from seasonscapes.sky.overcast import (
    DAY_CCT_K,
    clear_illuminance_lx,
    cloud_transmission,
    daylight_rgb,
    overcast,
    overcast_rgb,
)
from seasonscapes.sky.spectrum import WAVELENGTHS_NM, angstrom_ratio, rayleigh_optical_depth

TablesOf = Callable[[Atmosphere], AtmosphereTables]
HosekOf = Callable[..., Illumination]

# The moon is left out where it cannot matter: under 1e-3 of the sun's light, or of the night sky's.
_SUN_OUTSHINES_DEG, _MOON_GONE_DEG = 0.0, -9.0


@lru_cache(maxsize=4)
def tables_in_memory(atmosphere: Atmosphere) -> AtmosphereTables:
    """`atmosphere_tables`, kept for the life of the process. A workspace passes its own, kept on disk."""
    return atmosphere_tables(atmosphere)


def illuminate(
    model: SkyModel,
    sun: SolarPosition,
    moon: LunarPosition | None = None,
    *,
    height_m: float = 0.0,
    map_height: int = 128,
    with_air: bool = True,
    tables_of: TablesOf = tables_in_memory,
    hosek: HosekOf | None = None,
) -> Illumination:
    """All the light of one instant at one place under a sky model.

    Parameters
    ----------
    model
        From `models.read_sky_model`, with or without overrides.
    sun, moon
        Where they stand, of the same instant and place; without a moon there is no moonlight.
    height_m
        Of the observer [m].
    map_height
        Rows of the sky map; it has twice as many columns.
    with_air
        Without, atmosphere models leave out aerial perspective, the larger part of their time.
    tables_of
        Gives the tables of an atmosphere; the default computes them once a process, in tens of seconds.
    hosek
        For models of kind ``hosek`` only, whose evaluation is the renderer's:
        `seasonscapes.rendering.hosek.hosek_illumination`.

    Raises
    ------
    InputError
        Where sun or observer are outside the model's valid range.
    ValueError
        For a model of kind ``hosek`` without ``hosek``.
    """
    check_valid(model, float(sun.elevation_deg), height_m)
    if isinstance(model, OvercastModel):
        return _named(model, _overcast(model, sun, moon, height_m, map_height))
    if isinstance(model, HosekModel):
        if hosek is None:
            raise ValueError("kind 'hosek' is evaluated by the renderer: pass hosek=rendering.hosek.hosek_illumination")
        clear = hosek(
            sun.direction,
            turbidity=model.turbidity,
            ground_albedo=model.ground.albedo,
            shape=(map_height, 2 * map_height),
        )
        return _named(model, _clouded(model, clear, sun, None))
    if isinstance(model, AtmosphereModel):
        moon = _worth_having(sun, moon)
        clear = _atmosphere(model, sun, moon, height_m, (map_height, with_air), tables_of)
        return _named(model, _clouded(model, clear, sun, moon))
    raise ValueError(f"model: got {type(model).__name__}, expected one of `models.KINDS`")


def _named(model: SkyModel, illumination: Illumination) -> Illumination:
    record = {"name": model.name, **illumination.model}
    return replace(illumination, model={**record, "cloudiness": model.cloudiness})


def _worth_having(sun: SolarPosition, moon: LunarPosition | None) -> LunarPosition | None:
    if moon is None or sun.elevation_deg > _SUN_OUTSHINES_DEG or moon.elevation_deg < _MOON_GONE_DEG:
        return None
    return moon


def _atmosphere(
    model: AtmosphereModel,
    sun: SolarPosition,
    moon: LunarPosition | None,
    height_m: float,
    extent: tuple[int, bool],
    tables_of: TablesOf,
) -> Illumination:
    map_height, with_air = extent
    source = None
    if moon is not None:
        source = (moon.direction, moon_to_sun_ratio(moon, WAVELENGTHS_NM), float(moon.angular_radius_deg))
    clear = illumination_from_atmosphere(
        tables_of(atmosphere_of(model)),
        sun.direction,
        height_m,
        distance_au=float(sun.distance_au),
        moon=source,
        shape=(map_height, 2 * map_height),
        with_air=with_air,
    )
    haze = model.aerosol.optical_depth_500nm * float(angstrom_ratio(model.aerosol.angstrom_exponent, 500.0, 550.0))
    night = night_sky_radiance(
        map_height,
        2 * map_height,
        height_m=height_m,
        ground_albedo=model.ground.albedo,
        optical_depth=haze + float(rayleigh_optical_depth(550.0)),
    )
    return replace(clear, sky_radiance=(clear.sky_radiance + night).astype(np.float32))


def _overcast(
    model: OvercastModel, sun: SolarPosition, moon: LunarPosition | None, height_m: float, map_height: int
) -> Illumination:
    return overcast(
        sun,
        _worth_having(sun, moon),
        height_m=height_m,
        map_height=map_height,
        visibility_km=model.visibility_km,
        ground_albedo=model.ground.albedo,
        intermediate=model.distribution == "intermediate",
    )


def _clouded(model: SkyModel, clear: Illumination, sun: SolarPosition, moon: LunarPosition | None) -> Illumination:
    """Clouds lit by sun, moon and night sky, each let through by its own share; no jump as one takes over."""
    if model.cloudiness == 0.0:
        return clear
    night = float(luminance(diffuse_horizontal_illuminance(night_sky_radiance(32, 8))))
    lights = [
        (
            clear_illuminance_lx(sun.elevation_deg),
            cloud_transmission(sun.elevation_deg),
            overcast_rgb(sun.elevation_deg),
        ),
        (night, cloud_transmission(-20.0), daylight_rgb(4900.0)),
    ]
    source = sun.direction
    if moon is not None:
        ratio = float(moon_to_sun_ratio(moon, 555.0))
        moonlight = ratio * clear_illuminance_lx(moon.elevation_deg)
        lights.append((moonlight, cloud_transmission(moon.elevation_deg), daylight_rgb(DAY_CCT_K)))
        source = moon.direction if moonlight > lights[0][0] else source
    amounts = np.array([float(amount) for amount, _, _ in lights])
    shares = amounts / amounts.sum()
    transmission = float(sum(share * light[1] for share, light in zip(shares, lights, strict=True)))
    colour = sum(share * light[2] for share, light in zip(shares, lights, strict=True))
    return with_clouds(clear, model.cloudiness, source, transmission=transmission, colour=colour)
