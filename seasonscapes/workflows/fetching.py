"""From coordinates to a scene file: heights and images from open catalogues, or from files of one's own."""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes import __version__
from seasonscapes.declaration import validate
from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path, srgb_from_linear
from seasonscapes.open_data.elevation import AssetUse, Heights, height_tiles, load_heights
from seasonscapes.open_data.imagery import Day, Image, image_days, load_image, load_undated, undated_tiles
from seasonscapes.open_data.local_files import LocalRaster, local_colours, local_heights, local_rasters
from seasonscapes.open_data.remote import RemoteStore
from seasonscapes.open_data.sources import Source, read_source, source_of
from seasonscapes.progress import Progress, task_progress
from seasonscapes.scene import SceneFile
from seasonscapes.sky.ephemeris import sun_position
from seasonscapes.terrain.mosaic import MapGrid, grid_about
from seasonscapes.terrain.raster import fill_nodata
from seasonscapes.terrain.surface import Raster
from seasonscapes.terrain.viewpoints import View, find_views
from seasonscapes.workspace import Workspace, default_workspace, file_hash

# Textures and grids of more cells a side show nothing more.
_MOST_CELLS = 4096
_SIZE_M = (500.0, 150_000.0)
_FULL_SCALE = 10_000.0
_DEM_NODATA = -32768.0
_AUTO_ELEVATION = "cop-dem-glo-30"


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
    interval
        ISO 8601 interval with a slash; by default the last whole summer of the place.
    cloud_percent
        Largest cloud cover of an image [%].
    composite
        ``clearest`` or ``median``.
    catalogue_url
        STAC API asked in place of the sources' own.
    resolution_m
        Finest spacing of heights and pixels [m].
    offline
        Use what was loaded before, and nothing else.
    """

    output: Path
    at: tuple[float, float] | None = None
    size_m: tuple[float, float] | None = None
    elevation: str = "auto"
    imagery: str = "sentinel-2"
    interval: str | None = None
    cloud_percent: float = 20.0
    composite: str = "clearest"
    catalogue_url: str | None = None
    resolution_m: float | None = None
    offline: bool = False


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
    height_files, image_files
        Files of one's own.
    height_tiles, image_tiles
        Assets of catalogues.
    days
        Passes to choose from, the most promising first.
    interval
        Interval of `FetchRequest.interval`.
    height_bytes, image_bytes
        About how much is to be loaded.
    """

    centre_deg: tuple[float, float]
    size_m: tuple[float, float]
    elevation_name: str
    imagery_name: str
    heights_grid: MapGrid
    image_grid: MapGrid | None
    height_files: list[LocalRaster] = field(default_factory=list)
    image_files: list[LocalRaster] = field(default_factory=list)
    height_tiles: list[AssetUse] = field(default_factory=list)
    image_tiles: list[AssetUse] = field(default_factory=list)
    days: list[Day] = field(default_factory=list)
    interval: str | None = None
    height_bytes: int = 0
    image_bytes: int = 0


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
    plan = FetchPlan(centre, size, name, "none", grid, None, height_files, image_files)
    if source is not None:
        _check_covers(source, name, centre, "--elevation")
        plan.height_tiles = height_tiles(
            store, name, grid, catalogue_url=request.catalogue_url, finest_m=grid.spacing_m
        )
        plan.height_bytes = _bytes(source, size, grid.spacing_m, len(plan.height_tiles))
    if request.imagery != "none":
        _plan_imagery(plan, request, store)
    return plan


def _plan_imagery(plan: FetchPlan, request: FetchRequest, store: RemoteStore) -> None:
    if plan.image_files:
        plan.imagery_name = "files"
        spacing_m = _spacing_m(min(each.spacing_m for each in plan.image_files), plan.size_m, request.resolution_m)
        plan.image_grid = grid_about(*plan.centre_deg, plan.size_m, spacing_m)
        return
    source = source_of(request.imagery, "imagery", flag="--imagery")
    _check_covers(source, request.imagery, plan.centre_deg, "--imagery")
    plan.imagery_name = request.imagery
    spacing_m = _spacing_m(source.spacing_m, plan.size_m, request.resolution_m)
    plan.image_grid = grid = grid_about(*plan.centre_deg, plan.size_m, spacing_m)
    if source.time == "year":
        plan.image_tiles = undated_tiles(store, request.imagery, grid, catalogue_url=request.catalogue_url)
        plan.image_bytes = 3 * _bytes(source, plan.size_m, spacing_m, len(plan.image_tiles))
        return
    plan.interval = request.interval or last_summer(plan.centre_deg[0], datetime.now(UTC).date())
    plan.days = image_days(
        store,
        request.imagery,
        grid,
        interval=plan.interval,
        cloud_percent=request.cloud_percent,
        catalogue_url=request.catalogue_url,
    )
    if not plan.days:
        raise InputError(
            f"{request.imagery} at {plan.centre_deg[0]:.4f}, {plan.centre_deg[1]:.4f}",
            "no image in this time with so few clouds",
            got=f"{plan.interval}, at most {request.cloud_percent:g} % clouds",
            cure="widen --date, or raise --cloud",
        )
    items = len(plan.days[0].items)
    one = _bytes(source, plan.size_m, spacing_m, items)
    plan.image_bytes = 3 * one + min(len(plan.days), 8) * one // 8


def fetch_place(request: FetchRequest, store: RemoteStore, *, progress: Progress | None = None) -> Fetched:
    """Load heights and image of a place and write its scene file, rasters and sources.

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
        ``NAME.toml`` with ``NAME.dem.tif``, ``NAME.ortho.tif`` and ``NAME.sources.json`` beside it.

    Raises
    ------
    InputError
        One line; nothing is written, and what was loaded is kept for the next attempt.
    """
    _check_output(request.output)
    plan = plan_place(request, store)
    heights = _heights(plan, request, store, progress)
    image = _image(plan, request, store, progress)
    views = find_views(_filled(heights.values, plan.heights_grid), plan.heights_grid)
    record = _record(plan, heights, image, store)
    text = _scene_text(request.output, plan, heights, image, views, record)
    validate(tomllib.loads(text), SceneFile, where=request.output)
    _write(request.output, plan, heights, image, text, record)
    return Fetched(request.output, record, store.loaded_bytes)


# ---------------------------------------------------------------------------------------------- the request


def last_summer(latitude_deg: float, today: date) -> str:
    """The last whole summer, June to September or December to March, as an ISO 8601 interval.

    Examples
    --------
    >>> from datetime import date
    >>> from seasonscapes.workflows.fetching import last_summer
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
    if request.composite not in ("clearest", "median"):
        raise InputError("--composite", "unknown composite", got=request.composite, expected="clearest or median")
    if not 0.0 <= request.cloud_percent <= 100.0:
        raise InputError("--cloud", "out of range", got=request.cloud_percent, expected="0 to 100 %")
    if request.resolution_m is not None and not 0.1 <= request.resolution_m <= 1000.0:
        raise InputError("--resolution", "out of range", got=request.resolution_m, expected="0.1 to 1000 m")
    for side in request.size_m or ():
        if not _SIZE_M[0] <= side <= _SIZE_M[1]:
            expected = f"{_SIZE_M[0]:g} m to {_SIZE_M[1] / 1000.0:g} km"
            raise InputError("--size", "out of range", got=f"{side:g} m", expected=expected)
    if request.catalogue_url is not None and not re.match(r"https?://[^\s/]+", request.catalogue_url):
        raise InputError("--stac", "not an address", got=request.catalogue_url, expected="https://…")


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


def _check_output(output: Path) -> None:
    """Refuse to replace a scene file that somebody has edited, or written otherwise."""
    if output.suffix != ".toml":
        raise InputError("--output", "not a scene file", got=str(output), expected="a name that ends in .toml")
    if not output.exists():
        return
    sources = _beside(output, ".sources.json")
    try:
        ours = json.loads(sources.read_text())["files"][output.name]["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        ours = None
    if not output.is_file() or ours != file_hash(output):
        raise InputError(
            output, "exists, and is not as fetch wrote it", cure="choose another -o, or move the file away"
        )


def _beside(output: Path, suffix: str) -> Path:
    return output.with_name(output.stem + suffix)


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
    return Heights(values, shares={"files": known})


def _image(plan: FetchPlan, request: FetchRequest, store: RemoteStore, progress: Progress | None) -> Image | None:
    if plan.image_grid is None:
        return None
    report = task_progress(progress, "image")
    if plan.image_files:
        values = local_colours(plan.image_files, plan.image_grid, progress=report)
        times = {each.time for each in plan.image_files}
        time = times.pop() if len(times) == 1 else None
        years = sorted({each.year for each in plan.image_files if each.year is not None})
        known = float(np.isfinite(values).all(axis=2).mean())
        return Image(values, time, report={"known_share": known, "years": years})
    if plan.days:
        return load_image(
            store, plan.imagery_name, plan.image_grid, plan.days, composite=request.composite, progress=report
        )
    return load_undated(store, plan.imagery_name, plan.image_grid, catalogue_url=request.catalogue_url, progress=report)


def _filled(values: np.ndarray, grid: MapGrid) -> np.ndarray:
    raster = Raster(values[..., None], grid.transform, grid.crs)
    return fill_nodata(raster, max_share=0.5, where="heights")[0].values[..., 0]


# ---------------------------------------------------------------------------------------------- the record


def _record(plan: FetchPlan, heights: Heights, image: Image | None, store: RemoteStore) -> dict[str, Any]:
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
        "licences": _licences(_layers(plan.elevation_name, heights.used, plan.height_files), []),
        "items": _items(heights.used, plan.height_files, store),
    }
    if image is None or plan.image_grid is None:
        return record
    years = image.report.get("years") or sorted({use.item.time.year for use in image.used if use.item.time is not None})
    record["imagery"] = {
        "source": plan.imagery_name,
        "grid": asdict(plan.image_grid),
        "time": None if image.time is None else _iso(image.time),
        "sun": _sun(plan, heights, image),
        "report": image.report,
        "licences": _licences(_layers(plan.imagery_name, image.used, plan.image_files), years),
        "items": _items(image.used, plan.image_files, store),
    }
    return record


def _layers(name: str, used: list[AssetUse], files: list[LocalRaster]) -> dict[str, Source]:
    """The declared sources that gave something, by name."""
    names = dict.fromkeys(use.source for use in used)
    layers = {each: read_source(each) for each in names}
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
                "time": None if use.item.time is None else _iso(use.item.time),
                "etag": None if state is None else state.tag,
                "bytes": None if state is None else state.size,
                "checksum": checksum,
                "checksum_verified": store.verify(use.asset["href"], None if checksum is None else str(checksum)),
                "processing_baseline": use.item.properties.get("s2:processing_baseline"),
            }
        )
    for each in files:
        time = None if each.time is None else _iso(each.time)
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


def _iso(time: datetime) -> str:
    return time.astimezone(UTC).isoformat().replace("+00:00", "Z")


# ---------------------------------------------------------------------------------------------- the files


def _scene_text(
    output: Path, plan: FetchPlan, heights: Heights, image: Image | None, views: list[View], record: dict[str, Any]
) -> str:
    latitude, longitude = plan.centre_deg
    kilometres = " × ".join(f"{side / 1000.0:g}" for side in (round(side, -1) for side in plan.size_m))
    credits = dict.fromkeys(
        each["attribution"] for part in ("elevation", "imagery") for each in record.get(part, {}).get("licences", [])
    )
    lines = [
        f"# Written by seasonscapes fetch; where it comes from: {_beside(output, '.sources.json').name}",
        f"name = {_toml(_slug(output.stem))}",
        f"title = {_toml(f'{latitude:.4f}, {longitude:.4f}: {kilometres} km')}",
        f"attribution = {_toml('; '.join(credits))}",
        f"vertical_datum = {_toml(record['elevation']['vertical_datum'])}",
        "",
        "[elevation]",
        f"file = {_toml(_beside(output, '.dem.tif').name)}",
    ]
    if image is not None:
        lines += ["", "[imagery]", f"file = {_toml(_beside(output, '.ortho.tif').name)}"]
        if _is_reflectance(plan):
            lines += ['encoding = "linear"', f"full_scale = {_FULL_SCALE}", "reflectance_scale = 1.0"]
        else:
            lines += ['encoding = "srgb"']
        if image.time is not None:
            lines += [f"time = {_toml(_iso(image.time))}"]
    for view in views:
        lines += ["", "[[camera]]"] + [f"{key} = {_toml(value)}" for key, value in asdict(view).items()]
    return "\n".join(lines) + "\n"


def _is_reflectance(plan: FetchPlan) -> bool:
    return not plan.image_files and read_source(plan.imagery_name).encoding == "linear"


def _slug(stem: str) -> str:
    slug = re.sub(r"[^a-z0-9_-]+", "_", stem.lower()).strip("_-")
    return slug[:60] or "place"


def _toml(value: str | float) -> str:
    """A TOML basic string or a number."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "")


def _write(
    output: Path, plan: FetchPlan, heights: Heights, image: Image | None, text: str, record: dict[str, Any]
) -> None:
    """Write all files, and give them their names only when all are whole; the scene file last."""
    writers: list[tuple[Path, Callable[[Path], None]]] = [
        (_beside(output, ".dem.tif"), lambda path: _write_heights(path, heights.values, plan.heights_grid))
    ]
    if image is not None and plan.image_grid is not None:
        grid, values, reflectance = plan.image_grid, image.values, _is_reflectance(plan)
        write = _write_reflectance if reflectance else _write_colours
        writers.append((_beside(output, ".ortho.tif"), lambda path: write(path, values, grid)))
    try:
        with ExitStack() as stack:
            scene_path = stack.enter_context(atomic_path(output))
            sources_path = stack.enter_context(atomic_path(_beside(output, ".sources.json")))
            files = {}
            for path, write_file in writers:
                temporary = stack.enter_context(atomic_path(path))
                write_file(temporary)
                files[path.name] = {"sha256": file_hash(temporary), "bytes": temporary.stat().st_size}
            scene_path.write_text(text, encoding="utf-8")
            files[output.name] = {"sha256": hashlib.sha256(text.encode()).hexdigest(), "bytes": len(text.encode())}
            record["files"] = files
            sources_path.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(output, f"cannot be written: {error.strerror or error}", cure="choose another -o") from None


def _write_heights(path: Path, values: np.ndarray, grid: MapGrid) -> None:
    stored = np.where(np.isfinite(values), np.round(values, 2), _DEM_NODATA).astype(np.float32)
    _write_cog(path, stored[None], grid, nodata=_DEM_NODATA, predictor=3)


def _write_reflectance(path: Path, values: np.ndarray, grid: MapGrid) -> None:
    """Reflectance as 16-bit numbers of 1/10,000; 0 where nothing is known."""
    known = np.isfinite(values).all(axis=2, keepdims=True)
    stored = np.where(known, np.clip(np.nan_to_num(values) * _FULL_SCALE, 1.0, 65535.0), 0.0)
    _write_cog(path, np.rint(stored).astype(np.uint16).transpose(2, 0, 1), grid, nodata=0, predictor=2)


def _write_colours(path: Path, values: np.ndarray, grid: MapGrid) -> None:
    """8-bit sRGB with an alpha band that is 0 where nothing is known."""
    known = np.isfinite(values).all(axis=2)
    stored = np.rint(255.0 * srgb_from_linear(np.nan_to_num(values))).astype(np.uint8)
    bands = np.concatenate([stored.transpose(2, 0, 1), np.where(known, 255, 0).astype(np.uint8)[None]])
    _write_cog(path, bands, grid, nodata=None, predictor=2)


def _write_cog(path: Path, bands: np.ndarray, grid: MapGrid, *, nodata: float | None, predictor: int) -> None:
    import rasterio
    from rasterio.enums import ColorInterp
    from rasterio.errors import RasterioError

    profile = {
        "driver": "GTiff",
        "height": grid.height,
        "width": grid.width,
        "count": len(bands),
        "dtype": bands.dtype.name,
        "crs": grid.crs,
        "transform": grid.transform,
        "nodata": nodata,
    }
    try:
        with rasterio.MemoryFile() as memory:
            with memory.open(**profile) as file:
                file.write(bands)
                if len(bands) >= 3:
                    colour = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
                    file.colorinterp = colour[: len(bands)]
            options = {"compress": "deflate", "predictor": predictor, "blocksize": 512}
            with memory.open() as file:
                from rasterio.shutil import copy

                copy(file, path, driver="COG", **options)
    except RasterioError as error:
        raise OSError(f"{error}") from None


def described(plan: FetchPlan) -> dict[str, Any]:
    """A plan as plain values: sources, items, licences and about how many bytes."""
    description: dict[str, Any] = {
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
    }
    if plan.image_grid is not None:
        years = [day.time.year for day in plan.days[:1]]
        description["imagery"] = {
            "source": plan.imagery_name,
            "spacing_m": plan.image_grid.spacing_m,
            "interval": plan.interval,
            "items": [use.item.id for use in plan.image_tiles] or [each.path.name for each in plan.image_files],
            "days": [
                {
                    "time": _iso(day.time),
                    "cloud_percent": round(day.cloud_percent, 2),
                    "items": [item.id for item in day.items],
                }
                for day in plan.days
            ],
            "about_bytes": plan.image_bytes,
            "licences": _licences(_planned_layers(plan.imagery_name, plan.image_files), years),
        }
    return description


def _planned_layers(name: str, files: list[LocalRaster]) -> dict[str, Source]:
    return _layers(name, [], files) if files else {name: read_source(name)}


__all__ = [
    "FetchPlan",
    "FetchRequest",
    "Fetched",
    "described",
    "fetch_place",
    "last_summer",
    "open_data_store",
    "plan_place",
]
