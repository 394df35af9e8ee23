"""Path tracing of a view: radiance at the camera, with aerial perspective and the sky behind the terrain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama, view_directions
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.backend import use_backend
from seasonscapes.rendering.gbuffer import GBuffer, trace_gbuffer
from seasonscapes.rendering.mitsuba_scene import RenderScene, sky_radiance_towards
from seasonscapes.sky.illumination import AerialPerspective

# Samples per kernel launch: about 50 MB on the LLVM backend; more are not faster.
LANES = 1 << 22
Progress = Callable[[float], None]


@dataclass(frozen=True)
class RenderedView:
    """A rendered view.

    Parameters
    ----------
    radiance
        ``(H, W, 3)`` radiance at the camera, scene-linear photometric Rec.709 [cd/m²]: terrain with aerial perspective
        in front of the sky.
    surface
        ``(H, W, 3)`` radiance that leaves the terrain, without aerial perspective, weighted by ``coverage`` [cd/m²].
    coverage
        ``(H, W)`` fraction of each pixel that terrain covers.
    gbuffer
        First surfaces at pixel centres.
    provenance
        Plain values that describe the rendering (scene, camera, time, sun, sky, samples), stored in image files.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> view = ss.render(place, ss.camera(place, "aerial", size_px=(48, 32)), "2024-07-20T13:30", sky="hosek", spp=1)
    >>> view.coverage.shape, view.gbuffer.depth.shape
    ((32, 48), (32, 48))
    """

    radiance: np.ndarray
    surface: np.ndarray
    coverage: np.ndarray
    gbuffer: GBuffer
    provenance: dict[str, Any] = field(default_factory=dict)


def mi_path_integrator(max_depth: int) -> Any:
    """Create Mitsuba's own path tracer, with directly visible lights hidden.

    Parameters
    ----------
    max_depth
        Longest path, in edges.

    Returns
    -------
    mi.Integrator
        Used by the scalar variant.
    """
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
    """Path trace the radiance that leaves the terrain towards the camera.

    Box-filtered over the pixel. On the LLVM backend the result is bit-identical for equal arguments, independently of
    the number of threads. Rendered in blocks of rows, so that memory does not grow with the image.

    Parameters
    ----------
    scene
        Terrain and illumination.
    camera
        The view.
    spp
        Samples per pixel, at least 1.
    seed
        Any non-negative integer; equal seeds give equal images.
    max_depth
        Longest path in edges, at least 2: 2 is direct light alone, 6 includes four bounces between surfaces.
    progress
        Called with the completed fraction.

    Returns
    -------
    radiance
        ``(H, W, 3)`` float32 [cd/m²], black in the sky.
    coverage
        ``(H, W)`` float32 fraction of each pixel that terrain covers.

    Raises
    ------
    ValueError
        If ``spp`` or ``max_depth`` is too small, the scene has no illumination, or the camera is not supported by the
        scalar variant.
    FloatingPointError
        If a radiance is not finite.
    """
    if spp < 1 or max_depth < 2:
        raise ValueError(f"spp and max_depth: got {spp} and {max_depth}, expected spp ≥ 1 and max_depth ≥ 2")
    trace = _trace_block_scalar if use_backend().device == "scalar" else _trace_block
    rows = max(1, min(camera.height_px, LANES // (camera.width_px * spp)))
    blocks = [range(top, min(top + rows, camera.height_px)) for top in range(0, camera.height_px, rows)]
    # Blocks of many samples per row are also divided into passes.
    samples = max(1, min(spp, LANES // camera.width_px))
    passes = [range(first, min(first + samples, spp)) for first in range(0, spp, samples)]
    image = np.zeros((camera.height_px, camera.width_px, 4), np.float32)
    for b, block_rows in enumerate(blocks):
        for p, block_samples in enumerate(passes):
            part = trace(scene, camera, block_rows, block_samples, max_depth=max_depth, seed=seed)
            if not np.isfinite(part).all():
                raise FloatingPointError("path_trace: radiance is not finite; check that albedo and light are finite")
            image[block_rows.start : block_rows.stop] += part / spp
            if progress is not None:
                progress((b * len(passes) + p + 1) / (len(blocks) * len(passes)))
    return image[..., :3], np.clip(image[..., 3], 0.0, 1.0)


def _trace_block(
    scene: RenderScene, camera: Camera | Panorama, rows: range, samples: range, *, max_depth: int, seed: int
) -> np.ndarray:
    """Sums over samples of a block of rows ``(len(rows), W, 4)``: radiance and coverage."""
    # Imports Dr.Jit, whose libLLVM `use_backend` must choose first.
    from seasonscapes.rendering.path_tracer import trace_block

    first, second = np.random.SeedSequence(seed).generate_state(2)
    return trace_block(scene, camera, rows, samples, max_depth=max_depth, seed=(first, second))


def _trace_block_scalar(
    scene: RenderScene, camera: Camera | Panorama, rows: range, samples: range, *, max_depth: int, seed: int
) -> np.ndarray:
    """Same as `_trace_block`, with Mitsuba's own sensor and film, for the scalar variant."""
    import mitsuba as mi

    if isinstance(camera, Panorama):
        raise ValueError("the scalar variant renders pinhole cameras only; install a libLLVM for panoramas")
    if abs(camera.fx / camera.fy - 1.0) > 1e-6:
        raise ValueError("the scalar variant renders square pixels only; install a libLLVM for other cameras")
    count = len(samples)
    block_seed = int(np.random.SeedSequence((seed, rows.start, samples.start)).generate_state(1)[0])
    pose = camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba's camera has z forward and x left
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
                "crop_offset_y": rows.start,
                "crop_width": camera.width_px,
                "crop_height": len(rows),
                "pixel_format": "rgba",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        }
    )
    integrator = mi_path_integrator(max_depth)
    # The stubs describe the vectorised variants, whose seed is an `mi.UInt32`.
    mean = mi.render(
        scene.mi_scene,
        sensor=sensor,
        integrator=integrator,
        spp=count,
        seed=block_seed,  # pyright: ignore[reportArgumentType]
    )
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
    """Render a view by path tracing, with aerial perspective and the sky behind the terrain.

    Parameters
    ----------
    scene
        Terrain and illumination.
    camera
        The view.
    spp, seed, max_depth, progress
        See `path_trace`.

    Returns
    -------
    RenderedView
        Radiance at the camera, radiance of the surface, coverage and G-buffer.

    Raises
    ------
    ValueError, FloatingPointError
        See `path_trace`.
    """
    surface, coverage = path_trace(scene, camera, spp=spp, seed=seed, max_depth=max_depth, progress=progress)
    gbuffer = trace_gbuffer(scene, camera)
    return RenderedView(apply_aerial_perspective(scene, camera, surface, coverage, gbuffer), surface, coverage, gbuffer)


def apply_aerial_perspective(
    scene: RenderScene, camera: Camera | Panorama, surface: np.ndarray, coverage: np.ndarray, gbuffer: GBuffer
) -> np.ndarray:
    """Apply aerial perspective to the radiance of the terrain and add the sky behind it.

    Aerial perspective is evaluated at the distance of the pixel centre. On silhouettes it is averaged over 4 × 4
    distances, because terrain at very different distances may share a pixel.

    Parameters
    ----------
    scene
        Terrain and illumination.
    camera
        The view.
    surface
        ``(H, W, 3)`` radiance that leaves the terrain, weighted by coverage [cd/m²].
    coverage
        ``(H, W)`` fraction of each pixel that terrain covers.
    gbuffer
        First surfaces at pixel centres.

    Returns
    -------
    numpy.ndarray
        ``(H, W, 3)`` float32 radiance at the camera [cd/m²].

    Raises
    ------
    ValueError
        If the scene has no illumination.
    """
    illumination = scene.illumination
    if illumination is None:
        raise ValueError(
            "apply_aerial_perspective: got a scene without illumination, expected one from `mitsuba_scene.relight`"
        )
    direction = view_directions(camera)
    open_sky = (1.0 - coverage)[..., None]
    image = surface.astype(np.float64)
    if illumination.aerial_perspective is not None:
        depth = np.where(np.isfinite(gbuffer.depth), gbuffer.depth, 0.0)
        transmittance, airlight = illumination.aerial_perspective(depth, direction)
        transmittance, airlight = np.array(transmittance, float), np.array(airlight, float)
        row, column = np.nonzero(_silhouettes(gbuffer.depth) & (coverage > 0.0))
        if row.size:
            transmittance[row, column], airlight[row, column] = _subpixel_air(
                scene, camera, illumination.aerial_perspective, row, column
            )
        image = image * transmittance + airlight * coverage[..., None]
    if np.any(open_sky > 0.0):
        pixel_angle_deg = float(np.degrees(1.0 / camera.fx))
        rows = np.any(open_sky[..., 0] > 0.0, axis=1)
        image[rows] += open_sky[rows] * sky_radiance_towards(illumination, direction[rows], pixel_angle_deg)
    return image.astype(np.float32)


def _silhouettes(depth: np.ndarray, ratio: float = 1.1) -> np.ndarray:
    """Pixels ``(H, W)`` whose distance differs from that of a neighbour by more than ``ratio``."""
    finite = np.where(np.isfinite(depth), depth, 1e9)
    padded = np.pad(np.log(np.maximum(finite, 1e-3)), 1, mode="edge")
    neighbours = [padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]]
    centre = padded[1:-1, 1:-1]
    return np.max([np.abs(centre - other) for other in neighbours], axis=0) > np.log(ratio)


def _subpixel_air(
    scene: RenderScene,
    camera: Camera | Panorama,
    air: AerialPerspective,
    row: np.ndarray,
    column: np.ndarray,
    side: int = 4,
) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance and airlight ``(N, 3)`` of pixels, averaged over the terrain hits among side² rays per pixel."""
    offset = (np.arange(side) + 0.5) / side
    dx, dy = (grid.ravel() for grid in np.meshgrid(offset, offset))
    pixel = np.stack([column[:, None] + dx, row[:, None] + dy], axis=-1)
    depth = trace_gbuffer(scene, camera, pixel).depth
    hit = np.isfinite(depth)
    transmittance, airlight = air(np.where(hit, depth, 0.0), view_directions(camera, pixel))
    weight = hit / np.maximum(hit.sum(axis=1, keepdims=True), 1)
    # If none of these rays hits terrain, the few samples that did stay unattenuated rather than black.
    missed = ~hit.any(axis=1)
    mean_transmittance = np.einsum("nk,nkc->nc", weight, transmittance)
    mean_transmittance[missed] = 1.0
    return mean_transmittance, np.einsum("nk,nkc->nc", weight, airlight)
