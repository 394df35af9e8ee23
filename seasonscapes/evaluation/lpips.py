"""LPIPS with AlexNet: perceptual distance of two images in the feature space of a classification network.

Zhang, Isola, Efros, Shechtman & Wang 2018 (doi:10.1109/CVPR.2018.00068), version 0.1. Its weights are published in two
parts, neither of which this package holds: the network by torchvision (``alexnet-owt-7be5be79.pth``, keys
``features.0.weight`` …), the linear layers by the authors (``lpips/weights/v0.1/alex.pth`` in their wheel ``lpips``, keys
``lin0.model.1.weight`` …). `join_lpips` joins both to one file of plain tensors, which `load_lpips` reads.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path

if TYPE_CHECKING:
    import torch

ENVIRONMENT = "SEASONSCAPES_LPIPS"
NETWORK_URL = "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"
WHEEL_MEMBER = "lpips/weights/v0.1/alex.pth"
# SHA-256 of the published files. The network's begins with the eight digits of its name.
PUBLISHED = {
    "alexnet_sha256": "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
    "linear_sha256": "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
}
_KIND, _FACTS = "LPIPS, AlexNet, version 0.1", "lpips"
# Of the linear layers in the wheel; the published ones take 6 kB.
_MOST_LINEAR_BYTES = 1_000_000
# Mean and standard deviation of ImageNet colours, for values in [-1, 1].
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
# Convolutional layers: index in torchvision's `features`, stride, padding, and whether max pooling precedes it.
_LAYERS = ((0, 4, 2, False), (3, 1, 2, True), (6, 1, 1, True), (8, 1, 1, False), (10, 1, 1, False))
# Channels out and in, and side of each kernel.
_KERNELS = ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))
_NETWORK_SHAPES = {
    f"features.{n}.{kind}": shape
    for (n, *_), (channels, before, side) in zip(_LAYERS, _KERNELS, strict=True)
    for kind, shape in (("weight", (channels, before, side, side)), ("bias", (channels,)))
}
_LINEAR_SHAPES = {f"lin{i}.model.1.weight": (1, channels, 1, 1) for i, (channels, *_) in enumerate(_KERNELS)}
_SMALLEST_PX = 31
Lpips = Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]


def missing_lpips(file: Path | None = None) -> str | None:
    """Describe why LPIPS is not available.

    Parameters
    ----------
    file
        File of the weights; the value of the environment variable ``SEASONSCAPES_LPIPS`` if omitted.

    Returns
    -------
    str or None
        Reason, or ``None`` if the file exists.
    """
    if file is None and ENVIRONMENT not in os.environ:
        return f"no file of weights is given (set {ENVIRONMENT}; `seasonscapes lpips` makes it)"
    file = file or Path(os.environ[ENVIRONMENT])
    return None if file.is_file() else f"no such file: {file}"


def join_lpips(network: Path, linear: Path, output: Path) -> dict[str, str]:
    """Join the two published parts of LPIPS's weights to one file of plain tensors.

    Parameters
    ----------
    network
        State dict of torchvision's AlexNet, ``alexnet-owt-7be5be79.pth``; only its convolutions are kept.
    linear
        The wheel ``lpips-*.whl``, or its file ``lpips/weights/v0.1/alex.pth``.
    output
        ``.safetensors`` file to write.

    Returns
    -------
    dict
        SHA-256 of both parts, as `PUBLISHED` holds those of the published files.

    Raises
    ------
    InputError
        If a file is missing, damaged, holds anything but tensors, or other weights.
    """
    from safetensors.torch import save

    kept, sources = {}, {"kind": _KIND}
    for name, path, shapes in (("alexnet", network, _NETWORK_SHAPES), ("linear", linear, _LINEAR_SHAPES)):
        content = _content(path)
        weights = _checked(_unpickled(content, path), path, shapes)
        sources[f"{name}_sha256"] = hashlib.sha256(content).hexdigest()
        kept |= {key: weights[key].detach().float().contiguous() for key in shapes}
    # One entry: the order of several is not the same in each file.
    facts = {_FACTS: json.dumps(sources | {"content_sha256": _digest(kept)})}
    with atomic_path(output) as temporary:
        temporary.write_bytes(save(kept, metadata=facts))
    return {key: sources[key] for key in PUBLISHED}


def lpips_sources(file: Path | None = None) -> dict[str, Any]:
    """What the weights of a file were made from.

    Parameters
    ----------
    file
        As of `load_lpips`.

    Returns
    -------
    dict
        SHA-256 of both parts, and ``published``: whether both are the published files. Scores by other weights cannot be
        compared with LPIPS of other works.
    """
    _, sources = _opened(file)
    found = {key: sources.get(key, "") for key in PUBLISHED}
    return {**found, "published": found == PUBLISHED}


def load_lpips(file: Path | None = None) -> Lpips:
    """Load LPIPS from the file that `join_lpips` wrote.

    Parameters
    ----------
    file
        File of the weights; the value of the environment variable ``SEASONSCAPES_LPIPS`` if omitted.

    Returns
    -------
    callable
        Function of two images ``(H, W, 3)``, sRGB-encoded in [0, 1], and a mask ``(H, W)`` bool or ``None``, that
        returns their LPIPS within the mask, or over the whole image.

    Raises
    ------
    FileNotFoundError
        If the file is missing (`missing_lpips`).
    InputError
        If it is damaged or holds other weights.
    """
    weights, _ = _opened(file)
    return lpips_of(weights, weights)


def _opened(file: Path | None) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    """Tensors and metadata of a file of `join_lpips`."""
    from safetensors import SafetensorError, safe_open

    reason = missing_lpips(file)
    if reason is not None:
        raise FileNotFoundError(f"LPIPS: {reason}")
    file = file or Path(os.environ[ENVIRONMENT])
    cure = "make it with `seasonscapes lpips`"
    try:
        with safe_open(file, "pt") as opened:
            sources = json.loads((opened.metadata() or {}).get(_FACTS, "{}"))
            weights = {key: opened.get_tensor(key) for key in opened.keys()}  # noqa: SIM118  (no mapping)
    except (SafetensorError, OSError, json.JSONDecodeError) as error:
        raise InputError(file, f"not readable as weights of LPIPS: {error}", cure=cure) from None
    _checked(weights, file, _NETWORK_SHAPES | _LINEAR_SHAPES)
    if (
        not isinstance(sources, dict)
        or sources.get("kind") != _KIND
        or sources.get("content_sha256") != _digest(weights)
    ):
        raise InputError(file, "damaged, or not weights of LPIPS: its content is not what its checksum says", cure=cure)
    return weights, sources


def _digest(weights: Mapping[str, torch.Tensor]) -> str:
    digest = hashlib.sha256()
    for key in sorted(weights):
        digest.update(key.encode() + weights[key].numpy().tobytes())
    return digest.hexdigest()


def _content(path: Path) -> bytes:
    """Bytes of a part of the weights, taken out of the wheel where it is one."""
    if not path.is_file():
        raise InputError(path, "no such file", expected=f"{NETWORK_URL.rsplit('/', 1)[-1]}, or lpips-*.whl")
    if path.suffix.lower() != ".whl":
        return path.read_bytes()
    try:
        with zipfile.ZipFile(path) as wheel:
            if wheel.getinfo(WHEEL_MEMBER).file_size > _MOST_LINEAR_BYTES:
                raise InputError(path, f"{WHEEL_MEMBER} in it is too large", expected="the wheel of lpips")
            return wheel.read(WHEEL_MEMBER)
    except KeyError:
        raise InputError(path, f"holds no {WHEEL_MEMBER}", expected="the wheel of lpips") from None
    except zipfile.BadZipFile as error:
        raise InputError(path, f"damaged: {error}", cure="download the wheel again") from None


def _checked(weights: Any, path: Path, shapes: Mapping[str, tuple[int, ...]]) -> Mapping[str, torch.Tensor]:
    """The weights, if they hold all tensors in their shapes; else `InputError`."""
    missing = [key for key in shapes if not isinstance(weights, Mapping) or key not in weights]
    if missing:
        problem = f"not the weights of LPIPS: {len(missing)} of {len(shapes)} keys are missing"
        raise InputError(path, problem, expected=f"the key {missing[0]}")
    for key, shape in shapes.items():
        if tuple(getattr(weights[key], "shape", ())) != shape:
            got = tuple(getattr(weights[key], "shape", ()))
            raise InputError(path, f"not the weights of LPIPS: {key} has another shape", got=got, expected=str(shape))
    return weights


def _unpickled(content: bytes, path: Path) -> Any:
    """The tensors of a weight file; `InputError` for a damaged one, and for one that would run code to be loaded."""
    import pickle
    import warnings

    import torch

    try:
        with warnings.catch_warnings():
            # About pickles of another kind, which are refused below.
            warnings.simplefilter("ignore", UserWarning)
            return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
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
