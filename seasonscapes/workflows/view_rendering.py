"""Path-traced views of a place."""

from __future__ import annotations

import logging
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes import __version__
from seasonscapes.cameras.pinhole import view_in_frame
from seasonscapes.errors import InputError
from seasonscapes.progress import Progress, task_progress
from seasonscapes.sky.eclipses import eclipse_record
from seasonscapes.sky.models import SkyModel
from seasonscapes.sky.report import eclipse_text, moon_text
from seasonscapes.workflows.albedo_sources import AlbedoSource, chosen_albedo
from seasonscapes.workflows.illumination import SunMoonPosition, illumination_for_camera, position_at, sky_model
from seasonscapes.workflows.place import Place, utc_at
from seasonscapes.workflows.relight_session import still_session, view_at
from seasonscapes.workflows.views import camera_geodetic, tilted_terrain, view_with_terrain
from seasonscapes.workspace import content_key

if TYPE_CHECKING:
    from seasonscapes.cameras.panorama import Panorama
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.rendering.coefficients import SamplingOptions
    from seasonscapes.rendering.radiance import RenderedView
    from seasonscapes.sky.illumination import Illumination

log = logging.getLogger(__name__)

# Below this elevation of the sun the moon matters.
_MOONLIT_BELOW_DEG = -4.0
ENGINES = ("auto", "transport", "path")


def render(
    place: Place,
    camera: Camera | Panorama,
    time: str | datetime,
    *,
    sky: str | Path | SkyModel = "clear",
    albedo: AlbedoSource = None,
    engine: str = "auto",
    spp: int | None = None,
    max_depth: int | None = None,
    seed: int = 0,
    lambertian: bool = False,
    amplify: bool = False,
    progress: Progress | None = None,
) -> RenderedView:
    """Render a view of a place at a date and hour.

    Parameters
    ----------
    place
        The place.
    camera
        A camera or panorama; one calibrated in another frame is converted to the place's.
    time
        An aware datetime, or ISO 8601 text; without offset it is civil time at the place.
    sky
        A sky model, its name or its file; see `sky_model`.
    albedo
        A texture of the place's atlas, a dated albedo, an `AlbedoSeries`, or ``None`` for the scene's own.
    engine
        ``"transport"``: daylight coefficients of the view, which are kept in the workspace (see `relight_session`); a
        picture without grain, and further ones of the view in seconds. ``"path"``: path tracing, the reference.
        ``"auto"``: ``"path"`` where ``spp`` or ``max_depth`` is given or the device is ``scalar``, else ``"transport"``.
    spp
        Of path tracing: samples per pixel; powers of two are best. Default 32.
    max_depth
        Of path tracing: largest number of edges of a light path; 2 is direct light only. Default 6.
    seed
        Equal seeds give equal pictures.
    lambertian
        All ground is matt, also what the scene file declares as water, snow and forest: for comparison.
    amplify
        Add relief and albedo below the resolution of the data: for pictures, not for measurements. Normals that the albedo has
        from photographs (``albedo --normals``) are left out then: both are of the same scale.
    progress
        Called with a task and its finished share.

    Returns
    -------
    RenderedView
        ``radiance`` ``(H, W, 3)`` scene-linear photometric Rec.709 [cd/m²], coverage, G-buffer and provenance.

    Raises
    ------
    InputError
        For a time, sky model or engine that does not exist, or options of another engine.
    NoTerrainInView
        With ``"transport"``, where the camera sees no terrain.
    FrameMismatch, AtlasMismatch
        For a camera without a frame, or a texture of another atlas.

    Notes
    -----
    Path tracing is unidirectional, with next-event estimation of sun and moon and Owen-scrambled Sobol points; see
    `rendering.path_tracer`. Daylight coefficients hold the same light with four bounces; see `rendering.transport`.
    Aerial perspective is applied by the distance of each pixel.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> view = ss.render(place, camera, "2024-07-20T13:30", sky="hosek", spp=4)
    >>> view.radiance.shape, view.provenance["scene"]
    ((32, 48, 3), 'alpine_small')
    """
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.mitsuba_scene import build_scene
    from seasonscapes.rendering.radiance import render_view

    backend = use_backend()
    engine = chosen_engine(engine, path_options=spp is not None or max_depth is not None, device=backend.device)
    camera = view_in_frame(camera, place.frame)
    utc = utc_at(place, time)
    for line in sky_lines(position_at(place, utc)):
        log.info(line)
    texture = chosen_albedo(place, utc.date(), albedo, progress=progress)
    if engine == "transport":
        session = still_session(
            place,
            camera,
            sky=sky,
            albedo=texture,
            seed=seed,
            sampling=still_sampling(),
            lambertian=lambertian,
            amplify=amplify,
            progress=progress,
        )
        view, light, position = view_at(session, utc)
        record = view_record(place, session.camera, light, position)
        record |= {"engine": engine, "seed": seed, "lambertian": lambertian, "amplified": amplify}
        record["variant"] = backend.variant
        return replace(view, provenance=record)
    spp, max_depth = 32 if spp is None else spp, 6 if max_depth is None else max_depth
    camera, terrain = view_with_terrain(place, camera, lambertian=lambertian, amplify=amplify)
    light, position = illumination_for_camera(place, camera, sky_model(sky), utc)
    view = render_view(
        build_scene(tilted_terrain(terrain, texture, amplify=amplify), texture.values, light),
        camera,
        spp=spp,
        seed=seed,
        max_depth=max_depth,
        progress=task_progress(progress, "path tracing"),
    )
    record = view_record(place, camera, light, position)
    record |= {"engine": engine, "spp": spp, "max_depth": max_depth, "seed": seed, "variant": backend.variant}
    record |= {"lambertian": lambertian, "amplified": amplify}
    return replace(view, provenance=record)


def still_sampling() -> SamplingOptions:
    """Samples and rays of a still: fewer than a film's, whose frames share them."""
    from seasonscapes.rendering.coefficients import SamplingOptions

    return SamplingOptions(albedo_samples=16, rays=64, clusters=8192)


def chosen_engine(engine: str, *, path_options: bool, device: str) -> str:
    """``transport`` or ``path``; `InputError` for unknown engines, and where options or device do not suit the engine.

    Parameters
    ----------
    engine
        ``auto``, ``transport`` or ``path``.
    path_options
        Whether options of path tracing are given.
    device
        Of the backend.
    """
    if engine not in ENGINES:
        raise InputError("--engine", "unknown engine", got=engine, expected=", ".join(ENGINES))
    if engine == "auto":
        return "path" if path_options or device == "scalar" else "transport"
    if engine == "transport" and path_options:
        raise InputError("--spp", "and --max-depth go with --engine path", cure="leave them out")
    if engine == "transport" and device == "scalar":
        raise InputError("--engine", "transport needs the device llvm or cuda", got="scalar", cure="--engine path")
    return engine


def textured_view(
    place: Place,
    radiance: np.ndarray,
    camera: Camera | Panorama,
    time: str | datetime,
    *,
    sky: str | Path | SkyModel = "clear",
) -> RenderedView:
    """View a place whose texture holds radiance instead of albedo: nothing is relit, the air and the sky are added.

    Parameters
    ----------
    place
        The place.
    radiance
        ``(R, S, 3)`` radiance of the surface in the place's atlas [cd/m²], such as ``complete(...).values``.
    camera
        A camera or panorama; one calibrated in another frame is converted to the place's.
    time
        Of the air and the sky: an aware datetime, or ISO 8601 text (civil time at the place without offset).
    sky
        A sky model, its name or its file.

    Returns
    -------
    RenderedView
        ``radiance`` ``(H, W, 3)`` at the camera [cd/m²], sampled at pixel centres.

    Raises
    ------
    InputError
        For a time or sky model that does not exist.
    FrameMismatch
        For a camera without a frame.

    Examples
    --------
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> texture = np.full((*place.texture_shape, 3), 3000.0, np.float32)
    >>> view = ss.textured_view(place, texture, camera, "2024-07-20T13:30", sky="hosek")
    >>> float(view.surface.max())
    3000.0
    """
    from seasonscapes.rendering.gbuffer import trace_gbuffer
    from seasonscapes.rendering.mitsuba_scene import build_scene
    from seasonscapes.rendering.radiance import RenderedView, apply_aerial_perspective
    from seasonscapes.terrain.surface import sample_texture

    camera = view_in_frame(camera, place.frame)
    camera, terrain = view_with_terrain(place, camera)
    light, position = illumination_for_camera(place, camera, sky_model(sky), utc_at(place, time))
    scene = build_scene(terrain, np.full(3, 0.2, np.float32), light)
    gbuffer = trace_gbuffer(scene, camera)
    coverage = np.isfinite(gbuffer.depth).astype(np.float32)
    surface = np.nan_to_num(sample_texture(radiance, gbuffer.uv))
    image = apply_aerial_perspective(scene, camera, surface, coverage, gbuffer)
    return RenderedView(image, surface, coverage, gbuffer, view_record(place, camera, light, position))


def view_record(
    place: Place, camera: Camera | Panorama, light: Illumination, position: SunMoonPosition
) -> dict[str, Any]:
    """Plain values about a rendered view: scene, camera, time, sun and sky, for files and reports."""
    latitude, longitude, height = camera_geodetic(place, camera)
    return {
        "scene": place.scene.name,
        "time_utc": position.time.astimezone(UTC).isoformat(),
        "sun": sun_angles(position),
        "sky": light.model,
        "white_rgb": light.white_rgb,
        "size_px": [camera.width_px, camera.height_px],
        "gps": {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height},
        "frame": dict(place.frame.__dict__),
        "world_from_camera": camera.world_from_camera.tolist(),
        "intrinsics": [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]],
        "attribution": place.scene.attribution,
        "scene_key": content_key(place.key),
        "seasonscapes": __version__,
    }


def sky_lines(position: SunMoonPosition) -> list[str]:
    """What to tell about sun and moon: the sun's position, the moon's when it is dark, and an eclipse."""
    sun = sun_angles(position)
    lines = [f"sun at azimuth {sun['azimuth_deg']:.2f}°, elevation {sun['elevation_deg']:.2f}° (refracted)"]
    if sun["elevation_deg"] < _MOONLIT_BELOW_DEG:
        lines.append(moon_text(position.moon))
    eclipse = eclipse_record(position.sun, position.moon)
    return lines if eclipse is None else [*lines, eclipse_text(eclipse)]


def sun_angles(position: SunMoonPosition) -> dict[str, float]:
    """Azimuth and elevation of the sun [deg] as plain numbers."""
    sun = position.sun
    return {"azimuth_deg": float(sun.azimuth_deg), "elevation_deg": float(sun.elevation_deg)}
