"""Pictures as functions of albedo, light, air, camera and pose, with their derivatives.

    picture = C(sRGB(g (T/π · Σ texels share · albedo · (v cos E_sun + ς E_sky + E_bounce) + airlight)))

with C the response curve (`recovery_unknowns.bent`), g the gain, v the sun's visible share, ς the scale of skylight, and
T, airlight, E_sun and E_sky functions of the visibility, interpolated between lights that the sky model computed.
Daylight coefficients give E_sky and E_bounce of any light and albedo without a new ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from seasonscapes.albedo.footprints import whole_pixels
from seasonscapes.albedo.forward_model import TexelTransport, ambient_on_texels
from seasonscapes.albedo.photographs import NoiseModel
from seasonscapes.albedo.recovery_pictures import HazeLights, RecoveryPicture, encode, geometric, resampled
from seasonscapes.albedo.recovery_unknowns import CURVE, GAIN, HAZE, SKY, SUN, TURN, UnknownLayout, bent, straightened
from seasonscapes.images import linear_from_srgb
from seasonscapes.sky.illumination import Illumination

# Dense unknowns of a channel of a photograph: gain, s, log γ, three turns, haze, sky.
COLUMNS = 8
_HAZE_STEP, _CURVE_STEP = 0.02, 1e-3
# Radiance below this share of the median has no meaningful relative error.
_FLOOR = 1e-3


@dataclass(frozen=True)
class RecoveryFrame:
    """What the pictures of a recovery share.

    Parameters
    ----------
    layout
        Of the unknowns.
    haze
        Lights at the nodes of visibility.
    noise_model
        Standard deviations of model and pictures.
    turning
        ``(C,)`` bool, cameras whose pose is not exact.
    """

    layout: UnknownLayout
    haze: HazeLights
    noise_model: NoiseModel
    turning: np.ndarray

    def columns(self, picture: RecoveryPicture) -> np.ndarray:
        """Numbers of the dense unknowns of each channel ``(3, 8)``, in the order of `COLUMNS`."""
        at = self.layout.offset
        curve, turn = at(CURVE) + 2 * picture.camera, at(TURN) + 3 * picture.camera
        return np.array(
            [
                [
                    at(GAIN) + 3 * picture.number + c,
                    curve,
                    curve + 1,
                    turn,
                    turn + 1,
                    turn + 2,
                    at(HAZE),
                    at(SKY) + 3 * picture.instant + c,
                ]
                for c in range(3)
            ]
        )


@dataclass(frozen=True)
class LitLand:
    """Light on the texels at one instant: at each visibility that of the sky, and for the current state of the bounce.

    Parameters
    ----------
    sky
        ``(V, R·S, 3)`` illuminance by the sky, in full [lx].
    bounce
        ``(R·S, 3)`` interreflection [lx].
    """

    sky: np.ndarray
    bounce: np.ndarray


def sky_on_land(transport: TexelTransport, lights: Sequence[Illumination]) -> np.ndarray:
    """Illuminance of the texels by the sky at each visibility ``(V, R·S, 3)`` [lx]."""
    return np.stack([ambient_on_texels(transport, light, None) for light in lights])


def bounce_on_land(
    transport: TexelTransport, light: Illumination, albedo: np.ndarray, sun_share: float, log_sky: np.ndarray
) -> np.ndarray:
    """Interreflection ``(R·S, 3)`` [lx] under a light whose sun and sky are dimmed; albedo ``(R, S, 3)``."""
    scale = np.exp(log_sky).astype(np.float32)
    dimmed = replace(light, sky_radiance=(light.sky_radiance * scale).astype(np.float32))
    if light.sun is not None:
        shining = np.asarray(light.sun.normal_illuminance_lx) * sun_share
        dimmed = replace(dimmed, sun=replace(light.sun, normal_illuminance_lx=shining))
    with_albedo = ambient_on_texels(transport, dimmed, albedo)
    return np.maximum(with_albedo - ambient_on_texels(transport, dimmed, None), 0.0)


@dataclass(frozen=True)
class PredictedPicture:
    """A picture under a state of all unknowns, with its derivatives.

    Parameters
    ----------
    value, residual
        ``(n, 3)`` encoded values that the state predicts, and those of the photograph less these.
    weight
        ``(n, 3)`` inverse variances without robust weights, 0 for pixels that are unusable.
    sun_factor, diffuse_factor, ambient
        Factors ``(n, 3)`` of each body and of diffuse light, and diffuse illuminance ``(R·S, 3)`` [lx], of which
        `albedo_derivative` is made.
    dense
        ``(3, n, 8)`` derivatives to gain, s, log γ, three turns, haze, sky.
    by_sun
        ``(n, 3)`` derivative to the sun's visible share.
    sky_residual, sky_dense
        ``(3,)`` log of the sky's radiance in the photograph over the predicted, and ``(3, 8)`` derivatives; ``None``
        without sky.
    """

    value: np.ndarray
    residual: np.ndarray
    weight: np.ndarray
    sun_factor: list[np.ndarray]
    diffuse_factor: np.ndarray
    ambient: np.ndarray
    dense: np.ndarray
    by_sun: np.ndarray
    sky_residual: np.ndarray | None
    sky_dense: np.ndarray | None


def predict(
    picture: RecoveryPicture, land: LitLand, albedo: np.ndarray, state: np.ndarray, frame: RecoveryFrame
) -> PredictedPicture:
    """Predict a picture and its derivatives.

    Parameters
    ----------
    picture
        The photograph.
    land
        Light of its instant.
    albedo
        ``(R·S, 3)``.
    state
        ``(P,)`` all other unknowns.
    frame
        Their layout, the nodes of visibility and the noise.
    """
    layout, noise_model = frame.layout, picture.photograph.noise(frame.noise_model)
    footprints, number = picture.photograph.footprints, picture.photograph.number
    of = {name: layout.view(state, name) for name in layout.shapes}
    gain = np.exp(of[GAIN][picture.number]).astype(np.float32) * np.float32(picture.scale)
    curve, log_sky = of[CURVE][picture.camera], of[SKY][picture.instant]
    shining = np.ones(len(footprints.pixel), np.float32)
    if picture.sun_weights is not None:
        shining = (picture.sun_weights @ of[SUN][picture.instant]).astype(np.float32)
    turn = of[TURN][picture.camera] if frame.turning[picture.camera] else None
    observed, usable, by_turn = resampled(picture, turn)
    usable = usable & whole_pixels(footprints)
    bodies = [footprints.matrix(values) @ albedo for values in footprints.sunlit[number]]
    share, scale = footprints.matrix(footprints.share), np.exp(log_sky).astype(np.float32)
    reflected = share @ (land.bounce * albedo)

    def parts(log_visibility: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        low, weight, _ = frame.haze.between(log_visibility)
        through = geometric(picture.transmittance, low, weight) / np.float32(np.pi)
        lux = geometric(picture.luminary_lx, low, weight)
        sky = geometric(land.sky, low, weight) * scale
        sun = np.zeros_like(reflected)
        for body, e in zip(bodies, lux, strict=True):
            sun += body * e
        diffuse = share @ (sky * albedo)
        air = geometric(picture.airlight, low, weight)
        return through, sun, diffuse, air, lux, sky

    log_visibility = float(of[HAZE][0])
    through, sun, diffuse, air, lux, sky = parts(log_visibility)
    radiance = through * (shining[:, None] * sun + diffuse + reflected) + air
    exposed = gain * radiance
    srgb, slope = encode(exposed)
    value, steepness, by_curve = bent(srgb, curve) if picture.levels else (srgb, np.ones_like(srgb), None)
    by_radiance = (steepness * slope * gain).astype(np.float32)
    dense = np.zeros((3, len(value), COLUMNS), np.float32)
    dense[:, :, 0] = (by_radiance * radiance).T
    if by_curve is not None:
        dense[:, :, 1:3] = by_curve.transpose(1, 0, 2)
    if by_turn is not None:
        dense[:, :, 3:6] = -by_turn.transpose(2, 1, 0)
    if len(frame.haze.visibility_km) > 1:
        t, s, d, a, _, _ = parts(log_visibility + _HAZE_STEP)
        hazier = t * (shining[:, None] * s + d + reflected) + a
        dense[:, :, 6] = (by_radiance * (hazier - radiance) / _HAZE_STEP).T
    dense[:, :, 7] = (by_radiance * through * diffuse).T
    variance = _variance(picture, by_radiance, radiance, through * sun * shining[:, None], noise_model)
    weight = np.where(usable[:, None], 1.0 / variance, 0.0).astype(np.float32)
    if picture.photograph.confidence is not None:
        weight *= picture.photograph.confidence[:, None]
    return PredictedPicture(
        value,
        (observed - value).astype(np.float32),
        weight,
        [by_radiance * through * shining[:, None] * e for e in lux],
        by_radiance * through,
        sky + land.bounce,
        dense,
        (by_radiance * through * sun).astype(np.float32),
        *_sky_evidence(picture, of, frame),
    )


def _variance(
    picture: RecoveryPicture, by_radiance: np.ndarray, radiance: np.ndarray, sun: np.ndarray, noise_model: NoiseModel
) -> np.ndarray:
    """Variance ``(n, 3)`` of encoded values; the same contributions as `equations.reweight`."""
    footprints, number = picture.photograph.footprints, picture.photograph.number
    lit = footprints.lit[number] if footprints.sunlit[number] else np.zeros(len(radiance))
    penumbra = np.nan_to_num(4.0 * lit * (1.0 - lit))[:, None]
    floor = _FLOOR * float(np.median(radiance)) + 1e-9
    relative = (noise_model.model * radiance) ** 2 + (noise_model.edge * sun * penumbra) ** 2 + floor**2
    return relative * by_radiance**2 + picture.levels**2


def _sky_evidence(
    picture: RecoveryPicture, of: dict[str, np.ndarray], frame: RecoveryFrame
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """See `PredictedPicture.sky_residual`."""
    if not len(picture.sky_encoded):
        return None, None
    log_visibility, log_sky, curve = float(of[HAZE][0]), of[SKY][picture.instant], of[CURVE][picture.camera]

    def log_linear(bend: np.ndarray) -> np.ndarray:
        straight = straightened(picture.sky_encoded, bend) if picture.levels else picture.sky_encoded
        return np.log(np.maximum(linear_from_srgb(straight), 1e-6))

    def log_radiance(value: float) -> np.ndarray:
        low, weight, _ = frame.haze.between(value)
        return np.log(np.maximum(geometric(picture.sky_radiance, low, weight), 1e-9))

    seen, expected = log_linear(curve), log_radiance(log_visibility)
    residual = np.median(seen - expected, axis=0) - of[GAIN][picture.number] - np.log(picture.scale) - log_sky
    dense = np.zeros((3, COLUMNS))
    dense[:, 0] = dense[:, 7] = 1.0
    if picture.levels:
        for k, step in enumerate(np.eye(2) * _CURVE_STEP):
            dense[:, 1 + k] = -np.median(log_linear(curve + step) - seen, axis=0) / _CURVE_STEP
    dense[:, 6] = np.median(log_radiance(log_visibility + _HAZE_STEP) - expected, axis=0) / _HAZE_STEP
    return residual, dense


def albedo_derivative(
    picture: RecoveryPicture, predicted: PredictedPicture, albedo: np.ndarray, root_weight: np.ndarray
) -> list[csr_array]:
    """Weighted derivative of a picture to log albedo, with the bounce as it is: for each channel sparse ``(n, R·S)``.

    Parameters
    ----------
    picture, predicted
        The photograph, and its prediction.
    albedo
        ``(R·S, 3)``.
    root_weight
        ``(n, 3)``.
    """
    footprints, number = picture.photograph.footprints, picture.photograph.number
    row = np.repeat(np.arange(len(footprints.pixel)), np.diff(footprints.start))
    result = []
    for c in range(3):
        values = footprints.share * (predicted.ambient[:, c][footprints.texel])
        values *= (predicted.diffuse_factor[:, c] * root_weight[:, c])[row]
        for factor, sunlit in zip(predicted.sun_factor, footprints.sunlit[number], strict=True):
            values = values + sunlit * (factor[:, c] * root_weight[:, c])[row]
        result.append(footprints.matrix((values * albedo[:, c][footprints.texel]).astype(np.float32)))
    return result
