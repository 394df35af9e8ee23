"""A fixed camera's pictures to the same view at hours that it never took."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.albedo.picture_conditions import ViewLight
from seasonscapes.cameras.pinhole import Camera, view_in_frame
from seasonscapes.progress import Progress
from seasonscapes.rendering.transport import SamplingOptions
from seasonscapes.workflows.illumination import illumination_for_camera, sky_model
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.relight_session import relight_session

if TYPE_CHECKING:
    from seasonscapes.rendering.relit_view import RelightableView
    from seasonscapes.sky.models import SkyModel

log = logging.getLogger(__name__)

# Light is compared, not shown: a quarter of a film's samples.
SAMPLING = SamplingOptions(shadow_samples=4, albedo_samples=16, rays=256)
_MAP_ROWS = 64


@dataclass(frozen=True)
class FixedView:
    """The terrain in a fixed camera's pixels, ready for the light of any instant; from `fixed_view`.

    Parameters
    ----------
    place, camera
        The place and the camera, in the place's frame.
    view
        Daylight coefficients.
    pixel
        ``(n,)`` flat indices of the pixels that terrain covers wholly.
    distance_km, normal
        ``(n,)`` [km] and ``(n, 3)`` of the terrain there.
    """

    place: Place
    camera: Camera
    view: RelightableView
    pixel: np.ndarray
    distance_km: np.ndarray
    normal: np.ndarray
    _chosen: np.ndarray = field(repr=False)
    _clear: SkyModel = field(repr=False)
    _overcast: SkyModel = field(repr=False)


def fixed_view(place: Place, camera: Camera, *, progress: Progress | None = None) -> FixedView:
    """Trace the light transport of a fixed camera's view; kept in the place's workspace.

    Parameters
    ----------
    place
        The place.
    camera
        The camera; one calibrated in another frame is converted to the place's.
    progress
        Called with a task and its finished share.

    Raises
    ------
    NoTerrainInView
        Where the camera sees no terrain.
    """
    from seasonscapes.albedo.view_light import view_distances_km, view_normals

    camera = view_in_frame(camera, place.frame)
    session = relight_session(place, camera, sampling=SAMPLING, progress=progress)
    whole = np.flatnonzero(session.coefficients.coverage > 0.99)
    distance_km, normal = view_distances_km(session.relightable)[whole], view_normals(session.relightable)[whole]
    pixel = np.asarray(session.coefficients.pixel)[whole]
    return FixedView(
        place, camera, session.relightable, pixel, distance_km, normal, whole, sky_model("clear"), sky_model("overcast")
    )


def light_on_view(view: FixedView, time: datetime) -> ViewLight:
    """The light of an aware instant on the pixels of a view, under a clear and an overcast sky."""
    from seasonscapes.albedo.view_light import view_light

    clear, _ = illumination_for_camera(
        view.place, view.camera, view._clear, time, map_height=_MAP_ROWS, by_elevation=True
    )
    overcast, _ = illumination_for_camera(view.place, view.camera, view._overcast, time, map_height=_MAP_ROWS)
    return view_light(view.view, clear, overcast).at(view._chosen)
