"""The part of a picture that shows something: without the black frame of stabilised or stamped pictures."""

from __future__ import annotations

import numpy as np

# Levels up to 5 of 255 in sRGB, as linear light: black after lossy compression.
_BLACK = 0.0016
# A row or column is frame where so much of it is black: stamped clocks and logos interrupt it.
_FRAME_SHARE = 0.7
_LEAST_CONTENT = 0.3


def picture_content(image: np.ndarray) -> np.ndarray:
    """Mask a black frame around a picture.

    Parameters
    ----------
    image
        Scene-linear ``(H, W, 3)``.

    Returns
    -------
    ndarray
        ``(H, W)`` bool, True inside the frame. All True where there is none, and where so much is black that it is the
        picture itself (a night).
    """
    black = image.max(axis=2) <= _BLACK
    rows = np.flatnonzero(black.mean(axis=1) < _FRAME_SHARE)
    content = np.ones(black.shape, bool)
    if not len(rows):
        return content
    columns = np.flatnonzero(black[rows[0] : rows[-1] + 1].mean(axis=0) < _FRAME_SHARE)
    if not len(columns):
        return content
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    if (bottom - top) * (right - left) < _LEAST_CONTENT * black.size:
        return content
    # Compression mixes the frame into the pixels at its edge.
    margin = 2 * np.array([top > 0, bottom < black.shape[0], left > 0, right < black.shape[1]])
    content[:] = False
    content[top + margin[0] : bottom - margin[1], left + margin[2] : right - margin[3]] = True
    return content
