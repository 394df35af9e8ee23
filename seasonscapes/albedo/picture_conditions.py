"""Conditions under which one picture of a fixed camera was taken: weather, haze, exposure, white balance, response.

    E        = sun · E_sun · visible · max(0, m · direction + b) + (1 - overcast) · E_sky + overcast · E_clouds
    radiance = gain · T · reflectance · E + airlight · (1 - T) + flare,       T = exp(-extinction · distance)
    picture  = sRGB(radiance ^ contrast), clipped

E_sun, E_sky (with light between slopes) and the sun's visibility are those of the clear sky, E_clouds that of a closed
cloud layer, all computed from the terrain and relative to their means over the view: exposure takes the rest. Airlight,
flare (light scattered in the lens) and gain have three channels. ``m`` and ``b`` belong to the pixel (`Ground`): the mean
normal of what it shows, which is rougher than the raster, and the light that rough ground returns whatever the sun's
direction. The conditions of a picture are found from its own pixels where the ground is known from other pictures, by
robust least squares in encoded values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from seasonscapes.images import srgb_from_linear

# Order of the fitted vector: sun, overcast, log extinction [1/km], log gain, log airlight, log flare, log contrast.
SUN, OVERCAST, EXTINCTION, CONTRAST = 0, 1, 2, 12
GAIN, AIRLIGHT, FLARE = slice(3, 6), slice(6, 9), slice(9, 12)
COUNT = 13
START = np.array([0.6, 0.5, -3.3, *[0.0] * 3, *[-1.5] * 3, *[-4.5] * 3, 0.0])
_LOWEST = np.array([0.0, 0.0, -6.0, *[-5.0] * 3, *[-6.0] * 3, *[-8.0] * 3, np.log(0.6)])
_HIGHEST = np.array([1.6, 1.0, 0.0, *[5.0] * 3, *[1.0] * 3, *[-0.8] * 3, np.log(3.0)])
# Weak priors (mean, σ) on all but the gain: a picture that tells nothing of a condition leaves it at its mean.
_PRIOR_MEAN = np.array([0.6, 0.5, -3.2, *[0.0] * 3, *[-1.5] * 3, *[-4.5] * 3, 0.3])
_PRIOR_SIGMA = np.array([0.17, 0.17, 0.27, *[np.inf] * 3, *[0.33] * 3, *[0.33] * 3, 0.1])
# Encoded values this far from the model count half (Cauchy): clouds before the terrain, new snow, moving shadows.
RESIDUAL_SCALE = 0.05
_SMALLEST = 1e-6
_FIT_EVALUATIONS = 15


@dataclass(frozen=True)
class ViewLight:
    """Light on the n terrain pixels of a fixed camera at one instant, relative to the mean light of a clear sky.

    Parameters
    ----------
    sun
        ``(3,)`` direct light of a clear sky on a surface that faces the sun; zero below the horizon.
    sun_visible
        ``(n,)`` share of the pixel's ground that sees the sun, 0 to 1.
    sun_direction
        ``(3,)`` unit vector towards the sun, east-north-up.
    sky
        ``(n, 3)`` light of the clear sky and from other slopes.
    clouds
        ``(n, 3)`` light under a closed cloud layer, of mean 1 over the view.
    day
        Day of the year, for the season.
    """

    sun: np.ndarray
    sun_visible: np.ndarray
    sun_direction: np.ndarray
    sky: np.ndarray
    clouds: np.ndarray
    day: int

    def at(self, pixel: np.ndarray) -> ViewLight:
        """The light on some of the pixels."""
        return replace(self, sun_visible=self.sun_visible[pixel], sky=self.sky[pixel], clouds=self.clouds[pixel])


@dataclass(frozen=True)
class Ground:
    """What the n terrain pixels of a fixed camera show.

    Parameters
    ----------
    reflectance
        ``(n, 3)``, up to a factor that the gains share.
    shading
        ``(n, 4)``: the mean normal m (east-north-up), and b; see the module.
    distance_km
        ``(n,)`` [km].
    """

    reflectance: np.ndarray
    shading: np.ndarray
    distance_km: np.ndarray

    def at(self, pixel: np.ndarray) -> Ground:
        """The ground of some of the pixels."""
        return Ground(self.reflectance[pixel], self.shading[pixel], self.distance_km[pixel])


@dataclass(frozen=True)
class Conditions:
    """Weather and camera of one picture; see the module.

    Parameters
    ----------
    values
        ``(13,)``: sun, overcast, log extinction [1/km], then logs of gain, airlight, flare (three each), log contrast.
    sigma
        ``(13,)`` standard deviations; infinite where the picture tells nothing.
    """

    values: np.ndarray
    sigma: np.ndarray

    @property
    def sun(self) -> float:
        """Direct light as a share of that of the clear sky; above 1 where clear air is clearer than assumed."""
        return float(self.values[SUN])

    @property
    def sun_sigma(self) -> float:
        """Standard deviation of ``sun``."""
        return float(self.sigma[SUN])

    @property
    def overcast(self) -> float:
        """Share of the skylight that comes from clouds, 0 to 1."""
        return float(self.values[OVERCAST])

    @property
    def visibility_km(self) -> float:
        """Meteorological range [km] of the extinction (Koschmieder: contrast of 2 %)."""
        return float(-np.log(0.02) / np.exp(self.values[EXTINCTION]))


def incidence(light: ViewLight, shading: np.ndarray) -> np.ndarray:
    """Cosine of incidence of the pixels' ground with its own roughness ``(n,)``, without visibility; may be negative."""
    return shading[:, :3] @ light.sun_direction + shading[:, 3]


def linear_parts(light: ViewLight, ground: Ground, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factor of the reflectance, its part for each unit of incidence, and addend, ``(n, 3)`` each, before contrast."""
    transmitted = np.exp(-np.exp(values[EXTINCTION]) * ground.distance_km)[:, None]
    exposure, overcast = np.exp(values[GAIN]) * transmitted, values[OVERCAST]
    for_unit = exposure * (values[SUN] * light.sun) * light.sun_visible[:, None]
    diffuse = exposure * ((1.0 - overcast) * light.sky + overcast * light.clouds)
    factor = diffuse + for_unit * np.maximum(incidence(light, ground.shading), 0.0)[:, None]
    return factor, for_unit, np.exp(values[AIRLIGHT]) * (1.0 - transmitted) + np.exp(values[FLARE])


def encoded(linear: np.ndarray, contrast: float) -> np.ndarray:
    """Values of the picture in [0, 1] for linear ones."""
    return srgb_from_linear(np.clip(np.maximum(linear, _SMALLEST) ** contrast, 0.0, 1.0))


def picture_under(ground: Ground, light: ViewLight, values: np.ndarray) -> np.ndarray:
    """Values ``(n, 3)`` of the pixels in a picture, sRGB-encoded.

    Parameters
    ----------
    ground
        What the pixels show.
    light
        Light of the instant.
    values
        ``(13,)`` of `Conditions`.
    """
    factor, _, addend = linear_parts(light, ground, values)
    return encoded(ground.reflectance * factor + addend, float(np.exp(values[CONTRAST])))


def fit_conditions(
    picture: np.ndarray,
    ground: Ground,
    light: ViewLight,
    *,
    start: np.ndarray = START,
    free: np.ndarray | None = None,
    block: int = 1,
) -> Conditions:
    """Find the conditions of a picture from pixels of known ground.

    Parameters
    ----------
    picture
        ``(n, 3)`` sRGB-encoded values of the usable pixels.
    ground, light
        Of the same pixels.
    start
        ``(13,)`` where the search begins.
    free
        ``(13,)`` bool, which values are searched; all by default.
    block
        Number of neighbouring pixels that err together, for the standard deviations.

    Returns
    -------
    Conditions
        The most probable values, with standard deviations from the curvature there.
    """
    free = np.ones(COUNT, bool) if free is None else free
    low, high = _LOWEST[free], _HIGHEST[free]

    def residuals(searched: np.ndarray) -> np.ndarray:
        values = start.copy()
        values[free] = searched
        misfit = (picture_under(ground, light, values) - picture) / RESIDUAL_SCALE
        prior = (values - _PRIOR_MEAN) / _PRIOR_SIGMA
        return np.concatenate([misfit.ravel(), prior[free]])

    # The exact solver factorises all residuals by singular values: five times the time, to the same cost.
    found = least_squares(
        residuals,
        np.clip(start[free], low + 1e-3, high - 1e-3),
        bounds=(low, high),
        loss="soft_l1",
        tr_solver="lsmr",
        max_nfev=_FIT_EVALUATIONS,
    )
    values, sigma = start.copy(), np.zeros(COUNT)
    values[free] = found.x
    variance = max(float(2.0 * found.cost / max(picture.size - found.x.size, 1)), 1e-6) * block
    sigma[free] = np.sqrt(variance * np.diag(np.linalg.pinv(found.jac.T @ found.jac)))
    return Conditions(values, sigma)
