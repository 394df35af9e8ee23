"""``seasonscapes lit-texture`` and ``seasonscapes irradiance``: what the ground receives."""

from __future__ import annotations

import json as json_module
import time as clock
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.talk import check_range, check_suffix, finish, progress_bar, say
from seasonscapes.commands.timelapse import WhenOptions
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from seasonscapes.pipeline import Place
    from seasonscapes.sky.illumination import Illumination
    from seasonscapes.sky.models import SkyModel

# All lights of a period are held at once, 100 kB each.
_MOST_LIGHTS = 9000


def lit_texture(
    scene: str,
    *,
    time: str,
    sky: SkyOptions | None = None,
    albedo: Path | None = None,
    exposure: str = "auto",
    rays: int = 128,
    seed: int = 0,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/lit.png"),
    place: PlaceOptions | None = None,
    device: str = "auto",
    json: bool = False,
) -> None:
    """Export a place's texture as lit at an hour: baked sun, sky and interreflection times the albedo.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    time
        ISO 8601. Without an offset it is civil time at the place.
    albedo
        An albedo texture (.npz) of your own instead of the scene's.
    exposure
        auto (a camera), eye (a person who has adapted), or an exposure value EV100; of .png and .glb.
    rays
        Over the sky of each texel, a power of two.
    seed
        Equal seeds give equal textures.
    output
        .png, the exposed texture; .glb, the terrain wearing it; .exr, illuminances [lx], albedo and radiance [cd/m²].
    device
        auto, cuda or llvm.
    json
        Print one machine-readable record.
    """
    start = clock.perf_counter()
    sky, options = sky or SkyOptions(), place or PlaceOptions()
    check_suffix(output, (".png", ".glb", ".exr"))
    _check_rays(rays)
    from seasonscapes.exposure import develop, exposure_ev100, parse_exposure
    from seasonscapes.images import write_exr, write_png
    from seasonscapes.pipeline import albedo_for, dated_albedos
    from seasonscapes.relighting.lit_texture import lit_texture as bake
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.rendering.transport import SamplingOptions
    from seasonscapes.terrain.texels import texel_positions

    metering, model = parse_exposure(exposure), sky.model()
    use_backend(device)
    land = options.load(scene)
    when, moment, light = _light(land, model, time)
    if albedo is None:
        texture = albedo_for(land, when)
    else:
        texture = dated_albedos(land, [(when.date().isoformat(), str(albedo))])[0].load()
    positions, _ = texel_positions(land.terrain, land.atlas.width_px, land.atlas.height_px)
    with progress_bar("baking") as progress:
        lit = bake(
            ray_scene(mi_mesh(land.terrain, texture.values)),
            positions,
            texture.values,
            light,
            sampling=SamplingOptions(subpixels=1, rays=rays),
            seed=seed,
            progress=progress,
        )
    record = _record(scene, land, when, moment, light) | {"output": str(output), "rays": rays, "seed": seed}
    if output.suffix.lower() == ".exr":
        write_exr(
            output,
            {"": lit.radiance, "sun": lit.sun, "sky": lit.sky, "bounce": lit.bounce, "albedo": lit.albedo},
            header={
                "seasonscapes:provenance": record,
                "seasonscapes:units": "radiance in cd/m2; sun, sky and bounce in lux",
            },
        )
    else:
        record["exposure_ev100"] = exposure_ev100(lit.radiance, metering)
        picture = develop(lit.radiance, record["exposure_ev100"], eye=metering == "eye")
        if output.suffix.lower() == ".png":
            write_png(output, picture, metadata={"seasonscapes": json_module.dumps(record, default=float)})
        else:
            _write_model(output, land, picture, record)
    record["seconds"] = round(clock.perf_counter() - start, 2)
    finish(
        record,
        [f"{output}  ({land.atlas.width_px} × {land.atlas.height_px} texels, {record['seconds']} s)"],
        as_json=json,
    )


def _write_model(output: Path, land: Place, picture: np.ndarray, record: dict) -> None:
    import numpy as np

    from seasonscapes.images import srgb_from_linear
    from seasonscapes.terrain.gltf import write_glb

    levels = np.rint(srgb_from_linear(picture) * 255.0).astype(np.uint8)
    plain = json_module.loads(json_module.dumps(record, default=float))
    write_glb(output, land.terrain, levels, unlit=True, extras=plain)


def irradiance(
    scene: str,
    *,
    time: str | None = None,
    when: WhenOptions | None = None,
    sky: SkyOptions | None = None,
    spacing_m: float | None = None,
    rays: int = 128,
    seed: int = 0,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/irradiance.tif"),
    place: PlaceOptions | None = None,
    device: str = "auto",
    json: bool = False,
) -> None:
    """Map what sun, sky and slopes around give the ground: W/m² and lux at an hour, kWh/m² and sunny hours of a period.

    Values are per square metre of the slope itself. Shadows, the sky that mountains leave open and light from slope to
    slope are all in them; bands are named in the file.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    time
        An instant, ISO 8601; or give --from, --to and --every for a period.
    spacing_m
        Side of the map's cells; default those of the elevation raster.
    rays
        Over the sky of each cell, a power of two.
    seed
        Equal seeds give equal maps.
    output
        A .tif (GeoTIFF, float32, in the elevation's coordinate system).
    device
        auto, cuda or llvm.
    json
        Print one machine-readable record.
    """
    start = clock.perf_counter()
    sky, options = sky or SkyOptions(), place or PlaceOptions()
    check_suffix(output, (".tif", ".tiff"))
    _check_rays(rays)
    if (time is None) == (when is None):
        raise InputError(
            "--time",
            "give either an instant or a period",
            got="both" if when else "neither",
            cure="--time T, or --from T0 --to T1 --every 1h",
        )
    import numpy as np

    from seasonscapes.pipeline import albedo_for
    from seasonscapes.relighting.lit_texture import integrate_irradiance
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.rendering.transport import SamplingOptions

    model = sky.model()
    use_backend(device)
    land = options.load(scene)
    if time is not None:
        instant, moment, light = _light(land, model, time)
        times, lights, hours = [instant], [light], np.ones(1)
        record = _record(scene, land, instant, moment, light)
    else:
        times = when.instants(land.frame.latitude_deg, land.frame.longitude_deg)
        lights, times, hours = _lights(land, model, times)
        record = {
            "scene": scene,
            "from_utc": times[0].isoformat(),
            "to_utc": times[-1].isoformat(),
            "instants": len(times),
        }
    grid, positions = _grid(land, spacing_m)
    middle = times[len(times) // 2]
    with progress_bar("irradiance") as progress:
        received = integrate_irradiance(
            ray_scene(mi_mesh(land.terrain, albedo_for(land, middle).values)),
            positions,
            lights,
            hours,
            sampling=SamplingOptions(subpixels=1, rays=rays),
            search_m=_SEARCH_M,
            seed=seed,
            progress=progress,
        )
    bands = _bands(received, period=time is None)
    _write_map(output, grid, bands, record)
    record["output"] = str(output)
    record["mean"] = {name: round(float(np.nanmean(values)), 4) for name, values in bands.items()}
    record["seconds"] = round(clock.perf_counter() - start, 2)
    lines = [f"{name:<18} mean {record['mean'][name]:.4g}" for name in bands]
    finish(
        record,
        [*lines, f"{output}  ({grid.values.shape[1]} × {grid.values.shape[0]} cells, {record['seconds']} s)"],
        as_json=json,
    )


# The mesh keeps within some metres of the raster; on a cliff a cell's height may be far off it.
_SEARCH_M = 1000.0


def _check_rays(rays: int) -> None:
    check_range("--rays", rays, 16, 4096)
    if rays & (rays - 1):
        raise InputError("--rays", "not a power of two", got=rays)


def _light(land: Place, model: SkyModel, time: str) -> tuple[datetime, Any, Illumination]:
    """An instant, where sun and moon stand then, and their light on the land."""
    from seasonscapes.civil_time import resolve_time
    from seasonscapes.daylight import land_light

    resolved = resolve_time(time, land.frame.latitude_deg, land.frame.longitude_deg)
    say(resolved.reading)
    light, moment = land_light(land, model, resolved.utc)
    return resolved.utc, moment, light


def _record(scene: str, land: Place, when: datetime, moment: Any, light: Illumination) -> dict[str, Any]:
    sun = {"azimuth_deg": float(moment.sun.azimuth_deg), "elevation_deg": float(moment.sun.elevation_deg)}
    return {
        "scene": scene,
        "time_utc": when.astimezone(UTC).isoformat(),
        "sun": sun,
        "sky": light.model,
        "attribution": land.scene.attribution,
    }


def _lights(land: Place, model: SkyModel, times: list[datetime]) -> tuple[list, list[datetime], np.ndarray]:
    """Lights of a period where there is any worth a watt, and the hours that each stands for (trapezoid rule)."""
    import numpy as np

    from seasonscapes.daylight import light_at, median_height_m, moment_at

    if len(times) < 2:
        raise InputError("--every", "leaves one instant", cure="give --time for an instant, or a shorter --every")
    seconds = np.array([each.timestamp() for each in times])
    gaps = np.diff(seconds)
    hours = np.zeros(len(times))
    hours[:-1] += 0.5 * gaps / 3600.0
    hours[1:] += 0.5 * gaps / 3600.0
    ground_m = median_height_m(land)
    lights, kept = [], []
    with progress_bar("skies") as progress:
        for index, each in enumerate(times):
            moment = moment_at(each, land.frame.latitude_deg, land.frame.longitude_deg, ground_m)
            # Below -6° the sky gives less than a hundredth of a watt.
            if moment.sun.elevation_deg > -6.0:
                lights.append(
                    light_at(model, moment, ground_m, workspace=land.workspace, map_height=64, with_air=False)
                )
                kept.append(index)
            progress((index + 1) / len(times))
    if not lights:
        raise InputError(
            "--from", "the sun is far below the horizon all this time", cure="choose a period with daylight"
        )
    check_range("--every", len(lights), 1, _MOST_LIGHTS)
    return lights, [times[index] for index in kept], hours[kept]


def _grid(land: Place, spacing_m: float | None) -> tuple[Any, np.ndarray]:
    """The map's raster, values are heights, and the cells' places ``(N, 3)`` ENU."""
    import numpy as np
    from affine import Affine

    from seasonscapes.frames import enu_from_geodetic
    from seasonscapes.pipeline import sample_spacing_m
    from seasonscapes.terrain.raster import geodetic_from_map, sample_raster
    from seasonscapes.terrain.surface import Raster

    raster = land.elevation
    height, width = raster.values.shape[:2]
    factor = 1.0 if spacing_m is None else spacing_m / sample_spacing_m(raster)
    rows, columns = max(1, round(height / factor)), max(1, round(width / factor))
    check_range("--spacing-m", rows * columns, 1, 400_000_000)
    transform = raster.transform * Affine.scale(width / columns, height / rows)
    column, row = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    x, y = transform * (column.ravel(), row.ravel())
    heights = sample_raster(raster, x, y)[..., 0]
    latitude, longitude = geodetic_from_map(raster.crs, x, y)
    positions = enu_from_geodetic(land.frame, latitude, longitude, heights)
    return Raster(heights.reshape(rows, columns, 1), transform, raster.crs), positions


def _bands(received: Any, *, period: bool) -> dict[str, np.ndarray]:
    watts = {"direct": received.direct_w, "sky": received.sky_w, "reflected": received.reflected_w}
    watts = {"total": received.direct_w + received.sky_w + received.reflected_w, **watts}
    if period:
        return {f"{name} kWh/m2": values / 1000.0 for name, values in watts.items()} | {
            "total klx h": received.total_lx / 1000.0,
            "sunshine h": received.sunlit,
        }
    return {f"{name} W/m2": values for name, values in watts.items()} | {"total lx": received.total_lx}


def _write_map(path: Path, grid: Any, bands: dict[str, np.ndarray], record: dict) -> None:
    import rasterio

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
    with atomic_path(path) as temporary, rasterio.open(temporary, "w", **profile) as file:
        for index, (name, values) in enumerate(bands.items(), start=1):
            file.write(values.reshape(rows, columns), index)
            file.set_band_description(index, name)
        file.update_tags(seasonscapes=json_module.dumps(record, default=float))
