"""Path tracing of terrain lit by a distant sun, moon and sky, on vectorised variants.

Mitsuba's general ``path`` integrator spends half of its emitter samples on the sun and the other half on directions of
the sky. Here each vertex casts one shadow ray to the sun and one to the moon, and the cosine-sampled continuation ray
samples the sky. The expectation and the number of rays are the same, with much less noise. Water that the viewer sees,
directly or in other water, mirrors (`water_surface`); snow and forest that the viewer sees directly scatter (`ground_optics`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np

from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.gbuffer import mi_rays
from seasonscapes.rendering.ground_optics import GroundOptics
from seasonscapes.rendering.mitsuba_scene import LUMINARY_DISTANCE_M, RenderScene
from seasonscapes.rendering.sobol import hashed, sobol_pair, uniform
from seasonscapes.rendering.terrain_material import (
    device_water,
    diffuse_normal,
    ground_optics,
    leaving_points,
    shadow_ray_start,
)
from seasonscapes.rendering.water_surface import DeviceWater
from seasonscapes.sky.illumination import Luminary

# Farther hits are the polygons of sun and moon, which only Mitsuba's own integrators use.
FAR_M = 0.1 * LUMINARY_DISTANCE_M
# Russian roulette: from the second vertex on, a path continues with probability min(1, SURVIVAL √throughput). This gave
# the least noise in equal time among 1 and 2 times √throughput and throughput, for albedos of 0.1 to 0.5.
SURVIVAL = 2.0
# Keys of the random decisions at a path vertex, mixed into their hashes.
_PIXEL, _BOUNCE, _SURVIVAL, _LUMINARY, _WAVE, _FRESNEL = 0, 1, 3, 4, 7, 8


@dataclass(frozen=True)
class _DeviceLuminary:
    """Sun or moon on the device: frame towards its centre, cosine and squared sine of its angular radius, normal illuminance
    and radiance of its disc."""

    mi_frame: Any
    mi_cos_radius: Any
    mi_sin2_radius: Any
    mi_illuminance: Any
    mi_radiance: Any


def trace_block(
    scene: RenderScene, camera: Camera | Panorama, rows: range, samples: range, *, max_depth: int, seed: tuple[int, int]
) -> np.ndarray:
    """Trace the paths of a block of image rows and sum over the samples of each pixel.

    Parameters
    ----------
    scene
        Terrain and illumination.
    camera
        The view.
    rows
        Consecutive image rows.
    samples
        Indices of consecutive samples of each pixel.
    max_depth
        Longest path, in edges.
    seed
        Two 32-bit words.

    Returns
    -------
    numpy.ndarray
        ``(len(rows), W, 4)`` float32: radiance [cd/m²] and number of samples on terrain.

    Raises
    ------
    ValueError
        If the scene has other emitters than sky, sun and moon.
    """
    import mitsuba as mi

    # Opaque numbers: one compiled kernel serves all blocks, sizes and seeds.
    def opaque(value: int) -> Any:
        return dr.opaque(mi.UInt32, int(value))

    count = len(samples)
    lane = dr.arange(mi.UInt32, camera.width_px * len(rows) * count)
    per_pixel, width = opaque(count), opaque(camera.width_px)
    pixel = lane // per_pixel
    index = lane - pixel * per_pixel + opaque(samples.start)
    pixel += width * opaque(rows.start)
    row = pixel // width
    key = hashed(hashed(pixel, opaque(seed[0])), opaque(seed[1]))
    offset = sobol_pair(hashed(key, _PIXEL), index)
    ray = mi_rays(camera, mi.Float(pixel - row * width) + offset.x, mi.Float(row) + offset.y)
    with dr.suspend_grad():
        radiance, on_terrain = _trace(scene, ray, key, index, opaque(max_depth))
    channels = [
        *(dr.select(on_terrain, channel, 0.0) for channel in radiance),
        dr.select(on_terrain, mi.Float(1.0), 0.0),
    ]
    # Evaluated together: summing an unevaluated channel would trace all paths again for each of the four channels.
    dr.eval(channels)
    sums = [dr.block_sum(channel, count) for channel in channels]
    dr.eval(sums)
    return np.stack([np.array(values) for values in sums], axis=-1).reshape(len(rows), camera.width_px, 4)


def _upload_luminary(luminary: Luminary) -> _DeviceLuminary:
    import mitsuba as mi

    def opaque(value: float) -> Any:
        return dr.opaque(mi.Float, float(value))

    frame = mi.Frame3f(mi.Vector3f(*map(opaque, luminary.direction)))
    radius = np.radians(luminary.angular_radius_deg)
    illuminance = np.asarray(luminary.normal_illuminance_lx, float)
    radiance = illuminance / (4.0 * np.pi * np.sin(0.5 * radius) ** 2)
    colours = (mi.Color3f(*map(opaque, colour)) for colour in (illuminance, radiance))
    return _DeviceLuminary(frame, opaque(np.cos(radius)), opaque(np.sin(radius) ** 2), *colours)


def _luminaries(scene: RenderScene) -> list[_DeviceLuminary]:
    if scene.illumination is None:
        raise ValueError("path tracer: got a scene without illumination, expected one from `mitsuba_scene.relight`")
    bodies = (scene.illumination.sun, scene.illumination.moon)
    bright = [body for body in bodies if body is not None and np.max(body.normal_illuminance_lx) > 0.0]
    emitters, expected = len(scene.mi_scene.emitters()), len(bright) + (scene.mi_scene.environment() is not None)
    if emitters != expected:
        raise ValueError(
            f"path tracer: got {emitters} emitters, expected {expected}; only sky, sun and moon may light a scene"
        )
    return [_upload_luminary(body) for body in bright]


@dataclass(frozen=True)
class _Reflection:
    """How lanes of paths reflect light from a direction.

    ``diffuse`` and ``before``: throughput behind and before the surface; ``water`` with waves and ``optics`` with the lanes
    that they concern.
    """

    normal: Any
    viewer: Any
    diffuse: Any
    before: Any
    albedo: Any
    water: tuple[DeviceWater, Any] | None
    optics: tuple[GroundOptics, Any] | None

    def towards(self, direction: Any, cosine: Any) -> Any:
        """Throughput × reflected radiance for unit normal irradiance [1/sr]."""
        reflected = self.diffuse * cosine * dr.inv_pi * self.of_ground(direction)
        if self.water is not None:
            water, on_water = self.water
            glitter = water.glitter(self.normal, self.viewer, direction)
            reflected += dr.select(on_water, self.before * glitter, 0.0)
        return reflected

    def of_ground(self, direction: Any) -> Any:
        """Reflection of snow and forest relative to Lambertian ground.

        The interpolated normal may face away from the viewer, who sees the facet all the same.
        """
        import mitsuba as mi

        if self.optics is None:
            return mi.Color3f(1.0)
        optics, scatters = self.optics
        cosines = (dr.dot(self.normal, self.viewer), dr.dot(self.normal, direction), dr.dot(self.viewer, direction))
        return dr.select(scatters, mi.Color3f(*optics.relative(self.albedo, cosines, dr)), 1.0)


def _trace(scene: RenderScene, ray: Any, sample_key: Any, index: Any, max_depth: Any) -> tuple[Any, Any]:
    """Radiance ``mi.Color3f`` along camera rays, and whether they hit terrain.

    ``sample_key`` and ``index`` are key and index of each sample's Sobol points.
    """
    import mitsuba as mi

    mi_terrain, mi_sky, luminaries = scene.mi_terrain, scene.mi_scene.environment(), _luminaries(scene)
    material = mi_terrain.bsdf()
    water, optics = device_water(material), ground_optics(material)

    def step(
        ray: Any, radiance: Any, throughput: Any, depth: Any, active: Any, on_terrain: Any, seen: Any, most: Any
    ) -> tuple[Any, ...]:
        # ``seen``: only mirrors lie between here and the viewer. ``most``: longest path; a mirror makes it one longer.
        preliminary = scene.mi_scene.ray_intersect_preliminary(ray, coherent=depth == 0, active=active)
        hit = active & preliminary.is_valid() & (preliminary.t < FAR_M)
        radiance += _sky_radiance(mi_sky, ray.d, throughput, active & ~hit & (depth > 0))
        if water is not None and water.smooth:
            radiance += _discs(luminaries, ray.d, throughput, active & ~hit & (depth > 0) & seen)
        on_terrain |= hit & (depth == 0)
        key = hashed(sample_key, depth)
        survival = dr.select(depth > 0, dr.minimum(SURVIVAL * dr.sqrt(dr.max(throughput)), 1.0), 1.0)
        active = hit & (depth + 1 < most) & (uniform(hashed(key, _SURVIVAL)) < survival)
        throughput /= survival
        # Called on the mesh: the same call on the scene would first look up the shape of each lane.
        surface = mi_terrain.compute_surface_interaction(ray, preliminary, mi.RayFlags.All, active)
        active &= dr.dot(surface.n, ray.d) < 0.0
        origin, outward, normal = leaving_points(material, surface, active)
        reflectance = material.eval_diffuse_reflectance(surface, active)
        direction = mi.warp.square_to_cosine_hemisphere(sobol_pair(hashed(key, _BOUNCE), index))
        diffuse = diffuse_normal(material, outward, normal)
        direction = mi.Frame3f(diffuse).to_world(direction)
        albedo, before = mi.Color3f(reflectance), mi.Color3f(throughput)
        mirrored, on_water = mi.Bool(False), mi.Bool(False)
        if water is not None:
            on_water = active & seen & water.covers(surface.uv, active)
            wave, share = water.mirrored(normal, -ray.d, sobol_pair(hashed(key, _WAVE), index))
            # A facet mirrors or lets in; the facet that is seen decides.
            mirrored = on_water & (sobol_pair(hashed(key, _FRESNEL), index).x < share)
            reflectance = dr.select(on_water, material.body(surface, on_water), reflectance)
            reflectance = dr.select(mirrored, 1.0, reflectance)
            direction = dr.select(mirrored, wave, direction)
        throughput = dr.select(active, throughput * reflectance, throughput)
        reflection = _Reflection(
            normal,
            -ray.d,
            diffuse=dr.select(mirrored, 0.0, throughput),
            before=before,
            albedo=albedo,
            water=None if water is None or water.smooth else (water, on_water),
            optics=None if optics is None else (optics, active & (depth == 0) & ~on_water),
        )
        throughput *= replace(reflection, normal=diffuse).of_ground(direction)
        light = _direct_light(
            scene,
            luminaries,
            (origin, outward, normal),
            reflection,
            sample=(key, index),
            active=active,
            coherent=depth == 0,
        )
        radiance += dr.select(active, light, 0.0)
        seen &= mirrored
        most = dr.select(mirrored & (most == max_depth), most + 1, most)
        active &= (dr.max(throughput) > 0.0) & (dr.dot(direction, outward) > 0.0)
        return mi.Ray3f(origin, direction), radiance, throughput, depth + 1, active, on_terrain, seen, most

    start = (
        mi.Ray3f(ray),
        mi.Color3f(0.0),
        mi.Color3f(1.0),
        mi.UInt32(0),
        mi.Bool(True),
        mi.Bool(False),
        mi.Bool(True),
        mi.UInt32(max_depth),
    )
    _, radiance, _, _, _, on_terrain, *_ = dr.while_loop(
        start, lambda *state: state[4], step, label="path over terrain"
    )
    return radiance, on_terrain


def _discs(luminaries: list[_DeviceLuminary], direction: Any, throughput: Any, escaped: Any) -> Any:
    """Throughput × radiance of the discs of sun and moon along ``direction``, zero for lanes that have not escaped."""
    import mitsuba as mi

    total = mi.Color3f(0.0)
    for luminary in luminaries:
        local = luminary.mi_frame.to_local(direction)
        inside = escaped & (local.z > 0.0) & (local.x * local.x + local.y * local.y < luminary.mi_sin2_radius)
        total += dr.select(inside, throughput * luminary.mi_radiance, 0.0)
    return total


def _sky_radiance(mi_sky: Any, direction: Any, throughput: Any, escaped: Any) -> Any:
    """Throughput × sky radiance along ``direction``, zero for lanes that have not escaped."""
    import mitsuba as mi

    if mi_sky is None:
        return mi.Color3f(0.0)
    interaction = dr.zeros(mi.SurfaceInteraction3f)
    interaction.wi = -direction
    return dr.select(escaped, throughput * mi_sky.eval(interaction, escaped), 0.0)


def _direct_light(
    scene: RenderScene,
    luminaries: list[_DeviceLuminary],
    leaving: tuple[Any, Any, Any],
    reflection: _Reflection,
    *,
    sample: tuple[Any, Any],
    active: Any,
    coherent: Any,
) -> Any:
    """Radiance that a surface reflects of the direct light of sun and moon, with one shadow ray for each."""
    import mitsuba as mi

    origin, outward, normal = leaving
    key, index = sample
    material = scene.mi_terrain.bsdf()
    total = mi.Color3f(0.0)
    for number, luminary in enumerate(luminaries):
        point = sobol_pair(hashed(key, _LUMINARY + number), index)
        direction = luminary.mi_frame.to_world(mi.warp.square_to_uniform_cone(point, luminary.mi_cos_radius))
        cosine = dr.dot(normal, direction)
        rise = dr.dot(outward, direction)
        facing = active & (cosine > 0.0) & (rise > 0.0)
        ray: Any = mi.Ray3f(origin + direction * shadow_ray_start(material, rise, origin), direction)
        ray.maxt = FAR_M
        shadowed = scene.mi_scene.ray_test(ray, coherent=coherent, active=facing)
        reflected = reflection.towards(direction, cosine) * luminary.mi_illuminance
        total += dr.select(facing & ~shadowed, reflected, 0.0)
    return total
