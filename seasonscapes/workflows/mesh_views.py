"""Pictures and films of a textured mesh under any hour."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.errors import InputError
from seasonscapes.frames import angles_from_direction, direction_from_angles
from seasonscapes.progress import Progress, each_reported, task_progress
from seasonscapes.terrain.textured_mesh import TexturedMesh
from seasonscapes.workflows.meshes import MeshSurroundings, Time, albedo_image, atlas_of, mesh_light
from seasonscapes.workflows.timelapse import FilmLook, develop_frames

if TYPE_CHECKING:
    from seasonscapes.rendering.radiance import RenderedView
    from seasonscapes.rendering.relit_view import RelightableView

# The mesh's bounding box fills this share of the picture.
_FILL = 0.9


def mesh_camera(
    mesh: TexturedMesh,
    *,
    azimuth_deg: float = 200.0,
    elevation_deg: float = 20.0,
    fov_deg: float = 35.0,
    size_px: tuple[int, int] = (1200, 900),
) -> Camera:
    """A camera about a mesh that frames all of it.

    Parameters
    ----------
    mesh
        The mesh.
    azimuth_deg, elevation_deg
        Where the camera stands, as seen from the mesh: azimuth clockwise from north, and elevation [deg].
    fov_deg
        Horizontal field of view [deg].
    size_px
        Width and height [px].
    """
    low, high = mesh.bounds_m
    centre = 0.5 * (low + high)
    rotation = rotation_from_angles(azimuth_deg + 180.0, -elevation_deg)
    width, height = size_px
    focal = 0.5 * width / np.tan(np.radians(fov_deg) / 2.0)
    steps = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    corner = (low + steps * (high - low) - centre) @ rotation
    # Every corner of the bounding box lies within the picture: |x| · focal / (distance + z) ≤ half a side.
    reach = np.maximum(np.abs(corner[:, 0]) * focal / (0.5 * width), np.abs(corner[:, 1]) * focal / (0.5 * height))
    distance = float(np.max(reach / _FILL - corner[:, 2]))
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = centre + distance * direction_from_angles(azimuth_deg, elevation_deg)
    return Camera(width, height, focal, focal, width / 2.0, height / 2.0, pose, mesh.frame)


def camera_between(
    mesh: TexturedMesh,
    eye: Sequence[float],
    target: Sequence[float],
    *,
    fov_deg: float = 35.0,
    size_px: tuple[int, int] = (1200, 900),
) -> Camera:
    """A camera at a point that looks at another, both in the mesh file's own coordinates.

    Raises
    ------
    InputError
        Where the two points coincide.
    """
    from_file, to_enu = mesh.parts[0].vertices[0], mesh.positions[0][0]
    points = [to_enu + mesh.turn @ (np.asarray(point, float) - from_file) for point in (eye, target)]
    view = points[1] - points[0]
    if not np.linalg.norm(view) > 0.0:
        raise InputError("--target", "is where the camera stands", got=",".join(f"{x:g}" for x in target))
    azimuth, elevation = angles_from_direction(view)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_angles(float(azimuth), float(elevation)), points[0]
    width, height = size_px
    focal = 0.5 * width / np.tan(np.radians(fov_deg) / 2.0)
    return Camera(width, height, focal, focal, width / 2.0, height / 2.0, pose, mesh.frame)


@dataclass(frozen=True)
class MeshView:
    """A view of a mesh with its traced light transport, for any light.

    Parameters
    ----------
    mesh, surroundings
        What is seen.
    relightable
        The view's coefficients.
    """

    mesh: TexturedMesh
    surroundings: MeshSurroundings
    relightable: RelightableView


def mesh_view(
    mesh: TexturedMesh,
    camera: Camera | None = None,
    *,
    surroundings: MeshSurroundings | None = None,
    progress: Progress | None = None,
) -> MeshView:
    """Trace the light transport of a view of a mesh once, for any hour afterwards.

    Parameters
    ----------
    mesh
        The mesh, whose textures are albedo.
    camera
        Of `mesh_camera` or `camera_between`; the former's defaults if left out.
    surroundings
        Ground, sky and number of rays.
    progress
        Called with a task and its finished share.

    Raises
    ------
    NoTerrainInView
        Where the camera sees neither mesh nor ground.
    """
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.coefficients import SamplingOptions
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.rendering.relit_view import relightable_view
    from seasonscapes.rendering.transport import trace_view

    around = surroundings or MeshSurroundings()
    use_backend()
    atlas = atlas_of(mesh, around)
    scene = ray_scene(mi_mesh(atlas.terrain, albedo_image(atlas, mesh)))
    sampling = SamplingOptions(albedo_samples=16, rays=around.rays, clusters=4096)
    report = task_progress(progress, "light transport")
    coefficients = trace_view(scene, camera or mesh_camera(mesh), sampling, seed=around.seed, progress=report)
    return MeshView(mesh, around, relightable_view(scene, coefficients))


def relit_mesh_view(view: MeshView, time: Time) -> RenderedView:
    """A view of a mesh at an hour; its provenance holds the light's plain values. See `render_mesh`."""
    from seasonscapes.rendering.relit_view import relight_view

    light, record = mesh_light(view.mesh, time, view.surroundings)
    camera = view.relightable.coefficients.camera
    record |= {
        "size_px": [camera.width_px, camera.height_px],
        "world_from_camera": camera.world_from_camera.tolist(),
        "frame": dict(view.mesh.frame.__dict__),
        **view.surroundings.ground_facts,
    }
    return replace(relight_view(view.relightable, light), provenance=record)


def render_mesh(
    mesh: TexturedMesh,
    time: Time,
    camera: Camera | None = None,
    *,
    surroundings: MeshSurroundings | None = None,
    progress: Progress | None = None,
) -> RenderedView:
    """Render a mesh with albedo textures under the light of an hour, standing on level ground.

    Parameters
    ----------
    mesh
        The mesh, whose textures are albedo, as those of `delight_mesh`.
    time
        An aware datetime; ISO 8601 text, which without offset is civil time at the mesh; or azimuth and elevation of
        the sun [deg].
    camera
        Of `mesh_camera` or `camera_between`; one that frames the mesh if left out.
    surroundings
        Ground, sky and number of rays.
    progress
        Called with a task and its finished share.

    Returns
    -------
    RenderedView
        Radiance ``(H, W, 3)`` [cd/m²], coverage and G-buffer; `develop` makes a picture of it.

    Raises
    ------
    InputError
        For a time that is none, or a texture that repeats over the surface.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np, trimesh
    >>> import seasonscapes as ss
    >>> from seasonscapes.workflows.mesh_views import mesh_camera
    >>> ball = trimesh.creation.icosphere(subdivisions=2)
    >>> ball.visual.vertex_colors = np.full((len(ball.vertices), 4), (120, 110, 90, 255), np.uint8)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = ball.export(f"{folder}/ball.ply")
    ...     mesh = ss.load_mesh(f"{folder}/ball.ply")
    >>> around = ss.MeshSurroundings(sky="hosek", rays=16)
    >>> ss.render_mesh(mesh, (180.0, 45.0), mesh_camera(mesh, size_px=(24, 16)), surroundings=around).radiance.shape
    (16, 24, 3)
    """
    return relit_mesh_view(mesh_view(mesh, camera, surroundings=surroundings, progress=progress), time)


def film_mesh(
    view: MeshView, times: Sequence[datetime], output: Path, look: FilmLook, *, progress: Progress | None = None
) -> list[Path]:
    """Film a view of a mesh over hours, with one exposure that follows the light smoothly.

    Parameters
    ----------
    view
        Of `mesh_view`.
    times
        Aware instants.
    output
        A ``.mp4`` film, or a folder for ``.png`` pictures.
    look
        Exposure, its smoothing and the frame rate.
    progress
        Called with a task and its finished share.

    Returns
    -------
    list of pathlib.Path
        The film, or its pictures.
    """
    from seasonscapes.exposure import exposure_ev100, photo_ev100
    from seasonscapes.relighting.frame_file import frame_name, save_frame

    about: dict[str, Any] = {"mesh": view.mesh.path.name, "sky": view.surroundings.model.name}
    with tempfile.TemporaryDirectory() as folder:
        for time in each_reported(times, len(times), progress, "frames"):
            picture = relit_mesh_view(view, time.astimezone(UTC))
            metered = exposure_ev100(picture.radiance, "auto")
            record = picture.provenance | {"photo_ev100": photo_ev100(picture.radiance, metered)}
            path = Path(folder) / frame_name(time)
            save_frame(path, picture.radiance, metered_ev100=metered, provenance=record)
        return develop_frames(Path(folder), times, output, look, about, progress=progress)


def relit_pictures(
    mesh: TexturedMesh,
    hours: Sequence[Time],
    cameras: Sequence[Camera],
    output: Path,
    look: FilmLook,
    *,
    surroundings: MeshSurroundings,
    progress: Progress | None = None,
) -> tuple[list[Path], dict[str, Any]]:
    """Write a picture of a mesh, a film of several hours, or a turntable of several cameras at one hour.

    Parameters
    ----------
    mesh
        The mesh, whose textures are albedo.
    hours
        One hour; of a film aware instants.
    cameras
        One camera; of a turntable several.
    output
        ``.png`` or ``.exr``; of films and turntables ``.mp4``, or a folder.
    look
        Exposure and look.
    surroundings, progress
        See `render_mesh`.

    Returns
    -------
    files
        The files written.
    record
        Plain values about light and exposure.
    """
    from seasonscapes.exposure import exposure_ev100
    from seasonscapes.workflows.pictures import png_metadata, save_exr, save_png

    instants = [hour for hour in hours if isinstance(hour, datetime)]
    if len(hours) > 1:
        view = mesh_view(mesh, cameras[0], surroundings=surroundings, progress=progress)
        files = film_mesh(view, instants, output, look, progress=progress)
        return files, {"mesh": mesh.path.name, "frames": len(instants)}
    pictures: list[np.ndarray] = []
    ev100, record = 0.0, {}
    # A turntable's exposure is that of its first picture.
    for camera in cameras:
        rendered = render_mesh(mesh, hours[0], camera, surroundings=surroundings, progress=progress)
        if not pictures:
            record = rendered.provenance
            ev100 = exposure_ev100(rendered.radiance, look.exposure, look=look.look)
            record["exposure_ev100"] = round(ev100, 3)
        if output.suffix.lower() == ".exr":
            save_exr(output, rendered)
            return [output], record
        pictures.append(_developed(rendered, ev100, look))
    if output.suffix.lower() == ".png":
        save_png(output, pictures[0], metadata=png_metadata(record))
        return [output], record
    record = {name: value for name, value in record.items() if name != "world_from_camera"} | {"views": len(pictures)}
    if output.suffix.lower() == ".mp4":
        from seasonscapes.relighting.film import write_video

        write_video(output, pictures, fps=look.fps, comment=json.dumps(record, default=float))
        return [output], record
    files = [output / f"view-{number:03d}.png" for number in range(len(pictures))]
    for path, picture in zip(files, pictures, strict=True):
        save_png(path, picture, metadata=png_metadata(record))
    return files, record


def _developed(view: RenderedView, ev100: float, look: FilmLook) -> np.ndarray:
    from seasonscapes.exposure import develop
    from seasonscapes.workflows.pictures import balance_rgb

    white = balance_rgb(look.white_balance, view.provenance["white_rgb"])
    return develop(view.radiance, ev100, eye=look.exposure == "eye", look=look.look, white=white)
