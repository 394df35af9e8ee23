"""Hole filling of images without terrain data: Telea inpainting, the Laplace equation and push–pull pyramids."""

from __future__ import annotations

import cv2
import numpy as np

_SWEEPS = 40
_OVER_RELAXATION = 1.4
# Radius of the mean over known pixels that `propagate` extrapolates [px].
_MEAN_PX = 2.0


def telea_fill(
    values: np.ndarray, known: np.ndarray, *, radius_px: float = 3.0, flag: int = cv2.INPAINT_TELEA
) -> np.ndarray:
    """Fill holes by fast marching from their rims inwards (Telea 2004, doi:10.1080/10867651.2004.10487596).

    This is OpenCV's implementation, the reference that other methods are compared with.

    Parameters
    ----------
    values
        ``(H, W, C)``; ignored where not known.
    known
        ``(H, W)`` bool.
    radius_px
        Radius of the neighbourhood that contributes to a pixel [px].
    flag
        ``cv2.INPAINT_NS`` for the Navier–Stokes scheme of the same interface.

    Returns
    -------
    ndarray
        ``(H, W, C)`` float32; known pixels are unchanged.

    Raises
    ------
    ValueError
        No pixel is known.
    """
    if not known.any():
        raise ValueError("telea_fill: no known texel")
    hole = (~known).astype(np.uint8)
    low, high = float(values[known].min()), float(values[known].max())
    scale = 65_535.0 / max(high - low, 1e-12)
    # OpenCV 5.0 returns garbage for float images; 16 bits over the range of the known values are exact enough.
    levels = np.where(known[..., None], np.round((values - low) * scale), 0.0).astype(np.uint16)
    channels = [
        cv2.inpaint(np.ascontiguousarray(channel), hole, radius_px, flag) for channel in np.moveaxis(levels, -1, 0)
    ]
    filled = np.stack(channels, -1).astype(np.float32) / scale + low
    return np.where(known[..., None], values, filled).astype(np.float32)


def membrane_fill(values: np.ndarray, known: np.ndarray, *, sweeps: int = _SWEEPS) -> np.ndarray:
    """Fill holes with the solution of ∇²v = 0, known pixels fixed and the image border free (Neumann).

    Cascadic multigrid (Bornemann & Deuflhard 1996, Numerische Mathematik 75, 135): each level starts from the
    coarser one's solution and relaxes it by red–black Gauss–Seidel sweeps.

    Parameters
    ----------
    values
        ``(H, W, C)``; ignored where not known.
    known
        ``(H, W)`` bool.
    sweeps
        Relaxation sweeps per level.

    Returns
    -------
    ndarray
        ``(H, W, C)`` float32; known pixels are unchanged.

    Raises
    ------
    ValueError
        No pixel is known.
    """
    if not known.any():
        raise ValueError("membrane_fill: no known texel")
    return _solve_laplace(np.where(known[..., None], values, 0.0).astype(np.float32), known, sweeps)


def _solve_laplace(values: np.ndarray, known: np.ndarray, sweeps: int) -> np.ndarray:
    if known.all():
        return values
    height, width = known.shape
    if max(height, width) <= 2:
        return np.where(known[..., None], values, values[known].mean(axis=0))
    edge = ((0, height % 2), (0, width % 2))
    padded, padded_known = np.pad(values, (*edge, (0, 0))), np.pad(known, edge)
    shape = (padded.shape[0] // 2, 2, padded.shape[1] // 2, 2)
    count = padded_known.reshape(shape).sum(axis=(1, 3))
    coarse = padded.reshape(*shape, -1).sum(axis=(1, 3)) / np.maximum(count, 1)[..., None]
    coarse = _solve_laplace(coarse.astype(np.float32), count > 0, sweeps)
    up = cv2.resize(coarse, (2 * coarse.shape[1], 2 * coarse.shape[0]), interpolation=cv2.INTER_LINEAR)
    initial = np.where(known[..., None], values, up.reshape(*padded.shape)[:height, :width])
    return _relax(initial, ~known, sweeps)


def _relax(values: np.ndarray, hole: np.ndarray, sweeps: int) -> np.ndarray:
    """Over-relaxed red–black Gauss–Seidel sweeps over the pixels of the hole."""
    row, column = np.nonzero(hole)
    height, width = hole.shape
    flat = values.reshape(-1, values.shape[2])
    colours = []
    for parity in (0, 1):
        r, c = row[(row + column) % 2 == parity], column[(row + column) % 2 == parity]
        # Clipped indices make a border pixel its own neighbour: zero flux across the border.
        neighbours = [
            np.clip(r + dr, 0, height - 1) * width + np.clip(c + dc, 0, width - 1)
            for dr, dc in ((0, 1), (0, -1), (1, 0), (-1, 0))
        ]
        colours.append((r * width + c, np.stack(neighbours)))
    for _ in range(sweeps):
        for pixel, neighbours in colours:
            mean = flat[neighbours].mean(axis=0)
            flat[pixel] += _OVER_RELAXATION * (mean - flat[pixel])
    return flat.reshape(values.shape)


def push_pull(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Fill texels without weight from the next coarser level of a weighted mean pyramid.

    After Gortler et al. 1996, "The Lumigraph" (doi:10.1145/237170.237200).

    Parameters
    ----------
    values
        ``(H, W, C)``; ignored where the weight is 0.
    weight
        ``(H, W)`` in [0, 1]: 1 keeps the value.

    Returns
    -------
    ndarray
        ``(H, W, C)`` float32, finite everywhere if any weight is positive, 0 if none is.
    """
    weight = np.clip(np.asarray(weight, np.float32), 0.0, 1.0)
    known = weight > 0.0
    return _merged(_push_pull_level([np.where(known, plane, np.float32(0.0)) for plane in _planes(values)], weight))


def _planes(values: np.ndarray) -> list[np.ndarray]:
    """The channels of ``(H, W, C)`` float32, each contiguous: three channels side by side would be added three numbers at a time."""
    return list(cv2.split(np.ascontiguousarray(values, np.float32)))


def _merged(planes: list[np.ndarray]) -> np.ndarray:
    return cv2.merge(planes).reshape(*planes[0].shape, len(planes))


def _push_pull_level(planes: list[np.ndarray], weight: np.ndarray) -> list[np.ndarray]:
    if weight.min() >= 1.0 or max(weight.shape) <= 1:
        return planes
    height, width = weight.shape
    held = [plane * weight for plane in planes]
    share = _halved(weight)
    norm = np.maximum(share, np.float32(0.25e-6))
    coarse = _push_pull_level([_halved(plane) / norm for plane in held], np.minimum(4.0 * share, 1.0))
    size, missing = (2 * share.shape[1], 2 * share.shape[0]), 1.0 - weight
    filled = []
    for small, plane in zip(coarse, held, strict=True):
        up = cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)[:height, :width]
        up *= missing
        up += plane
        filled.append(up)
    return filled


def _halved(plane: np.ndarray) -> np.ndarray:
    """Means over 2 × 2 pixels, with zeros beyond the last row and column of an odd side."""
    height, width = plane.shape
    if height % 2 or width % 2:
        plane = cv2.copyMakeBorder(plane, 0, height % 2, 0, width % 2, cv2.BORDER_CONSTANT, value=0.0)
    return cv2.resize(plane, (plane.shape[1] // 2, plane.shape[0] // 2), interpolation=cv2.INTER_AREA)


def propagate(residual: np.ndarray, known: np.ndarray, *, reach_px: float = 12.0) -> np.ndarray:
    """Extrapolate a residual into holes, decaying with the distance d to the nearest known pixel as exp(−d / reach).

    Added to a model's prediction, it removes the seam at the rim of a hole and leaves the interior to the model. What is
    extrapolated is the residual's mean over a few known pixels: a single one, such as a boulder or a pixel that is half a roof,
    says nothing of the hole beside it, and would become a blot of its colour there.

    Parameters
    ----------
    residual
        ``(H, W, C)``; ignored where not known.
    known
        ``(H, W)`` bool.
    reach_px
        Decay length [px].

    Returns
    -------
    ndarray
        ``(H, W, C)`` float32, 0 everywhere where no pixel is known.
    """
    if known.all() or not known.any():
        return np.where(known[..., None], residual, 0.0).astype(np.float32)
    distance = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    decay = np.exp(-np.maximum(distance - 1.0, 0.0) / np.float32(reach_px))
    weight = known.astype(np.float32)
    share = np.maximum(cv2.GaussianBlur(weight, (0, 0), _MEAN_PX), 1e-6)
    planes = [np.where(known, plane, np.float32(0.0)) for plane in _planes(residual)]
    spread = _push_pull_level([cv2.GaussianBlur(plane, (0, 0), _MEAN_PX) / share for plane in planes], weight)
    for plane, filled in zip(planes, spread, strict=True):
        filled *= decay
        np.copyto(filled, plane, where=known)
    return _merged(spread)
