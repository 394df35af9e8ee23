"""Mitsuba scenes from terrain, albedo and illumination.

All arguments are in ENU; conversions to Mitsuba's own axes are internal. Mitsuba objects are named ``mi_*``. The RGB
variants do not depend on units: photometric linear Rec.709 input gives radiance in cd/m².
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from seasonscapes.frames import equirectangular_directions, sample_equirectangular
from seasonscapes.rendering.backend import aligned, use_backend
from seasonscapes.rendering.terrain_material import terrain_material
from seasonscapes.sky.illumination import Illumination, Luminary
from seasonscapes.terrain.attributes import vertex_normals
from seasonscapes.terrain.surface import Terrain

# Distance of the polygons that represent sun and moon: across 60 km of terrain their direction varies by 0.0004°.
LUMINARY_DISTANCE_M = 1.0e10
LUMINARY_SIDES = 32


class _HasTerrain(Protocol):
    @property
    def mi_terrain(self) -> Any: ...


@dataclass(frozen=True)
class RenderScene:
    """A Mitsuba scene of a terrain, under one illumination or without light.

    Parameters
    ----------
    mi_scene
        The complete scene, with sky, sun and moon as emitters.
    mi_terrain
        Mesh and material, which `relight` reuses for other illuminations.
    illumination
        Sky, sun, moon and aerial perspective; ``None`` for a scene without light, of which only the geometry is used.
    """

    mi_scene: Any
    mi_terrain: Any
    illumination: Illumination | None = None


def mi_mesh(terrain: Terrain, albedo: np.ndarray, *, smooth: bool = True) -> Any:
    """Create a Mitsuba mesh with its material; see `terrain_material`.

    Parameters
    ----------
    terrain
        Triangle mesh with texture coordinates.
    albedo
        ``(R, S, 3)`` linear Rec.709 reflectance with row 0 at v = 1, or ``(3,)`` for a uniform colour.
    smooth
        Shade with the normals of the terrain's surface, or without one with interpolated vertex normals; otherwise each
        triangle is flat.

    Returns
    -------
    mi.Mesh
        The mesh.
    """
    use_backend()
    import mitsuba as mi

    albedo = np.asarray(albedo, np.float32)
    if albedo.ndim == 1:
        reflectance: dict[str, Any] = {"type": "rgb", "value": albedo.tolist()}
    else:
        reflectance = {
            "type": "bitmap",
            "data": mi.TensorXf(aligned(albedo)),
            "raw": True,  # linear floats: no sRGB decoding, and differentiable
            "filter_type": "bilinear",
            "wrap_mode": "clamp",
        }
    properties = mi.Properties()
    properties["bsdf"] = terrain_material(reflectance, terrain, smooth=smooth)
    mesh = mi.Mesh(
        "terrain",
        len(terrain.vertices),
        len(terrain.faces),
        has_vertex_normals=smooth,
        has_vertex_texcoords=True,
        props=properties,
    )
    uv = np.array(terrain.uv, np.float32)
    # Mitsuba's bitmaps have row 0 at v = 0; here row 0 is at v = 1 (v runs upwards).
    uv[:, 1] = 1.0 - uv[:, 1]
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = aligned(terrain.vertices).ravel()
    parameters["faces"] = aligned(terrain.faces, np.uint32).ravel()
    parameters["vertex_texcoords"] = aligned(uv).ravel()
    if smooth:
        # Mitsuba sums vertex normals in parallel; their last bits, and those of images, would vary between runs. Those that are
        # set together with the positions it leaves as they are.
        normals = vertex_normals(terrain) if terrain.normals is None else terrain.normals
        parameters["vertex_normals"] = aligned(normals).ravel()
    parameters.update()
    return mesh


def _polygon(direction: np.ndarray, angular_radius_deg: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Vertices, faces and solid angle [sr] of a regular polygon in ``direction`` that faces the origin."""
    axis = np.array([0.0, 0.0, 1.0]) if abs(direction[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    side = np.cross(direction, axis)
    side /= np.linalg.norm(side)
    other = np.cross(direction, side)
    angle = np.arange(LUMINARY_SIDES) * (2.0 * np.pi / LUMINARY_SIDES)
    radius = LUMINARY_DISTANCE_M * np.tan(np.radians(angular_radius_deg))
    rim = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
    vertices = np.vstack([LUMINARY_DISTANCE_M * direction, LUMINARY_DISTANCE_M * direction + radius * rim])
    index = np.arange(LUMINARY_SIDES)
    faces = np.stack([np.zeros_like(index), 1 + (index + 1) % LUMINARY_SIDES, 1 + index], axis=1)
    area = 0.5 * LUMINARY_SIDES * radius**2 * np.sin(2.0 * np.pi / LUMINARY_SIDES)
    if np.cross(rim[0], rim[1]) @ direction < 0.0:
        faces = faces[:, ::-1]
    return vertices.astype(np.float32), np.ascontiguousarray(faces, np.uint32), area / LUMINARY_DISTANCE_M**2


def mi_luminary(luminary: Luminary) -> Any:
    """Create the emitter of sun or moon: a distant polygon of uniform radiance, with the luminary's exact illuminance.

    Parameters
    ----------
    luminary
        Sun or moon.

    Returns
    -------
    mi.Mesh
        Polygon with an area emitter.
    """
    import mitsuba as mi

    vertices, faces, solid_angle = _polygon(np.asarray(luminary.direction, float), luminary.angular_radius_deg)
    radiance = np.asarray(luminary.normal_illuminance_lx, float) / solid_angle
    properties = mi.Properties()
    properties["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": radiance.tolist()}})
    mesh = mi.Mesh("luminary", len(vertices), len(faces), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"], parameters["faces"] = vertices.ravel(), faces.ravel()
    parameters.update()
    return mesh


def mi_sky(sky_radiance: np.ndarray) -> Any:
    """Create the environment emitter of a sky map.

    Mitsuba's map has y up, its first column at -z, and rows from pole to pole *inclusive*. The map, whose values are at
    pixel centres, is resampled to that grid.

    Parameters
    ----------
    sky_radiance
        ``(H, W, 3)`` equirectangular sky radiance, ENU [cd/m²].

    Returns
    -------
    mi.Emitter
        Environment map in ENU.
    """
    import mitsuba as mi

    height, width = sky_radiance.shape[:2]
    elevation = np.pi / 2.0 - np.arange(height) * (np.pi / (height - 1))
    azimuth = (np.arange(width) + 0.5) * (2.0 * np.pi / width)
    horizontal = np.cos(elevation)[:, None]
    direction = np.stack(
        np.broadcast_arrays(np.sin(azimuth) * horizontal, np.cos(azimuth) * horizontal, np.sin(elevation)[:, None]), -1
    )
    values = sample_equirectangular(np.asarray(sky_radiance, np.float64), direction).astype(np.float32)
    enu_from_local = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)
    return mi.load_dict(
        {
            "type": "envmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(values)),
            "to_world": mi.ScalarTransform4f(enu_from_local),
        }
    )


def relight(mi_terrain: Any, illumination: Illumination) -> RenderScene:
    """Create a scene of a terrain under an illumination.

    A black sky, and luminaries without illuminance, are omitted.

    Parameters
    ----------
    mi_terrain
        Mesh from `mi_mesh`, or ``mi_terrain`` of another scene.
    illumination
        Sky, sun, moon and aerial perspective.

    Returns
    -------
    RenderScene
        The scene.

    Raises
    ------
    ValueError
        If the illumination has no light.
    """
    use_backend()
    import mitsuba as mi

    members: dict[str, Any] = {"type": "scene", "terrain": mi_terrain}
    if illumination.sky_radiance.max() > 0.0:
        members["sky"] = mi_sky(illumination.sky_radiance)
    for name, luminary in (("sun", illumination.sun), ("moon", illumination.moon)):
        if luminary is not None and np.max(luminary.normal_illuminance_lx) > 0.0:
            members[name] = mi_luminary(luminary)
    if len(members) == 2:
        raise ValueError("relight: the illumination has no light at all; expected a sky, sun or moon that is not black")
    return RenderScene(mi.load_dict(members), mi_terrain, illumination)


def build_scene(
    terrain: Terrain, albedo: np.ndarray, illumination: Illumination, *, smooth: bool = True
) -> RenderScene:
    """Create a scene of a terrain under an illumination; see `mi_mesh` and `relight`.

    Parameters
    ----------
    terrain
        Triangle mesh with texture coordinates.
    albedo
        ``(R, S, 3)`` linear Rec.709 reflectance, or ``(3,)`` for a uniform colour.
    illumination
        Sky, sun, moon and aerial perspective.
    smooth
        Interpolate vertex normals for shading.

    Returns
    -------
    RenderScene
        The scene.

    Raises
    ------
    ValueError
        If the illumination has no light.
    """
    return relight(mi_mesh(terrain, albedo, smooth=smooth), illumination)


def set_albedo(scene: _HasTerrain, albedo: np.ndarray) -> None:
    """Replace the albedo texture of a scene in place.

    Parameters
    ----------
    scene
        Any scene with an ``mi_terrain``: a `RenderScene` or a `hemisphere_rays.RayScene`.
    albedo
        ``(R, S, 3)`` linear Rec.709 reflectance, of the same size as the current texture.
    """
    import mitsuba as mi

    parameters = mi.traverse(scene.mi_terrain)
    key = next(key for key in parameters.keys() if key.endswith("reflectance.data"))  # noqa: SIM118 (not a dict)
    parameters[key] = mi.TensorXf(aligned(albedo))
    parameters.update()


def sky_radiance_towards(illumination: Illumination, direction: np.ndarray, pixel_angle_deg: float) -> np.ndarray:
    """Compute the radiance of the sky along view directions, with the discs of sun and moon.

    The edges of the discs are blurred over one pixel against aliasing. With aerial perspective the sky is its airlight
    at infinite distance, which has more detail than the map, plus the part of the map that this airlight lacks (stars,
    clouds); nothing is added where the visible sky is an empty map.

    Parameters
    ----------
    illumination
        Sky, sun, moon and aerial perspective.
    direction
        ``(..., 3)`` unit view directions, ENU.
    pixel_angle_deg
        Angular size of a pixel [deg].

    Returns
    -------
    numpy.ndarray
        ``(..., 3)`` [cd/m²].
    """
    sky_map = illumination.sky_radiance if illumination.visible_sky is None else illumination.visible_sky
    air = illumination.aerial_perspective
    if air is None:
        sky = sample_equirectangular(sky_map, direction)
    elif not sky_map.size:
        sky = air(np.inf, direction)[1]
    else:
        height, width = sky_map.shape[:2]
        grid = equirectangular_directions(height, width)
        # Near the horizon the map undersamples a steep profile: the residual at 4° elevation is used down to it.
        # Below the horizon the ground is part of the airlight, and the residual fades out.
        lowest = height // 2 - 1 - int(np.ceil(4.0 * height / 180.0))
        upper = sky_map[: lowest + 1] - air(np.inf, grid[: lowest + 1])[1]
        residual = np.concatenate([upper, np.broadcast_to(upper[-1], (height - len(upper), width, 3))])
        fade = np.clip(1.0 + np.degrees(np.arcsin(np.clip(direction[..., 2:], -1.0, 1.0))) / 2.0, 0.0, 1.0)
        sky = air(np.inf, direction)[1]
        sky = sky + fade * sample_equirectangular(residual, direction)
        sky = np.maximum(sky, 0.0)
    for luminary in (illumination.sun, illumination.moon):
        if luminary is None:
            continue
        # Chord length, because arccos loses half its digits at such small angles.
        angle_deg = np.degrees(np.linalg.norm(direction - np.asarray(luminary.direction), axis=-1))
        coverage = np.clip((luminary.angular_radius_deg - angle_deg) / pixel_angle_deg + 0.5, 0.0, 1.0)
        solid_angle = 2.0 * np.pi * (1.0 - np.cos(np.radians(luminary.angular_radius_deg)))
        sky = sky + coverage[..., None] * (np.asarray(luminary.normal_illuminance_lx) / solid_angle)
    return sky
