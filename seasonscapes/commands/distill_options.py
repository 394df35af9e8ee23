"""Flags of ``seasonscapes distill`` by appearance: of light that is relit, and of frames that are learned from."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_choice, check_range
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.commands.options import PlaceOptions
    from seasonscapes.workflows.distillation import DistilOptions


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DistilOptionsOfLight:
    """Of --appearance physical."""

    disc_px: float | None = None
    """Largest side of a disc in pictures of --view-px from the scene's cameras [px], default 2; 0: all of one size."""
    suns: int | None = None
    """Instants to train on, at random hours of the dates' days; default 32."""
    dates: int | None = None
    """Of a synthetic scene: dates of the year whose albedo is stored, default 4. Between them the snow line moves."""
    views: int | None = None
    """Cameras around the terrain for training images, default 6; 0 trains on the surface alone."""
    view_px: int | None = None
    """Their size; default 256."""
    picture_steps: int | None = None
    """Training steps on images; default 240."""
    kind: str | None = None
    """full (physics and a network, default), physical (no network), or sun (a network alone, for comparison)."""

    refine_discs: bool | None = None
    """Whether the images also refine the discs: place, size, direction and opacity; default yes."""

    def values(self, discs: int, steps: int) -> DistilOptions:
        """The flags as one value."""
        from seasonscapes.workflows.distillation import KINDS, DistilOptions

        how = {
            "disc_px": 2.0,
            "suns": 32,
            "dates": 4,
            "views": 6,
            "view_px": 256,
            "picture_steps": 240,
            "kind": "full",
            "refine_discs": True,
        }
        how |= {name: getattr(self, name) for name in how if getattr(self, name) is not None}
        check_choice("--kind", how["kind"], KINDS)
        limits = {
            "disc_px": (0, 64),
            "suns": (1, 512),
            "dates": (1, 24),
            "views": (0, 64),
            "view_px": (16, 4096),
            "picture_steps": (0, 1e6),
        }
        for name, (low, high) in limits.items():
            check_range(f"--{name.replace('_', '-')}", how[name], low, high)
        if self.disc_px and not how["views"]:
            raise InputError("--disc-px", "there are no images whose pixels discs could follow", cure="ask for --views")
        if self.refine_discs and not (how["views"] and how["picture_steps"]):
            raise InputError(
                "--refine-discs", "there are no images to refine from", cure="ask for --views and --picture-steps"
            )
        return DistilOptions(discs=discs, steps=steps, **how)


@dataclass(frozen=True)
class Frames:
    """How to learn from frames; see `workflows.path_stages.distil_frames`."""

    directional: bool
    discs: int
    steps: int
    seed: int


def distil_frames(
    scene: str, place: PlaceOptions, folder: Path | None, output: Path, how: Frames, *, as_json: bool
) -> None:
    """Train on the frames of a folder, write the model, and print what was done."""
    from seasonscapes.workflows import path_stages

    if folder is None:
        raise InputError("--frames", "missing", expected="a folder of pictures with transforms.json or a COLMAP model")
    start = clock.perf_counter()
    with progress_bars() as progress:
        loaded = place.load(scene, progress, output=output)
        model, losses = path_stages.distil_frames(
            loaded,
            folder,
            discs=how.discs,
            steps=how.steps,
            directional=how.directional,
            seed=how.seed,
            progress=progress,
        )
    from seasonscapes.gaussians.frame_appearance import save_frame_gaussians

    save_frame_gaussians(model, output)
    record = {
        "output": str(output),
        **model.note,
        "gaussians": len(model.surfels.means),
        "times": [time.isoformat() for time in model.times],
        "loss": losses[-1],
        "seconds": round(clock.perf_counter() - start, 1),
    }
    size = f"{record['gaussians']:,} Gaussians from {record['frames']} frames of {len(model.times)} times"
    print_result(record, [f"{output}  ({size}, {record['seconds']} s)"], as_json=as_json)
