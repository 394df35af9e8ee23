"""Clouds before the terrain of a picture: where the terrain should be and the sky goes on."""

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
    reach = max(1, round(_SKYLINE_PER_100_PX * image.shape[1] / 100.0))
    sky = np.logical_not(ndimage.binary_dilation(terrain, _NEIGHBOURS, iterations=reach))
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
