"""Light received by the terrain: lit textures of an instant, irradiance maps of an instant or a period."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.errors import DamagedFile, InputError
from seasonscapes.progress import Progress, each_reported, task_progress
from seasonscapes.sky.models import SkyModel
from seasonscapes.terrain.surface import Raster
from seasonscapes.workflows.albedo_sources import AlbedoSource, chosen_albedo
from seasonscapes.workflows.illumination import illumination_at, illumination_on_terrain, sky_model, sun_moon_position
from seasonscapes.workflows.place import Place, utc_at
from seasonscapes.workflows.terrain_building import sample_spacing_m
from seasonscapes.workflows.view_rendering import sun_angles
from seasonscapes.workspace import artefact_key

if TYPE_CHECKING:
    from seasonscapes.relighting.lit_texture import IntegratedIrradiance, LitTexture
    from seasonscapes.rendering.coefficients import PointCoefficients
    from seasonscapes.sky.illumination import Illumination

log = logging.getLogger(__name__)

_CELLS_CODE = ("rendering.irradiance", "rendering.coefficients_file")
# All illuminations of a period are kept in memory, 100 kB each.
_MOST_INSTANTS = 9000
# The mesh lies within some metres of the raster; on a cliff a cell's height may be far from it.
_SEARCH_M = 1000.0
# Below this elevation of the sun the sky contributes less than a hundredth of a watt per square metre.
_DARK_BELOW_DEG = -6.0


def lit_texture(
    place: Place,
    time: str | datetime,
    *,
    sky: str | Path | SkyModel = "clear",
    albedo: AlbedoSource = None,
    rays: int = 128,
    seed: int = 0,
    progress: Progress | None = None,
) -> LitTexture:
    """Compute the light that every texel of a place receives and reflects at an instant.

    Parameters
    ----------
    place
        The place.
    time
        An aware datetime, or ISO 8601 text; without offset it is civil time at the place.
    sky
        A sky model, its name or its file.
    albedo
        A texture of the place's atlas, a dated albedo, an `AlbedoSeries`, or ``None`` for the scene's own.
    rays
        Rays over the hemisphere of each texel; a power of two from 16 to 4096.
    seed
        Equal seeds give equal textures.
    progress
        Called with a task and its finished share.

    Returns
    -------
    LitTexture
        Illuminance from sun, sky and interreflection ``(R, S, 3)`` [lx], the albedo, and ``radiance`` [cd/m²].

    Raises
    ------
    InputError
        For a time or sky model that does not exist, or a number of rays that is not allowed.

    Examples
    --------
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> lit = ss.lit_texture(place, "2024-07-20T13:30", sky="hosek", rays=16)
    >>> bool(np.nanmax(lit.sun[..., 1]) > 50_000)
    True
    """
    from seasonscapes.relighting.lit_texture import bake_lit_texture
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.coefficients import SamplingOptions
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.terrain.texels import texel_positions

    require_rays(rays)
    use_backend()
    utc = utc_at(place, time)
    light, _ = illumination_on_terrain(place, sky_model(sky), utc)
    texture = chosen_albedo(place, utc.date(), albedo, progress=progress)
    positions, _ = texel_positions(place.terrain, place.atlas.width_px, place.atlas.height_px)
    lit = bake_lit_texture(
        ray_scene(mi_mesh(replace(place.terrain, tilt=texture.tilt), texture.values)),
        positions,
        texture.values,
        light,
        sampling=SamplingOptions(shadow_samples=1, rays=rays),
        seed=seed,
        progress=task_progress(progress, "baking"),
    )
    return replace(lit, tilted=texture.tilt is not None)


@dataclass(frozen=True)
class IrradianceMap:
    """Irradiance on the terrain over a map grid; made by `irradiance_map`.

    Parameters
    ----------
    grid
        The map: ``values`` ``(H, W, 1)`` are heights [m]; transform and CRS are those of the elevation raster.
    bands
        Name with unit to ``(H, W)`` float32, NaN without terrain. Of an instant: ``total``, ``direct``, ``sky``,
        ``reflected`` in W/m² and ``total lx``. Of a period: the same in kWh/m², ``total klx h`` and ``sunshine h``.
    record
        Plain values for files and reports.
    """

    grid: Raster
    bands: dict[str, np.ndarray]
    record: dict[str, Any]

    def save(self, path: str | Path) -> None:
        """Write a float32 GeoTIFF, one band each, atomically."""
        write_geotiff(Path(path), self.grid, self.bands, self.record)


def irradiance_map(
    place: Place,
    times: str | datetime | Sequence[datetime],
    *,
    sky: str | Path | SkyModel = "clear",
    albedo: AlbedoSource = None,
    spacing_m: float | None = None,
    rays: int = 128,
    seed: int = 0,
    progress: Progress | None = None,
) -> IrradianceMap:
    """Map the irradiance of the terrain at an instant, or integrate it over a period.

    Values are per square metre of the inclined surface and contain cast shadows, the visible part of the sky and
    interreflection.

    Parameters
    ----------
    place
        The place.
    times
        An instant, or the instants of a period (integrated by the trapezoidal rule).
    sky
        A sky model, its name or its file.
    albedo
        A texture of the place's atlas, a dated albedo, an `AlbedoSeries`, or ``None`` for the scene's own.
    spacing_m
        Side of the map's cells [m]; default that of the elevation raster.
    rays
        Rays over the hemisphere of each cell; a power of two from 16 to 4096.
    seed
        Equal seeds give equal maps.
    progress
        Called with a task and its finished share.

    Returns
    -------
    IrradianceMap
        Its bands are named with their units.

    Raises
    ------
    InputError
        For times without daylight, too many instants or cells, or a number of rays that is not allowed.

    Notes
    -----
    Illuminance is converted to irradiance by the luminous efficacies of Perez et al. 1990
    (doi:10.1016/0038-092X(90)90055-H); see `relighting.luminous_efficacy`.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> received = ss.irradiance_map(place, "2024-07-20T13:30", sky="hosek", spacing_m=400.0, rays=16)
    >>> sorted(received.bands)[0]
    'direct W/m2'
    """
    from seasonscapes.relighting.lit_texture import IlluminationSeries, integrate_irradiance
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.coefficients import SamplingOptions
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.irradiance import BLOCK, irradiance_blocks, kept_irradiance, point_coefficients
    from seasonscapes.rendering.mitsuba_scene import mi_mesh

    require_rays(rays)
    if spacing_m is not None and not 0.0 < spacing_m < np.inf:
        raise InputError("--spacing-m", "out of range", got=spacing_m, expected="a positive number of metres")
    use_backend()
    model = sky_model(sky)
    if isinstance(times, (str, datetime)):
        utc = utc_at(place, times)
        light, position = illumination_on_terrain(place, model, utc)
        instants, lights, hours = [utc], [light], np.ones(1)
        record: dict[str, Any] = {"time_utc": utc.isoformat(), "sun": sun_angles(position), "sky": light.model}
    else:
        instants, lights, hours = _illuminated(place, model, [utc_at(place, time) for time in times], progress)
        span = {"from_utc": instants[0].isoformat(), "to_utc": instants[-1].isoformat()}
        record = span | {"instants": len(instants)}
    record = {"scene": place.scene.name, **record, "attribution": place.scene.attribution}
    grid, positions = _map_grid(place, spacing_m)
    texture = chosen_albedo(place, instants[len(instants) // 2].date(), albedo)
    scene = ray_scene(mi_mesh(replace(place.terrain, tilt=texture.tilt), texture.values))
    sampling = SamplingOptions(shadow_samples=1, rays=rays)
    report = task_progress(progress, "irradiance")
    if len(positions) <= BLOCK:
        inputs = {"place": place.key, "albedo": texture.content, "spacing_m": spacing_m, "rays": rays, "seed": seed}
        trace = partial(point_coefficients, scene, positions, sampling, seed=seed, search_m=_SEARCH_M, progress=report)
        coefficients = _kept_coefficients(place, inputs, trace)
        blocks = iter([kept_irradiance(scene, positions, coefficients, lights, search_m=_SEARCH_M)])
    else:
        blocks = irradiance_blocks(scene, positions, lights, sampling, seed=seed, search_m=_SEARCH_M, progress=report)
    received = integrate_irradiance(blocks, len(positions), IlluminationSeries(lights, hours))
    period = not isinstance(times, (str, datetime))
    return IrradianceMap(grid, _bands(received, grid.values.shape[:2], period=period), record)


def _kept_coefficients(
    place: Place, inputs: dict[str, Any], trace: Callable[[], PointCoefficients]
) -> PointCoefficients:
    """Coefficients of a map's cells from the workspace, where another instant has left them, or traced and kept there."""
    from seasonscapes.rendering.coefficients import PointCoefficients
    from seasonscapes.rendering.coefficients_file import load_coefficients, save_coefficients

    key = artefact_key(inputs, _CELLS_CODE)
    folder = place.workspace.folder / f"{place.scene.name}/coefficients-{key}"
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "a file stands where a built folder belongs", cure="remove it")
    if (folder / "coefficients.json").is_file():
        try:
            kept = load_coefficients(folder, key=key)
            assert isinstance(kept, PointCoefficients)
            return kept
        except DamagedFile as error:
            log.info("%s; light transport is traced again", error)
    traced = trace()
    save_coefficients(folder, traced, key=key)
    return traced


def require_rays(rays: int, *, where: str = "rays") -> None:
    """`InputError` for a number of hemisphere rays that is not a power of two from 16 to 4096."""
    if not 16 <= rays <= 4096:
        raise InputError(where, "out of range", got=rays, expected="16 to 4096")
    if rays & (rays - 1):
        raise InputError(where, "not a power of two", got=rays)


def _illuminated(
    place: Place, model: SkyModel, times: Sequence[datetime], progress: Progress | None
) -> tuple[list[datetime], list[Illumination], np.ndarray]:
    """Instants of a period with daylight, their illumination, and the hours that each represents (trapezoidal rule)."""
    if len(times) < 2:
        raise InputError("--every", "leaves one instant", cure="give --time for an instant, or a shorter --every")
    gaps = np.diff([time.timestamp() for time in times])
    hours = np.zeros(len(times))
    hours[:-1] += 0.5 * gaps / 3600.0
    hours[1:] += 0.5 * gaps / 3600.0
    ground_m, frame = place.median_height_m, place.frame
    lights, kept = [], []
    for index, time in enumerate(each_reported(times, len(times), progress, "skies")):
        position = sun_moon_position(time, frame.latitude_deg, frame.longitude_deg, ground_m)
        if position.sun.elevation_deg > _DARK_BELOW_DEG:
            lights.append(
                illumination_at(
                    model, position, ground_m, workspace=place.workspace, map_height=64, with_aerial_perspective=False
                )
            )
            kept.append(index)
    if not lights:
        cure = "choose a period with daylight"
        raise InputError("--from", "the sun is far below the horizon all this time", cure=cure)
    if len(lights) > _MOST_INSTANTS:
        raise InputError("--every", "too many instants", got=len(lights), expected=f"at most {_MOST_INSTANTS}")
    return [times[index] for index in kept], lights, hours[kept]


def _map_grid(place: Place, spacing_m: float | None) -> tuple[Raster, np.ndarray]:
    """The map's raster, whose values are heights, and the positions of its cells ``(N, 3)`` [m, east-north-up]."""
    from affine import Affine

    from seasonscapes.frames import enu_from_geodetic
    from seasonscapes.terrain.crs import apply_affine, geodetic_from_map
    from seasonscapes.terrain.memory import check_memory
    from seasonscapes.terrain.raster import sample_raster

    raster = place.elevation
    height, width = raster.values.shape[:2]
    factor = 1.0 if spacing_m is None else spacing_m / sample_spacing_m(raster)
    rows, columns = max(1, round(height / factor)), max(1, round(width / factor))
    if rows * columns > 400_000_000:
        raise InputError("--spacing-m", "too many cells", got=rows * columns, expected="at most 400,000,000")
    check_memory((rows, columns), "--spacing-m")
    transform = raster.transform * Affine.scale(width / columns, height / rows)
    column, row = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    # The mesh ends at the outermost samples: cells on its edge or beyond are moved inside, by a thousandth at least.
    inset = 0.5 + 1e-3
    pixel = ~raster.transform * np.asarray(apply_affine(transform, column.ravel(), row.ravel()))
    pixel = [np.clip(values, inset, size - inset) for values, size in zip(pixel, (width, height), strict=True)]
    x, y = apply_affine(raster.transform, *pixel)
    heights = sample_raster(raster, x, y)[..., 0]
    latitude, longitude = geodetic_from_map(raster.crs, x, y)
    positions = enu_from_geodetic(place.frame, latitude, longitude, heights)
    return Raster(heights.reshape(rows, columns, 1), transform, raster.crs), positions


def _bands(received: IntegratedIrradiance, shape: tuple[int, int], *, period: bool) -> dict[str, np.ndarray]:
    watts = {"direct": received.direct_w, "sky": received.sky_w, "reflected": received.reflected_w}
    watts = {"total": received.direct_w + received.sky_w + received.reflected_w, **watts}
    if period:
        bands = {f"{name} kWh/m2": values / 1000.0 for name, values in watts.items()}
        bands |= {"total klx h": received.total_lx / 1000.0, "sunshine h": received.sunlit}
    else:
        bands = {f"{name} W/m2": values for name, values in watts.items()} | {"total lx": received.total_lx}
    return {name: values.reshape(shape) for name, values in bands.items()}


def write_geotiff(path: Path, grid: Raster, bands: dict[str, np.ndarray], record: dict) -> None:
    """Write bands ``(H, W)`` as a tiled float32 GeoTIFF with named bands and a record among its tags, atomically."""
    from rasterio.io import MemoryFile

    from seasonscapes.images import atomic_path

    rows, columns = grid.values.shape[:2]
    profile = {
        "driver": "GTiff",
        "height": rows,
        "width": columns,
        "count": len(bands),
        "dtype": "float32",
        "crs": grid.crs,
        "transform": grid.transform,
        "nodata": float("nan"),
        "compress": "deflate",
        "predictor": 3,
        "tiled": True,
        "blockxsize": 256,
        "blockysize": 256,
    }
    # Made in memory: GDAL says nothing of a disk that is full when it closes a file.
    with MemoryFile() as memory:
        with memory.open(**profile) as file:
            for index, (name, values) in enumerate(bands.items(), start=1):
                file.write(values, index)
                file.set_band_description(index, name)
            file.update_tags(seasonscapes=json.dumps(record, default=float))
        with atomic_path(path) as temporary:
            temporary.write_bytes(memory.getbuffer())
