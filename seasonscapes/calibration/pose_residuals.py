"""What a pose is judged by: whitened residuals of points, skyline, priors and ground, and their least squares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from seasonscapes.calibration.evidence import Correspondences
from seasonscapes.calibration.ground_clearance import LEAST_ABOVE_GROUND_M
from seasonscapes.calibration.pose_model import View, pixel_error

# Maps whitened residual vectors (..., D) to vectors whose squared length is the robust loss.
RobustLoss = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class SkylineEvidence:
    """Residuals between the skyline in the image and the projected terrain horizon.

    Parameters
    ----------
    residuals
        Function of parameters ``(9,)`` or ``(P, 9)`` that returns signed residuals ``(M,)`` or ``(P, M)`` [px].
    sigma_px
        Standard deviation of one residual [px], enlarged for the correlation of neighbouring residuals.
    """

    residuals: Callable[[np.ndarray], np.ndarray]
    sigma_px: float = 1.0


@dataclass(frozen=True)
class ResectionProblem:
    """Inputs of one minimisation.

    Parameters
    ----------
    start
        View that the parameters refer to.
    axes
        East, north and up at the camera, rows ``(3, 3)``.
    origin, sigmas
        Means ``(9,)`` and standard deviations ``(9,)`` of the priors; 0 fixes a parameter, infinity omits its prior.
    points
        Correspondences; may be empty.
    skyline
        Skyline residuals, or ``None``.
    ground_m, ground_sigma_m
        See `resection.ResectionOptions`.
    """

    start: View
    axes: np.ndarray
    origin: np.ndarray
    sigmas: np.ndarray
    points: Correspondences
    skyline: SkylineEvidence | None
    ground_m: Callable[[float, float], float] | None = None
    ground_sigma_m: float = 1.0

    @property
    def free(self) -> np.ndarray:
        """Mask ``(9,)`` of the parameters that are not fixed."""
        return self.sigmas > 0


def point_errors(problem: ResectionProblem, parameters: np.ndarray) -> np.ndarray:
    """Projected minus observed pixel ``(N, 2)`` or ``(P, N, 2)`` of all points [px]."""
    return pixel_error(problem.start, problem.axes, parameters, problem.points)[0]


def depth_below_m(
    ground_m: Callable[[float, float], float] | None, parameters: np.ndarray, clearance_m: float = 0.0
) -> float:
    """How far below the ground, or below a clearance above it, the camera stands [m]; 0 where the ground is unknown."""
    if ground_m is None:
        return 0.0
    below = float(ground_m(parameters[3], parameters[4])) + clearance_m - parameters[5]
    return max(below, 0.0) if np.isfinite(below) else 0.0


def residual_rows(
    problem: ResectionProblem, parameters: np.ndarray, noise: float, robust_loss: RobustLoss | None, inlier: np.ndarray
) -> np.ndarray:
    """Whitened residuals ``(P, R)`` of parameters ``(P, 9)``: of inlier points (with a robust loss or none), skyline, priors."""
    rows = []
    if len(problem.points):
        error = point_errors(problem, parameters)[:, inlier] / noise
        rows.append((error if robust_loss is None else robust_loss(error)).reshape(len(parameters), -1))
    if problem.skyline is not None:
        rows.append(cauchy(problem.skyline.residuals(parameters)[..., None] / problem.skyline.sigma_px, 2.0)[..., 0])
    has_prior = problem.free & np.isfinite(problem.sigmas)
    offset = parameters - problem.origin
    offset[:, 0] = (offset[:, 0] + 180.0) % 360.0 - 180.0
    rows.append(offset[:, has_prior] / problem.sigmas[has_prior])
    if problem.ground_m is not None:
        below_m = [depth_below_m(problem.ground_m, each, LEAST_ABOVE_GROUND_M) for each in parameters]
        rows.append(np.array(below_m)[:, None] / problem.ground_sigma_m)
    return np.concatenate(rows, axis=1)


def cauchy(error: np.ndarray, scale: float) -> np.ndarray:
    """Cauchy loss: vectors ``(..., D)`` whose squared length is ``c² log(1 + |e|²/c²)``."""
    squared = np.sum(error**2, axis=-1, keepdims=True)
    loss = scale**2 * np.log1p(squared / scale**2)
    return error * np.sqrt(np.divide(loss, squared, out=np.ones_like(squared), where=squared > 1e-20))


def soft_l1(error: np.ndarray, scale: float) -> np.ndarray:
    """Soft L1 loss: vectors ``(..., D)`` whose squared length is ``2c² (√(1 + |e|²/c²) - 1)``."""
    squared = np.sum(error**2, axis=-1, keepdims=True)
    loss = 2.0 * scale**2 * (np.sqrt(1.0 + squared / scale**2) - 1.0)
    return error * np.sqrt(np.divide(loss, squared, out=np.ones_like(squared), where=squared > 1e-20))


def jacobian_at(
    problem: ResectionProblem, parameters: np.ndarray, noise: float, robust_loss: RobustLoss | None, inlier: np.ndarray
) -> np.ndarray:
    """Jacobian ``(R, F)`` of the residuals for the free parameters: forward differences, all in one evaluation."""
    free = np.flatnonzero(problem.free)
    size = np.sqrt(np.finfo(float).eps) * np.maximum(np.abs(parameters[free]), 1.0)
    trials = np.tile(parameters, (len(free) + 1, 1))
    trials[np.arange(len(free)), free] += np.where(parameters[free] < 0.0, -size, size)
    rows = residual_rows(problem, trials, noise, robust_loss, inlier)
    # The steps as they are after rounding.
    return ((rows[:-1] - rows[-1]) / (trials[np.arange(len(free)), free] - parameters[free])[:, None]).T


def minimise(
    problem: ResectionProblem,
    parameters: np.ndarray,
    noise: float,
    robust_loss: RobustLoss | None,
    inlier: np.ndarray,
    *,
    tolerance: float = 1e-10,
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters ``(9,)`` of the least sum of squared residuals, and the Jacobian there for the free parameters."""
    from scipy.optimize import least_squares

    free = problem.free

    def with_free(values: np.ndarray) -> np.ndarray:
        result = parameters.copy()
        result[free] = values
        return result

    # Characteristic steps of comparable effect on the residuals: [deg], [m], relative, k1, [px].
    scale = np.array([0.1, 0.1, 0.1, 10.0, 10.0, 10.0, 0.01, 0.02, 5.0])[free]
    solution = least_squares(
        lambda values: residual_rows(problem, with_free(values)[None], noise, robust_loss, inlier)[0],
        parameters[free],
        lambda values: jacobian_at(problem, with_free(values), noise, robust_loss, inlier),  # pyright: ignore[reportArgumentType]
        x_scale=scale,
        xtol=tolerance,
        ftol=tolerance,
        gtol=tolerance,
        max_nfev=200,
    )
    return with_free(solution.x), solution.jac
