"""Camera resection: the pose and field of view of a photograph or panorama from correspondences, a skyline, or both.

The unknowns are heading, tilt, roll, position (with GPS priors), field-of-view scale and, for a perspective camera, one
radial distortion coefficient. An initial rotation is found among all pairs of points, so that neither a start tens of
degrees off nor outliers matter. Minimisation with a robust loss (soft L1 or Cauchy) then identifies the inliers, and
least squares over the inliers gives the solution and its covariance (Hartley & Zisserman 2004, ch. 4 and 5).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from seasonscapes.calibration.evidence import PARAMETERS, Correspondences, Priors, select_points
from seasonscapes.calibration.ground_clearance import TOLERANCE_SIGMAS
from seasonscapes.calibration.initial_rotation import check_orientation, rotation_among_pairs
from seasonscapes.calibration.pose_model import View, parameters_of_view, pixel_error, view_from_parameters
from seasonscapes.calibration.pose_residuals import (
    ResectionProblem,
    SkylineEvidence,
    cauchy,
    depth_below_m,
    jacobian_at,
    minimise,
    point_errors,
    residual_rows,
    soft_l1,
)
from seasonscapes.cameras.lens import Lens
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.errors import CameraBelowGround, NotEnoughEvidence

Loss = Literal["cauchy", "l1", "squares"]
# Threshold on the residual of an inlier [standard deviations]: probability 0.999 of two pixel coordinates (χ², 2 dof).
OUTLIER_SIGMAS = 3.717


@dataclass(frozen=True)
class Calibration:
    """Result of a resection with its uncertainty.

    Parameters
    ----------
    view
        `Camera` (the ideal pinhole without the distortion ``k1``) or `Panorama`.
    k1
        Radial distortion coefficient.
    parameters, covariance
        Parameters ``(9,)`` in the order of `PARAMETERS` and their covariance ``(9, 9)``; zero variance where fixed.
    names, residual_px, outlier
        Of each correspondence: name, projected minus observed pixel ``(N, 2)`` [px], and whether it was rejected as an
        outlier ``(N,)``.
    noise_px
        Standard deviation of a pixel coordinate [px], as given or as estimated.
    skyline_rms_px
        Root mean square of the skyline residuals within three standard deviations [px]; NaN without a skyline.
    lens
        Distortion that was known beforehand and taken out of the picture; ``k1`` is then 0.
    """

    view: View
    k1: float
    parameters: np.ndarray
    covariance: np.ndarray
    names: tuple[str, ...]
    residual_px: np.ndarray
    outlier: np.ndarray
    noise_px: float
    skyline_rms_px: float = float("nan")
    lens: Lens = field(default_factory=Lens)

    @property
    def distortion(self) -> Lens:
        """The distortion of the pictures: the one known beforehand, or the solved ``k1``."""
        return Lens(k1=self.k1) if self.lens.is_ideal else self.lens

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each parameter by name; 0 where it was fixed."""
        return dict(zip(PARAMETERS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def rms_px(self) -> float:
        """Root mean square reprojection distance of **all** points, outliers included [px]."""
        return float(np.sqrt(np.mean(np.sum(self.residual_px**2, axis=1)))) if len(self.residual_px) else float("nan")

    @property
    def inlier_rms_px(self) -> float:
        """Root mean square reprojection distance of the inliers [px]."""
        inliers = self.residual_px[~self.outlier]
        return float(np.sqrt(np.mean(np.sum(inliers**2, axis=1)))) if len(inliers) else float("nan")

    @property
    def outlier_names(self) -> tuple[str, ...]:
        """Names of the outliers."""
        return tuple(name for name, is_outlier in zip(self.names, self.outlier, strict=True) if is_outlier)


@dataclass(frozen=True)
class ResectionOptions:
    """Options of the minimisation of `resect`.

    Parameters
    ----------
    loss
        Loss of the correspondences while outliers are identified: ``"cauchy"``, ``"l1"`` (soft L1), or ``"squares"``,
        which rejects none.
    noise_px
        Standard deviation of a pixel coordinate [px]. If omitted, it is estimated from the residuals, and the standard
        deviations of the result are widened for the few degrees of freedom (Student's t).
    guess
        Initial parameters ``(9,)`` where a better estimate than the mean of the priors exists.
    ground_m
        Function that returns the terrain height in the frame [m] at (east, north) [m], NaN where it is unknown. The camera is
        then kept above the ground: a camera on a slope is far less free than its position and height are singly, since
        what moves it into the slope has to lift it.
    ground_sigma_m
        Standard deviation of those heights [m].
    """

    loss: Loss = "cauchy"
    noise_px: float | None = None
    guess: np.ndarray | None = None
    ground_m: Callable[[float, float], float] | None = None
    ground_sigma_m: float = 1.0


def resect(
    start: View,
    points: Correspondences | None = None,
    *,
    skyline: SkylineEvidence | None = None,
    priors: Priors | None = None,
    k1: float = 0.0,
    axes: np.ndarray | None = None,
    options: ResectionOptions | None = None,
) -> Calibration:
    """Estimate the pose and field of view of one camera or panorama.

    Parameters
    ----------
    start
        Approximate view, the mean of the priors. With correspondences its heading is arbitrary.
    points, skyline
        Evidence; at least one of the two is required.
    priors
        Standard deviations about the start; `Priors()` if omitted.
    k1
        Radial distortion coefficient of the start.
    axes
        East, north and up at the camera, rows ``(3, 3)``; those of the frame's origin if omitted.
    options
        Loss, noise, initial parameters and ground; `ResectionOptions()` if omitted.

    Returns
    -------
    Calibration
        View, parameters, covariance and residuals.

    Raises
    ------
    NotEnoughEvidence
        If there are fewer points than unknowns without a prior require, the points are mirrored, flipped, in reverse
        order, behind the camera or have no common pose, or a parameter remains undetermined.
    CameraBelowGround
        If the solution lies more than five standard deviations of the heights below the ground, or the start more than five of
        its heights and of its own prior together.
    ValueError
        If neither points nor a skyline are given.
    """
    priors, options = priors or Priors(), options or ResectionOptions()
    axes = np.eye(3) if axes is None else np.asarray(axes, float)
    sigmas = priors.sigmas
    # A panorama has no radial distortion; the horizon row of a perspective camera is not separable from its tilt.
    sigmas[8 if isinstance(start, Camera) else 7] = 0.0
    origin = parameters_of_view(start, axes, k1)
    # A start is known as badly as its prior says: the evidence may lift it out of the ground.
    _check_above_ground(origin, options, "the start", sigma_m=float(np.hypot(options.ground_sigma_m, sigmas[5])))
    if points is None and skyline is None:
        raise ValueError("resect: neither points nor a skyline given")
    parameters = origin.copy() if options.guess is None else np.array(options.guess, float)
    if points is not None and (len(points) or skyline is None):
        _check_point_count(len(points), sigmas, skyline is not None)
        rotation = rotation_among_pairs(start, k1, points)
        check_orientation(start, k1, points, rotation, axes)
        parameters[:3] = parameters_of_view(_with_rotation(start, rotation), axes)[:3]
        for angle in range(3):
            if sigmas[angle] == 0.0:
                parameters[angle] = origin[angle]
    if points is None:
        points = Correspondences(np.empty((0, 2)), np.empty((0, 3)))
    problem = ResectionProblem(start, axes, origin, sigmas, points, skyline, options.ground_m, options.ground_sigma_m)
    parameters, outlier, noise = _solve(problem, parameters, options.loss, options.noise_px)
    calibration = _calibration(problem, parameters, outlier, noise, widen=options.noise_px is None)
    _check_above_ground(parameters, options, "the solution", sigma_m=options.ground_sigma_m)
    return calibration


def leave_one_out(
    start: View,
    points: Correspondences,
    *,
    skyline: SkylineEvidence | None = None,
    priors: Priors | None = None,
    k1: float = 0.0,
    axes: np.ndarray | None = None,
    options: ResectionOptions | None = None,
) -> np.ndarray:
    """Compute leave-one-out reprojection errors: each point is predicted by a resection from all other points.

    Parameters
    ----------
    start
        Approximate view.
    points
        Correspondences of N points.
    skyline, priors, k1, axes, options
        As in `resect`.

    Returns
    -------
    ndarray
        Projected minus observed pixel ``(N, 2)`` [px].

    Raises
    ------
    NotEnoughEvidence, CameraBelowGround
        As `resect`.
    """
    errors, frame_axes = np.empty((len(points), 2)), np.eye(3)
    for i in range(len(points)):
        others = select_points(points, np.arange(len(points)) != i)
        solved = resect(start, others, skyline=skyline, priors=priors, k1=k1, axes=axes, options=options)
        parameters = parameters_of_view(solved.view, frame_axes, solved.k1)
        errors[i] = pixel_error(solved.view, frame_axes, parameters, select_points(points, [i]))[0][0]
    return errors


def _with_rotation(view: View, rotation: np.ndarray) -> View:
    pose = view.world_from_camera.copy()
    pose[:3, :3] = rotation
    return replace(view, world_from_camera=pose)


def _check_point_count(count: int, sigmas: np.ndarray, has_skyline: bool) -> None:
    unknowns = int(np.isinf(sigmas).sum())
    needed = 1 if has_skyline else max(3, int(np.ceil(unknowns / 2)))
    if count < needed:
        raise NotEnoughEvidence(f"{count} points for {unknowns} unknowns without a prior: at least {needed} are needed")


def _check_above_ground(parameters: np.ndarray, options: ResectionOptions, what: str, *, sigma_m: float) -> None:
    below = depth_below_m(options.ground_m, parameters)
    if below > TOLERANCE_SIGMAS * sigma_m:
        raise CameraBelowGround(
            f"{what} puts the camera {below:.0f} m below ground; check its height and vertical datum"
        )


def _solve(
    problem: ResectionProblem, parameters: np.ndarray, loss: Loss, noise_px: float | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Parameters ``(9,)``, outliers ``(N,)`` and noise [px]: a robust loss of decreasing width, then least squares."""
    count = len(problem.points)
    all_points = np.ones(count, bool)
    noise = noise_px or 1.0
    if not count:
        return minimise(problem, parameters, noise, None, all_points)[0], ~all_points, noise
    if loss == "squares":
        for _ in range(2 if noise_px is None else 1):
            parameters, jacobian = minimise(problem, parameters, noise, None, all_points)
            noise = noise_px or _rms_noise(problem, parameters, all_points, _effective_parameters(problem, jacobian))
        return parameters, ~all_points, noise
    widest = max(0.005 * problem.start.width_px / noise, 3.0)
    for scale in (widest, widest / 5.0, 1.0):
        parameters, _ = minimise(
            problem, parameters, noise, lambda e, c=scale: soft_l1(e, c), all_points, tolerance=1e-4
        )
    robust_loss = cauchy if loss == "cauchy" else soft_l1
    for _ in range(3):
        if noise_px is None:
            noise = _median_noise(problem, parameters)
        parameters, _ = minimise(problem, parameters, noise, lambda e: robust_loss(e, 2.0), all_points, tolerance=1e-6)
    parameters, inlier, noise = _refine_inliers(problem, parameters, all_points, noise, noise_px)
    return _test_influential_points(problem, parameters, inlier, noise, noise_px)


def _refine_inliers(
    problem: ResectionProblem, parameters: np.ndarray, inlier: np.ndarray, noise: float, noise_px: float | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Alternate least squares over the inliers and their classification until the inliers no longer change."""
    parameter_count = float(problem.free.sum())
    for _ in range(8):
        error = np.linalg.norm(point_errors(problem, parameters), axis=1)
        selected = error <= _outlier_threshold(2 * int(inlier.sum()) - parameter_count, noise_px is None) * noise
        _check_agreement(problem, selected, error)
        parameters, jacobian = minimise(problem, parameters, noise, None, selected)
        parameter_count = _effective_parameters(problem, jacobian)
        if noise_px is None:
            noise = _rms_noise(problem, parameters, selected, parameter_count)
        converged = (selected == inlier).all()
        inlier = selected
        if converged:
            break
    return parameters, inlier, noise


def _outlier_threshold(degrees_of_freedom: float, noise_is_estimated: bool) -> float:
    """Residual in standard deviations that an inlier exceeds with probability 0.001 (χ², or F if σ is estimated)."""
    if not noise_is_estimated:
        return OUTLIER_SIGMAS
    # Not by scipy.stats, which takes half a second to import.
    from scipy.special import fdtri

    return float(np.sqrt(2.0 * fdtri(2.0, max(degrees_of_freedom, 2.0), 0.999)))


def _effective_parameters(problem: ResectionProblem, jacobian: np.ndarray) -> float:
    """Effective number of parameters determined by the data rather than by priors (trace of the resolution matrix)."""
    sigmas = problem.sigmas[problem.free]
    try:
        variance = np.diag(np.linalg.inv(jacobian.T @ jacobian))
    except np.linalg.LinAlgError:
        return float(len(sigmas))
    return float(len(sigmas) - np.sum(np.where(np.isfinite(sigmas), np.minimum(variance / sigmas**2, 1.0), 0.0)))


def _test_influential_points(
    problem: ResectionProblem, parameters: np.ndarray, inlier: np.ndarray, noise: float, noise_px: float | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Omit each point of high leverage in turn and keep the solution of the smallest truncated sum of squares.

    An isolated outlier pulls the solution towards itself and leaves a small residual. Large sets are not affected.
    """
    if inlier.sum() > 40 or inlier.sum() <= 4:
        return parameters, ~inlier, noise
    jacobian = jacobian_at(problem, parameters, noise, None, inlier)
    threshold = _outlier_threshold(2 * int(inlier.sum()) - _effective_parameters(problem, jacobian), noise_px is None)
    # The first rows of the Jacobian are the x and y residuals of the inliers, alternating.
    hat = np.einsum("ij,jk,ik->i", jacobian, np.linalg.pinv(jacobian.T @ jacobian), jacobian)
    leverage = hat[: 2 * int(inlier.sum())].reshape(-1, 2).max(axis=1)

    def cost(trial: np.ndarray) -> float:
        error = np.linalg.norm(point_errors(problem, trial), axis=1) / noise
        other_rows = residual_rows(problem, trial[None], noise, None, np.zeros(len(problem.points), bool))
        return float(np.sum(np.minimum(error, threshold) ** 2) + np.sum(other_rows**2))

    best, best_cost = parameters, cost(parameters)
    for index in np.flatnonzero(inlier)[leverage > 0.5]:
        remaining = inlier.copy()
        remaining[index] = False
        trial, _ = minimise(problem, parameters, noise, lambda e: cauchy(e, 2.0), remaining, tolerance=1e-6)
        trial, _ = minimise(problem, trial, noise, lambda e: cauchy(e, 2.0), np.ones_like(inlier), tolerance=1e-6)
        trial_cost = cost(trial)
        if trial_cost < best_cost - 1.0:
            best, best_cost = trial, trial_cost
    if best is not parameters:
        parameters, inlier, noise = _refine_inliers(problem, best, inlier, noise, noise_px)
    return parameters, ~inlier, noise


def _median_noise(problem: ResectionProblem, parameters: np.ndarray) -> float:
    """Standard deviation of a pixel coordinate [px] from the median residual, corrected for the fitted parameters."""
    count = len(problem.points)
    unfitted_fraction = max(1.0 - float(problem.free.sum()) / (2.0 * count), 0.2)
    # The median of a Rayleigh distribution is 1.1774 sigma.
    median = float(np.median(np.linalg.norm(point_errors(problem, parameters), axis=1)))
    return max(median / 1.1774 / np.sqrt(unfitted_fraction), 1e-3)


def _rms_noise(problem: ResectionProblem, parameters: np.ndarray, inlier: np.ndarray, parameter_count: float) -> float:
    """Standard deviation of a pixel coordinate [px] from the squared residuals of the inliers."""
    degrees_of_freedom = max(2.0 * inlier.sum() - parameter_count, 1.0)
    return max(float(np.sqrt(np.sum(point_errors(problem, parameters)[inlier] ** 2) / degrees_of_freedom)), 1e-6)


def _check_agreement(problem: ResectionProblem, inlier: np.ndarray, error: np.ndarray) -> None:
    unknowns = int(np.isinf(problem.sigmas).sum())
    needed = max(3, int(np.ceil(unknowns / 2)))
    limit = 0.04 * problem.start.width_px
    if problem.skyline is None and (inlier.sum() < needed or np.median(error) > limit):
        raise NotEnoughEvidence(
            f"the correspondences have no pose in common: {int(inlier.sum())} of {len(inlier)} agree, median error "
            f"{np.median(error):.0f} px; check their pairing and the camera's position"
        )


def _calibration(
    problem: ResectionProblem, parameters: np.ndarray, outlier: np.ndarray, noise: float, *, widen: bool
) -> Calibration:
    """Assemble the result: covariance (widened for an estimated noise), residuals and skyline residuals."""
    view, k1 = view_from_parameters(problem.start, problem.axes, parameters), float(parameters[7])
    residual, in_front = pixel_error(problem.start, problem.axes, parameters, problem.points)
    if not in_front.all():
        names = ", ".join(np.array(problem.points.names)[~in_front])
        raise NotEnoughEvidence(
            f"behind the camera: {names}; a correspondence is wrong, or the camera faces another direction"
        )
    jacobian = jacobian_at(problem, parameters, noise, None, ~outlier)
    covariance = _covariance(problem, jacobian)
    if widen and len(residual):
        from scipy.special import stdtrit

        degrees_of_freedom = max(2.0 * (~outlier).sum() - _effective_parameters(problem, jacobian), 1.0)
        # ± 2 sigma then covers 95.45 % although sigma itself is estimated.
        covariance = covariance * (stdtrit(degrees_of_freedom, 0.97725) / 2.0) ** 2
    skyline_rms = float("nan")
    if problem.skyline is not None:
        skyline_residual = problem.skyline.residuals(parameters)
        agrees = np.abs(skyline_residual) < 3.0 * problem.skyline.sigma_px
        skyline_rms = float(np.sqrt(np.mean(skyline_residual[agrees] ** 2))) if agrees.any() else float("nan")
    parameters = parameters.copy()
    parameters[0] %= 360.0
    return Calibration(view, k1, parameters, covariance, problem.points.names, residual, outlier, noise, skyline_rms)


def _covariance(problem: ResectionProblem, jacobian: np.ndarray) -> np.ndarray:
    """Covariance ``(9, 9)`` of the parameters: inverse of the information matrix, zero for fixed parameters."""
    free = np.flatnonzero(problem.free)
    information = jacobian.T @ jacobian
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if eigenvalues[0] < 1e-11:
        undetermined = PARAMETERS[free[int(np.argmax(np.abs(vectors[:, 0])))]]
        raise NotEnoughEvidence(
            f"the evidence leaves {undetermined} undetermined; add points elsewhere in the image, or give it a prior"
        )
    covariance = np.zeros((9, 9))
    covariance[np.ix_(free, free)] = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return covariance


def report_lines(calibration: Calibration) -> Sequence[str]:
    """Format a calibration as lines of text.

    Parameters
    ----------
    calibration
        Result of `resect`.

    Returns
    -------
    sequence of str
        One line per parameter with its standard deviation, the RMS reprojection error, and one line per correspondence
        with its residual [px].
    """
    lines = []
    for name, value in zip(PARAMETERS, calibration.parameters, strict=True):
        sigma = calibration.sigma[name]
        displayed = float(np.exp(value)) if name == "focal" else float(value)
        lines.append(f"{name:12s} {displayed:14.4f}  {'fixed' if sigma == 0 else f'± {sigma:.4f}'}")
    if len(calibration.names):
        inliers = f"{calibration.inlier_rms_px:.2f} px without {int(calibration.outlier.sum())} outliers"
        lines.append(f"RMS {calibration.rms_px:.2f} px of {len(calibration.names)} points, {inliers}")
    for name, error, is_outlier in zip(calibration.names, calibration.residual_px, calibration.outlier, strict=True):
        lines.append(f"  {name:12s} {error[0]:8.2f} {error[1]:8.2f} px{'  outlier' if is_outlier else ''}")
    return lines
