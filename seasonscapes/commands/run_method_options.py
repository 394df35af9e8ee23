"""Flags of ``seasonscapes run`` about its method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range
from seasonscapes.commands.refusals import refuse_without
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.workflows.run_methods import PathStages, RunMethod


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RunMethodOptions:
    """The method, and stages to exchange for the other method's."""

    method: str = "physical"
    """physical (this package's) or paper (Algorithm 1 of the SeasonScapes paper)."""
    poses: str | None = None
    """skyline (physical); joint: each panorama whole, by 2D-3D points; or points (paper): heading, fx, fy of plane views, L1."""
    grade: str | None = None
    """Of plane views: paper (paper), none, warm or soft."""
    painting: str | None = None
    """weighted (physical), or first (paper): the first photograph that sees a texel, ungraded by light."""
    completion: str | None = None
    """guided (physical), telea, membrane, or diffusion (paper): an image model along the path."""
    appearance: str | None = None
    """Of the Gaussians: physical (relit renders), or paper (frames along the path, embeddings, viewing direction)."""
    recovery: str | None = None
    """Of albedo: closed (light, air and poses are given), or differentiable (haze, response, clouds, poses are found)."""
    use_painted: bool | None = None
    """Recover the albedo again with the painted textures as further observations."""
    use_inpainted: bool | None = None
    """Let the completed textures, their light taken out, correct the albedo where no photograph measured it."""
    find_foreground: bool = False
    """Look for houses and masts, which the terrain lacks, and paint none of them; what is known belongs into --masks."""
    season: str | None = None
    """Of photographs of several days: the albedo between two seasons is blended, nearest, or follows the snow-line."""
    points: Path | None = None
    """Of --poses joint or points with real photographs: folder of WEBCAM.csv, of `seasonscapes annotate`."""
    path: Path | None = None
    """Of completion by diffusion and of films: views of `seasonscapes path`; default through the scene's cameras."""
    path_views: int | None = None
    """Without --path: how many views; default 12."""
    weights: Path | None = None
    """Of --completion diffusion: folder with the weights as OWNER/NAME."""
    prompt: str | None = None
    """Of --completion diffusion: default by date, hour and sky."""
    guide_image: Path | None = None
    """Of --completion diffusion: a picture whose looks to adopt; default a photograph of each time."""
    diffusion_steps: int | None = None
    """Of --completion diffusion: steps of its sampler; default 50."""
    paper_steps: int | None = None
    """Of --appearance paper: training steps; default 2000."""

    def values(self) -> tuple[RunMethod, PathStages]:
        """The method and what its stages along a path need; `InputError` for flags that would do nothing."""
        from seasonscapes.workflows.path_completion import PathCompletionOptions
        from seasonscapes.workflows.run_methods import PathStages, run_method

        method = run_method(
            self.method,
            poses=self.poses,
            grade=self.grade,
            painting=self.painting,
            completion=self.completion,
            appearance=self.appearance,
            recovery=self.recovery,
            painted=self.use_painted,
            inpainted=self.use_inpainted,
            foreground=self.find_foreground,
        )
        refuse_without("--poses joint or points", method.poses != "skyline", points=self.points)
        refuse_without("a path (--completion diffusion or --appearance paper)", method.needs_path, path=self.path)
        own = method.needs_path and self.path is None
        refuse_without("a path that this run makes", own, path_views=self.path_views)
        own_model = {"weights": self.weights, "prompt": self.prompt, "guide_image": self.guide_image}
        own_model["diffusion_steps"] = self.diffusion_steps
        refuse_without("--completion diffusion", method.completion == "diffusion", **own_model)
        refuse_without("--appearance paper", method.appearance == "paper", paper_steps=self.paper_steps)
        for flag, file in (("--path", self.path), ("--guide-image", self.guide_image)):
            if file is not None and not file.is_file():
                raise InputError(flag, "no such file", got=str(file))
        views, steps = self.path_views or 12, self.paper_steps or 2000
        check_range("--path-views", views, 2, 10_000)
        check_range("--paper-steps", steps, 1, 1_000_000)
        model = None
        if method.completion == "diffusion":
            if self.weights is None or not self.weights.is_dir():
                raise InputError("--weights", "no folder of weights for --completion diffusion", got=str(self.weights))
            check_range("--diffusion-steps", self.diffusion_steps or 50, 1, 1000)
            model = PathCompletionOptions(
                Path(), self.weights, prompt=self.prompt, guide_image=self.guide_image, steps=self.diffusion_steps or 50
            )
        return method, PathStages(self.path, views, self.points, model, steps)

    def season_of(self, times: Sequence[datetime]) -> str:
        """How to interpolate between seasons; `InputError` where the flag does nothing, since all photographs are of one day."""
        from seasonscapes.workflows.albedo_sources import require_season

        season = self.season or "blended"
        require_season(season, where="--season")
        if self.season is not None and len({time.date() for time in times}) < 2:
            raise InputError("--season", "does nothing without --times of two days", got=self.season)
        return season
