"""Clouds in a picture: before the terrain, where the sky goes on below the skyline, and in the sky itself."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

# Encoded values this near to the sky above are the sky's [largest channel].
_LIKE_SKY = 0.08
# The skyline is known to so many pixels for each 100 of the picture's width.
_SKYLINE_PER_100_PX = 0.6
# Width of the smoothing of the sky's colour, as a share of the picture's.
_SMOOTHING = 0.01
_NEIGHBOURS = np.ones((3, 3), bool)
# Excess of blue over red, over their sum, of encoded values: clouds of six cameras have -0.08 to 0.04, their clear skies 0.07 to 0.7.
_GREYER = 0.05
# A sky is judged where it covers so much of the picture, and so much of it is not clipped.
_LEAST_SKY, _LEAST_TOLD, _CLIPPED_SKY = 0.02, 0.25, 0.96
# A closed cloud layer: nearly all of the sky is grey, and nearly none so bright as about a sun behind thin cloud.
_CLOSED_GREY, _CLOSED_TOLD = 0.95, 0.9


def clouds_before(image: np.ndarray, terrain: np.ndarray) -> np.ndarray:
    """Where a picture shows sky before its terrain.

    Clouds that hang below the skyline have the brightness and colour of the sky right above it, and no edge towards it.
    Sunlit snow under a white sky looks alike: it is taken for cloud, since a picture so clipped tells nothing of it.

    Parameters
    ----------
    image
        ``(H, W, 3)`` sRGB-encoded, in [0, 1].
    terrain
        ``(H, W)`` bool: pixels that terrain covers.

    Returns
    -------
    numpy.ndarray
        ``(H, W)`` bool: terrain that clouds hide.
    """
    reach, sky = _skyline_reach(terrain), sky_above(terrain)
    if not sky.any():
        return np.zeros_like(terrain)
    nearest = np.zeros((2, *sky.shape), np.int32)
    ndimage.distance_transform_edt(~sky, return_distances=False, return_indices=True, indices=nearest)
    width = _SMOOTHING * image.shape[1]
    above = np.stack([ndimage.gaussian_filter(image[..., c][tuple(nearest)], width) for c in range(3)], axis=-1)
    like = np.abs(image - above).max(axis=-1) < _LIKE_SKY
    labels = np.zeros(sky.shape, np.int32)
    ndimage.label(like | sky, _NEIGHBOURS, output=labels)
    reached = np.isin(labels, np.unique(labels[sky]))
    # A cloud's fringe is neither sky nor ground.
    return ndimage.binary_dilation(reached & like, _NEIGHBOURS, iterations=reach) & terrain


def grey_share(image: np.ndarray, sky: np.ndarray) -> float | None:
    """Share of a picture's sky that is as grey as clouds.

    A clear sky is bluer than what it lights, clouds are not: their red is nearly as bright as their blue, by which cameras of the
    whole sky tell them apart (Long et al. 2006, doi:10.1175/JTECH1875.1).

    Parameters
    ----------
    image
        ``(H, W, 3)`` sRGB-encoded, in [0, 1].
    sky
        ``(H, W)`` bool: pixels of the sky.

    Returns
    -------
    float or None
        0 to 1; ``None`` where too little of the sky is seen, or nearly all of it is clipped and tells nothing.

    Examples
    --------
    >>> import numpy as np
    >>> half = np.where(np.arange(8)[:, None, None] < 4, [0.4, 0.5, 0.8], [0.7, 0.7, 0.71]) * np.ones((8, 8, 1))
    >>> grey_share(half, np.ones((8, 8), bool))
    0.5
    """
    values = image[sky]
    told = values[values.min(axis=1) < _CLIPPED_SKY]
    if sky.mean() < _LEAST_SKY or len(told) < _LEAST_TOLD * len(values):
        return None
    red, blue = told[:, 0], told[:, 2]
    return float(np.mean((blue - red) / np.maximum(blue + red, 1e-6) < _GREYER))


def closed_clouds(image: np.ndarray, sky: np.ndarray) -> bool:
    """Whether a picture's sky is a closed layer of clouds, through which the sun throws no shadows.

    Parameters
    ----------
    image, sky
        As in `grey_share`.

    Examples
    --------
    >>> import numpy as np
    >>> closed_clouds(np.full((8, 8, 3), 0.7), np.ones((8, 8), bool))
    True
    """
    grey = grey_share(image, sky)
    told = float(np.mean(image[sky].min(axis=1) < _CLIPPED_SKY)) if sky.any() else 0.0
    return grey is not None and grey >= _CLOSED_GREY and told >= _CLOSED_TOLD


def sky_above(terrain: np.ndarray) -> np.ndarray:
    """Pixels ``(H, W)`` bool of a picture that are surely sky, for the pixels that terrain covers ``(H, W)`` bool."""
    return np.logical_not(ndimage.binary_dilation(terrain, _NEIGHBOURS, iterations=_skyline_reach(terrain)))


def _skyline_reach(terrain: np.ndarray) -> int:
    return max(1, round(_SKYLINE_PER_100_PX * terrain.shape[1] / 100.0))
