"""Simulated webcam degradations: exposure, white balance, tone curve, noise, JPEG, pose errors and foreground objects.

All applied degradations are returned, so that estimators of them can be evaluated. Haze is not included, because it is
part of the illumination (`sky.models`, visibility).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from seasonscapes.calibration.pose_model import View, parameters_of_view, view_from_parameters
from seasonscapes.cameras.pinhole import rotation_from_angles
from seasonscapes.images import (
    METER_CONSTANT,
    REC709_LUMINANCE,
    auto_exposure_ev100,
    linear_from_srgb,
    srgb_from_linear,
)

# Exposed value of the metered luminance, relative to the clipping level: an 18 % grey card.
_METERED_GREY = 0.18


@dataclass(frozen=True)
class WebcamFaults:
    """Degradation of an image by a webcam; `CLEAN` only quantises to 8 bits.

    Parameters
    ----------
    exposure_sigma_ev
        Standard deviation of the exposure about that of average metering [stops].
    white_balance_sigma
        Standard deviation of the logarithms of the red and blue gains.
    tone_strength
        Strength of an S-curve applied to the encoded values, 0 (sRGB only) to 0.9.
    full_well
        Full-well capacity of a pixel [electrons]: shot noise has the standard deviation ``sqrt(x / full_well)`` at
        values x in [0, 1]; infinite for no shot noise.
    read_noise
        Standard deviation of the read noise, relative to the clipping level.
    jpeg_quality
        JPEG quality, 1 to 100 (4:2:0 chroma); ``None`` for no compression.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    exposure_sigma_ev: float = 0.35
    white_balance_sigma: float = 0.06
    tone_strength: float = 0.4
    full_well: float = 8000.0
    read_noise: float = 0.002
    jpeg_quality: int | None = 88

    def __post_init__(self):
        if not 0.0 <= self.tone_strength <= 0.9:
            raise ValueError(f"WebcamFaults: got tone_strength = {self.tone_strength}, expected 0 to 0.9")
        if min(self.exposure_sigma_ev, self.white_balance_sigma, self.read_noise) < 0.0 or not self.full_well > 0.0:
            raise ValueError("WebcamFaults: standard deviations must not be negative, and full_well must be positive")
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"WebcamFaults: got jpeg_quality = {self.jpeg_quality}, expected 1 to 100")


CLEAN = WebcamFaults(0.0, 0.0, 0.0, np.inf, 0.0, None)
TYPICAL = WebcamFaults()
SEVERE = WebcamFaults(0.7, 0.12, 0.7, 3000.0, 0.006, 65)


@dataclass(frozen=True)
class Development:
    """Development of an image from radiance to encoded values, as it was applied.

    Parameters
    ----------
    gains
        Exposed value over radiance ``(3,)`` [1 / (cd/m²)], exposure and white balance together; values clip at 1.
    exposure_error_ev
        Exposure relative to the metered exposure [stops]; positive is brighter.
    white_balance
        White-balance factor ``(3,)`` contained in ``gains``; green is 1.
    tone_strength
        Strength of the S-curve.
    clipped
        ``(H, W)`` bool, True where a channel is clipped.
    """

    gains: np.ndarray
    exposure_error_ev: float
    white_balance: np.ndarray
    tone_strength: float
    clipped: np.ndarray


@dataclass(frozen=True)
class PoseSigmas:
    """Standard deviations of pose errors.

    Parameters
    ----------
    horizontal_m, vertical_m
        Position: east and north each, and up [m].
    heading_deg, pitch_deg, roll_deg
        Angles [deg].
    log_focal
        Natural logarithm of the focal length.
    """

    horizontal_m: float = 0.0
    vertical_m: float = 0.0
    heading_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    log_focal: float = 0.0


def degrade(radiance: np.ndarray, faults: WebcamFaults, rng: np.random.Generator) -> tuple[np.ndarray, Development]:
    """Simulate the image that a webcam delivers of given radiance.

    Parameters
    ----------
    radiance
        Radiance ``(H, W, 3)`` [cd/m²].
    faults
        Degradation.
    rng
        Random generator.

    Returns
    -------
    levels : ndarray
        Image ``(H, W, 3)`` uint8 sRGB.
    development : Development
        The applied development.

    Raises
    ------
    ValueError
        If the radiance is not finite, or nowhere positive.
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
        jpeg = cv2.imencode(".jpg", levels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, faults.jpeg_quality])[1]
        decoded = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        assert decoded is not None
        levels = np.ascontiguousarray(decoded[..., ::-1])
    return levels, Development(gains, error_ev, white_balance, faults.tone_strength, clipped)


def undo_development(levels: np.ndarray, development: Development) -> np.ndarray:
    """Recover radiance from an image whose development is known.

    Parameters
    ----------
    levels
        Image ``(H, W, 3)`` uint8.
    development
        Its development.

    Returns
    -------
    ndarray
        Radiance ``(H, W, 3)`` float32 [cd/m²]; too low where clipped.
    """
    encoded = untone(np.asarray(levels, np.float32) / 255.0, development.tone_strength)
    return (linear_from_srgb(encoded) / development.gains).astype(np.float32)


def tone(encoded: np.ndarray, strength: float) -> np.ndarray:
    """Apply an S-curve: ``strength`` times ``3e² - 2e³`` plus ``1 - strength`` times ``e``.

    Parameters
    ----------
    encoded
        Values ``(...)`` in [0, 1].
    strength
        Strength of the curve, 0 to 0.9.

    Returns
    -------
    ndarray
        Values ``(...)`` in [0, 1].
    """
    return (1.0 - strength) * encoded + strength * encoded * encoded * (3.0 - 2.0 * encoded)


def untone(toned: np.ndarray, strength: float) -> np.ndarray:
    """Invert `tone` by interpolation in a table of 4097 knots.

    Parameters
    ----------
    toned
        Values ``(...)`` in [0, 1].
    strength
        Strength of the curve, 0 to 0.9.

    Returns
    -------
    ndarray
        Values ``(...)`` in [0, 1], float32.
    """
    knots = np.linspace(0.0, 1.0, 4097)
    return np.interp(toned, tone(knots, strength), knots).astype(np.float32)


def perturb_pose(camera: View, sigmas: PoseSigmas, rng: np.random.Generator) -> tuple[View, dict[str, float]]:
    """Add random errors to the pose and focal length of a view.

    The heading error rotates about the up axis of the frame, pitch and roll errors about the axes of the camera. A
    full-circle panorama keeps its horizontal focal length.

    Parameters
    ----------
    camera
        Camera or panorama.
    sigmas
        Standard deviations of the errors.
    rng
        Random generator.

    Returns
    -------
    view : Camera or Panorama
        View with errors.
    error : dict
        The errors: ``east_m``, ``north_m``, ``up_m``, ``heading_deg``, ``pitch_deg``, ``roll_deg`` and ``log_focal``.
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
    heading_rotation = rotation_from_angles(error["heading_deg"], 0.0) @ level.T
    camera_rotation = level.T @ rotation_from_angles(0.0, error["pitch_deg"], error["roll_deg"])
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = heading_rotation @ pose[:3, :3] @ camera_rotation
    pose[:3, 3] += [error["east_m"], error["north_m"], error["up_m"]]
    parameters = parameters_of_view(camera, np.eye(3))
    parameters[6] = error["log_focal"]
    scaled = view_from_parameters(camera, np.eye(3), parameters)
    return replace(camera, fx=scaled.fx, fy=scaled.fy, world_from_camera=pose), error


# Reflectances of foreground objects: roof tiles and slate, plaster and weathered wood, steel, window panes.
_ROOFS = np.array([[0.24, 0.10, 0.06], [0.10, 0.10, 0.11], [0.16, 0.09, 0.06]])
_WALLS = np.array([[0.62, 0.58, 0.50], [0.20, 0.13, 0.08], [0.45, 0.42, 0.36]])
_STEEL, _PANE = np.array([0.30, 0.31, 0.32]), np.array([0.05, 0.06, 0.07])


def add_foreground(
    radiance: np.ndarray, rng: np.random.Generator, *, houses: int = 3, mast: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Add houses and a mast, which elevation models do not contain, to the foreground of an image.

    Their irradiance is derived from the lower half of the image, whose median luminance is taken to be that of a
    surface of reflectance 0.2.

    Parameters
    ----------
    radiance
        Radiance ``(H, W, 3)`` [cd/m²].
    rng
        Random generator.
    houses
        Number of houses.
    mast
        Whether to add a mast.

    Returns
    -------
    radiance : ndarray
        Radiance ``(H, W, 3)`` float32 [cd/m²] with the foreground.
    mask : ndarray
        ``(H, W)`` bool, True on the foreground.
    """
    image = np.array(radiance, np.float32)
    height, width = image.shape[:2]
    light = 5.0 * float(np.median(image[height // 2 :] @ REC709_LUMINANCE))
    mask = np.zeros((height, width), np.uint8)
    centres = (np.arange(houses) + rng.uniform(0.25, 0.75, houses)) * width / max(houses, 1)
    for centre in centres:
        _house(image, mask, float(centre), light, rng)
    if mast:
        x, top = int(rng.uniform(0.1, 0.9) * width), int(rng.uniform(0.15, 0.35) * height)
        size = min(width, 1.5 * height)  # see `_house`
        thickness = max(2, round(0.004 * size))
        _fill(image, mask, [(x, height), (x, top), (x + thickness, top), (x + thickness, height)], light * _STEEL)
        for rung in np.linspace(top, 0.5 * height, 3):
            y, half = int(rung), int(0.02 * size)
            _fill(
                image,
                mask,
                [(x - half, y), (x + half, y), (x + half, y + thickness), (x - half, y + thickness)],
                light * _STEEL,
            )
    return image, mask.astype(bool)


def _house(image: np.ndarray, mask: np.ndarray, centre: float, light: float, rng: np.random.Generator) -> None:
    height, width = mask.shape
    # A panorama is wider because of its larger field of view; the size of objects is limited by the height.
    half = 0.5 * rng.uniform(0.08, 0.16) * min(width, 1.5 * height)
    eaves = height - rng.uniform(0.10, 0.22) * height
    ridge = eaves - rng.uniform(0.35, 0.6) * half
    shade = rng.uniform(0.25, 1.1, 2)  # relative irradiance of the two walls
    wall, roof = _WALLS[rng.integers(len(_WALLS))], _ROOFS[rng.integers(len(_ROOFS))]
    corner = centre + rng.uniform(-0.3, 0.3) * half
    _fill(
        image,
        mask,
        [(centre - half, height), (centre - half, eaves), (corner, eaves), (corner, height)],
        light * shade[0] * wall,
    )
    _fill(
        image,
        mask,
        [(corner, height), (corner, eaves), (centre + half, eaves), (centre + half, height)],
        light * shade[1] * wall,
    )
    overhang = 1.12 * half
    _fill(
        image,
        mask,
        [
            (centre - overhang, eaves),
            (centre - 0.7 * half, ridge),
            (centre + 0.7 * half, ridge),
            (centre + overhang, eaves),
        ],
        light * rng.uniform(0.5, 1.1) * roof,
    )
    pane = 0.1 * half
    for x in np.linspace(centre - 0.75 * half, centre + 0.75 * half, 5):
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
