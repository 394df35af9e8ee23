"""Interpolation of samples, without the modules of scipy for it: their imports take longer than what is interpolated here."""

from __future__ import annotations

import numpy as np


def monotone_cubic(knots: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate by piecewise cubics without overshoot (PCHIP), along the first axis.

    Slopes at the knots are the weighted harmonic means of the differences beside them, and zero at extrema
    (Fritsch & Butland 1984, doi:10.1137/0905021); at the ends they follow from three points.

    Parameters
    ----------
    knots
        ``(N,)`` increasing, N ≥ 2.
    values
        ``(N, ...)``.
    at
        ``(M,)`` places between the first and the last knot; cubics of the ends continue beyond.

    Returns
    -------
    numpy.ndarray
        ``(M, ...)`` float64; equal to ``scipy.interpolate.PchipInterpolator(knots, values)(at)``.

    Raises
    ------
    ValueError
        Fewer than two knots, knots that do not increase, or another number of values.

    Examples
    --------
    >>> import numpy as np
    >>> from seasonscapes.terrain.interpolation import monotone_cubic
    >>> monotone_cubic(np.arange(4.0), np.array([0.0, 0.0, 1.0, 1.0]), np.array([0.5, 1.5, 2.5]))
    array([0. , 0.5, 1. ])
    """
    knots, values = np.asarray(knots, float), np.asarray(values, float)
    if len(knots) < 2 or len(values) != len(knots) or not (np.diff(knots) > 0.0).all():
        raise ValueError(
            f"monotone_cubic: got {len(knots)} knots and {len(values)} values, expected as many of both, two at least, and increasing knots"
        )
    width = np.diff(knots).reshape(-1, *(1,) * (values.ndim - 1))
    chord = np.diff(values, axis=0) / width
    slope = _slopes(width, chord)
    cell = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    t = (np.asarray(at, float) - knots[cell]).reshape(-1, *(1,) * (values.ndim - 1))
    # Coefficients of powers of the distance from the knot below, by Hermite's conditions.
    curvature = (slope[:-1] + slope[1:] - 2.0 * chord) / width
    square, cube = (chord - slope[:-1]) / width - curvature, curvature / width
    result = cube[cell]
    for coefficient in (square, slope, values):
        result *= t
        result += coefficient[cell]
    return result


def _slopes(width: np.ndarray, chord: np.ndarray) -> np.ndarray:
    """Slopes ``(N, ...)`` at knots, from the ``(N - 1, ...)`` widths between them and slopes of the chords."""
    if len(chord) == 1:
        return np.concatenate([chord, chord])
    low, high = 2.0 * width[1:] + width[:-1], width[1:] + 2.0 * width[:-1]
    monotone = chord[:-1] * chord[1:] > 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        inner = np.where(monotone, (low + high) / (low / chord[:-1] + high / chord[1:]), 0.0)
    first = _end_slope(width[0], width[1], chord[0], chord[1])
    last = _end_slope(width[-1], width[-2], chord[-1], chord[-2])
    return np.concatenate([first[None], inner, last[None]])


def _end_slope(near: np.ndarray, far: np.ndarray, chord: np.ndarray, next_chord: np.ndarray) -> np.ndarray:
    """Slope at an end by the parabola of three points, limited so that the end cubic stays monotone."""
    slope = ((2.0 * near + far) * chord - near * next_chord) / (near + far)
    turned = (np.sign(chord) != np.sign(next_chord)) & (np.abs(slope) > 3.0 * np.abs(chord))
    return np.where(np.sign(slope) != np.sign(chord), 0.0, np.where(turned, 3.0 * chord, slope))


def bilinear(nodes: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Interpolate bilinearly between the nodes of a grid.

    Parameters
    ----------
    nodes
        ``(R, S, C)``, R and S ≥ 2.
    column, row
        ``(N,)`` places, whole numbers at the nodes; outside of the grid those of its border.

    Returns
    -------
    numpy.ndarray
        ``(N, C)`` float64.

    Examples
    --------
    >>> import numpy as np
    >>> from seasonscapes.terrain.interpolation import bilinear
    >>> bilinear(np.arange(4.0).reshape(2, 2, 1), np.array([0.5, 9.0]), np.array([0.0, 0.5]))
    array([[0.5],
           [2. ]])
    """
    rows, columns = nodes.shape[:2]
    column, row = np.clip(column, 0.0, columns - 1.0), np.clip(row, 0.0, rows - 1.0)
    left, above = np.minimum(column.astype(np.intp), columns - 2), np.minimum(row.astype(np.intp), rows - 2)
    across, down = (column - left)[:, None], (row - above)[:, None]
    flat, corner = nodes.reshape(rows * columns, -1), above * columns + left
    upper, lower = (flat[first] * (1.0 - across) + flat[first + 1] * across for first in (corner, corner + columns))
    return upper * (1.0 - down) + lower * down
