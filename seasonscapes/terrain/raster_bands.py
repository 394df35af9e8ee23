"""Pixels of a raster file as the numbers that they stand for: scale and offset, masks, alpha and colour tables."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from rasterio.io import DatasetReader
    from rasterio.windows import Window

# Alpha of an opaque pixel; masks are also written as 0 and 1.
_OPAQUE = (1, 255, 65535)
_PROBE_PX = 64


def marked_alpha(source: DatasetReader) -> int | None:
    """Number of the band that a file marks as alpha, by its colour interpretation or description."""
    from rasterio.enums import ColorInterp

    for band, kind, text in zip(source.indexes, source.colorinterp, source.descriptions, strict=True):
        if kind == ColorInterp.alpha or (text or "").lower().startswith("alpha"):
            return band
    return None


def alpha_band(source: DatasetReader) -> int | None:
    """Number of the alpha band, or ``None``: a fourth measured band, such as near infrared, is often marked as alpha.

    An alpha band is opaque nearly everywhere that it is not transparent; a measured one takes all values. A band whose
    description says so is alpha whatever it holds.
    """
    band = marked_alpha(source)
    if band is None or (source.descriptions[band - 1] or "").lower().startswith("alpha"):
        return band
    values = _probe(source, band)
    shown = values[values != 0]
    return band if not len(shown) or np.isin(shown, _OPAQUE).mean() > 0.5 else None


def _probe(source: DatasetReader, band: int) -> np.ndarray:
    """Values of a band in 16 small windows spread over the file."""
    from rasterio.windows import Window

    width, height = min(_PROBE_PX, source.width), min(_PROBE_PX, source.height)
    corners = [
        (round(u * (source.width - width)), round(v * (source.height - height)))
        for v in np.linspace(0.0, 1.0, 4)
        for u in np.linspace(0.0, 1.0, 4)
    ]
    read = (
        source.read(band, window=Window(column, row, width, height))  # pyright: ignore[reportCallIssue]
        for column, row in dict.fromkeys(corners)
    )
    return np.concatenate([values.ravel() for values in read])


def colour_table(source: DatasetReader, band: int) -> np.ndarray | None:
    """Colour table of a band ``(N, 4)`` float64, NaN where an entry is transparent or missing; ``None`` without one."""
    from rasterio.enums import ColorInterp

    if source.colorinterp[band - 1] != ColorInterp.palette:
        return None
    entries = source.colormap(band)
    table = np.full((max(entries) + 1, 3), np.nan)
    for index, (red, green, blue, alpha) in entries.items():
        if alpha > 0:
            table[index] = red, green, blue
    return table


@dataclass(frozen=True)
class BandReader:
    """Reads windows of some bands of an open raster as float64 with NaN where there is no data; made by `band_reader`.

    Parameters
    ----------
    source
        The open file.
    bands
        Band numbers from 1.
    alpha
        Band whose zeros mark missing pixels.
    table
        Colour table ``(N, 3)`` that expands the one band into three.
    """

    source: DatasetReader
    bands: tuple[int, ...]
    alpha: int | None
    table: np.ndarray | None

    @property
    def channels(self) -> int:
        """Number of channels of what `read` returns."""
        return len(self.bands) if self.table is None else 3

    def read(self, window: Window) -> np.ndarray:
        """Values ``(H, W, C)`` float64 of a window, with the file's own scale and offset applied."""
        source = self.source
        read = source.read(self.bands, window=window)
        missing = self._missing(window, read.shape)
        if self.table is not None:
            values = self.table[np.minimum(read[0], len(self.table) - 1)]
            values = np.where((read[0] >= len(self.table))[..., None] | missing[0][..., None], np.nan, values)
        else:
            scale = np.array([source.scales[band - 1] for band in self.bands], np.float64)
            offset = np.array([source.offsets[band - 1] for band in self.bands], np.float64)
            values = np.where(missing, np.nan, read.astype(np.float64)).transpose(1, 2, 0) * scale + offset
        if self.alpha is not None:
            values[source.read(self.alpha, window=window) == 0] = np.nan
        return values

    def _missing(self, window: Window, shape: tuple[int, ...]) -> np.ndarray:
        """``(C, H, W)`` bool by the file's nodata values and masks.

        Where nodata is a possible value of a colour, such as 0, a pixel is missing only if all its bands hold it: dark
        water has no red.
        """
        from rasterio.enums import MaskFlags

        flags = self.source.mask_flag_enums[self.bands[0] - 1]
        if MaskFlags.all_valid in flags or (MaskFlags.alpha in flags and MaskFlags.nodata not in flags):
            return np.zeros(shape, bool)
        missing = self.source.read_masks(self.bands, window=window) == 0
        nodata = self.source.nodatavals[self.bands[0] - 1]
        if nodata is not None and nodata >= 0:
            missing = np.broadcast_to(missing.all(axis=0), shape)
        return missing


def band_reader(source: DatasetReader, bands: tuple[int, ...] | None, path: str) -> BandReader:
    """A `BandReader` of some bands, by default all except alpha.

    Raises
    ------
    InputError
        A band that the file does not have, or complex numbers.
    """
    alpha = alpha_band(source)
    if bands is None:
        bands = tuple(band for band in source.indexes if band != alpha)
    for band in bands:
        if band not in source.indexes:
            raise InputError(path, "no such band", got=band, expected=f"1 … {source.count}")
        if source.dtypes[band - 1].startswith("complex"):
            raise InputError(
                path,
                f"band {band} holds complex numbers",
                got=source.dtypes[band - 1],
                expected="real numbers",
                cure="it is a radar product, and neither heights nor colours",
            )
    table = colour_table(source, bands[0]) if len(bands) == 1 else None
    return BandReader(source, tuple(bands), alpha, table)
