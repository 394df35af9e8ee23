"""How well each pixel of a photograph would serve as the border of a landscape: an edge with calm air right above it.

A contrast of logarithms: the gradient at a pixel against the usual gradient in a window just above. It makes the pale
snow ridge under a bright cloud count as much as a dark one, and pattern inside the ground count little, since there the
window above is patterned too. Nothing is learned and nothing is cut out.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

# Gradients below this [Lab units a pixel] are sensor and compression noise.
_NOISE = 0.35
# Pixels of the working picture in a degree of view: fine enough for a start, coarse enough to be quick.
_PER_DEGREE = 10.0


@dataclass(frozen=True)
class BoundaryMap:
    """Evidence for boundaries, at a working scale for the search and in full for the refinement.

    Parameters
    ----------
    scale
        Working pixels per picture pixel.
    coarse, coarse_edges
        ``(h, w)`` tolerant evidence in [0, 1] for a skyline and for any edge; NaN where masked.
    near
        ``(h, w)`` 1 where a distinct boundary lies within three working pixels, 0 elsewhere; NaN where masked.
    fine, fine_edges
        ``(H, W)`` evidence in [0, 1] of full resolution; 0 where masked.
    """

    scale: float
    coarse: np.ndarray
    coarse_edges: np.ndarray
    near: np.ndarray
    fine: np.ndarray
    fine_edges: np.ndarray


def picture_area(encoded: np.ndarray) -> np.ndarray:
    """Mask ``(H, W)`` without a uniform frame around a picture ``(H, W, 3)`` uint8 (card, letterbox)."""
    corner = np.median(np.concatenate([encoded[:3, :3], encoded[-3:, -3:]]).reshape(-1, 3), axis=0)
    same = np.abs(encoded.astype(np.int16) - corner).max(axis=-1) <= 12
    mask = np.ones(same.shape, bool)
    for axis in (0, 1):
        share = same.mean(axis=1 - axis)
        for order in (slice(None), slice(None, None, -1)):
            run = int(np.argmax(share[order] < 0.97)) if (share < 0.97).any() else 0
            if 2 <= run < 0.25 * len(share):
                # A few pixels of the frame's own edge go too.
                cut = np.arange(len(share))[order][: run + 4]
                mask[(cut, slice(None)) if axis == 0 else (slice(None), cut)] = False
    return mask


def boundary_map(encoded: np.ndarray, mask: np.ndarray | None, pixels_per_degree: float) -> BoundaryMap:
    """Evidence of a picture ``(H, W, 3)`` uint8 sRGB; ``mask`` ``(H, W)`` False before the landscape, or ``None``."""
    mask = picture_area(encoded) if mask is None else np.asarray(mask, bool)
    if encoded.ndim != 3 or encoded.dtype != np.uint8:
        raise ValueError(f"boundary_map: got {encoded.dtype} {encoded.shape}, expected (H, W, 3) uint8")
    if mask.shape != encoded.shape[:2] or mask.mean() < 0.05:
        raise ValueError(f"boundary_map: the mask {mask.shape} leaves {100 * mask.mean():.0f} % of {encoded.shape[:2]}")
    scale = min(1.0, _PER_DEGREE / pixels_per_degree)
    small = cv2.resize(encoded, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    open_small = cv2.resize(mask.astype(np.uint8), small.shape[1::-1], interpolation=cv2.INTER_AREA) > 0
    # The frame of a mask is itself an edge: what is close to it says nothing.
    open_small = cv2.erode(open_small.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=1) > 0
    open_full = cv2.erode(mask.astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=1) > 0
    border, edge = _evidence(small, 1.0)
    thin, thin_edge = _thin(border), _thin(edge)
    near = cv2.dilate((thin > 0.4).astype(np.float32), np.ones((7, 3), np.uint8))
    fine, fine_edge = _evidence(encoded, 1.0 / scale)
    hidden = ~open_small
    maps = [_tolerant(thin), _tolerant(thin_edge), near]
    for values in maps:
        values[hidden] = np.nan
    return BoundaryMap(scale, *maps, np.where(open_full, fine, 0.0), np.where(open_full, fine_edge, 0.0))


def _evidence(encoded: np.ndarray, zoom: float) -> tuple[np.ndarray, np.ndarray]:
    """Skyline and edge evidence ``(H, W)`` in [0, 1]; ``zoom`` says how much larger than working size the picture is."""
    lab = cv2.cvtColor(encoded.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    lab = cv2.GaussianBlur(lab, (0, 0), 1.2) * np.float32([1.0, 1.5, 1.5])
    across = cv2.Sobel(lab, cv2.CV_32F, 1, 0, scale=0.125 * zoom)
    down = cv2.Sobel(lab, cv2.CV_32F, 0, 1, scale=0.125 * zoom)
    strength = np.sqrt(np.sum(across**2 + down**2, axis=2))
    upright = np.clip(1.5 * np.sqrt(np.sum(down**2, axis=2)) / np.maximum(strength, 1e-6), 0.0, 1.0)
    window, gap, side = max(3, int(0.05 * encoded.shape[0])), round(3 * zoom), 2 * round(2 * zoom) + 1
    # A fourth-power mean: one distinct edge within the window is enough to make it unquiet.
    unquiet = cv2.blur((strength + _NOISE) ** 4, (side, window), borderType=cv2.BORDER_REPLICATE) ** 0.25
    # The blur is centred; the window has to end `gap` rows above the pixel.
    shift = gap + window // 2
    above = np.log(np.vstack([np.repeat(unquiet[:1], shift, axis=0), unquiet[:-shift]]))
    level = np.log(strength + _NOISE)
    contrast = np.clip((level - above) / 2.2, 0.0, 1.0)
    border = contrast * upright
    top = round(4 * zoom)
    border[:top] = 0.0
    typical = max(float(np.percentile(strength, 92)), 1.0)
    return border, np.clip(strength / typical, 0.0, 1.0) * upright


def _thin(values: np.ndarray) -> np.ndarray:
    """Only the strongest of five rows stays."""
    return np.where(values >= cv2.dilate(values, np.ones((5, 1), np.uint8)), values, 0.0).astype(np.float32)


def _tolerant(thin: np.ndarray, sigma: float = 2.5) -> np.ndarray:
    """A line of full strength spreads into a ridge of height one."""
    return np.minimum(cv2.GaussianBlur(thin, (0, 0), sigma) * (sigma * np.sqrt(2.0 * np.pi)), 1.0)


def edge_near(
    boundary: BoundaryMap,
    pixel: np.ndarray,
    front: np.ndarray,
    reach_px: np.ndarray,
    skyline: bool,
    *,
    least: float = 0.25,
):
    """Edges beside the points of a projected line, across its course, up to ``reach_px`` ``(N,)`` away.

    Returns index ``(K,)`` of the points that met one, where it is ``(K, 2)``, the direction across ``(K, 2)`` and its
    strength ``(K,)``; ``None`` where none did.
    """
    values = boundary.fine if skyline else boundary.fine_edges
    height, width = values.shape
    inside = front & (pixel[:, 0] > 1) & (pixel[:, 0] < width - 1)
    inside &= (pixel[:, 1] > -reach_px) & (pixel[:, 1] < height + reach_px)
    index = np.flatnonzero(inside)
    if len(index) < 5:
        return None
    place = pixel[index]
    normal = _across(place) if skyline else np.tile([0.0, 1.0], (len(place), 1))
    reach = reach_px[index, None]
    unit = np.linspace(-1.0, 1.0, 2 * int(np.ceil(2.0 * reach.max())) + 1)
    offsets = reach * unit
    samples = (place[:, None] + offsets[..., None] * normal[:, None] - 0.5).astype(np.float32)
    found = cv2.remap(
        values.astype(np.float32),
        samples[..., 0],
        samples[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    ranked = found * np.exp(-0.5 * (unit / 0.7) ** 2)
    best = np.clip(np.argmax(ranked, axis=1), 1, len(unit) - 2)
    rows = np.arange(len(best))
    left, middle, right = found[rows, best - 1], found[rows, best], found[rows, best + 1]
    bend = 2.0 * middle - left - right
    shift = np.where(bend > 1e-4, 0.5 * (right - left) / np.maximum(bend, 1e-4), 0.0)
    met = middle > least
    if met.sum() < 5:
        return None
    distance = offsets[rows, best] + reach[:, 0] * (unit[1] - unit[0]) * np.clip(shift, -1.0, 1.0)
    target = place + distance[:, None] * normal
    return index[met], target[met], normal[met], np.clip(middle[met], 0.0, 1.0)


def _across(place: np.ndarray) -> np.ndarray:
    """Unit vectors across a line of points in order, from its course over a few pixels; pointing down."""
    along = np.empty_like(place)
    span = 4
    along[span:-span] = place[2 * span :] - place[: -2 * span]
    along[:span], along[-span:] = along[span], along[-span - 1]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    # A jump from one ridge to another is no course.
    along = np.where((length > 0) & (length < 60.0), along / np.maximum(length, 1e-9), [1.0, 0.0])
    normal = np.stack([-along[:, 1], along[:, 0]], -1)
    return normal * np.where(normal[:, 1:] < 0, -1.0, 1.0)
