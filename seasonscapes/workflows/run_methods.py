"""The two methods of a run, stage by stage, so that any stage of one can be exchanged for the other's."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.workflows.path_completion import PathCompletionOptions

_CHOICES = {
    "poses": ("skyline", "joint", "points"),
    "grade": ("none", "paper", "warm", "soft"),
    "painting": ("weighted", "first"),
    "completion": ("guided", "telea", "membrane", "diffusion"),
    "appearance": ("physical", "paper"),
    "recovery": ("closed", "differentiable"),
}
# What the stages of an albedo are asked for without one.
_OF_ALBEDO = ("recovery", "painted", "inpainted")


@dataclass(frozen=True)
class RunMethod:
    """How each stage of a run is done.

    Parameters
    ----------
    name
        Of the method that the stages were taken from.
    poses
        ``"skyline"`` finds panoramas by the terrain's horizon; ``"joint"`` solves one pose of each whole panorama from
        2D–3D points; ``"points"`` cuts them to 4 to 6 plane views and solves each one's heading, ``fx`` and ``fy`` from
        2D–3D points under an L1 loss, as the paper does.
    grade
        Colour grade of the plane views (`cameras.colour_grade.GRADES`), or ``"none"``.
    painting
        ``"weighted"`` blends photographs, fitted to the light; ``"first"`` lets the first one in order that sees a texel win.
    completion
        How texels that nothing painted are filled; ``"diffusion"`` works along a camera path.
    appearance
        Of the Gaussians: ``"physical"`` is distilled from relit renders of the recovered albedo; ``"paper"`` is trained on
        the frames of the completed textures along the path.
    recovery
        Of albedo: ``"closed"``, or ``"differentiable"`` (see `albedo_recovery.RecoveryOptions`).
    painted
        Whether the painted textures enter the albedo once more, as observations beside the photographs.
    foreground
        Whether painting looks for houses and masts, and leaves them out.
    inpainted
        Whether the completed textures, their light taken out, enter the albedo of texels that no photograph measured.

    Examples
    --------
    >>> from seasonscapes.workflows.run_methods import run_method
    >>> run_method("paper", painting="weighted").poses
    'points'
    """

    name: str
    poses: str
    grade: str
    painting: str
    completion: str
    appearance: str
    recovery: str = "closed"
    painted: bool = False
    inpainted: bool = False
    foreground: bool = False

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            value = getattr(self, name)
            if value not in choices:
                raise InputError(f"--{name}", "unknown", got=value, expected=", ".join(choices))
        if self.grade != "none" and self.poses != "points":
            raise InputError("--grade", "is for the plane views of --poses points", got=self.grade, expected="none")
        if not self.needs_albedo:
            for name in _OF_ALBEDO:
                if getattr(self, name) not in (False, "closed"):
                    flag = f"--{name}" if name == "recovery" else f"--use-{name}"
                    raise InputError(flag, "does nothing: without relit pictures no albedo is recovered")

    @property
    def needs_albedo(self) -> bool:
        """Whether an albedo is recovered: from it come relit pictures, distilled light and fitted exposures."""
        return self.name == "physical" or self.appearance == "physical"

    @property
    def refines(self) -> bool:
        """Whether paintings or completions go back into the albedo."""
        return self.painted or self.inpainted

    @property
    def needs_path(self) -> bool:
        """Whether there is a camera path, which is painted along or filmed."""
        return self.completion == "diffusion" or self.appearance == "paper"


METHODS = {
    "physical": RunMethod("physical", "skyline", "none", "weighted", "guided", "physical"),
    "paper": RunMethod("paper", "points", "paper", "first", "diffusion", "paper"),
}


def run_method(name: str, **stages: str | bool | None) -> RunMethod:
    """A method with some of its stages exchanged.

    Parameters
    ----------
    name
        ``"physical"`` or ``"paper"``.
    stages
        Names of fields of `RunMethod` and their values; ``None`` keeps the method's own.

    Raises
    ------
    InputError
        For unknown names and values, and a grade without plane views.
    """
    if name not in METHODS:
        raise InputError("--method", "unknown method", got=name, expected=", ".join(METHODS))
    known = {each.name for each in fields(RunMethod)}
    chosen = {stage: value for stage, value in stages.items() if value is not None and stage in known}
    if chosen.get("poses") in ("skyline", "joint"):
        # A grade belongs to plane views; without them the method's own goes too.
        chosen.setdefault("grade", "none")
    return replace(METHODS[name], **chosen)


@dataclass(frozen=True)
class PathStages:
    """What the stages along a camera path need.

    Parameters
    ----------
    path
        A ``.json`` of ``seasonscapes path``; ``None`` makes one through the scene's cameras.
    views
        Number of its views, where it is made.
    points
        Of real photographs with poses by points: folder of ``WEBCAM.csv``, as ``seasonscapes annotate`` writes them.
    diffusion
        Weights, prompt and effort of the image model; ``None`` without one. Its path and guide image are those of the run.
    paper_steps
        Training steps of the Gaussians with the paper's appearance.
    fps
        Of the films.
    """

    path: Path | None = None
    views: int = 12
    points: Path | None = None
    diffusion: PathCompletionOptions | None = None
    paper_steps: int = 2000
    fps: float = 12.0
