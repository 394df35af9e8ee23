"""Visibility of the sun per texel of a lit image: predicted shadows whose borders follow the image.

Heights that are coarser than the image put the borders of shadows a few texels off. Here the visibility v of each texel
is an unknown of a few levels. Its cost is the prior of the prediction, blurred by the uncertainty of its borders, and,
between neighbouring texels, the truncated difference of the logarithms of the albedos that follow from their
visibilities, ``log(π L) − log(v · sun + ambient)``: a true border between sun and shade is where brightness and colour
change as sunlight does, and land beyond it continues. The sum is minimised by loopy belief propagation (min-sum,
Felzenszwalb & Huttenlocher 2006, International Journal of Computer Vision 70, 41).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

# Texels on a side of a tile, and of the margin that overlaps its neighbours: as far as messages carry.
_TILE, _MARGIN = 384, 24
# A texel far from every predicted border may still be in a shadow that the heights do not contain, at these odds.
_SURPRISE = 0.002
# Samples across the standard deviation of what counts as around.
_SAMPLES_PER_SIGMA = 6.0
# Squared deviations of three features, in their spreads, that are nothing unusual.
_USUAL = 9.0
# Texels of which the prediction is sure tell what land is around; rounds of weights; least spreads of its features.
_SURE, _LAND_ROUNDS, _LEAST_SPREAD = 0.95, 3, np.array([0.3, 0.1, 0.1], np.float32)


@dataclass(frozen=True)
class BorderModel:
    """Weights of the cost of `refined_visibility`.

    Parameters
    ----------
    levels
        Number of levels of the visibility, 0 and 1 included.
    border_texels
        Standard deviation of the position of predicted borders [texels].
    contrast
        Typical difference of log albedo between neighbouring texels.
    truncation
        Largest cost of such a difference: that of a border of the land itself.
    smoothness
        Cost of a full step of visibility between neighbours.
    penumbra
        Cost of a half-lit texel.
    iterations
        Rounds of messages.
    land
        Largest cost of an albedo that is unlike that of the land around, in brightness or colour; 0 leaves it out.
    land_texels
        Standard deviation of what counts as around [texels].
    """

    levels: int = 5
    border_texels: float = 1.0
    contrast: float = 0.3
    truncation: float = 6.0
    smoothness: float = 0.3
    penumbra: float = 1.0
    iterations: int = 20
    land: float = 4.0
    land_texels: float = 24.0


def refined_visibility(
    log_radiance: np.ndarray,
    sun: np.ndarray,
    ambient: np.ndarray,
    predicted: np.ndarray,
    chart: np.ndarray,
    *,
    model: BorderModel | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the visibility of the sun from a lit image and a prediction of its shadows.

    Parameters
    ----------
    log_radiance
        ``(R, S, 3)`` natural logarithm of π × radiance [cd/m²].
    sun
        ``(R, S, 3)`` illuminance by the sun without cast shadows [lx].
    ambient
        ``(R, S, 3)`` illuminance by sky and interreflection [lx], positive.
    predicted
        ``(R, S)`` predicted visibility in [0, 1].
    chart
        ``(R, S)`` integers: neighbouring texels of equal number ≥ 0 adjoin on the surface; −1 where the radiance is
        unknown.
    model
        Weights; defaults if ``None``.
    progress
        Called with the finished fraction.

    Returns
    -------
    visibility, deviation : numpy.ndarray
        ``(R, S)`` float32 each: mean and standard deviation of the visibility. Where ``chart`` is −1 they are those of
        the prediction.
    """
    model, report = model or BorderModel(), progress or (lambda fraction: None)
    known = chart >= 0
    # Weighted by the surface, so that the surroundings of a chart do not darken its rim.
    share = gaussian_filter(known.astype(np.float32), model.border_texels)
    prior = gaussian_filter(np.where(known, predicted, 0.0).astype(np.float32), model.border_texels)
    prior = np.clip(prior / np.maximum(share, 1e-3), _SURPRISE, 1.0 - _SURPRISE)
    mean = np.where(known, prior, predicted).astype(np.float32)
    deviation = np.sqrt(mean * (1.0 - mean))
    land = _land_around(log_radiance, sun, ambient, prior, known, model)
    tiles = list(_tiles(chart.shape))
    for number, (outer, inner, within) in enumerate(tiles):
        lit = known[outer] & (sun[outer].max(axis=2) > 0.0)
        # A tile all in sun, or all in shade, has no border to refine.
        if lit.any() and np.ptp(prior[outer][lit]) > 0.0:
            mean_here, deviation_here = _propagated(
                log_radiance[outer], sun[outer], ambient[outer], prior[outer], chart[outer], land[outer], model
            )
            change = known[inner]
            mean[inner] = np.where(change, mean_here[within], mean[inner])
            deviation[inner] = np.where(change, deviation_here[within], deviation[inner])
        report((number + 1) / len(tiles))
    return mean, deviation


def _tiles(shape: tuple[int, ...]) -> Iterator[tuple[tuple[slice, slice], ...]]:
    """Slices of the tile with its margin, of the tile itself, and of the tile within its margin."""
    for top in range(0, shape[0], _TILE):
        for left in range(0, shape[1], _TILE):
            outer, inner, within = [], [], []
            for start, size in ((top, shape[0]), (left, shape[1])):
                stop = min(start + _TILE, size)
                low, high = max(start - _MARGIN, 0), min(stop + _MARGIN, size)
                outer.append(slice(low, high))
                inner.append(slice(start, stop))
                within.append(slice(start - low, stop - low))
            yield (outer[0], outer[1]), (inner[0], inner[1]), (within[0], within[1])


def _propagated(
    log_radiance: np.ndarray,
    sun: np.ndarray,
    ambient: np.ndarray,
    prior: np.ndarray,
    chart: np.ndarray,
    land: np.ndarray,
    model: BorderModel,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation ``(h, w)`` of the visibility of one tile."""
    levels = np.linspace(0.0, 1.0, model.levels, dtype=np.float32)
    known = chart >= 0
    # Planes of levels come first: sums and minima over levels then run along contiguous memory.
    features = np.stack([_features(log_radiance, level * sun + ambient) for level in levels])
    unary = np.stack(
        [
            model.penumbra * 4.0 * level * (1.0 - level) - np.log(level * prior + (1.0 - level) * (1.0 - prior))
            for level in levels
        ]
    )
    if model.land > 0.0:
        # Land varies: only what lies beyond its usual spread counts.
        unlike = np.maximum((((features - land[..., :3]) / land[..., 3:]) ** 2).sum(axis=-1) - _USUAL, 0.0)
        unary += model.land * unlike / (unlike + 2.0 * model.land)
    unary = np.where(known, unary, 0.0).astype(np.float32)
    costs, joined = [], []
    for axis in (0, 1):
        one, other = _neighbours(chart, axis)
        joined.append((one == other) & (one >= 0))
        first, second = _neighbours(features, axis)
        cost = np.empty((model.levels, model.levels, *joined[axis].shape), np.float32)
        for k in range(model.levels):
            for m in range(model.levels):
                difference = np.abs(first[k] - second[m]).sum(axis=-1) / np.float32(model.contrast)
                step = np.float32(model.smoothness * abs(levels[k] - levels[m]))
                np.minimum(difference, np.float32(model.truncation), out=cost[k, m])
                cost[k, m] += step
        costs.append(cost)
    belief = _min_sum(unary, costs, joined, model.iterations)
    # Sharper than the beliefs: a share of a few hundredths of sun would darken the albedo of shade by a tenth.
    weight = np.exp(-5.0 * belief)
    weight /= weight.sum(axis=0)
    mean = np.tensordot(levels, weight, axes=(0, 0))
    return mean, np.sqrt(np.maximum(np.tensordot(levels**2, weight, axes=(0, 0)) - mean**2, 0.0))


def _land_around(
    log_radiance: np.ndarray,
    sun: np.ndarray,
    ambient: np.ndarray,
    prior: np.ndarray,
    known: np.ndarray,
    model: BorderModel,
) -> np.ndarray:
    """Mean and spread ``(R, S, 6)`` of the features of the land around each texel, from texels surely in sun or shade."""
    rows, columns = known.shape
    # It varies slowly: a texel of each small square stands for it.
    step = max(1, min(round(model.land_texels / _SAMPLES_PER_SIGMA), rows, columns))
    every, width = (slice(None, None, step), slice(None, None, step)), model.land_texels / step
    chosen = prior[every]
    sure = known[every] & ((chosen > _SURE) | (chosen < 1.0 - _SURE))
    features = _features(log_radiance[every], chosen[..., None] * sun[every] + ambient[every])
    typical = np.median(features[sure], axis=0) if sure.any() else np.zeros(3, np.float32)
    left = np.where(sure[..., None], features - typical, 0.0)
    weight = sure.astype(np.float32)
    mean = spread = np.zeros_like(left)
    for _ in range(_LAND_ROUNDS):
        # A little of the whole image's, where nothing sure is around.
        total = (gaussian_filter(weight, width) + np.float32(1e-3))[..., None]
        mean = gaussian_filter(weight[..., None] * left, (width, width, 0)) / total
        off = (left - mean) ** 2
        spread = np.sqrt(gaussian_filter(weight[..., None] * off, (width, width, 0)) / total)
        spread = np.maximum(spread, _LEAST_SPREAD)
        weight = sure / (1.0 + (off / spread**2).sum(axis=2) / 3.0)
    land = np.concatenate([mean + typical, spread], axis=2).astype(np.float32)
    size = (land.shape[1] * step, land.shape[0] * step)
    return np.stack([cv2.resize(land[..., k], size)[:rows, :columns] for k in range(6)], axis=2)


def _features(log_radiance: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Brightness of the log albedo under a light, and two differences of its colour ``(h, w, 3)``."""
    log_albedo = np.nan_to_num(log_radiance) - np.log(np.maximum(light, 1e-3))
    red, green, blue = np.moveaxis(log_albedo, 2, 0)
    return np.stack([(red + green + blue) / 3.0, red - green, blue - green], axis=2).astype(np.float32)


def _neighbours(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Views of all texels that have a next one along an axis, and of those next ones.

    ``values`` is ``(h, w)``, planes ``(K, h, w)``, or planes of features ``(K, h, w, 3)``.
    """
    at = axis if values.ndim == 2 else axis + 1
    ahead = [slice(None)] * values.ndim
    behind = list(ahead)
    ahead[at], behind[at] = slice(None, -1), slice(1, None)
    return values[tuple(ahead)], values[tuple(behind)]


def _min_sum(unary: np.ndarray, costs: list[np.ndarray], joined: list[np.ndarray], iterations: int) -> np.ndarray:
    """Beliefs ``(K, h, w)``, 0 for the best level, after damped rounds of messages along both axes and both ways."""
    # [axis, 0]: messages to the next texel along the axis; [axis, 1]: to the previous one; stored at the receiver.
    messages = np.zeros((2, 2, *unary.shape), np.float32)
    for _ in range(iterations):
        total = unary + messages.sum(axis=(0, 1))
        for axis in (0, 1):
            ahead, _ = _neighbours(total - messages[axis, 1], axis)
            _, back = _neighbours(total - messages[axis, 0], axis)
            _, to_next = _neighbours(messages[axis, 0], axis)
            to_previous, _ = _neighbours(messages[axis, 1], axis)
            _send(ahead, costs[axis], joined[axis], to_next)
            _send(back, costs[axis].swapaxes(0, 1), joined[axis], to_previous)
    belief = unary + messages.sum(axis=(0, 1))
    return belief - belief.min(axis=0)


def _send(source: np.ndarray, cost: np.ndarray, joined: np.ndarray, target: np.ndarray) -> None:
    """Damped update of messages ``(K, h, w)``: the least of source and cost over the source's levels."""
    sent = np.empty(source.shape, np.float32)
    trial = np.empty(source.shape[1:], np.float32)
    for m in range(len(sent)):
        np.add(source[0], cost[0, m], out=sent[m])
        for k in range(1, len(source)):
            np.add(source[k], cost[k, m], out=trial)
            np.minimum(sent[m], trial, out=sent[m])
    sent -= sent.min(axis=0)
    sent *= joined
    target += sent
    target *= np.float32(0.5)
