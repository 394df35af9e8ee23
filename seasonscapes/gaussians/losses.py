"""Loss functions of training: colours of (disc, time) pairs, and pictures rendered with frozen splat weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.errors import NoTerrainInView
from seasonscapes.gaussians.appearance import Appearance, LightTensors
from seasonscapes.gaussians.disc_geometry import normalised_picture, uncovered_loss
from seasonscapes.gaussians.rasterise import Splats, ViewWeights

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Floor of the denominator of the relative squared error (Lehtinen et al. 2018, arXiv:1803.04189); chosen.
_RELATIVE_FLOOR = 0.02


@dataclass(frozen=True)
class TrainingFrame:
    """A training picture: a path-traced view, or a painted one.

    Parameters
    ----------
    weights
        Blending weights of its camera, from `rasterise.view_weights`; frames of one camera share them.
    time
        Index among the times of the training targets.
    image
        ``(H, W, 3)`` colours of the surface as in `SurfaceTargets`, before aerial perspective.
    mask
        ``(H, W)`` bool, True = usable.
    camera
        The view that the weights belong to; needed where the discs are refined.

    Raises
    ------
    ValueError
        If the sizes differ, or a usable pixel is not finite.
    NoTerrainInView
        If no splat or no usable pixel is in view.
    """

    weights: ViewWeights
    time: int
    image: np.ndarray
    mask: np.ndarray
    camera: Camera | None = None

    def __post_init__(self) -> None:
        if self.image.shape != (*self.mask.shape, 3) or self.mask.shape != (
            self.weights.height_px,
            self.weights.width_px,
        ):
            raise ValueError(
                f"TrainingFrame: got image {self.image.shape} and mask {self.mask.shape}, "
                f"expected the camera's {self.weights.height_px} × {self.weights.width_px} pixels"
            )
        if not np.isfinite(self.image[self.mask]).all():
            raise ValueError("TrainingFrame: the picture has usable pixels that are not finite")
        if not self.mask.any() or self.weights.matrix.nnz == 0:
            raise NoTerrainInView(
                "TrainingFrame: no splat or no usable pixel in view; the camera may be inside the mountain"
            )


def surface_loss(
    appearance: Appearance, lights: LightTensors, targets: torch.Tensor, batch: int, rng: np.random.Generator
) -> torch.Tensor:
    """Relative squared error of random (disc, time) pairs; unbiased under noisy targets.

    Parameters
    ----------
    appearance
        Appearance of N discs.
    lights
        T light states.
    targets
        ``(T, N, 3)`` colours.
    batch
        Number of pairs.
    rng
        Draws the pairs.

    Returns
    -------
    torch.Tensor
        Scalar loss.
    """
    times, count, _ = targets.shape
    index = torch.as_tensor(rng.integers(0, count, batch))
    time = torch.as_tensor(rng.integers(0, times, batch))
    value = appearance(index, time, lights)
    loss = ((value - targets[time, index]) ** 2 / (value.detach() ** 2 + _RELATIVE_FLOOR)).mean()
    if lights.visible is None:
        return loss
    # Colours no longer say anything about the horizons, which browsers relight with: they learn from the traced shadows.
    return loss + _horizon_loss(appearance, lights, index, time)


def _horizon_loss(
    appearance: Appearance, lights: LightTensors, index: torch.Tensor, time: torch.Tensor
) -> torch.Tensor:
    """Squared error of the sun's visibility by horizons, of discs that face it."""
    assert lights.visible is not None
    direction = lights.direction[time, 0]
    facing = (appearance.normals[index] * direction).sum(1) > 0.0
    traced = lights.visible[time, 0, index].float() / 255.0
    return (((appearance.visibility(index, direction) - traced) * facing) ** 2).mean()


@dataclass(frozen=True)
class TrainingPicture:
    """A frame prepared for training.

    Parameters
    ----------
    discs
        ``(n,)`` indices of the visible discs.
    forward, backward
        Weights ``(H W, n)`` of these discs in the pixels, rows sum to 1; and their transpose.
    time
        Index of the light, ``()``.
    target
        ``(H, W, 3)`` sRGB.
    mask
        ``(H, W)`` bool, True = usable and covered by splats.
    camera
        The view, where the frame names it.
    """

    discs: torch.Tensor
    forward: csr_array
    backward: csr_array
    time: torch.Tensor
    target: torch.Tensor
    mask: torch.Tensor
    camera: Camera | None


def training_picture(frame: TrainingFrame) -> TrainingPicture:
    """Restrict a frame to its visible discs, normalise its weights and encode its pixels.

    Parameters
    ----------
    frame
        Frame with frozen weights.

    Returns
    -------
    TrainingPicture
        Input of `picture_loss`.
    """
    from scipy import sparse

    matrix = frame.weights.matrix
    discs = np.unique(matrix.indices)
    pixels, splats = matrix.shape  # pyright: ignore[reportGeneralTypeIssues]
    number = np.zeros(splats, np.int32)
    number[discs] = np.arange(len(discs), dtype=np.int32)
    scale = 1.0 / np.maximum(frame.weights.coverage.ravel(), 1e-3)
    data = matrix.data * np.repeat(scale, np.diff(matrix.indptr))
    forward = sparse.csr_array(
        (data.astype(np.float32), number[matrix.indices], matrix.indptr), shape=(pixels, len(discs))
    )
    mask = torch.as_tensor(frame.mask & (frame.weights.coverage > 0.5))
    target = torch.where(
        mask[..., None], srgb_encoded(torch.as_tensor(np.nan_to_num(frame.image).astype(np.float32))), 0.0
    )
    return TrainingPicture(
        torch.as_tensor(discs.astype(np.int64)),
        forward,
        forward.T.tocsr(),
        torch.tensor(frame.time),
        target,
        mask,
        frame.camera,
    )


class SparseProduct(torch.autograd.Function):
    """Product of a constant sparse matrix and a dense one; the transpose is an argument because many steps reuse it."""

    @staticmethod
    def forward(context: Any, values: torch.Tensor, matrix: csr_array, transpose: csr_array) -> torch.Tensor:
        """Return ``matrix @ values``, ``(m, C)``."""
        context.transpose = transpose
        return torch.from_numpy(matrix @ values.detach().numpy())

    @staticmethod
    def backward(context: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        """Return the gradient with respect to ``values``, ``(n, C)``."""
        return torch.from_numpy(context.transpose @ gradient.contiguous().numpy()), None, None


def srgb_encoded(linear: torch.Tensor) -> torch.Tensor:
    """Encode linear values as sRGB, extended along the same curve above 1 so that gradients do not vanish there.

    Parameters
    ----------
    linear
        ``(...)``; negative values are clipped.

    Returns
    -------
    torch.Tensor
        ``(...)``.
    """
    linear = linear.clamp(min=0.0)
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=1e-4) ** (1.0 / 2.4) - 0.055)


def picture_loss(appearance: Appearance, lights: LightTensors, picture: TrainingPicture) -> torch.Tensor:
    """0.8 L1 + 0.2 D-SSIM of a frame in sRGB over its usable pixels.

    Parameters
    ----------
    appearance
        Appearance of N discs.
    lights
        T light states.
    picture
        Picture from `training_picture`.

    Returns
    -------
    torch.Tensor
        Scalar loss.
    """
    values = appearance(picture.discs, picture.time, lights)
    return image_loss(SparseProduct.apply(values, picture.forward, picture.backward), picture)


def refining_loss(appearance: Appearance, lights: LightTensors, pictures: Sequence[TrainingPicture]) -> torch.Tensor:
    """`picture_loss` of frames of one camera through its discs as they are now, differentiable in their geometry too.

    Parameters
    ----------
    appearance
        Appearance of N discs, with `Appearance.geometry`.
    lights
        T light states.
    pictures
        Pictures of one camera, from `training_picture`; their frozen weights only tell which discs are in view.

    Returns
    -------
    torch.Tensor
        Scalar loss: the mean of the pictures', and what pixels of terrain lack of coverage.
    """
    geometry, camera, seen = appearance.geometry, pictures[0].camera, pictures[0].discs
    assert geometry is not None, "train refines only where there is one"
    assert camera is not None, "train has asked for it"
    colours = torch.cat([appearance(seen, picture.time, lights) for picture in pictures], dim=1)
    splats = Splats(*(values.index_select(0, seen) for values in geometry.splats(camera)))
    drawn, coverage = normalised_picture(splats, colours, camera)
    losses = [
        image_loss(pixels.reshape(-1, 3), picture)
        for pixels, picture in zip(drawn.split(3, dim=2), pictures, strict=True)
    ]
    return torch.stack(losses).mean() + uncovered_loss(coverage, pictures[0].mask)


def image_loss(pixels: torch.Tensor, picture: TrainingPicture) -> torch.Tensor:
    """0.8 L1 + 0.2 D-SSIM of linear pixels ``(H W, 3)`` against a frame, in sRGB over its usable pixels."""
    image = srgb_encoded(pixels).reshape(picture.target.shape)
    image = torch.where(picture.mask[..., None], image, 0.0)
    usable_fraction = picture.mask.float().mean()
    difference = (image - picture.target).abs().mean() / usable_fraction
    return 0.8 * difference + 0.2 * (1.0 - torch_ssim_map(image, picture.target)).mean() / usable_fraction


def sampled_loss(
    picture: TrainingPicture, colours: Callable[[torch.Tensor], torch.Tensor], rng: np.random.Generator
) -> torch.Tensor:
    """Mean absolute difference in sRGB of 1024 random usable pixels, which suffice for the few unknowns of a code.

    Parameters
    ----------
    picture
        The picture.
    colours
        Gives the linear colours ``(n, 3)`` of the picture's discs of numbers ``(n,)``.
    rng
        Draws the pixels.
    """
    rows = np.flatnonzero(picture.mask.numpy().ravel())
    chosen = rng.choice(rows, min(1024, len(rows)), replace=False)
    weights = picture.forward[chosen]
    visible = np.unique(weights.indices)
    weights = weights[:, visible]
    pixels = SparseProduct.apply(colours(torch.from_numpy(visible).long()), weights, weights.T.tocsr())
    return (srgb_encoded(pixels) - picture.target.reshape(-1, 3)[chosen]).abs().mean()


def torch_ssim_map(image: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Structural similarity of two pictures (Wang et al. 2004, doi:10.1109/TIP.2003.819861).

    Parameters
    ----------
    image, other
        ``(H, W, C)`` in [0, 1].

    Returns
    -------
    torch.Tensor
        ``(C, H, W)``, 1 where equal.
    """
    offset = torch.arange(11.0) - 5.0
    window = torch.exp(-(offset**2) / 4.5)
    window = window / window.sum()
    a, b = image.permute(2, 0, 1)[:, None], other.permute(2, 0, 1)[:, None]

    def mean(values: torch.Tensor) -> torch.Tensor:
        across = torch.nn.functional.conv2d(values, window[None, None, None, :], padding=(0, 5))
        return torch.nn.functional.conv2d(across, window[None, None, :, None], padding=(5, 0))

    mean_a, mean_b = mean(a), mean(b)
    variance = mean(a * a) - mean_a**2 + mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    above = (2.0 * mean_a * mean_b + 1e-4) * (2.0 * covariance + 9e-4)
    return (above / ((mean_a**2 + mean_b**2 + 1e-4) * (variance + 9e-4)))[:, 0]
