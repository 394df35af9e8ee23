"""Declarations of open data sources: TOML files in ``data_sources/``. A new source is one file.

A declaration states what a catalogue's items do not tell, or tell wrongly: which asset to read, what its numbers mean,
the vertical datum, the text of attribution that the licence asks for, and where to look when a tile is missing.
"""

from __future__ import annotations

import math
from fnmatch import fnmatch
from typing import Literal

from pydantic import Field, model_validator

from seasonscapes.bundled import bundled_names, bundled_path
from seasonscapes.declaration import Declaration, InputError, read_declaration
from seasonscapes.scene import VerticalDatum


class Reflectance(Declaration):
    """How stored numbers become reflectance where an item does not declare it: ``value · scale + offset``.

    Parameters
    ----------
    scale
        Reflectance of one unit.
    offset
        Added to items of ``baseline`` or later, 0 before.
    baseline
        First processing baseline with the offset, such as ``"04.00"``.
    """

    scale: float = Field(gt=0.0)
    offset: float = 0.0
    baseline: str | None = None


class Classes(Declaration):
    """Scene classification that says where an image shows the ground.

    Parameters
    ----------
    asset
        Asset of the classification.
    ground
        Classes of clear ground, water and snow included.
    snow, water
        Classes told in the report.
    margin_px
        Everything that is not ground is widened by so many pixels of the classification.
    """

    asset: str
    ground: list[int] = Field(min_length=1)
    snow: list[int] = Field(default_factory=list)
    water: list[int] = Field(default_factory=list)
    margin_px: int = Field(default=3, ge=0, le=50)


class Source(Declaration):
    """A declared source of elevation or imagery.

    Parameters
    ----------
    title
        Name for people.
    kind
        ``elevation`` or ``imagery``.
    catalogue, collection
        STAC API and collection; left out where there is none, so that the source is only known by its downloaded files.
    assets
        Asset keys, or patterns with ``*``: one for elevation, one (with all colours) or three (red, green, blue) for
        imagery.
    spacing_m
        Finest distance of samples [m].
    in_degrees
        Samples stand on a grid of degrees: they are nearer to each other from west to east, by the cosine of the latitude.
    bytes_per_sample
        Typical size of a compressed sample, for plans where a catalogue states no file size.
    licence, licence_url, attribution
        What may be done with the data, and the text that has to go with it; ``{year}`` is the year of the image.
    vertical_datum
        Of heights.
    sea_without_tiles
        No tile, here and in the coarser product, means sea: a height of 0 m.
    coarser
        Name of the source that fills voids and missing tiles.
    newest_per_tile
        Several years of the same tile are in the catalogue; only the newest counts.
    encoding
        ``linear`` reflectance or ``srgb`` colours.
    reflectance
        See `Reflectance`.
    classes
        See `Classes`; without them an image is taken as it is.
    time
        What an item's time means: the ``instant`` of the image, or only its ``year``.
    cloud_property
        Property of an item that holds its cloud cover [%].
    s3_region
        Region of buckets in ``s3://`` addresses, which are read by HTTPS.
    token_url
        Address of a freely given token that is added to the files' addresses.
    file_patterns
        Names of files that were downloaded from this source.
    covers_deg
        West, south, east and north bounds outside of which the source has nothing [deg].
    notes
        What a user should know.
    """

    title: str
    kind: Literal["elevation", "imagery"]
    catalogue: str | None = Field(default=None, pattern=r"^https?://")
    collection: str = ""
    assets: list[str] = Field(default_factory=list, max_length=3)
    spacing_m: float = Field(gt=0.0)
    in_degrees: bool = False
    bytes_per_sample: float = Field(gt=0.0)
    licence: str
    licence_url: str
    attribution: str
    vertical_datum: VerticalDatum | None = None
    sea_without_tiles: bool = False
    coarser: str | None = None
    newest_per_tile: bool = False
    encoding: Literal["linear", "srgb"] = "linear"
    reflectance: Reflectance | None = None
    classes: Classes | None = None
    time: Literal["instant", "year"] = "year"
    cloud_property: str | None = None
    s3_region: str | None = None
    token_url: str | None = None
    file_patterns: list[str] = Field(default_factory=list)
    covers_deg: list[float] | None = Field(default=None, min_length=4, max_length=4)
    notes: list[str] = Field(default_factory=list)

    @model_validator(mode="after")
    def _complete(self) -> Source:
        if self.catalogue is None:
            if not self.file_patterns or self.collection or self.assets:
                raise ValueError("without a 'catalogue' a source has 'file_patterns', no 'collection' and no 'assets'")
        elif not self.collection or not self.assets:
            raise ValueError("a 'catalogue' needs 'collection' and 'assets'")
        if self.kind == "elevation" and (self.vertical_datum is None or len(self.assets) > 1):
            raise ValueError("elevation needs 'vertical_datum' and one asset")
        if self.kind == "imagery" and len(self.assets) == 2:
            raise ValueError("imagery needs one asset with all colours, or red, green and blue")
        return self

    @property
    def catalogue_url(self) -> str:
        """Address of the catalogue; `ValueError` for a source without one."""
        if self.catalogue is None:
            raise ValueError(f"{self.title}: has no catalogue")
        return self.catalogue

    def finest_m(self, latitude_deg: float) -> float:
        """Distance of samples along the finer direction [m]; grids of degrees become sparser beyond 50°."""
        return self.spacing_m * (math.cos(math.radians(min(abs(latitude_deg), 50.0))) if self.in_degrees else 1.0)


def source_names(kind: str) -> list[str]:
    """Names of the bundled sources of a kind, ``elevation`` or ``imagery``."""
    return [name for name in bundled_names("data_sources") if read_source(name).kind == kind]


def read_source(name: str) -> Source:
    """Read a bundled source.

    Parameters
    ----------
    name
        File name without suffix, such as ``cop-dem-glo-30``.

    Returns
    -------
    Source
        The declaration.

    Raises
    ------
    InputError
        There is none of that name; the message lists the names.
    """
    return read_declaration(bundled_path("data_sources", name), Source)


def source_of(name: str, kind: str, *, flag: str) -> Source:
    """The bundled source of a kind that an argument names; `InputError` about the argument otherwise."""
    names = source_names(kind)
    if name in names and read_source(name).catalogue is None:
        source = read_source(name)
        raise InputError(
            flag,
            f"{source.title} has no catalogue that can be asked",
            got=name,
            cure=f"download tiles ({source.licence_url}) and name them: {flag} 'tiles/{source.file_patterns[0]}'",
        )
    if name not in names:
        raise InputError(
            flag,
            f"unknown source of {kind}",
            got=name,
            expected="one of " + ", ".join(names) + ", or files such as 'tiles/*.tif'",
        )
    return read_source(name)


def source_of_file(file_name: str, kind: str) -> tuple[str, Source] | None:
    """Name and declaration of the bundled source whose downloaded files are called like this one."""
    for name in source_names(kind):
        source = read_source(name)
        if any(fnmatch(file_name, pattern) for pattern in source.file_patterns):
            return name, source
    return None
