"""Automatic camera resection from the skyline: align the terrain horizon to edges in the photograph.

The sky is not segmented. `boundary_map` measures at each pixel the likelihood of a skyline; a trial pose is scored by the
mean likelihood along its projected horizon and ridges. All poses in the search range are scored coarsely, and the best
few are refined to sub-pixel edges by `resect`. The result counts as reliable if no other heading scores similarly, enough
of the horizon coincides with edges, the heading is well determined, and it does not lie at the limit of the range.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from seasonscapes.calibration.boundary_map import BoundaryMap, boundary_map, edge_near
from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.pose_model import View, focal_scales, parameters_of_view, project_with_parameters
from seasonscapes.calibration.pose_residuals import SkylineEvidence
from seasonscapes.calibration.resection import Calibration, ResectionOptions, resect
from seasonscapes.calibration.terrain_horizon import Horizon, HorizonOptions, cell_size_m, horizon_from
from seasonscapes.cameras.panorama import Panorama
from seasonscapes.errors import ImageSizeMismatch, NoTerrainInView
from seasonscapes.frames import LocalFrame, geodetic_from_enu, local_axes
from seasonscapes.terrain.surface import Raster

# Maximum number of points of a line in the refinement.
_MAX_POINTS = 700
# Thresholds of a reliable fit, found in synthetic trials with fog, masks and wrong locations (benchmarks/calibration.py).
MIN_EDGE_FRACTION, MIN_SCORE_RATIO, MAX_HEADING_SIGMA_DEG, MIN_COLUMN_FRACTION = 0.6, 1.06, 0.12, 0.15


@dataclass(frozen=True)
class SearchRange:
    """Range of poses about the start that are searched, and the priors of the refinement.

    Parameters
    ----------
    heading_deg, tilt_deg, roll_deg
        Half ranges [deg]. For a panorama ``tilt_deg`` is also the half range of its horizon row, as an angle.
    focal
        Half range of the field-of-view scale, relative.
    k1
        Radial distortion coefficient of the start; it is not searched, and refined only where ``priors`` let it vary.
    terrain_sigma_m
        Standard deviation of the terrain height [m]; a third of a raster cell if ``None``.
    priors
        Standard deviations in the refinement. Those of the position matter most, because a skyline hardly constrains it.
    """

    heading_deg: float = 12.0
    tilt_deg: float = 4.0
    roll_deg: float = 2.0
    focal: float = 0.0
    k1: float = 0.0
    terrain_sigma_m: float | None = None
    priors: Priors = field(
        default_factory=lambda: Priors(tilt_deg=3.0, roll_deg=2.0, horizontal_m=3.0, vertical_m=3.0, focal=0.02)
    )


@dataclass(frozen=True)
class SkylineFit:
    """Result of a skyline alignment and its reliability.

    Parameters
    ----------
    calibration
        Calibrated view; ``None`` if no pose in the search range coincides with image edges.
    reliable
        Whether all criteria below are met.
    edge_fraction
        Fraction of the horizon within the image and the mask that coincides with an image edge, corrected for chance
        coincidences.
    score_ratio
        Score of the pose relative to the best pose more than 1° away in heading; infinite if there is none.
    heading_sigma_deg
        Standard deviation of the heading [deg].
    column_fraction
        Fraction of the image columns that the visible horizon crosses.
    doubts
        Description of each criterion that is not met; empty if reliable.
    horizon
        Terrain horizon at the start position.
    """

    calibration: Calibration | None
    reliable: bool
    edge_fraction: float
    score_ratio: float
    heading_sigma_deg: float
    column_fraction: float
    doubts: tuple[str, ...]
    horizon: Horizon


@dataclass(frozen=True)
class _SkylineProblem:
    """Inputs shared by the search, the refinement and the assessment.

    Parameters
    ----------
    start
        View that the parameters refer to.
    axes
        East, north and up at the camera, rows ``(3, 3)``.
    origin
        Parameters ``(9,)`` of the start.
    horizon
        Terrain horizon at the start position.
    terrain_sigma_m
        Standard deviation of the terrain height [m].
    boundary
        Edge likelihood of the photograph.
    search
        Search range.
    points
        Correspondences used in addition, or ``None``.
    """

    start: View
    axes: np.ndarray
    origin: np.ndarray
    horizon: Horizon
    terrain_sigma_m: float
    boundary: BoundaryMap
    search: SearchRange
    points: Correspondences | None

    @property
    def skyline_m(self) -> np.ndarray:
        """Skyline points ``(S, 3)`` [m] of the azimuths that have a skyline."""
        return self.horizon.skyline_m[np.isfinite(self.horizon.skyline_elevation_deg)]

    @property
    def pixels_per_degree(self) -> float:
        """Vertical resolution of the photograph [px/°]."""
        return self.start.fy * np.pi / 180.0


def align_to_skyline(
    image: np.ndarray,
    start: View,
    rasters: Sequence[Raster],
    frame: LocalFrame,
    *,
    mask: np.ndarray | None = None,
    search: SearchRange | None = None,
    points: Correspondences | None = None,
) -> SkylineFit:
    """Estimate the pose of a view from its skyline, or from skyline and correspondences together.

    Parameters
    ----------
    image
        Photograph ``(H, W, 3)`` uint8 sRGB.
    start
        Approximate view.
    rasters
        Elevation rasters, the most detailed first.
    frame
        Local frame of the view.
    mask
        ``(H, W)`` bool, False where foreground occludes the landscape.
    search
        Search range; `SearchRange()` if omitted.
    points
        Correspondences used in addition.

    Returns
    -------
    SkylineFit
        Calibration with its reliability. If ``reliable`` is False, ``doubts`` states why the pose should not be used.

    Raises
    ------
    NoTerrainInView
        If no terrain is visible from the start position, or the heights end before the skyline in every direction.
    CameraBelowGround
        If the start position lies more than 40 m below the ground.
    NoUsablePixels
        If the mask leaves less than 5 % of the image.
    NotEnoughEvidence
        If the correspondences contradict each other, or a parameter remains undetermined.
    ImageSizeMismatch
        If the image and the view differ in size.
    """
    search = search or SearchRange()
    if image.shape[:2] != (start.height_px, start.width_px):
        raise ImageSizeMismatch(
            f"align_to_skyline: the image is {image.shape[1]} x {image.shape[0]} px, expected "
            f"{start.width_px} x {start.height_px} as the view"
        )
    latitude, longitude, _ = geodetic_from_enu(frame, start.position_m)
    axes = local_axes(frame, float(latitude), float(longitude))
    origin = parameters_of_view(start, axes, search.k1)
    azimuth = _azimuths(start, origin, search)
    cell_m = cell_size_m(rasters[0])
    options = HorizonOptions(nearest_m=max(60.0, 3.0 * cell_m), below_ground_m=40.0)
    horizon = horizon_from(rasters, frame, start.position_m, azimuth_deg=azimuth, options=options)
    if not np.isfinite(horizon.skyline_elevation_deg).any():
        raise NoTerrainInView(
            "align_to_skyline: the heights end before the skyline in every direction of the camera; it takes heights that reach farther"
        )
    boundary = boundary_map(image, mask, start.fy * np.pi / 180.0)
    terrain_sigma_m = search.terrain_sigma_m or cell_m / 3.0
    problem = _SkylineProblem(start, axes, origin, horizon, terrain_sigma_m, boundary, search, points)
    poses, scores = _search_poses(problem)
    refined = [_refine(problem, poses[index]) for index in _best_distinct(poses, scores, 6)]
    fits = [fit for fit in refined if fit is not None]
    if not fits:
        reason = "no pose in the search range coincides with image edges"
        return SkylineFit(None, False, 0.0, 0.0, float("inf"), 0.0, (reason,), horizon)
    return _assess(problem, fits)


def _azimuths(start: View, origin: np.ndarray, search: SearchRange) -> np.ndarray:
    """Azimuths ``(A,)`` [deg] visible from any pose in the search range, in steps of about two thirds of a pixel."""
    if isinstance(start, Panorama):
        half, pitch = start.span_deg / 2.0, 1.0 / start.fx
        offset = np.degrees((0.5 * start.width_px - start.cx) / start.fx)
    else:
        half = np.degrees(np.arctan(1.15 * max(start.cx, start.width_px - start.cx) / start.fx)) + 4.0
        pitch, offset = 1.0 / start.fx, 0.0
    half = min(half * (1.0 + search.focal) + search.heading_deg + search.roll_deg, 180.0)
    step = float(np.clip(np.degrees(pitch) * 0.66, 0.015, 0.1))
    count = int(2.0 * half / step)
    return origin[0] + offset - half + (np.arange(count) + 0.5) * (2.0 * half / count)


def _search_poses(problem: _SkylineProblem) -> tuple[np.ndarray, np.ndarray]:
    """Parameters ``(P, 9)`` and scores ``(P,)`` of all poses in the range, in steps of 0.4° or of a coarse pixel.

    A small tilt shifts the projected horizon vertically (in a panorama the horizon row itself is shifted), so all tilts
    of a heading share one projection.
    """
    start, search, boundary, horizon = problem.start, problem.search, problem.boundary, problem.horizon
    per_degree = problem.pixels_per_degree
    step = float(np.clip(3.0 / per_degree / boundary.scale, 0.12, 0.4))
    headings = _steps(search.heading_deg, step)
    tilts = _steps(search.tilt_deg, step)
    skyline = problem.skyline_m
    skyline = skyline[:: max(1, int(len(skyline) / 500))]
    edges = horizon.edges_m[:: max(1, len(horizon.edges_m) // 300)]
    row_shift = np.round(tilts * per_degree * boundary.scale).astype(int)
    poses, scores = [], []
    is_panorama = isinstance(start, Panorama)
    tilt_offsets = tilts[:, None] * (per_degree * np.eye(9)[8] if is_panorama else np.eye(9)[1])
    # A tilted axis of a panorama turns its horizon into a sine curve; that is left to the local maximisation.
    for roll in np.zeros(1) if is_panorama else _steps(search.roll_deg, 1.0):
        for log_scale in _steps(np.log1p(search.focal), 0.03):
            for heading in headings:
                parameters = problem.origin + np.array([heading, 0.0, roll, 0, 0, 0, log_scale, 0, 0])
                scores.append(_pose_scores(problem, parameters, skyline, edges, row_shift))
                poses.append(parameters + tilt_offsets)
    return np.concatenate(poses), np.concatenate(scores)


def _steps(half: float, step: float) -> np.ndarray:
    count = int(np.ceil(half / step - 1e-9))
    return np.linspace(-half, half, 2 * count + 1) if count else np.zeros(1)


def _pose_scores(
    problem: _SkylineProblem, parameters: np.ndarray, skyline: np.ndarray, edges: np.ndarray, row_shift: np.ndarray
) -> np.ndarray:
    """Score ``(S,)`` of parameters ``(9,)`` at each downward shift in coarse pixels: skyline and a quarter of ridges."""
    boundary = problem.boundary
    score = _mean_likelihood(problem, parameters, skyline, boundary.coarse, row_shift)
    if len(edges) > 20:
        score = score + 0.25 * _mean_likelihood(problem, parameters, edges, boundary.coarse_edges, row_shift)
    return score


def _mean_likelihood(
    problem: _SkylineProblem,
    parameters: np.ndarray,
    position: np.ndarray,
    likelihood: np.ndarray,
    row_shift: np.ndarray,
) -> np.ndarray:
    """Mean likelihood ``(S,)`` along a projected line for each downward shift in coarse pixels.

    Points above or below the image count as zero, so that a pose is scored over all columns. Masked pixels are omitted.
    """
    start = problem.start
    pixel, in_front = project_with_parameters(start, problem.axes, parameters, position)
    column = np.floor(pixel[:, 0] * problem.boundary.scale).astype(int)
    if isinstance(start, Panorama) and start.full_circle:
        column %= likelihood.shape[1]
    use = in_front & (column >= 0) & (column < likelihood.shape[1])
    if use.sum() < 20:
        return np.zeros(len(row_shift))
    row = np.floor(pixel[use, 1] * problem.boundary.scale).astype(int) + row_shift[:, None]
    inside = (row >= 0) & (row < likelihood.shape[0])
    sampled = np.where(inside, likelihood[np.clip(row, 0, likelihood.shape[0] - 1), column[use]], 0.0)
    masked = np.isnan(sampled)
    return np.where(masked, 0.0, sampled).sum(axis=1) / np.maximum((~masked).sum(axis=1), 20)


def _best_distinct(poses: np.ndarray, scores: np.ndarray, count: int) -> list[int]:
    """Indices of the best poses that differ by more than 1° in heading or 8 % in scale."""
    chosen: list[int] = []
    for index in np.argsort(scores)[::-1]:
        difference = np.abs(poses[index] - poses[chosen])
        if np.all((difference[:, 0] > 1.0) | (difference[:, 6] > 0.08)):
            chosen.append(int(index))
            if len(chosen) == count:
                break
    return chosen


def _refine(problem: _SkylineProblem, parameters: np.ndarray) -> tuple[Calibration, float] | None:
    """Calibrate to the edges nearest to the projected horizon, with decreasing search distance; and the final score.

    ``None`` if too little of the horizon lies near edges.
    """
    start, search = problem.start, problem.search
    parameters = _maximise_score(problem, parameters)
    priors = replace(search.priors, heading_deg=np.inf)
    if isinstance(start, Panorama) and not priors.horizon_px:
        priors = replace(priors, horizon_px=search.tilt_deg * start.fy * np.pi / 180.0)
    calibration = None
    coarse_px = 1.0 / problem.boundary.scale
    for reach in (8.0 * coarse_px, 4.0 * coarse_px, 2.5 * coarse_px, 2.0 * coarse_px):
        evidence = _skyline_evidence(problem, parameters, reach)
        if evidence is None:
            return None
        calibration = resect(
            start,
            problem.points,
            skyline=evidence,
            priors=priors,
            k1=float(parameters[7]),
            axes=problem.axes,
            options=ResectionOptions(noise_px=None if problem.points else 1.0, guess=parameters),
        )
        parameters = calibration.parameters
    assert calibration is not None
    return calibration, _score(problem, parameters)


def _maximise_score(problem: _SkylineProblem, parameters: np.ndarray) -> np.ndarray:
    """Parameters of the local maximum of the score in heading, tilt, roll and scale (Nelder & Mead 1965).

    Starting the edge search there, edges on both sides of a summit are found; a search across nearly horizontal lines
    could not correct the heading.
    """
    from scipy.optimize import minimize

    start, search, horizon = problem.start, problem.search, problem.horizon
    horizon_range = search.tilt_deg if isinstance(start, Panorama) else 0.0
    ranges = np.array([search.heading_deg, search.tilt_deg, search.roll_deg, 0, 0, 0, search.focal, 0, horizon_range])
    free = np.flatnonzero(ranges > 0)
    size = np.array([0.5, 0.4, 0.6, 0, 0, 0, 0.03, 0, 0.4 * start.fy * np.pi / 180.0])[free]
    skyline = _visible_subset(problem, parameters, problem.skyline_m, 600)
    edges = _visible_subset(problem, parameters, horizon.edges_m, 300) if len(horizon.edges_m) else horizon.edges_m
    no_shift = np.zeros(1, int)

    def loss(unit: np.ndarray) -> float:
        trial = parameters.copy()
        trial[free] += unit * size
        return -_pose_scores(problem, trial, skyline, edges, no_shift)[0]

    simplex = np.vstack([np.zeros(len(free)), np.eye(len(free))]) - 1.0 / (len(free) + 1)
    minimum = minimize(
        loss,
        np.zeros(len(free)),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 250, "xatol": 0.02, "fatol": 1e-4},
    )
    best = parameters.copy()
    if minimum.fun < loss(np.zeros(len(free))):
        best[free] += minimum.x * size
    return best


def _skyline_evidence(problem: _SkylineProblem, parameters: np.ndarray, reach: float) -> SkylineEvidence | None:
    """Residuals of horizon and ridge points against the edges within ``reach`` pixels across their lines.

    A point is weighted by the likelihood of its edge and by the angle of the terrain's height error at its distance.
    ``None`` if fewer than 30 points of the first line match an edge.
    """
    start, axes, horizon = problem.start, problem.axes, problem.horizon
    # Points of a line, factor of their standard deviation, whether the line is a skyline.
    lines = [(problem.skyline_m, 1.0, True), (horizon.edges_m, 2.0, False)]
    points, target, normal, weight = [], [], [], []
    for position, sigma_factor, is_skyline in lines:
        if len(position) < 5:
            continue
        position = _visible_subset(problem, parameters, position, _MAX_POINTS)
        pixel, in_front = project_with_parameters(start, axes, parameters, position)
        blur = start.fy * problem.terrain_sigma_m / np.linalg.norm(position - parameters[3:6], axis=1)
        reach_px = reach + 2.0 * np.minimum(blur, 2.0 * reach)
        edge = edge_near(problem.boundary, pixel, in_front, reach_px, is_skyline)
        if edge is None:
            continue
        points.append(position[edge.index])
        target.append(edge.pixel)
        normal.append(edge.normal)
        weight.append(edge.strength / sigma_factor / np.hypot(1.0, blur[edge.index]))
    if not points or len(points[0]) < 30:
        return None
    points, target, normal, weight = (np.concatenate(part) for part in (points, target, normal, weight))

    def residuals(trial: np.ndarray) -> np.ndarray:
        error = project_with_parameters(start, axes, trial, points)[0] - target
        if isinstance(start, Panorama):
            circle = 2.0 * np.pi * start.fx * focal_scales(start, trial)[..., :1]
            error[..., 0] -= circle * np.round(error[..., 0] / circle)
        return np.einsum("...i,...i", error, normal) * weight

    initial = residuals(parameters)
    spread = max(1.4826 * float(np.median(np.abs(initial - np.median(initial)))), 0.5)
    # Errors of neighbouring columns are correlated: one independent residual per correlation length.
    return SkylineEvidence(residuals, spread * np.sqrt(_correlation_length(initial)))


def _visible_subset(problem: _SkylineProblem, parameters: np.ndarray, position: np.ndarray, count: int) -> np.ndarray:
    """About ``count`` points, evenly selected from those that project into the image columns."""
    pixel, in_front = project_with_parameters(problem.start, problem.axes, parameters, position)
    inside = np.flatnonzero(in_front & (pixel[:, 0] > 0) & (pixel[:, 0] < problem.start.width_px))
    return position[inside[:: max(1, len(inside) // count)]]


def _score(problem: _SkylineProblem, parameters: np.ndarray) -> float:
    """Score of a refined pose over all points of the horizon and ridges."""
    return float(_pose_scores(problem, parameters, problem.skyline_m, problem.horizon.edges_m, np.zeros(1, int))[0])


def _correlation_length(residual: np.ndarray) -> float:
    """Correlation length of consecutive residuals [samples]: sum of the autocorrelation over both signs of the lag."""
    centred = np.clip(residual - np.median(residual), -8, 8)
    power = np.mean(centred**2)
    if power <= 0:
        return 1.0
    total = 1.0
    for lag in range(1, min(200, len(centred) // 3)):
        correlation = float(np.mean(centred[:-lag] * centred[lag:]) / power)
        if correlation < 0.1:
            break
        total += 2.0 * correlation
    return total


def _edge_coverage(problem: _SkylineProblem, view: View, parameters: np.ndarray) -> tuple[float, float]:
    """Fraction of the visible horizon within three coarse pixels of a boundary, less chance; fraction of columns."""
    pixel, in_front = project_with_parameters(view, problem.axes, parameters, problem.skyline_m)
    # Parts of the horizon above or below the image are not counted.
    in_front = in_front & (pixel[:, 1] > 0) & (pixel[:, 1] < view.height_px)
    near, inside = _sample_near(problem.boundary, view, pixel, in_front)
    if inside.sum() < 20:
        return 0.0, 0.0
    # Chance level: the same columns at other rows nearby.
    chance = []
    for shift in (-0.10, -0.07, 0.07, 0.10, 0.14):
        shifted = pixel + np.array([0.0, shift * problem.boundary.coarse.shape[0] / problem.boundary.scale])
        value, usable = _sample_near(problem.boundary, view, shifted, in_front)
        if usable.sum() >= 20:
            chance.append(value[usable].mean())
    expected = float(np.mean(chance)) if chance else 0.0
    column_fraction = np.unique(np.floor(pixel[inside, 0] / view.width_px * 200)).size / 200.0
    return float((near[inside].mean() - expected) / max(1.0 - expected, 0.1)), column_fraction


def _sample_near(
    boundary: BoundaryMap, view: View, pixel: np.ndarray, in_front: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`BoundaryMap.near` at pixels, 0 outside ``(N,)``; whether a pixel is in an image column and not masked ``(N,)``."""
    near, scale = boundary.near, boundary.scale
    column, row = np.floor(pixel[:, 0] * scale).astype(int), np.floor(pixel[:, 1] * scale).astype(int)
    if isinstance(view, Panorama) and view.full_circle:
        column %= near.shape[1]
    in_column = in_front & (column >= 0) & (column < near.shape[1])
    inside = in_column & (row >= 0) & (row < near.shape[0])
    sampled = np.zeros(len(pixel))
    sampled[inside] = near[row[inside], column[inside]]
    return sampled, in_column & ~np.isnan(sampled)


def _assess(problem: _SkylineProblem, fits: list[tuple[Calibration, float]]) -> SkylineFit:
    """Select the fit of the highest score and test its reliability."""
    calibration, score = max(fits, key=lambda fit: fit[1])
    view, search = calibration.view, problem.search
    parameters = parameters_of_view(view, problem.axes, calibration.k1)

    def heading_difference(a: float, b: float) -> float:
        return abs((a - b + 180.0) % 360.0 - 180.0)

    other_scores = [other for fit, other in fits if heading_difference(fit.parameters[0], parameters[0]) > 1.0]
    score_ratio = score / max(max(other_scores), 1e-6) if other_scores else float("inf")
    offset = (parameters[0] - problem.origin[0] + 180.0) % 360.0 - 180.0
    edge_fraction, column_fraction = _edge_coverage(problem, view, parameters)
    sigma = calibration.sigma["heading_deg"]
    doubts = []
    if edge_fraction < MIN_EDGE_FRACTION:
        percent = 100 * max(edge_fraction, 0.0)
        doubts.append(f"only {percent:.0f} % of the horizon coincides with an image edge (fog or foreground)")
    if score_ratio < MIN_SCORE_RATIO:
        doubts.append(f"another heading reaches {100 / max(score_ratio, 1e-6):.0f} % of the score")
    if sigma > MAX_HEADING_SIGMA_DEG:
        doubts.append(f"the horizon is too smooth to determine the heading (± {sigma:.2f}°)")
    if column_fraction < MIN_COLUMN_FRACTION:
        doubts.append(f"the horizon is visible in only {100 * column_fraction:.0f} % of the columns")
    if search.heading_deg < 180.0 and abs(offset) > search.heading_deg - 0.3:
        doubts.append("the heading lies at the limit of the search range")
    return SkylineFit(
        calibration,
        not doubts,
        edge_fraction,
        score_ratio,
        float(sigma),
        column_fraction,
        tuple(doubts),
        problem.horizon,
    )
