"""The equations of photographs: their radiance is linear in the texture; its transpose, and the weights of residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.albedo.footprints import whole_pixels
from seasonscapes.albedo.forward_model import aerial_perspective_of, sky_radiance_of
from seasonscapes.albedo.photographs import AlbedoPhotograph, NoiseModel
from seasonscapes.rendering.receivers import luminaries

# Sky pixels that fix a gain, and how far they keep from sun and moon, whose glare and disc say nothing.
_FEWEST_SKY, _GLARE_DEG = 100, 8.0


@dataclass
class PhotographEquations:
    """The equations of one photograph; weights change from round to round."""

    photograph: AlbedoPhotograph
    picture: np.ndarray  # (n, 3)
    usable: np.ndarray  # (n, 3) bool
    noise: np.ndarray  # (n, 3) standard deviation of the picture
    transmittance: np.ndarray
    airlight: np.ndarray
    sky_picture: np.ndarray  # (K, 3)
    sky_radiance: np.ndarray
    ambient: np.ndarray  # (R·S, 3)
    inverse_gain: np.ndarray  # (3,)
    suns: list[np.ndarray]
    weight: np.ndarray | None = None  # (n, 3)

    @property
    def projected(self) -> bool:
        """Whether the gain is eliminated: neither given nor fixed by the sky."""
        return self.photograph.gain is None and len(self.sky_picture) < _FEWEST_SKY


def equations_of(photograph: AlbedoPhotograph, noise_model: NoiseModel, size: int) -> PhotographEquations:
    """Pick the photograph's terrain and sky pixels and say how far each is to be trusted."""
    footprints, observation = photograph.footprints, photograph.observation
    picture = observation.image.reshape(-1, 3)
    usable = observation.mask.ravel() & np.isfinite(picture).all(axis=1)
    if noise_model.levels is not None:
        # One clipped channel clips the pixel: demosaicing and JPEG mix the channels.
        usable = usable & (picture.max(axis=1) < noise_model.white) & (picture.max(axis=1) > noise_model.black)
    terrain, sky = footprints.pixel, photograph.seen.sky.pixel
    whole = whole_pixels(footprints) & usable[terrain]
    transmittance, airlight = aerial_perspective_of(photograph.seen, photograph.light, len(terrain))
    chosen = usable[sky]
    for body in luminaries(photograph.light):
        chosen &= photograph.seen.sky.direction @ np.asarray(body.direction) < np.cos(np.radians(_GLARE_DEG))
    sky = sky[chosen]
    radiance = (
        sky_radiance_of(photograph.seen, photograph.light)[chosen]
        if len(photograph.seen.sky.pixel)
        else np.zeros((0, 3), np.float32)
    )
    suns = [np.asarray(body.normal_illuminance_lx, np.float32) for body in luminaries(photograph.light)]
    values = np.nan_to_num(picture[terrain].astype(np.float32))
    rows = PhotographEquations(
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
        suns,
    )
    if photograph.gain is not None:
        rows.inverse_gain = 1.0 / photograph.gain
    elif not rows.projected:
        rows.inverse_gain = _median_ratio(rows.sky_radiance, rows.sky_picture)
    return rows


def picture_noise(linear: np.ndarray, noise_model: NoiseModel) -> np.ndarray:
    """Standard deviation of linear values from rounding and compression of their sRGB encoding."""
    if noise_model.levels is None:
        return np.zeros_like(linear)
    bright = np.maximum(linear, 1e-6)
    slope = np.where(linear <= 0.0031308, 1.0 / 12.92, 2.4 / 1.055 * bright ** (1.0 - 1.0 / 2.4))
    return (noise_model.level_noise / noise_model.levels * slope).astype(np.float32)


# ---------------------------------------------------------------------------------------------- linear parts


def forward_product(row: PhotographEquations, albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radiance ``(n, 3)`` at the camera without airlight, and its directly sunlit part."""
    footprints = row.photograph.footprints
    sun = np.zeros((len(footprints.pixel), 3), np.float32)
    for illuminance, values in zip(row.suns, footprints.sunlit[row.photograph.number], strict=True):
        sun += (footprints.matrix(values) @ albedo) * illuminance
    total = sun + footprints.matrix(footprints.share) @ (row.ambient * albedo)
    scale = row.transmittance / np.float32(np.pi)
    return total * scale, sun * scale


def adjoint(row: PhotographEquations, residual: np.ndarray) -> np.ndarray:
    """Transpose of `forward_product`: ``(n, 3)`` → ``(R·S, 3)``."""
    footprints = row.photograph.footprints
    scaled = residual * row.transmittance / np.float32(np.pi)
    total = (footprints.matrix(footprints.share).T @ scaled) * row.ambient
    for illuminance, values in zip(row.suns, footprints.sunlit[row.photograph.number], strict=True):
        total += footprints.matrix(values).T @ (scaled * illuminance)
    return total


def squared_adjoint(row: PhotographEquations) -> np.ndarray:
    """Diagonal of the normal matrix, ``(R·S, 3)``: the preconditioner and the information of each texel."""
    footprints = row.photograph.footprints
    scaled = row.weight * (row.transmittance / np.float32(np.pi)) ** 2
    share, texel = footprints.share, footprints.texel
    total = np.empty_like(row.ambient)
    for channel in range(3):
        values = share * row.ambient[texel, channel]
        for illuminance, sunlit in zip(row.suns, footprints.sunlit[row.photograph.number], strict=True):
            values = values + sunlit * illuminance[channel]
        total[:, channel] = footprints.matrix(values * values).T @ scaled[:, channel]
    return total


# ---------------------------------------------------------------------------------------------- weights


def reweight(rows: list[PhotographEquations], albedo: np.ndarray, noise_model: NoiseModel, *, robust: bool) -> None:
    """Weights of all equations from the present albedo: variances, times Cauchy's where ``robust``."""
    for row in rows:
        model, sun = forward_product(row, albedo)
        radiance = model + row.airlight
        if row.projected:
            row.inverse_gain = projected_gain(row, radiance)
        lit = row.photograph.footprints.lit[row.photograph.number] if row.suns else np.zeros(len(model))
        mixed = np.nan_to_num(4.0 * lit * (1.0 - lit)).astype(np.float32)[:, None]
        noise = row.noise * row.inverse_gain.astype(np.float32)
        floor = 1e-3 * float(np.median(radiance)) + 1e-9
        variance = (noise_model.model * radiance) ** 2 + (noise_model.edge * sun * mixed) ** 2 + noise**2 + floor**2
        row.weight = np.where(row.usable, 1.0 / variance, 0.0).astype(np.float32)
        if robust:
            h = row.inverse_gain.astype(np.float32)
            row.weight *= _cauchy((h * row.picture - radiance) * np.sqrt(row.weight), row.usable)


def _cauchy(normal: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Cauchy's weights of residuals that should have unit variance; one doubtful channel makes the pixel doubtful."""
    worst = np.abs(normal).max(axis=1, keepdims=True)
    counted = worst[usable[:, 0]]
    # Where the promise was too bold, the spread found counts instead: 2.385 gives 95 % efficiency for normal errors.
    scale = max(1.0, float(np.median(counted)) / 1.4 if len(counted) else 1.0)
    return 1.0 / (1.0 + (worst / (2.385 * scale)) ** 2)


def _median_ratio(top: np.ndarray, bottom: np.ndarray) -> np.ndarray:
    """Median of top over positive bottom, channel by channel ``(3,)``."""
    sound = [bottom[:, c] > 0.0 for c in range(3)]
    return np.array([np.median(top[k, c] / bottom[k, c]) if k.any() else 1.0 for c, k in enumerate(sound)], float)


def projected_gain(row: PhotographEquations, radiance: np.ndarray) -> np.ndarray:
    """Inverse gain ``(3,)`` that fits terrain pixels best to a radiance."""
    keep = row.usable[:, 0]
    if row.weight is None:
        return _median_ratio(radiance[keep], row.picture[keep])
    bottom = (row.weight * row.picture**2).sum(axis=0)
    top = (row.weight * row.picture * radiance).sum(axis=0)
    return np.where(bottom > 0.0, top / np.maximum(bottom, 1e-30), row.inverse_gain).astype(float)
