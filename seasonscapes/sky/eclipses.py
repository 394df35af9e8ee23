"""Eclipses: how much of the sun the moon covers, and how much of the moon lies in the Earth's shadow.

Geometry follows from the topocentric positions of the ephemeris, so an eclipse is partial, annular or total where the
observer stands. A partly covered sun is dimmer and, since its limb is darker and redder than its centre, a little redder.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from seasonscapes.sky.ephemeris import MOON_RADIUS_KM, SUN_RADIUS_KM, LunarPosition, SolarPosition
from seasonscapes.sky.illumination import Illumination, ScaledAir

# Limb darkening I(µ) = µ^α of the sun, α = -0.023 + 0.292 µm / λ (Hestroffer & Magnan 1998, A&A 333, 338), at the
# dominant wavelengths of Rec.709's primaries [µm].
_PRIMARY_UM = np.array([0.611, 0.549, 0.464])
_RINGS = 400
# Sky light follows the sun's light down to 0.2 % of it; in totality light scattered in from outside the umbra remains,
# a few lux (Sharp, Silverman & Lloyd 1971, doi:10.1364/AO.10.001207).
_TOTALITY_SKY = 5e-4
# Danjon's shadow: that of a sphere of the Earth's radius at 45° of latitude, enlarged by its atmosphere by 1 % of the
# moon's parallax (Espenak & Meeus 2009, NASA/TP-2009-214173). Light refracted into the umbra makes the moon
# coppery, some ten thousand times dimmer than the full moon (Danjon's L = 2).
_SHADOW_ENLARGEMENT = 1.01 * 0.99834
_UMBRA_RGB = np.array([3.0e-4, 6.0e-5, 1.5e-5])
_EARTH_RADIUS_KM = 6378.137
_AU_KM = 149_597_870.7
# Below it neither disc is seen.
_HORIZON_DEG = -1.0


@dataclass(frozen=True)
class SolarEclipse:
    """A sun that the moon covers in part or whole, as seen from one place at one instant.

    Parameters
    ----------
    kind
        ``partial``, ``annular`` or ``total``.
    magnitude
        Covered fraction of the sun's diameter; of annular and total eclipses the ratio of the diameters.
    visible_rgb
        Fraction of the sun's light that is left, linear Rec.709 ``(3,)``.
    """

    kind: str
    magnitude: float
    visible_rgb: np.ndarray


@dataclass(frozen=True)
class LunarEclipse:
    """A moon in the Earth's shadow.

    Parameters
    ----------
    kind
        ``penumbral``, ``partial`` or ``total``.
    magnitude
        Fraction of the moon's diameter within the umbra; negative in a penumbral eclipse.
    light_rgb
        Moonlight relative to the same moon without an eclipse, linear Rec.709 ``(3,)``.
    """

    kind: str
    magnitude: float
    light_rgb: np.ndarray


def solar_eclipse(sun: SolarPosition, moon: LunarPosition) -> SolarEclipse | None:
    """Return the eclipse of the sun by the moon at an instant and place.

    Parameters
    ----------
    sun, moon
        Topocentric positions at the same instant and place.

    Returns
    -------
    SolarEclipse or None
        ``None`` where the discs do not overlap.

    Notes
    -----
    Refraction lifts both bodies alike; the separation is that of their apparent centres.
    """
    separation = np.degrees(np.linalg.norm(np.asarray(sun.direction) - np.asarray(moon.direction)))
    sun_radius, moon_radius = float(sun.angular_radius_deg), float(moon.angular_radius_deg)
    overlap = sun_radius + moon_radius - separation
    if overlap <= 0.0:
        return None
    if separation <= abs(moon_radius - sun_radius):
        kind, magnitude = "total" if moon_radius >= sun_radius else "annular", moon_radius / sun_radius
    else:
        kind, magnitude = "partial", float(overlap / (2.0 * sun_radius))
    return SolarEclipse(kind, magnitude, visible_fraction(separation / sun_radius, moon_radius / sun_radius))


def visible_fraction(separation: float, moon_radius: float) -> np.ndarray:
    """Compute the fraction of the sun's light that a moon leaves, with limb darkening.

    Parameters
    ----------
    separation, moon_radius
        Distance of the centres and radius of the moon, in radii of the sun.

    Returns
    -------
    numpy.ndarray
        ``(3,)`` linear Rec.709 in [0, 1].
    """
    radius = (np.arange(_RINGS) + 0.5) / _RINGS
    brightness = np.sqrt(1.0 - radius**2)[:, None] ** (-0.023 + 0.292 / _PRIMARY_UM)
    # Share of each ring about the sun's centre that the moon's disc covers.
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (radius**2 + separation**2 - moon_radius**2) / (2.0 * radius * separation)
    covered = np.where(
        separation + radius <= moon_radius,
        1.0,
        np.where(abs(separation - radius) >= moon_radius, 0.0, np.arccos(np.clip(cosine, -1.0, 1.0)) / np.pi),
    )
    weight = radius[:, None] * brightness
    return ((1.0 - covered)[:, None] * weight).sum(axis=0) / weight.sum(axis=0)


def lunar_eclipse(moon: LunarPosition) -> LunarEclipse | None:
    """Return the eclipse of the moon by the Earth's shadow.

    Parameters
    ----------
    moon
        Its distances, and its angle from the axis of the shadow.

    Returns
    -------
    LunarEclipse or None
        ``None`` outside the penumbra.
    """
    angle, sun_distance_au = float(moon.shadow_angle_deg), float(moon.sun_distance_au)
    parallax = np.degrees(np.arcsin(_EARTH_RADIUS_KM / float(moon.geocentric_km)))
    sun_parallax = np.degrees(np.arcsin(_EARTH_RADIUS_KM / (sun_distance_au * _AU_KM)))
    sun_radius = np.degrees(np.arcsin(SUN_RADIUS_KM / (sun_distance_au * _AU_KM)))
    moon_radius = np.degrees(np.arcsin(MOON_RADIUS_KM / float(moon.geocentric_km)))
    umbra = _SHADOW_ENLARGEMENT * parallax + sun_parallax - sun_radius
    penumbra = _SHADOW_ENLARGEMENT * parallax + sun_parallax + sun_radius
    if angle >= penumbra + moon_radius:
        return None
    magnitude = (umbra + moon_radius - angle) / (2.0 * moon_radius)
    kind = "total" if magnitude >= 1.0 else "partial" if magnitude > 0.0 else "penumbral"
    # Points of the moon's disc; in the penumbra the Earth covers the sun like a straight edge.
    x, y = np.meshgrid(*(2 * [(np.arange(64) - 31.5) / 32.0]))
    disc = x**2 + y**2 < 1.0
    distance = np.hypot(angle + moon_radius * x[disc], moon_radius * y[disc])
    depth = np.clip((distance - umbra) / (penumbra - umbra), 0.0, 1.0)
    sunlit = depth - np.sin(2.0 * np.pi * depth) / (2.0 * np.pi)
    light = sunlit.mean() + _UMBRA_RGB * (1.0 - sunlit).mean()
    return LunarEclipse(kind, float(magnitude), np.minimum(light, 1.0))


def moonlight_fraction(moon: LunarPosition, wavelength_nm: np.ndarray) -> np.ndarray:
    """Moonlight relative to the same moon without an eclipse, ``(B,)`` at wavelengths ``(B,)`` [nm]."""
    eclipse = lunar_eclipse(moon)
    if eclipse is None:
        return np.ones(np.shape(wavelength_nm))
    return np.interp(wavelength_nm, 1000.0 * _PRIMARY_UM[::-1], eclipse.light_rgb[::-1])


def eclipse_record(sun: SolarPosition, moon: LunarPosition | None) -> dict[str, Any] | None:
    """Plain values about the eclipse of an instant for files and reports; ``None`` without one above the horizon."""
    if moon is None:
        return None
    solar, lunar = solar_eclipse(sun, moon), lunar_eclipse(moon)
    if solar is not None and sun.elevation_deg > _HORIZON_DEG:
        return {"of": "sun", "kind": solar.kind, "magnitude": round(solar.magnitude, 3)}
    if lunar is not None and moon.elevation_deg > _HORIZON_DEG:
        return {"of": "moon", "kind": lunar.kind, "magnitude": round(lunar.magnitude, 3)}
    return None


def eclipsed_sun(illumination: Illumination, eclipse: SolarEclipse) -> Illumination:
    """Dim an illumination by daylight as an eclipse of the sun does.

    Parameters
    ----------
    illumination
        Of an instant with the sun uncovered.
    eclipse
        The eclipse.

    Returns
    -------
    Illumination
        Sunlight is reduced to what the moon leaves; sky and airlight likewise, down to the level of totality.
    """
    sky = (eclipse.visible_rgb + (1.0 - eclipse.visible_rgb) * _TOTALITY_SKY).astype(np.float32)
    sun, air = illumination.sun, illumination.aerial_perspective
    visible = illumination.visible_sky
    return replace(
        illumination,
        sky_radiance=illumination.sky_radiance * sky,
        visible_sky=None if visible is None else visible * sky,
        sun=None
        if sun is None
        else replace(sun, normal_illuminance_lx=np.asarray(sun.normal_illuminance_lx) * eclipse.visible_rgb),
        aerial_perspective=None if air is None else ScaledAir(air, sky),
    )
