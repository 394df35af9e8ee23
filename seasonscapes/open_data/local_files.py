"""Rasters of one's own as a source: folders of tiles, whose origin and time are told by their names and metadata."""

from __future__ import annotations

import glob
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.open_data.imagery import SAME_PASS, colours
from seasonscapes.open_data.sources import Source, source_of_file
from seasonscapes.progress import TaskProgress
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map
from seasonscapes.terrain.heights import check_height_band, declared_unit, to_metres
from seasonscapes.terrain.mosaic import MapGrid, mosaic, read_tile
from seasonscapes.terrain.raster_files import open_raster
from seasonscapes.terrain.tile_files import time_in_name

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

# A date and an hour in UTC, as names of satellite images have them: 20240918T102021, 20240918_102021Z.
_UTC = re.compile(r"(?<!\d)((?:19|20)\d{6})(?:T(\d{6})Z?|[_-]?(\d{6})Z)(?!\d)")
_DAY = re.compile(r"(?<!\d)((?:19|20)\d{2})([-_]?)([01]\d)\2([0-3]\d)(?!\d)")
# Heights above the ground, which are none above the sea.
_NO_ELEVATION = "LHD_*_MNH_*"
# Images of several times are images of the same ground if each shows at least this much of it.
_SAME_GROUND = 0.5


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
    day
        Its date where they tell the day.
    year
        Its year where they tell that much.
    bounds_deg
        West, south, east and north bounds [deg]; west > east across the antimeridian.
    spacing_m
        Distance of samples [m].
    """

    path: Path
    source: tuple[str, Source] | None
    time: datetime | None
    day: date | None
    year: int | None
    bounds_deg: tuple[float, float, float, float]
    spacing_m: float


@dataclass(frozen=True)
class LocalImage:
    """Files of the user's that are one image.

    Parameters
    ----------
    files
        The files, newest first.
    time
        UTC; ``None`` where the hour is unknown.
    day
        Its date; ``None`` where the files tell several or none.
    """

    files: tuple[LocalRaster, ...]
    time: datetime | None
    day: date | None


def local_images(rasters: Sequence[LocalRaster], grid: MapGrid, *, flag: str) -> list[LocalImage]:
    """The images that files are: one for each pass or day that shows the ground of a grid; one where no day is told.

    Parameters
    ----------
    rasters
        The files.
    grid
        The area.
    flag
        Argument named in error messages.

    Raises
    ------
    InputError
        Some files tell their hour and others do not; several hours of one day, one day in several years, or several hours
        that show different ground: neither has one sun.
    """
    timed = [each for each in rasters if each.time is not None]
    if timed and len(timed) < len(rasters):
        silent = next(each for each in rasters if each.time is None)
        got = f"{timed[0].path.name} and {silent.path.name}"
        cure = "fetch them apart, or give all of them names with their UTC, such as 20240918T102021"
        raise InputError(flag, "some files tell their hour, others do not", got=got, cure=cure)
    if timed:
        passes: list[list[LocalRaster]] = []
        for each in sorted(timed, key=lambda raster: raster.time or datetime.min):
            last = passes[-1][-1].time if passes else None
            assert each.time is not None
            if last is not None and each.time - last <= SAME_PASS:
                passes[-1].append(each)
            else:
                passes.append([each])
        images = [LocalImage(tuple(files), files[len(files) // 2].time, files[0].day) for files in passes]
        _check_days(images, flag)
        partial = min(_share(image.files, grid) for image in images)
        if len(images) > 1 and partial < _SAME_GROUND:
            raise InputError(
                flag,
                "the files of one hour show only a part of the area, so that no single sun lights the image",
                got=f"{100.0 * partial:.0f} % at one of {len(images)} times",
                cure="choose files of one time, or a smaller --size; names without times make one image whose light stays in",
            )
        return images
    days = sorted({each.day for each in rasters if each.day is not None})
    of_days = [LocalImage(tuple(each for each in rasters if each.day == day), None, day) for day in days]
    whole = len(days) > 1 and all(each.day is not None for each in rasters)
    if whole and min(_share(image.files, grid) for image in of_days) >= _SAME_GROUND:
        _check_days(of_days, flag)
        return of_days
    single = len(days) == 1 and all(each.day is not None for each in rasters)
    return [LocalImage(tuple(rasters), None, days[0] if single else None)]


def _check_days(images: Sequence[LocalImage], flag: str) -> None:
    seen: dict[tuple[int, int], LocalImage] = {}
    for image in images:
        assert image.day is not None
        other = seen.setdefault((image.day.month, image.day.day), image)
        if other is not image:
            got = " and ".join(_iso(each) for each in (other, image))
            cure = "name the files of one of them alone"
            raise InputError(flag, "the files show one day of the year at several times", got=got, cure=cure)


def _iso(image: LocalImage) -> str:
    return f"{image.day}" if image.time is None else f"{image.time:%Y-%m-%dT%H:%M}Z"


def _share(rasters: Sequence[LocalRaster], grid: MapGrid) -> float:
    """Share of a grid within the bounds of rasters."""
    u, v = np.meshgrid(np.linspace(0.0, grid.width, 21), np.linspace(0.0, grid.height, 21))
    latitude, longitude = grid.geodetic(u, v)
    inside = np.zeros(u.shape, bool)
    for each in rasters:
        west, south, east, north = each.bounds_deg
        span = (east - west) % 360.0
        inside |= ((longitude - west) % 360.0 <= span) & (latitude >= south) & (latitude <= north)
    return float(inside.mean())


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


def local_heights(rasters: Sequence[LocalRaster], grid: MapGrid, *, progress: TaskProgress | None = None) -> np.ndarray:
    """Heights ``(H, W)`` [m] of a grid from rasters of one's own, NaN where they have none."""

    for each in rasters:
        if fnmatch(each.path.name, _NO_ELEVATION):
            cure = "choose the tiles MNT (ground) or MNS (with woods and houses)"
            raise InputError(each.path.name, "heights above the ground, not above the sea", cure=cure)

    def read(dataset: DatasetReader) -> Any:
        if dataset.count != 1:
            raise InputError(dataset.name, "more than one band", got=dataset.count, expected="one band of heights")
        check_height_band(dataset, 1, dataset.name)
        unit, tile = declared_unit(dataset, 1, dataset.name), read_tile(dataset, grid, bands=[1])
        return None if tile is None else replace(tile, values=to_metres(tile.values, unit, dataset.name))

    return _mosaic(rasters, grid, read, progress, extend=False)[..., 0]


def local_colours(rasters: Sequence[LocalRaster], grid: MapGrid, *, progress: TaskProgress | None = None) -> np.ndarray:
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
    rasters: Sequence[LocalRaster],
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
        # GDAL's place for the UTC at which an image was taken; a TIFF's own stamp is when and where it was written.
        stated = dataset.tags(ns="IMAGERY").get("ACQUISITIONDATETIME"), dataset.tags().get("TIFFTAG_DATETIME", "")
        spacing_m = _spacing_m(latitude, longitude, dataset.width, dataset.height)
    wide = longitude.max() - longitude.min() > 180.0
    west, east = (
        (longitude[longitude > 0].min(), longitude[longitude < 0].max()) if wide else (longitude.min(), longitude.max())
    )
    bounds = float(west), float(latitude.min()), float(east), float(latitude.max())
    return LocalRaster(path, source_of_file(path.name, kind), *_time(path.name, *stated), bounds, spacing_m)


def _spacing_m(latitude: np.ndarray, longitude: np.ndarray, width: int, height: int) -> float:
    from seasonscapes.frames import LocalFrame, enu_from_geodetic

    frame = LocalFrame(float(latitude[0, 0]), float(longitude[0, 0]))
    across, down = (
        np.linalg.norm(enu_from_geodetic(frame, latitude[at], longitude[at], 0.0)) for at in ((0, 1), (1, 0))
    )
    return float(min(across / width, down / height))


def _time(name: str, taken: str | None, written: str) -> tuple[datetime | None, date | None, int | None]:
    """UTC, or the day, or the year, that a file's metadata and name tell."""
    if taken is not None:
        try:
            time = datetime.fromisoformat(taken.strip())
            return time if time.tzinfo is not None else time.replace(tzinfo=UTC), time.date(), time.year
        except ValueError:
            raise InputError(name, "not a time in its metadata ACQUISITIONDATETIME", got=taken) from None
    if match := _UTC.search(name):
        try:
            time = datetime.strptime(match[1] + (match[2] or match[3]), "%Y%m%d%H%M%S").replace(tzinfo=UTC)
            return time, time.date(), time.year
        except ValueError:
            pass
    if match := _DAY.search(name):
        try:
            day = date(int(match[1]), int(match[3]), int(match[4]))
            return None, day, day.year
        except ValueError:
            pass
    year = time_in_name(name)[1]
    # The stamp of a TIFF is in an unknown zone: good for its year at best.
    return None, None, year or (int(written[:4]) if re.match(r"(19|20)\d\d:", written) else None)
