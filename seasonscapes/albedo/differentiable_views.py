"""Differentiable pictures: Mitsuba's path replay backpropagation behind our light, air and cameras.

Vicini, Speierer & Jakob 2021, "Path replay backpropagation", doi:10.1145/3450626.3459804: memory does not grow with the
length of paths. A picture here is what `forward` computes, but with every bounce traced and every part differentiable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.albedo.forward_model import aerial_perspective_of
from seasonscapes.albedo.photographs import AlbedoPhotograph
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.backend import use_backend
from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight
from seasonscapes.terrain.surface import Terrain

ALBEDO, SUN, SKY = "terrain.bsdf.reflectance.data", "sun.emitter.radiance.value", "sky.scale"


@dataclass(frozen=True)
class DifferentiableViews:
    """Photographs as Mitsuba renders them, K of them, all on one mesh.

    Parameters
    ----------
    mi_scenes, mi_params
        A scene and its parameters for each photograph; those of one light are the same objects.
    mi_sensors
        One for each.
    sun_radiance
        ``(3,)`` of each scene's sun, or ``None``.
    mi_depth, mi_airlight
        Optical depth and airlight of every pixel, tensors ``(H, W, 3)``.
    """

    mi_scenes: list[Any]
    mi_params: list[Any]
    mi_sensors: list[Any]
    sun_radiance: list[np.ndarray | None]
    mi_depth: list[Any]
    mi_airlight: list[Any]
    mi_integrator: Any


def differentiable_views(
    terrain: Terrain,
    albedo: np.ndarray,
    photographs: Sequence[AlbedoPhotograph],
    *,
    max_depth: int = 6,
    smooth: bool = True,
) -> DifferentiableViews:
    """Scenes, sensors and air of photographs.

    Raises
    ------
    InputError
        Where only the scalar variant is there, which has no gradients.
    """
    use_backend(gradients=True)
    import mitsuba as mi

    mesh = mi_mesh(terrain, albedo, smooth=smooth)
    top = float(terrain.vertices[:, 2].max())
    made: dict[tuple, tuple] = {}
    scenes, params, suns, depths, airlights = [], [], [], [], []
    for photograph in photographs:
        light = photograph.light
        # Cameras of one instant share sun and sky map, whatever air each looks through.
        key = (id(light.sky_radiance), id(light.sun), id(light.moon))
        if key not in made:
            mi_scene = relight(mesh, light, max_height_m=top).mi_scene
            values = mi.traverse(mi_scene)
            made[key] = mi_scene, values, np.array(values[SUN]).ravel() if SUN in values else None
        for held, value in zip((scenes, params, suns), made[key], strict=True):
            held.append(value)
        depth, airlight = _air(photograph)
        depths.append(mi.TensorXf(depth))
        airlights.append(mi.TensorXf(airlight))
    integrator = mi.load_dict({"type": "prb", "max_depth": max_depth, "rr_depth": 64, "hide_emitters": True})
    sensors = [mi_sensor(photograph.observation.camera) for photograph in photographs]
    return DifferentiableViews(scenes, params, sensors, suns, depths, airlights, integrator)


def _air(photograph: AlbedoPhotograph) -> tuple[np.ndarray, np.ndarray]:
    """Optical depth and airlight ``(H, W, 3)``; zero where no terrain is."""
    camera, pixel = photograph.footprints.camera, photograph.footprints.pixel
    transmittance, airlight = aerial_perspective_of(photograph.seen, photograph.light, len(pixel))
    images = np.zeros((2, camera.height_px * camera.width_px, 3), np.float32)
    images[0, pixel], images[1, pixel] = -np.log(np.maximum(transmittance, 1e-6)), airlight
    return tuple(images.reshape(2, camera.height_px, camera.width_px, 3))


def mi_sensor(camera: Camera) -> Any:
    """Mitsuba's perspective sensor for a camera with square pixels; `ValueError` for others."""
    import mitsuba as mi

    if abs(camera.fx / camera.fy - 1.0) > 1e-6:
        raise ValueError("differentiable pictures need square pixels")
    film = {
        "type": "hdrfilm",
        "width": camera.width_px,
        "height": camera.height_px,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "near_clip": 0.5,
            "far_clip": 1.0e7,
            "film": film,
            "fov": float(np.degrees(2.0 * np.arctan(0.5 * camera.width_px / camera.fx))),
            "principal_point_offset_x": 0.5 - camera.cx / camera.width_px,
            "principal_point_offset_y": 0.5 - camera.cy / camera.height_px,
            # Mitsuba looks along +z with x to the left.
            "to_world": mi.ScalarTransform4f(camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])),
        }
    )


def mi_picture(views: DifferentiableViews, index: int, unknowns: dict[str, Any], *, spp: int, seed: int) -> Any:
    """One photograph ``(H, W, 3)`` as a differentiable tensor; the sky is black.

    Parameters
    ----------
    unknowns
        Lanes and tensors by name: ``albedo`` ``(R, S, 3)``, ``sun`` and ``sky`` (scales), ``haze`` (scale of the air's
        optical depth), ``log_gain`` ``(K, 3)``; and any of Mitsuba's own parameters by its key. Missing ones keep their
        value (gains: 1).
    seed
        Gradients are estimated from other samples than the picture, so that their product has no bias.
    """
    import drjit as dr
    import mitsuba as mi

    params = views.mi_params[index]
    for name, value in unknowns.items():
        if name == "albedo":
            params[ALBEDO] = value
        elif name == "sun" and views.sun_radiance[index] is not None:
            params[SUN] = mi.Color3f(*map(float, views.sun_radiance[index])) * value
        elif name == "sky" and SKY in params:
            params[SKY] = mi.Float(value)
        elif name in params:
            params[name] = value
    params.update()
    image = mi.render(
        views.mi_scenes[index],
        params,
        sensor=views.mi_sensors[index],
        integrator=views.mi_integrator,
        spp=spp,
        seed=2 * seed,
        seed_grad=2 * seed + 1,
    )
    haze = unknowns.get("haze")
    depth, airlight = views.mi_depth[index], views.mi_airlight[index]
    if haze is None:
        image = image * dr.exp(-depth) + airlight
    else:
        scale = mi.TensorXf(mi.Float(haze), shape=(1, 1, 1))
        # A homogeneous path: airlight grows as what is scattered out of it.
        grown = (1.0 - dr.exp(-depth * scale)) / dr.fmax(1.0 - dr.exp(-depth), 1e-6)
        image = image * dr.exp(-depth * scale) + airlight * grown
    if "log_gain" in unknowns:
        gain = dr.exp(unknowns["log_gain"].array)
        row = [dr.gather(mi.Float, gain, mi.UInt32(3 * index + c)) for c in range(3)]
        image = image * mi.TensorXf(dr.ravel(mi.Color3f(*row)), shape=(1, 1, 3))
    return image
