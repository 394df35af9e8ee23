"""Per-texel radiance predicted from a recovered albedo at one instant.

A prior for the radiometric calibration of photographs, and for the completion of what they paint.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.array_files import read_arrays
from seasonscapes.progress import Progress, task_progress
from seasonscapes.sky.models import SkyModel
from seasonscapes.terrain.surface import Texture
from seasonscapes.workflows.albedo_sources import load_albedo, texture_once
from seasonscapes.workflows.illumination import illumination_on_terrain, sky_model
from seasonscapes.workflows.place import Place, utc_at

if TYPE_CHECKING:
    from seasonscapes.albedo.seasons import DatedAlbedo

_CODE = ("workflows.predicted_radiance",)
_RAYS = 64
# Relative standard error of radiance predicted from an albedo that photographs gave. It determines the exposure of a
# photograph better than the sky in it does.
RELATIVE_SIGMA = 0.2


def predict_radiance(
    place: Place,
    albedo: DatedAlbedo,
    time: str | datetime,
    *,
    sky: str | Path | SkyModel = "clear",
    progress: Progress | None = None,
) -> Texture:
    """Predict the radiance that leaves every texel at an instant; kept in the workspace.

    Parameters
    ----------
    place
        The place.
    albedo
        A recovered albedo of the place's atlas; see `load_albedo`.
    time
        An aware datetime, or ISO 8601 text; without offset it is civil time at the place.
    sky
        A sky model, its name or its file.
    progress
        Called with a task and its finished share.

    Returns
    -------
    Texture
        Radiance ``(R, S, 3)`` [cd/m²]; ``weight`` is the albedo's: 0 where no photograph measured it.

    Raises
    ------
    AtlasMismatch
        Where the albedo belongs to another atlas.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     values = np.full((*place.texture_shape, 3), 0.2, np.float32)
    ...     np.savez(f"{folder}/albedo.npz", values=values, weight=values[..., 0], atlas_id=place.atlas_id)
    ...     albedo = ss.load_albedo(place, f"{folder}/albedo.npz", "2024-07-20")
    ...     radiance = ss.predict_radiance(place, albedo, "2024-07-20T13:30", sky="hosek")
    >>> radiance.values.shape == (*place.texture_shape, 3)
    True
    """
    model, utc = sky_model(sky), utc_at(place, time)
    texture = place.require_texture(albedo.load(), what="albedo")
    return texture_once(
        place,
        "predicted",
        {"place": place.key, "albedo": albedo.content, "time": utc, "sky": model},
        code=_CODE,
        build=lambda: _relit(place, texture, utc, model, progress),
    )


def measured_radiance(
    place: Place, path: Path, utc: datetime, model: SkyModel, *, progress: Progress | None = None
) -> np.ndarray:
    """Predicted radiance ``(R, S, 3)`` [cd/m²] of the texels whose albedo a file states as measured, NaN elsewhere."""
    predicted = predict_radiance(place, load_albedo(place, path, utc.date()), utc, sky=model, progress=progress)
    return np.where((predicted.weight > 0.0)[..., None], predicted.values, np.float32(np.nan))


def albedo_relative_sigma(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """Relative standard error ``(R, S)`` float32 of an albedo file; `RELATIVE_SIGMA` where it states none."""
    relative = np.full(shape, np.inf, np.float32)
    if path.suffix.lower() == ".npz":
        stored = read_arrays(path, ["values"], optional=["sigma"], what="an albedo texture")
        if "sigma" in stored:
            relative = stored["sigma"] / np.maximum(stored["values"][..., 1], 1e-3)
    return np.where(np.isfinite(relative), relative, RELATIVE_SIGMA).astype(np.float32)


def _relit(place: Place, albedo: Texture, utc: datetime, model: SkyModel, progress: Progress | None) -> Texture:
    from seasonscapes.relighting.lit_texture import bake_lit_texture
    from seasonscapes.rendering.coefficients import SamplingOptions
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.terrain.texels import texel_positions

    light, _ = illumination_on_terrain(place, model, utc)
    positions, _ = texel_positions(place.terrain, place.atlas.width_px, place.atlas.height_px)
    lit = bake_lit_texture(
        ray_scene(mi_mesh(replace(place.terrain, tilt=albedo.tilt), albedo.values)),
        positions,
        albedo.values,
        light,
        sampling=SamplingOptions(shadow_samples=1, rays=_RAYS),
        progress=task_progress(progress, "relighting the albedo"),
    )
    return Texture(lit.radiance.astype(np.float32), albedo.weight, place.atlas_id)
