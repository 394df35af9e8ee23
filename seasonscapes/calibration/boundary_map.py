"""Likelihood of a skyline at each pixel of a photograph: an edge with a smooth region directly above it.

The measure is a difference of logarithms: the gradient magnitude at a pixel against the typical gradient magnitude in a
window just above it. A pale snow ridge under a bright cloud therefore scores as high as a dark one, and texture on the
ground scores low, because the window above it is textured too. No training and no sky segmentation are involved.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from seasonscapes.errors import NoUsablePixels

# Gradients below this value [Lab units per pixel] are sensor and compression noise.
_NOISE = 0.35
# Resolution of the coarse maps [px per degree]: fine enough for an initial pose, coarse enough for a fast search.
_PER_DEGREE = 10.0


@dataclass(frozen=True)
class BoundaryMap:
    """Edge likelihood at a coarse scale for the search and at full resolution for the refinement.

    Parameters
    ----------
    scale
        Coarse pixels per image pixel.
    coarse, coarse_edges
        ``(h, w)`` blurred likelihood in [0, 1] of a skyline and of any edge; NaN where masked.
    near
        ``(h, w)`` 1 where a distinct boundary lies within three coarse pixels, else 0; NaN where masked.
    fine, fine_edges
        ``(H, W)`` likelihood in [0, 1] of a skyline and of any edge at full resolution; 0 where masked.
    """

    scale: float
    coarse: np.ndarray
    coarse_edges: np.ndarray
    near: np.ndarray
    fine: np.ndarray
    fine_edges: np.ndarray


@dataclass(frozen=True)
class EdgeMatches:
    """Image edges found near K points of a projected line.

    Parameters
    ----------
    index
        Index ``(K,)`` of the matched points of the line.
    pixel
        Sub-pixel position ``(K, 2)`` of the edge.
    normal
        Unit vector ``(K, 2)`` across the line, along which the edge was searched.
    strength
        Edge likelihood ``(K,)`` in [0, 1].
    """

    index: np.ndarray
    pixel: np.ndarray
    normal: np.ndarray
    strength: np.ndarray


def detect_border_mask(encoded: np.ndarray) -> np.ndarray:
    """Detect a uniform border around an image (mount of a print, letterbox).

    Parameters
    ----------
    encoded
        Image ``(H, W, 3)`` uint8.

    Returns
    -------
    ndarray
        Mask ``(H, W)`` bool, False on the border and up to four pixels inside its edge.
    """
    corner = np.median(np.concatenate([encoded[:3, :3], encoded[-3:, -3:]]).reshape(-1, 3), axis=0)
    is_border_colour = np.abs(encoded.astype(np.int16) - corner).max(axis=-1) <= 12
    mask = np.ones(is_border_colour.shape, bool)
    for axis in (0, 1):
        fraction = is_border_colour.mean(axis=1 - axis)
        for order in (slice(None), slice(None, None, -1)):
            width = int(np.argmax(fraction[order] < 0.97)) if (fraction < 0.97).any() else 0
            if 2 <= width < 0.25 * len(fraction):
                border = np.arange(len(fraction))[order][: width + 4]
                mask[(border, slice(None)) if axis == 0 else (slice(None), border)] = False
    return mask


def boundary_map(encoded: np.ndarray, mask: np.ndarray | None, pixels_per_degree: float) -> BoundaryMap:
    """Compute the edge likelihood of an image.

    Parameters
    ----------
    encoded
        Image ``(H, W, 3)`` uint8 sRGB.
    mask
        ``(H, W)`` bool, False where foreground occludes the landscape; `detect_border_mask` if ``None``.
    pixels_per_degree
        Angular resolution of the image [px/°].

    Returns
    -------
    BoundaryMap
        Coarse and full-resolution maps.

    Raises
    ------
    NoUsablePixels
        If the mask leaves less than 5 % of the image.
    ValueError
        If the image or the mask has the wrong shape or type.
    """
    mask = detect_border_mask(encoded) if mask is None else np.asarray(mask, bool)
    if encoded.ndim != 3 or encoded.dtype != np.uint8:
        raise ValueError(f"boundary_map: got {encoded.dtype} {encoded.shape}, expected (H, W, 3) uint8")
    if mask.shape != encoded.shape[:2]:
        raise ValueError(f"boundary_map: got a mask {mask.shape}, expected {encoded.shape[:2]} as the image")
    if mask.mean() < 0.05:
        raise NoUsablePixels(
            f"boundary_map: the mask leaves {100 * mask.mean():.0f} % of the image, expected at least 5 %"
        )
    scale = min(1.0, _PER_DEGREE / pixels_per_degree)
    small = cv2.resize(encoded, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    usable_small = cv2.resize(mask.astype(np.uint8), small.shape[1::-1], interpolation=cv2.INTER_AREA) > 0
    # The outline of a mask is itself an edge in the image; pixels close to it are not used.
    usable_small = cv2.erode(usable_small.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=1) > 0
    usable = cv2.erode(mask.astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=1) > 0
    border, edge = _edge_likelihood(small, 1.0)
    thin, thin_edge = _thin(border), _thin(edge)
    near = cv2.dilate((thin > 0.4).astype(np.float32), np.ones((7, 3), np.uint8))
    fine, fine_edge = _edge_likelihood(encoded, 1.0 / scale)
    coarse, coarse_edge = _blurred(thin), _blurred(thin_edge)
    for values in (coarse, coarse_edge, near):
        values[~usable_small] = np.nan
    return BoundaryMap(scale, coarse, coarse_edge, near, np.where(usable, fine, 0.0), np.where(usable, fine_edge, 0.0))


def _edge_likelihood(encoded: np.ndarray, zoom: float) -> tuple[np.ndarray, np.ndarray]:
    """Skyline and edge likelihood ``(H, W)`` in [0, 1]; ``zoom`` is the size of the image over the coarse size."""
    lab = cv2.cvtColor(encoded.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    lab = cv2.GaussianBlur(lab, (0, 0), 1.2) * np.array([1.0, 1.5, 1.5], np.float32)
    gradient_x = cv2.Sobel(lab, cv2.CV_32F, 1, 0, scale=0.125 * zoom)
    gradient_y = cv2.Sobel(lab, cv2.CV_32F, 0, 1, scale=0.125 * zoom)
    strength = np.sqrt(np.sum(gradient_x**2 + gradient_y**2, axis=2))
    vertical = np.clip(1.5 * np.sqrt(np.sum(gradient_y**2, axis=2)) / np.maximum(strength, 1e-6), 0.0, 1.0)
    window, gap, side = max(3, int(0.05 * encoded.shape[0])), round(3 * zoom), 2 * round(2 * zoom) + 1
    # With a fourth-power mean, one distinct edge in the window suffices for a high texture value.
    texture = cv2.blur((strength + _NOISE) ** 4, (side, window), borderType=cv2.BORDER_REPLICATE) ** 0.25
    # The blur is centred, but the window must end `gap` rows above the pixel.
    shift = gap + window // 2
    above = np.log(np.vstack([np.repeat(texture[:1], shift, axis=0), texture[:-shift]]))
    level = np.log(strength + _NOISE)
    contrast = np.clip((level - above) / 2.2, 0.0, 1.0)
    border = contrast * vertical
    top = round(4 * zoom)
    border[:top] = 0.0
    typical = max(float(np.percentile(strength, 92)), 1.0)
    return border, np.clip(strength / typical, 0.0, 1.0) * vertical


def _thin(values: np.ndarray) -> np.ndarray:
    """Non-maximum suppression over five rows."""
    return np.where(values >= cv2.dilate(values, np.ones((5, 1), np.uint8)), values, 0.0).astype(np.float32)


def _blurred(thin: np.ndarray, sigma: float = 2.5) -> np.ndarray:
    """Gaussian blur, normalised so that a horizontal line of likelihood 1 keeps its maximum."""
    return np.minimum(cv2.GaussianBlur(thin, (0, 0), sigma) * (sigma * np.sqrt(2.0 * np.pi)), 1.0)


def edge_near(
    boundary: BoundaryMap,
    pixel: np.ndarray,
    front: np.ndarray,
    reach_px: np.ndarray,
    skyline: bool,
    *,
    least: float = 0.25,
) -> EdgeMatches | None:
    """Search the strongest edge across a projected line at each of its points.

    Parameters
    ----------
    boundary
        Edge likelihood of the image.
    pixel
        Points of the line ``(N, 2)`` in order [px].
    front
        ``(N,)`` bool, True where the point lies in front of the camera.
    reach_px
        Search distance ``(N,)`` to each side [px].
    skyline
        Whether the line is a skyline, searched across its own direction; other edges are searched vertically.
    least
        Minimum likelihood of an edge.

    Returns
    -------
    EdgeMatches or None
        Edges with sub-pixel positions (parabola through three samples); ``None`` if fewer than five are found.
    """
    values = boundary.fine if skyline else boundary.fine_edges
    height, width = values.shape
    inside = front & (pixel[:, 0] > 1) & (pixel[:, 0] < width - 1)
    inside &= (pixel[:, 1] > -reach_px) & (pixel[:, 1] < height + reach_px)
    index = np.flatnonzero(inside)
    if len(index) < 5:
        return None
    origin = pixel[index]
    normal = _line_normals(origin) if skyline else np.tile([0.0, 1.0], (len(origin), 1))
    reach = reach_px[index, None]
    unit = np.linspace(-1.0, 1.0, 2 * int(np.ceil(2.0 * reach.max())) + 1)
    offsets = reach * unit
    samples = (origin[:, None] + offsets[..., None] * normal[:, None] - 0.5).astype(np.float32)
    likelihood = cv2.remap(
        values.astype(np.float32),
        samples[..., 0],
        samples[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    weighted = likelihood * np.exp(-0.5 * (unit / 0.7) ** 2)
    best = np.clip(np.argmax(weighted, axis=1), 1, len(unit) - 2)
    rows = np.arange(len(best))
    left, middle, right = likelihood[rows, best - 1], likelihood[rows, best], likelihood[rows, best + 1]
    curvature = 2.0 * middle - left - right
    shift = np.where(curvature > 1e-4, 0.5 * (right - left) / np.maximum(curvature, 1e-4), 0.0)
    matched = middle > least
    if matched.sum() < 5:
        return None
    distance = offsets[rows, best] + reach[:, 0] * (unit[1] - unit[0]) * np.clip(shift, -1.0, 1.0)
    edge = origin + distance[:, None] * normal
    return EdgeMatches(index[matched], edge[matched], normal[matched], np.clip(middle[matched], 0.0, 1.0))


def _line_normals(pixel: np.ndarray) -> np.ndarray:
    """Unit normals ``(N, 2)`` of a polyline, from its direction over a few points; pointing down."""
    along = np.empty_like(pixel)
    span = 4
    along[span:-span] = pixel[2 * span :] - pixel[: -2 * span]
    along[:span], along[-span:] = along[span], along[-span - 1]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    # A jump from one ridge to another does not define a direction; a horizontal line is assumed.
    along = np.where((length > 0) & (length < 60.0), along / np.maximum(length, 1e-9), [1.0, 0.0])
    normal = np.stack([-along[:, 1], along[:, 0]], -1)
    return normal * np.where(normal[:, 1:] < 0, -1.0, 1.0)
