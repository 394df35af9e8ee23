"""Delighting: the light of a known hour removed from an image that lies in a place's texture."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import numpy as np

from seasonscapes.progress import Progress, task_progress
from seasonscapes.sky.models import SkyModel
from seasonscapes.terrain.surface import Texture
from seasonscapes.workflows.illumination import illumination_on_terrain, sky_model
from seasonscapes.workflows.place import Place, utc_at


def delight(
    place: Place,
    image: Texture,
    time: str | datetime,
    *,
    sky: str | Path | SkyModel = "clear",
    progress: Progress | None = None,
) -> Texture:
    """Remove the light of a known hour from an image that lies in a place's texture, such as an orthophoto.

    Parameters
    ----------
    place
        The place.
    image
        Radiance ``(R, S, 3)`` [cd/m²] of the surface, or proportional to it, in the place's atlas; ``weight`` is 0 where
        there is none.
    time
        When it was taken: an aware datetime, or ISO 8601 text; without offset it is civil time at the place.
    sky
        The sky model of that hour.
    progress
        Called with a task and its finished share.

    Returns
    -------
    Texture
        Albedo ``(R, S, 3)``; ``weight`` is 0 where it is unknown.

    Raises
    ------
    AtlasMismatch
        For an image of another atlas.

    Examples
    --------
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> lit = ss.lit_texture(place, "2024-07-20T13:30", sky="hosek", rays=16)
    >>> albedo = ss.delight(place, ss.Texture(lit.radiance), "2024-07-20T13:30", sky="hosek")
    >>> known = albedo.weight > 0.0
    >>> bool(np.median(np.abs(albedo.values[known] / lit.albedo[known] - 1.0)) < 0.2)
    True
    """
    from seasonscapes.albedo.forward_model import trace_texel_transport
    from seasonscapes.albedo.texture_delighting import delight_textures
    from seasonscapes.rendering.backend import use_backend

    use_backend()
    place.require_texture(image, what="image")
    light, _ = illumination_on_terrain(place, sky_model(sky), utc_at(place, time))
    report = task_progress(progress, "daylight of the atlas")
    transport = trace_texel_transport(place.terrain, place.texture_shape, progress=report)
    radiance = np.where(image.weight[..., None] > 0.0, image.values, np.float32(np.nan))
    albedo, _ = delight_textures(transport, [radiance], [light])
    known = np.isfinite(albedo).all(axis=2)
    return Texture(np.nan_to_num(albedo), np.asarray(known, np.float32), place.atlas_id)
