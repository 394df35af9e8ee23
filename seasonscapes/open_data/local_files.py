"""Rasters of one's own as a source: folders of tiles, whose origin is told by their names."""

from __future__ import annotations

import glob
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.open_data.imagery import colours
from seasonscapes.open_data.sources import Source, source_of_file
from seasonscapes.progress import TaskProgress
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map
from seasonscapes.terrain.heights import check_height_band, declared_unit, to_metres
from seasonscapes.terrain.mosaic import MapGrid, mosaic, read_tile
from seasonscapes.terrain.raster_files import open_raster

if TYPE_CHECKING:
    from rasterio.io import DatasetReader


@dataclass(frozen=True)
class LocalRaster:
    """A raster file of the user's.

    Parameters
    ----------
    path
        The file.
    source
        Name and declaration of the source whose files are called like it; ``None`` for others.
    time
        UTC of the image where its name or metadata tell the hour.
    year
        Year where that is all that they tell.
    bounds_deg
        West, south, east and north bounds [deg]; west > east across the antimeridian.
    spacing_m
        Distance of samples [m].
    """

    path: Path
    source: tuple[str, Source] | None
    time: datetime | None
    year: int | None
    bounds_deg: tuple[float, float, float, float]
    spacing_m: float


def local_rasters(patterns: str, kind: str, *, flag: str) -> list[LocalRaster]:
    """The rasters that file names and patterns name, newest first.

    Parameters
    ----------
    patterns
        Names or patterns with ``*``, with commas between.
    kind
        ``elevation`` or ``imagery``.
    flag
        Argument named in error messages.

    Raises
    ------
    InputError
        A pattern fits no file, or a file is no georeferenced raster.
    """
    found: dict[Path, None] = {}
    for pattern in (part.strip() for part in patterns.split(",")):
        names = sorted(glob.glob(str(Path(pattern).expanduser()), recursive=True))
        if not names:
            raise InputError(flag, "no such file", got=pattern, cure="quote patterns: 'tiles/*.tif'")
        found |= {Path(name): None for name in names if Path(name).is_file()}
    rasters = [_local_raster(path, kind) for path in found]
    return sorted(rasters, key=lambda r: (r.time is not None and r.time.timestamp(), r.year or 0), reverse=True)


def local_heights(rasters: list[LocalRaster], grid: MapGrid, *, progress: TaskProgress | None = None) -> np.ndarray:
    """Heights ``(H, W)`` [m] of a grid from rasters of one's own, NaN where they have none."""

    def read(dataset: DatasetReader) -> Any:
        if dataset.count != 1:
            raise InputError(dataset.name, "more than one band", got=dataset.count, expected="one band of heights")
        check_height_band(dataset, 1, dataset.name)
        unit, tile = declared_unit(dataset, 1, dataset.name), read_tile(dataset, grid, bands=[1])
        return None if tile is None else replace(tile, values=to_metres(tile.values, unit, dataset.name))

    return _mosaic(rasters, grid, read, progress, extend=False)[..., 0]


def local_colours(rasters: list[LocalRaster], grid: MapGrid, *, progress: TaskProgress | None = None) -> np.ndarray:
    """Linear display colours ``(H, W, 3)`` of a grid from 8-bit rasters of one's own, NaN where they have none."""

    def read(dataset: DatasetReader) -> Any:
        if any(kind != "uint8" for kind in dataset.dtypes[:3]):
            raise InputError(
                dataset.name,
                "not an image of 8 bits",
                got=dataset.dtypes[0],
                expected="red, green and blue in 8 bits",
                cure="name it in [imagery] of a scene file with its encoding and full_scale",
            )
        return colours(dataset, grid, "srgb")

    return _mosaic(rasters, grid, read, progress)


def _mosaic(
    rasters: list[LocalRaster],
    grid: MapGrid,
    read: Callable[[Any], Any],
    progress: TaskProgress | None,
    *,
    extend: bool = True,
) -> np.ndarray:
    tiles = []
    for number, raster in enumerate(rasters):
        with open_raster(raster.path) as dataset:
            tiles.append(read(dataset))
        if progress is not None:
            progress((number + 1) / len(rasters))
    tiles = [tile for tile in tiles if tile is not None]
    if not tiles:
        raise InputError(str(rasters[0].path), "none of the files shows the area", cure="check --at and --size")
    return mosaic(tiles, grid, extend=extend)


def _local_raster(path: Path, kind: str) -> LocalRaster:
    with open_raster(path) as dataset:
        if dataset.crs is None or dataset.transform.is_identity:
            raise InputError(path, "not georeferenced", cure="assign a CRS with: gdal_edit.py -a_srs EPSG:… FILE")
        corners_x, corners_y = np.meshgrid([0.0, dataset.width], [0.0, dataset.height])
        crs = dataset.crs.to_string()
        latitude, longitude = geodetic_from_map(crs, *apply_affine(dataset.transform, corners_x, corners_y))
        if not (np.isfinite(latitude).all() and np.isfinite(longitude).all()):
            raise InputError(path, "lies outside the area of its CRS", got=crs, cure="the CRS is probably wrong")
        stated = dataset.tags().get("TIFFTAG_DATETIME", "")
        spacing_m = _spacing_m(latitude, longitude, dataset.width, dataset.height)
    wide = longitude.max() - longitude.min() > 180.0
    west, east = (
        (longitude[longitude > 0].min(), longitude[longitude < 0].max()) if wide else (longitude.min(), longitude.max())
    )
    bounds = float(west), float(latitude.min()), float(east), float(latitude.max())
    return LocalRaster(path, source_of_file(path.name, kind), *_time(path.name, stated), bounds, spacing_m)


def _spacing_m(latitude: np.ndarray, longitude: np.ndarray, width: int, height: int) -> float:
    from seasonscapes.frames import LocalFrame, enu_from_geodetic

    frame = LocalFrame(float(latitude[0, 0]), float(longitude[0, 0]))
    across, down = (
        np.linalg.norm(enu_from_geodetic(frame, latitude[at], longitude[at], 0.0)) for at in ((0, 1), (1, 0))
    )
    return float(min(across / width, down / height))


def _time(name: str, stated: str) -> tuple[datetime | None, int | None]:
    """UTC, or the year alone, that a file's name tells (20240918T102021 is UTC); its own date stamp as a year."""
    if match := re.search(r"(?<!\d)((?:19|20)\d{6})T(\d{6})(?!\d)", name):
        try:
            return datetime.strptime(match[1] + match[2], "%Y%m%d%H%M%S").replace(tzinfo=UTC), int(match[1][:4])
        except ValueError:
            pass
    if match := re.search(r"(?<!\d)((?:19|20)\d{2})(?!\d)", name):
        return None, int(match[1])
    # The stamp of a TIFF is the time of writing in an unknown zone: good for its year at best.
    return None, int(stated[:4]) if re.match(r"(19|20)\d\d:", stated) else None
