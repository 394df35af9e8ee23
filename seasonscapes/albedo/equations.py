"""Linear equations of photographs: radiance as a linear function of the texels, its adjoint, and residual weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.albedo.footprints import whole_pixels
from seasonscapes.albedo.forward_model import aerial_perspective_of, sky_radiance_of
from seasonscapes.albedo.ground_pixels import GroundFactors
from seasonscapes.albedo.photographs import AlbedoPhotograph, NoiseModel, TextureObservation
from seasonscapes.cameras.observation import Observation
from seasonscapes.rendering.receivers import luminaries

# Sky pixels needed to fix a gain, and their least distance from sun and moon, whose disc and glare are not modelled.
FEWEST_SKY, _GLARE_DEG = 100, 8.0


@dataclass
class PhotographEquations:
    """Equations of one photograph with n terrain pixels and K sky pixels; the weights change in each round.

    Parameters
    ----------
    photograph
        The photograph itself.
    picture
        ``(n, 3)`` linear values of the terrain pixels.
    usable
        ``(n, 3)`` bool.
    noise
        ``(n, 3)`` standard deviation of ``picture``.
    transmittance, airlight
        ``(n, 3)`` of the air in front of the terrain; airlight in [cd/m²].
    sky_picture, sky_radiance
        ``(K, 3)`` linear values of sky pixels, and their modelled radiance [cd/m²].
    ambient
        ``(R·S, 3)`` illuminance of the texels from sky and interreflection [lx].
    inverse_gain
        ``(3,)`` radiance over pixel value.
    luminary_lx
        Normal illuminance ``(3,)`` [lx] of each luminary.
    weight
        ``(n, 3)`` inverse variances [1 / (cd/m²)²]; ``None`` before the first `reweight`.
    ground
        How its pixels reflect relative to Lambertian ground; ``None`` where they are.
    """

    photograph: AlbedoPhotograph
    picture: np.ndarray
    usable: np.ndarray
    noise: np.ndarray
    transmittance: np.ndarray
    airlight: np.ndarray
    sky_picture: np.ndarray
    sky_radiance: np.ndarray
    ambient: np.ndarray
    inverse_gain: np.ndarray
    luminary_lx: list[np.ndarray]
    weight: np.ndarray | None = None
    ground: GroundFactors | None = None

    @property
    def projected(self) -> bool:
        """Whether the gain is eliminated: neither given nor fixed by the sky."""
        return self.photograph.gain is None and len(self.sky_picture) < FEWEST_SKY


def equations_of(photograph: AlbedoPhotograph, noise_model: NoiseModel, size: int) -> PhotographEquations:
    """Select the terrain and sky pixels of a photograph and estimate their noise.

    Parameters
    ----------
    photograph
        Photograph with its light and footprints.
    noise_model
        Standard deviations and clipping limits.
    size
        Number of texels, R·S.

    Returns
    -------
    PhotographEquations
        Equations with zero ambient illuminance and without weights.
    """
    footprints, observation, noise_model = photograph.footprints, photograph.observation, photograph.noise(noise_model)
    picture = observation.image.reshape(-1, 3)
    usable = usable_pixels(observation, noise_model).ravel()
    terrain = footprints.pixel
    whole = whole_pixels(footprints) & usable[terrain]
    transmittance, airlight = aerial_perspective_of(photograph.atmosphere, photograph.light, len(terrain))
    chosen = usable_sky(photograph, usable)
    sky = photograph.atmosphere.sky.pixel[chosen]
    radiance = (
        sky_radiance_of(photograph.atmosphere, photograph.light)[chosen]
        if len(photograph.atmosphere.sky.pixel)
        else np.zeros((0, 3), np.float32)
    )
    luminary_lx = [np.asarray(body.normal_illuminance_lx, np.float32) for body in luminaries(photograph.light)]
    values = np.nan_to_num(picture[terrain].astype(np.float32))
    equations = PhotographEquations(
        photograph,
        values,
        np.repeat(whole[:, None], 3, axis=1),
        picture_noise(values, noise_model),
        transmittance,
        airlight,
        picture[sky].astype(np.float32),
        radiance.astype(np.float32),
        np.zeros((size, 3), np.float32),
        np.ones(3),
        luminary_lx,
    )
    if photograph.gain is not None:
        equations.inverse_gain = 1.0 / photograph.gain
    elif not equations.projected:
        equations.inverse_gain = _median_ratio(equations.sky_radiance, equations.sky_picture)
    return equations


def usable_pixels(observation: Observation | TextureObservation, noise_model: NoiseModel) -> np.ndarray:
    """Pixels ``(H, W)`` bool that are finite, not masked, and in encoded pictures neither clipped nor black."""
    usable = observation.mask & np.isfinite(observation.image).all(axis=2)
    if noise_model.levels is not None:
        # One clipped channel clips the pixel: demosaicing and JPEG mix the channels.
        brightest = observation.image.max(axis=2)
        usable = usable & (brightest < noise_model.white) & (brightest > noise_model.black)
    return usable


def usable_sky(photograph: AlbedoPhotograph, usable: np.ndarray) -> np.ndarray:
    """Which of the camera's sampled open pixels tell the exposure: usable ones away from sun and moon, bool."""
    sky = photograph.atmosphere.sky
    chosen = usable.ravel()[sky.pixel]
    for body in luminaries(photograph.light):
        chosen &= sky.direction @ np.asarray(body.direction) < np.cos(np.radians(_GLARE_DEG))
    return chosen


def picture_noise(linear: np.ndarray, noise_model: NoiseModel) -> np.ndarray:
    """Standard deviation of linear values caused by rounding and compression of their sRGB encoding.

    Parameters
    ----------
    linear
        ``(...)`` linear values, 1 clips.
    noise_model
        Number of levels and their noise.

    Returns
    -------
    numpy.ndarray
        ``(...)`` float32, in linear units; zero for pictures that were not encoded.
    """
    if noise_model.levels is None:
        return np.zeros_like(linear)
    bright = np.maximum(linear, 1e-6)
    slope = np.where(linear <= 0.0031308, 1.0 / 12.92, 2.4 / 1.055 * bright ** (1.0 - 1.0 / 2.4))
    return (noise_model.level_noise / noise_model.levels * slope).astype(np.float32)


# ---------------------------------------------------------------------------------------------- linear parts


def forward_product(equations: PhotographEquations, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Apply the linear forward model to an albedo.

    Parameters
    ----------
    equations
        Equations of one photograph.
    albedo
        ``(R·S, 3)``.

    Returns
    -------
    tuple of numpy.ndarray
        Radiance ``(n, 3)`` at the camera without airlight, and its directly sunlit part [cd/m²].
    """
    footprints = equations.photograph.footprints
    sun = np.zeros((len(footprints.pixel), 3), np.float32)
    direct, diffuse = light_factors(equations)
    for factor, values in zip(direct, footprints.sunlit[equations.photograph.number], strict=True):
        sun += (footprints.matrix(values) @ albedo) * factor
    total = sun + footprints.matrix(footprints.share) @ (equations.ambient * albedo) * diffuse
    scale = equations.transmittance / np.float32(np.pi)
    return total * scale, sun * scale


def adjoint(equations: PhotographEquations, residual: np.ndarray) -> np.ndarray:
    """Apply the transpose of `forward_product`.

    Parameters
    ----------
    equations
        Equations of one photograph.
    residual
        ``(n, 3)``.

    Returns
    -------
    numpy.ndarray
        ``(R·S, 3)``.
    """
    footprints = equations.photograph.footprints
    scaled = residual * equations.transmittance / np.float32(np.pi)
    direct, diffuse = light_factors(equations)
    total = (footprints.matrix(footprints.share).T @ (scaled * diffuse)) * equations.ambient
    for factor, values in zip(direct, footprints.sunlit[equations.photograph.number], strict=True):
        total += footprints.matrix(values).T @ (scaled * factor)
    return total


def light_factors(equations: PhotographEquations) -> tuple[list[np.ndarray], np.ndarray]:
    """What the pixels reflect of each luminary [lx] and of diffuse light, relative to Lambertian ground."""
    if equations.ground is None:
        return equations.luminary_lx, np.ones(3, np.float32)
    direct = zip(equations.luminary_lx, equations.ground.luminaries, strict=True)
    return [illuminance * factor for illuminance, factor in direct], equations.ground.diffuse


def squared_adjoint(equations: PhotographEquations) -> np.ndarray:
    """Diagonal of the normal matrix: preconditioner, and information of each texel.

    Parameters
    ----------
    equations
        Equations of one photograph, with weights.

    Returns
    -------
    numpy.ndarray
        ``(R·S, 3)`` [1 / albedo²].
    """
    assert equations.weight is not None, "call reweight first"
    footprints = equations.photograph.footprints
    scaled = equations.weight * (equations.transmittance / np.float32(np.pi)) ** 2
    share, texel = footprints.share, footprints.texel
    total = np.empty_like(equations.ambient)
    direct, diffuse = light_factors(equations)
    entries = np.diff(footprints.start)

    def of_entries(factor: np.ndarray, channel: int) -> np.ndarray:
        """A channel of factors ``(3,)`` of all pixels, or ``(n, 3)`` of each, for the entries."""
        return factor[channel] if factor.ndim == 1 else np.repeat(factor[:, channel], entries)

    for channel in range(3):
        values = share * equations.ambient[texel, channel] * of_entries(diffuse, channel)
        for factor, sunlit in zip(direct, footprints.sunlit[equations.photograph.number], strict=True):
            values = values + sunlit * of_entries(factor, channel)
        total[:, channel] = footprints.matrix(values * values).T @ scaled[:, channel]
    return total


# ---------------------------------------------------------------------------------------------- weights


def reweight(systems: list[PhotographEquations], albedo: np.ndarray, noise_model: NoiseModel, *, robust: bool) -> None:
    """Update the weights and projected gains of all photographs in place.

    Parameters
    ----------
    systems
        Equations of each photograph.
    albedo
        ``(R·S, 3)`` current estimate.
    noise_model
        Standard deviations of model and picture.
    robust
        Multiply the inverse variances by Cauchy weights of the current residuals.
    """
    for equations in systems:
        model, sun = forward_product(equations, albedo)
        radiance = model + equations.airlight
        if equations.projected:
            equations.inverse_gain = projected_gain(equations, radiance)
        photograph, own = equations.photograph, equations.photograph.noise(noise_model)
        lit = photograph.footprints.lit[photograph.number] if equations.luminary_lx else np.zeros(len(model))
        # Highest where a shadow's edge divides the pixel.
        penumbra = np.nan_to_num(4.0 * lit * (1.0 - lit)).astype(np.float32)[:, None]
        noise = equations.noise * equations.inverse_gain.astype(np.float32)
        floor = radiance_floor(radiance)
        variance = (own.model * radiance) ** 2 + (own.edge * sun * penumbra) ** 2 + noise**2 + floor**2
        equations.weight = np.where(equations.usable, 1.0 / variance, 0.0).astype(np.float32)
        if photograph.confidence is not None:
            equations.weight *= photograph.confidence[:, None]
        if robust:
            h = equations.inverse_gain.astype(np.float32)
            residual = (h * equations.picture - radiance) * np.sqrt(equations.weight)
            equations.weight *= _cauchy(residual, equations.usable)


def radiance_floor(radiance: np.ndarray) -> float:
    """Return the radiance below which relative residuals are not meaningful: a thousandth of the median, above zero."""
    return 1e-3 * float(np.median(radiance)) + 1e-9


def _cauchy(residual: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Cauchy weights ``(n, 1)`` of normalised residuals ``(n, 3)``, by the largest residual of each pixel."""
    worst = np.abs(residual).max(axis=1, keepdims=True)
    counted = worst[usable[:, 0]]
    # The empirical spread replaces variances that were underestimated. 2.385 gives 95 % efficiency for normal errors.
    scale = max(1.0, float(np.median(counted)) / 1.4 if len(counted) else 1.0)
    return 1.0 / (1.0 + (worst / (2.385 * scale)) ** 2)


def _median_ratio(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Median ratio over positive denominators, channel by channel ``(3,)``."""
    positive = [denominator[:, c] > 0.0 for c in range(3)]
    return np.array(
        [np.median(numerator[k, c] / denominator[k, c]) if k.any() else 1.0 for c, k in enumerate(positive)], float
    )


def projected_gain(equations: PhotographEquations, radiance: np.ndarray) -> np.ndarray:
    """Inverse gain that fits the terrain pixels to a radiance in the least-squares sense.

    Parameters
    ----------
    equations
        Equations of one photograph; without weights, the median ratio is returned.
    radiance
        ``(n, 3)`` modelled radiance of the terrain pixels at the camera [cd/m²].

    Returns
    -------
    numpy.ndarray
        ``(3,)`` radiance over pixel value.
    """
    keep = equations.usable[:, 0]
    if equations.weight is None:
        return _median_ratio(radiance[keep], equations.picture[keep])
    denominator = (equations.weight * equations.picture**2).sum(axis=0)
    numerator = (equations.weight * equations.picture * radiance).sum(axis=0)
    return np.where(denominator > 0.0, numerator / np.maximum(denominator, 1e-30), equations.inverse_gain).astype(float)
