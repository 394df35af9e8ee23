"""What an image model is told about a view with holes: the partial picture, where its holes are, how far things are.

The reference implementation finds holes by colour (red texels, so autumn and alpenglow are holes too) and hands over its
depth inverted. Here coverage decides, and near is white, as `control_v11f1p_sd15_depth` was trained.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from seasonscapes.images import linear_from_srgb, srgb_from_linear
from seasonscapes.terrain.surface import sample_texture

MASKS = ("coverage", "hsv")
# Distances beyond these percentiles of the land are taken for the nearest and the farthest.
_NEAREST, _FARTHEST = 0.5, 99.5
# The farthest land stays this much lighter than the sky, so that the skyline is seen.
_FARTHEST_GREY = 0.08
# A pixel is a hole where less than half of the texels under it have a value.
_LEAST_COVER = 0.5
# The whitest painted land is this bright in a picture; what a model paints may be brighter.
_WHITEST = 0.85


@dataclass(frozen=True)
class Conditions:
    """One view for an image model.

    Parameters
    ----------
    picture
        ``(H, W, 3)`` float32 sRGB-encoded in [0, 1]; holes hold a guess (their rims' colours, or a completion's).
    hole
        ``(H, W)`` bool: to be painted.
    depth
        ``(H, W)`` float32 in [0, 1], near is white, the sky black.
    seed
        Of this view.
    """

    picture: np.ndarray
    hole: np.ndarray
    depth: np.ndarray
    seed: int


def white_radiance(values: np.ndarray, painted: np.ndarray) -> float:
    """The radiance [cd/m²] that is white in pictures of a painted texture ``(R, S, 3)``, the same for all views."""
    brightest = values[painted].max(axis=1)
    return max(float(np.percentile(brightest, 99.0)), 1e-9) / _WHITEST


def encode(radiance: np.ndarray, white: float) -> np.ndarray:
    """Radiance as an sRGB picture in [0, 1]; brighter than ``white`` is clipped."""
    return srgb_from_linear(radiance / white).astype(np.float32)


def decode(picture: np.ndarray, white: float) -> np.ndarray:
    """The way back."""
    return (linear_from_srgb(np.clip(picture, 0.0, 1.0)) * white).astype(np.float32)


def depth_picture(depth_m: np.ndarray) -> np.ndarray:
    """Depth as ControlNet takes it ``(H, W)`` float32: near is 1, the farthest land dark grey, the sky 0.

    Parameters
    ----------
    depth_m
        ``(H, W)`` distance along the rays [m]; infinite is sky.

    Notes
    -----
    In the logarithm of distance: a landscape spans three decades, and in disparity all of it beyond the first slope
    would be black.
    """
    land = np.isfinite(depth_m)
    picture = np.zeros(depth_m.shape, np.float32)
    if land.any():
        distance = np.log(np.maximum(depth_m[land], 1e-3))
        near, far = np.percentile(distance, [_NEAREST, _FARTHEST])
        nearness = np.clip((far - distance) / max(far - near, 1e-6), 0.0, 1.0)
        picture[land] = _FARTHEST_GREY + (1.0 - _FARTHEST_GREY) * nearness
    return picture


def look_up(values: np.ndarray, covered: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What pixels see of a texture with holes: radiance ``(H, W, 3)`` and whether there is enough of it ``(H, W)`` bool.

    Parameters
    ----------
    values, covered
        ``(R, S, 3)`` and ``(R, S)`` bool. Texels that are not covered have no say.
    uv
        ``(H, W, 2)`` of a G-buffer, NaN in the sky.
    """
    known = np.where(covered[..., None], values, 0.0)
    layers = np.concatenate([known, covered[..., None]], axis=2).astype(np.float32)
    found = np.nan_to_num(sample_texture(layers, uv))
    share = found[..., 3:]
    return found[..., :3] / np.maximum(share, 1e-6), share[..., 0] >= _LEAST_COVER


def red_pixels(picture: np.ndarray) -> np.ndarray:
    """The reference implementation's hole mask ``(H, W)`` bool: red by hue, wherever it comes from.

    OpenCV's hue (0 to 179) 0 to 15 or 165 to 180 with saturation and value of at least 50 of 255; autumn, alpenglow and
    red rock are holes to it.

    Parameters
    ----------
    picture
        ``(H, W, 3)`` sRGB-encoded in [0, 1] with unpainted texels in pure red.
    """
    hsv = cv2.cvtColor(np.round(np.clip(picture, 0.0, 1.0) * 255.0).astype(np.uint8), cv2.COLOR_RGB2HSV)
    hue, saturation, value = (hsv[..., k].astype(int) for k in range(3))
    return ((hue <= 15) | (hue >= 165)) & (saturation >= 50) & (value >= 50)


def dilated(hole: np.ndarray, reach_px: int) -> np.ndarray:
    """A mask ``(H, W)`` bool grown by a disc."""
    if reach_px <= 0:
        return hole
    side = 2 * reach_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return cv2.dilate(hole.astype(np.uint8), disc).astype(bool)


def plain_sky(direction: np.ndarray, *, cloudiness: float = 0.0) -> np.ndarray:
    """An sRGB-encoded sky ``(..., 3)`` float32 without clouds' shapes, for frames: pale at the horizon, blue above.

    Parameters
    ----------
    direction
        Unit vectors ``(..., 3)`` ENU.
    """
    height = np.sqrt(np.clip(direction[..., 2:], 0.0, 1.0))
    blue = (1.0 - height) * np.array([0.80, 0.87, 0.93]) + height * np.array([0.30, 0.50, 0.80])
    grey = np.array([0.80, 0.81, 0.83]) - 0.1 * height
    return ((1.0 - cloudiness) * blue + cloudiness * grey).astype(np.float32)
