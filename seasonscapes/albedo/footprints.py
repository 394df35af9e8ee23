"""What a photograph's pixels are made of: each pixel as a weighted sum of texels, sunlit or not, through sub-pixel rays.

A pixel's radiance is linear in the texture: S rays fall within it, each meets the surface at a texture coordinate, and
the texture is bilinear there. Solving for texels against these sums (rather than against a photograph resampled onto the
texture) is worth 6 to 8 dB of albedo, because neither a pixel that covers many texels nor a texel that covers many
pixels is ever blurred.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.rendering.sun_visibility import cosine_seen, pixel_turn, sun_rays
from seasonscapes.rendering.view_samples import view_samples
from seasonscapes.sky.illumination import Luminary

# Sub-pixel rays in work at a time: their texels and weights take about 100 bytes each.
_BLOCK_RAYS = 1 << 20
Progress = Callable[[float], None]


@dataclass(frozen=True)
class Footprints:
    """The terrain pixels of one camera as sums over texels, under T positions of sun and moon. n pixels, Z entries.

    Parameters
    ----------
    camera
        The view.
    shape
        Rows and columns of the texture.
    pixel
        ``(n,)`` int32 flat index of pixels that show any terrain.
    coverage
        ``(n,)`` float32 share of the pixel's rays that met terrain.
    start
        ``(n + 1,)`` int32, where each pixel's entries begin (compressed rows).
    texel
        ``(Z,)`` int32 flat index of texels.
    share
        ``(Z,)`` float32: the pixel's mean texture value is Σ share · texel; rows sum to the coverage.
    sunlit
        Per light a list with one ``(Z,)`` float32 for each luminary: the same shares times cosine of incidence times
        visible part of its disc.
    lit
        ``(T, n)`` float32 share of each pixel's facing surface that sees the (first) luminary; NaN where none faces it.
    distance_m
        ``(n,)`` float32 mean distance of what the pixel shows [m].
    spread
        ``(n,)`` float32 farthest over nearest distance within the pixel.
    """

    camera: Camera
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
        """``(n, texels)`` sparse matrix with these entries ``(Z,)``; the pattern is shared, nothing is copied."""
        from scipy.sparse import csr_array

        size = (len(self.pixel), self.shape[0] * self.shape[1])
        return csr_array((values, self.texel, self.start), shape=size, copy=False)


def trace_footprints(
    terrain: RayScene,
    camera: Camera,
    shape: tuple[int, int],
    suns: Sequence[Sequence[Luminary]],
    *,
    rays: int = 16,
    seed: int = 0,
    progress: Progress | None = None,
) -> Footprints:
    """Footprints of a camera's pixels, sun by sun. Memory beyond the result does not grow with the picture.

    Parameters
    ----------
    terrain
        From `gather_hemisphere.occluder`. Its albedo plays no part.
    shape
        Rows and columns of the texture to be found.
    suns
        For each of T lights its luminaries (`reception.luminaries`): none, the sun, the moon or both.
    rays
        S rays in each pixel; powers of two are best.

    Raises
    ------
    ValueError
        Where the camera sees no terrain.
    """
    tell = progress or (lambda share: None)
    rows = max(1, _BLOCK_RAYS // (camera.width_px * rays))
    parts, lit = [], []
    for top in range(0, camera.height_px, rows):
        block = (top, min(rows, camera.height_px - top))
        points, hit, pixel = view_samples(terrain, camera, block, rays, seed)
        if len(pixel):
            columns, seen = _block_entries(terrain, camera, shape, (points, hit, pixel), suns)
            parts.append(columns)
            lit.append(seen)
        tell(min(1.0, (top + rows) / camera.height_px))
    if not parts:
        raise ValueError("the camera sees no terrain")
    pixel, coverage, count, texel, share, distance, spread = (np.concatenate([p[k] for p in parts]) for k in range(7))
    start = np.zeros(len(pixel) + 1, np.int32)
    np.cumsum(count, out=start[1:])
    sunlit = [
        [np.concatenate([p[7][t][b] for p in parts]) for b in range(len(bodies))] for t, bodies in enumerate(suns)
    ]
    return Footprints(
        camera, shape, pixel, coverage, start, texel, share, sunlit, np.concatenate(lit, axis=1), distance, spread
    )


def _block_entries(
    terrain: RayScene, camera: Camera, shape: tuple[int, int], samples: tuple, suns: Sequence[Sequence[Luminary]]
) -> tuple[tuple, np.ndarray]:
    """Columns of `Footprints` for a block of pixels, and its ``lit`` ``(T, n)``."""
    points, hit, pixel = samples
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
        (points.origin, points.normal, points.outward),
        hit.astype(np.float32),
        pixel_turn(pixel, camera.width_px, rays),
    )
    lit = np.full((len(suns), count), np.nan, np.float32)
    sunlit = []
    for t, bodies in enumerate(suns):
        sunlit.append([])
        for number, body in enumerate(bodies):
            seen = cosine_seen(shadow_rays, body)
            # Each sample's four corners share its cosine.
            values = np.bincount(entry, weight * np.repeat(seen.ravel(), 4), len(columns))
            sunlit[t].append(values.astype(np.float32))
            if number == 0:
                facing = np.maximum(points.normal @ np.asarray(body.direction, np.float32), 0.0) * hit
                with np.errstate(invalid="ignore", divide="ignore"):
                    lit[t] = np.clip((seen * hit).sum(axis=1) / facing.sum(axis=1), 0.0, 1.0)
    distance = np.linalg.norm(points.origin - camera.position_m.astype(np.float32), axis=2)
    nearest = np.where(hit, distance, np.inf).min(axis=1)
    farthest = np.where(hit, distance, 0.0).max(axis=1)
    mean = (distance * hit).sum(axis=1) / hit.sum(axis=1)
    columns = (
        pixel,
        hit.mean(axis=1, dtype=np.float32),
        np.diff(start),
        columns.astype(np.int32),
        share,
        mean.astype(np.float32),
        (farthest / np.maximum(nearest, 1e-3)).astype(np.float32),
        sunlit,
    )
    return columns, lit


def bilinear_texels(uv: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The four texels ``(N, 4)`` int64 (flat) around texture coordinates ``(N, 2)`` and their weights ``(N, 4)``.

    As `terrain.surface.sample_texture` and the renderer's own texture: centres at half texels, clamped at the rim.
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
    """Entries of equal row and texel become one: the new entry of each old one, starts of rows, texels of entries."""
    unique, entry = np.unique(row * texels + texel, return_inverse=True)
    start = np.searchsorted(unique, np.arange(rows + 1, dtype=np.int64) * texels).astype(np.int32)
    return entry, start, unique % texels


def seen_weight(footprints: Sequence[Footprints]) -> np.ndarray:
    """How many pixels each texel fills, summed over cameras, ``(R, S)`` float32; 0 where it is never seen."""
    total = np.zeros(footprints[0].shape[0] * footprints[0].shape[1])
    for one in footprints:
        total += np.bincount(one.texel, one.share, len(total))
    return total.reshape(footprints[0].shape).astype(np.float32)


def whole_pixels(footprints: Footprints, *, full: float = 0.999) -> np.ndarray:
    """Pixels ``(n,)`` bool that show terrain alone: sky in a pixel is brighter than any slope, and not sharp in a photograph."""
    return footprints.coverage >= full


def thinned_footprints(footprints: Footprints, keep: np.ndarray) -> Footprints:
    """The footprints of some of the pixels ``(n,)`` bool."""
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
