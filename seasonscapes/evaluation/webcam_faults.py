"""What a webcam makes of a landscape: exposure, white balance, tone curve, noise, JPEG; poses that are slightly off; houses.

Everything that is done is told, so that each estimator that undoes some of it can be measured. Haze is none of these:
it comes with the light (`sky.models`, visibility).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from seasonscapes.calibration.pose_model import View, values_of, view_from_values
from seasonscapes.cameras.pinhole import rotation_from_angles
from seasonscapes.images import (
    METER_CONSTANT,
    REC709_LUMINANCE,
    auto_exposure_ev100,
    linear_from_srgb,
    srgb_from_linear,
)

# The luminance that the meter finds is put here, where 1 is the least that clips: an 18 % grey card.
_METERED_GREY = 0.18


@dataclass(frozen=True)
class WebcamFaults:
    """How a webcam treats its picture; `CLEAN` treats it as well as 8 bits can.

    Parameters
    ----------
    exposure_sigma_ev
        Standard deviation of the automatic exposure about what average metering asks for [stops].
    white_balance_sigma
        Standard deviation of the logarithms of the red and blue gains.
    tone_strength
        S-curve in the encoded values, 0 (sRGB alone) to 0.9.
    full_well
        Electrons of a sensor cell that clips: photon noise is ``sqrt(x / full_well)`` of values x in [0, 1]; infinite
        for none.
    read_noise
        Standard deviation of the noise in the dark, where 1 clips.
    jpeg_quality
        1 to 100 (4:2:0 chroma); ``None`` leaves JPEG out.
    """

    exposure_sigma_ev: float = 0.35
    white_balance_sigma: float = 0.06
    tone_strength: float = 0.4
    full_well: float = 8000.0
    read_noise: float = 0.002
    jpeg_quality: int | None = 88

    def __post_init__(self):
        if not 0.0 <= self.tone_strength <= 0.9:
            raise ValueError(f"WebcamFaults: tone_strength = {self.tone_strength}, expected 0 to 0.9")
        if min(self.exposure_sigma_ev, self.white_balance_sigma, self.read_noise) < 0.0 or not self.full_well > 0.0:
            raise ValueError("WebcamFaults: sigmas must not be negative, and full_well must be positive")
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"WebcamFaults: jpeg_quality = {self.jpeg_quality}, expected 1 to 100")


CLEAN = WebcamFaults(0.0, 0.0, 0.0, np.inf, 0.0, None)
TYPICAL = WebcamFaults()
SEVERE = WebcamFaults(0.7, 0.12, 0.7, 3000.0, 0.006, 65)


@dataclass(frozen=True)
class Development:
    """What was done to a picture.

    Parameters
    ----------
    gains
        ``(3,)`` exposed value over radiance [1 / (cd/m²)], exposure and white balance together; 1 clips.
    exposure_error_ev
        Stops brighter than metered.
    white_balance
        ``(3,)`` share of it in ``gains``; green is 1.
    tone_strength
        Of the S-curve.
    clipped
        ``(H, W)`` bool: pixels with a channel beyond the sensor's range.
    """

    gains: np.ndarray
    exposure_error_ev: float
    white_balance: np.ndarray
    tone_strength: float
    clipped: np.ndarray


@dataclass(frozen=True)
class PoseSigmas:
    """Standard deviations of a pose: position [m], angles [deg], logarithm of the focal length."""

    horizontal_m: float = 0.0
    vertical_m: float = 0.0
    heading_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    log_focal: float = 0.0


def degrade(radiance: np.ndarray, faults: WebcamFaults, rng: np.random.Generator) -> tuple[np.ndarray, Development]:
    """The picture ``(H, W, 3)`` uint8 sRGB that a webcam delivers of radiance ``(H, W, 3)`` [cd/m²], and what was done.

    Raises
    ------
    ValueError
        The radiance is not finite, or black all over.
    """
    radiance = np.asarray(radiance, np.float32)
    if not np.isfinite(radiance).all():
        raise ValueError("degrade: radiance is not finite")
    error_ev = float(rng.normal(0.0, 1.0)) * faults.exposure_sigma_ev
    red, blue = np.exp(rng.normal(0.0, 1.0, 2) * faults.white_balance_sigma)
    white_balance = np.array([red, 1.0, blue])
    metered = METER_CONSTANT * 2.0 ** auto_exposure_ev100(radiance)
    gains = _METERED_GREY / metered * 2.0**error_ev * white_balance
    exposed = radiance * gains.astype(np.float32)
    clipped = (exposed >= 1.0).any(axis=2)
    noise = np.sqrt(np.clip(exposed, 0.0, 1.0) / faults.full_well + faults.read_noise**2)
    exposed = exposed + rng.standard_normal(exposed.shape, np.float32) * noise
    levels = np.round(255.0 * tone(srgb_from_linear(exposed), faults.tone_strength)).astype(np.uint8)
    if faults.jpeg_quality is not None:
        written = cv2.imencode(".jpg", levels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, faults.jpeg_quality])[1]
        levels = np.ascontiguousarray(cv2.imdecode(written, cv2.IMREAD_COLOR)[..., ::-1])
    return levels, Development(gains, error_ev, white_balance, faults.tone_strength, clipped)


def undo_development(levels: np.ndarray, done: Development) -> np.ndarray:
    """Radiance ``(H, W, 3)`` [cd/m²] from bytes when all that was done is known; clipped pixels stay too dark."""
    encoded = untone(np.asarray(levels, np.float32) / 255.0, done.tone_strength)
    return (linear_from_srgb(encoded) / done.gains).astype(np.float32)


def tone(encoded: np.ndarray, strength: float) -> np.ndarray:
    """An S-curve of values in [0, 1]: a share ``strength`` of ``3e² - 2e³`` and the rest of ``e``."""
    return (1.0 - strength) * encoded + strength * encoded * encoded * (3.0 - 2.0 * encoded)


def untone(toned: np.ndarray, strength: float) -> np.ndarray:
    """Inverse of `tone`, by a table that is finer than 8 bits."""
    knots = np.linspace(0.0, 1.0, 4097)
    return np.interp(toned, tone(knots, strength), knots).astype(np.float32)


def perturb_pose(camera: View, sigmas: PoseSigmas, rng: np.random.Generator) -> tuple[View, dict[str, float]]:
    """A view that is off by a random amount, and by how much: keys as the fields of `PoseSigmas`, and east, north, up.

    Heading turns about the frame's up axis, pitch and roll about the camera's own axes. A full circle stays one: the
    focal length of such a panorama changes in its rows alone.
    """
    draw = rng.normal(0.0, 1.0, 7)
    error = {
        "east_m": draw[0] * sigmas.horizontal_m,
        "north_m": draw[1] * sigmas.horizontal_m,
        "up_m": draw[2] * sigmas.vertical_m,
        "heading_deg": draw[3] * sigmas.heading_deg,
        "pitch_deg": draw[4] * sigmas.pitch_deg,
        "roll_deg": draw[5] * sigmas.roll_deg,
        "log_focal": draw[6] * sigmas.log_focal,
    }
    error = {name: float(value) for name, value in error.items()}
    level = rotation_from_angles(0.0, 0.0)
    turn = rotation_from_angles(error["heading_deg"], 0.0) @ level.T
    nod = level.T @ rotation_from_angles(0.0, error["pitch_deg"], error["roll_deg"])
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = turn @ pose[:3, :3] @ nod
    pose[:3, 3] += [error["east_m"], error["north_m"], error["up_m"]]
    values = values_of(camera, np.eye(3))
    values[6] = error["log_focal"]
    scaled = view_from_values(camera, np.eye(3), values)
    return replace(camera, fx=scaled.fx, fy=scaled.fy, world_from_camera=pose), error


# Reflectances of what stands before webcams: roof tiles, slate, plaster, weathered wood, steel.
_ROOFS = np.array([[0.24, 0.10, 0.06], [0.10, 0.10, 0.11], [0.16, 0.09, 0.06]])
_WALLS = np.array([[0.62, 0.58, 0.50], [0.20, 0.13, 0.08], [0.45, 0.42, 0.36]])
_STEEL, _PANE = np.array([0.30, 0.31, 0.32]), np.array([0.05, 0.06, 0.07])


def add_foreground(
    radiance: np.ndarray, rng: np.random.Generator, *, houses: int = 3, mast: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Stand houses and a mast, which no elevation model knows, before a picture.

    Parameters
    ----------
    radiance
        ``(H, W, 3)`` [cd/m²].

    Returns
    -------
    radiance
        With them. They are lit like the picture's lower half: its median luminance is taken for a fifth reflected.
    mask
        ``(H, W)`` bool, True where they stand.
    """
    image = np.array(radiance, np.float32)
    height, width = image.shape[:2]
    light = 5.0 * float(np.median(image[height // 2 :] @ REC709_LUMINANCE))
    mask = np.zeros((height, width), np.uint8)
    middles = (np.arange(houses) + rng.uniform(0.25, 0.75, houses)) * width / max(houses, 1)
    for middle in middles:
        _house(image, mask, float(middle), light, rng)
    if mast:
        x, top = int(rng.uniform(0.1, 0.9) * width), int(rng.uniform(0.15, 0.35) * height)
        size = min(width, 1.5 * height)  # see `_house`
        thick = max(2, round(0.004 * size))
        _fill(image, mask, [(x, height), (x, top), (x + thick, top), (x + thick, height)], light * _STEEL)
        for rung in np.linspace(top, 0.5 * height, 3):
            y, half = int(rung), int(0.02 * size)
            _fill(
                image,
                mask,
                [(x - half, y), (x + half, y), (x + half, y + thick), (x - half, y + thick)],
                light * _STEEL,
            )
    return image, mask.astype(bool)


def _house(image: np.ndarray, mask: np.ndarray, middle: float, light: float, rng: np.random.Generator) -> None:
    height, width = mask.shape
    # A panorama is wide because it shows more, not because it is nearer.
    half = 0.5 * rng.uniform(0.08, 0.16) * min(width, 1.5 * height)
    eaves = height - rng.uniform(0.10, 0.22) * height
    ridge = eaves - rng.uniform(0.35, 0.6) * half
    shade = rng.uniform(0.25, 1.1, 2)  # sides turned to and from the light
    wall, roof = _WALLS[rng.integers(len(_WALLS))], _ROOFS[rng.integers(len(_ROOFS))]
    corner = middle + rng.uniform(-0.3, 0.3) * half
    _fill(
        image,
        mask,
        [(middle - half, height), (middle - half, eaves), (corner, eaves), (corner, height)],
        light * shade[0] * wall,
    )
    _fill(
        image,
        mask,
        [(corner, height), (corner, eaves), (middle + half, eaves), (middle + half, height)],
        light * shade[1] * wall,
    )
    out = 1.12 * half
    _fill(
        image,
        mask,
        [(middle - out, eaves), (middle - 0.7 * half, ridge), (middle + 0.7 * half, ridge), (middle + out, eaves)],
        light * rng.uniform(0.5, 1.1) * roof,
    )
    pane = 0.1 * half
    for x in np.linspace(middle - 0.75 * half, middle + 0.75 * half, 5):
        for y in np.arange(eaves + 2.0 * pane, height, 5.0 * pane):
            _fill(
                image,
                mask,
                [(x - pane, y), (x + pane, y), (x + pane, y + 2.5 * pane), (x - pane, y + 2.5 * pane)],
                light * _PANE,
            )


def _fill(image: np.ndarray, mask: np.ndarray, corners: list[tuple[float, float]], colour: np.ndarray) -> None:
    outline = np.round(np.array(corners)).astype(np.int32)
    cv2.fillPoly(image, [outline], tuple(float(value) for value in colour))
    cv2.fillPoly(mask, [outline], 1)
