"""Completion: a value and a standard error for every texel that no camera painted."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.progress import Progress, task_progress
from seasonscapes.terrain.surface import Texture, load_texture
from seasonscapes.texturing.completion import CompletedTexture, CompletionOptions
from seasonscapes.workflows.albedo_sources import orthoimage
from seasonscapes.workflows.place import Place, utc_at
from seasonscapes.workflows.view_rendering import textured_view

if TYPE_CHECKING:
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.sky.models import SkyModel
    from seasonscapes.texturing.predictors import Predictors
    from seasonscapes.texturing.tiled_predictors import TiledPredictors

# Texels whose predictors are held at once: some 100 bytes each, and as much again while they are made.
MOST_WHOLE_TEXELS = 16_000_000
_FIGURE_PX = 1024
# Over the sky of each texel, where the light of a completed picture is computed again.
_RAYS = 128


def complete(
    place: Place,
    texture: Texture,
    time: str | datetime,
    *,
    predicted: Texture | None = None,
    options: CompletionOptions | None = None,
    progress: Progress | None = None,
) -> CompletedTexture:
    """Complete a painted texture where no camera saw the surface.

    Parameters
    ----------
    place
        The place.
    texture
        Painted radiance with weights (0 where unpainted), such as ``painting.texture``.
    time
        When the photographs were taken: an aware datetime, or ISO 8601 text (civil time at the place without offset).
    predicted
        Radiance predicted from a recovered albedo, as a further predictor; see `predict_radiance`.
    options
        Method, grain, effort and seed; default: the guided method without grain.
    progress
        Called with a task and its finished share.

    Returns
    -------
    CompletedTexture
        ``values`` ``(R, S, 3)`` [cd/m²], ``sigma`` ``(R, S)`` and which texels were painted.

    Raises
    ------
    AtlasMismatch
        For a texture of another atlas.

    Examples
    --------
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> weight = (np.random.default_rng(0).random(place.texture_shape) < 0.5).astype(np.float32)
    >>> painted = ss.Texture(np.full((*place.texture_shape, 3), 2000.0, np.float32), weight)
    >>> completed = ss.complete(place, painted, "2024-07-20T13:30", options=ss.CompletionOptions("membrane"))
    >>> bool(np.isfinite(completed.values).all())
    True
    """
    from seasonscapes.texturing.completion import complete as complete_texture

    options = options or CompletionOptions()
    place.require_texture(texture)
    return complete_texture(
        texture,
        completion_predictors(place, utc_at(place, time), predicted),
        options=options,
        progress=task_progress(progress, f"completing ({options.method})"),
    )


def predictors_at(place: Place, utc: datetime, predicted: Texture | None = None) -> Predictors:
    """Predictors of every texel: relief, the sun of the hour and of the day, the orthoimage, predicted radiance."""
    from seasonscapes.texturing.predictors import predictors_for

    relit = None if predicted is None else predicted.values
    sun, day = _suns(place, utc)
    return predictors_for(
        place.terrain, place.atlas, satellite=orthoimage(place, utc), relit=relit, sun_direction=sun, day_suns=day
    )


def completion_predictors(
    place: Place, utc: datetime, predicted: Texture | None = None
) -> Predictors | TiledPredictors:
    """`predictors_at`, for `texturing.completion.complete`: in tiles for a planar atlas whose predictors would take gigabytes."""
    from seasonscapes.texturing.predictors import relit_layers
    from seasonscapes.texturing.tiled_predictors import tiled_predictors

    rows, columns = place.texture_shape
    if place.atlas.kind != "planar" or rows * columns <= MOST_WHOLE_TEXELS:
        return predictors_at(place, utc, predicted)
    layers = relit_layers(None if predicted is None else predicted.values)
    sun, day = _suns(place, utc)
    return tiled_predictors(
        place.terrain, place.atlas, satellite=orthoimage(place, utc), layers=layers, sun_direction=sun, day_suns=day
    )


def _suns(place: Place, utc: datetime) -> tuple[np.ndarray, np.ndarray]:
    """Directions to the sun at a time ``(3,)``, and through its day ``(24, 3)``."""
    from seasonscapes.sky.ephemeris import sun_position

    at = (place.frame.latitude_deg, place.frame.longitude_deg)
    hours = [utc + timedelta(hours=hour) for hour in range(-12, 12)]
    return sun_position(utc, *at).direction, np.asarray(sun_position(hours, *at).direction, float)


def read_painted(path: Path, place: Place) -> Texture:
    """Read a painted texture of a place.

    Raises
    ------
    InputError
        Where the file is missing, no texture, of another atlas, without painted texels or with negative radiance.
    """
    from seasonscapes.texturing.completion import painted_texels

    if not path.is_file():
        raise InputError("--texture", "no such file", got=str(path), cure="run `seasonscapes paint` first")
    texture = load_texture(path)
    rows, columns = place.texture_shape
    if texture.weight.shape != (rows, columns):
        raise InputError(
            "--texture",
            "made for another atlas",
            got=f"{texture.weight.shape[1]} × {texture.weight.shape[0]}",
            expected=f"{columns} × {rows}",
            cure="give the same --atlas and --texel-m as for painting",
        )
    place.require_texture(texture, what=str(path))
    painted = painted_texels(texture)
    if not painted.any():
        cure = "did the cameras see the terrain? look at the figures of `seasonscapes paint`"
        raise InputError("--texture", "no painted texel: there is nothing to learn from", got=str(path), cure=cure)
    if texture.values[painted].min() < 0.0:
        raise InputError("--texture", "negative radiance", got=str(path), expected="values of at least 0")
    return texture


def save_completed(completed: CompletedTexture, painted: Texture, path: Path) -> None:
    """Write a ``.npz`` that `load_texture` reads: values, the painting's weight (0 where filled), and σ."""
    weight = np.where(completed.painted, painted.weight, np.float32(0.0)).astype(np.float32)
    arrays = {"values": completed.values, "weight": weight, "sigma": completed.sigma}
    if painted.atlas_id is not None:
        arrays["atlas_id"] = np.array(painted.atlas_id)
    np.savez(path, **arrays)  # pyright: ignore[reportArgumentType]  # numpy's stub takes **arrays for allow_pickle


def completion_record(completed: CompletedTexture, surface: np.ndarray) -> dict:
    """Plain numbers about a completion: texels of the surface ``(R, S)``, filled share, medians over filled texels."""
    hole = surface & ~completed.painted
    return {
        "texels": int(surface.sum()),
        "filled_share": float(hole.sum() / max(surface.sum(), 1)),
        "sigma_median": _median(completed.sigma[hole]),
        "value_median": _median(completed.values[hole]),
    }


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if values.size else 0.0


def save_texture_figures(
    folder: Path, place: Place, completed: CompletedTexture, utc: datetime, sky: SkyModel
) -> list[Path]:
    """Write pictures of the texture before and after completion, and of σ relative to its 99th percentile.

    The completed one may be edited and given back as an albedo where it is as large as the atlas.
    """
    from seasonscapes.exposure import develop, exposure_ev100
    from seasonscapes.images import write_png
    from seasonscapes.workflows.edited_textures import texture_facts
    from seasonscapes.workflows.pictures import png_metadata

    shrink = max(1, -(-max(completed.painted.shape) // _FIGURE_PX))
    values = _shrunk(completed.values, shrink)
    painted = _shrunk(completed.painted[..., None].astype(np.float32), shrink)
    ev100 = exposure_ev100(values)
    after = develop(values, ev100)
    sigma = _shrunk(completed.sigma[..., None], shrink)
    scale = np.percentile(sigma, 99.0) or 1.0
    pictures = {
        "before": after * painted + 0.05 * (1.0 - painted),
        "after": after,
        "sigma": np.repeat(np.clip(sigma / scale, 0.0, 1.0) ** 2.2, 3, axis=2),
    }
    paths = [folder / f"{place.scene.name}_texture_{name}.png" for name in pictures]
    lit = texture_facts(place, "lit", utc=utc, sky=sky, exposure_ev100=ev100, rays=_RAYS, seed=0)
    for path, (name, picture) in zip(paths, pictures.items(), strict=True):
        facts = lit if name == "after" and shrink == 1 else texture_facts(place, "figure")
        write_png(path, picture, metadata=png_metadata({"texture": facts, "attribution": place.scene.attribution}))
    return paths


def _shrunk(values: np.ndarray, factor: int) -> np.ndarray:
    import cv2

    size = (max(1, values.shape[1] // factor), max(1, values.shape[0] // factor))
    return cv2.resize(values, size, interpolation=cv2.INTER_AREA).reshape(size[1], size[0], -1)


def save_view_figures(
    folder: Path,
    place: Place,
    completed: CompletedTexture,
    camera: Camera,
    model: SkyModel,
    utc: datetime,
    *,
    name: str,
) -> list[Path]:
    """Write pictures of the textured terrain as a camera observes it at that hour, before and after completion."""
    from seasonscapes.exposure import develop, exposure_ev100
    from seasonscapes.images import write_png
    from seasonscapes.terrain.surface import sample_texture

    view = textured_view(place, completed.values, camera, utc, sky=model)
    painted = sample_texture(completed.painted[..., None].astype(np.float32), view.gbuffer.uv)
    after = develop(view.radiance, exposure_ev100(view.radiance))
    pictures = {"before": after * np.nan_to_num(painted) + 0.05 * (1.0 - np.nan_to_num(painted)), "after": after}
    paths = [folder / f"{place.scene.name}_{name}_{stage}.png" for stage in pictures]
    for path, shown in zip(paths, pictures.values(), strict=True):
        write_png(path, shown)
    return paths
