"""Texture images of meshes: decoding with 8 or 16 bits, their size before they are read, and encoding."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.images import linear_from_srgb, srgb_from_linear
from seasonscapes.terrain.textured_mesh import MeshTexture

# Memory that a texel takes at the peak: coefficients of its light, and images in single precision [bytes]. Measured with
# textures half of whose texels lie on the surface.
BYTES_PER_TEXEL = 1000


def decode_texture(data: bytes, name: str, where: str) -> MeshTexture:
    """Decode an sRGB image file of 8 or 16 bits.

    Parameters
    ----------
    data
        Contents of the file.
    name
        Of the texture.
    where
        File and texture, for messages.

    Raises
    ------
    InputError
        For data that are no image, CMYK images, and images of another number of bits.
    """
    mode = _header(data, where)[1]
    if mode == "CMYK":
        cure = "convert it to RGB, for example: magick in.jpg -colorspace sRGB out.png"
        raise InputError(where, "a texture in CMYK", got=mode, expected="RGB", cure=cure)
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InputError(where, "not a readable image", expected="PNG, JPEG, TIFF, WebP or BMP")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(where, "pixels of an unusual kind", got=str(pixels.dtype), expected="8 or 16 bits a channel")
    scaled = pixels.reshape(*pixels.shape[:2], -1).astype(np.float32) / float(np.iinfo(pixels.dtype).max)
    colour = np.repeat(scaled, 3, axis=2) if scaled.shape[2] == 1 else scaled[..., 2::-1]
    alpha = np.ascontiguousarray(scaled[..., 3]) if scaled.shape[2] == 4 else None
    return MeshTexture(name, linear_from_srgb(np.ascontiguousarray(colour)), 8 * pixels.dtype.itemsize, alpha)


def image_size(data: bytes, where: str) -> tuple[int, int]:
    """Width and height of an image file, without decoding it."""
    return _header(data, where)[0]


def _header(data: bytes, where: str) -> tuple[tuple[int, int], str]:
    """Size and mode of an image file."""
    from PIL import Image, UnidentifiedImageError

    # Large textures are wanted here; what they need is estimated from their size instead.
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        with Image.open(io.BytesIO(data)) as image:
            return image.size, image.mode
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        expected = "PNG, JPEG, TIFF, WebP or BMP"
        raise InputError(where, f"not a readable image ({error})", expected=expected) from None
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def require_memory(texels: int, where: str, available_bytes: int) -> None:
    """Raise `InputError` where textures need more memory than there is.

    Parameters
    ----------
    texels
        Texels of all textures together.
    where
        File, for the message.
    available_bytes
        Memory of the machine.
    """
    needed = texels * BYTES_PER_TEXEL
    if needed > available_bytes:
        side = int(np.sqrt(texels * available_bytes / needed)) // 256 * 256
        raise InputError(
            where,
            f"textures of {texels / 1e6:.0f} million texels need about {needed / 1e9:.0f} GB of memory",
            expected=f"at most {available_bytes / 1e9:.0f} GB, as this machine has",
            cure=f"reduce the textures to about {max(side, 256)} × {max(side, 256)} texels together",
        )


def encode_texture(values: np.ndarray, alpha: np.ndarray | None, suffix: str, bits: int, where: str) -> bytes:
    """Encode linear values as an sRGB image file.

    Parameters
    ----------
    values
        ``(R, S, 3)`` linear Rec.709 in [0, 1].
    alpha
        ``(R, S)`` opacity, or ``None``.
    suffix
        ``.png``, ``.jpg``, ``.tif`` …
    bits
        8 or 16.
    where
        File, for messages.

    Raises
    ------
    InputError
        For a format that cannot be written.
    """
    top = (1 << bits) - 1
    channels = [srgb_from_linear(values)[..., ::-1]]
    if alpha is not None and suffix.lower() not in (".jpg", ".jpeg"):
        channels.append(alpha[..., None])
    levels = np.rint(np.concatenate(channels, axis=2) * top).astype(np.uint16 if bits == 16 else np.uint8)
    flags: list[int] = []
    if suffix.lower() in (".jpg", ".jpeg"):
        flags = [cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    try:
        done, data = cv2.imencode(suffix.lower(), levels, flags)
    except cv2.error:
        done, data = False, np.empty(0, np.uint8)
    if not done:
        raise InputError(where, "textures of this kind cannot be written", got=suffix, expected=".png, .jpg or .tif")
    return data.tobytes()


def file_suffix(name: str, bits: int) -> str:
    """Suffix of a texture's file: its own, or ``.png`` where it has none or holds no 16 bits."""
    suffix = Path(name).suffix.lower()
    if suffix in (".jpg", ".jpeg") and bits == 8:
        return suffix
    return suffix if suffix in (".png", ".tif", ".tiff") else ".png"
