"""Alignment to the terrain without any hand: the horizon and the ridges before it, looked for in the photograph.

No sky is cut out first. The picture becomes a map of how well each pixel would serve as a boundary with calm sky right
above it; the terrain's horizon, shaped by a trial pose, collects what lies under it. All poses within the search are
tried coarsely, the best few are refined to sub-pixel edges by `resect`, and what remains of the doubt (a rival pose
elsewhere, few edges met, wide error bars, a rim of the search) decides whether the result is to be trusted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from seasonscapes.calibration.boundary_map import BoundaryMap, boundary_map, edge_near
from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.pose_model import View, project_values, values_of, view_from_values
from seasonscapes.calibration.resection import Calibration, SkylineEvidence, resect
from seasonscapes.calibration.terrain_horizon import Horizon, horizon_from
from seasonscapes.cameras.panorama import Panorama
from seasonscapes.frames import LocalFrame, geodetic_from_enu, local_axes
from seasonscapes.terrain.surface import Raster

# Points of a line that are worth their time.
_MOST_POINTS = 700
# What a result must reach to be trusted; found on rehearsals with fog, masks and wrong places (benchmarks/calibration.py).
LEAST_MET, LEAST_LEAD, MOST_SIGMA_DEG, LEAST_COLUMNS = 0.6, 1.06, 0.12, 0.15


@dataclass(frozen=True)
class SearchRange:
    """How far from the start to look, each way, and how far the start is trusted otherwise.

    Parameters
    ----------
    heading_deg, tilt_deg, roll_deg
        Half ranges [deg]. For a panorama ``tilt_deg`` is also how far its horizon may be off its row.
    focal
        Half range of the field-of-view scale, relative.
    terrain_sigma_m
        Height error of the terrain [m]; a third of a cell when left out.
    priors
        Standard deviations for the refinement; position most of all, since a skyline says little about it.
    """

    heading_deg: float = 12.0
    tilt_deg: float = 4.0
    roll_deg: float = 2.0
    focal: float = 0.0
    terrain_sigma_m: float | None = None
    priors: Priors = field(
        default_factory=lambda: Priors(tilt_deg=3.0, roll_deg=2.0, horizontal_m=3.0, vertical_m=3.0, focal=0.02)
    )


@dataclass(frozen=True)
class SkylineFit:
    """An alignment and how far it can be believed.

    Parameters
    ----------
    calibration
        The solved view; ``None`` where no pose of the search met any edges at all.
    reliable
        Whether every test below is passed.
    met
        Share of the horizon inside the picture (and the mask) that has an edge where it is expected, less what chance
        alone would give.
    lead
        Score of the pose over that of the best rival more than 1.5° away in heading.
    heading_sigma_deg
        Standard deviation of the heading [deg].
    columns
        Share of the picture's columns that the used horizon crosses.
    doubts
        The tests that failed, in words; empty when reliable.
    horizon
        The terrain's horizon at the solved place.
    """

    calibration: Calibration | None
    reliable: bool
    met: float
    lead: float
    heading_sigma_deg: float
    columns: float
    doubts: tuple[str, ...]
    horizon: Horizon


def align_to_skyline(
    image: np.ndarray,
    start: View,
    rasters: Sequence[Raster],
    frame: LocalFrame,
    *,
    mask: np.ndarray | None = None,
    search: SearchRange | None = None,
    points: Correspondences | None = None,
    k1: float = 0.0,
) -> SkylineFit:
    """Find a view's pose by its skyline, or by skyline and points together.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 sRGB.
    start
        Where the camera is thought to be and to look.
    rasters
        Elevations, the most detailed first.
    mask
        ``(H, W)`` bool, False where something stands before the landscape.
    search
        How far to look; `Search()` when left out.
    points
        Matched points that count as well.
    k1
        Radial term of the lens.

    Returns
    -------
    SkylineFit
        ``reliable`` is False and ``doubts`` says why where the pose should not be used.

    Raises
    ------
    ValueError
        A picture of another size than the view; no terrain in sight; a camera below ground.
    """
    search = search or SearchRange()
    if image.shape[:2] != (start.height_px, start.width_px):
        raise ValueError(
            f"align_to_skyline: the picture is {image.shape[1]} x {image.shape[0]} px, the view "
            f"{start.width_px} x {start.height_px}"
        )
    latitude, longitude, _ = geodetic_from_enu(frame, start.position_m)
    axes = local_axes(frame, float(latitude), float(longitude))
    origin = values_of(start, axes, k1)
    azimuth = _azimuths(start, origin, search)
    horizon = horizon_from(
        rasters,
        frame,
        start.position_m,
        azimuth_deg=azimuth,
        nearest_m=max(60.0, 3.0 * _cell(rasters[0])),
        below_ground_m=40.0,
    )
    boundary = boundary_map(image, mask, start.fy * np.pi / 180.0)
    candidates, scores = _coarse(start, axes, origin, horizon, boundary, search)
    error_m = search.terrain_sigma_m or _cell(rasters[0]) / 3.0
    fits = [
        _refine(start, axes, candidates[index], (horizon, error_m), boundary, search, points)
        for index in _peaks(candidates, scores, 6)
    ]
    fits = [fit for fit in fits if fit is not None]
    if not fits:
        return SkylineFit(None, False, 0.0, 0.0, float("inf"), 0.0, ("no pose of the search meets any edges",), horizon)
    return _judge(axes, origin, fits, horizon, boundary, search)


def _cell(raster: Raster) -> float:
    size = float(np.sqrt(abs(raster.transform.determinant)))
    return size * 111_195.0 if size < 0.1 else size


def _azimuths(start: View, origin: np.ndarray, search: SearchRange) -> np.ndarray:
    """Directions that any pose of the search may see, at about two thirds of a pixel."""
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


def _coarse(
    start: View, axes: np.ndarray, origin: np.ndarray, horizon: Horizon, boundary: BoundaryMap, search: SearchRange
):
    """Poses ``(P, 9)`` and their scores over the whole search at 0.4° or a coarser pixel.

    A small tilt moves the whole line up or down (in a panorama it is the horizon's row that moves): all tilts of a
    heading share one projection.
    """
    per_degree = start.fy * np.pi / 180.0
    step = float(np.clip(3.0 / per_degree / boundary.scale, 0.12, 0.4))
    headings = _steps(search.heading_deg, step)
    tilts = _steps(search.tilt_deg, step)
    keep = np.isfinite(horizon.skyline_elevation_deg)
    sky = horizon.skyline_m[keep][:: max(1, int(keep.sum() / 500))]
    edges = horizon.edges_m[:: max(1, len(horizon.edges_m) // 300)]
    # Up in the picture by a degree of tilt.
    shift = np.round(tilts * per_degree * boundary.scale).astype(int)
    poses, scores = [], []
    panoramic = isinstance(start, Panorama)
    lifts = tilts[:, None] * (per_degree * np.eye(9)[8] if panoramic else np.eye(9)[1])
    # Leaning the axis of a panorama bends its horizon into a wave; that is left to the climb.
    for roll in np.zeros(1) if panoramic else _steps(search.roll_deg, 1.0):
        for scale in _steps(np.log1p(search.focal), 0.03):
            for heading in headings:
                values = origin + np.array([heading, 0.0, roll, 0, 0, 0, scale, 0, 0])
                score = _scores(start, axes, values, sky, boundary.coarse, boundary.scale, shift)
                if len(edges) > 20:
                    score = score + 0.25 * _scores(
                        start, axes, values, edges, boundary.coarse_edges, boundary.scale, shift
                    )
                scores.append(score)
                poses.append(values + lifts)
    return np.concatenate(poses), np.concatenate(scores)


def _steps(half: float, step: float) -> np.ndarray:
    count = int(np.ceil(half / step - 1e-9))
    return np.linspace(-half, half, 2 * count + 1) if count else np.zeros(1)


def _scores(
    start: View,
    axes: np.ndarray,
    values: np.ndarray,
    position: np.ndarray,
    evidence: np.ndarray,
    scale: float,
    shift: np.ndarray,
) -> np.ndarray:
    """Mean evidence ``(S,)`` along a projected line for each downward shift in working pixels.

    Out of the picture above or below counts as not met: columns are what there is to explain. Masked pixels are no
    evidence either way.
    """
    pixel, front = project_values(start, axes, values, position)
    column = np.floor(pixel[:, 0] * scale).astype(int)
    if isinstance(start, Panorama) and start.full_circle:
        column %= evidence.shape[1]
    use = front & (column >= 0) & (column < evidence.shape[1])
    if use.sum() < 20:
        return np.zeros(len(shift))
    row = np.floor(pixel[use, 1] * scale).astype(int) + shift[:, None]
    seen = (row >= 0) & (row < evidence.shape[0])
    found = np.where(seen, evidence[np.clip(row, 0, evidence.shape[0] - 1), column[use]], 0.0)
    hidden = np.isnan(found)
    return np.where(hidden, 0.0, found).sum(axis=1) / np.maximum((~hidden).sum(axis=1), 20)


def _collect(start: View, values: np.ndarray, scale: float, pixel: np.ndarray, front: np.ndarray):
    """Evidence ``(N,)`` under pixels, 0 outside, and which of them lie in the picture's columns and are not masked."""
    column, row = np.floor(pixel[:, 0] * scale).astype(int), np.floor(pixel[:, 1] * scale).astype(int)
    if isinstance(start, Panorama) and start.full_circle:
        column %= values.shape[1]
    inside = front & (column >= 0) & (column < values.shape[1])
    seen = inside & (row >= 0) & (row < values.shape[0])
    found = np.zeros(len(pixel))
    found[seen] = values[row[seen], column[seen]]
    return found, inside & ~np.isnan(found)


def _peaks(poses: np.ndarray, scores: np.ndarray, count: int) -> list[int]:
    """Indices of the best poses that differ by more than a degree of heading, or by 8 % of scale."""
    chosen: list[int] = []
    for index in np.argsort(scores)[::-1]:
        apart = np.abs(poses[index] - poses[chosen])
        if np.all((apart[:, 0] > 1.0) | (apart[:, 6] > 0.08)):
            chosen.append(int(index))
            if len(chosen) == count:
                break
    return chosen


def _refine(start, axes, values, terrain, boundary, search, points):
    """The calibration at the edges nearest to its own horizon, in rounds of shrinking reach; and how well it sits there.

    ``None`` where the horizon leaves the picture.
    """
    calibration = None
    values = _climb(start, axes, values, terrain[0], boundary, search)
    pixels = 1.0 / boundary.scale
    for reach in (8.0 * pixels, 4.0 * pixels, 2.5 * pixels, 2.0 * pixels):
        evidence = _edges_at(start, axes, values, terrain, boundary, reach)
        if evidence is None:
            return None
        priors = replace(search.priors, heading_deg=np.inf)
        if isinstance(start, Panorama) and not priors.horizon_px:
            priors = replace(priors, horizon_px=search.tilt_deg * start.fy * np.pi / 180.0)
        calibration = resect(
            start,
            points,
            priors=priors,
            axes=axes,
            k1=float(values[7]),
            guess=values,
            skyline=evidence,
            noise_px=None if points else 1.0,
        )
        values = calibration.values
    return calibration, _sits(start, axes, values, terrain[0], boundary)


def _climb(start, axes, values, horizon, boundary, search) -> np.ndarray:
    """The summit of the score near a pose, in heading, tilt, roll and scale (Nelder & Mead 1965).

    Edges are then met on both sides of a peak at once, which a search across nearly level lines cannot do.
    """
    from scipy.optimize import minimize

    panoramic = isinstance(start, Panorama)
    lift = search.tilt_deg if panoramic else 0.0
    spans = np.array([search.heading_deg, search.tilt_deg, search.roll_deg, 0, 0, 0, search.focal, 0, lift])
    free = np.flatnonzero(spans > 0)
    size = np.array([0.5, 0.4, 0.6, 0, 0, 0, 0.03, 0, 0.4 * start.fy * np.pi / 180.0])[free]
    keep = np.isfinite(horizon.skyline_elevation_deg)
    sky = _thinned(start, axes, values, horizon.skyline_m[keep], 600)
    edges = _thinned(start, axes, values, horizon.edges_m, 300) if len(horizon.edges_m) else horizon.edges_m
    none = np.zeros(1, int)

    def loss(unit):
        trial = values.copy()
        trial[free] += unit * size
        score = _scores(start, axes, trial, sky, boundary.coarse, boundary.scale, none)[0]
        if len(edges) > 20:
            score += 0.25 * _scores(start, axes, trial, edges, boundary.coarse_edges, boundary.scale, none)[0]
        return -score

    simplex = np.vstack([np.zeros(len(free)), np.eye(len(free))]) - 1.0 / (len(free) + 1)
    found = minimize(
        loss,
        np.zeros(len(free)),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 250, "xatol": 0.02, "fatol": 1e-4},
    )
    best = values.copy()
    if found.fun < loss(np.zeros(len(free))):
        best[free] += found.x * size
    return best


def _edges_at(start, axes, values, terrain, boundary, reach):
    """Evidence: horizon (and ridge) points against the edges found within ``reach`` pixels across their course.

    A point counts by the sharpness of its edge and by what the terrain's height error makes of it at its distance.
    """
    horizon, error_m = terrain
    groups = [(horizon.skyline_m[np.isfinite(horizon.skyline_elevation_deg)], 1.0, True), (horizon.edges_m, 2.0, False)]
    points, target, normal, weight = [], [], [], []
    for position, slack, is_sky in groups:
        if len(position) < 5:
            continue
        position = _thinned(start, axes, values, position, _MOST_POINTS)
        pixel, front = project_values(start, axes, values, position)
        blur = start.fy * error_m / np.linalg.norm(position - values[3:6], axis=1)
        found = edge_near(boundary, pixel, front, reach + 2.0 * np.minimum(blur, 2.0 * reach), is_sky)
        if found is None:
            continue
        index, place, across, strength = found
        points.append(position[index])
        target.append(place)
        normal.append(across)
        weight.append(strength / slack / np.hypot(1.0, blur[index]))
    if not points or len(points[0]) < 30:
        return None
    points, target, normal, weight = (np.concatenate(part) for part in (points, target, normal, weight))

    def residuals(view, k1):
        pixel, _ = project_values(view, axes, values_of(view, axes, k1), points)
        miss = pixel - target
        if isinstance(view, Panorama):
            turn = 2.0 * np.pi * view.fx
            miss[:, 0] -= turn * np.round(miss[:, 0] / turn)
        return np.sum(miss * normal, axis=1) * weight

    now = residuals(view_from_values(start, axes, values), values[7])
    spread = max(1.4826 * float(np.median(np.abs(now - np.median(now)))), 0.5)
    # Neighbouring columns err together: one independent miss in as many as their correlation spans.
    return SkylineEvidence(residuals, spread * np.sqrt(_correlation_length(now)))


def _thinned(start, axes, values, position, count):
    """Evenly chosen points of those that fall into the picture."""
    pixel, front = project_values(start, axes, values, position)
    inside = np.flatnonzero(front & (pixel[:, 0] > 0) & (pixel[:, 0] < start.width_px))
    return position[inside[:: max(1, len(inside) // count)]]


def _sits(start, axes, values, horizon, boundary) -> float:
    """Mean evidence right under the projected skyline and ridges: the score that rivals are compared by."""
    none = np.zeros(1, int)
    keep = np.isfinite(horizon.skyline_elevation_deg)
    score = _scores(start, axes, values, horizon.skyline_m[keep], boundary.coarse, boundary.scale, none)[0]
    if len(horizon.edges_m) > 20:
        score += 0.25 * _scores(start, axes, values, horizon.edges_m, boundary.coarse_edges, boundary.scale, none)[0]
    return float(score)


def _correlation_length(misses: np.ndarray) -> float:
    centred = np.clip(misses - np.median(misses), -8, 8)
    power = np.mean(centred**2)
    if power <= 0:
        return 1.0
    total = 1.0
    for lag in range(1, min(200, len(centred) // 3)):
        value = float(np.mean(centred[:-lag] * centred[lag:]) / power)
        if value < 0.1:
            break
        total += 2.0 * value
    return total


def _met(start, axes, values, horizon, boundary):
    """Share of visible horizon with a strong boundary within 3 px of a coarse pixel, less chance; and column share."""
    keep = np.isfinite(horizon.skyline_elevation_deg)
    pixel, front = project_values(start, axes, values, horizon.skyline_m[keep])
    # A horizon above or below the frame of a flat panorama is neither met nor missed.
    front = front & (pixel[:, 1] > 0) & (pixel[:, 1] < start.height_px)
    near, inside = _collect(start, boundary.near, boundary.scale, pixel, front)
    if inside.sum() < 20:
        return 0.0, 0.0
    # What other rows of the same columns, not far away, would meet.
    chance = []
    for shift in (-0.10, -0.07, 0.07, 0.10, 0.14):
        moved = pixel + np.array([0.0, shift * boundary.coarse.shape[0] / boundary.scale])
        value, usable = _collect(start, boundary.near, boundary.scale, moved, front)
        if usable.sum() >= 20:
            chance.append(value[usable].mean())
    expected = float(np.mean(chance)) if chance else 0.0
    columns = np.unique(np.floor(pixel[inside, 0] / start.width_px * 200)).size / 200.0
    return float((near[inside].mean() - expected) / max(1.0 - expected, 0.1)), columns


def _judge(axes, origin, fits, horizon, boundary, search) -> SkylineFit:
    calibration, score = max(fits, key=lambda fit: fit[1])
    start, values = replace(calibration.view), values_of(calibration.view, axes, calibration.k1)

    def apart(a, b):
        return abs((a - b + 180.0) % 360.0 - 180.0)

    rivals = [other for fit, other in fits if apart(fit.values[0], values[0]) > 1.0]
    lead = score / max(max(rivals), 1e-6) if rivals else float("inf")
    offset = (values[0] - origin[0] + 180.0) % 360.0 - 180.0
    met, columns = _met(start, axes, values, horizon, boundary)
    sigma = calibration.sigma["heading_deg"]
    doubts = []
    if met < LEAST_MET:
        doubts.append(f"only {100 * max(met, 0.0):.0f} % of the horizon meets an edge (fog, or something before it)")
    if lead < LEAST_LEAD:
        doubts.append(f"another heading fits {100 / max(lead, 1e-6):.0f} % as well")
    if sigma > MOST_SIGMA_DEG:
        doubts.append(f"the horizon is too even to fix the heading (± {sigma:.2f}°)")
    if columns < LEAST_COLUMNS:
        doubts.append(f"the horizon shows in {100 * columns:.0f} % of the columns alone")
    if search.heading_deg < 180.0 and abs(offset) > search.heading_deg - 0.3:
        doubts.append("the heading lies at the rim of the search")
    return SkylineFit(calibration, not doubts, met, lead, float(sigma), columns, tuple(doubts), horizon)


def encoded_from_file(path) -> np.ndarray:
    """``(H, W, 3)`` uint8 sRGB of a picture file; `ValueError` where it is none."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise ValueError(f"{path}: not a readable picture")
    return np.ascontiguousarray(picture[..., ::-1])
