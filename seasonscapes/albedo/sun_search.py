"""Where the sun stood when an image of known relief was taken, from shading and cast shadows together.

For a trial sun the irradiance of the relief is known up to the sky's share. What is left of the image is the land's own:
the gradients of ``log image - log irradiance``. Their robust (Cauchy) cost is least for the true sun, since shading and
shadow borders that the trial does not explain remain as gradients, and those that it invents are added. The cost is
summed in blocks of the image: resampling them gives the standard error, and regions that prefer another sun show a
mosaic of several flights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from seasonscapes.frames import direction_from_angles

# Blocks on a side, and the blocks on a side of each region that is asked on its own.
BLOCKS, _REGION = 6, 3
_AZIMUTH_STEP_DEG, _ELEVATIONS_DEG = 12.0, (7.0, 12.0, 18.0, 25.0, 33.0, 42.0, 52.0, 64.0)
# Illuminance from an open sky over the sun's normal illuminance: hazy and low sun to clear and high sun.
_SKY_SHARES = (0.12, 0.25, 0.5)
# Half the transition from shade to sun across the horizon [deg]: uncertain heights, not the disc.
_HORIZON_SOFTNESS_DEG = 1.0
_SMOOTHING_TEXELS = 1.0
# A trusted sun is this many standard errors better than any sun farther away than this angle [deg].
_LEAST_LEAD, _APART_DEG = 3.5, 25.0
# Three standard errors of azimuth are 5°.
_LARGEST_AZIMUTH_SIGMA_DEG, _LARGEST_ELEVATION_SIGMA_DEG = 1.67, 2.0
# Errors that all blocks share, such as heights coarser than the image, whose shadows are too short [deg].
_COMMON_SIGMA_DEG = (0.8, 1.2)
_HIGHEST_DECLINATION_DEG = 23.5


@dataclass(frozen=True)
class Relief:
    """Relief under an image of h rows and w columns, row 0 and column 0 anywhere.

    Parameters
    ----------
    normal
        ``(h, w, 3)`` unit normals, east-north-up.
    horizon_rad
        ``(h, w, A)`` elevation of the terrain horizon in A azimuths, clockwise from north [rad].
    known
        ``(h, w)`` bool: texels with a surface and a value.
    """

    normal: np.ndarray
    horizon_rad: np.ndarray
    known: np.ndarray


@dataclass(frozen=True)
class FoundSun:
    """The sun of an image.

    Parameters
    ----------
    azimuth_deg, elevation_deg
        The best one.
    azimuth_sigma_deg, elevation_sigma_deg
        Standard errors.
    trusted
        Whether the image decides; otherwise ``reason`` says why it does not.
    reason
        One sentence.
    regions
        Best sun of each of four regions: azimuth, elevation [deg], and by how many standard errors the region prefers it
        to the best of the whole image.
    """

    azimuth_deg: float
    elevation_deg: float
    azimuth_sigma_deg: float
    elevation_sigma_deg: float
    trusted: bool
    reason: str
    regions: tuple[tuple[float, float, float], ...]

    @property
    def direction(self) -> np.ndarray:
        """Unit vector towards the sun ``(3,)``, east-north-up."""
        return direction_from_angles(self.azimuth_deg, self.elevation_deg)


def find_sun(
    image: np.ndarray,
    relief: Relief,
    *,
    latitude_deg: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> FoundSun:
    """Estimate azimuth and elevation of the sun from one image and its relief.

    Parameters
    ----------
    image
        ``(h, w)`` linear brightness, positive where known.
    relief
        Normals and horizons under it.
    latitude_deg
        Only suns that can stand there on some day of the year are tried; ``None`` tries all.
    progress
        Called with the finished fraction.

    Returns
    -------
    FoundSun
        With standard errors, and whether it can be trusted.
    """
    return search_sun(_relief_search(image, relief), latitude_deg=latitude_deg, progress=progress)


@dataclass(frozen=True)
class SunSearch:
    """What trial suns are compared with: D places of a surface, each with K differences to neighbours.

    Parameters
    ----------
    measured
        ``(K, D)`` differences of the logarithm of brightness.
    block
        ``(D,)`` integers: block of each place, of `BLOCKS` × `BLOCKS`, row by row.
    predicted
        The like ``(K, D)`` of the light of a sun with azimuth and elevation [deg]: a function of the illuminance from an
        open sky over the sun's normal illuminance.
    """

    measured: np.ndarray
    block: np.ndarray
    predicted: Callable[[float, float], Callable[[float], np.ndarray]]

    def costs(
        self, trials: list[tuple[float, float, float]], progress: Callable[[float], None] | None = None
    ) -> np.ndarray:
        """Cost ``(N, B)`` of trials (azimuth, elevation [deg], share of the sky) in each block."""
        size = np.median(np.abs(self.measured)) if self.measured.size else 1.0
        scale = max(float(size), 1e-3)
        result = np.empty((len(trials), BLOCKS * BLOCKS))
        previous, differences = None, None
        for number, (azimuth, elevation, share) in enumerate(trials):
            if differences is None or (azimuth, elevation) != previous:
                differences, previous = self.predicted(azimuth, elevation), (azimuth, elevation)
            left = ((self.measured - differences(share)) ** 2).sum(axis=0)
            cost = np.log1p(left / np.float32(scale**2))
            result[number] = np.bincount(self.block, weights=cost, minlength=BLOCKS * BLOCKS)
            if progress is not None:
                progress((number + 1) / len(trials))
        return result


def search_sun(
    search: SunSearch, *, latitude_deg: float | None = None, progress: Callable[[float], None] | None = None
) -> FoundSun:
    """Estimate azimuth and elevation of the sun whose light explains the measured differences best.

    Parameters
    ----------
    search
        What trial suns are compared with.
    latitude_deg, progress
        See `find_sun`.

    Returns
    -------
    FoundSun
        With standard errors, and whether it can be trusted.
    """
    report = progress or (lambda fraction: None)
    coarse = [
        (float(azimuth), elevation, share)
        for azimuth in np.arange(0.0, 360.0, _AZIMUTH_STEP_DEG)
        for elevation in _ELEVATIONS_DEG
        for share in _SKY_SHARES
        if latitude_deg is None or _possible(float(azimuth), elevation, latitude_deg)
    ]
    costs = search.costs(coarse, lambda share: report(0.7 * share))
    best = coarse[int(np.argmin(costs.sum(axis=1)))]
    for step_azimuth, step_elevation in ((6.0, 4.0), (2.5, 2.0)):
        near = _around(best, step_azimuth, step_elevation)
        near_costs = search.costs(near)
        best = near[int(np.argmin(near_costs.sum(axis=1)))]
    report(0.9)
    azimuth, elevation = _minimum(near, near_costs.sum(axis=1), best)
    sigma = _standard_errors(near, near_costs, best)
    at_best = search.costs([(azimuth, elevation, best[2])])[0]
    regions = _regions(coarse, costs, at_best)
    report(1.0)
    return _judged(azimuth, elevation, sigma, regions, _lead(coarse, costs, (azimuth, elevation), at_best))


def _possible(azimuth_deg: float, elevation_deg: float, latitude_deg: float) -> bool:
    """Whether the sun can stand there: its declination is at most that of the solstices (and a step of the grid)."""
    azimuth, elevation, latitude = np.radians([azimuth_deg, elevation_deg, latitude_deg])
    sine = np.sin(latitude) * np.sin(elevation) + np.cos(latitude) * np.cos(elevation) * np.cos(azimuth)
    return bool(abs(np.degrees(np.arcsin(sine))) <= _HIGHEST_DECLINATION_DEG + 5.0)


def _relief_search(image: np.ndarray, relief: Relief) -> SunSearch:
    """Trial suns over relief under an image: gradients down and to the right of smoothed logarithms."""
    known = relief.known & (image > 0.0)
    covered = np.maximum(gaussian_filter(known.astype(np.float32), _SMOOTHING_TEXELS), 1e-3)
    reach = gaussian_filter((~known).astype(np.float32), _SMOOTHING_TEXELS) < 1e-3
    inside = reach[:-1, :-1] & reach[1:, :-1] & reach[:-1, 1:]
    # The open part of the sky over a tilted surface, from the mean of its horizons.
    upward = 0.5 * (1.0 + relief.normal[..., 2])
    open_sky = (upward * np.mean(np.cos(np.maximum(relief.horizon_rad, 0.0)) ** 2, axis=2)).astype(np.float32)

    def gradients(logarithm: np.ndarray) -> np.ndarray:
        smooth = gaussian_filter(np.where(known, logarithm, 0.0), _SMOOTHING_TEXELS) / covered
        corner = smooth[:-1, :-1]
        return np.stack([(smooth[1:, :-1] - corner)[inside], (smooth[:-1, 1:] - corner)[inside]])

    def predicted(azimuth_deg: float, elevation_deg: float) -> Callable[[float], np.ndarray]:
        sunlight = _sunlight(relief, azimuth_deg, elevation_deg)
        return lambda share: gradients(np.log(sunlight + np.float32(share) * open_sky + np.float32(1e-3)))

    rows, columns = (np.minimum(np.arange(n) * BLOCKS // n, BLOCKS - 1) for n in inside.shape)
    block = (rows[:, None] * BLOCKS + columns)[inside]
    return SunSearch(gradients(np.log(np.where(known, image, 1.0)).astype(np.float32)), block, predicted)


def _sunlight(relief: Relief, azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Cosine of incidence × visibility ``(h, w)``."""
    horizon, azimuths = relief.horizon_rad, relief.horizon_rad.shape[2]
    at = azimuth_deg / 360.0 * azimuths
    lower, part = int(np.floor(at)), np.float32(at - np.floor(at))
    height = (1.0 - part) * horizon[..., lower % azimuths] + part * horizon[..., (lower + 1) % azimuths]
    above = np.degrees(np.radians(elevation_deg) - height) / _HORIZON_SOFTNESS_DEG
    visible = np.clip(0.5 + 0.5 * above, 0.0, 1.0)
    direction = direction_from_angles(azimuth_deg, elevation_deg).astype(np.float32)
    return visible * np.maximum(relief.normal @ direction, 0.0)


def _around(
    best: tuple[float, float, float], azimuth_deg: float, elevation_deg: float
) -> list[tuple[float, float, float]]:
    """A grid of 5 × 5 × 3 trials around one."""
    azimuths = [(best[0] + k * azimuth_deg) % 360.0 for k in range(-2, 3)]
    elevations = sorted({float(np.clip(best[1] + k * elevation_deg, 2.0, 88.0)) for k in range(-2, 3)})
    return [(a, e, best[2] * factor) for a in azimuths for e in elevations for factor in (0.7, 1.0, 1.4)]


def _minimum(
    trials: list[tuple[float, float, float]], cost: np.ndarray, best: tuple[float, float, float]
) -> tuple[float, float]:
    """Azimuth and elevation [deg] of the minimum of the quadratic through the trials near the best one."""
    least: dict[tuple[float, float], float] = {}
    for (azimuth, elevation, _), value in zip(trials, cost, strict=True):
        at = ((azimuth - best[0] + 180.0) % 360.0 - 180.0, elevation - best[1])
        least[at] = min(float(value), least.get(at, np.inf))
    points, values = np.array(list(least)), np.array(list(least.values()))
    x, y = points.T
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    constant = np.linalg.lstsq(terms, values, rcond=None)[0]
    matrix = np.array([[2.0 * constant[3], constant[4]], [constant[4], 2.0 * constant[5]]])
    step = np.zeros(2)
    if np.linalg.eigvalsh(matrix).min() > 0.0:
        step = np.clip(-np.linalg.solve(matrix, constant[1:3]), points.min(axis=0), points.max(axis=0))
    return float((best[0] + step[0]) % 360.0), float(best[1] + step[1])


def _standard_errors(
    trials: list[tuple[float, float, float]], costs: np.ndarray, best: tuple[float, float, float], draws: int = 60
) -> tuple[float, float]:
    """Standard errors of azimuth and elevation [deg], from resampled blocks and common errors."""
    rng = np.random.default_rng(0)
    found = []
    for _ in range(draws):
        weight = np.bincount(rng.integers(0, costs.shape[1], costs.shape[1]), minlength=costs.shape[1])
        cost = costs @ weight
        centre = trials[int(np.argmin(cost))]
        azimuth, elevation = _minimum(trials, cost, centre)
        found.append(((azimuth - best[0] + 180.0) % 360.0 - 180.0, elevation - best[1]))
    spread = np.hypot(np.std(found, axis=0), _COMMON_SIGMA_DEG)
    return float(spread[0]), float(spread[1])


def _angle_deg(first: tuple[float, float], second: tuple[float, float]) -> float:
    """Angle between two suns (azimuth, elevation) [deg]."""
    cosine = float(direction_from_angles(*first) @ direction_from_angles(*second))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _preference(first: np.ndarray, second: np.ndarray) -> float:
    """By how many standard errors blocks cost less in the first than in the second."""
    difference = second - first
    used = difference[difference != 0.0]
    if len(used) < 3:
        return 0.0
    return float(used.sum() / max(np.sqrt(len(used)) * used.std(ddof=1), 1e-12))


def _regions(
    trials: list[tuple[float, float, float]], costs: np.ndarray, at_best: np.ndarray
) -> tuple[tuple[float, float, float], ...]:
    block = np.arange(BLOCKS * BLOCKS).reshape(BLOCKS, BLOCKS)
    found = []
    for top in range(0, BLOCKS, _REGION):
        for left in range(0, BLOCKS, _REGION):
            part = block[top : top + _REGION, left : left + _REGION].ravel()
            best = int(np.argmin(costs[:, part].sum(axis=1)))
            found.append((*trials[best][:2], _preference(costs[best, part], at_best[part])))
    return tuple(found)


def _lead(
    trials: list[tuple[float, float, float]], costs: np.ndarray, best: tuple[float, float], at_best: np.ndarray
) -> float:
    """Standard errors by which the best sun is better than each sun far from it: the least of them."""
    far: Iterable[int] = (k for k, trial in enumerate(trials) if _angle_deg(trial[:2], best) > _APART_DEG)
    return min((_preference(at_best, costs[k]) for k in far), default=0.0)


def _judged(
    azimuth_deg: float,
    elevation_deg: float,
    sigma: tuple[float, float],
    regions: tuple[tuple[float, float, float], ...],
    lead: float,
) -> FoundSun:
    others = [
        region
        for region in regions
        if region[2] > _LEAST_LEAD and _angle_deg(region[:2], (azimuth_deg, elevation_deg)) > _APART_DEG
    ]
    if others:
        suns = ", ".join(f"{a:.0f}°/{e:.0f}°" for a, e, _ in others)
        reason = (
            f"no single sun: the whole image prefers {azimuth_deg:.0f}°/{elevation_deg:.0f}°, parts of it {suns}; "
            "it may be a mosaic of several flights"
        )
    elif lead < _LEAST_LEAD:
        reason = (
            f"no distinct sun: suns far from the best one, {azimuth_deg:.0f}°/{elevation_deg:.0f}°, explain the image about "
            f"as well ({lead:.1f} standard errors)"
        )
    elif sigma[0] > _LARGEST_AZIMUTH_SIGMA_DEG or sigma[1] > _LARGEST_ELEVATION_SIGMA_DEG:
        reason = f"the sun is uncertain by {sigma[0]:.0f}° in azimuth and {sigma[1]:.0f}° in elevation"
    else:
        reason = f"{lead:.1f} standard errors better than any sun farther than {_APART_DEG:.0f}° away"
    trusted = not others and lead >= _LEAST_LEAD and sigma[0] <= _LARGEST_AZIMUTH_SIGMA_DEG
    trusted = trusted and sigma[1] <= _LARGEST_ELEVATION_SIGMA_DEG
    return FoundSun(azimuth_deg, elevation_deg, *sigma, trusted, reason, regions)
