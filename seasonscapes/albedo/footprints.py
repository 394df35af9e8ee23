"""Pixel footprints: each terrain pixel of a photograph as a weighted sum of texels, sunlit or not, by sub-pixel rays.

The radiance of a pixel is linear in the texture: S rays are cast within the pixel, each hits the surface at a texture
coordinate, and the texture is interpolated bilinearly there. Solving for texels against these sums, instead of
resampling the photograph onto the texture first, blurs neither a pixel that covers many texels nor a texel that covers
many pixels (`benchmarks/albedo.py` compares both).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.errors import NoTerrainInView
from seasonscapes.rendering.hemisphere_rays import RayScene, SurfacePoints
from seasonscapes.rendering.sun_visibility import bayer_disc_offset, sun_rays, visible_cosine
from seasonscapes.rendering.view_samples import view_samples
from seasonscapes.sky.illumination import Luminary

# Sub-pixel rays processed at a time: their texels and weights take about 100 bytes each.
_BLOCK_RAYS = 1 << 20
Progress = Callable[[float], None]


@dataclass(frozen=True)
class Footprints:
    """The n terrain pixels of one camera as sums over texels with Z entries, under T positions of sun and moon.

    Parameters
    ----------
    camera
        The view; ``None`` where the pixels are the texels of a painted texture.
    shape
        Rows and columns of the texture.
    pixel
        ``(n,)`` int32 flat index of pixels that contain terrain.
    coverage
        ``(n,)`` float32 fraction of the pixel's rays that hit terrain.
    start
        ``(n + 1,)`` int32 first entry of each pixel (compressed rows).
    texel
        ``(Z,)`` int32 flat index of texels.
    share
        ``(Z,)`` float32: the mean texture value of a pixel is Σ share · texel; rows sum to the coverage.
    sunlit
        For each light a list with one ``(Z,)`` float32 per luminary: the same weights times cosine of incidence times
        visible fraction of the luminary's disc.
    lit
        ``(T, n)`` float32 fraction of each pixel's surface facing the (first) luminary from which the luminary is
        visible; NaN where no surface faces it.
    distance_m
        ``(n,)`` float32 mean distance of the terrain in the pixel [m].
    spread
        ``(n,)`` float32 farthest over nearest distance within the pixel.
    """

    camera: Camera | Panorama | None
    shape: tuple[int, int]
    pixel: np.ndarray
    coverage: np.ndarray
    start: np.ndarray
    texel: np.ndarray
    share: np.ndarray
    sunlit: list[list[np.ndarray]]
    lit: np.ndarray
    distance_m: np.ndarray
    spread: np.ndarray

    def matrix(self, values: np.ndarray) -> Any:
        """Return the ``(n, R·S)`` sparse matrix with entries ``values (Z,)``; the pattern is shared, not copied."""
        from scipy.sparse import csr_array

        size = (len(self.pixel), self.shape[0] * self.shape[1])
        return csr_array((values, self.texel, self.start), shape=size, copy=False)


@dataclass(frozen=True)
class _Block:
    """Columns of `Footprints` for a block of pixels, with the number of entries in place of their start."""

    pixel: np.ndarray
    coverage: np.ndarray
    entries: np.ndarray
    texel: np.ndarray
    share: np.ndarray
    sunlit: list[list[np.ndarray]]
    lit: np.ndarray
    distance_m: np.ndarray
    spread: np.ndarray


def trace_footprints(
    terrain: RayScene,
    camera: Camera | Panorama,
    shape: tuple[int, int],
    luminaries: Sequence[Sequence[Luminary]],
    *,
    rays: int = 16,
    seed: int = 0,
    progress: Progress | None = None,
) -> Footprints:
    """Trace the footprints of a camera's pixels in blocks of bounded memory.

    Parameters
    ----------
    terrain
        Terrain from `hemisphere_rays.ray_scene`. Its albedo has no influence.
    camera
        The view.
    shape
        Rows and columns of the unknown texture.
    luminaries
        For each of T lights its luminaries (`receivers.luminaries`): none, the sun, the moon or both.
    rays
        S rays in each pixel; powers of two are best.
    seed
        Seed of the positions of rays within their pixels.
    progress
        Called with the finished fraction.

    Returns
    -------
    Footprints
        Weights of all texels in all terrain pixels.

    Raises
    ------
    NoTerrainInView
        If no ray of the camera hits the terrain.
    """
    report = progress or (lambda fraction: None)
    rows = max(1, _BLOCK_RAYS // (camera.width_px * rays))
    blocks = []
    for top in range(0, camera.height_px, rows):
        points, hit, pixel = view_samples(terrain, camera, range(top, min(top + rows, camera.height_px)), rays, seed)
        if len(pixel):
            blocks.append(_block_entries(terrain, camera, shape, points, hit, pixel, luminaries))
        report(min(1.0, (top + rows) / camera.height_px))
    if not blocks:
        raise NoTerrainInView("trace_footprints: no terrain in the camera's view; check the pose of the camera")

    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(block, name) for block in blocks])

    pixel = joined("pixel")
    start = np.zeros(len(pixel) + 1, np.int32)
    np.cumsum(joined("entries"), out=start[1:])
    sunlit = [
        [np.concatenate([block.sunlit[t][b] for block in blocks]) for b in range(len(bodies))]
        for t, bodies in enumerate(luminaries)
    ]
    return Footprints(
        camera,
        shape,
        pixel,
        joined("coverage"),
        start,
        joined("texel"),
        joined("share"),
        sunlit,
        np.concatenate([block.lit for block in blocks], axis=1),
        joined("distance_m"),
        joined("spread"),
    )


def _block_entries(
    terrain: RayScene,
    camera: Camera | Panorama,
    shape: tuple[int, int],
    points: SurfacePoints,
    hit: np.ndarray,
    pixel: np.ndarray,
    luminaries: Sequence[Sequence[Luminary]],
) -> _Block:
    """Footprints of pixels ``(n,)`` from their surface samples and hits ``(n, S)``."""
    count, rays = hit.shape
    texel, weight = bilinear_texels(points.uv.reshape(-1, 2), shape)
    weight *= np.where(hit.ravel(), np.float32(1.0 / rays), np.float32(0.0))[:, None]
    entry, start, columns = _merged(
        np.repeat(np.arange(count, dtype=np.int64), rays * 4), texel.ravel(), count, shape[0] * shape[1]
    )
    weight = weight.ravel()
    share = np.bincount(entry, weight, len(columns)).astype(np.float32)
    shadow_rays = sun_rays(
        terrain,
        points.origin,
        points.normal,
        points.geometric_normal,
        hit.astype(np.float32),
        bayer_disc_offset(pixel, camera.width_px, rays),
    )
    lit = np.full((len(luminaries), count), np.nan, np.float32)
    sunlit = []
    for t, bodies in enumerate(luminaries):
        sunlit.append([])
        for number, body in enumerate(bodies):
            cosine = visible_cosine(shadow_rays, body)
            # The four texels of a sample share its cosine.
            values = np.bincount(entry, weight * np.repeat(cosine.ravel(), 4), len(columns))
            sunlit[t].append(values.astype(np.float32))
            if number == 0:
                facing = np.maximum(points.normal @ np.asarray(body.direction, np.float32), 0.0) * hit
                with np.errstate(invalid="ignore", divide="ignore"):
                    lit[t] = np.clip((cosine * hit).sum(axis=1) / facing.sum(axis=1), 0.0, 1.0)
    distance = np.linalg.norm(points.origin - camera.position_m.astype(np.float32), axis=2)
    nearest = np.where(hit, distance, np.inf).min(axis=1)
    farthest = np.where(hit, distance, 0.0).max(axis=1)
    mean = (distance * hit).sum(axis=1) / hit.sum(axis=1)
    return _Block(
        pixel,
        hit.mean(axis=1, dtype=np.float32),
        np.diff(start),
        columns.astype(np.int32),
        share,
        sunlit,
        lit,
        mean.astype(np.float32),
        (farthest / np.maximum(nearest, 1e-3)).astype(np.float32),
    )


def bilinear_texels(uv: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Compute the texels and weights of bilinear interpolation.

    As `terrain.surface.sample_texture` and the renderer's texture: texel centres at +0.5, clamped at the border.

    Parameters
    ----------
    uv
        ``(N, 2)`` texture coordinates, v upwards.
    shape
        Rows and columns of the texture.

    Returns
    -------
    tuple of numpy.ndarray
        Flat texel indices ``(N, 4)`` int64 and weights ``(N, 4)`` float32.
    """
    height, width = shape
    x, y = uv[:, 0] * width - 0.5, (1.0 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x), np.floor(y)
    fx, fy = (x - left).astype(np.float32), (y - top).astype(np.float32)
    x0, y0 = (np.clip(left, 0, width - 1).astype(np.int64), np.clip(top, 0, height - 1).astype(np.int64))
    x1, y1 = np.clip(left + 1, 0, width - 1).astype(np.int64), np.clip(top + 1, 0, height - 1).astype(np.int64)
    texel = np.stack([y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1], axis=1)
    weight = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=1)
    return texel, weight


def _merged(row: np.ndarray, texel: np.ndarray, rows: int, texels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Merge entries of equal row and texel: the new entry of each old one, starts of rows, texels of new entries."""
    unique, entry = np.unique(row * texels + texel, return_inverse=True)
    start = np.searchsorted(unique, np.arange(rows + 1, dtype=np.int64) * texels).astype(np.int32)
    return entry, start, unique % texels


def texel_pixel_count(used: Iterable[tuple[Footprints, np.ndarray]]) -> np.ndarray:
    """Count the pixels that each texel covers, summed over cameras.

    A pixel of a camera counts once, however many of the camera's photographs use it.

    Parameters
    ----------
    used
        Footprints of each photograph, all of one texture shape, and which of their terrain pixels it uses, ``(n,)`` bool.

    Returns
    -------
    numpy.ndarray
        ``(R, S)`` float32 fractional pixel counts; 0 where no used pixel contains the texel.
    """
    cameras: dict[int, tuple[Footprints, np.ndarray]] = {}
    for footprints, pixels in used:
        _, before = cameras.get(id(footprints), (footprints, pixels))
        cameras[id(footprints)] = (footprints, np.logical_or(pixels, before))
    shape = next(iter(cameras.values()))[0].shape
    total = np.zeros(shape[0] * shape[1])
    for footprints, pixels in cameras.values():
        share = footprints.share * np.repeat(pixels, np.diff(footprints.start))
        total += np.bincount(footprints.texel, share, len(total))
    return total.reshape(shape).astype(np.float32)


def whole_pixels(footprints: Footprints, *, full: float = 0.999) -> np.ndarray:
    """Select the pixels that contain terrain only.

    Sky within a pixel is brighter than any slope, and photographs are not sharp, so mixed pixels are unusable.

    Parameters
    ----------
    footprints
        Footprints of one camera.
    full
        Least coverage of a selected pixel.

    Returns
    -------
    numpy.ndarray
        ``(n,)`` bool.
    """
    return footprints.coverage >= full


def thinned_footprints(footprints: Footprints, keep: np.ndarray) -> Footprints:
    """Restrict footprints to a subset of their pixels.

    Parameters
    ----------
    footprints
        Footprints of one camera, n pixels.
    keep
        ``(n,)`` bool.

    Returns
    -------
    Footprints
        Footprints of the kept pixels only.
    """
    count = np.diff(footprints.start)
    entries = np.repeat(keep, count)
    start = np.zeros(int(keep.sum()) + 1, np.int32)
    np.cumsum(count[keep], out=start[1:])
    return replace(
        footprints,
        pixel=footprints.pixel[keep],
        coverage=footprints.coverage[keep],
        start=start,
        texel=footprints.texel[entries],
        share=footprints.share[entries],
        sunlit=[[values[entries] for values in bodies] for bodies in footprints.sunlit],
        lit=footprints.lit[:, keep],
        distance_m=footprints.distance_m[keep],
        spread=footprints.spread[keep],
    )
