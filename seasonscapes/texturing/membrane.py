"""A membrane over the holes: Laplace's equation with what was painted as its rim."""

from __future__ import annotations

import cv2
import numpy as np

_SWEEPS = 40


def membrane_fill(values: np.ndarray, known: np.ndarray, *, sweeps: int = _SWEEPS) -> np.ndarray:
    """Holes as the solution of ∇²v = 0 with the known texels fixed and free outer edges.

    Cascadic multigrid (Bornemann & Deuflhard 1996, doi:10.1007/s002110050234): each level starts from the
    coarser one's solution and relaxes it by red–black Gauss–Seidel sweeps.

    Parameters
    ----------
    values
        ``(H, W, C)``; ignored where not known.
    known
        ``(H, W)`` bool.

    Raises
    ------
    ValueError
        Nothing is known.
    """
    if not known.any():
        raise ValueError("membrane_fill: no known texel")
    return _solved(np.where(known[..., None], values, 0.0).astype(np.float32), known, sweeps)


def _solved(values: np.ndarray, known: np.ndarray, sweeps: int) -> np.ndarray:
    if known.all():
        return values
    height, width = known.shape
    if max(height, width) <= 2:
        return np.where(known[..., None], values, values[known].mean(axis=0))
    edge = ((0, height % 2), (0, width % 2))
    padded, here = np.pad(values, (*edge, (0, 0))), np.pad(known, edge)
    shape = (padded.shape[0] // 2, 2, padded.shape[1] // 2, 2)
    count = here.reshape(shape).sum(axis=(1, 3))
    coarse = padded.reshape(*shape, -1).sum(axis=(1, 3)) / np.maximum(count, 1)[..., None]
    coarse = _solved(coarse.astype(np.float32), count > 0, sweeps)
    up = cv2.resize(coarse, (2 * coarse.shape[1], 2 * coarse.shape[0]), interpolation=cv2.INTER_LINEAR)
    guess = np.where(known[..., None], values, up.reshape(*padded.shape)[:height, :width])
    return _relaxed(guess, ~known, sweeps)


def _relaxed(values: np.ndarray, hole: np.ndarray, sweeps: int) -> np.ndarray:
    """Red–black Gauss–Seidel on the hole's texels, over-relaxed."""
    row, column = np.nonzero(hole)
    height, width = hole.shape
    flat = values.reshape(-1, values.shape[2])
    colours = []
    for parity in (0, 1):
        r, c = row[(row + column) % 2 == parity], column[(row + column) % 2 == parity]
        # Beyond the outer edge a texel sees itself: the edge is free.
        neighbours = [
            np.clip(r + dr, 0, height - 1) * width + np.clip(c + dc, 0, width - 1)
            for dr, dc in ((0, 1), (0, -1), (1, 0), (-1, 0))
        ]
        colours.append((r * width + c, np.stack(neighbours)))
    for _ in range(sweeps):
        for texel, neighbours in colours:
            mean = flat[neighbours].mean(axis=0)
            flat[texel] += 1.4 * (mean - flat[texel])
    return flat.reshape(values.shape)
