"""Splats to pixels: project discs, find the pixels under each, blend front to back. One interface, three homes.

* training: here, in plain torch. Pairs of (pixel, splat) are listed exactly, row by row of each ellipse, then brought
  from depth order into pixel order by one counting sort. Gradients by autograd.
* pictures alone: `rendering.splatting`, several times faster; on CUDA gsplat, in `rasterise_cuda`.
* the oracle: `rasterise_reference`, slow and obvious.

Where the geometry is frozen a view is a sparse matrix, pixels × splats: `view_weights` makes it once, and every colour
after that costs one product.

The splats are those of Kerbl et al. 2023, "3D Gaussian splatting", doi:10.1145/3592433 (projection after Zwicker et al.
2001, doi:10.1109/VISUAL.2001.964490).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.splatting import finer_camera

# Opacity under which a splat is not drawn, as in 3DGS; 0 switches the cut off (and the speed with it).
ALPHA_CUT = 1.0 / 255.0
ALPHA_MOST = 0.999
# Variance of the pixel itself [px²], added to each splat so that the smallest do not fall between pixels; more only blurs.
PIXEL_VARIANCE = 0.02
# Nothing is drawn nearer than this [m].
NEAR_M = 1.0
# What shines through less than this is not worth a weight.
TRANSMITTANCE_CUT = 1e-4


class Splats(NamedTuple):
    """N Gaussians as tensors: ``means (N, 3)`` relative to the camera's world, ``quaternions (N, 4)`` wxyz,
    ``log_scales (N, 3)``, ``opacity_logits (N,)``."""

    means: torch.Tensor
    quaternions: torch.Tensor
    log_scales: torch.Tensor
    opacity_logits: torch.Tensor


class Projected(NamedTuple):
    """n splats in the picture, nearest first: ``index (n,)`` among the N, ``centre (n, 2)`` [px], ``conic (n, 3)`` (the
    inverse covariance's xx, xy, yy), ``opacity (n,)``, ``variance_y (n,)`` [px²], ``depth (n,)`` along the axis [m]."""

    index: torch.Tensor
    centre: torch.Tensor
    conic: torch.Tensor
    opacity: torch.Tensor
    variance_y: torch.Tensor
    depth: torch.Tensor


@dataclass(frozen=True)
class ViewWeights:
    """How much of each splat each pixel shows; frozen geometry under any colours.

    Parameters
    ----------
    matrix
        Sparse ``(H W, N)`` float32, CSR.
    width_px, height_px
        Size of the picture.
    """

    matrix: object
    width_px: int
    height_px: int

    @property
    def coverage(self) -> np.ndarray:
        """Share ``(H, W)`` of each pixel that splats cover."""
        return np.asarray(self.matrix.sum(axis=1), np.float32).reshape(self.height_px, self.width_px)


def choose_threads(threads: int = 1) -> None:
    """Say how many threads torch may use. Never inherited: idle ones spin, and two were 10 to 30 times slower than one."""
    torch.set_num_threads(threads)


def splats_from(
    means: np.ndarray, quaternions: np.ndarray, log_scales: np.ndarray, opacity_logits: np.ndarray
) -> Splats:
    """Tensors of numpy arrays; `ValueError` where a value is not finite or a shape is wrong."""
    count = len(means)
    wanted = {"means": (count, 3), "quaternions": (count, 4), "log_scales": (count, 3), "opacity_logits": (count,)}
    for (name, shape), values in zip(wanted.items(), (means, quaternions, log_scales, opacity_logits), strict=True):
        if np.shape(values) != shape:
            raise ValueError(f"{name}: got shape {np.shape(values)}, expected {shape}")
        if not np.isfinite(values).all():
            raise ValueError(f"{name}: {int(np.sum(~np.isfinite(values)))} values are not finite")
    columns = (means, quaternions, log_scales, opacity_logits)
    return Splats(*(torch.as_tensor(np.ascontiguousarray(values, np.float32)) for values in columns))


def rotations(quaternions: torch.Tensor) -> torch.Tensor:
    """Rotations ``(N, 3, 3)`` of quaternions ``(N, 4)`` wxyz of any length."""
    w, x, y, z = (quaternions / quaternions.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, dim=1).reshape(-1, 3, 3)


def camera_tensors(camera: Camera, like: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotation ``(3, 3)`` into camera axes and the camera's position ``(3,)``."""
    pose = torch.as_tensor(camera.world_from_camera, dtype=torch.float64)
    return pose[:3, :3].T.to(like), pose[:3, 3].to(like)


def project_splats(
    splats: Splats, camera: Camera, *, alpha_cut: float = ALPHA_CUT, pixel_variance: float = PIXEL_VARIANCE
) -> Projected:
    """The splats that may be seen, nearest first (ties by number), with their ellipses in the picture."""
    turn, position = camera_tensors(camera, splats.means)
    with torch.no_grad():
        index = _candidates(splats, camera, turn, position, alpha_cut)
    local = (splats.means[index] - position) @ turn.T
    x, y, z = local.unbind(1)
    # As 3DGS does, the slope of the projection is taken no further out than a third past the picture's rim.
    limit_x, limit_y = 1.3 * 0.5 * camera.width_px / camera.fx, 1.3 * 0.5 * camera.height_px / camera.fy
    u, v = (x / z).clamp(-limit_x, limit_x), (y / z).clamp(-limit_y, limit_y)
    spread = turn @ (rotations(splats.quaternions[index]) * splats.log_scales[index].exp()[:, None, :])
    across = camera.fx / z[:, None] * (spread[:, 0] - u[:, None] * spread[:, 2])
    down = camera.fy / z[:, None] * (spread[:, 1] - v[:, None] * spread[:, 2])
    xx, xy, yy = ((a * b).sum(1) for a, b in ((across, across), (across, down), (down, down)))
    xx, yy = xx + pixel_variance, yy + pixel_variance
    determinant = xx * yy - xy * xy
    conic = torch.stack([yy, -xy, xx], dim=1) / determinant[:, None]
    centre = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
    opacity = torch.sigmoid(splats.opacity_logits[index])
    return Projected(index, centre, conic, opacity, yy, z)


def _candidates(
    splats: Splats, camera: Camera, turn: torch.Tensor, position: torch.Tensor, alpha_cut: float
) -> torch.Tensor:
    """Numbers of the splats in front of the camera and near the picture, nearest first; ties keep their order."""
    local = (splats.means - position) @ turn.T
    x, y, z = local.unbind(1)
    keep = z > NEAR_M
    if alpha_cut > 0.0:
        # A sphere of four standard deviations around the centre, against the four sides of the view.
        reach = 4.0 * splats.log_scales.amax(dim=1).exp()
        for along, focal, low, high in (
            (x, camera.fx, -camera.cx, camera.width_px - camera.cx),
            (y, camera.fy, -camera.cy, camera.height_px - camera.cy),
        ):
            for bound, side in ((low - 2.0, 1.0), (high + 2.0, -1.0)):
                slope = bound / focal
                keep &= side * (along - slope * z) > -reach * (1.0 + slope * slope) ** 0.5
    index = keep.nonzero().squeeze(1)
    return index[torch.argsort(z[index], stable=True)]


class Pairs(NamedTuple):
    """K pairs in pixel order, nearest first within a pixel: ``splat (K,)`` among the projected, ``weight (K,)``, and
    ``start (H W + 1,)`` where each pixel's pairs begin."""

    splat: torch.Tensor
    weight: torch.Tensor
    start: torch.Tensor


def blend_pairs(seen: Projected, width_px: int, height_px: int, *, alpha_cut: float = ALPHA_CUT) -> Pairs:
    """Weights of front-to-back blending; differentiable in what was projected."""
    with torch.no_grad():
        splat, pixel = _pairs_in_depth_order(seen, width_px, height_px, alpha_cut)
        row = torch.div(pixel, width_px, rounding_mode="floor")
        x, y = (pixel - row * width_px).to(seen.centre.dtype) + 0.5, row.to(seen.centre.dtype) + 0.5
        order, start = _to_pixel_order(pixel, width_px * height_px)
    # While still in depth order, neighbours in memory are neighbours in the picture; only α is then carried over.
    columns = (*seen.centre.unbind(1), *seen.conic.unbind(1), seen.opacity)
    centre_x, centre_y, xx, xy, yy, opacity = (column.index_select(0, splat) for column in columns)
    dx, dy = x - centre_x, y - centre_y
    power = -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy
    alpha = (opacity * power.exp()).clamp(max=ALPHA_MOST).index_select(0, order)
    splat = splat.index_select(0, order)
    # Sums of logarithms over all pairs at once: in double precision, as millions of them add up.
    through = torch.cumsum(torch.log1p(-alpha), 0, dtype=torch.float64)
    before = torch.cat([through.new_zeros(1), through])
    first = before.index_select(0, start[:-1]).repeat_interleave(start.diff())
    weight = alpha * (before[:-1] - first).to(alpha.dtype).exp()
    return Pairs(splat, weight, start)


def _pairs_in_depth_order(
    seen: Projected, width_px: int, height_px: int, alpha_cut: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Splat and pixel of every pair with α above the cut: the exact run of pixels of each ellipse in each row."""
    count = len(seen.index)
    if alpha_cut <= 0.0:
        pixel = torch.arange(width_px * height_px)
        return torch.arange(count).repeat_interleave(len(pixel)), pixel.repeat(count)
    centre_x, centre_y = seen.centre.unbind(1)
    a, b, c = seen.conic.unbind(1)
    reach = 2.0 * torch.log((seen.opacity / alpha_cut).clamp(min=1.0))
    half = (reach * seen.variance_y).sqrt()
    top = (centre_y - half - 0.5).ceil().clamp(0, height_px).int()
    bottom = ((centre_y + half - 0.5).floor() + 1).clamp(0, height_px).int()
    rows = (bottom - top).clamp(min=0)
    splat = torch.arange(count, dtype=torch.int32).repeat_interleave(rows)
    row = (
        torch.arange(len(splat), dtype=torch.int32)
        - (rows.cumsum(0) - rows).int().index_select(0, splat)
        + top.index_select(0, splat)
    )
    facts = [column.index_select(0, splat) for column in (centre_x, centre_y, a, b, c, reach)]
    dy = row + 0.5 - facts[1]
    slant = facts[3] * dy
    square = (slant * slant - facts[2] * (facts[4] * dy * dy - facts[5])).clamp(min=0.0).sqrt()
    left = ((-slant - square) / facts[2] + facts[0] - 0.5).ceil().clamp(0, width_px).int()
    right = (((-slant + square) / facts[2] + facts[0] - 0.5).floor() + 1).clamp(0, width_px).int()
    length = (right - left).clamp(min=0)
    first = row * width_px + left - (length.cumsum(0) - length).int()
    pixel = first.repeat_interleave(length)
    pixel += torch.arange(len(pixel), dtype=torch.int32)
    return splat.repeat_interleave(length), pixel


def _to_pixel_order(pixel: torch.Tensor, pixels: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A stable order by pixel and each pixel's start, by counting: pairs come in depth order and stay in it."""
    from scipy import sparse

    count = len(pixel)
    entries = (np.arange(1, count + 1, dtype=np.int32), (pixel.numpy(), np.zeros(count, np.int32)))
    table = sparse.coo_array(entries, shape=(pixels, 1))
    table.has_canonical_format = True  # else equal entries would be summed
    table = table.tocsr()
    return torch.from_numpy(table.data) - 1, torch.from_numpy(table.indptr.astype(np.int64))


def rasterise(
    splats: Splats,
    colours: torch.Tensor,
    camera: Camera,
    *,
    alpha_cut: float = ALPHA_CUT,
    pixel_variance: float = PIXEL_VARIANCE,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Blend colours ``(N, C)`` front to back over black: picture ``(H, W, C)`` and coverage ``(H, W)``.

    Differentiable in geometry, opacity and colour; the order of the splats, and which pixels the cut leaves out, are
    taken as given.

    Raises
    ------
    ValueError
        Where the colours' number is not the splats'.
    """
    if len(colours) != len(splats.means):
        raise ValueError(f"colours: got {len(colours)}, expected {len(splats.means)}, one for each splat")
    seen = project_splats(splats, camera, alpha_cut=alpha_cut, pixel_variance=pixel_variance)
    pairs = blend_pairs(seen, camera.width_px, camera.height_px, alpha_cut=alpha_cut)
    pixel = torch.arange(camera.width_px * camera.height_px).repeat_interleave(pairs.start.diff())
    channels = torch.cat([colours, colours.new_ones(len(colours), 1)], dim=1).index_select(
        0, seen.index.index_select(0, pairs.splat)
    )
    flat = channels.new_zeros(camera.width_px * camera.height_px, channels.shape[1])
    flat = flat.index_add(0, pixel, pairs.weight[:, None] * channels)
    image = flat.reshape(camera.height_px, camera.width_px, -1)
    return image[..., :-1], image[..., -1]


@torch.no_grad()
def view_weights(
    splats: Splats, camera: Camera, *, subpixels: int = 1, pixel_variance: float = PIXEL_VARIANCE
) -> ViewWeights:
    """The sparse matrix of a view whose geometry is frozen; weights behind a closed front are left out.

    Parameters
    ----------
    subpixels
        Samples along a pixel's side: 2 makes edges and steep ground about 1 dB truer, at four times the work.
    """
    from scipy import sparse

    fine = finer_camera(camera, subpixels)
    seen = project_splats(splats, fine, pixel_variance=pixel_variance)
    pairs = blend_pairs(seen, fine.width_px, fine.height_px)
    columns = seen.index.to(torch.int32).index_select(0, pairs.splat).numpy()
    weight, start = pairs.weight.numpy(), pairs.start.numpy()
    keep = weight > TRANSMITTANCE_CUT
    start = np.concatenate([[0], np.cumsum(keep, dtype=np.int64)])[start].astype(np.int32)
    shape = (fine.width_px * fine.height_px, len(splats.means))
    matrix = sparse.csr_array((weight[keep], columns[keep], start), shape=shape)
    if subpixels > 1:
        matrix = _pooled(matrix, camera, subpixels)
    return ViewWeights(matrix, camera.width_px, camera.height_px)


def _pooled(matrix, camera: Camera, subpixels: int):
    """Rows of the pixels from rows of their samples: means, entries of one splat added up."""
    from scipy import sparse

    width = camera.width_px * subpixels
    row, column = np.divmod(np.arange(matrix.shape[0], dtype=np.int32), np.int32(width))
    pixel = (row // subpixels) * np.int32(camera.width_px) + column // subpixels
    entries = (matrix.data / np.float32(subpixels**2), (np.repeat(pixel, np.diff(matrix.indptr)), matrix.indices))
    return sparse.coo_array(entries, shape=(camera.width_px * camera.height_px, matrix.shape[1])).tocsr()


def splat_colours(weights: ViewWeights, colours: np.ndarray) -> np.ndarray:
    """Picture ``(H, W, C)`` of colours ``(N, C)`` through the weights of a view."""
    flat = weights.matrix @ np.ascontiguousarray(colours, np.float32)
    return flat.reshape(weights.height_px, weights.width_px, -1)
