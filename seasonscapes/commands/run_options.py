"""Flags of ``seasonscapes run``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range, parse_names, parse_size
from seasonscapes.commands.refusals import refuse_without

if TYPE_CHECKING:
    from seasonscapes.workflows.distillation import DistilOptions
    from seasonscapes.workflows.run_photographs import RunPhotographs


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RunPictureOptions:
    """The photographs."""

    manifest: Path | None = None
    """The .csv of `seasonscapes webcams --manifest`; left out, a synthetic scene is photographed from its cameras."""
    calibrations: Path = Path("out/calibration")
    """Of a real scene: folder of the records of `seasonscapes calibrate`."""
    masks: Path | None = None
    """Folder of WEBCAM.png, black where something stands before the landscape."""
    within_min: float = 30.0
    """Of a real scene: use each webcam's picture that is nearest to a time, within so many minutes."""
    doubtful_poses: bool = False
    """Use poses that their calibration called not reliable."""
    leave_out: str | None = None
    """Of a synthetic scene: cameras that take no picture, with commas between."""
    photo_kind: str = "panorama"
    """Of a synthetic scene's webcams: panorama (a full circle, cylindrical) or perspective."""
    photo_size: str | None = None
    """Of a synthetic scene's webcams; default 2048x384, in perspective 720x480."""

    def values(self, *, allow_outside: bool = False) -> RunPhotographs:
        """The flags as one value; ``allow_outside`` lets the manifest name pictures outside its folder."""
        from seasonscapes.workflows.photograph_files import PhotographSources
        from seasonscapes.workflows.run_photographs import PHOTO_SIZES, RunPhotographs

        size_px = PHOTO_SIZES.get(self.photo_kind, (1, 1))
        if self.photo_size is not None:
            size_px = parse_size(self.photo_size, flag="--photo-size")
        sources = None
        if self.manifest is not None:
            sources = PhotographSources(
                self.manifest, self.calibrations, self.masks, allow_outside, self.doubtful_poses
            )
        return RunPhotographs(
            sources, self.masks, self.within_min, frozenset(parse_names(self.leave_out)), self.photo_kind, size_px
        )


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RunEffort:
    """Size and effort of the Gaussian model."""

    discs: int = 160
    """Gaussians along the longer side of the terrain."""
    disc_px: float | None = None
    """Largest side of a disc in the pictures [px], default 2, as far as 50,000 discs go; 0: all of one size."""
    steps: int | None = None
    """Training steps on the surface; default 1500."""
    picture_steps: int | None = None
    """Training steps on images; default 120."""
    suns: int | None = None
    """Instants to train on; default 24."""
    views: int | None = None
    """Cameras around the terrain for training images, default 3; 0 trains on the surface alone."""

    def values(self, *, appearance: str = "physical") -> DistilOptions:
        """The flags as one value; `InputError` for those that the appearance does not use."""
        from seasonscapes.workflows.distillation import RUN_DISCS, DistilOptions

        given = {
            "disc_px": self.disc_px,
            "steps": self.steps,
            "picture_steps": self.picture_steps,
            "suns": self.suns,
            "views": self.views,
        }
        refuse_without("--appearance physical", appearance == "physical", **given)
        check_range("--disc-px", self.disc_px or 0.0, 0, 64)
        # A run's model is smaller than the one that `distill` makes.
        return DistilOptions(
            discs=self.discs,
            disc_px=2.0 if self.disc_px is None else self.disc_px,
            most_discs=RUN_DISCS,
            learn_near=False,
            suns=24 if self.suns is None else self.suns,
            views=3 if self.views is None else self.views,
            steps=1500 if self.steps is None else self.steps,
            picture_steps=120 if self.picture_steps is None else self.picture_steps,
        )
