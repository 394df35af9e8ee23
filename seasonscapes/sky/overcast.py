"""Overcast sky in absolute units: CIE luminance distributions, illuminance by solar elevation, aerial perspective."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.frames import equirectangular_directions
from seasonscapes.sky.ephemeris import LunarPosition, SolarPosition
from seasonscapes.sky.illumination import Illumination, diffuse_horizontal_illuminance, luminance
from seasonscapes.sky.night import moon_to_sun_ratio, night_sky_radiance
from seasonscapes.sky.spectrum import RGB_FROM_XYZ

# Clear horizontal illuminance [lx] by solar elevation [deg]: the fits of Seidelmann (ed.), Explanatory Supplement to
# the Astronomical Almanac (1992), § 9.3, less the night sky of 6.2e-4 lx that is included in measurements below -12°.
_ELEVATION_DEG = (
    -20, -18, -16, -14, -12, -10, -8, -6, -5, -4, -3, -2, -1,
    0, 1, 2, 3, 5, 7, 10, 15, 20, 30, 45, 60, 90,
)  # fmt: skip
_CLEAR_LX = (
    1e-7, 2.5e-5, 8.2e-4, 2.30e-3, 7.44e-3, 4.15e-2, 0.3474, 3.411, 10.44, 29.93, 79.07, 189.4, 404.6, 758.6, 1268.0,
    1920.8, 2689.0, 4538.3, 6839.2, 11121.0, 19228.0, 27376.0, 46297.0, 77848.0, 103118.0, 128825.0,
)  # fmt: skip
# Transmission of a closed cloud layer for a low sun; gives the 300 lx of Krochmann & Seidl at 0°.
_LOW_SUN_TRANSMISSION = 0.4

# Colour of the layer: near D65 by day, bluer in twilight owing to ozone absorption in the light from above (Lee &
# Hernández-Andrés 2005, Applied Optics 44, 5712).
DAY_CCT_K, TWILIGHT_CCT_K = 6500.0, 9500.0

# CIE S 011 / ISO 15469 parameters (a, b, c, d, e). Type 8: partly cloudy, no gradation, distinct solar corona.
INTERMEDIATE = (0.0, -1.0, 10.0, -3.0, 0.45)


def clear_illuminance_lx(sun_elevation_deg: ArrayLike) -> np.ndarray:
    """Interpolate the global horizontal illuminance of a mean clear sky, without the night sky.

    Parameters
    ----------
    sun_elevation_deg
        Solar elevation ``(...)`` [deg].

    Returns
    -------
    ndarray
        Illuminance ``(...)`` [lx].
    """
    return 10.0 ** np.interp(np.asarray(sun_elevation_deg, float), _ELEVATION_DEG, np.log10(_CLEAR_LX))


def overcast_illuminance_lx(sun_elevation_deg: ArrayLike) -> np.ndarray:
    """Compute the horizontal illuminance under a closed cloud layer.

    ``300 + 21000 sin γ`` (Krochmann & Seidl 1974, Lighting Res. Technol. 6, 165; DIN 5034-2) from 10° up; below 2°
    and in twilight 0.4 of the clear sky's illuminance, which gives the same 300 lx at 0°; geometric blending between.

    Parameters
    ----------
    sun_elevation_deg
        Solar elevation ``(...)`` [deg].

    Returns
    -------
    ndarray
        Illuminance ``(...)`` [lx].
    """
    elevation = np.asarray(sun_elevation_deg, float)
    low = _LOW_SUN_TRANSMISSION * clear_illuminance_lx(elevation)
    high = 300.0 + 21000.0 * np.sin(np.radians(np.maximum(elevation, 0.0)))
    blend = np.clip((elevation - 2.0) / 8.0, 0.0, 1.0)
    blend = blend**2 * (3.0 - 2.0 * blend)
    return low ** (1.0 - blend) * high**blend


def cloud_transmission(elevation_deg: ArrayLike) -> np.ndarray:
    """Compute the transmission of a closed cloud layer, relative to the clear sky's horizontal illuminance.

    Parameters
    ----------
    elevation_deg
        Elevation of the luminary ``(...)`` [deg].

    Returns
    -------
    ndarray
        Transmission ``(...)``.
    """
    return overcast_illuminance_lx(elevation_deg) / clear_illuminance_lx(elevation_deg)


def daylight_rgb(cct_k: float) -> np.ndarray:
    """Compute the colour of CIE daylight of a correlated colour temperature (CIE 15:2018, eq. 4.7 to 4.9).

    Parameters
    ----------
    cct_k
        Correlated colour temperature [K], clipped to 4000 to 25000.

    Returns
    -------
    ndarray
        Linear Rec.709 at luminance 1 ``(3,)``.
    """
    t = float(np.clip(cct_k, 4000.0, 25000.0))
    if t <= 7000.0:
        x = -4.6070e9 / t**3 + 2.9678e6 / t**2 + 0.09911e3 / t + 0.244063
    else:
        x = -2.0064e9 / t**3 + 1.9018e6 / t**2 + 0.24748e3 / t + 0.237040
    y = -3.0 * x**2 + 2.870 * x - 0.275
    rgb = RGB_FROM_XYZ @ np.array([x / y, 1.0, (1.0 - x - y) / y])
    return rgb / luminance(rgb)


def overcast_rgb(sun_elevation_deg: float) -> np.ndarray:
    """Compute the colour of a closed cloud layer from below.

    Its colour temperature changes linearly in reciprocal megakelvin from 2° to -6° solar elevation.

    Parameters
    ----------
    sun_elevation_deg
        Solar elevation [deg].

    Returns
    -------
    ndarray
        Linear Rec.709 at luminance 1 ``(3,)``.
    """
    twilight = np.clip((2.0 - sun_elevation_deg) / 8.0, 0.0, 1.0)
    return daylight_rgb(1.0 / ((1.0 - twilight) / DAY_CCT_K + twilight / TWILIGHT_CCT_K))


def standard_overcast(elevation_deg: ArrayLike) -> np.ndarray:
    """Compute the luminance of the CIE standard overcast sky per horizontal illuminance, ``Lz (1 + 2 sin e) / 3``.

    Moon & Spencer (1942); ISO 15469 type 16. Its horizontal illuminance is ``7π/9 Lz``.

    Parameters
    ----------
    elevation_deg
        Elevation ``(...)`` [deg].

    Returns
    -------
    ndarray
        Luminance per illuminance ``(...)`` [1/sr]; below the horizon the value at the horizon.
    """
    return (9.0 / (7.0 * np.pi)) * (1.0 + 2.0 * np.sin(np.radians(np.maximum(elevation_deg, 0.0)))) / 3.0


def general_sky(
    direction: ArrayLike,
    source_direction: ArrayLike,
    parameters: tuple[float, float, float, float, float] = INTERMEDIATE,
) -> np.ndarray:
    """Compute the relative luminance of a CIE general sky, ``f(χ) φ(Z)`` of ISO 15469, not normalised.

    χ is the angle from the sun and Z that from the zenith.

    Parameters
    ----------
    direction
        Unit vectors ``(..., 3)``.
    source_direction
        Unit vector towards the sun ``(3,)``.
    parameters
        Coefficients a, b, c, d and e of the sky type.

    Returns
    -------
    ndarray
        Relative luminance ``(...)``; below the horizon with the gradation φ at the horizon.
    """
    a, b, c, d, e = parameters
    direction = np.asarray(direction, float)
    angle = np.arccos(np.clip(direction @ np.asarray(source_direction, float), -1.0, 1.0))
    gradation = 1.0 + a * np.exp(b / np.maximum(direction[..., 2], 1e-3))
    return gradation * (1.0 + c * (np.exp(d * angle) - np.exp(d * np.pi / 2.0)) + e * np.cos(angle) ** 2)


@dataclass(frozen=True)
class GreyAir:
    """Aerial perspective under a closed cloud layer: exponential atmosphere with uniform airlight (Koschmieder 1924).

    Parameters
    ----------
    extinction_per_m
        Extinction coefficients of haze and of air molecules at the observer, per channel ``(2, 3)`` [1/m].
    scale_height_m
        Scale heights of haze and of air molecules ``(2,)`` [m].
    airlight
        Radiance of an infinitely long horizontal ray ``(3,)`` [cd/m²].
    """

    extinction_per_m: np.ndarray
    scale_height_m: np.ndarray
    airlight: np.ndarray

    def __call__(self, depth_m: np.ndarray | float, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate transmittance and airlight; see `AerialPerspective`."""
        depth, rise = np.asarray(depth_m, float), np.asarray(direction, float)[..., 2]
        optical = np.zeros((*np.broadcast_shapes(depth.shape, rise.shape), 3))
        for extinction, scale in zip(self.extinction_per_m, self.scale_height_m, strict=True):
            # ∫ exp(-s sin e / H) ds in closed form; the limit avoids overflow where transmittance is zero, also after
            # the division by the least slope.
            slope = np.where(np.abs(rise) < 1e-9, 1e-9, rise) / scale
            with np.errstate(invalid="ignore"):
                path = -np.expm1(np.clip(-depth * slope, -600.0, 600.0)) / slope
            optical += path[..., None] * extinction
        transmittance = np.exp(-optical)
        return transmittance, (1.0 - transmittance) * self.airlight


def grey_air(visibility_km: float, airlight: np.ndarray, *, height_m: float = 0.0) -> GreyAir:
    """Build the aerial perspective of a meteorological range V at the observer (``3.912 / V`` at 550 nm).

    Parameters
    ----------
    visibility_km
        Meteorological range V, for a contrast of 2 % [km].
    airlight
        Radiance of an infinitely long horizontal ray ``(3,)`` [cd/m²].
    height_m
        Height of the observer [m].

    Returns
    -------
    GreyAir
        Aerial perspective.
    """
    wavelength = np.array([612.0, 549.0, 465.0])  # centroids of the Rec.709 channels
    rayleigh = 1.16e-5 * (550.0 / wavelength) ** 4.08 * np.exp(-height_m / 8000.0)
    haze = max(3.912 / (1000.0 * visibility_km) - rayleigh[1], 0.0) * (wavelength[1] / wavelength) ** 0.7
    return GreyAir(np.stack([haze, rayleigh]), np.array([1500.0, 8000.0]), np.asarray(airlight, float))


def overcast_sky_radiance(
    illuminance: np.ndarray, height: int, *, ground_albedo: float = 0.2, source_direction: np.ndarray | None = None
) -> np.ndarray:
    """Compute the radiance map of a cloudy sky with a given horizontal illuminance.

    Parameters
    ----------
    illuminance
        Horizontal illuminance ``(3,)`` [lx].
    height
        Rows of the map; it has twice as many columns.
    ground_albedo
        Albedo of the Lambertian ground in the rows below the horizon.
    source_direction
        Unit vector towards the sun ``(3,)`` for the CIE intermediate sky; the CIE standard overcast sky if omitted.

    Returns
    -------
    ndarray
        Radiance ``(height, 2 height, 3)`` [cd/m²].
    """
    direction = equirectangular_directions(height, 2 * height)
    if source_direction is None:
        relative = standard_overcast(np.degrees(np.arcsin(np.clip(direction[..., 2], -1.0, 1.0))))
    else:
        relative = general_sky(direction, source_direction)
    relative = np.where(direction[..., 2] > 0.0, relative, 0.0)
    # Normalise by the integral of the discrete map, so that its illuminance is exact at any resolution.
    relative /= diffuse_horizontal_illuminance(relative[..., None])[0]
    relative[direction[..., 2] <= 0.0] = ground_albedo / np.pi
    return relative[..., None] * np.asarray(illuminance, float)


def overcast(
    sun: SolarPosition,
    moon: LunarPosition | None = None,
    *,
    height_m: float = 0.0,
    map_height: int = 128,
    visibility_km: float = 20.0,
    ground_albedo: float = 0.2,
    intermediate: bool = False,
) -> Illumination:
    """Compute the illumination under a closed cloud layer, which has no directional source, at any solar elevation.

    Parameters
    ----------
    sun, moon
        Positions of sun and moon; without a moon there is no moonlight.
    height_m
        Height of the observer [m].
    map_height
        Rows of the sky map; it has twice as many columns.
    visibility_km
        Meteorological range below the layer at the observer [km].
    ground_albedo
        Albedo of the ground in the rows below the horizon.
    intermediate
        Use the CIE intermediate distribution, brighter towards the sun, in place of the standard overcast one.

    Returns
    -------
    Illumination
        Illumination without frame and time.
    """
    illuminance = overcast_illuminance_lx(sun.elevation_deg) * overcast_rgb(sun.elevation_deg) / sun.distance_au**2
    if moon is not None:
        ratio = moon_to_sun_ratio(moon, [612.0, 549.0, 465.0])
        illuminance = illuminance + ratio * overcast_illuminance_lx(moon.elevation_deg) * daylight_rgb(DAY_CCT_K)
    night = diffuse_horizontal_illuminance(night_sky_radiance(64, 8, height_m=height_m))
    illuminance = illuminance + _LOW_SUN_TRANSMISSION * night
    source = sun.direction if intermediate else None
    sky = overcast_sky_radiance(illuminance, map_height, ground_albedo=ground_albedo, source_direction=source)
    horizon = standard_overcast(0.0) * illuminance
    return Illumination(
        sky_radiance=sky.astype(np.float32),
        aerial_perspective=grey_air(visibility_km, horizon, height_m=height_m),
        model={
            "kind": "overcast",
            "distribution": "intermediate" if intermediate else "standard",
            "visibility_km": visibility_km,
            "ground_albedo": ground_albedo,
        },
    )
