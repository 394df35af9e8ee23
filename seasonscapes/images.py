"""Image input and output (OpenEXR, PNG), exposure metering and the tone curve.

In memory an image has row 0 on top and is float32, scene-linear Rec.709, photometric: its luminance Y is in cd/m².
sRGB encoding is used in files only. Exposure is EV100: ``luminance = 2**EV100 * 12.5 / 100`` is metered as middle grey.
"""

from __future__ import annotations

import errno
import io
import json
import logging
import os
import secrets
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.errors import NoUsablePixels, UnreadableImage

log = logging.getLogger(__name__)

# Reflected-light meter calibration constant (ISO 2720) at ISO 100.
METER_CONSTANT = 12.5 / 100.0
# Luminance that just saturates a sensor at EV100 = 0: 78 / (S q) with q = 0.65 (ISO 12232; Lagarde & de Rousiers 2014).
SATURATION_LUMINANCE = 1.2
# Of a file's name in that of its temporary file.
_STEM_CHARACTERS = 24
_notes: list[Callable[[Path], None]] = []
# Luminance weights of linear Rec.709 (ITU-R BT.709): Y = w · rgb. In photometric RGB, Y is in lux or cd/m².
# Linear Rec.709 with D65 white to CIE XYZ (ITU-R BT.709-6), as colour-science derives it from the primaries; that package
# takes seconds to import.
XYZ_FROM_REC709 = np.array(
    [
        [0.4123907992659595, 0.3575843393838780, 0.1804807884018343],
        [0.2126390058715104, 0.7151686787677559, 0.0721923153607337],
        [0.0193308187155918, 0.1191947797946259, 0.9505321522496608],
    ]
)
REC709_LUMINANCE = XYZ_FROM_REC709[1]


@contextmanager
def writes_noted(note: Callable[[Path], None]) -> Iterator[None]:
    """Context manager: ``note`` is called with each file that `atomic_path` is about to create, temporary ones included.

    Parameters
    ----------
    note
        Called before the file exists, from any thread of this process.
    """
    _notes.append(note)
    try:
        yield
    finally:
        _notes.remove(note)


@contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[Path]:
    """Context manager for atomic writing: a temporary path that replaces ``path`` when the block succeeds.

    After an exception in the block ``path`` is unchanged and the temporary file is removed; an `OSError` about the
    temporary file names ``path``. The temporary name keeps the suffix, since many writers choose the format by it.

    Parameters
    ----------
    path
        Destination; missing parent folders are created.

    Yields
    ------
    Path
        Temporary path in the same folder to write to.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Of a long name only the beginning, so that the temporary one is not too long where the name itself is not.
    name = str(path.with_name(f".{path.stem[:_STEM_CHARACTERS]}-{secrets.token_hex(4)}.part{path.suffix}"))
    for note in tuple(_notes):
        note(Path(name))
        note(path)
    try:
        os.close(os.open(name, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    temporary = Path(name)
    try:
        yield temporary
        # The temporary file is private; set the mode that open() would have set.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        os.replace(temporary, path)
    except Exception as error:
        trouble = _trouble_of_writing(error, name, path)
        if trouble is None:
            raise
        raise trouble from error
    finally:
        temporary.unlink(missing_ok=True)


def _trouble_of_writing(error: Exception, temporary: str, path: Path) -> OSError | None:
    """The `OSError` about ``path`` that an exception stands for, or ``None`` if it is none or about another file.

    A full disk is reported with the temporary name or with none; OpenEXR, safetensors and GDAL report it in exceptions of
    their own, by the system's words.
    """
    if isinstance(error, OSError) and error.errno is not None:
        if error.filename not in (None, temporary, Path(temporary)):
            return None
        return OSError(error.errno, error.strerror, str(path))
    said = str(error).lower()
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EIO):
        if os.strerror(number).lower() in said:
            return OSError(number, os.strerror(number), str(path))
    if "failed to write" in said:
        return OSError(errno.EIO, f"cannot be written ({error})", str(path))
    return None


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """Encode linear values as sRGB (IEC 61966-2-1).

    Parameters
    ----------
    linear
        Linear values ``(...)``, clipped to [0, 1].

    Returns
    -------
    ndarray
        Encoded values in [0, 1] ``(...)``.

    Examples
    --------
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> ss.srgb_from_linear(np.array([0.0, 0.2140411, 1.0])).round(4).tolist()
    [0.0, 0.5, 1.0]
    """
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1.0 / 2.4) - 0.055)


def srgb8_from_linear(linear: np.ndarray) -> np.ndarray:
    """Encode linear values ``(...)``, clipped to [0, 1], as sRGB levels, uint8, without dithering."""
    return np.rint(srgb_from_linear(linear) * 255.0).astype(np.uint8)


def linear_from_srgb(encoded: ArrayLike) -> np.ndarray:
    """Decode sRGB values (IEC 61966-2-1); the inverse of `srgb_from_linear`.

    Parameters
    ----------
    encoded
        Encoded values in [0, 1] ``(...)``.

    Returns
    -------
    ndarray
        Linear values in [0, 1] ``(...)``, float32.
    """
    encoded = np.asarray(encoded, np.float32)
    return np.where(encoded <= 0.04045, encoded / 12.92, np.power((encoded + 0.055) / 1.055, 2.4)).astype(np.float32)


def image_luminance(image: np.ndarray) -> np.ndarray:
    """Luminance of linear Rec.709 ``(..., 3)``, in the precision of the image."""
    image = np.asarray(image)
    if not np.issubdtype(image.dtype, np.floating):
        image = image.astype(np.float64)
    return image @ REC709_LUMINANCE.astype(image.dtype)


def auto_exposure_ev100(image: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Compute the EV100 that places the log-average luminance of an image at middle grey.

    Only luminances between the 2nd and the 98th percentile are averaged, so that the result depends neither on the
    solar disc nor on black corners.

    Parameters
    ----------
    image
        Scene-linear image ``(H, W, 3)`` [cd/m²].
    mask
        Pixels to meter ``(H, W)``, boolean; all if omitted.

    Returns
    -------
    float
        EV100.

    Raises
    ------
    NoUsablePixels
        If no metered pixel has a finite, positive luminance.
    """
    values = image_luminance(image)[... if mask is None else mask].ravel()
    values = values[np.isfinite(values) & (values > 0.0)]
    if values.size == 0:
        raise NoUsablePixels("auto exposure: the image has no positive luminance; give an EV100")
    low, high = np.percentile(values, [2.0, 98.0])
    metered = np.exp(np.mean(np.log(values[(values >= low) & (values <= high)]), dtype=np.float64))
    return float(np.log2(metered / METER_CONSTANT))


def expose(image: np.ndarray, ev100: float) -> np.ndarray:
    """Scale a scene-linear image by an exposure, before the tone curve.

    Parameters
    ----------
    image
        Scene-linear image ``(..., 3)`` [cd/m²].
    ev100
        Exposure value at ISO 100.

    Returns
    -------
    ndarray
        Exposed linear values ``(..., 3)``; 1 is the luminance that saturates a sensor.
    """
    return np.asarray(image) / (SATURATION_LUMINANCE * 2.0**ev100)


def largest_channel(image: np.ndarray) -> np.ndarray:
    """The largest of three channels ``(..., 3)``, as ``(..., 1)``: an order of magnitude quicker than along the last axis."""
    return np.maximum(np.maximum(image[..., :1], image[..., 1:2]), image[..., 2:])


def scaled_pixels(image: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Pixels ``(..., 3)`` times a factor ``(...)`` of each, float32: several times quicker than by broadcasting along the last axis."""
    import cv2  # slow to load

    values = np.ascontiguousarray(factor, np.float32).reshape(1, -1)
    if values.size == 0:
        return np.zeros((*np.shape(factor), 3), np.float32)
    scaled = np.asarray(cv2.merge([values, values, values])).reshape(*np.shape(factor), 3)
    return np.multiply(scaled, image, out=scaled)


# Shape of the tone curve: a constant gain, linear (no toe) up to the start of the shoulder, then a long soft shoulder.
_SHOULDER_START, _WHITE = 0.30, 8.0
EXPOSURE_GAIN = 1.6


def tone_curve(exposed: np.ndarray) -> np.ndarray:
    """Compress exposed linear values to the display range.

    Linear up to a shoulder; above it the *largest* channel is compressed smoothly towards 1. The other channels are
    scaled in proportion, which preserves hue, and strongly compressed colours are desaturated towards white, which
    avoids flat discs of saturated colour around the sun. Same construction as Khronos PBR Neutral (2024) with a wider
    shoulder, because landscapes have a larger dynamic range than products.

    Parameters
    ----------
    exposed
        Exposed linear values ``(..., 3)`` from `expose`.

    Returns
    -------
    ndarray
        Display-linear values in [0, 1] ``(..., 3)``, float32.
    """
    colour = np.maximum(np.asarray(exposed, np.float32) * EXPOSURE_GAIN, 0.0)
    peak = largest_channel(colour)
    compressed = _compressed_peak(peak)
    scaled = colour * (compressed / np.maximum(peak, 1e-12))
    whiten = _whitening(peak, compressed)
    return scaled + (compressed - scaled) * whiten


def linear_from_display(picture: np.ndarray, ev100: float) -> np.ndarray:
    """Invert `expose` and `tone_curve`: from a display-linear picture to scene-linear values.

    Parameters
    ----------
    picture
        Display-linear values ``(..., 3)`` in [0, 1].
    ev100
        The exposure that it was developed with.

    Returns
    -------
    ndarray
        Scene-linear values ``(..., 3)`` [cd/m²], float32; of clipped highlights, the least that could be.

    Examples
    --------
    >>> import numpy as np
    >>> from seasonscapes.images import expose, linear_from_display, tone_curve
    >>> scene = np.array([[900.0, 4000.0, 20000.0]])
    >>> bool(np.allclose(linear_from_display(tone_curve(expose(scene, 13.0)), 13.0), scene, rtol=1e-3))
    True
    """
    shown = np.asarray(picture, np.float64)
    compressed = shown.max(axis=-1, keepdims=True)
    # The curve of the largest channel rises to 1; its inverse is read from a table.
    peaks = np.concatenate(
        [np.linspace(0.0, _SHOULDER_START, 2), np.geomspace(_SHOULDER_START, 1.05 * _WHITE, 4096)[1:]]
    )
    peak = np.interp(compressed, _compressed_peak(peaks), peaks)
    whiten = _whitening(peak, compressed)
    scaled = np.maximum(shown - compressed * whiten, 0.0) / (1.0 - whiten)
    colour = scaled * (peak / np.maximum(compressed, 1e-12))
    return (colour / EXPOSURE_GAIN * (SATURATION_LUMINANCE * 2.0**ev100)).astype(np.float32)


def _compressed_peak(peak: np.ndarray) -> np.ndarray:
    """The display value of the largest channel."""
    start, span = _SHOULDER_START, 1.0 - _SHOULDER_START
    excess = np.maximum(peak - start, 0.0)
    compressed = start + span * excess / (excess + span) * (1.0 + excess * span / _WHITE**2)
    return np.where(peak > start, np.minimum(compressed, 1.0), peak)


def _whitening(peak: np.ndarray, compressed: np.ndarray) -> np.ndarray:
    """How far a compressed colour goes to white."""
    return 1.0 - 1.0 / (0.12 * np.maximum(peak - compressed, 0.0) + 1.0)


def write_png(path: str | os.PathLike, image: np.ndarray, *, metadata: Mapping[str, str] | None = None) -> None:
    """Write a display-linear image as a dithered 8-bit sRGB PNG, atomically.

    Parameters
    ----------
    path
        Destination.
    image
        Display-linear values ``(H, W, 3)`` in [0, 1].
    metadata
        Key-value pairs for the PNG's international text chunks.
    """
    # Dithering by up to one level avoids banding in smooth skies; the pattern is fixed, so files are reproducible.
    height, width = image.shape[:2]
    noise = np.random.default_rng(0).random((64, 64), np.float32)
    tiled = np.tile(noise, (height // 64 + 1, width // 64 + 1))[:height, :width, None]
    levels = np.clip(np.floor(srgb_from_linear(image) * 255.0 + tiled), 0, 255).astype(np.uint8)
    write_png8(path, levels, metadata=metadata)


def write_png8(path: str | os.PathLike, levels: np.ndarray, *, metadata: Mapping[str, str] | None = None) -> None:
    """Write 8-bit levels as a PNG, atomically; see `png8_bytes`.

    Parameters
    ----------
    path
        Destination.
    levels
        sRGB-encoded levels ``(H, W, 3)`` or grey levels ``(H, W)``, uint8.
    metadata
        Key-value pairs for the PNG's international text chunks.
    """
    encoded = png8_bytes(levels, metadata=metadata)
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded)


def png8_bytes(levels: np.ndarray, *, metadata: Mapping[str, str] | None = None) -> bytes:
    """Encode 8-bit levels as a PNG whose colours are declared to be sRGB.

    Parameters
    ----------
    levels
        sRGB-encoded levels ``(H, W, 3)``, or grey levels ``(H, W)`` (masks, counts), whose scale is not declared; uint8.
    metadata
        Key-value pairs for the PNG's international text chunks.

    Returns
    -------
    bytes
        The file's content.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    info = PngInfo()
    if levels.ndim == 3:
        # Rendering intent 0 (perceptual); gAMA of 1 / 2.2 for readers that do not know the chunk (PNG 3rd ed., 11.3.2.5).
        info.add(b"sRGB", b"\x00")
        info.add(b"gAMA", (45455).to_bytes(4, "big"))
    for key, value in (metadata or {}).items():
        info.add_itxt(key, value)
    encoded = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(levels)).save(encoded, format="PNG", pnginfo=info)
    return encoded.getvalue()


# Formats of photographs. Pillow reads more, and some of them run other programs (EPS).
_PHOTO_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP", "PPM", "GIF", "JPEG2000")
_EXIF_ORIENTATION, _SIDEWAYS = 0x0112, (5, 6, 7, 8)
# The largest webcam panoramas have some 100 megapixels; a few bytes of a file can declare any size.
_MOST_PIXELS = 300_000_000


@contextmanager
def _opened(path: str | os.PathLike) -> Iterator[Any]:
    """A photograph opened by Pillow; everything that is wrong with it in the block is one `UnreadableImage`."""
    import struct
    import zlib

    from PIL import Image, UnidentifiedImageError

    if not Path(path).is_file():
        raise FileNotFoundError(path)
    try:
        with warnings.catch_warnings():
            # Our own limit holds.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=_PHOTO_FORMATS) as picture:
                if picture.width * picture.height > _MOST_PIXELS:
                    raise UnreadableImage(
                        f"{path}: the picture is too large; got {picture.width} x {picture.height}, expected at most "
                        f"{_MOST_PIXELS // 1_000_000} megapixels"
                    )
                yield picture
    except UnidentifiedImageError:
        kinds = ", ".join(_PHOTO_FORMATS)
        raise UnreadableImage(f"{path}: not a readable picture; expected {kinds} of 8 or 16 bits") from None
    except Image.DecompressionBombError:
        raise UnreadableImage(f"{path}: the picture is too large to be one") from None
    except (OSError, SyntaxError, ValueError, TypeError, struct.error, zlib.error, EOFError) as error:
        if isinstance(error, UnreadableImage):
            raise
        raise UnreadableImage(f"{path}: not a readable picture: {' '.join(str(error).split())}") from None


def picture_size(path: str | os.PathLike) -> tuple[int, int, str]:
    """Width and height [px] of a photograph as it is looked at, after its EXIF orientation, and its format.

    Raises
    ------
    FileNotFoundError, UnreadableImage
        As `read_image_srgb`; only the header is read.
    """
    with _opened(path) as picture:
        width, height = picture.size
        if picture.format == "TIFF":
            # Some versions of Pillow have turned the size already.
            width, height = picture.tag_v2[256], picture.tag_v2[257]
        if picture.getexif().get(_EXIF_ORIENTATION) in _SIDEWAYS:
            width, height = height, width
        return width, height, str(picture.format)


def read_image_srgb(path: str | os.PathLike) -> np.ndarray:
    """Read a photograph as sRGB: turned by its EXIF orientation, with its colour profile converted.

    This is the only reader of photographs, so that all commands see the same pixels at the same places.

    Parameters
    ----------
    path
        JPEG, PNG, TIFF, WebP, JPEG 2000, BMP, PPM or GIF of 8 or 16 bits: grey, RGB, CMYK or with a palette. Alpha is
        ignored.

    Returns
    -------
    ndarray
        sRGB-encoded values ``(H, W, 3)``: uint8, or uint16 where the file has 16 bits.

    Raises
    ------
    FileNotFoundError
        If the file does not exist.
    UnreadableImage
        If the file is no such picture, is truncated, or declares an absurd size.
    """
    from PIL import ImageOps

    with _opened(path) as picture:
        deep = picture.mode.startswith("I;16") or any("16" in str(tile[3]) for tile in picture.tile)
        if picture.mode in ("F", "I") and not deep:
            kind = "float" if picture.mode == "F" else "32-bit"
            raise UnreadableImage(f"{path}: not a readable picture; got {kind} pixels, expected 8 or 16 bits")
        picture.load()
        foreign = _foreign_profile(path, picture)
        if not deep or foreign is not None:
            turned = ImageOps.exif_transpose(picture)
            assert turned is not None, "a new picture where it is not asked to change in place"
            if deep:
                log.warning("%s: converted to sRGB with 8 of its 16 bits", path)
            return np.ascontiguousarray(_to_srgb(path, turned, foreign))
    # Pillow keeps 8 bits of each channel; OpenCV keeps 16, and turns by the orientation as well.
    import cv2  # slow to load, and few commands read pictures

    levels = cv2.imread(os.fspath(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if levels is None or not np.issubdtype(levels.dtype, np.integer):
        raise UnreadableImage(f"{path}: not a readable picture of 16 bits; save it without an orientation tag")
    return np.ascontiguousarray(levels[..., ::-1])


def _foreign_profile(path: str | os.PathLike, picture: Any) -> Any:
    """The embedded colour profile of a picture where it is not sRGB, else ``None``."""
    import io

    from PIL import ImageCms

    embedded = picture.info.get("icc_profile")
    if not embedded:
        return None
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(embedded))
        name = ImageCms.getProfileDescription(profile)
    except (ImageCms.PyCMSError, OSError):
        log.warning("%s: its colour profile is damaged; the colours count as sRGB", path)
        return None
    return None if "srgb" in name.lower() else profile


def _to_srgb(path: str | os.PathLike, picture: Any, profile: Any) -> np.ndarray:
    """8-bit sRGB levels ``(H, W, 3)`` of a loaded picture, through its profile where there is one."""
    from PIL import ImageCms

    # Profiles are made for these modes; all others are ways of storing them.
    if picture.mode not in ("L", "RGB", "CMYK", "LAB"):
        picture = picture.convert("L" if picture.mode in ("1", "LA", "La", "I;16", "I;16B", "I;16L") else "RGB")
    if profile is not None:
        try:
            srgb = ImageCms.createProfile("sRGB")
            converted = ImageCms.profileToProfile(picture, profile, srgb, outputMode="RGB")
        except ImageCms.PyCMSError as error:
            raise UnreadableImage(f"{path}: its colour profile does not fit its pixels: {error}") from None
        assert converted is not None, "a new picture where it is not asked to change in place"
        log.info("%s: converted to sRGB from %s", path, ImageCms.getProfileDescription(profile).strip())
        return np.asarray(converted)
    if picture.mode == "CMYK":
        log.warning("%s: made for print (CMYK) and without a colour profile; its colours are a guess", path)
    return np.asarray(picture.convert("RGB"))


def read_image_srgb8(path: str | os.PathLike) -> np.ndarray:
    """`read_image_srgb` in 8 bits ``(H, W, 3)``, whatever the file has."""
    levels = read_image_srgb(path)
    return levels if levels.dtype == np.uint8 else np.round(levels / 257.0).astype(np.uint8)


def read_image_linear(path: str | os.PathLike) -> np.ndarray:
    """`read_image_srgb` decoded to linear Rec.709.

    Returns
    -------
    ndarray
        Linear Rec.709 ``(H, W, 3)`` in [0, 1], float32.

    Raises
    ------
    FileNotFoundError, UnreadableImage
        As `read_image_srgb`.
    """
    levels = read_image_srgb(path)
    return linear_from_srgb(levels.astype(np.float32) / np.iinfo(levels.dtype.name).max)


def write_exr(
    path: str | os.PathLike,
    layers: Mapping[str, np.ndarray],
    *,
    header: Mapping[str, Any] | None = None,
    half: bool = False,
) -> None:
    """Write named layers to one OpenEXR file, atomically.

    Parameters
    ----------
    path
        Destination.
    layers
        Mapping from layer name to values ``(H, W)``, ``(H, W, 2)`` or ``(H, W, 3)``. The layer ``""`` is written as
        channels R, G, B, any other three-channel layer as ``name.R``, ``name.G``, ``name.B``. Layers ``normal`` and
        ``position`` use ``.X .Y .Z`` and ``uv`` uses ``.U .V``. A single-channel layer uses ``.Z`` if it is named
        ``depth``, ``.A`` if ``mask`` or ``alpha``, and ``.Y`` otherwise.
    header
        Attributes. Strings and floats are stored as such, everything else as JSON text.
    half
        Store half precision (largest value 65504, three significant digits) in place of single precision.
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
    attributes: dict[str, Any] = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for key, value in (header or {}).items():
        attributes[key] = value if isinstance(value, (str, float)) else json.dumps(value)
    with atomic_path(path) as temporary:
        OpenEXR.File(attributes, channels).write(os.fspath(temporary))
        _require_whole_exr(temporary, path)


def _require_whole_exr(temporary: Path, path: str | os.PathLike) -> None:
    """`OSError` where a written file cannot be read: the library says nothing of a disk that is full when a file is closed."""
    try:
        read_exr(temporary)
    except UnreadableImage as error:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), os.fspath(path)) from error


def read_exr(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read the layers and the header of an OpenEXR file; the inverse of `write_exr`.

    Parameters
    ----------
    path
        OpenEXR file.

    Returns
    -------
    layers
        Mapping from layer name to values ``(H, W)`` or ``(H, W, C)``.
    header
        Attributes of the file.

    Raises
    ------
    FileNotFoundError
        If the file does not exist.
    UnreadableImage
        If the file is not an OpenEXR file that can be decoded.
    """
    import OpenEXR

    if not Path(path).is_file():
        raise FileNotFoundError(path)
    try:
        with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
            header = dict(file.header())
    except (RuntimeError, ValueError) as error:
        raise UnreadableImage(f"{path}: not a readable OpenEXR file ({error})") from None
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
