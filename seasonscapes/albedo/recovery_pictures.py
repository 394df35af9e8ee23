"""Photographs prepared for a recovery: encoded values, light and air at several visibilities, and turns of the camera.

A rotation of the camera about its centre changes no visibility: it moves the picture by a homography (Hartley & Zisserman
2004, section 8.4.2), so that the footprints of its pixels stay and the picture is resampled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from seasonscapes.albedo.equations import FEWEST_SKY, usable_pixels, usable_sky
from seasonscapes.albedo.forward_model import aerial_perspective_of, sky_radiance_of
from seasonscapes.albedo.haze import mixed_light
from seasonscapes.albedo.photographs import AlbedoPhotograph, NoiseModel
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.receivers import luminaries
from seasonscapes.sky.illumination import Illumination

# Sub-texel relief, JPEG and demosaicing blur pictures; derivatives of the picture are taken at that scale [px].
_SLOPE_BLUR_PX = 0.7
_WHOLE = 0.99


@dataclass(frozen=True)
class HazeLights:
    """Lights of all K photographs at several visibilities.

    Parameters
    ----------
    visibility_km
        ``(V,)`` rising [km]; one alone leaves the haze as it is.
    lights
        V lists of K lights.
    start_km
        The visibility assumed.
    """

    visibility_km: tuple[float, ...]
    lights: Sequence[Sequence[Illumination]]
    start_km: float

    def between(self, log_visibility: float) -> tuple[int, float, float]:
        """Number of the lower node, weight of the upper, and that weight's derivative to the log of visibility."""
        if len(self.visibility_km) == 1:
            return 0, 0.0, 0.0
        inverse = 1.0 / np.asarray(self.visibility_km)
        value = float(np.clip(np.exp(-log_visibility), inverse[-1], inverse[0]))
        low = int(np.clip(np.searchsorted(self.visibility_km, 1.0 / value) - 1, 0, len(inverse) - 2))
        width = inverse[low + 1] - inverse[low]
        return low, float((value - inverse[low]) / width), float(-value / width)

    def at(self, photograph: int, log_visibility: float) -> Illumination:
        """The light of one photograph."""
        low, weight, _ = self.between(log_visibility)
        first = self.lights[low][photograph]
        return first if weight == 0.0 else mixed_light(first, self.lights[low + 1][photograph], weight)


@dataclass(frozen=True)
class RecoveryPicture:
    """One photograph or painted texture, with all that does not change while unknowns do.

    Parameters
    ----------
    photograph
        The photograph itself; n terrain pixels.
    number, camera, instant
        Its numbers among photographs, cameras and instants.
    encoded, usable
        ``(H, W, 3)`` encoded values and ``(H, W)`` usable pixels, as they were taken.
    scale
        Encoded values are those of linear values times this.
    levels
        Standard deviation of encoded values by rounding and compression.
    transmittance, airlight, luminary_lx
        At each visibility ``(V, n, 3)``, ``(V, n, 3)`` and ``(V, B, 3)``.
    sky_encoded, sky_radiance
        ``(K, 3)`` of open pixels, and their radiance at each visibility ``(V, K, 3)``.
    sun_weights
        ``(n, G²)``; see `recovery_system.RecoveryBlock`.
    """

    photograph: AlbedoPhotograph
    number: int
    camera: int
    instant: int
    encoded: np.ndarray
    usable: np.ndarray
    scale: float
    levels: float
    transmittance: np.ndarray
    airlight: np.ndarray
    luminary_lx: np.ndarray
    sky_encoded: np.ndarray
    sky_radiance: np.ndarray
    sun_weights: Any


def geometric(nodes: np.ndarray, low: int, weight: float) -> np.ndarray:
    """Interpolate geometrically between two of the nodes ``(V, ...)``."""
    if weight == 0.0:
        return nodes[low]
    first, second = (np.log(np.maximum(nodes[k], 1e-12)) for k in (low, low + 1))
    return np.exp((1.0 - weight) * first + weight * second).astype(np.float32)


def encode(linear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Encode linear values as sRGB without clipping: values and slope ``(...)``."""
    bright = np.maximum(linear, 0.0031308)
    powered, dark = bright ** np.float32(1.0 / 2.4), linear <= 0.0031308
    value = np.where(dark, 12.92 * np.maximum(linear, 0.0), 1.055 * powered - 0.055)
    return value, np.where(dark, 12.92, 1.055 / 2.4 * powered / bright)


def recovery_picture(
    photograph: AlbedoPhotograph,
    numbers: tuple[int, int, int],
    lights: Sequence[Illumination],
    noise_model: NoiseModel,
    sun_weights: Any,
) -> RecoveryPicture:
    """Prepare a photograph.

    Parameters
    ----------
    photograph
        The photograph.
    numbers
        Its numbers among photographs, cameras and instants.
    lights
        Its light at each visibility.
    noise_model
        Clipping limits and noise.
    sun_weights
        Sparse ``(n, G²)`` weights of the nodes of the sun's grid in its pixels.
    """
    noise_model = photograph.noise(noise_model)
    image = np.nan_to_num(photograph.observation.image).astype(np.float32)
    usable = usable_pixels(photograph.observation, noise_model)
    scale = 1.0 if noise_model.levels else 1.0 / max(float(np.percentile(image, 99.0)), 1e-12)
    encoded = encode(image * np.float32(scale))[0].astype(np.float32)
    chosen = usable_sky(photograph, usable)
    if chosen.sum() < FEWEST_SKY:
        chosen[:] = False
    air = [aerial_perspective_of(photograph.atmosphere, light, len(photograph.footprints.pixel)) for light in lights]
    sky = [
        sky_radiance_of(photograph.atmosphere, light)[chosen] if chosen.any() else np.zeros((0, 3)) for light in lights
    ]
    return RecoveryPicture(
        photograph,
        *numbers,
        encoded,
        usable,
        scale,
        noise_model.level_noise / noise_model.levels if noise_model.levels else 0.0,
        np.stack([each[0] for each in air]),
        np.stack([each[1] for each in air]),
        np.stack([_luminary_lx(photograph.light, light) for light in lights]),
        encoded.reshape(-1, 3)[photograph.atmosphere.sky.pixel[chosen]],
        np.stack(sky).astype(np.float32),
        sun_weights,
    )


def _luminary_lx(light: Illumination, hazy: Illumination) -> np.ndarray:
    """Normal illuminance ``(B, 3)`` in other air of the bodies that a light lists."""
    bodies = [hazy.sun if body is light.sun else hazy.moon for body in luminaries(light)]
    return np.array(
        [np.zeros(3) if body is None else np.asarray(body.normal_illuminance_lx) for body in bodies], np.float32
    ).reshape(-1, 3)


# ---------------------------------------------------------------------------------------------- pose


def turned_positions(camera: Camera, turn: np.ndarray) -> np.ndarray:
    """Where the pixels of a camera lie in a picture that was taken with the camera turned ``(H, W, 2)`` float32 [px].

    Parameters
    ----------
    camera
        The camera that is assumed.
    turn
        ``(3,)`` rotation vector of the true camera in the assumed one's axes (right, down, forward) [rad].
    """
    column, row = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    ray = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones_like(column)], axis=-1)
    seen = ray @ cv2.Rodrigues(np.asarray(turn, float))[0]
    position = seen[..., :2] / seen[..., 2:] * (camera.fx, camera.fy) + (camera.cx - 0.5, camera.cy - 0.5)
    return position.astype(np.float32)


def turned_camera(camera: Camera, turn: np.ndarray) -> Camera:
    """The camera after a rotation about its own axes; see `turned_positions`."""
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.asarray(turn, float))[0]
    return replace(camera, world_from_camera=pose)


def resampled(picture: RecoveryPicture, turn: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Encoded values ``(n, 3)``, usable pixels ``(n,)`` and derivatives to the turn ``(3, n, 3)`` at the terrain pixels."""
    pixel = picture.photograph.footprints.pixel
    camera = picture.photograph.footprints.camera
    if turn is None or not isinstance(camera, Camera):
        return picture.encoded.reshape(-1, 3)[pixel], picture.usable.ravel()[pixel], None
    position = turned_positions(camera, turn)
    x, y = (np.ascontiguousarray(position[..., k]) for k in (0, 1))
    image = cv2.remap(picture.encoded, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    usable = cv2.remap(picture.usable.astype(np.float32), x, y, cv2.INTER_LINEAR, borderValue=0.0) > _WHOLE
    soft = cv2.GaussianBlur(image, (0, 0), _SLOPE_BLUR_PX)
    down, across = np.gradient(soft, axis=(0, 1))
    slopes = []
    for axis in np.eye(3) * 1e-4:
        moved = (turned_positions(camera, turn + axis) - turned_positions(camera, turn - axis)) / 2e-4
        slope = across * moved[..., :1] + down * moved[..., 1:]
        slopes.append(slope.reshape(-1, 3)[pixel])
    return image.reshape(-1, 3)[pixel], usable.ravel()[pixel], np.stack(slopes)
