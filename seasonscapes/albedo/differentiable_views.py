"""Differentiable rendering of photographs: path replay backpropagation with the package's light, air and cameras.

Vicini, Speierer & Jakob 2021, "Path replay backpropagation", doi:10.1145/3450626.3459804: memory does not grow with the
length of paths. A rendered photograph equals the forward model (`forward_model`), but with every bounce traced and
every parameter differentiable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.albedo.forward_model import aerial_perspective_of
from seasonscapes.albedo.photographs import AlbedoPhotograph
from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.backend import use_backend
from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight
from seasonscapes.terrain.surface import Terrain

ALBEDO, SUN, SKY = "terrain.bsdf.reflectance.data", "sun.emitter.radiance.value", "sky.scale"


@dataclass(frozen=True)
class DifferentiableViews:
    """K photographs as Mitsuba scenes, all of one mesh.

    Parameters
    ----------
    mi_scenes, mi_params
        A scene and its parameters for each photograph; photographs of one light share them.
    mi_sensors
        One for each photograph.
    sun_radiance
        ``(3,)`` of each scene's sun, or ``None``.
    mi_depth, mi_airlight
        Optical depth and airlight of every pixel, tensors ``(H, W, 3)``.
    mi_integrator
        Path replay backpropagation.
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
    """Build the scenes, sensors and air of photographs.

    Parameters
    ----------
    terrain
        Mesh with texture coordinates.
    albedo
        ``(R, S, 3)`` initial texture.
    photographs
        K photographs of perspective cameras.
    max_depth
        Longest path, in segments.
    smooth
        Interpolate vertex normals.

    Returns
    -------
    DifferentiableViews
        Input of `mi_picture`.

    Raises
    ------
    InputError
        If only the scalar variant is available, which has no gradients.
    ValueError
        If a camera is a panorama or has pixels that are not square.
    """
    use_backend(gradients=True)
    import mitsuba as mi

    mesh = mi_mesh(terrain, albedo, smooth=smooth)
    scene_of_light: dict[tuple[int, int, int], tuple[Any, Any, np.ndarray | None]] = {}
    scenes, params, suns, depths, airlights = [], [], [], [], []
    for photograph in photographs:
        light = photograph.light
        # Cameras of one instant share sun and sky map, but not aerial perspective.
        key = (id(light.sky_radiance), id(light.sun), id(light.moon))
        if key not in scene_of_light:
            mi_scene = relight(mesh, light).mi_scene
            mi_values = mi.traverse(mi_scene)
            scene_of_light[key] = mi_scene, mi_values, np.array(mi_values[SUN]).ravel() if SUN in mi_values else None
        for column, value in zip((scenes, params, suns), scene_of_light[key], strict=True):
            column.append(value)
        depth, airlight = _air(photograph)
        depths.append(mi.TensorXf(depth))
        airlights.append(mi.TensorXf(airlight))
    integrator = mi.load_dict({"type": "prb", "max_depth": max_depth, "rr_depth": 64, "hide_emitters": True})
    sensors = [mi_sensor(photograph.observation.camera) for photograph in photographs]
    return DifferentiableViews(scenes, params, sensors, suns, depths, airlights, integrator)


def _air(photograph: AlbedoPhotograph) -> tuple[np.ndarray, np.ndarray]:
    """Optical depth and airlight ``(H, W, 3)``; zero where there is no terrain."""
    camera, pixel = photograph.footprints.camera, photograph.footprints.pixel
    transmittance, airlight = aerial_perspective_of(photograph.atmosphere, photograph.light, len(pixel))
    images = np.zeros((2, camera.height_px * camera.width_px, 3), np.float32)
    images[0, pixel], images[1, pixel] = -np.log(np.maximum(transmittance, 1e-6)), airlight
    depth, airlight = images.reshape(2, camera.height_px, camera.width_px, 3)
    return depth, airlight


def mi_sensor(camera: Camera | Panorama, *, pixel_format: str = "rgb") -> Any:
    """Build Mitsuba's perspective sensor of a camera.

    Parameters
    ----------
    camera
        Perspective camera with square pixels.
    pixel_format
        ``"rgb"``, or ``"rgba"`` for the coverage too.

    Returns
    -------
    mitsuba.Sensor
        Sensor with a box filter and linear float32 pixels.

    Raises
    ------
    ValueError
        If the camera is a panorama or its pixels are not square.
    """
    import mitsuba as mi

    if not isinstance(camera, Camera) or abs(camera.fx / camera.fy - 1.0) > 1e-6:
        raise ValueError("mi_sensor: differentiable rendering needs a perspective camera with square pixels")
    film = {
        "type": "hdrfilm",
        "width": camera.width_px,
        "height": camera.height_px,
        "pixel_format": pixel_format,
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
            # Mitsuba's camera axes: z forward, x to the left.
            "to_world": mi.ScalarTransform4f(camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])),
        }
    )


def mi_picture(views: DifferentiableViews, index: int, unknowns: dict[str, Any], *, spp: int, seed: int) -> Any:
    """Render one photograph as a differentiable tensor; the sky is black.

    Parameters
    ----------
    views
        Scenes from `differentiable_views`.
    index
        Index of the photograph.
    unknowns
        Dr.Jit arrays and tensors by name: ``albedo`` ``(R, S, 3)``, ``sun`` and ``sky`` (scales), ``haze`` (scale of
        the air's optical depth), ``log_gain`` ``(K, 3)``; and any of Mitsuba's parameters by its key. Missing ones keep
        their value (gains: 1).
    spp
        Samples per pixel.
    seed
        Picture and gradients use independent samples derived from it, so that their product is unbiased.

    Returns
    -------
    mitsuba.TensorXf
        ``(H, W, 3)`` radiance times gain.
    """
    import drjit as dr
    import mitsuba as mi

    params = views.mi_params[index]
    sun_radiance = views.sun_radiance[index]
    for name, value in unknowns.items():
        if name == "albedo":
            params[ALBEDO] = value
        elif name == "sun" and sun_radiance is not None:
            params[SUN] = mi.Color3f(*map(float, sun_radiance)) * value
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
        seed=2 * seed,  # pyright: ignore[reportArgumentType]
        seed_grad=2 * seed + 1,  # pyright: ignore[reportArgumentType]
    )
    image = mi_through_air(image, views.mi_depth[index], views.mi_airlight[index], unknowns.get("haze"))
    if "log_gain" in unknowns:
        mi_gain = dr.exp(unknowns["log_gain"].array)
        channels = [dr.gather(mi.Float, mi_gain, mi.UInt32(3 * index + c)) for c in range(3)]
        mi_row: Any = dr.ravel(mi.Color3f(*channels))
        image = image * mi.TensorXf(mi_row, shape=(1, 1, 3))
    return image


def mi_through_air(mi_image: Any, mi_depth: Any, mi_airlight: Any, haze: Any = None) -> Any:
    """Apply aerial perspective to a rendered image, with a differentiable scale of its optical depth.

    Parameters
    ----------
    mi_image
        Radiance ``(H, W, 3)`` that leaves the terrain.
    mi_depth, mi_airlight
        Optical depth and airlight ``(H, W, 3)`` up to the terrain.
    haze
        Scale of the optical depth; ``None`` for 1.

    Returns
    -------
    mitsuba.TensorXf
        Radiance ``(H, W, 3)`` at the camera.
    """
    import drjit as dr
    import mitsuba as mi

    if haze is None:
        return mi_image * dr.exp(-mi_depth) + mi_airlight
    scale = mi.TensorXf(mi.Float(haze), shape=(1, 1, 1))
    # In a homogeneous medium airlight is proportional to 1 - exp(-optical depth).
    growth = (1.0 - dr.exp(-mi_depth * scale)) / dr.fmax(1.0 - dr.exp(-mi_depth), 1e-6)
    return mi_image * dr.exp(-mi_depth * scale) + mi_airlight * growth
