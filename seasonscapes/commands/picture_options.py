"""Flags that name photographs and their poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.arguments import parse_names, parse_size, parse_time
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from datetime import datetime

    from seasonscapes.progress import Progress
    from seasonscapes.sky.models import SkyModel
    from seasonscapes.workflows.photograph_files import PhotographSources
    from seasonscapes.workflows.place import Place
    from seasonscapes.workflows.recovery_methods import PaintedTexture


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """Where the pictures and their poses are."""

    manifest: Path | None = None
    """The .csv that `seasonscapes webcams --manifest` wrote."""
    calibrations: Path = Path("out/calibration")
    """Folder of the records that `seasonscapes calibrate` wrote."""
    masks: Path | None = None
    """Folder of WEBCAM.png, black where something stands before the landscape."""
    within_min: float = 30.0
    """Use each webcam's picture that is nearest to --time, within so many minutes."""
    doubtful_poses: bool = False
    """Use poses that their calibration called not reliable."""
    synthetic_webcams: bool = False
    """Photograph a synthetic scene from its own cameras first (some seconds each) instead of reading pictures."""
    leave_out: str | None = None
    """Of --synthetic-webcams: cameras that take no picture, with commas between."""
    size: str = "720x480"
    """Of --synthetic-webcams: WIDTHxHEIGHT."""

    def sources(self, place: Place, utc: datetime, model: SkyModel, progress: Progress) -> PhotographSources:
        """The files of photographs and poses; a synthetic scene is photographed first."""
        from seasonscapes.workflows.photograph_files import PhotographSources
        from seasonscapes.workflows.synthetic_photographs import photographed_in_workspace

        if not self.synthetic_webcams:
            if self.manifest is None:
                expected, cure = (
                    "the .csv of seasonscapes webcams --manifest",
                    "for a synthetic scene: --synthetic-webcams",
                )
                raise InputError("--manifest", "missing", expected=expected, cure=cure)
            return PhotographSources(
                self.manifest, self.calibrations, self.masks, place.scene.confinement.allow_outside, self.doubtful_poses
            )
        size_px = parse_size(self.size)
        return photographed_in_workspace(
            place, utc, model, leave_out=parse_names(self.leave_out), size_px=size_px, progress=progress
        )


def parse_painted(text: str, latitude_deg: float, longitude_deg: float) -> PaintedTexture:
    """``TIME=FILE`` as a painted texture of an instant."""
    from seasonscapes.terrain.surface import load_texture
    from seasonscapes.workflows.recovery_methods import PaintedTexture

    time, equals, name = text.partition("=")
    if not equals or not name.strip():
        expected = "TIME=FILE, such as 2024-07-20T12:00=out/paint/painted.npz"
        raise InputError("--painted", "not a painting with its time", got=text, expected=expected)
    instant = parse_time(time.strip(), latitude_deg, longitude_deg)
    return PaintedTexture(instant, load_texture(name.strip()), name.strip())
