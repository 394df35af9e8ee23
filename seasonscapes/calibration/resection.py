"""One pose per panorama or photograph from what is known of it: matched points, the skyline, or both.

The unknowns are heading, tilt, roll, position (with GPS priors), field-of-view scale and, for a lens, one radial term.
A rotation is found first among all pairs of points, so that neither a start tens of degrees off nor wrong matches
matter; a robust loss (L1-like or Cauchy) then finds who belongs to the solution; least squares over those gives the
answer and its covariance (Hartley & Zisserman 2004, ch. 4 and 5).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from seasonscapes.calibration.evidence import PARAMETERS, Correspondences, Priors, take
from seasonscapes.calibration.initial_rotation import check_orientation, rotation_among_pairs
from seasonscapes.calibration.pose_model import View, pixel_error, values_of, view_from_values
from seasonscapes.cameras.pinhole import Camera

Loss = Literal["cauchy", "l1", "squares"]
# Two pixel coordinates of a true match stay within this many sigmas with a chance of 0.999 (χ² of two degrees).
OUTLIER_SIGMAS = 3.717


@dataclass(frozen=True)
class Calibration:
    """A solved view with its error bars.

    Parameters
    ----------
    view
        `Camera` (the ideal pinhole behind ``k1``) or `Panorama`.
    k1
        Radial term of the lens.
    values, covariance
        Unknowns ``(9,)`` in the order of `PARAMETERS` and their covariance ``(9, 9)``; zero where held fixed.
    names, residual_px, outlier
        Of each matched point: name, projected minus observed ``(N, 2)`` [px], and whether it was set aside.
    noise_px
        Standard deviation of a pixel coordinate, as given or as estimated.
    skyline_rms_px
        Of the skyline pixels that agree; NaN where there was no skyline.
    """

    view: View
    k1: float
    values: np.ndarray
    covariance: np.ndarray
    names: tuple[str, ...]
    residual_px: np.ndarray
    outlier: np.ndarray
    noise_px: float
    skyline_rms_px: float = float("nan")

    @property
    def sigma(self) -> dict[str, float]:
        """Standard deviation of each unknown; 0 where it was held fixed."""
        return dict(zip(PARAMETERS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def rms_px(self) -> float:
        """Root mean square reprojection distance of **all** points [px]."""
        return float(np.sqrt(np.mean(np.sum(self.residual_px**2, axis=1)))) if len(self.residual_px) else float("nan")

    @property
    def inlier_rms_px(self) -> float:
        """The same of the points that were not set aside [px]."""
        kept = self.residual_px[~self.outlier]
        return float(np.sqrt(np.mean(np.sum(kept**2, axis=1)))) if len(kept) else float("nan")

    @property
    def outlier_names(self) -> tuple[str, ...]:
        """Names of the points that were set aside."""
        return tuple(name for name, out in zip(self.names, self.outlier, strict=True) if out)


@dataclass(frozen=True)
class ResectionProblem:
    """Everything a solver step needs, gathered once."""

    start: View
    axes: np.ndarray
    origin: np.ndarray
    sigmas: np.ndarray
    points: Correspondences
    extra: Callable[[View, float], np.ndarray] | None
    extra_sigma: float

    @property
    def free(self) -> np.ndarray:
        return self.sigmas > 0


def resect(
    start: View,
    points: Correspondences | None = None,
    *,
    priors: Priors | None = None,
    skyline: SkylineEvidence | None = None,
    loss: Loss = "cauchy",
    noise_px: float | None = None,
    k1: float = 0.0,
    axes: np.ndarray | None = None,
    guess: np.ndarray | None = None,
    ground_m: Callable[[float, float], float] | None = None,
) -> Calibration:
    """Solve for one view.

    Parameters
    ----------
    start
        Where the camera is thought to be and to look. With points the heading may be anything.
    points, skyline
        The evidence; at least one of them.

    Other parameters
    ----------------
    priors
        Standard deviations about the start; `Priors()` when left out.
    loss
        How matches that do not fit are treated while it is found out which they are; ``"squares"`` keeps them all.
    noise_px
        Standard deviation of a pixel coordinate; estimated from the residuals when left out, and the stated errors are
        then widened for the few degrees of freedom (Student's t).
    k1
        Radial term to start from.
    axes
        East, north and up of the camera's own horizon, rows ``(3, 3)``; the frame's when left out.
    guess
        Unknowns ``(9,)`` to begin from where they are better known than the start that the priors speak about.
    ground_m
        Height of the terrain in the frame at (east, north) [m].

    Raises
    ------
    ValueError
        No evidence; fewer points than unknowns need; points behind the camera; mirrored, flipped or reversed matches;
        matches without a common pose; unknowns that the evidence leaves open; a camera below ground.
    """
    priors = priors or Priors()
    axes = np.eye(3) if axes is None else np.asarray(axes, float)
    sigmas = priors.sigmas
    # A panorama has no lens term, a photograph no horizon of its own apart from its tilt.
    sigmas[8 if isinstance(start, Camera) else 7] = 0.0
    origin = values_of(start, axes, k1)
    if ground_m is not None:
        _refuse_below_ground(origin, ground_m, "the start")
    if points is None and skyline is None:
        raise ValueError("calibrate: neither points nor a skyline given")
    values = origin.copy() if guess is None else np.array(guess, float)
    if points is not None and (len(points) or skyline is None):
        _refuse_too_few(len(points), sigmas, skyline is not None)
        rotation = rotation_among_pairs(start, k1, points)
        check_orientation(start, k1, points, rotation, axes)
        values[:3] = values_of(_turned(start, rotation), axes)[:3]
        for angle in range(3):
            # An angle held fixed stays at its start.
            if sigmas[angle] == 0.0:
                values[angle] = origin[angle]
    empty = Correspondences(np.empty((0, 2)), np.empty((0, 3)))
    problem = ResectionProblem(
        start,
        axes,
        origin,
        sigmas,
        empty if points is None else points,
        skyline.residuals if skyline else None,
        skyline.sigma_px if skyline else 1.0,
    )
    values, outlier, noise = _solve(problem, values, loss, noise_px)
    result = _finish(problem, values, outlier, noise, widen=noise_px is None)
    if ground_m is not None:
        _refuse_below_ground(values, ground_m, "the solution")
    return result


def leave_one_out(start: View, points: Correspondences, **options) -> np.ndarray:
    """Error of each point ``(N, 2)`` [px] as predicted by a calibration that never saw it; options as `resect`."""
    errors, axes = np.empty((len(points), 2)), np.eye(3)
    for i in range(len(points)):
        rest = resect(start, take(points, np.arange(len(points)) != i), **options)
        errors[i] = pixel_error(rest.view, axes, values_of(rest.view, axes, rest.k1), take(points, [i]))[0][0]
    return errors


def _turned(view: View, rotation: np.ndarray) -> View:
    from dataclasses import replace

    pose = view.world_from_camera.copy()
    pose[:3, :3] = rotation
    return replace(view, world_from_camera=pose)


def _refuse_too_few(count: int, sigmas: np.ndarray, has_skyline: bool) -> None:
    unknowns = int(np.isinf(sigmas).sum())
    needed = 1 if has_skyline else max(3, int(np.ceil(unknowns / 2)))
    if count < needed:
        raise ValueError(f"{count} points for {unknowns} unknowns without a prior: at least {needed} are needed")


def _refuse_below_ground(values: np.ndarray, ground_m: Callable, what: str, *, tolerance_m: float = 5.0) -> None:
    below = float(ground_m(values[3], values[4])) - values[5]
    if below > tolerance_m:
        raise ValueError(f"{what} puts the camera {below:.0f} m below ground; check its height and vertical datum")


def _residual_rows(
    problem: ResectionProblem, values: np.ndarray, noise: float, shape: Callable | None, keep: np.ndarray
) -> np.ndarray:
    """Whitened residuals: points, further evidence and priors. ``shape`` bends point residuals to a robust loss."""
    rows = []
    if len(problem.points):
        error = _errors(problem, values)[keep] / noise
        rows.append((error if shape is None else shape(error)).ravel())
    if problem.extra is not None:
        view = view_from_values(problem.start, problem.axes, values)
        rows.append(_cauchy(problem.extra(view, values[7])[:, None] / problem.extra_sigma, 2.0).ravel())
    held = problem.free & np.isfinite(problem.sigmas)
    offset = values - problem.origin
    offset[0] = (offset[0] + 180.0) % 360.0 - 180.0
    rows.append(offset[held] / problem.sigmas[held])
    return np.concatenate(rows)


def _cauchy(error: np.ndarray, scale: float) -> np.ndarray:
    """Vectors ``(N, D)`` whose squared length is ``c² log(1 + |e|²/c²)``."""
    squared = np.sum(error**2, axis=1, keepdims=True)
    bent = scale**2 * np.log1p(squared / scale**2)
    return error * np.sqrt(np.divide(bent, squared, out=np.ones_like(squared), where=squared > 1e-20))


def _soft_l1(error: np.ndarray, scale: float) -> np.ndarray:
    """Vectors whose squared length is ``2c² (√(1 + |e|²/c²) - 1)``: the distance itself, rounded at its foot."""
    squared = np.sum(error**2, axis=1, keepdims=True)
    bent = 2.0 * scale**2 * (np.sqrt(1.0 + squared / scale**2) - 1.0)
    return error * np.sqrt(np.divide(bent, squared, out=np.ones_like(squared), where=squared > 1e-20))


def _minimise(
    problem: ResectionProblem,
    values: np.ndarray,
    noise: float,
    shape: Callable | None,
    keep: np.ndarray,
    *,
    tolerance: float = 1e-10,
):
    from scipy.optimize import least_squares

    free = problem.free

    def rows(moving):
        trial = values.copy()
        trial[free] = moving
        return _residual_rows(problem, trial, noise, shape, keep)

    # Steps of comparable effect: a hundredth of a degree, metres, a thousandth.
    scale = np.array([0.1, 0.1, 0.1, 10.0, 10.0, 10.0, 0.01, 0.02, 5.0])[free]
    solved = least_squares(
        rows, values[free], x_scale=scale, xtol=tolerance, ftol=tolerance, gtol=tolerance, max_nfev=200
    )
    result = values.copy()
    result[free] = solved.x
    return result, solved.jac


def _solve(problem: ResectionProblem, values: np.ndarray, loss: Loss, noise_px: float | None):
    """Unknowns, outliers ``(N,)`` and noise [px]: from a wide robust loss to least squares over those that agree."""
    count = len(problem.points)
    everyone = np.ones(count, bool)
    noise = noise_px or 1.0
    if not count:
        for _ in range(3):
            values, _ = _minimise(problem, values, noise, None, everyone)
        return values, ~everyone, noise
    if loss == "squares":
        for _ in range(2 if noise_px is None else 1):
            values, jacobian = _minimise(problem, values, noise, None, everyone)
            noise = noise_px or _noise(problem, values, everyone, _carried(problem, jacobian))
        return values, ~everyone, noise
    wide = max(0.005 * problem.start.width_px / noise, 3.0)
    for scale in (wide, wide / 5.0, 1.0):
        values, _ = _minimise(problem, values, noise, lambda e, c=scale: _soft_l1(e, c), everyone, tolerance=1e-4)
    bend = _cauchy if loss == "cauchy" else _soft_l1
    for _ in range(3):
        if noise_px is None:
            noise = _median_noise(problem, values)
        values, _ = _minimise(problem, values, noise, lambda e: bend(e, 2.0), everyone, tolerance=1e-6)
    values, keep, noise = _settle(problem, values, everyone, noise, noise_px)
    return _second_opinions(problem, values, keep, noise, noise_px)


def _settle(problem: ResectionProblem, values: np.ndarray, keep: np.ndarray, noise: float, noise_px: float | None):
    """Least squares over those that agree and who agrees with it, in turn, until neither changes."""
    carried = float(problem.free.sum())
    for _ in range(8):
        error = np.linalg.norm(_errors(problem, values), axis=1)
        chosen = error <= _cut(2 * int(keep.sum()) - carried, noise_px is None) * noise
        _refuse_no_agreement(problem, chosen, error)
        values, jacobian = _minimise(problem, values, noise, None, chosen)
        carried = _carried(problem, jacobian)
        if noise_px is None:
            noise = _noise(problem, values, chosen, carried)
        settled = (chosen == keep).all()
        keep = chosen
        if settled:
            break
    return values, keep, noise


def _cut(freedom: float, estimated: bool) -> float:
    """How many sigmas a true match may miss by, with a chance of 0.999; more where sigma itself is a guess (F)."""
    if not estimated:
        return OUTLIER_SIGMAS
    from scipy.stats import f

    return float(np.sqrt(2.0 * f.ppf(0.999, 2, max(freedom, 2.0))))


def _carried(problem: ResectionProblem, jacobian: np.ndarray) -> float:
    """How many unknowns the evidence determines; one that its prior holds counts little (trace of the resolution)."""
    sigmas = problem.sigmas[problem.free]
    try:
        variance = np.diag(np.linalg.inv(jacobian.T @ jacobian))
    except np.linalg.LinAlgError:
        return float(len(sigmas))
    return float(len(sigmas) - np.sum(np.where(np.isfinite(sigmas), np.minimum(variance / sigmas**2, 1.0), 0.0)))


def _second_opinions(
    problem: ResectionProblem, values: np.ndarray, keep: np.ndarray, noise: float, noise_px: float | None
):
    """A wrong match that stands alone in its region bends the solution to itself; leave out each, see who agrees.

    The solution of the least truncated sum of squares is kept. Large sets do not need it.
    """
    if keep.sum() > 40 or keep.sum() <= 4:
        return values, ~keep, noise
    _, jacobian = _minimise(problem, values, noise, None, keep)
    cut = _cut(2 * int(keep.sum()) - _carried(problem, jacobian), noise_px is None)
    # Only a match that largely determines its own residual can hide (leverage of its two rows; rows come in pairs).
    hat = np.einsum("ij,jk,ik->i", jacobian, np.linalg.pinv(jacobian.T @ jacobian), jacobian)
    leverage = hat[: 2 * int(keep.sum())].reshape(-1, 2).max(axis=1)

    def cost(trial):
        error = np.linalg.norm(_errors(problem, trial), axis=1) / noise
        prior = _residual_rows(problem, trial, noise, None, np.zeros(len(problem.points), bool))
        return float(np.sum(np.minimum(error, cut) ** 2) + np.sum(prior**2))

    best, best_cost = values, cost(values)
    for index in np.flatnonzero(keep)[leverage > 0.5]:
        fewer = keep.copy()
        fewer[index] = False
        trial, _ = _minimise(problem, values, noise, lambda e: _cauchy(e, 2.0), fewer, tolerance=1e-6)
        trial, _ = _minimise(problem, trial, noise, lambda e: _cauchy(e, 2.0), np.ones_like(keep), tolerance=1e-6)
        trial_cost = cost(trial)
        if trial_cost < best_cost - 1.0:
            best, best_cost = trial, trial_cost
    if best is not values:
        values, keep, noise = _settle(problem, best, keep, noise, noise_px)
    return values, ~keep, noise


def _errors(problem: ResectionProblem, values: np.ndarray) -> np.ndarray:
    return pixel_error(problem.start, problem.axes, values, problem.points)[0]


def _unknowns_from_data(problem: ResectionProblem) -> int:
    """Unknowns that the points must carry; a prior carries its own."""
    return int(np.isinf(problem.sigmas).sum())


def _median_noise(problem: ResectionProblem, values: np.ndarray) -> float:
    # The median of a Rayleigh distribution is 1.1774 sigma; the fit has taken up some of the residuals.
    count = len(problem.points)
    share = max(1.0 - float(problem.free.sum()) / (2.0 * count), 0.2)
    return max(float(np.median(np.linalg.norm(_errors(problem, values), axis=1))) / 1.1774 / np.sqrt(share), 1e-3)


def _noise(problem: ResectionProblem, values: np.ndarray, keep: np.ndarray, carried: float) -> float:
    freedom = max(2.0 * keep.sum() - carried, 1.0)
    return max(float(np.sqrt(np.sum(_errors(problem, values)[keep] ** 2) / freedom)), 1e-6)


def _refuse_no_agreement(problem: ResectionProblem, chosen: np.ndarray, error: np.ndarray) -> None:
    needed = max(3, int(np.ceil(_unknowns_from_data(problem) / 2)))
    limit = 0.04 * problem.start.width_px
    if problem.extra is None and (chosen.sum() < needed or np.median(error) > limit):
        agree = f"{int(chosen.sum())} of {len(chosen)} agree"
        raise ValueError(
            f"the matches have no pose in common: {agree}, median error "
            f"{np.median(error):.0f} px; check their pairing and the camera's position"
        )


def _finish(
    problem: ResectionProblem, values: np.ndarray, outlier: np.ndarray, noise: float, *, widen: bool
) -> Calibration:
    view, k1 = view_from_values(problem.start, problem.axes, values), float(values[7])
    residual, front = pixel_error(problem.start, problem.axes, values, problem.points)
    if not front.all():
        names = ", ".join(np.array(problem.points.names)[~front])
        raise ValueError(f"behind the camera: {names}; a wrong match, or the picture looks another way")
    _, jacobian = _minimise(problem, values, noise, None, ~outlier)
    covariance = _covariance(problem, jacobian)
    if widen and len(residual):
        from scipy.stats import t

        freedom = max(2.0 * (~outlier).sum() - _carried(problem, jacobian), 1.0)
        # So that ± 2 sigma holds 95.45 % although sigma itself is estimated.
        covariance = covariance * (t.ppf(0.97725, freedom) / 2.0) ** 2
    skyline_rms = float("nan")
    if problem.extra is not None:
        misses = problem.extra(view, k1)
        agree = np.abs(misses) < 3.0 * problem.extra_sigma
        skyline_rms = float(np.sqrt(np.mean(misses[agree] ** 2))) if agree.any() else float("nan")
    values = values.copy()
    values[0] %= 360.0
    return Calibration(view, k1, values, covariance, problem.points.names, residual, outlier, noise, skyline_rms)


def _covariance(problem: ResectionProblem, jacobian: np.ndarray) -> np.ndarray:
    free = np.flatnonzero(problem.free)
    information = jacobian.T @ jacobian
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if eigenvalues[0] < 1e-11:
        worst = PARAMETERS[free[int(np.argmax(np.abs(vectors[:, 0])))]]
        raise ValueError(f"the evidence leaves {worst} open; add points elsewhere in the picture, or give it a prior")
    covariance = np.zeros((9, 9))
    covariance[np.ix_(free, free)] = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return covariance


def report_lines(calibration: Calibration) -> Sequence[str]:
    """A calibration as lines of text: the unknowns with their errors, and each point's residual."""
    lines = []
    for name, value in zip(PARAMETERS, calibration.values, strict=True):
        sigma = calibration.sigma[name]
        shown = float(np.exp(value)) if name == "focal" else float(value)
        lines.append(f"{name:12s} {shown:14.4f}  {'fixed' if sigma == 0 else f'± {sigma:.4f}'}")
    if len(calibration.names):
        kept = f"{calibration.inlier_rms_px:.2f} px without {int(calibration.outlier.sum())} set aside"
        lines.append(f"RMS {calibration.rms_px:.2f} px of {len(calibration.names)} points, {kept}")
    for name, error, out in zip(calibration.names, calibration.residual_px, calibration.outlier, strict=True):
        lines.append(f"  {name:12s} {error[0]:8.2f} {error[1]:8.2f} px{'  set aside' if out else ''}")
    return lines


@dataclass(frozen=True)
class SkylineEvidence:
    """Skyline pixels against a terrain's horizon.

    Parameters
    ----------
    residuals
        Function of a view and ``k1`` to signed misses ``(M,)`` [px].
    sigma_px
        Standard deviation of one miss, widened for neighbours that err together.
    """

    residuals: Callable[[View, float], np.ndarray]
    sigma_px: float = 1.0
