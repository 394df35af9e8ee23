"""A user's textured mesh: placed on Earth, its light removed, and lit anew at any hour."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes import __version__
from seasonscapes.civil_time import resolve_time
from seasonscapes.errors import InputError
from seasonscapes.progress import Progress, task_progress
from seasonscapes.sky.illumination import Illumination
from seasonscapes.sky.models import SkyModel
from seasonscapes.terrain.mesh_atlas import MeshAtlas, MeshGround, mesh_atlas
from seasonscapes.terrain.textured_mesh import MeshTexture, TexturedMesh
from seasonscapes.workflows.illumination import (
    SunMoonPosition,
    given_sun_in_frame,
    illumination_at,
    sky_model,
    sun_moon_position,
)
from seasonscapes.workspace import Workspace, default_workspace

if TYPE_CHECKING:
    from seasonscapes.albedo.delighting import DelightOptions
    from seasonscapes.albedo.forward_model import TexelTransport

log = logging.getLogger(__name__)

Time = str | datetime | tuple[float, float]


@dataclass(frozen=True)
class MeshSurroundings:
    """What a mesh stands on and under.

    Parameters
    ----------
    ground_albedo
        Albedo of level ground at the mesh's lowest point; ``None``: the mesh hangs in the air.
    sky
        A sky model, its name or its file; see `sky_model`.
    rays
        Over the hemisphere of each texel, a power of two.
    workspace
        Where tables of the sky are kept.
    seed
        Equal seeds give equal results.
    terrain
        A scene's terrain instead of level ground, of `scene_ground`.

    Raises
    ------
    InputError
        For an albedo out of range.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> ss.MeshSurroundings(sky="overcast").model.name
    'overcast'
    """

    ground_albedo: float | None = 0.2
    sky: str | Path | SkyModel = "clear"
    rays: int = 256
    workspace: Workspace = field(default_factory=default_workspace)
    seed: int = 0
    terrain: MeshGround | None = None

    def __post_init__(self):
        if self.ground_albedo is not None and not 0.0 <= self.ground_albedo <= 1.0:
            raise InputError("--ground-albedo", "out of range", got=self.ground_albedo, expected="0 to 1")

    @cached_property
    def model(self) -> SkyModel:
        """The sky model."""
        return sky_model(self.sky)

    @property
    def ground_facts(self) -> dict[str, Any]:
        """Plain values about the ground."""
        return {"ground_albedo": self.ground_albedo} if self.terrain is None else {"standing_on": self.terrain.name}


@dataclass(frozen=True)
class DelitMesh:
    """A mesh without the light of its hour.

    Parameters
    ----------
    mesh
        The mesh with albedo textures.
    sigma
        Standard error of the albedo of each texture ``(R, S)``; infinite off the surface.
    facts
        Plain values about the light and what was fitted.
    """

    mesh: TexturedMesh
    sigma: tuple[np.ndarray, ...]
    facts: dict[str, Any]


@dataclass(frozen=True)
class LitMesh:
    """A mesh's textures as lit at an hour.

    Parameters
    ----------
    mesh
        The mesh, whose textures are albedo.
    radiance, illuminance
        Of each texture ``(R, S, 3)``: radiance that leaves the surface [cd/m²], and what it receives [lx].
    facts
        Plain values about the light.
    """

    mesh: TexturedMesh
    radiance: tuple[np.ndarray, ...]
    illuminance: tuple[np.ndarray, ...]
    facts: dict[str, Any]


def mesh_light(
    mesh: TexturedMesh, time: Time, surroundings: MeshSurroundings | None = None
) -> tuple[Illumination, dict[str, Any]]:
    """Light of an hour on a mesh, and plain values about it.

    Parameters
    ----------
    mesh
        The mesh.
    time
        An aware datetime; ISO 8601 text, which without offset is civil time at the mesh; or azimuth and elevation of
        the sun [deg].
    surroundings
        The sky.

    Raises
    ------
    InputError
        For a time that is none, or a sun outside the sky model's range.
    """
    from seasonscapes.workflows.view_rendering import sun_angles

    around = surroundings or MeshSurroundings()
    position, record = sun_of(mesh, time)
    light = illumination_at(
        around.model, position, mesh.frame.height_m, workspace=around.workspace, with_aerial_perspective=False
    )
    angles = sun_angles(position)
    record |= {"sun": {name: round(value, 4) for name, value in angles.items()}, "sky": light.model}
    record["white_rgb"] = light.white_rgb
    return replace(light, frame=mesh.frame), record


def sun_of(mesh: TexturedMesh, time: Time) -> tuple[SunMoonPosition, dict[str, Any]]:
    """Sun and moon of an hour over a mesh, and plain values about where and when."""
    frame = mesh.frame
    record: dict[str, Any] = {
        "mesh": mesh.path.name,
        "origin": {
            "latitude_deg": frame.latitude_deg,
            "longitude_deg": frame.longitude_deg,
            "height_m": frame.height_m,
        },
        "up": mesh.up,
        "seasonscapes": __version__,
    }
    if isinstance(time, tuple):
        return given_sun_in_frame(frame, *time), record
    utc = resolve_time(time, frame.latitude_deg, frame.longitude_deg).utc if isinstance(time, str) else time
    position = sun_moon_position(utc, frame.latitude_deg, frame.longitude_deg, frame.height_m)
    return position, record | {"time_utc": utc.astimezone(UTC).isoformat()}


@dataclass(frozen=True)
class MeshTransport:
    """A mesh with the traced light transport of its texels, for any light.

    Parameters
    ----------
    atlas
        All textures in one image.
    texels
        Daylight coefficients of the texels.
    """

    atlas: MeshAtlas
    texels: TexelTransport

    @property
    def known(self) -> np.ndarray:
        """``(R, S)`` texels on the surface."""
        return self.atlas.face >= 0


def mesh_transport(
    mesh: TexturedMesh, surroundings: MeshSurroundings | None = None, *, progress: Progress | None = None
) -> MeshTransport:
    """Trace the light transport of all texels of a mesh.

    Parameters
    ----------
    mesh
        The mesh.
    surroundings
        Ground and number of rays.
    progress
        Called with a task and its finished share.

    Raises
    ------
    InputError
        Where a texture repeats over the surface, or no texel lies on it.
    """
    from seasonscapes.albedo.forward_model import transport_of_points
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.coefficients import SamplingOptions
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.irradiance import points_on_faces
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.workflows.received_light import require_rays

    around = surroundings or MeshSurroundings()
    require_rays(around.rays, where="--rays")
    use_backend()
    atlas = atlas_of(mesh, around)
    texel = np.flatnonzero(atlas.face >= 0)
    if len(texel) == 0:
        raise InputError(mesh.path, "no texel of any texture lies on the surface", cure="unwrap the mesh again")
    surface = ray_scene(mi_mesh(atlas.terrain, np.full(3, 0.3, np.float32)))
    points = points_on_faces(surface, atlas.face.ravel()[texel], atlas.weights.reshape(-1, 3)[texel])
    sampling = SamplingOptions(shadow_samples=1, rays=around.rays, clusters_per_receiver=64, clusters=4096)
    report = task_progress(progress, "light of the texels")
    transport = transport_of_points(
        surface, atlas.shape, points, texel, sampling=sampling, seed=around.seed, progress=report
    )
    return MeshTransport(atlas, transport)


def atlas_of(mesh: TexturedMesh, surroundings: MeshSurroundings) -> MeshAtlas:
    """All textures of a mesh in one image, on its ground; what may not be meant in the mesh is logged."""
    atlas = mesh_atlas(mesh, ground=surroundings.terrain or surroundings.ground_albedo)
    for note in atlas.notes:
        log.warning("%s: %s", mesh.path.name, note)
    return atlas


def delight_mesh(
    mesh: TexturedMesh,
    time: Time,
    *,
    surroundings: MeshSurroundings | None = None,
    options: DelightOptions | None = None,
    transport: MeshTransport | None = None,
    progress: Progress | None = None,
) -> DelitMesh:
    """Remove the light of an hour from a mesh's textures: sun, cast shadows, skylight and interreflection.

    Parameters
    ----------
    mesh
        The mesh, whose textures were photographed at that hour.
    time
        An aware datetime; ISO 8601 text, which without offset is civil time at the mesh; azimuth and elevation of
        the sun [deg]; or "unknown", to find the sun from shading and cast shadows.
    surroundings
        Ground, sky and number of rays.
    options
        How to estimate; see `albedo.delighting.DelightOptions`.
    transport
        Of `mesh_transport`, if it is at hand.
    progress
        Called with a task and its finished share.

    Returns
    -------
    DelitMesh
        The mesh with albedo textures, and their standard errors.

    Raises
    ------
    InputError
        For a time that is none, or a texture that repeats over the surface.
    NotEnoughEvidence
        Where the sun of textures of unknown hour cannot be told.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np, trimesh
    >>> import seasonscapes as ss
    >>> ball = trimesh.creation.icosphere(subdivisions=2)
    >>> ball.visual.vertex_colors = np.full((len(ball.vertices), 4), (120, 110, 90, 255), np.uint8)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = ball.export(f"{folder}/ball.ply")
    ...     mesh = ss.load_mesh(f"{folder}/ball.ply")
    >>> around = ss.MeshSurroundings(sky="hosek", rays=16)
    >>> albedo = ss.delight_mesh(mesh, (180.0, 45.0), surroundings=around).mesh.textures[0].values
    >>> albedo.shape == mesh.textures[0].values.shape
    True
    """
    from seasonscapes.albedo.delighting import DelightOptions, delight_image
    from seasonscapes.albedo.texel_light import texel_irradiance

    around = surroundings or MeshSurroundings()
    found = {}
    if time == "unknown":
        from seasonscapes.workflows.mesh_sun import require_mesh_sun

        transport = transport or mesh_transport(mesh, around, progress=progress)
        time, found = require_mesh_sun(mesh, transport, around, progress=progress)
    light, record = mesh_light(mesh, time, around)
    if light.sun is None and record["sun"]["elevation_deg"] <= 0.0:
        got = f"the sun stands at {record['sun']['elevation_deg']:.1f}°"
        raise InputError("--time", "no daylight in the textures", got=got, expected="a sun above the horizon")
    transport = transport or mesh_transport(mesh, around, progress=progress)
    atlas, known = transport.atlas, transport.known
    stored = atlas.image([texture.values for texture in mesh.textures])
    whole = atlas.image([t.values * f for t, f in zip(mesh.textures, _factors(mesh), strict=True)])
    traced = texel_irradiance(transport.texels, light, atlas.chart)
    irradiance = replace(traced, bounce=lambda albedo: traced.bounce(_reflecting(atlas, albedo, known)))
    # Texture coordinates place the image exactly; between vertices no shadow border can be followed.
    only_vertices = all(texture.of_vertices for texture in mesh.textures)
    options = replace(options or DelightOptions(), register=False)
    options = replace(options, borders=None) if only_vertices else options
    clipped = (stored >= 1.0 - 1e-4) & known[..., None]
    image = np.where(known[..., None], whole, np.float32(np.nan))
    report = task_progress(progress, "removing the light")
    delit = delight_image(image, clipped, irradiance, options=options, progress=report)
    # Off the surface the light of the nearest texel is removed, so that the gutters of charts show no seams.
    gain = delit.albedo / np.maximum(image, 1e-4)
    albedo = np.where(
        known[..., None], delit.albedo, np.clip(whole * atlas.filled(np.nan_to_num(gain), known), 0.0, 1.0)
    )
    values = atlas.textures(albedo.astype(np.float32))
    textures = tuple(replace(t, values=v) for t, v in zip(mesh.textures, values, strict=True))
    sigma = tuple(sheet[..., 0] for sheet in atlas.textures(delit.sigma[..., None]))
    facts = record | found | around.ground_facts | {"textures": "albedo", **delit.facts}
    return DelitMesh(with_textures(mesh, textures), sigma, facts)


def with_textures(mesh: TexturedMesh, textures: Sequence[MeshTexture]) -> TexturedMesh:
    """The mesh with other textures, which contain the colour factors of its materials."""
    parts = tuple(part if part.texture < 0 else replace(part, colour=(1.0, 1.0, 1.0)) for part in mesh.parts)
    return replace(mesh, textures=tuple(textures), parts=parts)


def _reflecting(atlas: MeshAtlas, albedo: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The albedo image that reflects light: completed off the surface, with the tiles that are no texture."""
    values = atlas.textures(atlas.filled(np.nan_to_num(albedo, nan=0.25), known))
    return np.clip(atlas.image(values), 0.0, 1.0)


def light_mesh(
    mesh: TexturedMesh,
    time: Time,
    *,
    surroundings: MeshSurroundings | None = None,
    transport: MeshTransport | None = None,
    progress: Progress | None = None,
) -> LitMesh:
    """Compute a mesh's textures as lit at an hour.

    Parameters
    ----------
    mesh
        The mesh, whose textures are albedo, as those of `delight_mesh`.
    time, surroundings, transport, progress
        See `delight_mesh`.

    Returns
    -------
    LitMesh
        Radiance and illuminance of every texel.

    Raises
    ------
    InputError
        For a time that is none, or a texture that repeats over the surface.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np, trimesh
    >>> import seasonscapes as ss
    >>> ball = trimesh.creation.icosphere(subdivisions=2)
    >>> ball.visual.vertex_colors = np.full((len(ball.vertices), 4), (120, 110, 90, 255), np.uint8)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = ball.export(f"{folder}/ball.ply")
    ...     mesh = ss.load_mesh(f"{folder}/ball.ply")
    >>> around = ss.MeshSurroundings(sky="hosek", rays=16)
    >>> lit = ss.light_mesh(mesh, (180.0, 45.0), surroundings=around)
    >>> top, bottom = mesh.positions[0][:, 2].argmax(), mesh.positions[0][:, 2].argmin()
    >>> bool(lit.illuminance[0][top, 0, 1] > 5.0 * lit.illuminance[0][bottom, 0, 1])
    True
    """
    from seasonscapes.albedo.forward_model import ambient_on_texels, sun_on_texels

    around = surroundings or MeshSurroundings()
    light, record = mesh_light(mesh, time, around)
    transport = transport or mesh_transport(mesh, around, progress=progress)
    atlas, known = transport.atlas, transport.known
    albedo = albedo_image(atlas, mesh)
    total = sun_on_texels(transport.texels, light) + ambient_on_texels(transport.texels, light, albedo)
    received = atlas.filled(total.reshape(*atlas.shape, 3), known)
    illuminance = atlas.textures(received)
    radiance = atlas.textures(received * albedo / np.float32(np.pi))
    facts = record | around.ground_facts
    return LitMesh(mesh, tuple(radiance), tuple(illuminance), facts)


def albedo_image(atlas: MeshAtlas, mesh: TexturedMesh) -> np.ndarray:
    """The image ``(R, S, 3)`` of a mesh whose textures are albedo."""
    values = [t.values * f for t, f in zip(mesh.textures, _factors(mesh), strict=True)]
    return np.clip(atlas.image(values), 0.0, 1.0)


def _factors(mesh: TexturedMesh) -> Sequence[np.ndarray]:
    factors = [np.ones(3, np.float32)] * len(mesh.textures)
    for part in mesh.parts:
        if part.texture >= 0:
            factors[part.texture] = np.asarray(part.colour, np.float32)
    return factors
