"""How far what was recovered about the land is from the truth: albedo and shadows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.evaluation.metrics import angle_deg


@dataclass(frozen=True)
class AlbedoError:
    """Error of an albedo over the texels that count.

    Parameters
    ----------
    mae, rmse
        Mean absolute error, root of the mean squared error.
    psnr_db
        ``-20 log10(rmse)``.
    scale
        ``(3,)`` factors by which the estimate is best (in least squares) multiplied to meet the truth.
    scale_invariant_mae, scale_invariant_rmse
        After multiplying by ``scale``: blind to exposure and white balance.
    colour_angle_deg
        Mean angle between colours.
    """

    mae: float
    rmse: float
    psnr_db: float
    scale: np.ndarray
    scale_invariant_mae: float
    scale_invariant_rmse: float
    colour_angle_deg: float


def albedo_error(truth: np.ndarray, estimate: np.ndarray, weight: np.ndarray | None = None) -> AlbedoError:
    """Error of an albedo ``(..., 3)``, each texel weighed by ``weight`` ``(...)`` (its area, or whether it was seen).

    Raises
    ------
    ValueError
        Shapes differ, no texel has weight, or the estimate is not finite where it has.
    """
    truth, estimate = np.asarray(truth, np.float64), np.asarray(estimate, np.float64)
    if truth.shape != estimate.shape or truth.shape[-1] != 3:
        raise ValueError(f"albedo_error: shapes {truth.shape} and {estimate.shape}, expected (..., 3) twice")
    weight = np.ones(truth.shape[:-1]) if weight is None else np.asarray(weight, np.float64)
    kept = weight > 0.0
    if not kept.any():
        raise ValueError("albedo_error: no texel has weight")
    truth, estimate, weight = truth[kept], estimate[kept], weight[kept] / weight[kept].sum()
    if not np.isfinite(estimate).all():
        raise ValueError("albedo_error: the estimate is not finite")

    def mean(values: np.ndarray) -> float:
        return float(weight @ values.mean(axis=1))

    power = weight @ estimate**2
    scale = np.where(power > 0.0, (weight @ (truth * estimate)) / np.where(power > 0.0, power, 1.0), 1.0)
    off, scaled = np.abs(estimate - truth), np.abs(estimate * scale - truth)
    rmse = float(np.sqrt(mean(off**2)))
    return AlbedoError(
        mean(off),
        rmse,
        float("inf") if rmse == 0.0 else float(-20.0 * np.log10(rmse)),
        scale,
        mean(scaled),
        float(np.sqrt(mean(scaled**2))),
        angle_deg(truth, estimate),
    )


def shadow_iou(truth_lit: np.ndarray, estimate_lit: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Intersection over union of the shadows of two ``(...)`` maps of lit shares, 0 to 1, each cut at one half.

    1 where neither map has any shadow within the mask.
    """
    dark = [np.asarray(lit) < 0.5 for lit in (truth_lit, estimate_lit)]
    if dark[0].shape != dark[1].shape:
        raise ValueError(f"shadow_iou: shapes {dark[0].shape} and {dark[1].shape}")
    if mask is not None:
        dark = [each & mask for each in dark]
    union = np.count_nonzero(dark[0] | dark[1])
    return 1.0 if union == 0 else np.count_nonzero(dark[0] & dark[1]) / union
