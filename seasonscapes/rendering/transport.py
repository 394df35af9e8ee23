"""Daylight coefficients: light transport traced once, so that each hour costs a few shadow rays and small products.

Light is linear. For every pixel (or texel) this keeps, per patch of sky, how much of that patch's radiance arrives
directly and by interreflection (Tregenza & Waters 1983, "Daylight coefficients", doi:10.1177/096032718301500201), in two
compact directional bases. Sun and moon are exact: shadow rays to points of their discs each time; only their
interreflection goes through the patches.

Radiance of a pixel = albedo / π · E, with the albedo of its visible surface kept apart: another albedo may be put in its
place. Interreflection uses the albedo that the terrain had when the coefficients were made.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering import bounces as between
from seasonscapes.rendering.bounces import DirectionBasis, direction_basis, label_rows
from seasonscapes.rendering.gather import Occluder, Points, gather, mi_surface, surface_points, unit_square
from seasonscapes.rendering.gbuffer import mi_rays
from seasonscapes.rendering.sky_patches import SkyPatches, sky_patches
from seasonscapes.sky.illumination import LUMINANCE_WEIGHTS

# Receivers in work at a time: with 256 rays each their labels take 70 MB.
BLOCK = 1 << 16
Progress = Callable[[float], None]


@dataclass(frozen=True)
class Effort:
    """How hard to try.

    Parameters
    ----------
    subpixels
        Samples in each pixel, a square; shadow rays start from them.
    rays
        Rays over the hemisphere of each receiver, a power of two.
    bounces
        Surfaces between receiver and light, beyond the receiver itself: 4 equals ``max_depth=6`` of the path tracer.
    clusters
        M, senders of interreflected light, a power of two.
    sky_rank, bounce_rank
        Coefficients kept per receiver for direct sky, and per channel for interreflection.
    patches
        Subdivision of the sky, a name in `sky_patches.SUBDIVISIONS`.
    """

    subpixels: int = 16
    rays: int = 256
    bounces: int = 4
    clusters: int = 8192
    sky_rank: int = 64
    bounce_rank: int = 32
    patches: str = "reinhart"

    def __post_init__(self):
        if round(self.subpixels**0.5) ** 2 != self.subpixels or self.rays & (self.rays - 1) or self.bounces < 0:
            raise ValueError("Effort: subpixels must be a square, rays a power of two, bounces not negative")
        if self.rays % self.subpixels:
            raise ValueError(f"Effort: {self.rays} rays cannot be shared evenly among {self.subpixels} subpixels")


@dataclass(frozen=True)
class SkyTransport:
    """How N receivers answer to the sky, in two bases of directions.

    Parameters
    ----------
    patches
        Name of the subdivision.
    direct
        ``(N, r)`` float16; irradiance / π = ``direct @ (direct_from_sky.T @ sky)`` for patch radiances ``(P, 3)``.
    direct_from_sky
        ``(P, r)`` float32.
    bounce
        ``(3, N, q)`` float16, the same for interreflected light of each channel.
    bounce_from_sky
        ``(P, q)`` float32.
    """

    patches: str
    direct: np.ndarray
    direct_from_sky: np.ndarray
    bounce: np.ndarray
    bounce_from_sky: np.ndarray


@dataclass(frozen=True)
class ViewCoefficients:
    """All that a view needs to be lit anew. n of its pixels show terrain; S samples lie in each.

    Parameters
    ----------
    camera
        The view.
    pixel
        ``(n,)`` int32 flat index of pixels that show any terrain.
    coverage
        ``(n,)`` float32 share of the pixel that is terrain.
    albedo
        ``(n, 3)`` float32 mean albedo over the pixel; sky counts as black.
    normal
        ``(n, 3)`` float32 mean of the samples' normals, weighted by ``sample_weight``.
    sample_origin
        ``(n, S, 3)`` float32, where shadow rays begin [m]; samples on terrain come first.
    sample_normal
        ``(n, S, 3)`` float16.
    sample_weight
        ``(n, S)`` float16 share of each sample in the pixel's reflected light, sum 1; 0 in the sky.
    sky
        Answer to the sky.
    seed, effort
        How they were made.
    """

    camera: Camera
    pixel: np.ndarray
    coverage: np.ndarray
    albedo: np.ndarray
    normal: np.ndarray
    sample_origin: np.ndarray
    sample_normal: np.ndarray
    sample_weight: np.ndarray
    sky: SkyTransport
    seed: int
    effort: Effort


@dataclass(frozen=True)
class Senders:
    """Interreflection prepared: the label of each face, what clusters send, and the two bases."""

    face_label: Any
    radiance: np.ndarray
    bounce: DirectionBasis
    direct: DirectionBasis


def trace_view(terrain: Occluder, camera: Camera, effort: Effort | None = None, *, seed: int = 0,
               progress: Progress | None = None) -> ViewCoefficients:  # fmt: skip
    """Daylight coefficients of a view.

    Memory beyond the result is bounded by `BLOCK`, whatever the size of the view.

    Parameters
    ----------
    terrain
        From `gather.occluder`; its albedo at this moment is used.
    progress
        Called with the share that is done.

    Raises
    ------
    ValueError
        Where no pixel shows terrain.
    """
    effort = effort or Effort()
    samples = _trace_samples(terrain, camera, effort.subpixels, seed)
    tell = progress or (lambda share: None)
    tell(0.05)
    receivers = Points(samples.sample_origin, samples.sample_normal, None, None)
    pilot = np.random.default_rng(seed).permutation(len(samples.pixel))[: 1 << 17]
    # Ray i of a pixel starts at sample i · S / K, so each sample has an aligned run of the sequence.
    senders = prepare_senders(terrain, _first_samples(samples, pilot), effort, seed=seed)
    tell(0.2)
    sky = _trace_sky(terrain, senders, receivers, samples.sample_weight, samples.pixel.astype(np.uint32), effort, seed,
                     lambda share: tell(0.2 + 0.8 * share))  # fmt: skip
    return replace(samples, sky=sky, effort=effort)


def _trace_samples(terrain: Occluder, camera: Camera, count: int, seed: int) -> ViewCoefficients:
    """The view without its answer to the sky."""
    rows = max(1, (1 << 22) // (camera.width_px * count))
    parts = [_sample_rows(terrain, camera, (top, min(rows, camera.height_px - top)), count, seed)
             for top in range(0, camera.height_px, rows)]  # fmt: skip
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    if len(columns[0]) == 0:
        raise ValueError("the camera sees no terrain")
    return ViewCoefficients(camera, *columns, sky=None, seed=seed, effort=Effort(subpixels=count))  # type: ignore[arg-type]


def _sample_rows(terrain: Occluder, camera: Camera, rows: tuple[int, int], count: int, seed: int) -> tuple:
    """Pixel, coverage, albedo, normal, sample_origin, sample_normal, sample_weight of a block of rows."""
    points, hit = _camera_points(terrain, camera, rows, count, seed)
    shape = (rows[1] * camera.width_px, count)
    hit = hit.reshape(shape)
    shown = hit.any(axis=1)
    pixel = (np.flatnonzero(shown) + rows[0] * camera.width_px).astype(np.int32)
    hit = hit[shown]
    # Terrain before sky, so that the first sample always is one.
    order = np.argsort(~hit, axis=1, kind="stable")
    origin, normal, albedo = (
        np.take_along_axis(values.reshape(*shape, 3)[shown], order[..., None], axis=1)
        for values in (points.origin, points.normal, points.albedo)
    )
    hit = np.take_along_axis(hit, order, axis=1)
    albedo, normal = np.where(hit[..., None], albedo, 0.0), np.where(hit[..., None], normal, 0.0)
    origin = np.where(hit[..., None], origin, origin[:, :1])
    weight = sample_weights(albedo, hit)
    mean_normal = np.einsum("ns,nsc->nc", weight, normal)
    return (pixel, hit.mean(axis=1).astype(np.float32), albedo.mean(axis=1).astype(np.float32),
            mean_normal.astype(np.float32), origin.astype(np.float32), normal.astype(np.float16),
            weight.astype(np.float16))  # fmt: skip


def sample_weights(albedo: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Each sample's share of its pixel's albedo ``(n, S)``, by luminance; equal shares where all are black."""
    shade = albedo @ LUMINANCE_WEIGHTS.astype(np.float32)
    shade = np.where((shade.sum(axis=1) > 0.0)[:, None], shade, hit)
    return (shade / shade.sum(axis=1, keepdims=True)).astype(np.float32)


def _camera_points(terrain: Occluder, camera: Camera, rows: tuple[int, int], count: int,
                   seed: int) -> tuple[Points, np.ndarray]:  # fmt: skip
    """Surfaces under stratified samples of rows of pixels, samples of a pixel side by side, and which met terrain."""
    import drjit as dr
    import mitsuba as mi

    top, height = rows
    side = round(count**0.5)
    lane = dr.arange(mi.UInt32, camera.width_px * height * count)
    index, sample = lane // dr.opaque(mi.UInt32, count), lane % dr.opaque(mi.UInt32, count)
    width = dr.opaque(mi.UInt32, camera.width_px)
    row, column = index // width, index % width
    key = lane + dr.opaque(mi.UInt32, top) * width * dr.opaque(mi.UInt32, count)
    jitter = unit_square(*mi.sample_tea_32(key, dr.opaque(mi.UInt32, seed)))
    cell_y, cell_x = sample // dr.opaque(mi.UInt32, side), sample % dr.opaque(mi.UInt32, side)
    across = dr.opaque(mi.Float, 1.0 / side)
    x = mi.Float(column) + (mi.Float(cell_x) + jitter.x) * across
    y = mi.Float(row + dr.opaque(mi.UInt32, top)) + (mi.Float(cell_y) + jitter.y) * across
    interaction = terrain.mi_scene.ray_intersect(mi_rays(camera, x, y))
    valid = interaction.is_valid()
    surface = mi_surface(interaction, valid)
    dr.eval(surface, valid)
    return surface_points(surface), np.array(valid)


def view_albedo(terrain: Occluder, coefficients: ViewCoefficients) -> np.ndarray:
    """Mean albedo ``(n, 3)`` of the pixels for the albedo that the terrain has now (another season's)."""
    samples = _trace_samples(terrain, coefficients.camera, coefficients.effort.subpixels, coefficients.seed)
    return samples.albedo


def _first_samples(samples: ViewCoefficients, index: np.ndarray) -> Points:
    normal = samples.sample_normal[index, 0].astype(np.float32)
    return Points(samples.sample_origin[index, 0], normal, np.ones_like(normal), np.zeros(len(index), np.uint32))


def prepare_senders(terrain: Occluder, pilot: Points, effort: Effort, *, seed: int = 0) -> Senders:
    """Clusters that send interreflected light to receivers like ``pilot``, and bases of directions fit for them."""
    import mitsuba as mi

    patches = sky_patches(effort.patches)
    faces = face_geometry(terrain.mi_terrain)
    zero = mi.UInt32(np.zeros(len(faces[0]), np.uint32))
    few = slice(0, 4096)
    labels = gather(terrain, patches, pilot.origin[few], pilot.normal[few], rays=512,
                    first=np.zeros(len(pilot.origin[few]), np.uint32),
                    scramble=np.arange(len(pilot.origin[few]), dtype=np.uint32), face_label=zero)  # fmt: skip
    rows = label_rows(labels, np.float32(1.0 / 512.0), patches.size).toarray()
    direct = _unit_columns(direction_basis(rows, patches, effort.sky_rank), rows)
    if effort.bounces == 0:
        nothing = DirectionBasis(np.zeros((patches.size, 1)), np.zeros((patches.size, 1)))
        return Senders(zero, np.zeros((3, 1, 1), np.float32), nothing, direct)
    hits, weight = between.pilot_hits(terrain, pilot, effort.bounces, seed)
    if len(weight) == 0:
        nothing = DirectionBasis(np.zeros((patches.size, 1)), np.zeros((patches.size, 1)))
        return Senders(zero, np.zeros((3, 1, 1), np.float32), nothing, direct)
    clusters = between.build_clusters(hits, weight, faces, effort.clusters, seed=seed)
    label = mi.UInt32(clusters.of_face)
    radiance, basis = between.cluster_radiance(terrain, patches, clusters, label, bounces=effort.bounces,
                                               rank=effort.bounce_rank, seed=seed)  # fmt: skip
    scale = 1.0 / np.maximum(radiance.reshape(-1, radiance.shape[-1]).std(axis=0), 1e-12)
    basis = DirectionBasis(basis.into * scale, basis.from_sky / scale)
    return Senders(label, (radiance * scale).astype(np.float32), basis, direct)


def _unit_columns(basis: DirectionBasis, rows: np.ndarray) -> DirectionBasis:
    """The same basis with coefficients of about 1, where half precision is at its best."""
    scale = 1.0 / np.maximum((rows @ basis.into).std(axis=0), 1e-12)
    return DirectionBasis(basis.into * scale, basis.from_sky / scale)


def face_geometry(mi_terrain: Any) -> tuple[np.ndarray, np.ndarray]:
    """Centroids and unit normals ``(F, 3)`` float32 of a mesh's faces."""
    import mitsuba as mi

    parameters = mi.traverse(mi_terrain)
    vertices = np.array(parameters["vertex_positions"]).reshape(-1, 3)
    corners = vertices[np.array(parameters["faces"]).reshape(-1, 3)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    return corners.mean(axis=1).astype(np.float32), normal.astype(np.float32)


def _trace_sky(terrain: Occluder, senders: Senders, receivers: Points, weight: np.ndarray, identity: np.ndarray,
               effort: Effort, seed: int, tell: Progress) -> SkyTransport:  # fmt: skip
    """Direct and interreflected answers of receivers with S places each, origins and normals ``(N, S, 3)``."""
    patches = sky_patches(effort.patches)
    count, places = weight.shape
    each = effort.rays // places
    direct = np.empty((count, senders.direct.into.shape[1]), np.float16)
    bounce = np.empty((3, count, senders.bounce.into.shape[1]), np.float16)
    into = senders.direct.into.astype(np.float32)
    for start in range(0, count, BLOCK):
        part = slice(start, start + BLOCK)
        shares = np.asarray(weight[part], np.float32)
        n = len(shares)
        labels = gather(
            terrain, patches, receivers.origin[part].reshape(-1, 3),
            np.asarray(receivers.normal[part], np.float32).reshape(-1, 3), rays=each,
            first=np.tile(np.arange(places, dtype=np.uint32) * np.uint32(each), n),
            scramble=np.repeat(identity[part] + np.uint32(seed * 7919 % 2**31), places), face_label=senders.face_label,
        )  # fmt: skip
        labels = labels.reshape(n, places * each)
        ray_weight = np.repeat(shares / each, each, axis=1)
        direct[part] = label_rows(labels, ray_weight, patches.size) @ into
        arriving = label_rows(labels, ray_weight, senders.radiance.shape[1], first=patches.size)
        for channel in range(3):
            bounce[channel, part] = arriving @ senders.radiance[channel]
        tell(min(1.0, (start + n) / count))
    return SkyTransport(patches.name, direct, senders.direct.from_sky.astype(np.float32), bounce,
                        senders.bounce.from_sky.astype(np.float32))  # fmt: skip


def arriving_from_patches(sky: SkyTransport, radiance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of patch radiances ``(P, 3)`` in the two bases: ``(r, 3)`` and ``(q, 3)`` float32."""
    return (sky.direct_from_sky.T @ radiance).astype(np.float32), (sky.bounce_from_sky.T @ radiance).astype(np.float32)
