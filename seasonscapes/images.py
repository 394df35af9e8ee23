"""Pictures on disk and on screen: OpenEXR and PNG files, exposure and the tone curve.

In memory an image has row 0 on top and is float32, scene-linear Rec.709, photometric: its luminance Y is in cd/m².
sRGB exists only in files. Exposure is EV100: ``luminance = 2**EV100 * 12.5 / 100`` is metered as middle grey.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

# Reflected-light meter calibration constant (ISO 2720) at ISO 100.
METER_CONSTANT = 12.5 / 100.0
# Luminance that just saturates a sensor at EV100 = 0: 78 / (S q) with q = 0.65 (ISO 12232; Lagarde & de Rousiers 2014).
SATURATION_LUMINANCE = 1.2
REC709_LUMINANCE = np.array([0.2126390, 0.7151687, 0.0721923])


@contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[Path]:
    """A temporary path beside ``path`` that takes its name only when the block ends well.

    An interrupted or failed block leaves neither a half file nor the temporary one. The temporary name keeps the
    suffix, since many writers choose the format by it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=f".part{path.suffix}", dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes private files; give the result the mode that open() would have given.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1 encoding of values in [0, 1]."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1.0 / 2.4) - 0.055)


def linear_from_srgb(encoded: np.ndarray) -> np.ndarray:
    """Inverse of `srgb_from_linear`."""
    encoded = np.asarray(encoded, np.float32)
    return np.where(encoded <= 0.04045, encoded / 12.92, np.power((encoded + 0.055) / 1.055, 2.4)).astype(np.float32)


def auto_exposure_ev100(image: np.ndarray, mask: np.ndarray | None = None) -> float:
    """EV100 that a camera's average metering would choose for a scene-linear image ``(H, W, 3)`` [cd/m²].

    The log-average luminance, between its 2nd and 98th percentile so that neither a disc of sun nor a black corner
    decides, is placed at the meter's middle grey.
    """
    values = (np.asarray(image, np.float64) @ REC709_LUMINANCE)[... if mask is None else mask].ravel()
    values = values[np.isfinite(values) & (values > 0.0)]
    if values.size == 0:
        raise ValueError("auto exposure: the image has no positive luminance")
    low, high = np.percentile(values, [2.0, 98.0])
    metered = np.exp(np.mean(np.log(values[(values >= low) & (values <= high)])))
    return float(np.log2(metered / METER_CONSTANT))


def expose(image: np.ndarray, ev100: float) -> np.ndarray:
    """Scene-linear [cd/m²] to display-linear before the tone curve; 1 is the luminance that saturates a sensor."""
    return np.asarray(image) / (SATURATION_LUMINANCE * 2.0**ev100)


# The curve's shape: middle grey stays in place up to a camera-like lift, a toe-less foot, a long soft shoulder.
_SHOULDER_START, _WHITE = 0.30, 8.0
_EXPOSURE_GAIN = 1.6


def tone_curve(exposed: np.ndarray) -> np.ndarray:
    """Display-linear values in [0, 1] from exposed linear values ``(..., 3)``.

    Filmic but neutral: linear up to a shoulder, then ``1 - (1 - s) exp``-like compression of the *largest* channel,
    with the others following in proportion (so hues stay) and bleeding towards white as they near the top
    (so that a sun's glow does not turn into a flat disc of colour). Same construction as Khronos PBR Neutral (2024)
    with a wider shoulder, as landscapes hold more range than products.
    """
    colour = np.maximum(np.asarray(exposed, np.float32) * _EXPOSURE_GAIN, 0.0)
    peak = colour.max(axis=-1, keepdims=True)
    start, span = _SHOULDER_START, 1.0 - _SHOULDER_START
    over = np.maximum(peak - start, 0.0)
    compressed = start + span * over / (over + span) * (1.0 + over * span / _WHITE**2)
    compressed = np.where(peak > start, np.minimum(compressed, 1.0), peak)
    scaled = colour * (compressed / np.maximum(peak, 1e-12))
    whiten = 1.0 - 1.0 / (0.12 * np.maximum(peak - compressed, 0.0) + 1.0)
    return scaled + (compressed - scaled) * whiten


def write_png(path: str | os.PathLike, image: np.ndarray, *, metadata: Mapping[str, str] | None = None) -> None:
    """Write display-linear values ``(H, W, 3)`` in [0, 1] as an 8-bit sRGB PNG, atomically, dithered against banding.

    ``metadata`` goes into text chunks.
    """
    # Half a level of ordered noise hides the bands of a smooth sky; the pattern is fixed, so files are reproducible.
    height, width = image.shape[:2]
    noise = np.random.default_rng(0).random((64, 64), np.float32)
    tiled = np.tile(noise, (height // 64 + 1, width // 64 + 1))[:height, :width, None]
    levels = np.clip(np.floor(srgb_from_linear(image) * 255.0 + tiled), 0, 255).astype(np.uint8)
    write_png8(path, levels, metadata=metadata)


def write_png8(path: str | os.PathLike, levels: np.ndarray, *, metadata: Mapping[str, str] | None = None) -> None:
    """Write sRGB-encoded bytes ``(H, W, 3)`` or grey ``(H, W)`` as PNG, atomically."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    info = PngInfo()
    for key, value in (metadata or {}).items():
        info.add_itxt(key, value)
    with atomic_path(path) as temporary:
        Image.fromarray(np.ascontiguousarray(levels)).save(temporary, format="PNG", pnginfo=info)


def read_image_linear(path: str | os.PathLike) -> np.ndarray:
    """Read an 8- or 16-bit picture as linear Rec.709 ``(H, W, 3)`` float32 in [0, 1]; `FileNotFoundError`/`ValueError`."""
    if not Path(path).is_file():
        raise FileNotFoundError(path)
    encoded = cv2.imread(os.fspath(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if encoded is None:
        raise ValueError(f"{path}: not a readable picture")
    top = np.iinfo(encoded.dtype).max
    return linear_from_srgb(encoded[..., ::-1].astype(np.float32) / top)


def write_exr(
    path: str | os.PathLike, layers: Mapping[str, np.ndarray], *, header: Mapping | None = None, half: bool = False
) -> None:
    """Write float32 layers to one OpenEXR file, atomically.

    Parameters
    ----------
    layers
        Layer name to ``(H, W)``, ``(H, W, 2)`` or ``(H, W, 3)``. The name ``""`` is the beauty layer (R, G, B);
        others become ``name.R`` …; ``depth`` of two axes becomes ``depth.Z``; vectors named ``normal`` and
        ``position`` become ``.X .Y .Z`` and ``uv`` becomes ``.U .V``.
    header
        Attributes. Strings and floats are stored as such, everything else as JSON text.
    half
        Store half precision: values up to 65504, three digits.
    """
    import OpenEXR

    channels: dict[str, np.ndarray] = {}
    for name, values in layers.items():
        values = np.ascontiguousarray(values, np.float16 if half else np.float32)
        prefix = f"{name}." if name else ""
        if values.ndim == 2:
            channels[prefix + ("Z" if name == "depth" else "A" if name in ("mask", "alpha") else "Y")] = values
            continue
        axes = {"normal": "XYZ", "position": "XYZ", "uv": "UV"}.get(name, "RGB")
        for index, axis in enumerate(axes[: values.shape[2]]):
            channels[prefix + axis] = np.ascontiguousarray(values[..., index])
    attributes: dict = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for key, value in (header or {}).items():
        attributes[key] = value if isinstance(value, (str, float)) else json.dumps(value)
    with atomic_path(path) as temporary:
        OpenEXR.File(attributes, channels).write(os.fspath(temporary))


def read_exr(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict]:
    """Layers and header of an OpenEXR file, the inverse of `write_exr`."""
    import OpenEXR

    if not Path(path).is_file():
        raise FileNotFoundError(path)
    with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        header = dict(file.header())
    grouped: dict[str, dict[str, np.ndarray]] = {}
    for name, pixels in channels.items():
        layer, _, axis = name.rpartition(".")
        grouped.setdefault(layer, {})[axis] = pixels
    layers = {}
    for layer, axes in grouped.items():
        for order in ("RGB", "XYZ", "UV"):
            if set(axes) == set(order):
                layers[layer] = np.stack([axes[axis] for axis in order], axis=-1)
        if layer not in layers:
            layers[layer] = next(iter(axes.values())) if len(axes) == 1 else np.stack(list(axes.values()), axis=-1)
    return layers, header
