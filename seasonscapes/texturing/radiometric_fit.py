"""Cameras made to agree: exposure, white balance and contrast of each, and the haze before all of them.

A picture's value is ``v = R_a(g (T^h L + s A_h))``: radiance L of the land through the sky model's transmittance T, with
its airlight A as much stronger or weaker as ``1 - T^h`` is than ``1 - T``, times the camera's gain g for each colour, on a
tone curve R of contrast a. The airlight's own scale s g is read off the sky above the horizon of the same picture, which
needs no gain. Gains, contrasts and one haze exponent h (1 is the sky model's own haze) are fitted together, by robust
least squares over all places that two cameras see, and against a prediction where one is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.images import linear_from_srgb, srgb_from_linear
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.terrain.surface import sample_texture
from seasonscapes.texturing.camera_overlaps import CameraSamples, OverlapPairs, find_overlaps
from seasonscapes.texturing.inputs import PreparedInput, horizon_radiance

# Scatter of the logarithms of two cameras' views of one place, and of a picture's encoded values (noise, JPEG).
_LAND_SIGMA, _PICTURE_SIGMA = 0.1, 0.012
_HUBER = 1.5
# How far a gain may lie from what the sky tells, and from what the picture's mean tells [log].
_SKY_SIGMA, _MEAN_SIGMA = 0.4, 1.0
# Webcams steepen contrast: logarithm of the exponent, and of the haze's.
_CONTRAST, _CONTRAST_SIGMA, _HAZE_SIGMA = 0.1, 0.05, 0.5
# Neighbouring places are not independent: so many count as one, and those of one pair of cameras as no more than so many.
_PLACES_AS_ONE, _PLACES_A_PAIR = 20.0, 10.0
# Radiance of the land over that of the horizon's sky, where no picture shows any sky.
_LAND_OF_SKY = 0.25
# The least share of a picture's value that the land itself must have.
_LEAST_LAND = 0.08
_STEPS, _FARTHEST_STEP, _FIRST_HAZE = 15, 0.3, 0.6


@dataclass(frozen=True)
class RadiometricFit:
    """What turns picture values into radiances of the land.

    Parameters
    ----------
    log_gain
        ``(K, 3)`` logarithm of picture value over radiance.
    log_sky_gain
        ``(K, 3)`` the same, for the airlight.
    contrast
        ``(K,)`` exponent of each camera's tone curve, 1 for sRGB alone; see `invert_contrast`.
    haze
        Exponent of the sky model's transmittance.
    overlaps
        Pairs that were compared.
    scatter_before, scatter_after
        Median absolute difference of two cameras' logarithms of radiance there, before anything was fitted and now.
    """

    log_gain: np.ndarray
    log_sky_gain: np.ndarray
    contrast: np.ndarray
    haze: float = 1.0
    overlaps: int = 0
    scatter_before: float = float("nan")
    scatter_after: float = float("nan")


def invert_contrast(value: np.ndarray, contrast: np.ndarray | float) -> np.ndarray:
    """Decoded picture values in [0, 1] without the camera's tone curve.

    The curve bends encoded values e about their middle: ``eᵃ / (eᵃ + (1 - e)ᵃ)``; this is its inverse.
    """
    encoded = srgb_from_linear(value)
    power = 1.0 / np.asarray(contrast)
    low, high = encoded**power, (1.0 - encoded) ** power
    return linear_from_srgb(low / (low + high))


def scale_haze(transmittance: np.ndarray, airlight: np.ndarray, haze: float) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance and airlight with ``haze`` times the optical depth."""
    thicker = transmittance**haze
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(transmittance < 1.0 - 1e-6, (1.0 - thicker) / (1.0 - transmittance), haze)
    return thicker, airlight * ratio


def radiance_at_surface(
    value: np.ndarray, camera: int, air: tuple[np.ndarray, np.ndarray], radiometry: RadiometricFit
) -> tuple[np.ndarray, np.ndarray]:
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
    samples = CameraSamples(np.full(len(value), camera), value, *air)
    log_land, share = _land(samples, radiometry)
    return np.exp(log_land - radiometry.log_gain[camera]).astype(np.float32), share.min(axis=1).astype(np.float32)


def _land(samples: CameraSamples, radiometry: RadiometricFit) -> tuple[np.ndarray, np.ndarray]:
    """Logarithm of gain × radiance ``(N, 3)`` of the land, and its share of the picture's value ``(N, 3)``."""
    value = invert_contrast(samples.value, radiometry.contrast[samples.camera][:, None])
    transmittance, airlight = scale_haze(samples.transmittance, samples.airlight, radiometry.haze)
    share = 1.0 - airlight * np.exp(radiometry.log_sky_gain[samples.camera]) / np.maximum(value, 1e-6)
    share = np.clip(share, _LEAST_LAND, 1.0)
    return np.log(np.maximum(value, 1e-6) * share) - np.log(np.maximum(transmittance, 1e-3)), share


def common_gain(inputs: Sequence[PreparedInput], *, radiance: float | None = None) -> RadiometricFit:
    """No harmony: one gain for all cameras, by which their mean stands for ``radiance`` [cd/m²] (or as the skies tell)."""
    count = len(inputs)
    start = RadiometricFit(np.zeros((count, 3)), np.zeros((count, 3)), np.ones(count))
    prior, _ = _prior_gains(inputs, start, radiance)
    same = np.broadcast_to(prior.mean(), (count, 3)).copy()
    return replace(start, log_gain=same, log_sky_gain=same)


def fit_radiometry(
    inputs: Sequence[PreparedInput],
    terrain: RayScene,
    *,
    predicted: np.ndarray | None = None,
    predicted_sigma: float = 1.0,
    fit_haze: bool = True,
    fit_contrast: bool = True,
    radiance: float | None = None,
) -> RadiometricFit:
    """Fit gains, contrasts and haze over all places that two cameras see.

    Parameters
    ----------
    predicted
        ``(R, S, 3)`` radiance [cd/m²] that is expected of the land (NaN where it is not known): ties cameras together
        that share no place, and all of them to the absolute scale.
    predicted_sigma
        Standard error of its logarithm: about 1 for a regression from a satellite's image, 0.2 for a relit albedo.
    fit_haze, fit_contrast
        Let them differ from the sky model's haze and from plain sRGB.
    radiance
        Median radiance of the land [cd/m²], where no picture shows any sky; left out, a quarter of the horizon's by the
        sky model, and 1 (relative values) without any.

    Returns
    -------
    Harmony
        Absolute where skies are seen: their radiance is the sky model's.
    """
    count = len(inputs)
    overlaps = find_overlaps(inputs, terrain)
    expected = None if predicted is None else _expected(predicted, overlaps.alone_uv)
    radiometry = RadiometricFit(np.zeros((count, 3)), np.zeros((count, 3)), np.ones(count), overlaps=len(overlaps.uv))
    radiometry = replace(radiometry, log_gain=_prior_gains(inputs, radiometry, radiance)[0])
    radiometry = _with_sky(inputs, radiometry, radiance)
    before = _scatter(overlaps, common_gain(inputs))
    free = np.concatenate([np.ones(3 * count, bool), np.full(count, fit_contrast), [fit_haze]])
    if fit_contrast:
        radiometry = replace(radiometry, contrast=np.full(count, np.exp(_CONTRAST)))
    if fit_haze:
        # Begin in clear air: where too much is taken away nothing is left that could tell so.
        radiometry = replace(radiometry, haze=_FIRST_HAZE)
    for _ in range(_STEPS):
        prior = _prior_gains(inputs, radiometry, radiance)
        step = _gauss_newton(overlaps, (expected, predicted_sigma), radiometry, prior, free)
        # Gains are nearly linear; what bends the curve moves by little at a time.
        step[3 * count :] = np.clip(step[3 * count :], -_FARTHEST_STEP, _FARTHEST_STEP)
        radiometry = _with_sky(inputs, _moved(radiometry, step), radiance)
        if np.abs(step).max() < 1e-4:
            break
    return replace(radiometry, scatter_before=before, scatter_after=_scatter(overlaps, radiometry))


def _moved(radiometry: RadiometricFit, step: np.ndarray) -> RadiometricFit:
    count = len(radiometry.contrast)
    return replace(
        radiometry,
        log_gain=radiometry.log_gain + step[: 3 * count].reshape(3, count).T,
        contrast=np.clip(radiometry.contrast * np.exp(step[3 * count : 4 * count]), 0.7, 2.0),
        haze=float(np.clip(radiometry.haze * np.exp(step[-1]), 0.1, 10.0)),
    )


def _with_sky(inputs: Sequence[PreparedInput], radiometry: RadiometricFit, radiance: float | None) -> RadiometricFit:
    """The same with the airlight's gains read off the straightened skies."""
    return replace(radiometry, log_sky_gain=_prior_gains(inputs, radiometry, radiance)[0])


def _prior_gains(
    inputs: Sequence[PreparedInput], radiometry: RadiometricFit, radiance: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """What each gain is by its own picture alone ``(K, 3)``, and how surely ``(K, 1)``."""
    contrast = radiometry.contrast[:, None]
    mean = np.log(invert_contrast(np.array([ready.median_value for ready in inputs]), contrast))
    value, expected = (np.array([getattr(ready, name) for ready in inputs]) for name in ("sky_value", "sky_radiance"))
    seen = np.isfinite(value)
    sky = np.where(
        seen, np.log(invert_contrast(np.where(seen, value, 0.5), contrast) / np.where(seen, expected, 1.0)), 0.0
    )
    known = seen.any(axis=1)
    # A colour that is clipped has the gain of the others: white balance differs by little.
    grey = sky.sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    sky = np.where(seen, sky, grey[:, None])
    # A picture without sky is taken for as bright a land as those with sky show.
    if known.any():
        offset = np.median((sky - mean)[known], axis=0)
    else:
        horizon = float(np.mean([horizon_radiance(ready.item) for ready in inputs]))
        offset = -np.log(radiance or _LAND_OF_SKY * horizon or 1.0)
    return np.where(known[:, None], sky, mean + offset), np.where(known, _SKY_SIGMA, _MEAN_SIGMA)[:, None]


def _expected(predicted: np.ndarray, uv: np.ndarray) -> np.ndarray:
    value = sample_texture(predicted, uv)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(value > 0.0, np.log(value), np.nan)


def _scatter(overlaps: OverlapPairs, radiometry: RadiometricFit) -> float:
    if len(overlaps.uv) == 0:
        return float("nan")
    left, right = (_land(s, radiometry)[0] - radiometry.log_gain[s.camera] for s in (overlaps.own, overlaps.other))
    return float(np.median(np.abs(left - right)))


@dataclass(frozen=True)
class _Side:
    """One camera's part in a comparison, ``(N, 3)`` each.

    ``steepness`` is the logarithm of how much straightening and clearing spread tones at this value; ``by_...`` are slopes
    in the logarithms of contrast and haze, of ``log_land`` and of ``steepness``.
    """

    log_land: np.ndarray
    noise: np.ndarray
    steepness: np.ndarray
    by_contrast: np.ndarray
    by_haze: np.ndarray
    steeper_by_contrast: np.ndarray
    steeper_by_haze: np.ndarray


def _side(samples: CameraSamples, radiometry: RadiometricFit) -> _Side:
    tiny = 1e-3
    log_land, _ = _land(samples, radiometry)
    steepness = _steepness(samples, radiometry)
    bent = replace(radiometry, contrast=radiometry.contrast * np.exp(tiny))
    hazier = replace(radiometry, haze=radiometry.haze * np.exp(tiny))
    # Noise and rounding are even in encoded values.
    noise = _PICTURE_SIGMA * 2.4 / np.maximum(srgb_from_linear(samples.value) + 0.055, 0.02)
    slopes = ((_land(samples, other)[0] - log_land) / tiny for other in (bent, hazier))
    steeper = ((_steepness(samples, other) - steepness) / tiny for other in (bent, hazier))
    return _Side(log_land, noise, steepness, *slopes, *steeper)


def _steepness(samples: CameraSamples, radiometry: RadiometricFit) -> np.ndarray:
    tiny = 1e-3
    low, high = (
        _land(replace(samples, value=samples.value * np.exp(sign * tiny)), radiometry)[0] for sign in (-0.5, 0.5)
    )
    return np.log(np.clip((high - low) / tiny, 1e-2, 1.0 / _LEAST_LAND))


def _gauss_newton(
    overlaps: OverlapPairs,
    told: tuple[np.ndarray | None, float],
    radiometry: RadiometricFit,
    prior: tuple[np.ndarray, np.ndarray],
    free: np.ndarray,
) -> np.ndarray:
    """One step of iteratively reweighted least squares (Huber): of gains (colour by colour), log contrasts, log haze.

    Differences are divided by how much the tone curves spread them: else curves that flatten everything would agree best.
    """
    count, (expected, predicted_sigma) = len(radiometry.contrast), told
    own, other = overlaps.own, overlaps.other
    left, right = _side(own, radiometry), _side(other, radiometry)
    error = left.log_land - right.log_land - radiometry.log_gain[own.camera] + radiometry.log_gain[other.camera]
    spread = np.exp(0.5 * (left.steepness + right.steepness))
    noise = left.noise**2 * np.exp(2.0 * left.steepness) + right.noise**2 * np.exp(2.0 * right.steepness)
    half = 0.5 * error
    blocks = [
        (
            error / spread,
            noise / spread**2 + _LAND_SIGMA**2,
            (
                (own.camera, -1.0 / spread, (left.by_contrast - half * left.steeper_by_contrast) / spread),
                (other.camera, 1.0 / spread, (-right.by_contrast - half * right.steeper_by_contrast) / spread),
            ),
            (left.by_haze - right.by_haze - half * (left.steeper_by_haze + right.steeper_by_haze)) / spread,
            _counts(own.camera * count + other.camera),
        )
    ]
    if expected is not None:
        known = np.isfinite(expected).all(axis=1)
        side = _side(overlaps.alone[known], radiometry)
        camera, spread = overlaps.alone.camera[known], np.exp(side.steepness)
        apart = side.log_land - expected[known] - radiometry.log_gain[camera]
        blocks.append(
            (
                apart / spread,
                side.noise**2 + predicted_sigma**2,
                ((camera, -1.0 / spread, (side.by_contrast - apart * side.steeper_by_contrast) / spread),),
                (side.by_haze - apart * side.steeper_by_haze) / spread,
                _counts(camera),
            )
        )
    matrix, gradient = _priors(radiometry, prior, count)
    for block in blocks:
        for colour in range(3):
            jacobian, weight, apart = _rows(block, colour, count)
            matrix += (jacobian.T @ jacobian.multiply(weight[:, None])).toarray()
            gradient += jacobian.T @ (weight * apart)
    # A curve that all cameras share cannot be told from the land's own contrast: only their differences are fitted.
    shared = np.zeros(len(gradient))
    shared[3 * count : 4 * count] = 1e3
    matrix += np.outer(shared, shared)
    step = np.zeros(len(free))
    step[free] = np.linalg.solve(matrix[np.ix_(free, free)], -gradient[free])
    return step


def _counts(kind: np.ndarray) -> np.ndarray:
    """As how many independent places each row ``(N,)`` counts: all of one kind together as no more than a few."""
    _, number, members = np.unique(kind, return_inverse=True, return_counts=True)
    return np.minimum(1.0 / _PLACES_AS_ONE, _PLACES_A_PAIR / members)[number]


def _rows(block: tuple, colour: int, count: int) -> tuple:
    """Sparse Jacobian ``(N, 4 K + 1)``, weights and errors of one colour."""
    from scipy import sparse

    error, variance, sides, haze, counts = block
    rows = np.arange(len(error))
    entries = [(rows, np.full(len(rows), 4 * count), haze[:, colour])]
    for camera, gain, contrast in sides:
        entries.append((rows, colour * count + camera, gain[:, colour]))
        entries.append((rows, 3 * count + camera, contrast[:, colour]))
    row, column, value = (np.concatenate(part) for part in zip(*entries, strict=True))
    jacobian = sparse.csr_array((value, (row, column)), shape=(len(rows), 4 * count + 1))
    apart, sigma = error[:, colour], np.sqrt(variance[:, colour])
    weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(apart / sigma), 1e-9)) / sigma**2 * counts
    return jacobian, weight, apart


def _priors(
    radiometry: RadiometricFit, prior: tuple[np.ndarray, np.ndarray], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix and gradient of what is known before any overlap is looked at."""
    middle, sigma = prior
    weight = np.concatenate(
        [np.tile(1.0 / sigma[:, 0] ** 2, 3), np.full(count, _CONTRAST_SIGMA**-2), [_HAZE_SIGMA**-2]]
    )
    apart = np.concatenate(
        [(radiometry.log_gain - middle).T.ravel(), np.log(radiometry.contrast) - _CONTRAST, [np.log(radiometry.haze)]]
    )
    return np.diag(weight), weight * apart
