"""The differentiable scene of a place, for inverse-rendering experiments."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from seasonscapes.cameras.pinhole import Camera, view_in_frame
from seasonscapes.sky.models import SkyModel
from seasonscapes.workflows.albedo_sources import AlbedoSource, chosen_albedo
from seasonscapes.workflows.illumination import illumination_for_camera, sky_model
from seasonscapes.workflows.place import Place, utc_at

if TYPE_CHECKING:
    from seasonscapes.albedo.differentiable_scene import DifferentiableScene


def differentiable_scene(
    place: Place,
    camera: Camera,
    time: str | datetime,
    *,
    sky: str | Path | SkyModel = "clear",
    albedo: AlbedoSource = None,
    max_depth: int = 6,
    margin_px: int = 16,
) -> DifferentiableScene:
    """Return the Mitsuba scene of a place whose albedo, sun, sky, haze, exposure and camera rotation are differentiable.

    Parameters
    ----------
    place
        The place.
    camera
        A camera with square pixels; one calibrated in another frame is converted to the place's.
    time
        An aware datetime, or ISO 8601 text; without offset it is civil time at the place.
    sky
        A sky model, its name or its file.
    albedo
        Initial albedo: a texture of the place's atlas, a dated albedo, an `AlbedoSeries`, or ``None`` for the scene's own.
    max_depth
        Largest number of edges of a light path.
    margin_px
        Margin of the rendered image, which limits the rotation of the camera.

    Returns
    -------
    DifferentiableScene
        ``scene.render(unknowns)`` gives a Dr.Jit tensor ``(H, W, 3)`` [cd/m²]; ``scene.mi_params`` are Mitsuba's own
        parameters.

    Raises
    ------
    InputError
        Where only the scalar variant is available, which has no gradients.

    Notes
    -----
    Path replay backpropagation, Vicini, Speierer & Jakob 2021 (doi:10.1145/3450626.3459804); see
    `albedo.differentiable_scene` for the rotation.

    Examples
    --------
    >>> import drjit as dr
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> scene = ss.differentiable_scene(place, camera, "2024-07-20T13:30", sky="clear")
    >>> import mitsuba as mi
    >>> haze = mi.Float(1.0)
    >>> dr.enable_grad(haze)
    >>> dr.backward(dr.mean(scene.render({"haze": haze}, spp=4).array))
    >>> bool(dr.grad(haze)[0] != 0.0)
    True
    """
    from seasonscapes.albedo.differentiable_scene import build_differentiable_scene

    utc = utc_at(place, time)
    camera = view_in_frame(camera, place.frame)
    light, _ = illumination_for_camera(place, camera, sky_model(sky), utc)
    texture = chosen_albedo(place, utc.date(), albedo)
    return build_differentiable_scene(
        place.terrain, texture.values, camera, light, max_depth=max_depth, margin_px=margin_px
    )
