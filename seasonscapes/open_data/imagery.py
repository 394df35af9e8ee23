"""Images of an area from a declared source: the clearest single day, or the median of many.

A single day is the usual choice, because one sun then lights the whole image and its light can be taken out. Ground that
clouds hide on that day is shown by the next clearest ones, and how much of it is told.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import date, datetime, timedelta
from typing import Any

import cv2
import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.images import linear_from_srgb
from seasonscapes.open_data.catalogue import Item, asset_of, search
from seasonscapes.open_data.elevation import AssetUse, tiles_of
from seasonscapes.open_data.remote import RemoteStore
from seasonscapes.open_data.sources import Source, read_source
from seasonscapes.progress import TaskProgress
from seasonscapes.terrain.image_bands import marked_colours
from seasonscapes.terrain.mosaic import MapGrid, mosaic, read_tile
from seasonscapes.terrain.surface import Raster

log = logging.getLogger(__name__)

# Tiles of one pass of a satellite lie minutes apart, passes days.
SAME_PASS = timedelta(minutes=30)
# Days whose clouds are looked at, and days whose colours are loaded.
_MOST_DAYS, _MOST_FILLING_DAYS = 8, 4
# Clouds are looked at on a grid of about so many cells a side.
_LOOK_CELLS = 512
_LEAST_CLEAR = 0.05
# Bright ground that several days show alike is snow, whatever its class says.
_SNOW_REFLECTANCE, _SNOW_SPREAD = 0.35, 0.12
# The darkest ground (shadows, water, woods) of an image whose offset is right lies between these reflectances.
_DARKEST = (-0.02, 0.085)


@dataclass(frozen=True)
class Day:
    """The images of one pass.

    Parameters
    ----------
    items
        Its items, best first.
    time
        UTC of the item that shows most of the area.
    cloud_percent
        Mean cloud cover that the catalogue states.
    """

    items: tuple[Item, ...]
    time: datetime
    cloud_percent: float


@dataclass
class Image:
    """An image on a grid and where it comes from.

    Parameters
    ----------
    values
        ``(H, W, 3)`` float32: reflectance, or linear display colours of `Source.encoding` ``srgb``; NaN where nothing is
        known.
    time
        UTC at which the image was taken; ``None`` for a median and where only the day or the year is known.
    day
        The day that it shows; for a median that of the middle one of its images, ``None`` where only the year is known.
    used
        Assets that were read.
    report
        Plain facts: share of clear ground, of snow and water, of what other days fill in.
    """

    values: np.ndarray
    time: datetime | None
    day: date | None = None
    used: list[AssetUse] = field(default_factory=list)
    report: dict[str, Any] = field(default_factory=dict)


def image_days(
    store: RemoteStore,
    name: str,
    grid: MapGrid,
    *,
    interval: str,
    cloud_percent: float,
    catalogue_url: str | None = None,
) -> list[Day]:
    """The passes of a satellite that show an area within an interval, the most promising first.

    Parameters
    ----------
    store, name, grid, catalogue_url
        As in `elevation.height_tiles`.
    interval
        ISO 8601 interval with a slash.
    cloud_percent
        Largest cloud cover of an item [%].
    """
    source = read_source(name)
    query = None if source.cloud_property is None else {source.cloud_property: {"lte": cloud_percent}}
    items = search(
        store,
        catalogue_url or source.catalogue_url,
        source.collection,
        grid.boxes_deg(),
        interval=interval,
        query=query,
    )
    dated = sorted((item for item in items if item.time is not None), key=lambda item: (item.time, item.id))
    passes: list[list[Item]] = []
    for item in dated:
        assert item.time is not None
        last = passes[-1][-1].time if passes else None
        if last is not None and item.time - last <= SAME_PASS:
            passes[-1].append(item)
        else:
            passes.append([item])
    days = [_day(each, source, grid) for each in passes]
    shares = {id(day): _stated_share(day.items, grid) for day in days}
    return sorted(days, key=lambda day: (-(shares[id(day)] * (100.0 - day.cloud_percent)), day.time))


def load_image(
    store: RemoteStore,
    name: str,
    grid: MapGrid,
    days: Sequence[Day],
    *,
    composite: str = "clearest",
    progress: TaskProgress | None = None,
) -> Image:
    """Load the image of a grid from dated reflectance.

    Parameters
    ----------
    store, name, grid
        As in `image_days`.
    days
        From `image_days`.
    composite
        ``clearest`` single day, or ``median`` of all days, which has no time.
    progress
        Called with the finished share.

    Raises
    ------
    InputError
        No day shows the ground.
    """
    source, report = read_source(name), progress or (lambda share: None)
    looked = days[:_MOST_DAYS]
    clear: dict[int, float] = {}
    for number, day in enumerate(looked):
        clear[number] = _clear_share(store, source, grid, day)
        report(0.4 * (number + 1) / len(looked))
        if clear[number] > 0.998:
            break
    order = sorted(clear, key=lambda number: (-clear[number], number))
    if not order or clear[order[0]] < _LEAST_CLEAR:
        best = (
            f"{100.0 * clear[order[0]]:.0f} % of the area on {looked[order[0]].time:%Y-%m-%d}" if order else "no image"
        )
        raise InputError(
            f"{name}", "no image of clear ground in this time", got=best, cure="widen --date, or raise --cloud"
        )
    loaded: list[_LoadedDay] = []
    wanted = len(order) if composite == "median" else 1 + _MOST_FILLING_DAYS
    for number in order[:wanted]:
        day = _load_day(store, name, source, grid, looked[number])
        report(0.4 + 0.6 * (len(loaded) + 1) / wanted)
        if day.doubt is None:
            loaded.append(day)
        else:
            log.warning("%s of %s is left out: %s", name, day.day.time.date(), day.doubt)
        if composite == "clearest" and loaded and np.logical_or.reduce([each.clear for each in loaded]).mean() > 0.998:
            break
    if not loaded:
        raise InputError(name, "the numbers of no image make sense as reflectance", cure="choose another --date")
    report(1.0)
    return _median(loaded) if composite == "median" else _clearest(loaded)


def load_undated(
    store: RemoteStore, name: str, grid: MapGrid, tiles: Sequence[AssetUse], *, progress: TaskProgress | None = None
) -> Image:
    """Load the image of a grid from a source of colour tiles without an hour, the newest of each tile.

    Parameters
    ----------
    store, name, grid
        As in `image_days`.
    tiles
        From `undated_tiles`.
    progress
        Called with the finished share.

    Raises
    ------
    InputError
        The source has no tile here.
    """
    source = read_source(name)
    rasters, used = [], []
    for number, tile in enumerate(tiles):
        raster = store.read(tile.asset["href"], lambda dataset: colours(dataset, grid, source.encoding))
        if raster is not None:
            rasters.append(raster)
            used.append(tile)
        if progress is not None:
            progress((number + 1) / len(tiles))
    if not rasters:
        raise no_image_here(name, grid)
    years = sorted({tile.item.time.year for tile in used if tile.item.time is not None})
    values = mosaic(rasters, grid)
    known = float(np.isfinite(values).all(axis=2).mean())
    return Image(values, None, None, used, {"known_share": known, "years": years, "time_known_to": "year"})


def undated_tiles(
    store: RemoteStore, name: str, grid: MapGrid, *, interval: str | None = None, catalogue_url: str | None = None
) -> list[AssetUse]:
    """The tiles of a source of colour images that show a grid, newest first; of an ISO 8601 interval where one is given."""
    source = read_source(name)
    items = search(store, catalogue_url or source.catalogue_url, source.collection, grid.boxes_deg(), interval=interval)
    return tiles_of(items, name, source, finest_m=grid.spacing_m)


def no_image_here(name: str, grid: MapGrid) -> InputError:
    """What is said of a place that a source of colour tiles does not show."""
    latitude, longitude = grid.centre_deg
    cure = "choose another --date, --imagery sentinel-2 or none"
    return InputError(f"{name} at {latitude:.4f}, {longitude:.4f}", "the catalogue has no image here", cure=cure)


def colours(dataset: Any, grid: MapGrid, encoding: str, *, full_scale: float = 255.0) -> Raster | None:
    """The part of an open colour raster that a grid needs, as linear values; NaN where its mask says so."""
    if dataset.count < 3:
        raise InputError(dataset.name, "not a colour image", got=f"{dataset.count} bands", expected="red, green, blue")

    def decode(values: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            scaled = values / full_scale
            return linear_from_srgb(np.clip(scaled, 0.0, 1.0)) if encoding == "srgb" else scaled

    return read_tile(dataset, grid, bands=marked_colours(dataset) or (1, 2, 3), decode=decode)


def scale_and_offset(item: Item, asset: dict[str, Any], source: Source) -> tuple[float, float]:
    """What makes reflectance of stored numbers: what the item states, else what the source declares for its baseline.

    Parameters
    ----------
    item, asset
        STAC item and asset; ``raster:bands`` (STAC 1.0) and ``bands`` (STAC 1.1) are understood.
    source
        Its `Source.reflectance` steps in.

    Returns
    -------
    scale, offset
        reflectance = stored · scale + offset.
    """
    rule = source.reflectance
    bands = asset.get("raster:bands") or asset.get("bands") or [{}]
    first = bands[0] if isinstance(bands, list) and isinstance(bands[0], dict) else {}
    scale = _first_number(first.get("scale"), first.get("raster:scale"), asset.get("raster:scale"))
    offset = _first_number(first.get("offset"), first.get("raster:offset"), asset.get("raster:offset"))
    if scale is None:
        scale = rule.scale if rule is not None else 1.0
    if offset is None:
        offset = rule.offset if rule is not None and _has_offset(item, source) else 0.0
    return scale, offset


def _has_offset(item: Item, source: Source) -> bool:
    """Whether an item's baseline is one whose stored numbers carry the declared offset."""
    rule = source.reflectance
    if rule is None or rule.baseline is None:
        return rule is not None
    applied = item.properties.get("earthsearch:boa_offset_applied")
    baseline = item.properties.get("processing:version") or item.properties.get("s2:processing_baseline") or ""
    return applied is not True and _version(str(baseline)) >= _version(rule.baseline)


def _version(text: str) -> tuple[int, ...]:
    parts = text.strip().split(".")
    return tuple(int(part) for part in parts) if all(part.isdigit() for part in parts) else (0,)


def _first_number(*values: Any) -> float | None:
    return next((float(value) for value in values if isinstance(value, (int, float))), None)


def _day(items: list[Item], source: Source, grid: MapGrid) -> Day:
    best = sorted(items, key=lambda item: (-_stated_share([item], grid), item.id))
    assert best[0].time is not None
    covers = [item.properties.get(source.cloud_property or "") for item in items]
    known = [float(cover) for cover in covers if isinstance(cover, (int, float))]
    return Day(tuple(best), best[0].time, float(np.mean(known)) if known else 50.0)


def _stated_share(items: Sequence[Item], grid: MapGrid) -> float:
    """Share of the grid within the bounds that the catalogue states."""
    u, v = np.meshgrid(np.linspace(0.0, grid.width, 21), np.linspace(0.0, grid.height, 21))
    latitude, longitude = grid.geodetic(u, v)
    inside = np.zeros(u.shape, bool)
    for item in items:
        west, south, east, north = item.bounds_deg
        span = (east - west) % 360.0 or 360.0
        inside |= ((longitude - west) % 360.0 <= span) & (latitude >= south) & (latitude <= north)
    return float(inside.mean())


# ---------------------------------------------------------------------------------------------- one day


@dataclass
class _LoadedDay:
    """Reflectance ``(H, W, 3)`` of a day, where it shows the ground, and how much of it is snow and water."""

    day: Day
    values: np.ndarray
    clear: np.ndarray
    snow_share: float
    water_share: float
    used: list[AssetUse]
    doubt: str | None


def _clear_share(store: RemoteStore, source: Source, grid: MapGrid, day: Day) -> float:
    """Share of the grid on which a day shows the ground, on a coarse copy of the grid."""
    if source.classes is None:
        return _stated_share(day.items, grid)
    step = max(1, int(np.ceil(max(grid.shape) / _LOOK_CELLS)))
    coarse = replace(
        grid, spacing_m=grid.spacing_m * step, width=max(2, grid.width // step), height=max(2, grid.height // step)
    )
    return float(_class_masks(store, source, coarse, day)[..., 0].mean())


def _class_masks(store: RemoteStore, source: Source, grid: MapGrid, day: Day) -> np.ndarray:
    """Masks ``(H, W, 3)``: clear ground, snow, water."""
    classes = source.classes
    assert classes is not None

    def masks(values: np.ndarray) -> np.ndarray:
        kind = np.where(np.isfinite(values[..., 0]), values[..., 0], 0.0).astype(int)
        size = 2 * classes.margin_px + 1
        hidden = cv2.dilate((~np.isin(kind, classes.ground)).astype(np.uint8), np.ones((size, size), np.uint8))
        parts = [hidden == 0, np.isin(kind, classes.snow), np.isin(kind, classes.water)]
        return np.stack(parts, axis=-1).astype(np.float64)

    tiles = []
    for item in day.items:
        href = asset_of(item, classes.asset, source, finest_m=grid.spacing_m)["href"]
        tile = store.read(href, lambda dataset: read_tile(dataset, grid, bands=[1], decode=masks, average=False))
        if tile is not None:
            tiles.append(tile)
    if not tiles:
        return np.zeros((*grid.shape, 3), bool)
    return np.nan_to_num(mosaic(tiles, grid)) > 0.5


def _load_day(store: RemoteStore, name: str, source: Source, grid: MapGrid, day: Day) -> _LoadedDay:
    bands, used = [], []
    offsets = set()
    for key in source.assets:
        tiles = []
        for item in day.items:
            asset = asset_of(item, key, source, finest_m=grid.spacing_m)
            scale, offset = scale_and_offset(item, asset, source)
            offsets.add((offset, _has_offset(item, source)))
            tile = store.read(asset["href"], _reflectance_reader(grid, scale, offset), token_url=source.token_url)
            if tile is not None:
                tiles.append(tile)
                used.append(AssetUse(name, item, asset))
        bands.append(mosaic(tiles, grid)[..., 0] if tiles else np.full(grid.shape, np.nan, np.float32))
    values = np.stack(bands, axis=-1)
    known = np.asarray(np.isfinite(values).all(axis=2))
    if source.classes is None:
        clear, snow, water = known, np.zeros_like(known), np.zeros_like(known)
    else:
        clear, snow, water = np.moveaxis(_class_masks(store, source, grid, day), -1, 0)
        clear = clear & known
    doubt = _doubt(values[clear], offsets)
    return _LoadedDay(day, values, clear, float(snow.mean()), float(water.mean()), used, doubt)


def _reflectance_reader(grid: MapGrid, scale: float, offset: float) -> Callable[[Any], Raster | None]:
    def read(dataset: Any) -> Raster | None:
        from rasterio.vrt import WarpedVRT

        def decode(stored: np.ndarray) -> np.ndarray:
            return stored * scale + offset

        if dataset.nodata is not None:
            return read_tile(dataset, grid, bands=[1], decode=decode)
        # Sentinel-2 stores 0 where it has seen nothing.
        with WarpedVRT(dataset, src_nodata=0, nodata=0) as declared:
            return read_tile(declared, grid, bands=[1], decode=decode)

    return read


def _doubt(values: np.ndarray, offsets: set[tuple[float, bool]]) -> str | None:
    """What contradicts reflectance in the clear pixels ``(N, 3)``; ``None`` where nothing does."""
    if len(values) < 100:
        return None
    darkest = np.percentile(values, 1.0, axis=0)
    if darkest.min() < _DARKEST[0]:
        return f"its darkest ground has a reflectance of {darkest.min():.3f}: the stated offset was applied before"
    unshifted = all(offset == 0.0 for offset, _ in offsets)
    if unshifted and any(expected for _, expected in offsets) and darkest.min() > _DARKEST[1]:
        return f"its darkest ground has a reflectance of {darkest.min():.3f}: an offset seems to be left out"
    return None


# ---------------------------------------------------------------------------------------------- many days


def _keep_snow(loaded: list[_LoadedDay]) -> None:
    """Take ground for clear that is called cloud, or is beside one, but is bright and alike on three days: it is snow."""
    if len(loaded) < 3:
        return
    stack = np.stack([np.where(np.isfinite(each.values), each.values, np.nan).mean(axis=2) for each in loaded])
    with np.errstate(invalid="ignore"):
        middle = np.median(stack, axis=0)
        alike = np.abs(stack - middle) <= _SNOW_SPREAD * middle
        snow = (alike.sum(axis=0) >= 3) & (middle > _SNOW_REFLECTANCE)
    for each, same in zip(loaded, alike, strict=True):
        each.clear |= snow & same


def _clearest(loaded: list[_LoadedDay]) -> Image:
    _keep_snow(loaded)
    first = loaded[0]
    values = np.where(first.clear[..., None], first.values, np.nan)
    own = float(first.clear.mean())
    filled, used = [], list(first.used)
    for other in loaded[1:]:
        gap = np.isnan(values).any(axis=2) & other.clear
        if gap.any():
            values[gap] = other.values[gap]
            filled.append({"time": _iso(other.day.time), "share": round(float(gap.mean()), 5)})
            used += other.used
    report = {
        "composite": "clearest",
        "own_share": round(own, 5),
        "known_share": round(float(np.isfinite(values).all(axis=2).mean()), 5),
        "filled_from": filled,
        "snow_share": round(first.snow_share, 4),
        "water_share": round(first.water_share, 4),
    }
    return Image(values.astype(np.float32), first.day.time, first.day.time.date(), used, report)


def _median(loaded: list[_LoadedDay]) -> Image:
    _keep_snow(loaded)
    stack = np.stack([np.where(each.clear[..., None], each.values, np.nan) for each in loaded])
    known = np.asarray(np.isfinite(stack).any(axis=0))
    values = np.full(stack.shape[1:], np.nan, np.float32)
    values[known] = np.nanmedian(stack[:, known], axis=0)
    report = {
        "composite": "median",
        "times": [_iso(each.day.time) for each in loaded],
        "known_share": round(float(known.all(axis=2).mean()), 5),
        "note": "a median of several suns has no time; its light cannot be taken out",
    }
    times = sorted(each.day.time for each in loaded)
    used = [use for each in loaded for use in each.used]
    return Image(values, None, times[len(times) // 2].date(), used, report)


def _iso(time: datetime) -> str:
    return time.isoformat().replace("+00:00", "Z")
