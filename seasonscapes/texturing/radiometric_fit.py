"""Radiometric calibration of overlapping photographs: gain, white balance and contrast per camera, one common haze.

The image value is ``v = R_a(g (T^h L + s A_h))``: radiance L of the surface through the transmittance T of the sky
model, plus its airlight A, scaled by ``(1 - T^h) / (1 - T)`` to A_h, times the camera's gain g per channel, on a tone
curve R of contrast a. The scale of the airlight, s g, is measured on the sky above the horizon in the same image, which
needs no gain; in an image without sky s is 1. Gains, contrasts and one haze exponent h (1 is the sky model's own haze) are fitted jointly by robust
least squares over all surface points visible from two cameras, and against predicted radiance where it is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from seasonscapes.images import linear_from_srgb, srgb_from_linear
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.terrain.surface import sample_texture
from seasonscapes.texturing.camera_overlaps import CameraSamples, OverlapPairs, find_overlaps
from seasonscapes.texturing.inputs import PreparedInput, horizon_radiance

# Standard deviation of the log radiance of one point between two cameras, and of encoded image values (noise, JPEG).
_SURFACE_SIGMA, _IMAGE_SIGMA = 0.1, 0.012
_HUBER = 1.5
# Prior standard deviation of a log gain that the sky determines, and of one that the image's median determines.
_SKY_SIGMA, _MEDIAN_SIGMA = 0.4, 1.0
# Prior mean and standard deviation of log contrast (webcams steepen contrast), and standard deviation of log haze.
_CONTRAST, _CONTRAST_SIGMA, _HAZE_SIGMA = 0.1, 0.05, 0.5
# Neighbouring points are correlated: this many count as one, and those of a pair of cameras as at most so many.
_CORRELATED_POINTS, _MAX_POINTS_PER_PAIR = 20.0, 10.0
# Median radiance of the surface over that of the sky at the horizon, where no image shows any sky.
_SURFACE_TO_SKY = 0.25
# Least share of the surface in an image value; the rest is airlight.
_MIN_SURFACE_SHARE = 0.08
_ITERATIONS, _MAX_STEP, _INITIAL_HAZE = 15, 0.3, 0.6
# Step of finite differences in logarithms.
_DIFFERENCE = 1e-3


@dataclass(frozen=True)
class RadiometricFit:
    """Parameters that convert the image values of K cameras into radiance of the surface.

    Parameters
    ----------
    log_gain
        ``(K, 3)`` logarithm of image value over radiance.
    log_sky_gain
        ``(K, 3)`` the same for airlight.
    contrast
        ``(K,)`` exponent of each camera's tone curve, 1 for plain sRGB; see `invert_contrast`.
    haze
        Exponent of the sky model's transmittance.
    overlaps
        Number of compared pairs.
    scatter_before, scatter_after
        Median absolute difference of log radiance over these pairs, before and after the fit.
    """

    log_gain: np.ndarray
    log_sky_gain: np.ndarray
    contrast: np.ndarray
    haze: float = 1.0
    overlaps: int = 0
    scatter_before: float = float("nan")
    scatter_after: float = float("nan")


@dataclass(frozen=True)
class RadiometricReference:
    """Radiance that determines the absolute scale of a radiometric fit.

    Parameters
    ----------
    predicted
        ``(R, S, 3)`` predicted radiance [cd/m²] of the surface, NaN where unknown, or ``None``. It links cameras without
        common points, and all of them to the absolute scale.
    predicted_sigma
        Standard error of its logarithm: about 1 for a regression on a satellite image, 0.2 for a relit albedo.
    radiance
        Median radiance of the surface [cd/m²], used where no image shows any sky. ``None``: a quarter of the sky
        model's radiance at the horizon, or 1 (relative values) without a sky model.
    """

    predicted: np.ndarray | None = None
    predicted_sigma: float = 1.0
    radiance: float | None = None


def invert_contrast(value: np.ndarray, contrast: np.ndarray | float) -> np.ndarray:
    """Invert a camera's contrast curve.

    The curve acts on sRGB-encoded values e, about their middle: ``eᵃ / (eᵃ + (1 - e)ᵃ)``.

    Parameters
    ----------
    value
        ``(...)`` decoded image values in [0, 1].
    contrast
        Exponent a, broadcast against ``value``.

    Returns
    -------
    ndarray
        ``(...)`` decoded values in [0, 1] without the curve.

    Examples
    --------
    >>> import numpy as np
    >>> invert_contrast(np.array([0.0, 1.0]), 1.4).tolist()
    [0.0, 1.0]
    """
    encoded = srgb_from_linear(value)
    power = 1.0 / np.asarray(contrast)
    low, high = encoded**power, (1.0 - encoded) ** power
    return linear_from_srgb(low / (low + high))


def scale_haze(transmittance: np.ndarray, airlight: np.ndarray, haze: float) -> tuple[np.ndarray, np.ndarray]:
    """Scale the optical depth of the air.

    Parameters
    ----------
    transmittance, airlight
        ``(..., 3)`` of the sky model; airlight in [cd/m²].
    haze
        Factor of the optical depth.

    Returns
    -------
    transmittance, airlight
        ``(..., 3)`` each: ``T^h`` and ``A (1 - T^h) / (1 - T)``.
    """
    scaled = transmittance**haze
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(transmittance < 1.0 - 1e-6, (1.0 - scaled) / (1.0 - transmittance), haze)
    return scaled, airlight * ratio


def radiance_at_surface(
    value: np.ndarray, camera: int, air: tuple[np.ndarray, np.ndarray], radiometry: RadiometricFit
) -> tuple[np.ndarray, np.ndarray]:
    """Convert image values to radiance at the surface.

    Parameters
    ----------
    value
        ``(N, 3)`` decoded image values.
    camera
        Index of the camera in ``radiometry``.
    air
        Transmittance and airlight ``(N, 3)`` of the sky model between camera and each point.
    radiometry
        Gains, contrasts and haze.

    Returns
    -------
    radiance
        ``(N, 3)`` float32 [cd/m²].
    surface_share
        ``(N,)`` float32 in (0, 1]: share of the surface in the image value, the least over the channels.

    Notes
    -----
    The share has a lower limit of 0.08, which also applies where the airlight alone would exceed the image value.
    Painting multiplies weights by the square of the share.
    """
    samples = CameraSamples(np.full(len(value), camera), value, *air)
    log_surface, share = _log_surface(samples, radiometry)
    return (np.exp(log_surface - radiometry.log_gain[camera]).astype(np.float32), share.min(axis=1).astype(np.float32))


def _log_surface(samples: CameraSamples, radiometry: RadiometricFit) -> tuple[np.ndarray, np.ndarray]:
    """Logarithm of gain × radiance of the surface ``(N, 3)``, and its share of the image value ``(N, 3)``."""
    value = invert_contrast(samples.value, radiometry.contrast[samples.camera][:, None])
    transmittance, airlight = scale_haze(samples.transmittance, samples.airlight, radiometry.haze)
    share = 1.0 - airlight * np.exp(radiometry.log_sky_gain[samples.camera]) / np.maximum(value, 1e-6)
    share = np.clip(share, _MIN_SURFACE_SHARE, 1.0)
    return np.log(np.maximum(value, 1e-6) * share) - np.log(np.maximum(transmittance, 1e-3)), share


def common_gain(inputs: Sequence[PreparedInput], *, radiance: float | None = None) -> RadiometricFit:
    """Return one gain for all cameras and channels, without a fit: the mean of the gains of the single images.

    Parameters
    ----------
    inputs
        Prepared photographs.
    radiance
        As in `RadiometricReference`.

    Returns
    -------
    RadiometricFit
        Contrast and haze are 1.
    """
    count = len(inputs)
    start = RadiometricFit(np.zeros((count, 3)), np.zeros((count, 3)), np.ones(count))
    prior = _gain_prior(inputs, start, radiance)
    same = np.broadcast_to(prior.mean.mean(), (count, 3)).copy()
    return replace(start, log_gain=same, log_sky_gain=same)


def fit_radiometry(
    inputs: Sequence[PreparedInput],
    terrain: RayScene,
    *,
    reference: RadiometricReference | None = None,
    fit_haze: bool = True,
    fit_contrast: bool = True,
) -> RadiometricFit:
    """Fit gains, contrasts and haze to all surface points visible from two cameras.

    Parameters
    ----------
    inputs
        Prepared photographs.
    terrain
        Ray-tracing scene of the terrain.
    reference
        Predicted radiance and scale; defaults to `RadiometricReference()`.
    fit_haze
        Fit the haze exponent; otherwise it is 1.
    fit_contrast
        Fit the contrasts; otherwise they are 1.

    Returns
    -------
    RadiometricFit
        Absolute where sky is in view: its radiance is the sky model's.
    """
    reference = reference or RadiometricReference()
    radiance, count = reference.radiance, len(inputs)
    overlaps = find_overlaps(inputs, terrain)
    expected = None if reference.predicted is None else _log_predicted(reference.predicted, overlaps.single_uv)
    radiometry = RadiometricFit(np.zeros((count, 3)), np.zeros((count, 3)), np.ones(count), overlaps=len(overlaps.uv))
    radiometry = replace(radiometry, log_gain=_gain_prior(inputs, radiometry, radiance).mean)
    radiometry = _with_sky_gain(inputs, radiometry, radiance)
    before = _scatter(overlaps, common_gain(inputs))
    free = np.concatenate([np.ones(3 * count, bool), np.full(count, fit_contrast), [fit_haze]])
    if fit_contrast:
        radiometry = replace(radiometry, contrast=np.full(count, np.exp(_CONTRAST)))
    if fit_haze:
        # Start in clear air: where too much airlight is subtracted, the clipped share has no gradient.
        radiometry = replace(radiometry, haze=_INITIAL_HAZE)
    for _ in range(_ITERATIONS):
        prior = _gain_prior(inputs, radiometry, radiance)
        step = _gauss_newton_step(overlaps, expected, reference.predicted_sigma, radiometry, prior, free)
        # Contrast and haze are strongly nonlinear, gains nearly linear.
        step[3 * count :] = np.clip(step[3 * count :], -_MAX_STEP, _MAX_STEP)
        radiometry = _with_sky_gain(inputs, _apply_step(radiometry, step), radiance)
        if np.abs(step).max() < 1e-4:
            break
    return replace(radiometry, scatter_before=before, scatter_after=_scatter(overlaps, radiometry))


def _apply_step(radiometry: RadiometricFit, step: np.ndarray) -> RadiometricFit:
    """Radiometry after a step of log gains ``3 K`` (channel by channel), log contrasts ``K`` and log haze."""
    count = len(radiometry.contrast)
    return replace(
        radiometry,
        log_gain=radiometry.log_gain + step[: 3 * count].reshape(3, count).T,
        contrast=np.clip(radiometry.contrast * np.exp(step[3 * count : 4 * count]), 0.7, 2.0),
        haze=float(np.clip(radiometry.haze * np.exp(step[-1]), 0.1, 10.0)),
    )


def _with_sky_gain(
    inputs: Sequence[PreparedInput], radiometry: RadiometricFit, radiance: float | None
) -> RadiometricFit:
    """The same with gains of the airlight measured on the sky under the present contrasts, or those of the surface without sky."""
    prior = _gain_prior(inputs, radiometry, radiance)
    return replace(radiometry, log_sky_gain=np.where(prior.sees_sky[:, None], prior.mean, radiometry.log_gain))


@dataclass(frozen=True)
class _GainPrior:
    """Log gain by each camera's own image.

    Parameters
    ----------
    mean
        ``(K, 3)``.
    sigma
        ``(K, 1)`` its standard deviation.
    sees_sky
        ``(K,)`` bool: by the sky, and not by the image's median.
    """

    mean: np.ndarray
    sigma: np.ndarray
    sees_sky: np.ndarray


def _gain_prior(inputs: Sequence[PreparedInput], radiometry: RadiometricFit, radiance: float | None) -> _GainPrior:
    """Log gains from the sky in each image or, without any, from the image's median value."""
    contrast = radiometry.contrast[:, None]
    median = np.log(invert_contrast(np.array([prepared.median_value for prepared in inputs]), contrast))
    value = np.array([prepared.sky_value for prepared in inputs])
    expected = np.array([prepared.sky_radiance for prepared in inputs])
    finite = np.isfinite(value)
    sky = np.where(
        finite, np.log(invert_contrast(np.where(finite, value, 0.5), contrast) / np.where(finite, expected, 1.0)), 0.0
    )
    known = np.asarray(finite.any(axis=1))
    # A clipped channel takes the mean gain of the others: white balance varies little.
    grey = sky.sum(axis=1) / np.maximum(finite.sum(axis=1), 1)
    sky = np.where(finite, sky, grey[:, None])
    # The surface in an image without sky is assumed to be as bright as in the images with sky.
    if known.any():
        offset = np.median((sky - median)[known], axis=0)
    else:
        horizon = float(np.mean([horizon_radiance(prepared.painting_input) for prepared in inputs]))
        offset = -np.log(radiance or _SURFACE_TO_SKY * horizon or 1.0)
    return _GainPrior(
        np.where(known[:, None], sky, median + offset), np.where(known, _SKY_SIGMA, _MEDIAN_SIGMA)[:, None], known
    )


def _log_predicted(predicted: np.ndarray, uv: np.ndarray) -> np.ndarray:
    value = sample_texture(predicted, uv)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(value > 0.0, np.log(value), np.nan)


def _scatter(overlaps: OverlapPairs, radiometry: RadiometricFit) -> float:
    """Median absolute difference of log radiance over all pairs."""
    if len(overlaps.uv) == 0:
        return float("nan")
    left, right = (
        _log_surface(samples, radiometry)[0] - radiometry.log_gain[samples.camera]
        for samples in (overlaps.own, overlaps.other)
    )
    return float(np.median(np.abs(left - right)))


@dataclass(frozen=True)
class _Linearisation:
    """Log radiance of samples and its derivatives, ``(N, 3)`` each.

    Parameters
    ----------
    log_surface
        Logarithm of gain × radiance.
    noise
        Standard deviation of the logarithm of the image value.
    log_slope
        Logarithm of the derivative of ``log_surface`` with respect to the logarithm of the image value.
    by_contrast, by_haze, by_sky_gain
        Derivatives of ``log_surface`` with respect to log contrast, log haze and the log gain of the airlight.
    slope_by_contrast, slope_by_haze
        Derivatives of ``log_slope`` with respect to the same.
    """

    log_surface: np.ndarray
    noise: np.ndarray
    log_slope: np.ndarray
    by_contrast: np.ndarray
    by_haze: np.ndarray
    by_sky_gain: np.ndarray
    slope_by_contrast: np.ndarray
    slope_by_haze: np.ndarray


def _linearise(samples: CameraSamples, radiometry: RadiometricFit) -> _Linearisation:
    log_surface, _ = _log_surface(samples, radiometry)
    log_slope = _log_slope(samples, radiometry)
    more_contrast = replace(radiometry, contrast=radiometry.contrast * np.exp(_DIFFERENCE))
    more_haze = replace(radiometry, haze=radiometry.haze * np.exp(_DIFFERENCE))
    more_gain = replace(radiometry, log_sky_gain=radiometry.log_sky_gain + _DIFFERENCE)
    # Noise and rounding have a constant standard deviation in encoded values.
    noise = _IMAGE_SIGMA * 2.4 / np.maximum(srgb_from_linear(samples.value) + 0.055, 0.02)
    value_derivatives = (
        (_log_surface(samples, other)[0] - log_surface) / _DIFFERENCE for other in (more_contrast, more_haze, more_gain)
    )
    slope_derivatives = ((_log_slope(samples, other) - log_slope) / _DIFFERENCE for other in (more_contrast, more_haze))
    return _Linearisation(log_surface, noise, log_slope, *value_derivatives, *slope_derivatives)


def _log_slope(samples: CameraSamples, radiometry: RadiometricFit) -> np.ndarray:
    low, high = (
        _log_surface(replace(samples, value=samples.value * np.exp(sign * _DIFFERENCE)), radiometry)[0]
        for sign in (-0.5, 0.5)
    )
    return np.log(np.clip((high - low) / _DIFFERENCE, 1e-2, 1.0 / _MIN_SURFACE_SHARE))


@dataclass(frozen=True)
class _CameraDerivatives:
    """Derivatives of N residuals with respect to the parameters of one camera each.

    Parameters
    ----------
    camera
        ``(N,)`` index of the camera.
    by_gain, by_contrast
        ``(N, 3)`` with respect to log gain and log contrast.
    """

    camera: np.ndarray
    by_gain: np.ndarray
    by_contrast: np.ndarray


@dataclass(frozen=True)
class _Residuals:
    """N residuals per channel with their derivatives.

    Parameters
    ----------
    residual, variance
        ``(N, 3)``.
    cameras
        Derivatives with respect to the parameters of every camera involved.
    by_haze
        ``(N, 3)`` derivatives with respect to log haze.
    count
        ``(N,)`` number of independent observations that each row counts as.
    """

    residual: np.ndarray
    variance: np.ndarray
    cameras: tuple[_CameraDerivatives, ...]
    by_haze: np.ndarray
    count: np.ndarray


def _gauss_newton_step(
    overlaps: OverlapPairs,
    expected: np.ndarray | None,
    predicted_sigma: float,
    radiometry: RadiometricFit,
    prior: _GainPrior,
    free: np.ndarray,
) -> np.ndarray:
    """Step of log gains (channel by channel), log contrasts and log haze by reweighted least squares (Huber).

    Residuals are divided by the local slope of the tone curves; otherwise the flattest curves would fit best.
    """
    count = len(radiometry.contrast)
    residuals = [_overlap_residuals(overlaps, radiometry, prior.sees_sky)]
    if expected is not None:
        residuals.append(_predicted_residuals(overlaps.single, expected, predicted_sigma, radiometry, prior.sees_sky))
    matrix, gradient = _prior_equations(radiometry, prior, count)
    for block in residuals:
        for channel in range(3):
            jacobian, weight, residual = _channel_equations(block, channel, count)
            matrix += (jacobian.T @ jacobian.multiply(weight[:, None])).toarray()
            gradient += jacobian.T @ (weight * residual)
    # A contrast common to all cameras cannot be separated from that of the surface: only differences are fitted.
    shared = np.zeros(len(gradient))
    shared[3 * count : 4 * count] = 1e3
    matrix += np.outer(shared, shared)
    step = np.zeros(len(free))
    step[free] = np.linalg.solve(matrix[np.ix_(free, free)], -gradient[free])
    return step


def _by_gain(sees_sky: np.ndarray, camera: np.ndarray, samples: _Linearisation) -> np.ndarray:
    """Derivative ``(N, 3)`` of the log radiance of samples with respect to the log gain of their cameras.

    Airlight whose gain the sky tells stays as it is; without sky it has the gain of the surface. The slope that a residual
    is divided by counts as a weight here: else a gain that leaves nothing but airlight would fit best.
    """
    return np.where(sees_sky[camera][:, None], 0.0, samples.by_sky_gain) - 1.0


def _overlap_residuals(overlaps: OverlapPairs, radiometry: RadiometricFit, sees_sky: np.ndarray) -> _Residuals:
    """Differences of log radiance between the two cameras of each pair."""
    own, other = overlaps.own, overlaps.other
    left, right = _linearise(own, radiometry), _linearise(other, radiometry)
    error = left.log_surface - right.log_surface - radiometry.log_gain[own.camera] + radiometry.log_gain[other.camera]
    slope = np.exp(0.5 * (left.log_slope + right.log_slope))
    noise = left.noise**2 * np.exp(2.0 * left.log_slope) + right.noise**2 * np.exp(2.0 * right.log_slope)
    half = 0.5 * error
    by_own, by_other = _by_gain(sees_sky, own.camera, left), _by_gain(sees_sky, other.camera, right)
    return _Residuals(
        error / slope,
        noise / slope**2 + _SURFACE_SIGMA**2,
        (
            _CameraDerivatives(own.camera, by_own / slope, (left.by_contrast - half * left.slope_by_contrast) / slope),
            _CameraDerivatives(
                other.camera, -by_other / slope, (-right.by_contrast - half * right.slope_by_contrast) / slope
            ),
        ),
        (left.by_haze - right.by_haze - half * (left.slope_by_haze + right.slope_by_haze)) / slope,
        _independent_count(own.camera * len(radiometry.contrast) + other.camera),
    )


def _predicted_residuals(
    single: CameraSamples,
    expected: np.ndarray,
    predicted_sigma: float,
    radiometry: RadiometricFit,
    sees_sky: np.ndarray,
) -> _Residuals:
    """Differences of log radiance between each camera and the prediction."""
    known = np.asarray(np.isfinite(expected).all(axis=1))
    samples = _linearise(single[known], radiometry)
    camera, slope = single.camera[known], np.exp(samples.log_slope)
    error = samples.log_surface - expected[known] - radiometry.log_gain[camera]
    by_gain = _by_gain(sees_sky, camera, samples)
    return _Residuals(
        error / slope,
        samples.noise**2 + predicted_sigma**2,
        (
            _CameraDerivatives(
                camera, by_gain / slope, (samples.by_contrast - error * samples.slope_by_contrast) / slope
            ),
        ),
        (samples.by_haze - error * samples.slope_by_haze) / slope,
        _independent_count(camera),
    )


def _independent_count(group: np.ndarray) -> np.ndarray:
    """Number of independent observations ``(N,)`` that each row counts as, limited per group of rows."""
    _, number, members = np.unique(group, return_inverse=True, return_counts=True)
    return np.minimum(1.0 / _CORRELATED_POINTS, _MAX_POINTS_PER_PAIR / members)[number]


def _channel_equations(block: _Residuals, channel: int, count: int) -> tuple[Any, np.ndarray, np.ndarray]:
    """Sparse Jacobian ``(N, 4 K + 1)``, Huber weights ``(N,)`` and residuals ``(N,)`` of one channel."""
    from scipy import sparse

    rows = np.arange(len(block.residual))
    entries = [(rows, np.full(len(rows), 4 * count), block.by_haze[:, channel])]
    for derivatives in block.cameras:
        entries.append((rows, channel * count + derivatives.camera, derivatives.by_gain[:, channel]))
        entries.append((rows, 3 * count + derivatives.camera, derivatives.by_contrast[:, channel]))
    row, column, value = (np.concatenate(part) for part in zip(*entries, strict=True))
    jacobian = sparse.csr_array((value, (row, column)), shape=(len(rows), 4 * count + 1))
    residual, sigma = block.residual[:, channel], np.sqrt(block.variance[:, channel])
    weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(residual / sigma), 1e-9)) / sigma**2 * block.count
    return jacobian, weight, residual


def _prior_equations(radiometry: RadiometricFit, prior: _GainPrior, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix and gradient of the priors of gains, contrasts and haze."""
    weight = np.concatenate(
        [np.tile(1.0 / prior.sigma[:, 0] ** 2, 3), np.full(count, _CONTRAST_SIGMA**-2), [_HAZE_SIGMA**-2]]
    )
    deviation = np.concatenate(
        [
            (radiometry.log_gain - prior.mean).T.ravel(),
            np.log(radiometry.contrast) - _CONTRAST,
            [np.log(radiometry.haze)],
        ]
    )
    return np.diag(weight), weight * deviation
