"""From terrain, albedo and illumination to a Mitsuba scene. Everything here speaks ENU; Mitsuba's own axes stay inside.

Objects of Mitsuba are named ``mi_*``. Radiances go in as they are: the variants are RGB and unit-agnostic, so
photometric linear Rec.709 in means cd/m² out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.frames import equirectangular_directions, sample_equirectangular
from seasonscapes.rendering.backend import use_backend
from seasonscapes.sky.illumination import Illumination, Luminary
from seasonscapes.terrain.attributes import vertex_normals
from seasonscapes.terrain.surface import Terrain

# Discs of sun and moon are polygons at this distance: 60 km of terrain then sees them within 0.0004° of parallel.
LUMINARY_DISTANCE_M = 1.0e10
LUMINARY_SIDES = 32


@dataclass(frozen=True)
class RenderScene:
    """A terrain with its material, under one light, ready for rays.

    ``mi_terrain`` (mesh and material) may be handed to `relight` again and again: only the light is rebuilt.
    """

    mi_scene: Any
    mi_terrain: Any
    illumination: Illumination
    max_height_m: float


def mi_mesh(terrain: Terrain, albedo: np.ndarray, *, smooth: bool = True) -> Any:
    """A Mitsuba mesh with a Lambertian texture.

    Parameters
    ----------
    albedo
        ``(R, S, 3)`` linear Rec.709 reflectance with row 0 at v = 1, or ``(3,)`` for one colour everywhere.
    smooth
        Interpolate vertex normals for shading. Off, the facets are flat: exact Lambert on every triangle.
    """
    use_backend()
    import mitsuba as mi

    albedo = np.asarray(albedo, np.float32)
    if albedo.ndim == 1:
        reflectance: dict = {"type": "rgb", "value": albedo.tolist()}
    else:
        reflectance = {
            "type": "bitmap",
            "data": mi.TensorXf(np.ascontiguousarray(albedo)),
            "raw": True,  # linear floats: no sRGB decoding, and differentiable
            "filter_type": "bilinear",
            "wrap_mode": "clamp",
        }
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": reflectance})
    mesh = mi.Mesh(
        "terrain",
        len(terrain.vertices),
        len(terrain.faces),
        has_vertex_normals=smooth,
        has_vertex_texcoords=True,
        props=properties,
    )
    uv = np.array(terrain.uv, np.float32)
    # Mitsuba's bitmaps put row 0 at v = 0; ours is at v = 1 (v runs upwards).
    uv[:, 1] = 1.0 - uv[:, 1]
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(terrain.vertices, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(terrain.faces, np.uint32).ravel()
    parameters["vertex_texcoords"] = uv.ravel()
    parameters.update()
    if smooth:
        # Mitsuba's own sums are made by all threads at once: their last bits, and pictures with them, would be by chance.
        parameters["vertex_normals"] = vertex_normals(terrain).ravel()
        parameters.update()
    return mesh


def _polygon(direction: np.ndarray, angular_radius_deg: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Vertices, faces and solid angle [sr] of a regular polygon that faces the origin from ``direction``."""
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
    """Sun or moon as a far polygon of uniform radiance whose illuminance is exact (the solid angle is its own)."""
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
    """An environment map in ENU.

    Mitsuba's map has y up and its first column at -z, and its rows run from pole to pole *inclusive*: ours are pixel
    centres, so the map is resampled to that grid.
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


def relight(mi_terrain: Any, illumination: Illumination, *, max_height_m: float) -> RenderScene:
    """The same terrain under another light. Black skies and luminaries without light are left out."""
    use_backend()
    import mitsuba as mi

    members: dict[str, Any] = {"type": "scene", "terrain": mi_terrain}
    if illumination.sky_radiance.max() > 0.0:
        members["sky"] = mi_sky(illumination.sky_radiance)
    for name, luminary in (("sun", illumination.sun), ("moon", illumination.moon)):
        if luminary is not None and np.max(luminary.normal_illuminance_lx) > 0.0:
            members[name] = mi_luminary(luminary)
    if len(members) == 2:
        raise ValueError("illumination: no light at all; neither sky, sun nor moon")
    return RenderScene(mi.load_dict(members), mi_terrain, illumination, max_height_m)


def build_scene(
    terrain: Terrain, albedo: np.ndarray, illumination: Illumination, *, smooth: bool = True
) -> RenderScene:
    """Terrain with albedo ``(R, S, 3)`` or ``(3,)`` under a light; see `mi_mesh` and `relight`."""
    return relight(
        mi_mesh(terrain, albedo, smooth=smooth), illumination, max_height_m=float(terrain.vertices[:, 2].max())
    )


def set_albedo(scene: RenderScene, albedo: np.ndarray) -> None:
    """Replace the texture of a scene in place by one of the same size ``(R, S, 3)``; geometry and light stay.

    Anything with an ``mi_terrain`` will do, such as a `hemisphere_rays.RayScene`.
    """
    import mitsuba as mi

    parameters = mi.traverse(scene.mi_terrain)
    key = next(key for key in parameters.keys() if key.endswith("reflectance.data"))  # noqa: SIM118 (not a dict)
    parameters[key] = mi.TensorXf(np.ascontiguousarray(albedo, np.float32))
    parameters.update()


def background(illumination: Illumination, direction: np.ndarray, pixel_angle_deg: float) -> np.ndarray:
    """Radiance ``(..., 3)`` [cd/m²] of the open sky along unit directions ``(..., 3)``, with the discs of sun and moon.

    The disc's edge is spread over one pixel, so that it does not alias. With aerial perspective the sky is what that
    gives at infinite distance, which is finer than the map, plus what the map knows beyond it (stars, clouds).
    """
    sky_map = illumination.sky_radiance if illumination.visible_sky is None else illumination.visible_sky
    air = illumination.aerial_perspective
    if air is None:
        sky = sample_equirectangular(sky_map, direction)
    else:
        height, width = sky_map.shape[:2]
        grid = equirectangular_directions(height, width)
        beyond = sky_map - air(np.full((height, width), np.inf), grid)[1]
        # Near the horizon the map is a coarse picture of a steep profile, so what it knows beyond the air is carried
        # down from 4° above; below the horizon the air alone knows the ground.
        lowest = height // 2 - 1 - int(np.ceil(4.0 * height / 180.0))
        beyond[lowest + 1 :] = beyond[lowest]
        above = np.clip(1.0 + np.degrees(np.arcsin(np.clip(direction[..., 2:], -1.0, 1.0))) / 2.0, 0.0, 1.0)
        sky = air(np.full(direction.shape[:-1], np.inf), direction)[1]
        sky = sky + above * sample_equirectangular(beyond, direction)
        sky = np.maximum(sky, 0.0)
    for luminary in (illumination.sun, illumination.moon):
        if luminary is None:
            continue
        # Chord length, not arccos: the latter loses half its digits at such small angles.
        angle_deg = np.degrees(np.linalg.norm(direction - np.asarray(luminary.direction), axis=-1))
        cover = np.clip((luminary.angular_radius_deg - angle_deg) / pixel_angle_deg + 0.5, 0.0, 1.0)
        solid_angle = 2.0 * np.pi * (1.0 - np.cos(np.radians(luminary.angular_radius_deg)))
        sky = sky + cover[..., None] * (np.asarray(luminary.normal_illuminance_lx) / solid_angle)
    return sky
