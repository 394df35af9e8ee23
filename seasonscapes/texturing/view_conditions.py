"""Conditions of an image model for a view with holes: the partial picture, the mask of its holes and a depth picture.

The reference implementation finds holes by colour (red texels, so that autumn foliage and alpenglow count as holes) and
passes its depth inverted. Here holes follow from coverage, and near is white, as in the training data of
`control_v11f1p_sd15_depth`.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from seasonscapes.images import linear_from_srgb, srgb_from_linear
from seasonscapes.terrain.surface import sample_texture

MASKS = ("coverage", "hsv")
# Percentiles of the terrain's distances that become white and the darkest grey.
_NEAR_PERCENTILE, _FAR_PERCENTILE = 0.5, 99.5
# Grey of the farthest terrain; brighter than the sky, to keep the skyline visible.
_FARTHEST_GREY = 0.08
# A pixel is a hole where a smaller fraction of the texels under it has a value.
_MIN_COVERAGE = 0.5
# Linear picture value of the 99th percentile of the painted radiance; the headroom is for the image model.
_BRIGHTEST_PAINTED = 0.85


@dataclass(frozen=True)
class ViewConditions:
    """Inputs of an image model for one view.

    Parameters
    ----------
    picture
        ``(H, W, 3)`` float32 sRGB-encoded in [0, 1]; holes contain an initial estimate.
    hole
        ``(H, W)`` bool: pixels to inpaint.
    depth
        ``(H, W)`` float32 in [0, 1]; near is white, the sky black.
    seed
        Seed of this view.
    """

    picture: np.ndarray
    hole: np.ndarray
    depth: np.ndarray
    seed: int


def white_radiance(values: np.ndarray, painted: np.ndarray) -> float:
    """Return the radiance that pictures of a texture show as white, common to all views.

    Parameters
    ----------
    values
        ``(R, S, 3)`` radiance [cd/m²].
    painted
        ``(R, S)`` bool: texels that count.

    Returns
    -------
    float
        [cd/m²], somewhat above the 99th percentile of the painted texels' brightest channel.
    """
    brightest = values[painted].max(axis=1)
    return max(float(np.percentile(brightest, 99.0)), 1e-9) / _BRIGHTEST_PAINTED


def encode(radiance: np.ndarray, white: float) -> np.ndarray:
    """Encode radiance as an sRGB picture; values above white are clipped.

    Parameters
    ----------
    radiance
        ``(..., 3)`` [cd/m²].
    white
        Radiance of white [cd/m²].

    Returns
    -------
    ndarray
        ``(..., 3)`` float32 in [0, 1].
    """
    return srgb_from_linear(radiance / white).astype(np.float32)


def decode(picture: np.ndarray, white: float) -> np.ndarray:
    """Decode an sRGB picture to radiance; the inverse of `encode`.

    Parameters
    ----------
    picture
        ``(..., 3)``, clipped to [0, 1].
    white
        Radiance of white [cd/m²].

    Returns
    -------
    ndarray
        ``(..., 3)`` float32 [cd/m²].
    """
    return (linear_from_srgb(np.clip(picture, 0.0, 1.0)) * white).astype(np.float32)


def depth_picture(depth_m: np.ndarray) -> np.ndarray:
    """Return a depth map as the depth ControlNet expects it, linear in the logarithm of distance.

    Parameters
    ----------
    depth_m
        ``(H, W)`` distance along the rays [m]; infinite is sky.

    Returns
    -------
    ndarray
        ``(H, W)`` float32 in [0, 1]: 1 near, dark grey for the farthest terrain, 0 for the sky.

    Notes
    -----
    A landscape spans three decades of distance; in disparity, everything beyond the nearest slope would be black.
    """
    terrain = np.isfinite(depth_m)
    picture = np.zeros(depth_m.shape, np.float32)
    if terrain.any():
        distance = np.log(np.maximum(depth_m[terrain], 1e-3))
        near, far = np.percentile(distance, [_NEAR_PERCENTILE, _FAR_PERCENTILE])
        nearness = np.clip((far - distance) / max(far - near, 1e-6), 0.0, 1.0)
        picture[terrain] = _FARTHEST_GREY + (1.0 - _FARTHEST_GREY) * nearness
    return picture


def sample_covered(values: np.ndarray, covered: np.ndarray, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sample a texture with holes bilinearly, ignoring texels without a value.

    Parameters
    ----------
    values
        ``(R, S, 3)`` radiance [cd/m²].
    covered
        ``(R, S)`` bool: texels with a value.
    uv
        ``(H, W, 2)`` texture coordinates of a G-buffer, NaN in the sky.

    Returns
    -------
    radiance
        ``(H, W, 3)`` [cd/m²].
    known
        ``(H, W)`` bool: at least half of the bilinear weight lies on texels with a value.
    """
    masked = np.where(covered[..., None], values, 0.0)
    layers = np.concatenate([masked, covered[..., None]], axis=2).astype(np.float32)
    sampled = np.nan_to_num(sample_texture(layers, uv))
    coverage = sampled[..., 3:]
    return sampled[..., :3] / np.maximum(coverage, 1e-6), coverage[..., 0] >= _MIN_COVERAGE


def red_pixels(picture: np.ndarray) -> np.ndarray:
    """Return the reference implementation's hole mask: all red pixels, whatever their origin.

    OpenCV's hue (0 to 179) 0 to 15 or 165 to 180 with saturation and value of at least 50 of 255. Autumn foliage,
    alpenglow and red rock therefore count as holes.

    Parameters
    ----------
    picture
        ``(H, W, 3)`` sRGB-encoded in [0, 1] with unpainted texels in pure red.

    Returns
    -------
    ndarray
        ``(H, W)`` bool.
    """
    hsv = cv2.cvtColor(np.round(np.clip(picture, 0.0, 1.0) * 255.0).astype(np.uint8), cv2.COLOR_RGB2HSV)
    hue, saturation, value = (hsv[..., k].astype(int) for k in range(3))
    return ((hue <= 15) | (hue >= 165)) & (saturation >= 50) & (value >= 50)


def dilated(hole: np.ndarray, reach_px: int) -> np.ndarray:
    """Dilate a mask by a disc.

    Parameters
    ----------
    hole
        ``(H, W)`` bool.
    reach_px
        Radius of the disc [px]; 0 returns the mask itself.

    Returns
    -------
    ndarray
        ``(H, W)`` bool.
    """
    if reach_px <= 0:
        return hole
    side = 2 * reach_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return cv2.dilate(hole.astype(np.uint8), disc).astype(bool)


def plain_sky(direction: np.ndarray, *, cloudiness: float = 0.0) -> np.ndarray:
    """Return a featureless sky for frames: pale at the horizon, blue above, grey where overcast.

    Parameters
    ----------
    direction
        Unit vectors ``(..., 3)`` ENU.
    cloudiness
        Fraction of grey in [0, 1].

    Returns
    -------
    ndarray
        ``(..., 3)`` float32, sRGB-encoded.
    """
    height = np.sqrt(np.clip(direction[..., 2:], 0.0, 1.0))
    blue = (1.0 - height) * np.array([0.80, 0.87, 0.93]) + height * np.array([0.30, 0.50, 0.80])
    grey = np.array([0.80, 0.81, 0.83]) - 0.1 * height
    return ((1.0 - cloudiness) * blue + cloudiness * grey).astype(np.float32)
