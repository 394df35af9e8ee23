"""Paths over a terrain under a far sun, moon and sky: what `radiance.path_trace` runs on lanes.

Mitsuba's general ``path`` spends half of its light samples on the sun and traces the other half towards points of the
sky. A landscape knows better: at every vertex the sun (and the moon) each get a shadow ray, and the sky is met by the
very ray that carries the path on, which a cosine-distributed sample suits well. Same expectation, same number of rays,
a small part of the noise.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.gbuffer import mi_rays
from seasonscapes.rendering.mitsuba_scene import LUMINARY_DISTANCE_M, RenderScene
from seasonscapes.rendering.sobol import hashed, sobol_pair, uniform
from seasonscapes.sky.illumination import Luminary

# Anything farther is the polygon of sun or moon, which only Mitsuba's own integrators look at.
FAR_M = 0.1 * LUMINARY_DISTANCE_M
# From the second vertex on, a path goes on with probability min(1, SURVIVAL √throughput). Measured best for equal time
# among 1 and 2 times √throughput and throughput itself, on albedo 0.1 to 0.5; the paths of snow are hardly cut.
SURVIVAL = 2.0
# Names of a vertex's decisions, as words for their hashes.
_PIXEL, _BOUNCE, _LOBE, _SURVIVAL, _LUMINARY = range(5)


def trace_block(
    scene: RenderScene,
    camera: Camera | Panorama,
    block: tuple[int, int, int, int],
    *,
    max_depth: int,
    seed: tuple[int, int],
) -> np.ndarray:
    """Sums over the samples of a block of rows, ``(height, W, 4)``: radiance [cd/m²] and samples that met terrain.

    Parameters
    ----------
    block
        First row, number of rows, first sample and number of samples of each pixel.
    seed
        Two words of 32 bits.
    """
    import mitsuba as mi

    top, height, first, count = block

    # Opaque numbers keep one compiled kernel for all blocks, sizes and seeds.
    def opaque(value: int) -> Any:
        return dr.opaque(mi.UInt32, int(value))

    lane = dr.arange(mi.UInt32, camera.width_px * height * count)
    samples, width = opaque(count), opaque(camera.width_px)
    pixel = lane // samples
    index = lane - pixel * samples + opaque(first)
    pixel += width * opaque(top)
    row = pixel // width
    key = hashed(hashed(pixel, opaque(seed[0])), opaque(seed[1]))
    offset = sobol_pair(hashed(key, _PIXEL), index)
    ray = mi_rays(camera, mi.Float(pixel - row * width) + offset.x, mi.Float(row) + offset.y)
    with dr.suspend_grad():
        radiance, met = _trace(scene, ray, (key, index), opaque(max_depth))
    channels = [*(dr.select(met, channel, 0.0) for channel in radiance), dr.select(met, mi.Float(1.0), 0.0)]
    # Evaluated together: summing an unevaluated channel would trace all the paths again for each of the four.
    dr.eval(channels)
    sums = [dr.block_sum(channel, count) for channel in channels]
    dr.eval(sums)
    return np.stack([np.array(values) for values in sums], axis=-1).reshape(height, camera.width_px, 4)


def _mi_luminary(luminary: Luminary) -> tuple[Any, Any, Any]:
    """Frame towards the body, cosine of its angular radius, and normal illuminance, as opaque lanes."""
    import mitsuba as mi

    def opaque(value: float) -> Any:
        return dr.opaque(mi.Float, float(value))

    frame = mi.Frame3f(mi.Vector3f(*map(opaque, luminary.direction)))
    illuminance = mi.Color3f(*map(opaque, luminary.normal_illuminance_lx))
    return frame, opaque(np.cos(np.radians(luminary.angular_radius_deg))), illuminance


def _luminaries(scene: RenderScene) -> list[tuple[Any, Any, Any]]:
    bodies = (scene.illumination.sun, scene.illumination.moon)
    found = [_mi_luminary(body) for body in bodies if body is not None and np.max(body.normal_illuminance_lx) > 0.0]
    emitters, expected = len(scene.mi_scene.emitters()), len(found) + (scene.mi_scene.environment() is not None)
    if emitters != expected:
        raise ValueError(f"scene: got {emitters} emitters, expected {expected}: none but sky, sun and moon are sampled")
    return found


def _trace(scene: RenderScene, ray: Any, draw: tuple[Any, Any], max_depth: Any) -> tuple[Any, Any]:
    """Radiance ``mi.Color3f`` along camera rays and whether they met terrain; ``draw`` is sample key and index."""
    import mitsuba as mi

    sample, index = draw
    mi_terrain, mi_sky, luminaries = scene.mi_terrain, scene.mi_scene.environment(), _luminaries(scene)

    def step(ray: Any, radiance: Any, throughput: Any, depth: Any, active: Any, met: Any) -> tuple:
        found = scene.mi_scene.ray_intersect_preliminary(ray, coherent=depth == 0, active=active)
        hit = active & found.is_valid() & (found.t < FAR_M)
        radiance += _sky_where(mi_sky, ray.d, throughput, active & ~hit & (depth > 0))
        met |= hit
        key = hashed(sample, depth)
        survival = dr.select(depth > 0, dr.minimum(SURVIVAL * dr.sqrt(dr.max(throughput)), 1.0), 1.0)
        active = hit & (depth + 1 < max_depth) & (uniform(hashed(key, _SURVIVAL)) < survival)
        throughput /= survival
        # Asked of the mesh itself: asked of the scene, each lane would first look up which shape it met.
        surface = mi_terrain.compute_surface_interaction(ray, found, mi.RayFlags.All, active)
        surface.sh_frame = mi.Frame3f(surface.sh_frame.n)
        surface.wi = surface.to_local(-ray.d)
        light = _light_of_luminaries(scene, luminaries, surface, (key, index, active, depth == 0))
        radiance += dr.select(active, throughput * light, 0.0)
        onward, weight = mi_terrain.bsdf().sample(
            mi.BSDFContext(), surface, uniform(hashed(key, _LOBE)), sobol_pair(hashed(key, _BOUNCE), index), active
        )
        throughput = dr.select(active, throughput * weight, throughput)
        ray = surface.spawn_ray(surface.to_world(onward.wo))
        return ray, radiance, throughput, depth + 1, active & (dr.max(throughput) > 0.0), met

    start = (mi.Ray3f(ray), mi.Color3f(0.0), mi.Color3f(1.0), mi.UInt32(0), mi.Bool(True), mi.Bool(False))
    _, radiance, _, _, _, met = dr.while_loop(start, lambda *state: state[4], step, label="path over terrain")
    return radiance, met


def _sky_where(mi_sky: Any, direction: Any, throughput: Any, escaped: Any) -> Any:
    """Radiance of the sky along a direction, weighted, and zero where the lane has not escaped."""
    import mitsuba as mi

    if mi_sky is None:
        return mi.Color3f(0.0)
    interaction = dr.zeros(mi.SurfaceInteraction3f)
    interaction.wi = -direction
    return dr.select(escaped, throughput * mi_sky.eval(interaction, escaped), 0.0)


def _light_of_luminaries(scene: RenderScene, luminaries: list, surface: Any, lanes: tuple) -> Any:
    """Radiance towards the viewer that sun and moon cause directly: one shadow ray for each."""
    import mitsuba as mi

    key, index, active, coherent = lanes
    total = mi.Color3f(0.0)
    for number, (frame, cosine, illuminance) in enumerate(luminaries):
        point = sobol_pair(hashed(key, _LUMINARY + number), index)
        direction = frame.to_world(mi.warp.square_to_uniform_cone(point, cosine))
        value = scene.mi_terrain.bsdf().eval(mi.BSDFContext(), surface, surface.to_local(direction), active)
        facing = active & (dr.max(value) > 0.0)
        ray = surface.spawn_ray(direction)
        ray.maxt = FAR_M
        shaded = scene.mi_scene.ray_test(ray, coherent=coherent, active=facing)
        total += dr.select(facing & ~shaded, value * illuminance, 0.0)
    return total
