"""LPIPS with AlexNet: perceptual distance of two images in the feature space of a classification network.

Zhang, Isola, Efros, Shechtman & Wang 2018 (doi:10.1109/CVPR.2018.00068), version 0.1. Two local weight files,
not distributed with this package, are required: ``alexnet.pth`` (state dict of torchvision's AlexNet, keys
``features.0.weight`` …) and ``lpips_alex.pth`` (its linear layers, keys ``lin0.model.1.weight`` …).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.errors import InputError

if TYPE_CHECKING:
    import torch

WEIGHTS = ("alexnet.pth", "lpips_alex.pth")
ENVIRONMENT = "SEASONSCAPES_LPIPS"
# Mean and standard deviation of ImageNet colours, for values in [-1, 1].
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
# Convolutional layers: index in torchvision's `features`, stride, padding, and whether max pooling precedes it.
_LAYERS = ((0, 4, 2, False), (3, 1, 2, True), (6, 1, 1, True), (8, 1, 1, False), (10, 1, 1, False))
_NETWORK_KEYS = tuple(f"features.{n}.{kind}" for n, *_ in _LAYERS for kind in ("weight", "bias"))
_LINEAR_KEYS = tuple(f"lin{i}.model.1.weight" for i in range(len(_LAYERS)))
_SMALLEST_PX = 31
Lpips = Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]


def missing_lpips(folder: Path | None = None) -> str | None:
    """Describe why LPIPS is not available.

    Parameters
    ----------
    folder
        Folder of the weight files; the value of the environment variable ``SEASONSCAPES_LPIPS`` if omitted.

    Returns
    -------
    str or None
        Reason, or ``None`` if all weight files exist.
    """
    folder = folder or (Path(os.environ[ENVIRONMENT]) if ENVIRONMENT in os.environ else None)
    if folder is None:
        return f"no folder of weights is given (set {ENVIRONMENT})"
    absent = [name for name in WEIGHTS if not (folder / name).is_file()]
    return f"{folder} does not contain {' and '.join(absent)}" if absent else None


def load_lpips(folder: Path | None = None) -> Lpips:
    """Load LPIPS from its weight files.

    Parameters
    ----------
    folder
        Folder of the weight files; the value of the environment variable ``SEASONSCAPES_LPIPS`` if omitted.

    Returns
    -------
    callable
        Function of two images ``(H, W, 3)``, sRGB-encoded in [0, 1], and a mask ``(H, W)`` bool or ``None``, that
        returns their LPIPS within the mask, or over the whole image.

    Raises
    ------
    FileNotFoundError
        If a weight file is missing (`missing_lpips`).
    InputError
        If a file contains other weights.
    """
    reason = missing_lpips(folder)
    if reason is not None:
        raise FileNotFoundError(f"LPIPS: {reason}")
    folder = folder or Path(os.environ[ENVIRONMENT])
    network, linear = (_weights(folder / name) for name in WEIGHTS)
    for name, weights, keys in zip(WEIGHTS, (network, linear), (_NETWORK_KEYS, _LINEAR_KEYS), strict=True):
        missing = [key for key in keys if not isinstance(weights, Mapping) or key not in weights]
        if missing:
            problem = f"not the weights of LPIPS: {len(missing)} of {len(keys)} keys are missing"
            raise InputError(folder / name, problem, expected=f"the key {missing[0]}")
    return lpips_of(network, linear)


def _weights(path: Path) -> Any:
    """The tensors of a weight file; `InputError` for a damaged one, and for one that would run code to be loaded."""
    import pickle
    import warnings

    import torch

    try:
        with warnings.catch_warnings():
            # About pickles of another kind, which are refused below.
            warnings.simplefilter("ignore", UserWarning)
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:
        problem = "not plain tensors: it holds objects, which are never unpickled"
    # What torch raises for files that are cut short or no weights at all.
    except (RuntimeError, EOFError, ValueError, KeyError, AttributeError, TypeError, IndexError, OSError) as error:
        problem = f"not readable as weights: {str(error).partition(chr(10))[0] or type(error).__name__}"
    raise InputError(path, problem, expected="a state dict of torch.save", cure="download the file again")


def lpips_of(network: Mapping[str, torch.Tensor], linear: Mapping[str, torch.Tensor]) -> Lpips:
    """Create LPIPS from the state dicts of its network and linear layers.

    Parameters
    ----------
    network
        State dict of torchvision's AlexNet.
    linear
        State dict of the linear layers.

    Returns
    -------
    callable
        As `load_lpips`.

    Raises
    ------
    ValueError
        If a key is missing.
    """
    import torch

    try:
        convolutions = [
            (network[f"features.{n}.weight"].float(), network[f"features.{n}.bias"].float()) for n, *_ in _LAYERS
        ]
        weights = [linear[f"lin{i}.model.1.weight"].float() for i in range(len(_LAYERS))]
    except KeyError as error:
        raise ValueError(f"LPIPS: the weights lack the key {error}") from None
    shift, scale = (torch.tensor(values).view(1, 3, 1, 1) for values in (_SHIFT, _SCALE))

    def features(image: np.ndarray) -> list[torch.Tensor]:
        x = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32)) * 2.0 - 1.0
        x, outputs = (x - shift) / scale, []
        for (_, stride, padding, pool), (weight, bias) in zip(_LAYERS, convolutions, strict=True):
            x = torch.nn.functional.max_pool2d(x, 3, 2) if pool else x
            x = torch.relu(torch.nn.functional.conv2d(x, weight, bias, stride, padding))
            outputs.append(x / (x.norm(dim=1, keepdim=True) + 1e-10))
        return outputs

    def measure(truth: np.ndarray, image: np.ndarray, mask: np.ndarray | None = None) -> float:
        if min(truth.shape[:2]) < _SMALLEST_PX:
            raise ValueError(
                f"LPIPS: got an image of {truth.shape[:2]} pixels, expected at least {_SMALLEST_PX} on each side"
            )
        total = 0.0
        with torch.no_grad():
            for a, b, weight in zip(features(truth), features(image), weights, strict=True):
                layer = torch.nn.functional.conv2d((a - b) ** 2, weight)
                total += float(_masked_mean(layer, mask))
        return total

    def _masked_mean(layer: torch.Tensor, mask: np.ndarray | None) -> torch.Tensor:
        if mask is None:
            return layer.mean()
        weight = torch.from_numpy(mask.astype(np.float32))[None, None]
        weight = torch.nn.functional.interpolate(weight, layer.shape[2:], mode="area")
        return (layer * weight).sum() / weight.sum()

    return measure
