"""``seasonscapes irradiance``."""

from __future__ import annotations

import time as clock
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.arguments import parse_time
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output
from seasonscapes.commands.when_options import WhenOptions
from seasonscapes.errors import InputError


def irradiance_command(
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
    """Map the irradiance of the ground: W/m² and lux at an hour, kWh/m² and sunshine hours of a period.

    Values are per square metre of the inclined surface. Cast shadows, the visible part of the sky and interreflection
    are included; bands are named in the file.

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
    check_output(output, (".tif", ".tiff"))
    if (time is None) == (when is None):
        got, cure = "both" if when else "neither", "--time T, or --from T0 --to T1 --every 1h"
        raise InputError("--time", "give either an instant or a period", got=got, cure=cure)
    import numpy as np

    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows.received_light import irradiance_map, require_rays

    require_rays(rays, where="--rays")
    model = sky.model()
    use_backend(device)
    with progress_bars() as progress:
        loaded = options.load(scene, progress, output=output)
        at = (loaded.frame.latitude_deg, loaded.frame.longitude_deg)
        times = parse_time(time, *at) if time is not None else (when or WhenOptions()).instants(*at)
        received = irradiance_map(
            loaded, times, sky=model, spacing_m=spacing_m, rays=rays, seed=seed, progress=progress
        )
    received.save(output)
    mean = {name: round(float(np.nanmean(values)), 4) for name, values in received.bands.items()}
    seconds = round(clock.perf_counter() - start, 2)
    record = {**received.record, "output": str(output), "mean": mean, "seconds": seconds}
    lines = [f"{name:<18} mean {mean[name]:.4g}" for name in received.bands]
    rows, columns = received.grid.values.shape[:2]
    print_result(record, [*lines, f"{output}  ({columns} × {rows} cells, {seconds} s)"], as_json=json)
