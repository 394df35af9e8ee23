"""Tables of a scene file about rasters: which files, and finer ones of a part."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from seasonscapes.declaration import Declaration

HeightUnit = Literal["metre", "foot", "US survey foot", "decimetre", "centimetre", "kilometre"]
Encoding = Literal["srgb", "linear"]


class RasterFiles(Declaration):
    """A raster in one file or in many tiles.

    Parameters
    ----------
    file
        Raster file, relative to the scene file's folder.
    files
        In place of ``file``: names and patterns of tiles, such as ``["tiles/*.tif"]``. They may overlap, and differ in CRS
        and spacing; where several have a value, that of the newest counts (by a date or year in their names, then in the
        order given). Where tiles are missing there is no data.
    """

    file: str | None = None
    files: list[str] | None = Field(default=None, min_length=1, max_length=1000)

    @property
    def paths(self) -> tuple[str, ...]:
        """The raster's files; after `read_scene` absolute, patterns resolved and the newest first."""
        return tuple(self.files or ()) if self.file is None else (self.file,)

    @property
    def finer_tables(self) -> tuple[RasterFiles, ...]:
        """Finer rasters of parts of it."""
        return tuple(getattr(self, "finer", ()))

    @property
    def all_paths(self) -> tuple[str, ...]:
        """The raster's files, and those of its finer parts."""
        return self.paths + tuple(path for part in self.finer_tables for path in part.paths)

    @property
    def label(self) -> str:
        """What messages call the raster: its file, or the first and the number of its tiles."""
        first = Path(self.paths[0]).name
        return first if len(self.paths) == 1 else f"{first} and {len(self.paths) - 1} more"

    def without_folders(self) -> Any:
        """A copy with the names of the files alone, for keys of artefacts, which move with their scene."""
        names = [Path(path).name for path in self.paths]
        update: dict[str, Any] = {"file": names[0]} if self.file is not None else {"files": names or None}
        if self.finer_tables:
            update["finer"] = [part.without_folders() for part in self.finer_tables]
        return self.model_copy(update=update)


class HeightFiles(RasterFiles):
    """Heights in files.

    Parameters
    ----------
    band
        Band of the file, counted from 1; may be left out where there is one.
    unit
        Unit of the file's heights; left out, the one that the file declares, else metres.
    nodata
        Value of the file that means no data, besides what it declares.
    """

    band: int | None = Field(default=None, ge=1)
    unit: HeightUnit | None = None
    nodata: float | None = None


class ImageFiles(RasterFiles):
    """A colour image in files.

    Parameters
    ----------
    encoding
        Transfer function of the pixel values.
    full_scale
        Value that corresponds to 1, after the file's own scale and offset. Left out, it is 1 for floating-point numbers
        and where the file has a scale, else 255.
    bands
        Red, green and blue bands of the file, counted from 1; left out, those that the file marks.
    """

    encoding: Encoding = "srgb"
    full_scale: float | None = Field(default=None, gt=0.0)
    bands: list[int] | None = Field(default=None, min_length=1, max_length=3)


class _Part(RasterFiles):
    """A finer raster of a part of another one."""

    @model_validator(mode="after")
    def _one_raster(self) -> _Part:
        if (self.file is None) == (self.files is None):
            raise ValueError("give either 'file', or the tiles of a raster as 'files'")
        return self


class FinerHeights(HeightFiles, _Part):
    """Finer heights of a part of the elevation raster, blended into it along their border.

    Parameters
    ----------
    offset_m
        What is added to these heights to bring them to the datum of the elevation raster [m].
    """

    offset_m: float = Field(default=0.0, ge=-200.0, le=200.0)


class FinerImage(ImageFiles, _Part):
    """Finer image of a part of the ground, whose detail is laid over the albedo in the pictures of cameras near it."""
