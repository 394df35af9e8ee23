"""Differentiable rasterisation of Gaussian splats in torch: projection, pixel coverage, front-to-back blending.

Implementations of the same interface:

* this module, for training: pairs of (pixel, splat) are enumerated exactly, row by row of each ellipse, and brought
  from depth order into pixel order by one counting sort. Gradients by autograd.
* `rendering.splatting`, several times faster and without gradients; on CUDA gsplat, in `rasterise_cuda`.
* `rasterise_reference`, a direct implementation for tests.

For fixed geometry a view is a sparse matrix, pixels × splats: `view_weights` computes it once, and each set of colours
then costs one product.

The splats are those of Kerbl et al. 2023, "3D Gaussian splatting", doi:10.1145/3592433 (projection after Zwicker et al.
2001, doi:10.1109/VISUAL.2001.964490).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.splatting import finer_camera

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Opacity below which a splat is not drawn, as in 3DGS; 0 disables the cut and enumerates all pairs.
ALPHA_CUT = 1.0 / 255.0
ALPHA_MOST = 0.999
# Variance added to each splat [px²], so that the smallest do not fall between pixel centres; larger values only blur.
PIXEL_VARIANCE = 0.02
# Near clipping distance [m].
NEAR_M = 1.0
# Weights below this are dropped from the sparse matrix of a view.
TRANSMITTANCE_CUT = 1e-4


class Splats(NamedTuple):
    """N Gaussians as tensors.

    Parameters
    ----------
    means
        ``(N, 3)`` centres in the camera's world frame [m].
    quaternions
        ``(N, 4)`` wxyz, of any length.
    log_scales
        ``(N, 3)`` natural logarithms of standard deviations [m].
    opacity_logits
        ``(N,)``.
    """

    means: torch.Tensor
    quaternions: torch.Tensor
    log_scales: torch.Tensor
    opacity_logits: torch.Tensor


class Projected(NamedTuple):
    """n projected splats, nearest first.

    Parameters
    ----------
    index
        ``(n,)`` index among all N splats.
    centre
        ``(n, 2)`` [px].
    conic
        ``(n, 3)`` elements xx, xy and yy of the inverse covariance [1/px²].
    opacity
        ``(n,)``.
    variance_y
        ``(n,)`` vertical variance [px²].
    depth
        ``(n,)`` along the optical axis [m].
    """

    index: torch.Tensor
    centre: torch.Tensor
    conic: torch.Tensor
    opacity: torch.Tensor
    variance_y: torch.Tensor
    depth: torch.Tensor


@dataclass(frozen=True)
class ViewWeights:
    """Blending weights of each splat in each pixel, for fixed geometry and any colours.

    Parameters
    ----------
    matrix
        Sparse ``(H W, N)`` float32, CSR.
    width_px, height_px
        Size of the picture.
    """

    matrix: csr_array
    width_px: int
    height_px: int

    @property
    def coverage(self) -> np.ndarray:
        """Fraction ``(H, W)`` of each pixel that is covered by splats."""
        return np.asarray(self.matrix.sum(axis=1), np.float32).reshape(self.height_px, self.width_px)


def set_torch_threads(threads: int = 1) -> None:
    """Set the number of torch threads.

    The default number must not be used: idle threads spin, and two were 10 to 30 times slower than one.

    Parameters
    ----------
    threads
        Number of threads, at least 1.
    """
    torch.set_num_threads(threads)


def splats_from(
    means: np.ndarray, quaternions: np.ndarray, log_scales: np.ndarray, opacity_logits: np.ndarray
) -> Splats:
    """Convert numpy arrays to splats.

    Parameters
    ----------
    means
        ``(N, 3)`` [m].
    quaternions
        ``(N, 4)`` wxyz, of any length.
    log_scales
        ``(N, 3)`` natural logarithms of standard deviations [m].
    opacity_logits
        ``(N,)``.

    Returns
    -------
    Splats
        float32 tensors.

    Raises
    ------
    ValueError
        If a shape is wrong or a value is not finite.
    """
    count = len(means)
    expected = {"means": (count, 3), "quaternions": (count, 4), "log_scales": (count, 3), "opacity_logits": (count,)}
    for (name, shape), values in zip(expected.items(), (means, quaternions, log_scales, opacity_logits), strict=True):
        if np.shape(values) != shape:
            raise ValueError(f"{name}: got shape {np.shape(values)}, expected {shape}")
        if not np.isfinite(values).all():
            raise ValueError(f"{name}: {int(np.sum(~np.isfinite(values)))} values are not finite")
    columns = (means, quaternions, log_scales, opacity_logits)
    return Splats(*(torch.as_tensor(np.ascontiguousarray(values, np.float32)) for values in columns))


def rotations(quaternions: torch.Tensor) -> torch.Tensor:
    """Convert quaternions to rotation matrices.

    Parameters
    ----------
    quaternions
        ``(N, 4)`` wxyz, of any length.

    Returns
    -------
    torch.Tensor
        ``(N, 3, 3)``.
    """
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
    """Return the pose of a camera as tensors.

    Parameters
    ----------
    camera
        The view.
    like
        Tensor whose dtype and device are adopted.

    Returns
    -------
    tuple of torch.Tensor
        Rotation ``(3, 3)`` from world to camera axes, and position ``(3,)`` [m].
    """
    pose = torch.as_tensor(camera.world_from_camera, dtype=torch.float64)
    return pose[:3, :3].T.to(like), pose[:3, 3].to(like)


def project_splats(
    splats: Splats, camera: Camera, *, alpha_cut: float = ALPHA_CUT, pixel_variance: float = PIXEL_VARIANCE
) -> Projected:
    """Project the splats near the view frustum to ellipses in the picture.

    Parameters
    ----------
    splats
        N Gaussians.
    camera
        The view.
    alpha_cut
        Opacity below which a splat is not drawn; 0 disables culling by the image borders.
    pixel_variance
        Variance added to each splat [px²].

    Returns
    -------
    Projected
        Nearest first; equal depths in the order of their index.
    """
    rotation, position = camera_tensors(camera, splats.means)
    with torch.no_grad():
        index = _candidates(splats, camera, rotation, position, alpha_cut)
    local = (splats.means[index] - position) @ rotation.T
    x, y, z = local.unbind(1)
    # As in 3DGS, the Jacobian of the projection is evaluated at most 30 % beyond the image border.
    limit_x, limit_y = 1.3 * 0.5 * camera.width_px / camera.fx, 1.3 * 0.5 * camera.height_px / camera.fy
    u, v = (x / z).clamp(-limit_x, limit_x), (y / z).clamp(-limit_y, limit_y)
    axes = rotation @ (rotations(splats.quaternions[index]) * splats.log_scales[index].exp()[:, None, :])
    across = camera.fx / z[:, None] * (axes[:, 0] - u[:, None] * axes[:, 2])
    down = camera.fy / z[:, None] * (axes[:, 1] - v[:, None] * axes[:, 2])
    xx, xy, yy = ((a * b).sum(1) for a, b in ((across, across), (across, down), (down, down)))
    xx, yy = xx + pixel_variance, yy + pixel_variance
    determinant = xx * yy - xy * xy
    conic = torch.stack([yy, -xy, xx], dim=1) / determinant[:, None]
    centre = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
    opacity = torch.sigmoid(splats.opacity_logits[index])
    return Projected(index, centre, conic, opacity, yy, z)


def _candidates(
    splats: Splats, camera: Camera, rotation: torch.Tensor, position: torch.Tensor, alpha_cut: float
) -> torch.Tensor:
    """Indices of the splats in front of the camera and near the picture, nearest first; ties keep their order."""
    local = (splats.means - position) @ rotation.T
    x, y, z = local.unbind(1)
    keep = z > NEAR_M
    if alpha_cut > 0.0:
        # Bounding sphere of four standard deviations against the four sides of the frustum.
        radius = 4.0 * splats.log_scales.amax(dim=1).exp()
        for along, focal, low, high in (
            (x, camera.fx, -camera.cx, camera.width_px - camera.cx),
            (y, camera.fy, -camera.cy, camera.height_px - camera.cy),
        ):
            for bound, side in ((low - 2.0, 1.0), (high + 2.0, -1.0)):
                slope = bound / focal
                keep &= side * (along - slope * z) > -radius * (1.0 + slope * slope) ** 0.5
    index = keep.nonzero().squeeze(1)
    return index[torch.argsort(z[index], stable=True)]


class Pairs(NamedTuple):
    """K pairs of pixel and splat in pixel order, nearest first within a pixel.

    Parameters
    ----------
    splat
        ``(K,)`` index among the projected splats.
    weight
        ``(K,)`` blending weight.
    start
        ``(H W + 1,)`` first pair of each pixel.
    """

    splat: torch.Tensor
    weight: torch.Tensor
    start: torch.Tensor


def blend_pairs(projected: Projected, width_px: int, height_px: int, *, alpha_cut: float = ALPHA_CUT) -> Pairs:
    """Compute the weights of front-to-back blending, differentiable in the projected quantities.

    Parameters
    ----------
    projected
        n splats, nearest first.
    width_px, height_px
        Size of the picture.
    alpha_cut
        Opacity below which a splat is not drawn; 0 pairs every splat with every pixel.

    Returns
    -------
    Pairs
        Pairs in pixel order.
    """
    with torch.no_grad():
        splat, pixel = _pairs_in_depth_order(projected, width_px, height_px, alpha_cut)
        row = torch.div(pixel, width_px, rounding_mode="floor")
        x, y = (pixel - row * width_px).to(projected.centre.dtype) + 0.5, row.to(projected.centre.dtype) + 0.5
        order, start = _to_pixel_order(pixel, width_px * height_px)
    # α is computed in depth order, where neighbours in memory are neighbours in the picture, and only then reordered.
    columns = (*projected.centre.unbind(1), *projected.conic.unbind(1), projected.opacity)
    centre_x, centre_y, xx, xy, yy, opacity = (column.index_select(0, splat) for column in columns)
    dx, dy = x - centre_x, y - centre_y
    power = -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy
    alpha = (opacity * power.exp()).clamp(max=ALPHA_MOST).index_select(0, order)
    splat = splat.index_select(0, order)
    # Transmittance by a cumulative sum of logarithms over all pairs; double precision, because it has millions of
    # terms.
    log_transmittance = torch.cumsum(torch.log1p(-alpha), 0, dtype=torch.float64)
    before = torch.cat([log_transmittance.new_zeros(1), log_transmittance])
    first = before.index_select(0, start[:-1]).repeat_interleave(start.diff())
    weight = alpha * (before[:-1] - first).to(alpha.dtype).exp()
    return Pairs(splat, weight, start)


def _pairs_in_depth_order(
    projected: Projected, width_px: int, height_px: int, alpha_cut: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Splat and pixel of every pair with α above the cut: the exact run of pixels of each ellipse in each row."""
    count = len(projected.index)
    if alpha_cut <= 0.0:
        pixel = torch.arange(width_px * height_px)
        return torch.arange(count).repeat_interleave(len(pixel)), pixel.repeat(count)
    centre_x, centre_y = projected.centre.unbind(1)
    a, b, c = projected.conic.unbind(1)
    # Squared Mahalanobis distance at which α falls to the cut.
    limit = 2.0 * torch.log((projected.opacity / alpha_cut).clamp(min=1.0))
    half_height = (limit * projected.variance_y).sqrt()
    top = (centre_y - half_height - 0.5).ceil().clamp(0, height_px).int()
    bottom = ((centre_y + half_height - 0.5).floor() + 1).clamp(0, height_px).int()
    rows = (bottom - top).clamp(min=0)
    splat = torch.arange(count, dtype=torch.int32).repeat_interleave(rows)
    row = (
        torch.arange(len(splat), dtype=torch.int32)
        - (rows.cumsum(0) - rows).int().index_select(0, splat)
        + top.index_select(0, splat)
    )
    # Roots of the ellipse's quadratic equation in x, for each row.
    centre_x, centre_y, a, b, c, limit = (
        column.index_select(0, splat) for column in (centre_x, centre_y, a, b, c, limit)
    )
    dy = row + 0.5 - centre_y
    mixed = b * dy
    root = (mixed * mixed - a * (c * dy * dy - limit)).clamp(min=0.0).sqrt()
    left = ((-mixed - root) / a + centre_x - 0.5).ceil().clamp(0, width_px).int()
    right = (((-mixed + root) / a + centre_x - 0.5).floor() + 1).clamp(0, width_px).int()
    length = (right - left).clamp(min=0)
    first = row * width_px + left - (length.cumsum(0) - length).int()
    pixel = first.repeat_interleave(length)
    pixel += torch.arange(len(pixel), dtype=torch.int32)
    return splat.repeat_interleave(length), pixel


def _to_pixel_order(pixel: torch.Tensor, pixels: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Stable order by pixel and start of each pixel, by counting sort; depth order is kept within a pixel."""
    from scipy import sparse

    count = len(pixel)
    entries = (np.arange(1, count + 1, dtype=np.int32), (pixel.numpy(), np.zeros(count, np.int32)))
    table = sparse.coo_array(entries, shape=(pixels, 1))
    table.has_canonical_format = True  # otherwise duplicate entries are summed
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
    """Blend colours front to back over black.

    Differentiable in geometry, opacity and colour; depth order and the set of pairs above the cut are constants.

    Parameters
    ----------
    splats
        N Gaussians.
    colours
        ``(N, C)``.
    camera
        The view.
    alpha_cut
        Opacity below which a splat is not drawn.
    pixel_variance
        Variance added to each splat [px²].

    Returns
    -------
    tuple of torch.Tensor
        Picture ``(H, W, C)`` and coverage ``(H, W)``.

    Raises
    ------
    ValueError
        If the numbers of colours and splats differ.
    """
    if len(colours) != len(splats.means):
        raise ValueError(f"colours: got {len(colours)}, expected {len(splats.means)}, one for each splat")
    projected = project_splats(splats, camera, alpha_cut=alpha_cut, pixel_variance=pixel_variance)
    pairs = blend_pairs(projected, camera.width_px, camera.height_px, alpha_cut=alpha_cut)
    pixel = torch.arange(camera.width_px * camera.height_px).repeat_interleave(pairs.start.diff())
    channels = torch.cat([colours, colours.new_ones(len(colours), 1)], dim=1).index_select(
        0, projected.index.index_select(0, pairs.splat)
    )
    flat = channels.new_zeros(camera.width_px * camera.height_px, channels.shape[1])
    flat = flat.index_add(0, pixel, pairs.weight[:, None] * channels)
    image = flat.reshape(camera.height_px, camera.width_px, -1)
    return image[..., :-1], image[..., -1]


@torch.no_grad()
def view_weights(
    splats: Splats, camera: Camera, *, subpixels: int = 1, pixel_variance: float = PIXEL_VARIANCE
) -> ViewWeights:
    """Compute the sparse blending matrix of a view; weights below `TRANSMITTANCE_CUT` are dropped.

    Parameters
    ----------
    splats
        N Gaussians.
    camera
        The view.
    subpixels
        Samples along a pixel's side: 2 is more exact at edges and on steep ground, at four times the samples.
    pixel_variance
        Variance added to each splat [px²].

    Returns
    -------
    ViewWeights
        ``(H W, N)``; without entries if no splat is in view.
    """
    from scipy import sparse

    fine = finer_camera(camera, subpixels)
    projected = project_splats(splats, fine, pixel_variance=pixel_variance)
    pairs = blend_pairs(projected, fine.width_px, fine.height_px)
    columns = projected.index.to(torch.int32).index_select(0, pairs.splat).numpy()
    weight, start = pairs.weight.numpy(), pairs.start.numpy()
    keep = weight > TRANSMITTANCE_CUT
    start = np.concatenate([[0], np.cumsum(keep, dtype=np.int64)])[start].astype(np.int32)
    shape = (fine.width_px * fine.height_px, len(splats.means))
    matrix = sparse.csr_array((weight[keep], columns[keep], start), shape=shape)
    if subpixels > 1:
        matrix = _pooled(matrix, camera, subpixels)
    return ViewWeights(matrix, camera.width_px, camera.height_px)


def _pooled(matrix: csr_array, camera: Camera, subpixels: int) -> csr_array:
    """Average the rows of sub-pixel samples into rows of pixels; entries of one splat are summed."""
    from scipy import sparse

    samples, splats = matrix.shape  # pyright: ignore[reportGeneralTypeIssues]
    width = camera.width_px * subpixels
    row, column = np.divmod(np.arange(samples, dtype=np.int32), np.int32(width))
    pixel = (row // subpixels) * np.int32(camera.width_px) + column // subpixels
    entries = (matrix.data / np.float32(subpixels**2), (np.repeat(pixel, np.diff(matrix.indptr)), matrix.indices))
    return sparse.coo_array(entries, shape=(camera.width_px * camera.height_px, splats)).tocsr()


def splat_colours(weights: ViewWeights, colours: np.ndarray) -> np.ndarray:
    """Render colours with the blending weights of a view.

    Parameters
    ----------
    weights
        Blending weights of N splats.
    colours
        ``(N, C)``.

    Returns
    -------
    numpy.ndarray
        ``(H, W, C)`` float32, blended over black.
    """
    flat = weights.matrix @ np.ascontiguousarray(colours, np.float32)
    return flat.reshape(weights.height_px, weights.width_px, -1)
