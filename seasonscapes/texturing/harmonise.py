"""Cameras made to agree: exposure and white balance of each, and the haze before all of them, from where they overlap.

A picture's value is ``v = g (T^h L + A_h)``: radiance L of the land through the sky model's transmittance T, and its
airlight A with as much more or less of it as ``1 - T^h`` is of ``1 - T``. The airlight's own scale is read off the sky
above the horizon of the same picture, which needs no gain. What is fitted: a gain for each camera and colour, one haze
exponent h for all (1 is the sky model's own haze).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.rendering.gather import Occluder
from seasonscapes.terrain.surface import sample_texture
from seasonscapes.texturing.shots import ReadyShot, sample_shot
from seasonscapes.texturing.visibility import by_ray, sight_of

# Compared places are means over this many texels' sides, so that cameras of unlike resolution see alike.
_FOOTPRINT_TEXELS = 4.0
# Scatter of the logarithms of two cameras' views of one place: of the land, and of the pictures before haze is removed.
_LAND_SIGMA, _PICTURE_SIGMA = 0.12, 0.02
_HUBER = 1.5
# How far a gain may lie from what the sky tells, from what the picture's mean tells, and from a prediction's [log].
_SKY_SIGMA, _MEAN_SIGMA, _PREDICTED_SIGMA = 0.4, 1.0, 0.6
_HAZE_SIGMA = 0.7
# The least share of a picture's value that the land itself must have.
_LEAST_LAND = 0.08
_HAZES = np.exp(np.linspace(np.log(0.3), np.log(3.5), 11))


@dataclass(frozen=True)
class Harmony:
    """What turns picture values into radiances of the land.

    Parameters
    ----------
    log_gain
        ``(K, 3)`` logarithm of picture value over radiance.
    log_sky_gain
        ``(K, 3)`` the same, for the airlight.
    haze
        Exponent of the sky model's transmittance.
    overlaps
        Places that two cameras see, that were compared.
    scatter_before, scatter_after
        Median absolute difference of two cameras' logarithms of radiance there, all gains equal and none but haze 1
        removed, and now.
    """

    log_gain: np.ndarray
    log_sky_gain: np.ndarray
    haze: float
    overlaps: int = 0
    scatter_before: float = float("nan")
    scatter_after: float = float("nan")


@dataclass(frozen=True)
class _Rows:
    """Samples of cameras at places; each row of ``other`` stands beside a row of ``own``."""

    camera: np.ndarray  # (N,)
    value: np.ndarray  # (N, 3)
    transmittance: np.ndarray
    airlight: np.ndarray

    def __getitem__(self, key) -> _Rows:
        return _Rows(self.camera[key], self.value[key], self.transmittance[key], self.airlight[key])


def through_haze(transmittance: np.ndarray, airlight: np.ndarray, haze: float) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance and airlight with ``haze`` times the optical depth; infinite distance keeps its airlight."""
    thicker = transmittance**haze
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(transmittance < 1.0 - 1e-6, (1.0 - thicker) / (1.0 - transmittance), haze)
    return thicker, airlight * ratio


def land_radiance(value: np.ndarray, camera: int, air: tuple[np.ndarray, np.ndarray], harmony: Harmony
                  ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Radiance ``(N, 3)`` [cd/m²] of the land from picture values ``(N, 3)``, and its share of the picture ``(N,)``.

    Parameters
    ----------
    air
        Transmittance and airlight ``(N, 3)`` of the sky model up to each place.

    Notes
    -----
    Where the airlight alone would be brighter than the picture, a small share is kept: the second value tells, and
    painting weighs by its square.
    """
    transmittance, airlight = through_haze(*air, harmony.haze)
    veil = airlight * np.exp(harmony.log_sky_gain[camera])
    land = np.maximum(value - veil, _LEAST_LAND * value)
    share = (land / np.maximum(value, 1e-9)).min(axis=1)
    radiance = land / (np.maximum(transmittance, 1e-3) * np.exp(harmony.log_gain[camera]))
    return radiance.astype(np.float32), np.clip(share, 0.0, 1.0).astype(np.float32)


def equal_gains(shots: Sequence[ReadyShot], *, radiance: float = 1.0) -> Harmony:
    """No harmony: one gain for all, by which the pictures' mean stands for ``radiance`` [cd/m²], and no fitted haze."""
    gain = np.mean([_mean_log(ready) for ready in shots]) - np.log(radiance)
    same = np.full((len(shots), 3), gain)
    return Harmony(same, same, 1.0)


def harmonise(shots: Sequence[ReadyShot], terrain: Occluder, *, predicted: np.ndarray | None = None,
              fit_haze: bool = True, radiance: float | None = None) -> Harmony:  # fmt: skip
    """Fit gains and haze by robust least squares over all places that two cameras see.

    Parameters
    ----------
    predicted
        ``(R, S, 3)`` radiance [cd/m²] that a regression expects of the land (NaN where it does not know): ties cameras
        together that share no place.
    fit_haze
        Let the sky model's haze be thicker or thinner.
    radiance
        Mean radiance of the land [cd/m²], for pictures that show no sky; left out, 1: relative values.

    Returns
    -------
    Harmony
        Absolute where skies are seen: their radiance is the sky model's.
    """
    own, other, place_uv = _overlaps(shots, terrain)
    prior, sigma = _prior_gains(shots, 1.0 if radiance is None else radiance)
    sky_gain = np.array([np.log(ready.sky_scale) for ready in shots])
    sky_gain = np.where(np.isfinite(sky_gain), sky_gain, prior)
    expected = None if predicted is None else _expected(predicted, place_uv)
    before = _scatter(own, other, np.zeros_like(prior), sky_gain, 1.0)

    def fitted(haze: float, gains: np.ndarray | None = None) -> tuple[np.ndarray, float]:
        return _solve(own, other, expected, (prior, sigma), sky_gain, haze)

    haze = 1.0
    if fit_haze and len(own.camera) >= 50 and any(ready.shot.air is not None for ready in shots):
        haze = _least(lambda h: fitted(h)[1])
    gains, _ = fitted(haze)
    return Harmony(gains, sky_gain, haze, len(own.camera), before, _scatter(own, other, gains, sky_gain, haze))


def _overlaps(shots: Sequence[ReadyShot], terrain: Occluder) -> tuple[_Rows, _Rows, np.ndarray]:
    """Rows of each shot's probes beside every other shot that sees them too, and their texture coordinates."""
    mine, theirs, uv = [_no_rows()], [_no_rows()], [np.zeros((0, 2), np.float32)]
    for first, ready in enumerate(shots):
        own, sound = _rows(ready, first, ready.probes)
        for second, partner in enumerate(shots):
            if second == first:
                continue
            index = np.flatnonzero(sound)
            sight = sight_of(partner.shot.observation.camera, ready.probes[index])
            index = index[by_ray(terrain, partner.shot.observation.camera, ready.probes[index], sight)]
            beside, known = _rows(partner, second, ready.probes[index])
            mine.append(own[index[known]])
            theirs.append(beside[known])
            uv.append(ready.probe_uv[index[known]])
    return _joined(mine), _joined(theirs), np.concatenate(uv)


def _rows(ready: ReadyShot, number: int, places) -> tuple[_Rows, np.ndarray]:
    camera = ready.shot.observation.camera
    sight = sight_of(camera, places)
    footprint = _FOOTPRINT_TEXELS * places.texel_m * camera.fx / np.maximum(sight.distance_m, 1.0)
    pixel = np.where(sight.inside[:, None], sight.pixel, 0.0)
    value, trust = sample_shot(ready, pixel, footprint)
    transmittance, airlight = air_to(ready, places.position_m)
    sound = sight.inside & (trust > 0.5) & (value > 1e-4).all(axis=1)
    return _Rows(np.full(len(value), number), value, transmittance, airlight), sound


def air_to(ready: ReadyShot, position_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance and airlight ``(N, 3)`` of the shot's air up to places ``(N, 3)`` ENU."""
    if ready.shot.air is None:
        return np.ones(position_m.shape), np.zeros(position_m.shape)
    offset = position_m - ready.shot.observation.camera.position_m
    distance = np.linalg.norm(offset, axis=1)
    return ready.shot.air(distance, offset / np.maximum(distance, 1e-6)[:, None])


def _no_rows() -> _Rows:
    return _Rows(np.zeros(0, int), *(np.zeros((0, 3)) for _ in range(3)))


def _joined(parts: list[_Rows]) -> _Rows:
    return _Rows(*(np.concatenate([getattr(part, name) for part in parts]) for name in _Rows.__dataclass_fields__))


def _mean_log(ready: ReadyShot) -> np.ndarray:
    coarse = ready.levels[min(3, len(ready.levels) - 1)]
    sound = (coarse[..., 3] > _FOOTPRINT_TEXELS / 8.0) & (coarse[..., :3] > 1e-4).all(axis=-1)
    if not sound.any():
        return np.full(3, np.log(0.1))
    return np.median(np.log(coarse[sound][:, :3] / coarse[sound][:, 3:4]), axis=0)


def _prior_gains(shots: Sequence[ReadyShot], radiance: float) -> tuple[np.ndarray, np.ndarray]:
    """What each gain is before any overlap is looked at ``(K, 3)``, and how surely ``(K, 1)``."""
    mean = np.array([_mean_log(ready) for ready in shots])
    sky = np.array([np.log(ready.sky_scale) for ready in shots])
    known = np.isfinite(sky).all(axis=1)
    # A picture without sky is taken for as bright a land as those with sky show.
    offset = np.median(sky[known] - mean[known], axis=0) if known.any() else np.full(3, -np.log(radiance))
    prior = np.where(known[:, None], sky, mean + offset)
    return prior, np.where(known, _SKY_SIGMA, _MEAN_SIGMA)[:, None]


def _expected(predicted: np.ndarray, uv: np.ndarray) -> np.ndarray:
    value = sample_texture(predicted, uv)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(value > 0.0, np.log(value), np.nan)


def _cleared(rows: _Rows, sky_gain: np.ndarray, haze: float) -> tuple[np.ndarray, np.ndarray]:
    """Logarithm of gain × radiance ``(N, 3)`` and its variance from the picture's noise."""
    transmittance, airlight = through_haze(rows.transmittance, rows.airlight, haze)
    land = np.maximum(rows.value - airlight * np.exp(sky_gain[rows.camera]), _LEAST_LAND * rows.value)
    share = land / rows.value
    return np.log(land) - np.log(np.maximum(transmittance, 1e-3)), (_PICTURE_SIGMA / share) ** 2


def _scatter(own: _Rows, other: _Rows, gains: np.ndarray, sky_gain: np.ndarray, haze: float) -> float:
    if len(own.camera) == 0:
        return float("nan")
    left, right = (_cleared(rows, sky_gain, haze)[0] - gains[rows.camera] for rows in (own, other))
    return float(np.median(np.abs(left - right)))


def _solve(own: _Rows, other: _Rows, expected: np.ndarray | None, prior: tuple[np.ndarray, np.ndarray],
           sky_gain: np.ndarray, haze: float) -> tuple[np.ndarray, float]:  # fmt: skip
    """Gains ``(K, 3)`` at a haze, by iteratively reweighted least squares (Huber), and the mean negative log-likelihood."""
    middle, sigma = prior
    (left, left_var), (right, right_var) = _cleared(own, sky_gain, haze), _cleared(other, sky_gain, haze)
    difference, variance = left - right, left_var + right_var + _LAND_SIGMA**2
    gains, weight = middle.copy(), 1.0 / variance
    for _ in range(8):
        error = difference - (gains[own.camera] - gains[other.camera])
        weight = _huber(error / np.sqrt(variance)) / variance
        against = None
        if expected is not None:
            apart = left - expected - gains[own.camera]
            trusted = np.where(np.isfinite(apart), 1.0, 0.0)
            against = (left - expected, trusted * _huber(np.nan_to_num(apart) / _PREDICTED_SIGMA) / _PREDICTED_SIGMA**2)
        gains = _normal_equations(own.camera, other.camera, (difference, weight), against, (middle, sigma))
    error = (difference - (gains[own.camera] - gains[other.camera])) / np.sqrt(variance)
    bent = np.where(np.abs(error) < _HUBER, 0.5 * error**2, _HUBER * (np.abs(error) - 0.5 * _HUBER))
    cost = float(np.mean(bent + 0.5 * np.log(variance))) if error.size else 0.0
    return gains, cost + 0.5 * (np.log(haze) / _HAZE_SIGMA) ** 2 / max(error.size, 1)


def _huber(error: np.ndarray) -> np.ndarray:
    return np.minimum(1.0, _HUBER / np.maximum(np.abs(error), 1e-9))


def _normal_equations(
    first: np.ndarray, second: np.ndarray, pairs: tuple, against: tuple | None, prior: tuple
) -> np.ndarray:
    """Weighted least squares of gain differences, of gains against a prediction, and of a prior, colour by colour."""
    (difference, weight), (middle, sigma) = pairs, prior
    count = len(middle)
    gains = np.empty_like(middle)
    for colour in range(3):
        matrix, right = np.diag(1.0 / sigma[:, 0] ** 2), middle[:, colour] / sigma[:, 0] ** 2
        w, wd = weight[:, colour], weight[:, colour] * difference[:, colour]
        linked = np.bincount(first * count + second, w, count * count).reshape(count, count)
        linked = linked + linked.T
        matrix = matrix + np.diag(linked.sum(axis=1)) - linked
        right = right + np.bincount(first, wd, count) - np.bincount(second, wd, count)
        if against is not None:
            value, trusted = np.nan_to_num(against[0][:, colour]), against[1][:, colour]
            matrix = matrix + np.diag(np.bincount(first, trusted, count))
            right = right + np.bincount(first, trusted * value, count)
        gains[:, colour] = np.linalg.solve(matrix, right)
    return gains


def _least(cost) -> float:
    """The haze of least cost: a coarse search, then a parabola through the lowest three."""
    values = np.array([cost(haze) for haze in _HAZES])
    best = int(np.clip(values.argmin(), 1, len(values) - 2))
    low, middle, high = values[best - 1 : best + 2]
    bend = low - 2.0 * middle + high
    step = 0.5 * (low - high) / bend if bend > 0.0 else 0.0
    return float(np.exp(np.log(_HAZES[best]) + np.clip(step, -1.0, 1.0) * np.log(_HAZES[1] / _HAZES[0])))
