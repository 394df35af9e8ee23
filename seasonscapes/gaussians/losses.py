"""What training is judged by: colours of (disc, time) pairs, and pictures through frozen weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from seasonscapes.gaussians.appearance import Appearance, LightTensors
from seasonscapes.gaussians.rasterise import ViewWeights

# Relative squared error, but not of what is nearly black (Lehtinen et al. 2018, arXiv:1803.04189, § 3.2).
_DARK = 0.02


@dataclass(frozen=True)
class TrainingFrame:
    """A picture to learn from: a path-traced view, or a painted one.

    Parameters
    ----------
    weights
        Of its camera, from `rasterise.view_weights`; frames of one camera share them.
    time
        Its number among the lessons' times.
    image
        ``(H, W, 3)`` colours as in `SurfaceTargets`, of the surface, before the air.
    mask
        ``(H, W)`` bool, True = usable.
    """

    weights: ViewWeights
    time: int
    image: np.ndarray
    mask: np.ndarray

    def __post_init__(self):
        if self.image.shape != (*self.mask.shape, 3) or self.mask.shape != (
            self.weights.height_px,
            self.weights.width_px,
        ):
            raise ValueError(f"Frame: image {self.image.shape} and mask {self.mask.shape} do not fit the camera")
        if not np.isfinite(self.image[self.mask]).all():
            raise ValueError("Frame: the picture has usable pixels that are not finite")
        if not self.mask.any() or self.weights.matrix.nnz == 0:
            raise ValueError("Frame: no splat and no usable pixel in view; does the camera stand inside the mountain?")


def surface_loss(
    appearance: Appearance, lights: LightTensors, targets: torch.Tensor, batch: int, rng: np.random.Generator
) -> torch.Tensor:
    """Relative squared error of random (disc, time) pairs: unbiased even where targets are noisy."""
    times, count, _ = targets.shape
    index = torch.as_tensor(rng.integers(0, count, batch))
    time = torch.as_tensor(rng.integers(0, times, batch))
    value = appearance(index, time, lights)
    return ((value - targets[time, index]) ** 2 / (value.detach() ** 2 + _DARK)).mean()


@dataclass(frozen=True)
class TrainingPicture:
    """A frame laid out for training: seen discs ``(n,)``, weights over them (rows sum to 1), and pixels in sRGB."""

    discs: torch.Tensor
    forward: object
    backward: object
    time: torch.Tensor
    target: torch.Tensor
    mask: torch.Tensor


def training_picture(frame: TrainingFrame) -> TrainingPicture:
    from scipy import sparse

    matrix = frame.weights.matrix
    discs = np.unique(matrix.indices)
    number = np.zeros(matrix.shape[1], np.int32)
    number[discs] = np.arange(len(discs), dtype=np.int32)
    scale = 1.0 / np.maximum(frame.weights.coverage.ravel(), 1e-3)
    data = matrix.data * np.repeat(scale, np.diff(matrix.indptr))
    forward = sparse.csr_array(
        (data.astype(np.float32), number[matrix.indices], matrix.indptr), shape=(matrix.shape[0], len(discs))
    )
    mask = torch.as_tensor(frame.mask & (frame.weights.coverage > 0.5))
    target = torch.where(mask[..., None], encoded(torch.as_tensor(np.nan_to_num(frame.image).astype(np.float32))), 0.0)
    return TrainingPicture(
        torch.as_tensor(discs.astype(np.int64)), forward, forward.T.tocsr(), torch.tensor(frame.time), target, mask
    )


class SparseProduct(torch.autograd.Function):
    """A constant sparse matrix times a dense one; the transpose is given too, as it serves many steps."""

    @staticmethod
    def forward(context, values: torch.Tensor, matrix, transpose) -> torch.Tensor:
        context.transpose = transpose
        return torch.from_numpy(matrix @ values.detach().numpy())

    @staticmethod
    def backward(context, gradient: torch.Tensor):
        return torch.from_numpy(context.transpose @ gradient.contiguous().numpy()), None, None


def encoded(linear: torch.Tensor) -> torch.Tensor:
    """sRGB of linear values; brighter than 1 goes on along the same curve, so that it still has a slope."""
    linear = linear.clamp(min=0.0)
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp(min=1e-4) ** (1.0 / 2.4) - 0.055)


def picture_loss(appearance: Appearance, lights: LightTensors, picture: TrainingPicture) -> torch.Tensor:
    """0.8 L1 + 0.2 D-SSIM of a frame in sRGB over its usable pixels."""
    values = appearance(picture.discs, picture.time, lights)
    image = encoded(SparseProduct.apply(values, picture.forward, picture.backward)).reshape(picture.target.shape)
    image = torch.where(picture.mask[..., None], image, 0.0)
    share = picture.mask.float().mean()
    difference = (image - picture.target).abs().mean() / share
    return 0.8 * difference + 0.2 * (1.0 - torch_ssim_map(image, picture.target)).mean() / share


def torch_ssim_map(image: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Structural similarity ``(C, H, W)`` of pictures ``(H, W, C)`` (Wang et al. 2004, doi:10.1109/TIP.2003.819861)."""
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
