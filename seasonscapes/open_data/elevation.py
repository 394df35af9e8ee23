"""Heights of an area from a declared source: its tiles, the coarser product where they have voids, the sea."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.open_data.catalogue import Item, asset_of, search
from seasonscapes.open_data.remote import MissingFile, RemoteStore
from seasonscapes.open_data.sources import Source, read_source
from seasonscapes.progress import TaskProgress
from seasonscapes.terrain.heights import PLAUSIBLE_ELEVATION_M
from seasonscapes.terrain.mosaic import MapGrid, mosaic, read_tile
from seasonscapes.terrain.surface import Raster

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class AssetUse:
    """An asset of an item that is, or would be, read.

    Parameters
    ----------
    source
        Name of the declared source.
    item
        The catalogue's item.
    asset
        Fields of the asset, with ``href``.
    """

    source: str
    item: Item
    asset: dict


@dataclass
class Heights:
    """Heights on a grid and where they come from.

    Parameters
    ----------
    values
        ``(H, W)`` float32 [m], NaN where nothing is known.
    used
        Assets that were read.
    shares
        Share of the grid that each source gave; ``sea`` where no tile is.
    missing
        Items whose file does not exist.
    """

    values: np.ndarray
    used: list[AssetUse] = field(default_factory=list)
    shares: dict[str, float] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)


def height_tiles(
    store: RemoteStore, name: str, grid: MapGrid, *, catalogue_url: str | None, finest_m: float
) -> list[AssetUse]:
    """The tiles of a source that show a grid, newest first.

    Parameters
    ----------
    store
        Where answers of catalogues are kept.
    name
        Declared source.
    grid
        Target.
    catalogue_url
        Asked in place of the source's own catalogue.
    finest_m
        Spacing that is needed [m].
    """
    source = read_source(name)
    items = search(store, catalogue_url or source.catalogue_url, source.collection, grid.boxes_deg())
    return tiles_of(items, name, source, finest_m=finest_m)


def tiles_of(items: Sequence[Item], name: str, source: Source, *, finest_m: float) -> list[AssetUse]:
    """The one asset of each item, the finest spacing first, then the newest; of a tile in several years the newest alone
    where so declared."""

    def worth(item: Item) -> tuple[float, float, str]:
        # Items of 3DEP of 10 m and of 30 m lie above each other in one collection.
        spacing = item.properties.get("gsd")
        age = 0.0 if item.time is None else -item.time.timestamp()
        return float(spacing) if isinstance(spacing, (int, float)) else 0.0, age, item.id

    newest: dict[tuple, Item] = {}
    for item in sorted(items, key=worth):
        tile = tuple(round(bound, 4) for bound in item.bounds_deg) if source.newest_per_tile else (item.id,)
        newest.setdefault(tile, item)
    return [
        AssetUse(name, item, asset_of(item, source.assets[0], source, finest_m=finest_m)) for item in newest.values()
    ]


def load_heights(
    store: RemoteStore,
    name: str,
    grid: MapGrid,
    *,
    catalogue_url: str | None = None,
    progress: TaskProgress | None = None,
) -> Heights:
    """Load the heights of a grid.

    Parameters
    ----------
    store, name, grid, catalogue_url
        As in `height_tiles`.
    progress
        Called with the finished share.

    Returns
    -------
    Heights
        Voids and missing tiles filled from the coarser product, the sea at 0 m.

    Raises
    ------
    InputError
        No source has a tile, or what they have are no heights in metres.
    """
    heights = Heights(np.full(grid.shape, np.nan, np.float32))
    source: Source = read_source(name)
    layer: str | None = name
    boxes: list[tuple[float, float, float, float]] = []
    all_rasters: list[Raster] = []
    while layer is not None and np.isnan(heights.values).any():
        declared = read_source(layer)
        tiles = height_tiles(store, layer, grid, catalogue_url=catalogue_url, finest_m=grid.spacing_m)
        rasters = _read_tiles(store, tiles, declared, grid, heights, progress or (lambda share: None))
        boxes += [tile.item.bounds_deg for tile in tiles]
        if rasters:
            empty = np.isnan(heights.values)
            found = mosaic(rasters, grid, extend=False)[..., 0]
            heights.values[empty] = found[empty]
            heights.shares[layer] = float((empty & np.isfinite(found)).mean())
        all_rasters += rasters
        layer = declared.coarser
    if source.sea_without_tiles and boxes:
        sea = np.isnan(heights.values) & ~_within(grid, boxes)
        heights.values[sea] = 0.0
        if sea.any():
            heights.shares["sea"] = float(sea.mean())
    if all_rasters and np.isnan(heights.values).any():
        # The rim of the outermost samples.
        heights.values = np.where(np.isnan(heights.values), mosaic(all_rasters, grid)[..., 0], heights.values)
    _check(heights, name, grid)
    return heights


def _read_tiles(
    store: RemoteStore, tiles: list[AssetUse], source: Source, grid: MapGrid, heights: Heights, progress: TaskProgress
) -> list[Raster]:
    rasters = []
    for number, tile in enumerate(tiles):
        try:
            raster = store.read(
                tile.asset["href"], lambda dataset: read_tile(dataset, grid, bands=[1]), token_url=source.token_url
            )
        except MissingFile as error:
            if source.coarser is None:
                raise
            log.warning("%s; %s is used there", error.problem, source.coarser)
            heights.missing.append(tile.item.id)
            raster = None
        if raster is not None:
            rasters.append(raster)
            heights.used.append(tile)
        progress((number + 1) / len(tiles))
    return rasters


def _within(grid: MapGrid, boxes_deg: list[tuple[float, float, float, float]]) -> np.ndarray:
    """Whether a catalogue states a tile at each cell ``(H, W)``; tiles reach half a sample beyond their degree."""
    u, v = np.meshgrid(np.arange(grid.width) + 0.5, np.arange(grid.height) + 0.5)
    latitude, longitude = grid.geodetic(u, v)
    inside = np.zeros(grid.shape, bool)
    margin = 1.0 / 3600.0
    for west, south, east, north in boxes_deg:
        span = (east - west) % 360.0 or 360.0
        from_west = (longitude - west + margin) % 360.0
        inside |= (from_west <= span + 2.0 * margin) & (latitude >= south - margin) & (latitude <= north + margin)
    return inside


def _check(heights: Heights, name: str, grid: MapGrid) -> None:
    latitude, longitude = grid.centre_deg
    known = np.isfinite(heights.values)
    if not known.any():
        raise InputError(
            f"{name} at {latitude:.4f}, {longitude:.4f}",
            "the catalogue has no heights here, neither has the coarser product",
            cure="is the place on land, and are latitude and longitude in this order? Else choose another --elevation",
        )
    low, high = float(np.nanmin(heights.values)), float(np.nanmax(heights.values))
    if low < PLAUSIBLE_ELEVATION_M[0] or high > PLAUSIBLE_ELEVATION_M[1]:
        raise InputError(
            name,
            "heights outside the range of land elevations",
            got=f"{low:g} … {high:g} m",
            cure="choose another --elevation",
        )
    void = 1.0 - float(known.mean())
    if void > 0.2:
        raise InputError(
            f"{name} at {latitude:.4f}, {longitude:.4f}",
            "a part of the area has no heights, though the catalogue states that it covers it",
            got=f"{100.0 * void:.0f} %",
            cure="choose a smaller --size or another --elevation",
        )
