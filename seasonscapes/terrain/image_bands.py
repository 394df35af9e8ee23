"""What the numbers of an image file mean: which bands are its colours, which value is white, and what is impossible."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.images import linear_from_srgb
from seasonscapes.terrain.raster_bands import alpha_band, colour_table, marked_alpha
from seasonscapes.terrain.raster_files import OWN_FOLDER, Confinement, open_raster

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

_BYTE_SCALE = 255.0
# An image whose brightest pixel is darker than this share of full scale was read with a wrong full scale.
_DARKEST_IMAGE = 0.02
# Reflectances of sunlit snow slopes and clouds exceed 1, and those of shaded water fall below 0, but not everywhere.
_MOST_REFLECTANCE, _LEAST_REFLECTANCE = 1.2, -0.02
_CURE = "state [imagery] full_scale, the value that is white (or a reflectance of 1), and encoding"


@dataclass(frozen=True)
class ImageFacts:
    """What a file and its declaration say of an image's numbers; made by `image_facts`.

    Parameters
    ----------
    bands
        Red, green and blue, or one band.
    full_scale
        Value, after the file's own scale and offset, that corresponds to 1.
    told
        What was understood beyond the obvious, one line each.
    """

    bands: tuple[int, ...]
    full_scale: float
    told: tuple[str, ...]


def image_facts(
    path: str | os.PathLike[str],
    *,
    bands: tuple[int, ...] | None = None,
    full_scale: float | None = None,
    confinement: Confinement = OWN_FOLDER,
) -> ImageFacts:
    """Read from a file's header which bands are colours and which value is white.

    Parameters
    ----------
    path, confinement
        As in `raster_files.open_raster`.
    bands
        Declared red, green and blue band numbers, or one band; ``None`` for those that the file marks.
    full_scale
        Declared value of white; ``None`` for 1 where the numbers are fractions (floats, or scaled by the file's own
        scale and offset), else 255.

    Raises
    ------
    InputError
        Neither one nor three colour bands; CMYK; bands that the file does not have.
    """
    where = os.fspath(path)
    with open_raster(path, confinement) as source:
        told = []
        if bands is None:
            bands = _colour_bands(source, where)
            if len(bands) == 3 and list(bands) != sorted(bands):
                told.append(
                    f"{where}: red, green and blue are its bands {', '.join(map(str, bands))}, as the file marks"
                )
        for band in bands:
            if band not in source.indexes:
                raise InputError(where, "no such band", got=band, expected=f"1 … {source.count}")
        alpha = marked_alpha(source)
        if alpha is not None and alpha not in bands and alpha_band(source) is None:
            told.append(
                f"{where}: band {alpha} is marked as alpha but holds measured values; it is not taken for a mask"
            )
        if len(bands) == 1 and colour_table(source, bands[0]) is not None:
            told.append(f"{where}: colours by its colour table")
        if source.tags(ns="IMAGE_STRUCTURE").get("SOURCE_COLOR_SPACE", "").startswith(("CMYK", "YCCK")):
            told.append(f"{where}: made for print (CMYK); its colours are converted without a profile")
        scaled = any(source.scales[band - 1] != 1.0 or source.offsets[band - 1] != 0.0 for band in bands)
        if scaled:
            scale, offset = source.scales[bands[0] - 1], source.offsets[bands[0] - 1]
            told.append(f"{where}: numbers scaled as the file says, × {scale:g} {offset:+g}")
        fractions = scaled or all(np.dtype(source.dtypes[band - 1]).kind == "f" for band in bands)
    if full_scale is None:
        full_scale = 1.0 if fractions else _BYTE_SCALE
        if fractions:
            told.append(f"{where}: no full scale is stated; 1 is white")
    return ImageFacts(tuple(bands), full_scale, tuple(told))


def marked_colours(source: DatasetReader) -> tuple[int, int, int] | None:
    """Numbers of the bands that a file marks as red, green and blue; ``None`` where it does not mark all three."""
    from rasterio.enums import ColorInterp

    kinds = dict(zip(source.colorinterp, source.indexes, strict=True))
    colours = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
    if not all(kind in kinds for kind in colours):
        return None
    red, green, blue = (kinds[kind] for kind in colours)
    return red, green, blue


def _colour_bands(source: DatasetReader, where: str) -> tuple[int, ...]:
    """Bands that a file marks as red, green and blue; else all its bands but alpha, one or three of them."""
    from rasterio.enums import ColorInterp

    kinds = dict(zip(source.colorinterp, source.indexes, strict=True))
    if any(kind in kinds for kind in (ColorInterp.cyan, ColorInterp.magenta, ColorInterp.yellow)):
        raise InputError(
            where,
            "its bands are printing inks (CMYK)",
            expected="red, green and blue, or grey",
            cure="convert it to sRGB in a program that applies its colour profile",
        )
    marked = marked_colours(source)
    if marked is not None:
        return marked
    bands = tuple(band for band in source.indexes if band != marked_alpha(source))
    if len(bands) not in (1, 3):
        raise InputError(
            where,
            "not a colour image",
            got=len(bands),
            expected="one (grey) or three bands, and alpha",
            cure="name its red, green and blue bands",
        )
    return bands


class Decoder:
    """Turns numbers into linear values strip by strip, and refuses an image whose numbers cannot be what was stated.

    Parameters
    ----------
    path
        File, for messages.
    encoding
        ``srgb`` or ``linear``.
    full_scale
        Value that corresponds to 1.
    """

    def __init__(self, path: str | os.PathLike[str], encoding: str, full_scale: float):
        self._where, self._encoding, self._full_scale = os.fspath(path), encoding, full_scale
        self._count = self._above = self._below = 0
        self._low, self._high = np.inf, -np.inf

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Linear values of a strip ``(H, W, C)``; NaN stays."""
        values = values / self._full_scale
        known = values[np.isfinite(values)]
        if known.size:
            self._count += known.size
            self._above += int((known > _MOST_REFLECTANCE).sum())
            self._below += int((known < _LEAST_REFLECTANCE).sum())
            self._low, self._high = min(self._low, float(known.min())), max(self._high, float(known.max()))
        if self._encoding == "linear":
            return np.maximum(values, 0.0)
        if self._high > 1.0:
            self._refuse("brighter than full scale", self._high, f"at most {self._full_scale:g}")
        with np.errstate(invalid="ignore"):
            return linear_from_srgb(values)

    def check(self) -> None:
        """Raise `InputError` where the image as a whole is impossible; call it after the last strip."""
        if not self._count:
            return
        srgb = self._encoding == "srgb"
        if self._above > 0.5 * self._count:
            self._refuse("brighter than full scale nearly everywhere", self._high, f"at most {self._full_scale:g}")
        if (srgb and self._low < 0.0) or self._below > 1e-3 * self._count:
            self._refuse(
                "negative colours", self._low, "at least 0", cure="declare the value that means no data, or " + _CURE
            )
        if self._high < _DARKEST_IMAGE:
            self._refuse("black everywhere", self._high, f"values up to about {self._full_scale:g}")

    def _refuse(self, problem: str, value: float, expected: str, *, cure: str = _CURE) -> None:
        raise InputError(self._where, problem, got=f"{value * self._full_scale:g}", expected=expected, cure=cure)
