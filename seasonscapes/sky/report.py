"""Numerical summary of an illumination, and fish-eye pictures of the sky dome."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np

from seasonscapes.frames import angles_from_direction, direction_from_angles, sample_equirectangular
from seasonscapes.images import auto_exposure_ev100, expose, linear_from_srgb, srgb_from_linear, tone_curve
from seasonscapes.sky.colour_temperature import correlated_colour_temperature_k
from seasonscapes.sky.ephemeris import LunarPosition, SolarPosition, SunEvents, sun_events
from seasonscapes.sky.illumination import (
    Illumination,
    Luminary,
    diffuse_horizontal_illuminance,
    global_horizontal_illuminance,
    luminance,
)


def sky_record(
    illumination: Illumination,
    time: datetime,
    sun: SolarPosition,
    moon: LunarPosition,
    latitude_deg: float,
    longitude_deg: float,
    *,
    zone: str | None = None,
) -> dict[str, Any]:
    """Summarise sun, moon, illuminances and sun events of an instant as JSON-serialisable values.

    Parameters
    ----------
    illumination
        Illumination of the instant, from `illuminate.illuminate`.
    time
        Aware datetime.
    sun, moon
        Positions of sun and moon.
    latitude_deg, longitude_deg
        WGS 84 position for the sun events [deg].
    zone
        IANA name of the civil time zone that determines the date of the sun events; local mean time if omitted.

    Returns
    -------
    dict
        ``illuminance_lx.direct_normal`` is the illuminance of the brighter luminary, named by ``direct_source``.
        Events that do not occur and undefined colour temperatures are ``None``.
    """
    tz = ZoneInfo(zone) if zone else timezone(timedelta(minutes=round(4.0 * longitude_deg)))
    events = sun_events(time.astimezone(tz).date(), latitude_deg, longitude_deg, tz)
    candidates = {"sun": illumination.sun, "moon": illumination.moon}
    luminaries = {name: luminary for name, luminary in candidates.items() if luminary is not None}
    source = max(luminaries, key=lambda name: _normal_lx(luminaries[name]), default=None)
    light = {
        "direct_normal": np.zeros(3) if source is None else np.asarray(luminaries[source].normal_illuminance_lx, float),
        "diffuse_horizontal": diffuse_horizontal_illuminance(illumination.sky_radiance),
        "global_horizontal": global_horizontal_illuminance(illumination),
    }
    return {
        "time_utc": _iso(time),
        "sun": {
            "azimuth_deg": float(sun.azimuth_deg),
            "elevation_deg": float(sun.elevation_deg),
            "distance_au": float(sun.distance_au),
        },
        "moon": {
            "azimuth_deg": float(moon.azimuth_deg),
            "elevation_deg": float(moon.elevation_deg),
            "illuminated_fraction": float(moon.illuminated_fraction),
            "phase_angle_deg": float(moon.phase_angle_deg),
            "waxing": bool(moon.waxing),
            "distance_km": float(moon.distance_km),
        },
        "direct_source": source,
        "illuminance_lx": {name: float(luminance(rgb)) for name, rgb in light.items()},
        "illuminance_rgb": {name: [float(value) for value in rgb] for name, rgb in light.items()},
        "cct_k": {name: correlated_colour_temperature_k(rgb) for name, rgb in light.items()},
        **_event_times(events),
        "eclipse": illumination.model.get("eclipse"),
        "model": illumination.model,
    }


def record_lines(record: dict[str, Any]) -> list[str]:
    """Format a record of `sky_record` as human-readable lines.

    Parameters
    ----------
    record
        Record of `sky_record`.

    Returns
    -------
    list of str
        Lines of text.
    """
    sun, moon, lux, kelvin = record["sun"], record["moon"], record["illuminance_lx"], record["cct_k"]

    def clock(key: str) -> str:
        return record[key][11:16] if record[key] else "never"

    def colour_of(name: str) -> str:
        return f"{kelvin[name]:,.0f} K" if kelvin[name] else "no colour temperature"

    phase = f"{100.0 * moon['illuminated_fraction']:.0f} % lit, {'waxing' if moon['waxing'] else 'waning'}"
    direct = f" ({record['direct_source']})" if record["direct_source"] else ""
    eclipse = record["eclipse"]
    eclipses = [f"eclipse  {eclipse_text(eclipse)}"] if eclipse else []
    return [
        f"time     {record['time_utc']}",
        f"sun      azimuth {sun['azimuth_deg']:.2f}°, elevation {sun['elevation_deg']:.2f}° (refracted)",
        f"moon     azimuth {moon['azimuth_deg']:.2f}°, elevation {moon['elevation_deg']:.2f}°, {phase}",
        *eclipses,
        f"day      sunrise {clock('sunrise_utc')}, noon {clock('solar_noon_utc')}, sunset {clock('sunset_utc')} UTC",
        f"twilight civil {clock('civil_dawn_utc')} to {clock('civil_dusk_utc')}, "
        f"nautical {clock('nautical_dawn_utc')} to {clock('nautical_dusk_utc')}, "
        f"astronomical {clock('astronomical_dawn_utc')} to {clock('astronomical_dusk_utc')} UTC",
        f"direct   {lux['direct_normal']:.4g} lx normal{direct}, {colour_of('direct_normal')}",
        f"diffuse  {lux['diffuse_horizontal']:.4g} lx horizontal, {colour_of('diffuse_horizontal')}",
        f"global   {lux['global_horizontal']:.4g} lx horizontal, {colour_of('global_horizontal')}",
    ]


def eclipse_text(eclipse: dict[str, Any]) -> str:
    """One phrase about an eclipse, from its record."""
    return f"{eclipse['kind']} eclipse of the {eclipse['of']}, magnitude {eclipse['magnitude']:.2f}"


def moon_text(moon: LunarPosition) -> str:
    """One phrase about the moon for pictures of a night."""
    if moon.elevation_deg < 0.0:
        return "moon below the horizon"
    lit = f"{100.0 * moon.illuminated_fraction:.0f} % lit"
    return f"moon at azimuth {moon.azimuth_deg:.2f}°, elevation {moon.elevation_deg:.2f}°, {lit}"


def dome_radiance(illumination: Illumination, size_px: int = 512) -> np.ndarray:
    """Project the upper hemisphere of the sky to an equidistant fish-eye image.

    North is up and **east to the right**, as on a map (the mirror image of the view upwards). The distance from the
    centre is proportional to the angle from the zenith. The discs of sun and moon are not included.

    Parameters
    ----------
    illumination
        Illumination whose sky is shown.
    size_px
        Side length S [px].

    Returns
    -------
    ndarray
        Radiance ``(S, S, 3)`` [cd/m²]; NaN below the horizon.
    """
    axis = (np.arange(size_px) + 0.5) * (2.0 / size_px) - 1.0
    x, y = np.meshgrid(axis, -axis)
    radius = np.hypot(x, y)
    direction = direction_from_angles(np.degrees(np.arctan2(x, y)), 90.0 - 90.0 * np.minimum(radius, 1.0))
    height = illumination.sky_radiance.shape[0]
    # Clamp the elevation so that interpolation does not use rows below the horizon, which hold ground radiance.
    direction[..., 2] = np.maximum(direction[..., 2], np.sin(np.radians(90.0 / height)))
    sky = sample_equirectangular(illumination.sky_radiance, direction)
    return np.where(radius[..., None] <= 1.0, sky, np.nan)


def dome_picture(illumination: Illumination, size_px: int = 768, *, ev100: float | None = None) -> np.ndarray:
    """Render `dome_radiance` for display, annotated with compass directions, elevation circles, sun and moon.

    Parameters
    ----------
    illumination
        Illumination whose sky is shown.
    size_px
        Side length S [px].
    ev100
        Exposure; metered from the dome if omitted.

    Returns
    -------
    ndarray
        Display-linear picture ``(S, S, 3)`` in [0, 1], for `images.write_png`.

    Raises
    ------
    NoUsablePixels
        If the exposure is metered and the sky has no positive luminance.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> ss.dome_picture(ss.illumination(place, "2024-07-20T13:30", sky="hosek"), 140).shape
    (140, 140, 3)
    """
    import cv2

    margin = size_px // 14
    inner = size_px - 2 * margin
    dome = dome_radiance(illumination, inner)
    inside = np.isfinite(dome[..., 0])
    radiance = np.where(inside[..., None], dome, 0.0)
    ev100 = auto_exposure_ev100(radiance, inside) if ev100 is None else ev100
    canvas = np.full((size_px, size_px, 3), 0.02, np.float32)
    display = tone_curve(expose(radiance, ev100)).clip(0.0, 1.0)
    window = canvas[margin : margin + inner, margin : margin + inner]
    window[inside] = display[inside]
    encoded = np.round(255.0 * srgb_from_linear(canvas)).astype(np.uint8)  # putText needs 8-bit images
    middle, scale = size_px / 2.0, inner / 2.0
    ink, thin = (235, 235, 235), max(1, size_px // 768)

    def pixel_of(direction: np.ndarray) -> tuple[int, int]:
        azimuth, elevation = (np.radians(float(angle)) for angle in angles_from_direction(direction))
        radius = scale * (1.0 - elevation / (np.pi / 2.0))
        return round(middle + radius * np.sin(azimuth)), round(middle - radius * np.cos(azimuth))

    def write(text: str, x: float, y: float, size: float) -> None:
        (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, thin)
        at = (round(x - width / 2), round(y + height / 2))
        cv2.putText(encoded, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, ink, thin, cv2.LINE_AA)

    for elevation_deg in (0, 30, 60):
        radius = scale * (1.0 - elevation_deg / 90.0)
        cv2.circle(encoded, (round(middle), round(middle)), round(radius), ink, thin, cv2.LINE_AA)
        if elevation_deg:
            write(f"{elevation_deg}", middle + 0.7071 * radius, middle + 0.7071 * radius, size_px / 1900)
    for name, (dx, dy) in {"N": (0, -1), "E": (1, 0), "S": (0, 1), "W": (-1, 0)}.items():
        write(name, middle + dx * (scale + margin / 2), middle + dy * (scale + margin / 2), size_px / 900)
    for luminary, colour in ((illumination.sun, (255, 190, 25)), (illumination.moon, (190, 215, 255))):
        if luminary is not None and luminary.direction[2] > 0.0:
            cv2.circle(encoded, pixel_of(luminary.direction), size_px // 90, colour, 2 * thin, cv2.LINE_AA)
    return linear_from_srgb(encoded / 255.0)


def _normal_lx(luminary: Luminary) -> float:
    return float(luminance(luminary.normal_illuminance_lx))


def _event_times(events: SunEvents) -> dict[str, str | None]:
    names = (
        "sunrise",
        "sunset",
        "solar_noon",
        "civil_dawn",
        "civil_dusk",
        "nautical_dawn",
        "nautical_dusk",
        "astronomical_dawn",
        "astronomical_dusk",
    )
    times = {name: getattr(events, name) for name in names}
    return {f"{name}_utc": None if time is None else _iso(time) for name, time in times.items()}


def _iso(time: datetime) -> str:
    return time.astimezone(ZoneInfo("UTC")).isoformat(timespec="seconds").replace("+00:00", "Z")
