"""LPIPS with AlexNet: distance of pictures in the features of a network that was trained to know things.

Zhang, Isola, Efros, Shechtman & Wang 2018 (doi:10.1109/CVPR.2018.00068), version 0.1. Two weight files are needed, by
local path; they are the user's to get: ``alexnet.pth`` (state dict of torchvision's AlexNet, keys ``features.0.weight`` …)
and ``lpips_alex.pth`` (its linear layers, keys ``lin0.model.1.weight`` …).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

WEIGHTS = ("alexnet.pth", "lpips_alex.pth")
ENVIRONMENT = "SEASONSCAPES_LPIPS"
# ImageNet's mean and standard deviation, for values in [-1, 1].
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
# Layer of torchvision's `features`, stride, padding, and whether pooling comes before it.
_LAYERS = ((0, 4, 2, False), (3, 1, 2, True), (6, 1, 1, True), (8, 1, 1, False), (10, 1, 1, False))
_SMALLEST_PX = 31
Lpips = Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]


def missing_lpips(folder: Path | None = None) -> str | None:
    """Why LPIPS cannot be measured, or ``None`` where it can."""
    folder = folder or (Path(os.environ[ENVIRONMENT]) if ENVIRONMENT in os.environ else None)
    if folder is None:
        return f"no folder of weights is named (set {ENVIRONMENT})"
    absent = [name for name in WEIGHTS if not (folder / name).is_file()]
    return f"{folder} holds no {' and no '.join(absent)}" if absent else None


def load_lpips(folder: Path | None = None) -> Lpips:
    """A function that measures LPIPS of two pictures ``(H, W, 3)`` sRGB in [0, 1], within a mask or over the frame.

    Parameters
    ----------
    folder
        Of the two weight files; left out, what the environment names.

    Raises
    ------
    FileNotFoundError
        Weights are missing; `missing_lpips` says which.
    ValueError
        The files hold other weights.
    """
    why = missing_lpips(folder)
    if why is not None:
        raise FileNotFoundError(f"LPIPS: {why}")
    import torch

    folder = folder or Path(os.environ[ENVIRONMENT])
    network, linear = (torch.load(folder / name, map_location="cpu", weights_only=True) for name in WEIGHTS)
    return lpips_of(network, linear)


def lpips_of(network: dict, linear: dict) -> Lpips:
    """LPIPS from state dicts of the network and of the linear layers; see `load_lpips`."""
    import torch

    try:
        convolutions = [
            (network[f"features.{n}.weight"].float(), network[f"features.{n}.bias"].float()) for n, *_ in _LAYERS
        ]
        weights = [linear[f"lin{i}.model.1.weight"].float() for i in range(len(_LAYERS))]
    except KeyError as error:
        raise ValueError(f"LPIPS: the weights have no {error}") from None
    shift, scale = (torch.tensor(values).view(1, 3, 1, 1) for values in (_SHIFT, _SCALE))

    def features(image: np.ndarray) -> list[torch.Tensor]:
        x = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32)) * 2.0 - 1.0
        x, found = (x - shift) / scale, []
        for (_, stride, padding, pool), (weight, bias) in zip(_LAYERS, convolutions, strict=True):
            x = torch.nn.functional.max_pool2d(x, 3, 2) if pool else x
            x = torch.relu(torch.nn.functional.conv2d(x, weight, bias, stride, padding))
            found.append(x / (x.norm(dim=1, keepdim=True) + 1e-10))
        return found

    def measure(truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None = None) -> float:
        if min(truth.shape[:2]) < _SMALLEST_PX:
            raise ValueError(
                f"LPIPS: a picture of {truth.shape[:2]} pixels, expected at least {_SMALLEST_PX} on a side"
            )
        total = 0.0
        with torch.no_grad():
            for a, b, weight in zip(features(truth), features(picture), weights, strict=True):
                layer = torch.nn.functional.conv2d((a - b) ** 2, weight)
                total += float(_mean(layer, mask))
        return total

    def _mean(layer: torch.Tensor, mask: np.ndarray | None) -> torch.Tensor:
        if mask is None:
            return layer.mean()
        share = torch.from_numpy(mask.astype(np.float32))[None, None]
        share = torch.nn.functional.interpolate(share, layer.shape[2:], mode="area")
        return (layer * share).sum() / share.sum()

    return measure
