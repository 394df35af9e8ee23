"""Illumination of one instant from a sky model and the positions of sun and moon."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np

from seasonscapes.sky.atmosphere import Atmosphere
from seasonscapes.sky.broadband import clear_efficacies_lm_w
from seasonscapes.sky.clear_sky import AtmosphereTables, LuminarySource, atmosphere_tables, illumination_from_atmosphere
from seasonscapes.sky.clouds import with_clouds
from seasonscapes.sky.eclipses import eclipse_record, eclipsed_sun, solar_eclipse
from seasonscapes.sky.ephemeris import LunarPosition, SolarPosition
from seasonscapes.sky.illumination import Illumination, diffuse_horizontal_illuminance, luminance
from seasonscapes.sky.models import (
    AtmosphereModel,
    HosekModel,
    OvercastModel,
    SkyModel,
    atmosphere_from_model,
    check_valid,
)
from seasonscapes.sky.night import moon_to_sun_ratio, night_sky_radiance
from seasonscapes.sky.overcast import (
    DAY_CCT_K,
    clear_illuminance_lx,
    cloud_transmission,
    daylight_rgb,
    overcast,
    overcast_rgb,
)
from seasonscapes.sky.shipped_tables import shipped_tables
from seasonscapes.sky.spectrum import WAVELENGTHS_NM, angstrom_ratio, rayleigh_optical_depth

TablesOf = Callable[[Atmosphere], AtmosphereTables]


class HosekFunction(Protocol):
    """Evaluation of the Hosek-Wilkie sky model; `seasonscapes.rendering.hosek.hosek_illumination`."""

    def __call__(
        self, sun_direction: np.ndarray, *, turbidity: float, ground_albedo: float, shape: tuple[int, int]
    ) -> Illumination:
        """Compute the illumination from the apparent solar direction ``(3,)`` as a map of ``shape`` pixels."""
        ...


# Moonlight is omitted if the sun is above, or the moon below, these elevations, where it contributes less than 1e-3 of
# the sunlight or of the night sky's light.
_MAX_SUN_FOR_MOONLIGHT_DEG, _MIN_MOON_DEG = 0.0, -9.0


@lru_cache(maxsize=4)
def tables_in_memory(atmosphere: Atmosphere) -> AtmosphereTables:
    """The tables of an atmosphere, shipped or computed, with a cache in memory.

    Parameters
    ----------
    atmosphere
        Atmosphere.

    Returns
    -------
    AtmosphereTables
        Tables of the atmosphere.
    """
    return shipped_tables(atmosphere) or atmosphere_tables(atmosphere)


@dataclass(frozen=True)
class SkyEvaluators:
    """Functions on which the evaluation of sky models depends.

    Parameters
    ----------
    tables_of
        Function that returns the tables of an atmosphere, for example from a cache on disk. The default loads those of
        the bundled models and computes others once per process, in seconds.
    hosek
        Function that evaluates models of kind ``hosek``: `seasonscapes.rendering.hosek.hosek_illumination`.
    """

    tables_of: TablesOf = tables_in_memory
    hosek: HosekFunction | None = None


def illuminate(
    model: SkyModel,
    sun: SolarPosition,
    moon: LunarPosition | None = None,
    *,
    height_m: float = 0.0,
    map_height: int = 128,
    with_aerial_perspective: bool = True,
    evaluators: SkyEvaluators | None = None,
) -> Illumination:
    """Compute the illumination of one instant at one place under a sky model.

    Parameters
    ----------
    model
        Sky model, from `models.read_sky_model`.
    sun, moon
        Positions at the same instant and place; without a moon there is no moonlight.
    height_m
        Height of the observer [m].
    map_height
        Rows of the sky map; it has twice as many columns. Models of kind ``atmosphere`` without clouds may have none.
    with_aerial_perspective
        Whether atmosphere models compute the aerial perspective, which takes most of their time.
    evaluators
        Tables of atmospheres and evaluation of models of kind ``hosek``; the defaults of `SkyEvaluators` if ``None``.

    Returns
    -------
    Illumination
        Illumination without frame and time.

    Raises
    ------
    InputError
        If sun or observer are outside the model's valid range.
    ValueError
        If the model is of kind ``hosek`` and ``evaluators.hosek`` is omitted, or of an unknown class.
    """
    light = _uneclipsed(
        model,
        sun,
        moon,
        height_m=height_m,
        map_height=map_height,
        with_aerial_perspective=with_aerial_perspective,
        evaluators=evaluators or SkyEvaluators(),
    )
    eclipse = None if moon is None else solar_eclipse(sun, moon)
    light = light if eclipse is None else eclipsed_sun(light, eclipse)
    record = eclipse_record(sun, moon)
    return light if record is None else replace(light, model={**light.model, "eclipse": record})


def _uneclipsed(
    model: SkyModel,
    sun: SolarPosition,
    moon: LunarPosition | None,
    *,
    height_m: float,
    map_height: int,
    with_aerial_perspective: bool,
    evaluators: SkyEvaluators,
) -> Illumination:
    """The illumination with an uncovered sun."""
    check_valid(model, float(sun.elevation_deg), height_m)
    if isinstance(model, OvercastModel):
        return _with_provenance(model, _overcast_illumination(model, sun, moon, height_m, map_height))
    if isinstance(model, HosekModel):
        if evaluators.hosek is None:
            raise ValueError(
                "kind 'hosek' is evaluated by the renderer: pass "
                "evaluators=SkyEvaluators(hosek=rendering.hosek.hosek_illumination)"
            )
        clear = evaluators.hosek(
            sun.direction,
            turbidity=model.turbidity,
            ground_albedo=model.ground.albedo,
            shape=(map_height, 2 * map_height),
        )
        return _with_provenance(model, _add_clouds(model, clear, sun, None))
    if isinstance(model, AtmosphereModel):
        moon = significant_moon(sun, moon)
        clear = _clear_illumination(
            model,
            sun,
            moon,
            height_m=height_m,
            map_height=map_height,
            with_aerial_perspective=with_aerial_perspective,
            tables_of=evaluators.tables_of,
        )
        return _with_provenance(model, _add_clouds(model, clear, sun, moon))
    raise ValueError(f"model: got {type(model).__name__}, expected one of `models.KINDS`")


def _with_provenance(model: SkyModel, illumination: Illumination) -> Illumination:
    record = {"name": model.name, **illumination.model}
    return replace(illumination, model={**record, "cloudiness": model.cloudiness})


def significant_moon(sun: SolarPosition, moon: LunarPosition | None) -> LunarPosition | None:
    """The moon, or ``None`` if its light is negligible."""
    if moon is None or sun.elevation_deg > _MAX_SUN_FOR_MOONLIGHT_DEG or moon.elevation_deg < _MIN_MOON_DEG:
        return None
    return moon


def _clear_illumination(
    model: AtmosphereModel,
    sun: SolarPosition,
    moon: LunarPosition | None,
    *,
    height_m: float,
    map_height: int,
    with_aerial_perspective: bool,
    tables_of: TablesOf,
) -> Illumination:
    """Illumination by the clear atmosphere and the night sky."""
    atmosphere, source = atmosphere_from_model(model), None
    if moon is not None:
        ratio = moon_to_sun_ratio(moon, WAVELENGTHS_NM)
        source = LuminarySource(moon.direction, ratio, float(moon.angular_radius_deg))
    clear = illumination_from_atmosphere(
        tables_of(atmosphere),
        sun.direction,
        height_m,
        distance_au=float(sun.distance_au),
        moon=source,
        shape=(map_height, 2 * map_height),
        with_aerial_perspective=with_aerial_perspective,
    )
    efficacy = clear_efficacies_lm_w(atmosphere, float(sun.elevation_deg), height_m, water_cm=model.water_cm)
    clear = replace(clear, efficacy_lm_w=efficacy)
    if not map_height:
        return clear
    haze = model.aerosol.optical_depth_500nm * float(angstrom_ratio(model.aerosol.angstrom_exponent, 500.0, 550.0))
    night = night_sky_radiance(
        map_height,
        2 * map_height,
        height_m=height_m,
        ground_albedo=model.ground.albedo,
        optical_depth=haze + float(rayleigh_optical_depth(550.0)),
    )
    return replace(clear, sky_radiance=(clear.sky_radiance + night).astype(np.float32))


def _overcast_illumination(
    model: OvercastModel, sun: SolarPosition, moon: LunarPosition | None, height_m: float, map_height: int
) -> Illumination:
    return overcast(
        sun,
        significant_moon(sun, moon),
        height_m=height_m,
        map_height=map_height,
        visibility_km=model.visibility_km,
        ground_albedo=model.ground.albedo,
        intermediate=model.distribution == "intermediate",
    )


def _add_clouds(model: SkyModel, clear: Illumination, sun: SolarPosition, moon: LunarPosition | None) -> Illumination:
    """Apply the model's cloudiness, with transmission and colour averaged over sun, moon and night sky.

    The weights are the clear-sky illuminances, so that the result is continuous when the dominant source changes.
    """
    if model.cloudiness == 0.0:
        return clear
    night = float(luminance(diffuse_horizontal_illuminance(night_sky_radiance(32, 8))))
    # Illuminance, transmission and colour of each source.
    sources = [
        (
            clear_illuminance_lx(sun.elevation_deg),
            cloud_transmission(sun.elevation_deg),
            overcast_rgb(sun.elevation_deg),
        ),
        (night, cloud_transmission(-20.0), daylight_rgb(4900.0)),
    ]
    dominant = sun.direction
    if moon is not None:
        ratio = float(moon_to_sun_ratio(moon, 555.0))
        moonlight = ratio * clear_illuminance_lx(moon.elevation_deg)
        sources.append((moonlight, cloud_transmission(moon.elevation_deg), daylight_rgb(DAY_CCT_K)))
        dominant = moon.direction if moonlight > sources[0][0] else dominant
    illuminances = np.array([float(illuminance) for illuminance, _, _ in sources])
    weights = illuminances / illuminances.sum()
    transmission = float(sum(weight * source[1] for weight, source in zip(weights, sources, strict=True)))
    colour = np.asarray(sum(weight * source[2] for weight, source in zip(weights, sources, strict=True)))
    clouded = with_clouds(clear, model.cloudiness, dominant, transmission=transmission, colour=colour)
    return replace(clouded, efficacy_lm_w=None)
