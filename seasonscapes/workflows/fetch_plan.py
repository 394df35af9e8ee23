"""What a place needs from open catalogues or from files of one's own, found out before anything is loaded."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.open_data.elevation import AssetUse, height_tiles
from seasonscapes.open_data.imagery import Day, image_days, no_image_here, undated_tiles
from seasonscapes.open_data.local_files import LocalImage, LocalRaster, local_images, local_rasters
from seasonscapes.open_data.remote import RemoteStore
from seasonscapes.open_data.sources import Source, source_of
from seasonscapes.terrain.mosaic import MapGrid, grid_about

# Textures and grids of more cells a side show nothing more.
_MOST_CELLS = 4096
_SIZE_M = (500.0, 150_000.0)
_AUTO_ELEVATION = "cop-dem-glo-30"
_CLOUD_PERCENT = 20.0
COMPOSITES = ("clearest", "median")


@dataclass(frozen=True)
class FetchRequest:
    """What to fetch.

    Parameters
    ----------
    output
        Scene file to write; the rasters lie beside it.
    at
        Latitude and longitude of the centre [deg]; may be left out with files of one's own.
    size_m
        West-east and south-north extent [m]; with files of one's own by default all that they cover.
    elevation
        ``auto``, a declared source, or file names and patterns.
    imagery
        A declared source, ``none``, or file names and patterns.
    intervals
        ISO 8601 intervals with a slash, an image for each; by default the last whole summer of the place, for sources without
        days the newest image.
    cloud_percent
        Largest cloud cover of an image [%]; ``None`` for 20.
    composite
        ``clearest`` or ``median``; ``None`` for ``clearest``.
    catalogue_url
        STAC API asked in place of the sources' own.
    resolution_m
        Finest spacing of heights and pixels [m].
    """

    output: Path
    at: tuple[float, float] | None = None
    size_m: tuple[float, float] | None = None
    elevation: str = "auto"
    imagery: str = "sentinel-2"
    intervals: Sequence[str] = ()
    cloud_percent: float | None = None
    composite: str | None = None
    catalogue_url: str | None = None
    resolution_m: float | None = None


@dataclass
class ImagePlan:
    """What one image needs.

    Parameters
    ----------
    interval
        When it may be taken, as in `FetchRequest.intervals`.
    days
        Passes to choose from, the most promising first.
    tiles
        Assets of a catalogue without days.
    local
        Files of one's own.
    about_bytes
        About how much is to be loaded.
    """

    interval: str | None = None
    days: list[Day] = field(default_factory=list)
    tiles: list[AssetUse] = field(default_factory=list)
    local: LocalImage | None = None
    about_bytes: int = 0

    @property
    def files(self) -> list[LocalRaster]:
        """Files of one's own."""
        return [] if self.local is None else list(self.local.files)


@dataclass
class FetchPlan:
    """What a request needs; made by `plan_place`.

    Parameters
    ----------
    centre_deg, size_m
        The area.
    elevation_name, imagery_name
        Declared sources; ``files`` for files of one's own, ``none`` for no imagery.
    heights_grid, image_grid
        Grids of the rasters to write.
    height_files
        Files of one's own.
    height_tiles
        Assets of a catalogue.
    height_bytes
        About how much of them is to be loaded.
    images
        The images, in the order of the request.
    """

    centre_deg: tuple[float, float]
    size_m: tuple[float, float]
    elevation_name: str
    imagery_name: str
    heights_grid: MapGrid
    image_grid: MapGrid | None
    height_files: list[LocalRaster] = field(default_factory=list)
    height_tiles: list[AssetUse] = field(default_factory=list)
    height_bytes: int = 0
    images: list[ImagePlan] = field(default_factory=list)


def plan_place(request: FetchRequest, store: RemoteStore) -> FetchPlan:
    """Find out what a request needs; catalogues are asked, and no data is loaded.

    Parameters
    ----------
    request
        What to fetch.
    store
        Where answers of catalogues are kept.

    Raises
    ------
    InputError
        The request makes no sense, a catalogue does not answer or has nothing here.
    """
    _check(request)
    height_files = (
        local_rasters(request.elevation, "elevation", flag="--elevation") if _is_files(request.elevation) else []
    )
    image_files = local_rasters(request.imagery, "imagery", flag="--imagery") if _is_files(request.imagery) else []
    centre, size = _area(request, height_files or image_files)
    name = "files" if height_files else _AUTO_ELEVATION if request.elevation == "auto" else request.elevation
    source = None if height_files else source_of(name, "elevation", flag="--elevation")
    finest = min(each.spacing_m for each in height_files) if source is None else source.finest_m(centre[0])
    grid = grid_about(*centre, size, _spacing_m(finest, size, request.resolution_m))
    plan = FetchPlan(centre, size, name, "none", grid, None, height_files)
    if source is not None:
        _check_covers(source, name, centre, "--elevation")
        plan.height_tiles = height_tiles(
            store, name, grid, catalogue_url=request.catalogue_url, finest_m=grid.spacing_m
        )
        plan.height_bytes = _bytes(source, size, grid.spacing_m, len(plan.height_tiles))
    if image_files:
        plan.imagery_name = "files"
        spacing_m = _spacing_m(min(each.spacing_m for each in image_files), size, request.resolution_m)
        plan.image_grid = grid_about(*centre, size, spacing_m)
        plan.images = [ImagePlan(local=each) for each in local_images(image_files, plan.image_grid, flag="--imagery")]
    elif request.imagery != "none":
        _plan_imagery(plan, request, store)
    return plan


def _plan_imagery(plan: FetchPlan, request: FetchRequest, store: RemoteStore) -> None:
    """Images of a catalogue."""
    name = request.imagery
    source = source_of(name, "imagery", flag="--imagery")
    _check_covers(source, name, plan.centre_deg, "--imagery")
    plan.imagery_name = name
    spacing_m = _spacing_m(source.spacing_m, plan.size_m, request.resolution_m)
    plan.image_grid = grid = grid_about(*plan.centre_deg, plan.size_m, spacing_m)
    if source.time == "year":
        _check_undated(request, name)
        interval = request.intervals[0] if request.intervals else None
        tiles = undated_tiles(store, name, grid, interval=interval, catalogue_url=request.catalogue_url)
        if not tiles:
            raise no_image_here(name, grid)
        about = 3 * _bytes(source, plan.size_m, spacing_m, len(tiles))
        plan.images = [ImagePlan(interval, tiles=tiles, about_bytes=about)]
        return
    cloud_percent = _CLOUD_PERCENT if request.cloud_percent is None else request.cloud_percent
    for interval in request.intervals or [last_summer(plan.centre_deg[0], datetime.now(UTC).date())]:
        days = image_days(
            store, name, grid, interval=interval, cloud_percent=cloud_percent, catalogue_url=request.catalogue_url
        )
        if not days:
            raise InputError(
                f"{name} at {plan.centre_deg[0]:.4f}, {plan.centre_deg[1]:.4f}",
                "no image in this time with so few clouds",
                got=f"{interval}, at most {cloud_percent:g} % clouds",
                cure="widen --date, or raise --cloud",
            )
        one = _bytes(source, plan.size_m, spacing_m, len(days[0].items))
        plan.images.append(ImagePlan(interval, days, about_bytes=3 * one + min(len(days), 8) * one // 8))


def last_summer(latitude_deg: float, today: date) -> str:
    """The last whole summer, June to September or December to March, as an ISO 8601 interval.

    Examples
    --------
    >>> from datetime import date
    >>> from seasonscapes.workflows.fetch_plan import last_summer
    >>> last_summer(46.5, date(2026, 11, 28))
    '2026-06-01T00:00:00Z/2026-09-30T23:59:59Z'
    >>> last_summer(-43.6, date(2026, 11, 28))
    '2025-12-01T00:00:00Z/2026-03-31T23:59:59Z'
    """
    if latitude_deg >= 0.0:
        year = today.year if today > date(today.year, 9, 30) else today.year - 1
        return f"{year}-06-01T00:00:00Z/{year}-09-30T23:59:59Z"
    year = today.year if today > date(today.year, 3, 31) else today.year - 1
    return f"{year - 1}-12-01T00:00:00Z/{year}-03-31T23:59:59Z"


def _is_files(text: str) -> bool:
    return bool(re.search(r"[*?/\\,]|\.[a-z0-9]{2,4}$", text, re.IGNORECASE))


def _check(request: FetchRequest) -> None:
    if request.composite is not None and request.composite not in COMPOSITES:
        raise InputError("--composite", "unknown composite", got=request.composite, expected=" or ".join(COMPOSITES))
    if request.cloud_percent is not None and not 0.0 <= request.cloud_percent <= 100.0:
        raise InputError("--cloud", "out of range", got=request.cloud_percent, expected="0 to 100 %")
    if request.resolution_m is not None and not 0.1 <= request.resolution_m <= 1000.0:
        raise InputError("--resolution", "out of range", got=request.resolution_m, expected="0.1 to 1000 m")
    for side in request.size_m or ():
        if not _SIZE_M[0] <= side <= _SIZE_M[1]:
            expected = f"{_SIZE_M[0]:g} m to {_SIZE_M[1] / 1000.0:g} km"
            raise InputError("--size", "out of range", got=f"{side:g} m", expected=expected)
    if request.catalogue_url is not None and not re.match(r"https?://[^\s/]+", request.catalogue_url):
        raise InputError("--stac", "not an address", got=request.catalogue_url, expected="https://…")
    if request.imagery == "none" or _is_files(request.imagery):
        _check_unused(request, "with files of one's own, or without imagery, there is no image to choose")


def _check_undated(request: FetchRequest, name: str) -> None:
    if len(request.intervals) > 1:
        cure = "give one, or choose --imagery sentinel-2"
        raise InputError(
            "--date", f"{name} tells the year alone, and images of several dates need a day each", cure=cure
        )
    _check_unused(request, f"{name} has one image, without clouds", but_date=True)


def _check_unused(request: FetchRequest, why: str, *, but_date: bool = False) -> None:
    """Refuse options that nothing would come of."""
    given = {
        "--date": bool(request.intervals) and not but_date,
        "--cloud": request.cloud_percent is not None,
        "--composite": request.composite is not None,
    }
    for flag, is_given in given.items():
        if is_given:
            raise InputError(flag, why, cure="leave it out")


def _check_covers(source: Source, name: str, centre: tuple[float, float], flag: str) -> None:
    if source.covers_deg is None:
        return
    west, south, east, north = source.covers_deg
    if not (south <= centre[0] <= north and west <= centre[1] <= east):
        raise InputError(
            flag,
            f"{source.title} has nothing here",
            got=f"{centre[0]:g}, {centre[1]:g}",
            expected=f"latitude {south:g} … {north:g}, longitude {west:g} … {east:g}",
            cure=f"leave out {flag} {name}",
        )


def _area(request: FetchRequest, files: list[LocalRaster]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Centre [deg] and size [m]."""
    if request.at is not None and request.size_m is not None:
        return request.at, request.size_m
    if not files:
        missing = "--at" if request.at is None else "--size"
        expected = "LAT,LON" if request.at is None else "such as 20km"
        raise InputError(missing, "missing", expected=expected, cure="only files of one's own tell the area themselves")
    west = min((each.bounds_deg[0] for each in files), key=lambda value: _from(files, value))
    east = max((each.bounds_deg[2] for each in files), key=lambda value: _from(files, value))
    south, north = min(each.bounds_deg[1] for each in files), max(each.bounds_deg[3] for each in files)
    middle_longitude = files[0].bounds_deg[0] + (_from(files, west) + _from(files, east)) / 2.0
    centre = request.at or ((south + north) / 2.0, (middle_longitude + 180.0) % 360.0 - 180.0)
    metres = 111_320.0
    width = (_from(files, east) - _from(files, west)) * metres * float(np.cos(np.deg2rad(centre[0])))
    size = request.size_m or (width, (north - south) * metres)
    if max(size) > _SIZE_M[1]:
        raise InputError(
            "--size", "the files cover too much", got=f"{max(size) / 1000.0:.0f} km", cure="give --at and --size"
        )
    return centre, size


def _from(files: list[LocalRaster], longitude_deg: float) -> float:
    """Degrees east of the first file's western border, negative to the west."""
    return (longitude_deg - files[0].bounds_deg[0] + 180.0) % 360.0 - 180.0


def _spacing_m(finest_m: float, size_m: tuple[float, float], wish_m: float | None) -> float:
    """The source's own spacing, the wish, or what `_MOST_CELLS` allow, whichever is coarsest; two digits."""
    spacing = max(finest_m, wish_m or 0.0, max(size_m) / _MOST_CELLS)
    digits = 10.0 ** (np.floor(np.log10(spacing)) - 1.0)
    return round(float(np.ceil(spacing / digits - 1e-6) * digits), 6)


def _bytes(source: Source, size_m: tuple[float, float], spacing_m: float, items: int) -> int:
    """About how many bytes one band of an area takes."""
    read_m = source.spacing_m * 2.0 ** np.floor(np.log2(max(spacing_m / source.spacing_m, 1.0)))
    samples = size_m[0] * size_m[1] / read_m**2
    return int(samples * source.bytes_per_sample * 1.3 + 131_072 * items)
