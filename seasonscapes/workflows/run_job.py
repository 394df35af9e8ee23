"""What a run is to make, and the files of its folder that several stages know."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from seasonscapes.images import atomic_path
from seasonscapes.scene import NamedCamera
from seasonscapes.sky.models import SkyModel
from seasonscapes.workflows.distillation import DistilOptions
from seasonscapes.workflows.photograph_files import PhotographSources
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.run_methods import METHODS, PathStages, RunMethod
from seasonscapes.workflows.run_photographs import RunPhotographs


@dataclass(frozen=True)
class RunJob:
    """What a run is to make.

    Parameters
    ----------
    place
        The place.
    times
        Of the photographs, aware UTC; of one season or of several.
    hours
        Of the pictures, aware UTC.
    view, size_px
        Camera of the pictures, and their size [px].
    sky
        The sky model.
    photographs
        Where photographs and poses come from.
    distil
        Size and effort of the Gaussian model.
    seed
        Equal seeds give equal results.
    allow_outside
        Let the scene file name rasters outside its folder.
    method
        How each stage is done; see `run_methods`.
    along
        What the stages along a camera path need.
    season
        How relit pictures interpolate between the albedos of several seasons; see `albedo.seasons.AlbedoSeries`.
    """

    place: Place
    times: tuple[datetime, ...]
    hours: tuple[datetime, ...]
    view: NamedCamera
    size_px: tuple[int, int]
    sky: SkyModel
    photographs: RunPhotographs = field(default_factory=RunPhotographs)
    distil: DistilOptions = field(default_factory=DistilOptions)
    seed: int = 0
    allow_outside: bool = False
    method: RunMethod = METHODS["physical"]
    along: PathStages = field(default_factory=PathStages)
    season: str = "blended"


def sources_of(job: RunJob, folder: Path) -> PhotographSources:
    """The photographs of a run's folder, or the plane views that were cut from them, with their poses and masks."""
    if job.method.poses == "points":
        own = folder / "views"
        return PhotographSources(own / "manifest.csv", folder / "calibration", own / "masks")
    masks = folder / "pictures" / "masks"
    return PhotographSources(
        folder / "pictures" / "manifest.csv",
        folder / "calibration",
        masks if masks.is_dir() else None,
        accept_doubtful=True,  # decided where the records were brought
    )


def write_record(path: Path, record: dict[str, Any] | list[dict[str, Any]]) -> Path:
    """Write plain values as JSON, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1, default=float) + "\n", encoding="utf-8")
    return path
