"""Sunlight between the shadows of clouds: patches of ground that a hidden sun does not explain.

One amount of direct light for a whole picture (`picture_conditions`) is next to nothing where the sun reaches a patch of
the land alone. Light, haze, exposure and response are therefore fitted once more with the sun hidden, robustly, which most
of the ground then decides. Beyond that a patch in the sun is brighter and warmer, and the fine detail of its ground is
stronger in the same proportion. New snow is brighter and not warmer; mist is bright and may be warm, but hides detail; glare
lies along the skyline.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from seasonscapes.albedo.fixed_camera import SUN_SHONE, FixedCamera, conditions_of
from seasonscapes.albedo.picture_conditions import CONTRAST, ViewLight, incidence, linear_parts
from seasonscapes.images import linear_from_srgb

# Standard deviations [widths of the picture] of the means that are compared, and of those that fine detail is beyond.
_SMOOTHING, _DETAIL = 1.0 / 60.0, 1.0 / 80.0
# Ground in the sun has its logarithm of red over blue raised by so much beyond the other ground's.
_WARMER = 0.1
# Ground is judged where its mean cosine of incidence, with visibility, is so large, away from the skyline and what is masked.
_FACING, _LEAST_WEIGHT = 0.15, 0.9
# Detail is the ground's where it agrees with what is expected at least by such a share of the median agreement; mist hides
# it below the second share, and ground is kept clear of mist by the smoothing.
_AGREES, _HIDDEN, _CLEAR = 0.5, 0.4, 0.1
_CLIPPED, _DARKEST, _SMALLEST = 0.98, 0.2, 1e-6
# A smaller share of the judged land is no patch: two blobs of the smoothing.
_LEAST_PATCH = 0.01


def sunlit_share(
    camera: FixedCamera,
    picture: np.ndarray,
    usable: np.ndarray,
    light: ViewLight,
    pixel: np.ndarray,
    size_px: tuple[int, int],
) -> float:
    """Share of a picture's ground that the sun lights more than the rest of it, 0 to 1.

    Parameters
    ----------
    camera
        What the camera's pictures tell of its ground.
    picture
        ``(n, 3)`` sRGB-encoded values of the terrain pixels.
    usable
        ``(n,)`` bool: False where something stands before the terrain.
    light
        Light of the picture's instant.
    pixel
        ``(n,)`` indices of the terrain pixels in the flat image.
    size_px
        Width and height of the image [px].

    Raises
    ------
    NoUsablePixels
        Where the picture has none.
    """
    conditions = conditions_of(camera, picture, usable, light, sun=0.0)
    factor, _, addend = linear_parts(light, camera.ground, conditions.values)
    expected = camera.ground.reflectance * factor
    linear = np.maximum(linear_from_srgb(picture), _SMALLEST) ** np.exp(-conditions.values[CONTRAST])
    found = np.maximum(linear - addend, _DARKEST * expected)
    weight = (usable & (picture.max(axis=1) < _CLIPPED)).astype(np.float64)
    facing = np.maximum(incidence(light, camera.ground.shading), 0.0) * light.sun_visible

    def means(planes: np.ndarray, share: float, weight: np.ndarray = weight) -> np.ndarray:
        """Weighted local means ``(n, p)`` of planes ``(n, p)``."""
        return _smoothed(planes * weight[:, None], share, pixel, size_px) / around(share, weight)[:, None]

    def around(share: float, weight: np.ndarray = weight) -> np.ndarray:
        return np.maximum(_smoothed(weight[:, None], share, pixel, size_px)[:, 0], _SMALLEST)

    levels = np.column_stack([found.mean(axis=1), expected.mean(axis=1)])
    fine = levels - means(levels, _DETAIL)
    products = np.column_stack([fine.prod(axis=1), fine**2])
    local = means(np.column_stack([found, expected, facing, products]), _SMOOTHING)
    judged = around(_SMOOTHING) > _LEAST_WEIGHT
    if not judged.any():
        return 0.0
    excess = np.log(np.maximum(local[:, :3], _SMALLEST) / np.maximum(local[:, 3:6], _SMALLEST))
    excess -= np.median(excess[judged], axis=0)
    both, of_found, of_expected = np.maximum(local[:, 7:].T, _SMALLEST**2)
    strength, agreement = both / of_expected, both / np.sqrt(of_found * of_expected)
    strength /= np.median(strength[judged])
    agreement /= np.median(agreement[judged])
    hidden = (judged & (agreement < _HIDDEN)).astype(np.float64)[:, None]
    patches = (
        (excess.mean(axis=1) > 0.0)
        & (excess[:, 0] - excess[:, 2] > _WARMER)
        # A hidden sun leaves 1 - share of the light.
        & (strength > 1.0 / (1.0 - SUN_SHONE))
        & (agreement > _AGREES)
        & (local[:, 6] > _FACING)
        & (means(hidden, _SMOOTHING, np.ones_like(weight))[:, 0] < _CLEAR)
    )
    return float(patches[judged].mean())


def sun_shone(
    camera: FixedCamera,
    direct: float,
    picture: np.ndarray,
    usable: np.ndarray,
    light: ViewLight,
    pixel: np.ndarray,
    size_px: tuple[int, int],
    *,
    closed: bool,
) -> bool:
    """Whether sunlight fell on any of a picture's ground: on all that faces the sun, or on patches between cloud shadows.

    Parameters
    ----------
    camera, picture, usable, light, pixel, size_px
        As in `sunlit_share`.
    direct
        Share of direct light in the picture (`fixed_camera.direct_share`).
    closed
        Whether its sky is a closed layer of clouds (`cloud_cover.closed_clouds`): the sun may shine through a gap outside
        the picture onto patches, and not onto all of the ground.

    Raises
    ------
    NoUsablePixels
        Where the picture has none.
    """
    if not light.sun.any():
        return False
    if direct > SUN_SHONE and not closed:
        return True
    return sunlit_share(camera, picture, usable, light, pixel, size_px) > _LEAST_PATCH


def _smoothed(planes: np.ndarray, share: float, pixel: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    """Planes ``(n, p)`` of the terrain pixels after a Gaussian filter of the image by a share of its width."""
    width, height = size_px
    image = np.zeros((height * width, planes.shape[1]), np.float32)
    image[pixel] = planes
    blurred = np.empty((height, width, planes.shape[1]), np.float32)
    sigma = (share * width, share * width, 0.0)
    ndimage.gaussian_filter(image.reshape(blurred.shape), sigma, output=blurred, mode="constant")
    return blurred.reshape(image.shape)[pixel].astype(np.float64)
