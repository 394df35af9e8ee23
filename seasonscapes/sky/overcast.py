"""The overcast sky in absolute units: CIE distributions, illuminance by sun elevation, and the grey air below."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.frames import equirectangular_directions
from seasonscapes.sky.ephemeris import LunarPosition, SolarPosition
from seasonscapes.sky.illumination import Illumination, diffuse_horizontal_illuminance, luminance
from seasonscapes.sky.night import moon_to_sun_ratio, night_sky_radiance

# Clear horizontal illuminance [lx] by sun elevation [deg]: the fits of Seidelmann (ed.), Explanatory Supplement to the
# Astronomical Almanac (1992), § 9.3, less the night sky of 6.2e-4 lx that measurements below -12° contain.
_ELEVATION_DEG = (
    -20, -18, -16, -14, -12, -10, -8, -6, -5, -4, -3, -2, -1,
    0, 1, 2, 3, 5, 7, 10, 15, 20, 30, 45, 60, 90,
)  # fmt: skip
_CLEAR_LX = (
    1e-7, 2.5e-5, 8.2e-4, 2.30e-3, 7.44e-3, 4.15e-2, 0.3474, 3.411, 10.44, 29.93, 79.07, 189.4, 404.6, 758.6, 1268.0,
    1920.8, 2689.0, 4538.3, 6839.2, 11121.0, 19228.0, 27376.0, 46297.0, 77848.0, 103118.0, 128825.0,
)  # fmt: skip
# What a closed layer lets through while the sun is low or down: meets the 300 lx of Krochmann & Seidl at 0°.
_LOW_SUN_TRANSMISSION = 0.4

# Colour of the layer: near D65 by day, bluer in twilight, as the ozone's blue lights it from above (Lee &
# Hernández-Andrés 2005, Applied Optics 44, 5712 and 5723).
DAY_CCT_K, TWILIGHT_CCT_K = 6500.0, 9500.0

# CIE S 011 / ISO 15469 parameters (a, b, c, d, e). Type 8: partly cloudy, no gradation, distinct solar corona.
INTERMEDIATE = (0.0, -1.0, 10.0, -3.0, 0.45)


def clear_illuminance_lx(sun_elevation_deg) -> np.ndarray:
    """Horizontal illuminance of a mean clear sky with its sun, without the night sky [lx]."""
    return 10.0 ** np.interp(sun_elevation_deg, _ELEVATION_DEG, np.log10(_CLEAR_LX))


def overcast_illuminance_lx(sun_elevation_deg) -> np.ndarray:
    """Horizontal illuminance under a closed layer of cloud [lx].

    ``300 + 21000 sin γ`` (Krochmann & Seidl 1974, Lighting Res. Technol. 6, 165; DIN 5034-2) from 10° up; below 2°
    and through twilight 0.4 of the clear sky's, which meets the same 300 lx at 0°; a geometric blend between.
    """
    elevation = np.asarray(sun_elevation_deg, float)
    low = _LOW_SUN_TRANSMISSION * clear_illuminance_lx(elevation)
    high = 300.0 + 21000.0 * np.sin(np.radians(np.maximum(elevation, 0.0)))
    share = np.clip((elevation - 2.0) / 8.0, 0.0, 1.0)
    share = share**2 * (3.0 - 2.0 * share)
    return low ** (1.0 - share) * high**share


def cloud_transmission(elevation_deg) -> np.ndarray:
    """Share of the clear sky's horizontal illuminance that a closed layer lets through, by elevation of the source."""
    return overcast_illuminance_lx(elevation_deg) / clear_illuminance_lx(elevation_deg)


def daylight_rgb(cct_k) -> np.ndarray:
    """Linear Rec.709 ``(3,)`` at luminance 1 of CIE daylight of a correlated colour temperature, 4000 to 25000 K.

    CIE 15:2018, eq. 4.7 to 4.9.
    """
    t = float(np.clip(cct_k, 4000.0, 25000.0))
    if t <= 7000.0:
        x = -4.6070e9 / t**3 + 2.9678e6 / t**2 + 0.09911e3 / t + 0.244063
    else:
        x = -2.0064e9 / t**3 + 1.9018e6 / t**2 + 0.24748e3 / t + 0.237040
    y = -3.0 * x**2 + 2.870 * x - 0.275
    rgb = _REC709_FROM_XYZ @ np.array([x / y, 1.0, (1.0 - x - y) / y])
    return rgb / luminance(rgb)


_REC709_FROM_XYZ = np.array(
    [[3.2409699, -1.5373832, -0.4986108], [-0.9692436, 1.8759675, 0.0415551], [0.0556301, -0.2039770, 1.0569715]]
)


def overcast_rgb(sun_elevation_deg: float) -> np.ndarray:
    """Colour of the layer from below, linear Rec.709 at luminance 1 ``(3,)``; even in mired from 2° down to -6°."""
    share = np.clip((2.0 - sun_elevation_deg) / 8.0, 0.0, 1.0)
    return daylight_rgb(1.0 / ((1.0 - share) / DAY_CCT_K + share / TWILIGHT_CCT_K))


def standard_overcast(elevation_deg) -> np.ndarray:
    """Luminance per horizontal illuminance [1/sr] of the CIE standard overcast sky: ``Lz (1 + 2 sin e) / 3``.

    Moon & Spencer (1942); ISO 15469 type 16. Its horizontal illuminance is ``7π/9 Lz``.
    """
    return (9.0 / (7.0 * np.pi)) * (1.0 + 2.0 * np.sin(np.radians(np.maximum(elevation_deg, 0.0)))) / 3.0


def general_sky(direction, source_direction, parameters=INTERMEDIATE) -> np.ndarray:
    """Relative luminance ``(...)`` of a CIE general sky along directions ``(..., 3)``, not normalised.

    ``f(χ) φ(Z)`` of ISO 15469, χ the angle from the sun and Z from the zenith; held at the horizon below it.
    """
    a, b, c, d, e = parameters
    direction = np.asarray(direction, float)
    angle = np.arccos(np.clip(direction @ np.asarray(source_direction, float), -1.0, 1.0))
    gradation = 1.0 + a * np.exp(b / np.maximum(direction[..., 2], 1e-3))
    return gradation * (1.0 + c * (np.exp(d * angle) - np.exp(d * np.pi / 2.0)) + e * np.cos(angle) ** 2)


@dataclass(frozen=True)
class GreyAir:
    """Air under a closed layer: extinction that falls with height, airlight of the overcast horizon (Koschmieder 1924).

    Parameters
    ----------
    extinction_per_m
        At the observer, by channel, of haze and of air molecules, ``(2, 3)`` [1/m].
    scale_height_m
        Of haze and of air molecules, ``(2,)`` [m].
    airlight
        What an endless horizontal ray meets, ``(3,)`` [cd/m²].
    """

    extinction_per_m: np.ndarray
    scale_height_m: np.ndarray
    airlight: np.ndarray

    def __call__(self, depth_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `AerialPerspective`."""
        depth, rise = np.asarray(depth_m, float), np.asarray(direction, float)[..., 2]
        optical = np.zeros((*np.broadcast_shapes(depth.shape, rise.shape), 3))
        for extinction, scale in zip(self.extinction_per_m, self.scale_height_m, strict=True):
            # ∫ exp(-s sin e / H) ds in closed form; 700 keeps exp finite, and there the ray has long gone black.
            slope = np.where(np.abs(rise) < 1e-9, 1e-9, rise) / scale
            with np.errstate(invalid="ignore"):
                path = -np.expm1(np.clip(-depth * slope, -700.0, 700.0)) / slope
            optical += path[..., None] * extinction
        transmittance = np.exp(-optical)
        return transmittance, (1.0 - transmittance) * self.airlight


def grey_air(visibility_km: float, airlight: np.ndarray, *, height_m: float = 0.0) -> GreyAir:
    """`GreyAir` of a meteorological visibility at the observer: 2 % contrast, ``3.912 / V`` at 550 nm."""
    wavelength = np.array([612.0, 549.0, 465.0])  # centroids of the Rec.709 channels
    rayleigh = 1.16e-5 * (550.0 / wavelength) ** 4.08 * np.exp(-height_m / 8000.0)
    haze = max(3.912 / (1000.0 * visibility_km) - rayleigh[1], 0.0) * (wavelength[1] / wavelength) ** 0.7
    return GreyAir(np.stack([haze, rayleigh]), np.array([1500.0, 8000.0]), np.asarray(airlight, float))


def overcast_sky_radiance(
    illuminance: np.ndarray, height: int, *, ground_albedo: float = 0.2, source_direction: np.ndarray | None = None
) -> np.ndarray:
    """Map ``(height, 2 height, 3)`` [cd/m²] of a closed sky that puts ``illuminance`` ``(3,)`` [lx] on the ground.

    The CIE standard overcast sky; where ``source_direction`` is given, the CIE intermediate one about it.
    """
    direction = equirectangular_directions(height, 2 * height)
    if source_direction is None:
        shape = standard_overcast(np.degrees(np.arcsin(np.clip(direction[..., 2], -1.0, 1.0))))
    else:
        shape = general_sky(direction, source_direction)
    shape = np.where(direction[..., 2] > 0.0, shape, 0.0)
    # Over the map's own rows, so that its illuminance is exact at any resolution.
    shape /= diffuse_horizontal_illuminance(shape[..., None])[0]
    shape[direction[..., 2] <= 0.0] = ground_albedo / np.pi
    return shape[..., None] * np.asarray(illuminance, float)


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
    """Illumination under a closed layer of cloud at any hour: no discs, no shadows, an absolute grey dome.

    Parameters
    ----------
    sun, moon
        Where they stand above the layer.
    height_m
        Of the observer [m].
    map_height
        Rows of the sky map; it has twice as many columns.
    visibility_km
        Below the layer, at the observer [km].
    ground_albedo
        Of the rows below the horizon.
    intermediate
        The CIE intermediate distribution, brighter towards the sun, in place of the standard overcast one.
    """
    illuminance = overcast_illuminance_lx(sun.elevation_deg) * overcast_rgb(sun.elevation_deg) / sun.distance_au**2
    if moon is not None:
        ratio = moon_to_sun_ratio(moon, [612.0, 549.0, 465.0])
        illuminance = illuminance + ratio * overcast_illuminance_lx(moon.elevation_deg) * daylight_rgb(DAY_CCT_K)
    floor = diffuse_horizontal_illuminance(night_sky_radiance(64, 8, height_m=height_m))
    illuminance = illuminance + _LOW_SUN_TRANSMISSION * floor
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
