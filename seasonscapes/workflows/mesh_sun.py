"""The sun of a mesh whose textures were photographed at an unknown hour."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.errors import NotEnoughEvidence
from seasonscapes.frames import direction_from_angles
from seasonscapes.progress import Progress, task_progress
from seasonscapes.sky.illumination import Illumination, Luminary
from seasonscapes.terrain.mesh_atlas import MeshAtlas
from seasonscapes.terrain.textured_mesh import TexturedMesh

if TYPE_CHECKING:
    from seasonscapes.albedo.sun_search import FoundSun
    from seasonscapes.workflows.meshes import MeshSurroundings, MeshTransport

# Texels are averaged to about so many samples at most.
_MOST_SAMPLES = 40_000
# Half the width of shadow borders that trial suns throw [deg]: uncertain surfaces, not the disc; and rays to its points.
_SOFTNESS_DEG, _RAYS = 1.0, 8
# Reflectance of ground whose texture is not uniform.
_GROUND = 0.2


def mesh_sun(
    mesh: TexturedMesh,
    transport: MeshTransport,
    *,
    ground_albedo: float | None = _GROUND,
    latitude_deg: float | None = None,
    progress: Progress | None = None,
) -> FoundSun:
    """Estimate the sun of a mesh's textures from shading and cast shadows; see `albedo.surface_sun`.

    Parameters
    ----------
    mesh
        The mesh, whose textures were photographed at one hour.
    transport
        Of `meshes.mesh_transport`.
    ground_albedo
        Of the ground around it; ``None`` for a mesh that hangs in the air.
    latitude_deg
        Only suns that can stand there are tried; ``None`` tries all.
    progress
        Called with a task and its finished share.

    Returns
    -------
    FoundSun
        With standard errors, and whether it can be trusted.

    Raises
    ------
    NotEnoughEvidence
        For textures with too few texels.
    """
    from seasonscapes.albedo.forward_model import ambient_on_texels
    from seasonscapes.albedo.surface_sun import LEAST_PAIRS, SurfaceSamples, find_surface_sun, neighbouring_pairs
    from seasonscapes.rendering.irradiance import points_on_faces, shadow_rays
    from seasonscapes.rendering.sun_visibility import visible_cosine

    atlas, texels = transport.atlas, transport.texels
    chosen, brightness = _samples(atlas, mesh)
    surface = texels.ray_scene
    points = points_on_faces(surface, atlas.face.ravel()[chosen], atlas.weights.reshape(-1, 3)[chosen])
    rays = shadow_rays(surface, points, chosen)
    uniform = np.zeros((32, 64, 3), np.float32)
    uniform[:16] = 1.0 / np.pi
    sky = ambient_on_texels(texels, Illumination(uniform), None)[chosen, 1]

    def sunlight(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
        direction = direction_from_angles(azimuth_deg, elevation_deg)
        return visible_cosine(rays, Luminary(direction, np.ones(3), _SOFTNESS_DEG), rays_per_sample=_RAYS)[:, 0]

    from_ground = 0.5 * (1.0 - points.normal[:, 2]) * (ground_albedo or 0.0)
    pairs = neighbouring_pairs(points.origin)
    if len(pairs) < LEAST_PAIRS:
        raise NotEnoughEvidence(
            f"{mesh.path.name}: its sun cannot be told from {len(chosen)} texels; state the time or the sun"
        )
    samples = SurfaceSamples(brightness, points.origin, sky, from_ground, sunlight)
    report = task_progress(progress, "sun of the textures")
    return find_surface_sun(samples, pairs, latitude_deg=latitude_deg, progress=report)


def require_mesh_sun(
    mesh: TexturedMesh, transport: MeshTransport, around: MeshSurroundings, *, progress: Progress | None = None
) -> tuple[tuple[float, float], dict[str, Any]]:
    """Azimuth and elevation [deg] of the sun of a mesh's textures, and plain values about how it was found.

    Raises
    ------
    NotEnoughEvidence
        Where it cannot be told.
    """
    from seasonscapes.workflows.delighting import found_sun_record, trusted_sun

    ground = _GROUND if around.terrain is not None else around.ground_albedo
    # A mesh without a place lies at latitude and longitude zero.
    latitude_deg = (
        mesh.frame.latitude_deg if (mesh.frame.latitude_deg, mesh.frame.longitude_deg) != (0.0, 0.0) else None
    )
    found = mesh_sun(mesh, transport, ground_albedo=ground, latitude_deg=latitude_deg, progress=progress)
    sun = trusted_sun(found, mesh.path.name, cure="state the time or the sun")
    return sun, {"found_sun": found_sun_record(found)}


def _samples(atlas: MeshAtlas, mesh: TexturedMesh) -> tuple[np.ndarray, np.ndarray]:
    """Texels ``(N,)`` of the atlas that stand for squares of texels of one chart, and the squares' brightness ``(N,)``."""
    image = atlas.image([texture.values for texture in mesh.textures])
    usable = (atlas.face >= 0) & (image < 1.0 - 1e-4).all(axis=2) & (image.max(axis=2) > 0.0)
    brightness = image.mean(axis=2)
    number = np.arange(usable.size).reshape(atlas.shape)
    step = max(1, int(np.ceil(np.sqrt(usable.sum() / _MOST_SAMPLES))))
    texels, values = [], []
    for index, texture in enumerate(mesh.textures):
        window = atlas.tiles[index].window
        # Colours of vertices do not adjoin in the image.
        side = 1 if texture.of_vertices else min(step, *usable[window].shape)
        rows, columns = (size // side for size in usable[window].shape)

        def squares(whole: np.ndarray) -> np.ndarray:
            part = whole[window][: rows * side, : columns * side]  # noqa: B023
            return part.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(rows * columns, side * side)  # noqa: B023

        chart, middle = squares(atlas.chart), side * side // 2
        good = squares(usable).all(axis=1) & (chart == chart[:, :1]).all(axis=1)
        texels.append(squares(number)[good][:, middle])
        values.append(squares(brightness)[good].mean(axis=1))
    chosen, found = np.concatenate(texels), np.concatenate(values)
    if len(chosen) > 2 * _MOST_SAMPLES:
        kept = np.random.default_rng(0).choice(len(chosen), _MOST_SAMPLES, replace=False)
        chosen, found = chosen[kept], found[kept]
    return chosen, found
