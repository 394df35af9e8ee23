"""Cameras of a place: the scene's named ones, free positions, and views calibrated in other frames."""

from __future__ import annotations

import logging
from dataclasses import astuple, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.calibration.ground_clearance import LEAST_ABOVE_GROUND_M
from seasonscapes.declaration import validate
from seasonscapes.errors import InputError
from seasonscapes.frames import enu_from_geodetic, geodetic_from_enu
from seasonscapes.scene import NamedCamera, Viewpoint, camera_from_named_view
from seasonscapes.workflows.camera_ground import ground_below
from seasonscapes.workflows.place import Place, ground_height_m, ground_or_nan, require_near

if TYPE_CHECKING:
    from seasonscapes.cameras.panorama import Panorama
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.terrain.surface import Terrain, Texture

log = logging.getLogger(__name__)

# Less distortion moves no pixel of a common camera by more than one.
_VISIBLE_DISTORTION = 1e-3

__all__ = ["camera", "camera_for", "camera_geodetic", "scene_cameras"]


def camera(place: Place, view: str | Viewpoint | None = None, *, size_px: tuple[int, int] = (1536, 1024)) -> Camera:
    """Return a pinhole camera of a place: one that the scene file names, or one at a free position.

    Parameters
    ----------
    place
        The place.
    view
        Name of a camera of the scene file, or a position with viewing direction and field of view; default the scene
        file's first camera.
    size_px
        Width and height of the image [px].

    Returns
    -------
    Camera
        With its pose in the place's frame.

    Raises
    ------
    InputError
        For an unknown name, or a position outside the raster or below the ground.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> ss.camera(place, "meadow", size_px=(96, 64)).width_px
    96
    >>> above = ss.Viewpoint(latitude_deg=46.556, longitude_deg=7.98, above_ground_m=30.0, heading_deg=180.0)
    >>> ss.camera(place, above).frame == place.frame
    True
    """
    if not isinstance(view, Viewpoint):
        view = place.scene.camera(view, where="camera")
    return camera_for(place, view, size_px=size_px, where="camera")


def camera_for(place: Place, view: Viewpoint, *, size_px: tuple[int, int], where: str = "--camera") -> Camera:
    """Return the pinhole camera of a viewpoint.

    A stated height less than a metre above ground, or in it by no more than heights are known to (half a cell, at least 5 m), is
    lifted to a metre above, with a warning.

    Parameters
    ----------
    place
        The place.
    view
        Position, angles and field of view, as a scene file states them.
    size_px
        Width and height [px].
    where
        What an error message calls the view.

    Raises
    ------
    InputError
        Where it stands deeper in the ground or, given above ground, outside the raster.
    """
    if view.above_ground_m is not None:
        ground = ground_height_m(place, view.latitude_deg, view.longitude_deg, where=where)
    else:
        require_near(place, view.latitude_deg, view.longitude_deg, where=where)
        ground = ground_or_nan(place, view.latitude_deg, view.longitude_deg)
        if view.height_m is not None and np.isfinite(ground):
            at = enu_from_geodetic(place.frame, view.latitude_deg, view.longitude_deg, view.height_m)
            below = ground_below(place, at)
            if below.lifts and not below.too_deep_m:
                name = view.name if isinstance(view, NamedCamera) else where
                log.warning("%s stands %s: it is lifted to %g m above", name, below, LEAST_ABOVE_GROUND_M)
                view = view.model_copy(update={"height_m": ground + LEAST_ABOVE_GROUND_M})
        if view.height_m is not None and view.height_m < ground:
            raise InputError(
                where,
                f"'{view.name}' stands below the ground"
                if isinstance(view, NamedCamera)
                else "stands below the ground",
                got=f"{view.height_m:g} m",
                expected=f"above {ground:.1f} m",
                cure="give above_ground_m instead",
            )
    return camera_from_named_view(place.frame, view, ground, size_px=size_px)


def calibrated_viewpoint(path: Path) -> tuple[NamedCamera, tuple[int, int]]:
    """The viewpoint and the picture's size of a calibration record, as ``seasonscapes calibrate`` writes it.

    Raises
    ------
    InputError
        Where it is no such record, or that of a panorama.
    """
    from seasonscapes.calibration.calibration_file import read_calibration
    from seasonscapes.calibration.pose_model import angles_from_rotation
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.frames import local_axes

    record = read_calibration(path)
    camera = record.view
    if not isinstance(camera, Camera):
        cure = "`seasonscapes webcams` splits it into views"
        raise InputError(path, "is the record of a panorama", expected="that of a perspective picture", cure=cure)
    if max(abs(value) for value in astuple(record.lens)) > _VISIBLE_DISTORTION:
        log.warning("%s: the picture is drawn without the lens distortion, k1 = %.4g", path, record.lens.k1)
    for doubt in record.doubts:
        log.warning("%s: the pose is not reliable: %s", path, doubt)
    latitude, longitude, height = (float(v) for v in geodetic_from_enu(record.frame, camera.position_m))
    axes = local_axes(record.frame, latitude, longitude)
    heading, pitch, roll = angles_from_rotation(axes @ camera.world_from_camera[:3, :3])
    table = {
        "name": record.webcam,
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "height_m": height,
        "heading_deg": float(heading),
        "pitch_deg": float(pitch),
        "roll_deg": float(roll),
        "fov_deg": float(np.degrees(2.0 * np.arctan(0.5 * camera.width_px / camera.fx))),
        "principal_point": (camera.cx / camera.width_px, camera.cy / camera.height_px),
    }
    return validate(table, NamedCamera, where=path), (camera.width_px, camera.height_px)


def view_with_terrain(
    place: Place, view: Camera | Panorama, *, lambertian: bool = False, amplify: bool = False
) -> tuple[Camera | Panorama, Terrain]:
    """A camera and the terrain that it is to render, with the finest data about it.

    ``lambertian``: without surfaces that are not matt. ``amplify``: with detail below the resolution of the data. On either the
    camera keeps its height above ground; see `workflows.amplified_terrain`.
    """
    from seasonscapes.workflows.amplified_terrain import detailed_view

    view, terrain = detailed_view(place, view, amplify=amplify)
    return view, replace(terrain, water=None, snow=None, forest=False) if lambertian else terrain


def tilted_terrain(terrain: Terrain, albedo: Texture, *, amplify: bool) -> Terrain:
    """A terrain with the normals that its albedo has below the resolution of the heights, if any.

    Not with ``amplify``: relief is invented for the same octaves, and would count twice.
    """
    if albedo.tilt is not None and amplify:
        log.info("detail is invented where the albedo has normals from photographs: these are left out")
    return terrain if amplify else replace(terrain, tilt=albedo.tilt)


def camera_geodetic(place: Place, view: Camera | Panorama) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and height [m] of a camera whose pose is in the place's frame."""
    latitude, longitude, height = geodetic_from_enu(place.frame, view.position_m)
    return float(latitude), float(longitude), float(height)


def scene_cameras(place: Place, *, leave_out: set[str] | None = None, size_px: tuple[int, int]) -> dict[str, Camera]:
    """The cameras that the scene file names, by name, without those in ``leave_out``.

    Raises
    ------
    InputError
        For a name in ``leave_out`` that the scene does not have, and where no camera is left.
    """
    leave_out = leave_out or set()
    known = [named.name for named in place.scene.cameras]
    for name in sorted(leave_out - set(known)):
        raise InputError("--leave-out", "no such camera", got=name, expected="of " + ", ".join(known))
    chosen = {
        named.name: camera_for(place, named, size_px=size_px)
        for named in place.scene.cameras
        if named.name not in leave_out
    }
    if not chosen:
        raise InputError("--leave-out", "leaves no camera", got=", ".join(sorted(leave_out)))
    return chosen


def camera_values(camera: Camera | Panorama) -> dict[str, Any]:
    """Plain values of a camera, for keys of what is made with it."""
    names = ("width_px", "height_px", "fx", "fy", "cx", "cy")
    numbers = {name: float(getattr(camera, name)) for name in names}
    kind = getattr(camera, "projection", "pinhole")
    # Another machine may compute the same pose with another last digit.
    return {"kind": kind, "pose": np.round(camera.world_from_camera, 9).tolist(), **numbers}


def local_ground(place: Place):
    """Heights of the ground in the local frame as a function of positions ``(N, 2)`` east, north [m]; NaN outside."""
    from seasonscapes.terrain.crs import map_position
    from seasonscapes.terrain.raster import sample_raster

    def heights(positions: np.ndarray) -> np.ndarray:
        up = np.zeros(len(positions))
        # The local vertical differs from the frame's, so a point's height shifts it sideways; two rounds converge.
        for _ in range(2):
            latitude, longitude, _ = geodetic_from_enu(place.frame, np.column_stack([positions, up]))
            height = sample_raster(place.elevation, *map_position(place.elevation, latitude, longitude))[..., 0]
            up = enu_from_geodetic(place.frame, latitude, longitude, np.nan_to_num(height))[..., 2]
        surface = place.terrain.surface
        if surface is not None and surface.parts:
            # Finer heights of a part may rise above the raster's.
            up = surface.up_at(np.column_stack([positions, up]))
        return np.where(np.isfinite(height), up, np.nan)

    return heights
