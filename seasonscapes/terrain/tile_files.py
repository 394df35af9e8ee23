"""Rasters in many files: tiles of any CRS and spacing as one raster, the newest first.

Nothing is converted on disk. Tiles whose pixels stand on one grid are joined as they are; others are interpolated to a
common grid in the UTM zone of the area, as fine as the finest of them (`terrain.mosaic`).
"""

from __future__ import annotations

import glob
import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from affine import Affine

from seasonscapes.declaration import InputError
from seasonscapes.terrain.crs import horizontal_crs, wrapped
from seasonscapes.terrain.memory import check_memory, require_bytes
from seasonscapes.terrain.mosaic import grid_about, joined, mosaic, same_grid
from seasonscapes.terrain.placement import cell_sides_m
from seasonscapes.terrain.raster import bounds_geographic, raster_grid, read_elevation
from seasonscapes.terrain.raster_files import OWN_FOLDER, Confinement, confined_path
from seasonscapes.terrain.surface import Raster

Bounds = tuple[float, float, float, float]

_WILDCARDS = re.compile(r"[*?\[]")
# More tiles than that are a whole country.
_MOST_TILES = 5000
# Three bands in float32: the tiles, their join, and the grid.
_BYTES_PER_PIXEL = 40
# Degrees along a meridian, on a sphere of the Earth's mean radius.
METRES_PER_DEGREE = 111_195.0


# ---------------------------------------------------------------------------------------------- which files


def named_tiles(patterns: Sequence[str], folder: Path, confinement: Confinement, *, where: str) -> list[str]:
    """Find the files that names and patterns of a document stand for.

    Parameters
    ----------
    patterns
        Names, or patterns with ``*``, ``?``, ``[…]`` and ``**`` for any depth of folders; relative to ``folder``.
    folder
        Folder of the document.
    confinement
        Where the files may lie.
    where
        What an error message calls the patterns: document and key.

    Returns
    -------
    list of str
        Absolute paths, each once, the newest first; see `newest_first`.

    Raises
    ------
    InputError
        A pattern that fits no file or leads out of the folder, or far too many files.
    """
    found: dict[str, None] = {}
    for number, pattern in enumerate(patterns):
        key = f"{where}[{number}]"
        first = _WILDCARDS.search(pattern)
        if first is None:
            names = [pattern]
        else:
            # Checked before any folder is listed.
            confined_path(pattern[: first.start()] or ".", folder, confinement, where=key)
            if ".." in Path(pattern[first.start() :]).parts and not confinement.allow_outside:
                raise InputError(key, "leads outside its folder", got=pattern, cure="leave out '..' after a wildcard")
            names = sorted(glob.glob(pattern, root_dir=folder, recursive=True))
            names = [name for name in names if (folder / name).is_file()]
            if not names:
                raise InputError(key, "no file fits the pattern", got=pattern, expected=f"files below {folder}")
        for name in names:
            path = confined_path(name, folder, confinement, where=key)
            if isinstance(path, Path) and not path.is_file():
                raise InputError(key, "no such file", got=str(path))
            found[str(path)] = None
        if len(found) > _MOST_TILES:
            raise InputError(key, "too many tiles", got=len(found), expected=f"at most {_MOST_TILES}")
    return newest_first(list(found))


def newest_first(paths: Sequence[str]) -> list[str]:
    """Files ordered by the time in their names, the newest first; those without one last, otherwise as given.

    Examples
    --------
    >>> from seasonscapes.terrain.tile_files import newest_first
    >>> newest_first(["b.tif", "a_2019_2600-1200.tif", "a_2023_2600-1200.tif"])
    ['a_2023_2600-1200.tif', 'a_2019_2600-1200.tif', 'b.tif']
    """

    def age(path: str) -> float:
        time, year = time_in_name(Path(path).name)
        return -(
            time.timestamp() if time is not None else datetime(year, 1, 1, tzinfo=UTC).timestamp() if year else 0.0
        )

    return sorted(paths, key=age)


def time_in_name(name: str) -> tuple[datetime | None, int | None]:
    """UTC, or the year alone, that a file's name tells: ``20240918T102021`` is UTC, ``2023`` and ``20230712`` tell a year.

    Examples
    --------
    >>> from seasonscapes.terrain.tile_files import time_in_name
    >>> time_in_name("swissimage-dop10_2023_2600-1200_2_2056.tif")
    (None, 2023)
    """
    if match := re.search(r"(?<!\d)((?:19|20)\d{6})[T_-]?(\d{6})Z?(?!\d)", name):
        try:
            return datetime.strptime(match[1] + match[2], "%Y%m%d%H%M%S").replace(tzinfo=UTC), int(match[1][:4])
        except ValueError:
            pass
    this_year = datetime.now(UTC).year
    for match in re.finditer(r"(?<!\d)((?:19|20)\d{2})(?:[01]\d[0-3]\d)?(?!\d)", name):
        if 1900 < int(match[1]) <= this_year:
            return None, int(match[1])
    return None, None


# ---------------------------------------------------------------------------------------------- one raster


def tile_spacing_m(paths: Sequence[str], confinement: Confinement = OWN_FOLDER) -> float:
    """Mean side of a pixel of the finest tile [m]."""
    return min(float(np.mean(cell_sides_m(raster_grid(path, confinement)))) for path in paths)


def bounds_about(latitude_deg: float, longitude_deg: float, reach_m: float) -> Bounds:
    """Bounds [deg] that reach so far to all sides of a place [m]."""
    down = reach_m / METRES_PER_DEGREE
    across = down / max(math.cos(math.radians(latitude_deg)), 0.01)
    return longitude_deg - across, latitude_deg - down, longitude_deg + across, latitude_deg + down


def covered_size_m(paths: Sequence[str], bounds_deg: Bounds, confinement: Confinement = OWN_FOLDER) -> np.ndarray:
    """Extent ``(2,)`` from west to east and from south to north of what tiles cover of bounds [m]."""
    boxes = np.array([bounds_geographic(raster_grid(path, confinement)) for path in paths])
    west, south = np.maximum(boxes[:, :2].min(axis=0), bounds_deg[:2])
    east, north = np.minimum(boxes[:, 2:].max(axis=0), bounds_deg[2:])
    metres = METRES_PER_DEGREE * np.array([math.cos(math.radians(0.5 * (south + north))), 1.0])
    return np.array([east - west, north - south]) * metres


def tiles_reach_into(paths: Sequence[str], bounds_deg: Bounds, confinement: Confinement = OWN_FOLDER) -> bool:
    """Whether any of the tiles reaches into bounds by two pixels or more."""
    grids = [raster_grid(path, confinement) for path in paths]
    return any(_overlap(bounds_geographic(grid), bounds_deg, cell_sides_m(grid)) for grid in grids)


def read_tiles(
    paths: Sequence[str],
    read: Callable[[str, Bounds | None, float | None], Raster],
    *,
    bounds_deg: Bounds | None = None,
    finest_m: float | None = None,
    confinement: Confinement = OWN_FOLDER,
) -> Raster:
    """Read tiles as one raster.

    Parameters
    ----------
    paths
        The files; where several have a value, that of the first one counts.
    read
        Reads one file within bounds, averaged to a finest pixel size; see `raster.read_raster`.
    bounds_deg
        West, south, east, north [deg]; ``None`` for all that the tiles cover.
    finest_m
        Smallest useful size of a pixel [m].
    confinement
        Where the files of the rasters may lie.

    Returns
    -------
    Raster
        NaN where no tile has data. A single file is read as it is.

    Raises
    ------
    InputError
        What ``read`` raises; no tile within the bounds; more pixels than fit into memory.
    """
    if len(paths) == 1:
        return read(paths[0], bounds_deg, finest_m)
    grids = {path: raster_grid(path, confinement) for path in paths}
    boxes = {path: bounds_geographic(grid) for path, grid in grids.items()}
    if bounds_deg is None:
        bounds_deg = _union(list(boxes.values()))
        wanted = dict.fromkeys(paths)
    else:
        # A pixel inside is not enough for interpolation; the neighbour has it as well.
        wanted = {path: bounds_deg for path in paths if _overlap(boxes[path], bounds_deg, cell_sides_m(grids[path]))}
        if not wanted:
            return read(paths[0], bounds_deg, finest_m)
    finest_m = _common_blocks_m([grids[path] for path in wanted], finest_m)
    sides = [float(np.mean(cell_sides_m(grids[path]))) for path in wanted]
    spacing_m = max(min(sides), finest_m or 0.0)
    west, south, east, north = bounds_deg
    latitude, longitude = 0.5 * (south + north), 0.5 * (west + east)
    size_m = ((east - west) * METRES_PER_DEGREE * math.cos(math.radians(latitude)), (north - south) * METRES_PER_DEGREE)
    width, height = (round(side / spacing_m) for side in size_m)
    require_bytes(
        width * height * _BYTES_PER_PIXEL,
        where=f"{paths[0]} and {len(paths) - 1} more",
        got=f"{width} × {height}",
        cure="use a part with a table [area]",
    )
    tiles = [in_turn_of(read(path, bounds, finest_m), longitude) for path, bounds in wanted.items()]
    if same_grid(tiles):
        return joined(tiles)
    grid = grid_about(latitude, longitude, size_m, spacing_m)
    return Raster(mosaic(tiles, grid), grid.transform, grid.crs)


def read_elevation_tiles(
    paths: Sequence[str],
    *,
    bounds_deg: Bounds | None = None,
    band: int | None = None,
    unit: str | None = None,
    nodata: float | None = None,
    finest_m: float | None = None,
    confinement: Confinement = OWN_FOLDER,
) -> Raster:
    """`raster.read_elevation` of one file, or of tiles as one raster; each file's own unit counts."""

    def read(path: str, bounds: Bounds | None, finest: float | None) -> Raster:
        return read_elevation(
            path, bounds_deg=bounds, band=band, unit=unit, nodata=nodata, finest_m=finest, confinement=confinement
        )

    heights = read_tiles(paths, read, bounds_deg=bounds_deg, finest_m=finest_m, confinement=confinement)
    check_memory(heights.values.shape, f"{paths[0]} and {len(paths) - 1} more")
    return heights


def _common_blocks_m(grids: list[Raster], finest_m: float | None) -> float | None:
    """The finest size [m], lessened so that blocks of pixels divide all tiles and those of neighbours stay on one grid."""
    if finest_m is None:
        return None
    side = max(max(cell_sides_m(grid)) for grid in grids)
    most = max(1, math.floor(finest_m / side + 1e-6))
    common = math.gcd(*(length for grid in grids for length in grid.values.shape[:2]))
    shrink = max(count for count in range(1, most + 1) if common % count == 0)
    return finest_m if shrink < 0.5 * most else min(finest_m, side * (shrink + 0.5))


def _overlap(box: Bounds, bounds_deg: Bounds, sides_m: tuple[float, float]) -> bool:
    """Whether a tile reaches into bounds by two pixels or more."""
    west, south, east, north = box
    turn = float(wrapped(west, 0.5 * (bounds_deg[0] + bounds_deg[2]) - 0.5 * (east - west), 360.0)) - west
    down = 2.0 * sides_m[1] / METRES_PER_DEGREE
    across = 2.0 * sides_m[0] / (METRES_PER_DEGREE * max(math.cos(math.radians(0.5 * (south + north))), 0.01))
    return (
        west + turn < bounds_deg[2] - across
        and east + turn > bounds_deg[0] + across
        and south < bounds_deg[3] - down
        and north > bounds_deg[1] + down
    )


def _union(boxes: list[Bounds]) -> Bounds:
    """The box about boxes, whose longitudes are counted from the first one's."""
    middle = 0.5 * (boxes[0][0] + boxes[0][2])
    wests, easts = [], []
    for west, _, east, _ in boxes:
        near = float(wrapped(0.5 * (west + east), middle, 360.0)) - 0.5 * (east - west)
        wests.append(near)
        easts.append(near + east - west)
    return min(wests), min(box[1] for box in boxes), max(easts), max(box[3] for box in boxes)


def in_turn_of(raster: Raster, longitude_deg: float) -> Raster:
    """A raster, of a geographic CRS in the turn of a longitude."""
    if not horizontal_crs(raster.crs).is_geographic:
        return raster
    a, b, c, d, e, f = tuple(raster.transform)[:6]
    middle = c + 0.5 * a * raster.values.shape[1]
    turned = c + float(wrapped(middle, longitude_deg, 360.0)) - middle
    return replace(raster, transform=Affine(a, b, turned, d, e, f))


def path_list(path: str | os.PathLike[str] | Sequence[str]) -> list[str]:
    """One path or several as a list."""
    return [os.fspath(path)] if isinstance(path, (str, os.PathLike)) else list(path)
