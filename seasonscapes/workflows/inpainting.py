"""Inpainting of a painted texture by any method: regression, membrane, Telea, fusion with an albedo, or diffusion."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from seasonscapes.errors import InputError
from seasonscapes.progress import Progress, task_progress
from seasonscapes.sky.models import SkyModel
from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.completion import INPAINTERS, CompletedTexture, CompletionOptions
from seasonscapes.workflows.albedo_sources import load_albedo
from seasonscapes.workflows.completion import completion_predictors, completion_record, predictors_at
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.predicted_radiance import albedo_relative_sigma, predict_radiance

if TYPE_CHECKING:
    from seasonscapes.workflows.path_completion import PathCompletionOptions

METHODS = (*INPAINTERS, "diffusion")


@dataclass(frozen=True)
class InpaintOptions:
    """How to complete a painted texture.

    Parameters
    ----------
    method
        ``"guided"``, ``"membrane"``, ``"telea"`` or ``"diffusion"``.
    albedo
        A recovered albedo file. With ``"guided"`` the painting is fused with the radiance that it predicts; with
        ``"diffusion"`` that radiance is a predictor.
    detail
        Strength of synthesised grain in [0, 1].
    fast
        A little less accurate, about three times as fast.
    seed
        Equal seeds give equal textures.
    diffusion
        Of the method ``"diffusion"``.
    rest
        With ``"diffusion"``: how texels that no view of the path shows are completed, among `INPAINTERS`.
    """

    method: str = "guided"
    albedo: Path | None = None
    detail: float = 0.0
    fast: bool = False
    seed: int = 0
    diffusion: PathCompletionOptions | None = None
    rest: str = "guided"

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError("--method", "unknown method", got=self.method, expected=", ".join(METHODS))
        if self.albedo is not None and self.method not in ("guided", "diffusion"):
            raise InputError("--albedo", f"of no use with --method {self.method}", expected="guided or diffusion")
        if (self.method == "diffusion") != (self.diffusion is not None):
            raise InputError("--path", "missing", expected="a .json of `seasonscapes path`")


@dataclass(frozen=True)
class Inpainted:
    """A completed texture and plain values about it."""

    completed: CompletedTexture
    record: dict[str, Any] = field(default_factory=dict)


def inpaint(
    place: Place,
    painted: Texture,
    utc: datetime,
    sky: SkyModel,
    options: InpaintOptions | None = None,
    *,
    progress: Progress | None = None,
) -> Inpainted:
    """Complete a painted texture of one time.

    Parameters
    ----------
    place
        The place.
    painted
        Radiance [cd/m²] with weights, 0 where unpainted.
    utc
        The time of the photographs, aware.
    sky
        The sky model of that time.
    options
        Method and effort.
    progress
        Called with a task and its finished share.

    Returns
    -------
    Inpainted
        The completed texture; method (``"fused"`` where a painting was fused with the radiance of an albedo), guides that
        were asked, and shares.
    """
    from seasonscapes.texturing.bayesian_fusion import fuse_with_albedo
    from seasonscapes.texturing.completion import complete as complete_texture
    from seasonscapes.texturing.predictors import predictors_for

    options = options or InpaintOptions()
    place.require_texture(painted, what="painting")
    predicted = None
    if options.albedo is not None:
        albedo = load_albedo(place, options.albedo, utc.date())
        predicted = predict_radiance(place, albedo, utc, sky=sky, progress=progress)
    record: dict[str, Any] = {"method": options.method}
    if predicted is not None and options.method == "guided":
        record["method"] = "fused"
        assert options.albedo is not None
        # Of the predictors only the surface and the charts matter: neither sun nor image is used.
        predictors = predictors_for(place.terrain, place.atlas)
        sigma = albedo_relative_sigma(options.albedo, place.texture_shape)
        completed = fuse_with_albedo(painted, predicted.values, sigma, predictors)
        record["guides"] = ["albedo, relit"]
    else:
        # Only regression asks what they tell.
        regression = options.rest if options.method == "diffusion" else options.method
        if options.diffusion is not None:
            from seasonscapes.workflows.path_completion import SkyState, complete_along_path

            predictors = predictors_at(place, utc, predicted)
            completion = CompletionOptions(options.rest, options.detail, options.fast, options.seed)
            sky_state = SkyState(utc, cloudiness_of(sky))
            completed, facts = complete_along_path(
                place, painted, predictors, sky_state, options.diffusion, completion, progress=progress
            )
            record |= facts | {"rest": options.rest}
        else:
            predictors = completion_predictors(place, utc, predicted)
            completed = complete_texture(
                painted,
                predictors,
                options=CompletionOptions(options.method, options.detail, options.fast, options.seed),
                progress=task_progress(progress, f"completing ({options.method})"),
            )
        record["guides"] = list(predictors.names) if regression == "guided" else []
    return Inpainted(completed, completion_record(completed, predictors.surface) | record)


def cloudiness_of(sky: SkyModel) -> float:
    """Share of the sky that a model covers with clouds, in [0, 1]."""
    from seasonscapes.sky.models import OvercastModel

    return 1.0 if isinstance(sky, OvercastModel) else float(sky.cloudiness)
