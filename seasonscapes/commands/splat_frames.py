"""``seasonscapes splat`` of a model that was learned from frames."""

from __future__ import annotations

import json
import time as clock
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING

from seasonscapes.commands.arguments import parse_time
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.errors import InputError, NoTerrainInView

if TYPE_CHECKING:
    from seasonscapes.commands.options import PlaceOptions
    from seasonscapes.commands.view_options import ViewOptions


def frame_picture(
    scene: str, place: PlaceOptions, view: ViewOptions, model: Path, look: str | Path, output: Path, *, as_json: bool
) -> None:
    """Picture the model at an hour (text: embeddings of its frames' times are interpolated), or like a photograph (path)."""
    from seasonscapes.images import write_png
    from seasonscapes.workflows.path_stages import frame_view, load_frame_model, look_of_photograph

    start = clock.perf_counter()
    with progress_bars() as progress:
        loaded = place.load(scene, progress, output=output)
    splats, camera, chosen = load_frame_model(loaded, model), view.pinhole(loaded), view.chosen(loaded.scene)
    if isinstance(look, Path):
        looks, about = look_of_photograph(loaded, splats, camera, look)
    else:
        looks = parse_time(look, chosen.latitude_deg, chosen.longitude_deg)
        about = {"time_utc": looks.astimezone(UTC).isoformat()}
    try:
        picture = frame_view(loaded, splats, camera, looks, cloudiness=0.0)
    except NoTerrainInView as error:
        raise InputError("--camera", str(error)) from None
    record = {
        "scene": loaded.scene.name,
        "gaussians": len(splats.surfels.means),
        "camera": chosen.name,
        **about,
        "learned_times_utc": [each.isoformat() for each in splats.times],
        "attribution": loaded.scene.attribution,
    }
    write_png(output, picture, metadata={"seasonscapes": json.dumps(record)})
    record["seconds"] = round(clock.perf_counter() - start, 2)
    line = f"{output}  ({record['gaussians']:,} Gaussians learned from frames, {record['seconds']} s)"
    print_result({"output": str(output), **record}, [line], as_json=as_json)
