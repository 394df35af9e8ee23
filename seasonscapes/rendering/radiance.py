"""Path tracing: the radiance that a camera sees, through the air, against the sky."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama, view_directions
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.backend import use_backend
from seasonscapes.rendering.gbuffer import GBuffer, trace_gbuffer
from seasonscapes.rendering.mitsuba_scene import RenderScene, background

# Samples in flight: about 50 MB on the LLVM backend; more are no faster.
LANES = 1 << 22
Progress = Callable[[float], None]


@dataclass(frozen=True)
class RenderedView:
    """A rendered view.

    Parameters
    ----------
    radiance
        ``(H, W, 3)`` scene-linear photometric Rec.709 [cd/m²]: terrain through the air over the sky.
    surface
        ``(H, W, 3)`` radiance leaving the terrain, before the air, weighted by ``coverage`` [cd/m²].
    coverage
        ``(H, W)`` share of each pixel that terrain covers.
    gbuffer
        First surfaces at pixel centres.
    provenance
        Plain values for the record: scene, camera, time, sun, sky, samples and the like; written to files.
    """

    radiance: np.ndarray
    surface: np.ndarray
    coverage: np.ndarray
    gbuffer: GBuffer
    provenance: dict = field(default_factory=dict)


def mi_path_integrator(max_depth: int) -> Any:
    """Mitsuba's own path tracer, for the variant without lanes. ``max_depth`` counts edges. Lights are not seen."""
    import mitsuba as mi

    return mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 64, "hide_emitters": True})


def path_trace(
    scene: RenderScene,
    camera: Camera | Panorama,
    *,
    spp: int = 64,
    seed: int = 0,
    max_depth: int = 6,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Radiance that leaves the terrain towards the camera ``(H, W, 3)`` [cd/m²] and coverage ``(H, W)``.

    Box-filtered over the pixel and, on the LLVM backend, bit-identical for equal arguments whatever the number of
    threads. Works through blocks of rows, so memory does not grow with image size.

    Parameters
    ----------
    spp
        Samples per pixel, at least 1.
    seed
        Any non-negative integer; equal seeds give equal images.
    max_depth
        Longest path in edges; 6 keeps four bounces between surfaces, 2 is direct light alone.
    progress
        Called with the share that is done.
    """
    if spp < 1 or max_depth < 2:
        raise ValueError(f"spp and max_depth: got {spp} and {max_depth}, expected spp ≥ 1 and max_depth ≥ 2")
    trace = _trace_block_scalar if use_backend().device == "scalar" else _trace_block
    rows = max(1, min(camera.height_px, LANES // (camera.width_px * spp)))
    blocks = [(top, min(rows, camera.height_px - top)) for top in range(0, camera.height_px, rows)]
    # Very wide or very deep blocks are also cut into passes of samples.
    samples = max(1, min(spp, LANES // camera.width_px))
    passes = [(done, min(samples, spp - done)) for done in range(0, spp, samples)]
    image = np.zeros((camera.height_px, camera.width_px, 4), np.float32)
    for b, (top, height) in enumerate(blocks):
        for p, (done, count) in enumerate(passes):
            part = trace(scene, camera, (top, height, done, count), max_depth=max_depth, seed=seed)
            # A sample that is not finite would poison its pixel; a geometry that makes one is a bug worth seeing.
            if not np.isfinite(part).all():
                raise FloatingPointError("path tracing gave values that are not finite; are albedo and light finite?")
            image[top : top + height] += part / spp
            if progress is not None:
                progress((b * len(passes) + p + 1) / (len(blocks) * len(passes)))
    return image[..., :3], np.clip(image[..., 3], 0.0, 1.0)


def _trace_block(
    scene: RenderScene, camera: Camera | Panorama, block: tuple[int, int, int, int], *, max_depth: int, seed: int
) -> np.ndarray:
    """Sums over the samples of one block of rows as ``(height, W, 4)``: radiance and coverage."""
    from seasonscapes.rendering.path_tracer import (
        trace_block,  # imports Dr.Jit, whose library `use_backend` chooses first
    )

    first, second = np.random.SeedSequence(seed).generate_state(2)
    return trace_block(scene, camera, block, max_depth=max_depth, seed=(first, second))


def _trace_block_scalar(
    scene: RenderScene, camera: Camera | Panorama, block: tuple[int, int, int, int], *, max_depth: int, seed: int
) -> np.ndarray:
    """The same through Mitsuba's own sensor and film, as the scalar variant knows no lanes."""
    import mitsuba as mi

    if isinstance(camera, Panorama):
        raise ValueError("the scalar variant renders pinhole cameras only; install a libLLVM for panoramas")
    if abs(camera.fx / camera.fy - 1.0) > 1e-6:
        raise ValueError("the scalar variant renders square pixels only; install a libLLVM for other cameras")
    top, height, first, count = block
    block_seed = int(np.random.SeedSequence((seed, top, first)).generate_state(1)[0])
    pose = camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba looks along +z with x to the left
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(2.0 * np.arctan(0.5 * camera.width_px / camera.fx))),
            "principal_point_offset_x": 0.5 - camera.cx / camera.width_px,
            "principal_point_offset_y": 0.5 - camera.cy / camera.height_px,
            "near_clip": 0.5,
            "far_clip": 1.0e7,
            "to_world": mi.ScalarTransform4f(pose),
            "sampler": {"type": "independent", "sample_count": count},
            "film": {
                "type": "hdrfilm",
                "width": camera.width_px,
                "height": camera.height_px,
                "crop_offset_x": 0,
                "crop_offset_y": top,
                "crop_width": camera.width_px,
                "crop_height": height,
                "pixel_format": "rgba",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        }
    )
    integrator = mi_path_integrator(max_depth)
    mean = mi.render(scene.mi_scene, sensor=sensor, integrator=integrator, spp=count, seed=block_seed)
    return np.array(mean, np.float32) * count


def render_view(
    scene: RenderScene,
    camera: Camera | Panorama,
    *,
    spp: int = 64,
    seed: int = 0,
    max_depth: int = 6,
    progress: Progress | None = None,
) -> RenderedView:
    """Path trace the terrain, look at it through the air, and put the sky behind it; see `path_trace`."""
    surface, coverage = path_trace(scene, camera, spp=spp, seed=seed, max_depth=max_depth, progress=progress)
    gbuffer = trace_gbuffer(scene, camera)
    return RenderedView(apply_aerial_perspective(scene, camera, surface, coverage, gbuffer), surface, coverage, gbuffer)


def apply_aerial_perspective(
    scene: RenderScene, camera: Camera | Panorama, surface: np.ndarray, coverage: np.ndarray, gbuffer: GBuffer
) -> np.ndarray:
    """Radiance ``(H, W, 3)`` at the camera of a terrain picture seen through the air, with the sky behind it.

    Each pixel's air is that of its centre's distance, except along silhouettes, where 4 × 4 distances are averaged:
    a far ridge and a near rock in one pixel have different air.
    """
    illumination = scene.illumination
    direction = view_directions(camera)
    open_sky = (1.0 - coverage)[..., None]
    image = surface.astype(np.float64)
    if illumination.aerial_perspective is not None:
        depth = np.where(np.isfinite(gbuffer.depth), gbuffer.depth, 0.0)
        transmittance, airlight = illumination.aerial_perspective(depth, direction)
        transmittance, airlight = np.array(transmittance, float), np.array(airlight, float)
        row, column = np.nonzero(_silhouettes(gbuffer.depth) & (coverage > 0.0))
        if row.size:
            transmittance[row, column], airlight[row, column] = _air_of_subpixels(scene, camera, row, column)
        image = image * transmittance + airlight * coverage[..., None]
    if np.any(open_sky > 0.0):
        pixel_angle_deg = float(np.degrees(1.0 / camera.fx))
        rows = np.any(open_sky[..., 0] > 0.0, axis=1)
        image[rows] += open_sky[rows] * background(illumination, direction[rows], pixel_angle_deg)
    return image.astype(np.float32)


def _silhouettes(depth: np.ndarray, ratio: float = 1.1) -> np.ndarray:
    """Pixels beside a jump of distance by more than ``ratio``, ``(H, W)`` bool."""
    finite = np.where(np.isfinite(depth), depth, 1e9)
    padded = np.pad(np.log(np.maximum(finite, 1e-3)), 1, mode="edge")
    neighbours = [padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]]
    centre = padded[1:-1, 1:-1]
    return np.max([np.abs(centre - other) for other in neighbours], axis=0) > np.log(ratio)


def _air_of_subpixels(
    scene: RenderScene, camera: Camera | Panorama, row: np.ndarray, column: np.ndarray, side: int = 4
):
    """Mean transmittance and airlight ``(N, 3)`` over the terrain-covered part of pixels, from side² distances each."""
    offset = (np.arange(side) + 0.5) / side
    dx, dy = (grid.ravel() for grid in np.meshgrid(offset, offset))
    pixel = np.stack([column[:, None] + dx, row[:, None] + dy], axis=-1)
    depth = trace_gbuffer(scene, camera, pixel).depth
    hit = np.isfinite(depth)
    transmittance, airlight = scene.illumination.aerial_perspective(
        np.where(hit, depth, 0.0), view_directions(camera, pixel)
    )
    weight = hit / np.maximum(hit.sum(axis=1, keepdims=True), 1)
    # No sub-ray met terrain: keep the coverage's rare sample unattenuated rather than black.
    missed = ~hit.any(axis=1)
    mean_transmittance = np.einsum("nk,nkc->nc", weight, transmittance)
    mean_transmittance[missed] = 1.0
    return mean_transmittance, np.einsum("nk,nkc->nc", weight, airlight)
