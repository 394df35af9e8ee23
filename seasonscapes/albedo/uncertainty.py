"""How well each texel's albedo is known, and gaps closed in albedo, where the terrain explains it best.

A texel's variance comes from the information matrix of the closed form (its diagonal: what the pixels that show it, and the
light upon it, tell), scaled by how well the photographs were explained, plus a share of the albedo for what light cannot
tell. Texels without information are completed by a forest of trees over place, height, slope and aspect, whose spread is
their uncertainty; they are marked as completed, never passed off as measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.albedo.closed_form import HIGHEST, LOWEST, AlbedoFit, fill_nearest
from seasonscapes.albedo.forward import Land
from seasonscapes.albedo.shots import Shot

# What the gains, the haze and the sky leave unknown of every texel, relative.
_COMMON = 0.01
# A texel is measured where its standard deviation stays below this share of its albedo (plus 0.02), and it was seen by
# so many pixels.
_POOR, _FEWEST_PIXELS = 0.35, 0.5
_TREES, _MOST_EXAMPLES = 60, 60_000


@dataclass(frozen=True)
class KnownAlbedo:
    """An albedo with how well it is known.

    Parameters
    ----------
    albedo
        ``(R, S, 3)`` float32, complete where it lies on the terrain.
    sigma
        ``(R, S)`` float32 standard deviation (green); of completed texels that of the completion.
    sunlit
        ``(R, S)`` uint8 in how many photographs the texel was seen in direct sunlight.
    source
        ``(R, S)`` uint8, a key of `SOURCES`.
    """

    albedo: np.ndarray
    sigma: np.ndarray
    sunlit: np.ndarray
    source: np.ndarray


SOURCES = {0: "nothing known", 1: "measured", 2: "completed from the terrain"}


def texel_sigma(fit: AlbedoFit) -> np.ndarray:
    """Standard deviation ``(R, S)`` float32 of the albedo (green); infinite where nothing was seen."""
    with np.errstate(divide="ignore"):
        random = 1.0 / np.sqrt(fit.information.astype(float))
    # Neighbours share pixels, so a texel that no pixel has to itself is known worse than the diagonal says.
    shared = 1.0 + 1.0 / np.maximum(fit.seen, 1e-3)
    scale = max(1.0, float(np.nanmedian(fit.residual)) / 0.0135)
    sigma = np.hypot(scale * random * shared, _COMMON * fit.albedo[..., 1])
    return np.where((fit.seen > 0.0) & (fit.information > 0.0), sigma, np.inf).astype(np.float32)


def times_sunlit(shots: Sequence[Shot]) -> np.ndarray:
    """In how many photographs each texel was seen in direct sunlight ``(R, S)`` uint8."""
    shape = shots[0].footprints.shape
    count = np.zeros(shape[0] * shape[1], np.int32)
    for shot in shots:
        footprints = shot.footprints
        if not footprints.sunlit[shot.number]:
            continue
        seen = np.bincount(footprints.texel, footprints.share, len(count))
        lit = np.bincount(footprints.texel, footprints.sunlit[shot.number][0], len(count))
        count += (lit > 0.05 * seen) & (seen > 0.0)
    return np.minimum(count, 255).astype(np.uint8).reshape(shape)


def known_albedo(
    land: Land, shots: Sequence[Shot], fit: AlbedoFit, *, complete: bool = True, seed: int = 0
) -> KnownAlbedo:
    """The albedo of a fit, its uncertainty, and its gaps closed (or left at the median, where ``complete`` is off).

    Raises
    ------
    ValueError
        Where no texel at all is measured.
    """
    sigma = texel_sigma(fit)
    on_surface = np.zeros(land.shape[0] * land.shape[1], bool)
    on_surface[land.texel] = True
    on_surface = on_surface.reshape(land.shape)
    measured = (sigma < _POOR * fit.albedo[..., 1] + 0.02) & (fit.seen >= _FEWEST_PIXELS) & on_surface
    if not measured.any():
        raise ValueError("known_albedo: no texel is measured")
    albedo, source = fit.albedo.copy(), np.zeros(land.shape, np.uint8)
    source[measured] = 1
    gap = on_surface & ~measured
    albedo[~measured] = np.median(albedo[measured], axis=0)
    sigma = np.where(measured, sigma, np.inf)
    if complete and gap.any():
        guess, spread = completion(land, fit.albedo, measured, gap, seed=seed)
        albedo[gap], sigma[gap], source[gap] = guess, spread, 2
    if complete:
        # Bilinear look-ups at the rim reach texels beyond the surface.
        albedo = fill_nearest(albedo, (source > 0).astype(np.float32))
    return KnownAlbedo(albedo, sigma.astype(np.float32), times_sunlit(shots), source)


def terrain_features(land: Land) -> np.ndarray:
    """What albedo depends on at texels ``(N, 9)``: place, height, slope, aspect, and whether the ground is hollow."""
    normal, position = land.normal, land.position_m
    slope_deg = np.degrees(np.arccos(np.clip(normal[:, 2], -1.0, 1.0)))
    height = np.full(land.shape[0] * land.shape[1], np.nan, np.float32)
    height[land.texel] = position[:, 2]
    hollow = _hollow_m(height.reshape(land.shape)).ravel()[land.texel]
    # Two turned axes let trees, which cut along axes alone, follow slanting borders.
    east, north = position[:, 0], position[:, 1]
    return np.stack([east, north, east + north, east - north, position[:, 2], slope_deg, normal[:, 0], normal[:, 1], hollow],
                    axis=1).astype(np.float32)  # fmt: skip


def _hollow_m(height: np.ndarray) -> np.ndarray:
    """Depth below the surroundings [m]."""
    import cv2

    level = float(np.nanmedian(height))
    known = np.isfinite(height).astype(np.float32)
    filled = np.where(known > 0.0, height - level, 0.0).astype(np.float32)
    top, bottom = (cv2.GaussianBlur(values, (0, 0), 3.0) for values in (filled, known))
    return np.where(known > 0.0, top / np.maximum(bottom, 1e-6) - filled, 0.0)


def completion(land: Land, albedo: np.ndarray, measured: np.ndarray, gap: np.ndarray, *,
               seed: int = 0) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Albedo ``(G, 3)`` of texels in gaps from measured ones, and its standard deviation ``(G,)``.

    Extremely randomised trees (Geurts, Ernst & Wehenkel 2006, doi:10.1007/s10994-006-6226-1) over `terrain_features`, in
    logarithms. Their spread is scaled by the error of texels that were left out, block by block.
    """
    from sklearn.ensemble import ExtraTreesRegressor

    features = np.zeros((land.shape[0] * land.shape[1], 9), np.float32)
    features[land.texel] = terrain_features(land)
    known, wanted = np.flatnonzero(measured.ravel()), np.flatnonzero(gap.ravel())
    rng = np.random.default_rng(seed)
    if len(known) > _MOST_EXAMPLES:
        known = rng.choice(known, _MOST_EXAMPLES, replace=False)
    values = np.log(np.clip(albedo.reshape(-1, 3)[known], LOWEST, HIGHEST))

    def forest() -> ExtraTreesRegressor:
        return ExtraTreesRegressor(_TREES, min_samples_leaf=3, random_state=seed, n_jobs=1)

    def answer(trees, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        each = np.stack([tree.predict(features[which]) for tree in trees.estimators_])
        return np.exp(each).mean(axis=0), np.exp(each).std(axis=0)[:, 1]

    # Blocks, not single texels: a gap's neighbours are missing too.
    block = (known // land.shape[1] // 8) * 10007 + (known % land.shape[1]) // 8
    left_out = np.isin(block, rng.permutation(np.unique(block))[: max(1, len(np.unique(block)) // 5)])
    factor = 2.0
    if 50 < left_out.sum() < len(known) - 50:
        rest = forest().fit(features[known[~left_out]], values[~left_out])
        mean, spread = answer(rest, known[left_out])
        error = np.abs(mean[:, 1] - np.exp(values[left_out][:, 1]))
        factor = float(np.clip(np.median(error / np.maximum(spread, 1e-4)) / 0.6745, 0.5, 10.0))
    trees = forest().fit(features[known], values)
    parts = [answer(trees, wanted[i : i + 200_000]) for i in range(0, len(wanted), 200_000)]
    mean, spread = (np.concatenate(column) for column in zip(*parts, strict=True))
    return np.clip(mean, LOWEST, HIGHEST).astype(np.float32), (factor * spread).astype(np.float32)
