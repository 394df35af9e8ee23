"""From coordinates to a scene file: heights and images from open catalogues, or from files of one's own."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes import __version__
from seasonscapes.declaration import validate
from seasonscapes.errors import InputError
from seasonscapes.open_data.elevation import AssetUse, Heights, load_heights
from seasonscapes.open_data.imagery import Image, load_image, load_undated
from seasonscapes.open_data.local_files import LocalRaster, local_colours, local_heights
from seasonscapes.open_data.remote import RemoteStore
from seasonscapes.open_data.sources import Source, read_source
from seasonscapes.progress import Progress, task_progress
from seasonscapes.scene import SceneFile
from seasonscapes.sky.ephemeris import sun_position
from seasonscapes.terrain.heights import check_heights
from seasonscapes.terrain.mosaic import MapGrid
from seasonscapes.terrain.raster import fill_nodata
from seasonscapes.terrain.surface import Raster
from seasonscapes.terrain.viewpoints import find_views
from seasonscapes.workflows.fetch_plan import FetchPlan, FetchRequest, ImagePlan, plan_place
from seasonscapes.workflows.fetched_files import (
    check_output,
    heights_writer,
    image_writers,
    iso,
    scene_text,
    write_place,
)
from seasonscapes.workspace import Workspace, default_workspace, file_hash


@dataclass
class Fetched:
    """A place that was fetched.

    Parameters
    ----------
    scene
        The scene file.
    record
        What its ``.sources.json`` says.
    loaded_bytes
        Bytes that came over the network.
    """

    scene: Path
    record: dict[str, Any]
    loaded_bytes: int


def open_data_store(workspace: Workspace | None = None, *, offline: bool = False) -> RemoteStore:
    """The cache of open data within a workspace."""
    return RemoteStore((workspace or default_workspace()).folder / "open_data", offline=offline)


def fetch_place(request: FetchRequest, store: RemoteStore, *, progress: Progress | None = None) -> Fetched:
    """Load heights and images of a place and write its scene file, rasters and sources.

    Parameters
    ----------
    request
        What to fetch.
    store
        Where loaded data is kept.
    progress
        Called with a task and its finished share.

    Returns
    -------
    Fetched
        ``NAME.toml`` with ``NAME.dem.tif``, ``NAME.ortho.tif`` (of several ``NAME.DAY.ortho.tif``) and ``NAME.sources.json``
        beside it.

    Raises
    ------
    InputError
        One line; nothing is written, and what was loaded is kept for the next attempt.
    """
    check_output(request.output)
    plan = plan_place(request, store)
    heights = _heights(plan, request, store, progress)
    images = [_image(plan, part, request, store, progress) for part in plan.images]
    _check_days(images)
    views = find_views(_filled(heights.values, plan.heights_grid), plan.heights_grid)
    record = _record(plan, heights, images, store)
    text = scene_text(request.output, record, images, views)
    validate(tomllib.loads(text), SceneFile, where=request.output)
    writers = [heights_writer(request.output, heights.values, plan.heights_grid)]
    if plan.image_grid is not None:
        writers += image_writers(request.output, images, plan.image_grid, _encoding(plan))
    write_place(request.output, text, record, writers)
    return Fetched(request.output, record, store.loaded_bytes)


# ---------------------------------------------------------------------------------------------- the data


def _heights(plan: FetchPlan, request: FetchRequest, store: RemoteStore, progress: Progress | None) -> Heights:
    report = task_progress(progress, "heights")
    if not plan.height_files:
        return load_heights(
            store, plan.elevation_name, plan.heights_grid, catalogue_url=request.catalogue_url, progress=report
        )
    values = local_heights(plan.height_files, plan.heights_grid, progress=report)
    known = float(np.isfinite(values).mean())
    if known < 0.75:
        raise InputError(
            "--elevation",
            "the files cover too little of the area",
            got=f"{100.0 * known:.0f} %",
            cure="choose a smaller --size, or leave it out",
        )
    grid = plan.heights_grid
    check_heights(Raster(values[..., None], grid.transform, grid.crs), "--elevation", unit="metre", nodata=None)
    return Heights(values, shares={"files": known})


def _image(
    plan: FetchPlan, part: ImagePlan, request: FetchRequest, store: RemoteStore, progress: Progress | None
) -> Image:
    grid = plan.image_grid
    assert grid is not None
    name = "image" if len(plan.images) == 1 else f"image {plan.images.index(part) + 1} of {len(plan.images)}"
    report = task_progress(progress, name)
    if part.local is not None:
        values = local_colours(part.files, grid, progress=report)
        years = sorted({each.year for each in part.files if each.year is not None})
        known = float(np.isfinite(values).all(axis=2).mean())
        return Image(values, part.local.time, part.local.day, report={"known_share": known, "years": years})
    if part.days:
        composite = request.composite or "clearest"
        return load_image(store, plan.imagery_name, grid, part.days, composite=composite, progress=report)
    return load_undated(store, plan.imagery_name, grid, part.tiles, progress=report)


def _check_days(images: Sequence[Image]) -> None:
    """Images of several intervals may turn out to show one day of the year."""
    if len(images) < 2:
        return
    days = [image.day for image in images if image.day is not None]
    folded = [(day.month, day.day) for day in days]
    twice = [str(day) for day, key in zip(days, folded, strict=True) if folded.count(key) > 1]
    if twice:
        cure = "choose times of the year that lie apart"
        raise InputError("--date", "two images show one day of the year", got=" and ".join(twice[:2]), cure=cure)


def _filled(values: np.ndarray, grid: MapGrid) -> np.ndarray:
    raster = Raster(values[..., None], grid.transform, grid.crs)
    return fill_nodata(raster, max_share=0.5, where="heights")[0].values[..., 0]


def _encoding(plan: FetchPlan) -> str:
    return "srgb" if plan.imagery_name == "files" else read_source(plan.imagery_name).encoding


# ---------------------------------------------------------------------------------------------- the record


def _record(plan: FetchPlan, heights: Heights, images: Sequence[Image], store: RemoteStore) -> dict[str, Any]:
    record: dict[str, Any] = {
        "program": f"seasonscapes {__version__}",
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "latitude_deg": plan.centre_deg[0],
        "longitude_deg": plan.centre_deg[1],
        "size_m": list(plan.size_m),
    }
    record["elevation"] = {
        "source": plan.elevation_name,
        "grid": asdict(plan.heights_grid),
        "vertical_datum": _vertical_datum(plan),
        "shares": {name: round(share, 6) for name, share in heights.shares.items()},
        "void_share": round(float(np.isnan(heights.values).mean()), 6),
        "missing_items": heights.missing,
        "licences": _licences(_layers(heights.used, plan.height_files), []),
        "items": _items(heights.used, plan.height_files, store),
    }
    record["imagery"] = [
        _image_record(plan, part, heights, image, store) for part, image in zip(plan.images, images, strict=True)
    ]
    return record


def _image_record(
    plan: FetchPlan, part: ImagePlan, heights: Heights, image: Image, store: RemoteStore
) -> dict[str, Any]:
    assert plan.image_grid is not None
    years = image.report.get("years") or sorted({use.item.time.year for use in image.used if use.item.time is not None})
    return {
        "source": plan.imagery_name,
        "grid": asdict(plan.image_grid),
        "encoding": _encoding(plan),
        "time": None if image.time is None else iso(image.time),
        "day": None if image.day is None else image.day.isoformat(),
        "sun": _sun(plan, heights, image),
        "report": image.report,
        "licences": _licences(_layers(image.used, part.files), years),
        "items": _items(image.used, part.files, store),
    }


def _layers(used: list[AssetUse], files: list[LocalRaster]) -> dict[str, Source]:
    """The declared sources that gave something, by name."""
    layers = {each: read_source(each) for each in dict.fromkeys(use.source for use in used)}
    return layers | {each.source[0]: each.source[1] for each in files if each.source is not None}


def _licences(layers: dict[str, Source], years: list[int]) -> list[dict[str, Any]]:
    told = f"{years[0]}" if len(set(years)) == 1 else f"{min(years)}-{max(years)}" if years else ""
    return [
        {
            "source": name,
            "title": source.title,
            "licence": source.licence,
            "licence_url": source.licence_url,
            "attribution": source.attribution.replace("{year}", told).strip(),
            "notes": source.notes,
        }
        for name, source in layers.items()
    ]


def _items(used: list[AssetUse], files: list[LocalRaster], store: RemoteStore) -> list[dict[str, Any]]:
    items = []
    for use in {use.asset["href"]: use for use in used}.values():
        state = store.known_state(use.asset["href"])
        checksum = use.asset.get("file:checksum") or use.asset.get("checksum:multihash")
        items.append(
            {
                "source": use.source,
                "id": use.item.id,
                "address": use.asset["href"],
                "time": None if use.item.time is None else iso(use.item.time),
                "etag": None if state is None else state.tag,
                "bytes": None if state is None else state.size,
                "checksum": checksum,
                "checksum_verified": store.verify(use.asset["href"], None if checksum is None else str(checksum)),
                "processing_baseline": use.item.properties.get("s2:processing_baseline"),
            }
        )
    for each in files:
        time = None if each.time is None else iso(each.time)
        items.append({"file": each.path.name, "time": time, "year": each.year, "sha256": file_hash(each.path)})
    return items


def _sun(plan: FetchPlan, heights: Heights, image: Image) -> dict[str, Any] | None:
    """Where the sun stood: computed, and as the item states it."""
    if image.time is None:
        return None
    latitude, longitude = plan.centre_deg
    sun = sun_position(image.time, latitude, longitude, float(np.nanmedian(heights.values)))
    stated = next((use.item.properties for use in image.used if use.item.time == image.time), {})
    azimuth, elevation = stated.get("view:sun_azimuth"), stated.get("view:sun_elevation")
    return {
        "azimuth_deg": round(float(sun.azimuth_deg), 3),
        "elevation_deg": round(float(sun.elevation_deg), 3),
        "stated_azimuth_deg": azimuth,
        "stated_elevation_deg": elevation,
    }


def _vertical_datum(plan: FetchPlan) -> str:
    if not plan.height_files:
        return str(read_source(plan.elevation_name).vertical_datum)
    stated = {each.source[1].vertical_datum if each.source is not None else None for each in plan.height_files}
    return str(stated.pop()) if len(stated) == 1 and None not in stated else "unknown"


# ---------------------------------------------------------------------------------------------- the plan


def described(plan: FetchPlan) -> dict[str, Any]:
    """A plan as plain values: sources, items, licences and about how many bytes."""
    return {
        "latitude_deg": plan.centre_deg[0],
        "longitude_deg": plan.centre_deg[1],
        "size_m": list(plan.size_m),
        "elevation": {
            "source": plan.elevation_name,
            "spacing_m": plan.heights_grid.spacing_m,
            "items": [use.item.id for use in plan.height_tiles] or [each.path.name for each in plan.height_files],
            "about_bytes": plan.height_bytes,
            "licences": _licences(_planned_layers(plan.elevation_name, plan.height_files), []),
        },
        "imagery": [_described_image(plan, part) for part in plan.images],
    }


def _described_image(plan: FetchPlan, part: ImagePlan) -> dict[str, Any]:
    assert plan.image_grid is not None
    years = [day.time.year for day in part.days[:1]]
    years += [use.item.time.year for use in part.tiles if use.item.time is not None]
    local = part.local
    return {
        "source": plan.imagery_name,
        "spacing_m": plan.image_grid.spacing_m,
        "interval": part.interval,
        "time": None if local is None or local.time is None else iso(local.time),
        "day": None if local is None or local.day is None else local.day.isoformat(),
        "items": [use.item.id for use in part.tiles] or [each.path.name for each in part.files],
        "days": [
            {
                "time": iso(day.time),
                "cloud_percent": round(day.cloud_percent, 2),
                "items": [item.id for item in day.items],
            }
            for day in part.days
        ],
        "about_bytes": part.about_bytes,
        "licences": _licences(_planned_layers(plan.imagery_name, part.files), years),
    }


def _planned_layers(name: str, files: list[LocalRaster]) -> dict[str, Source]:
    return _layers([], files) if files else {name: read_source(name)}


__all__ = ["FetchPlan", "FetchRequest", "Fetched", "described", "fetch_place", "open_data_store", "plan_place"]
