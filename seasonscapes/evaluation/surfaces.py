"""Errors of recovered surface quantities against the ground truth: albedo and shadows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.evaluation.metrics import angle_deg


@dataclass(frozen=True)
class AlbedoError:
    """Errors of an albedo, as weighted means over texels.

    Parameters
    ----------
    mae, rmse
        Mean absolute and root mean square error.
    psnr_db
        Peak signal-to-noise ratio ``-20 log10(rmse)`` [dB].
    scale
        Factors ``(3,)`` per channel that fit the estimate to the truth in least squares.
    scale_invariant_mae, scale_invariant_rmse
        Errors after multiplication with ``scale``, independent of exposure and white balance.
    colour_angle_deg
        Mean angle between colours [deg].
    """

    mae: float
    rmse: float
    psnr_db: float
    scale: np.ndarray
    scale_invariant_mae: float
    scale_invariant_rmse: float
    colour_angle_deg: float


def albedo_error(truth: np.ndarray, estimate: np.ndarray, weight: np.ndarray | None = None) -> AlbedoError:
    """Compute the errors of an albedo against the ground truth.

    Parameters
    ----------
    truth, estimate
        Albedos ``(..., 3)``.
    weight
        Weight ``(...)`` of each texel, such as its area or visibility; equal weights if omitted.

    Returns
    -------
    AlbedoError
        Weighted mean errors.

    Raises
    ------
    ValueError
        If the shapes differ, no texel has a positive weight, or the estimate is not finite where the weight is positive.
    """
    truth, estimate = np.asarray(truth, np.float64), np.asarray(estimate, np.float64)
    if truth.shape != estimate.shape or truth.shape[-1] != 3:
        raise ValueError(f"albedo_error: got shapes {truth.shape} and {estimate.shape}, expected equal (..., 3)")
    weight = np.ones(truth.shape[:-1]) if weight is None else np.asarray(weight, np.float64)
    kept = weight > 0.0
    if not kept.any():
        raise ValueError("albedo_error: no texel has a positive weight")
    truth, estimate, weight = truth[kept], estimate[kept], weight[kept] / weight[kept].sum()
    if not np.isfinite(estimate).all():
        raise ValueError("albedo_error: the estimate is not finite where the weight is positive")

    def mean(values: np.ndarray) -> float:
        return float(weight @ values.mean(axis=1))

    power = weight @ estimate**2
    scale = np.where(power > 0.0, (weight @ (truth * estimate)) / np.where(power > 0.0, power, 1.0), 1.0)
    error, scaled_error = np.abs(estimate - truth), np.abs(estimate * scale - truth)
    rmse = float(np.sqrt(mean(error**2)))
    return AlbedoError(
        mean(error),
        rmse,
        float("inf") if rmse == 0.0 else float(-20.0 * np.log10(rmse)),
        scale,
        mean(scaled_error),
        float(np.sqrt(mean(scaled_error**2))),
        angle_deg(truth, estimate),
    )


def shadow_iou(truth_lit: np.ndarray, estimate_lit: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Compute the intersection over union of two shadow maps.

    Parameters
    ----------
    truth_lit, estimate_lit
        Visible fraction of the light source ``(...)``, 0 to 1; values below one half are shadow.
    mask
        ``(...)`` bool, True where the maps are compared; everywhere if omitted.

    Returns
    -------
    float
        Intersection over union; 1 if neither map has a shadow within the mask.

    Raises
    ------
    ValueError
        If the shapes differ.
    """
    shadows = [np.asarray(lit) < 0.5 for lit in (truth_lit, estimate_lit)]
    if shadows[0].shape != shadows[1].shape:
        raise ValueError(f"shadow_iou: got shapes {shadows[0].shape} and {shadows[1].shape}, expected equal shapes")
    if mask is not None:
        shadows = [shadow & mask for shadow in shadows]
    union = np.count_nonzero(shadows[0] | shadows[1])
    return 1.0 if union == 0 else np.count_nonzero(shadows[0] & shadows[1]) / union
