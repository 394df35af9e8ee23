"""Diffuse albedo and snow cover of the synthetic massif as functions of the day of the year.

Reflectances are linear Rec.709, rounded from published spectra: rock, soil and vegetation from the ECOSTRESS library
(Meerdink et al. 2019, doi:10.1016/j.rse.2019.05.015), snow and ice from Warren 2019 (doi:10.1098/rsta.2018.0161)
and Cuffey & Paterson 2010, larch and pasture in autumn from the same library's senescent leaves and straw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from math import cos, pi, sin

import cv2
import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.terrain.interpolation import monotone_cubic
from seasonscapes.terrain.noise import fractal_noise, spline_noise
from seasonscapes.terrain.synthetic_cover import FOREST, Cover
from seasonscapes.terrain.synthetic_massif import SyntheticMassif
from seasonscapes.terrain.synthetic_strata import LEDGES_M, strata_level_m

SEASONS = {"winter": 32, "spring": 135, "summer": 205, "autumn": 288}
_YEAR = 365.25

# Mean height [m] of the snow line on level ground, by day of year.
_SNOW_LINE = ((1, 780), (32, 640), (60, 760), (91, 1250), (121, 1750), (152, 2250), (182, 2750), (213, 3050),
              (236, 3100), (258, 2950), (288, 2550), (319, 1650), (345, 1000))  # fmt: skip
# Reflectance of classes with an annual cycle, by day of year at 1,500 m.
_SEASONAL_ALBEDO = {
    Cover.MEADOW: (
        (60, (0.150, 0.120, 0.060)),
        (110, (0.120, 0.115, 0.045)),
        (145, (0.058, 0.118, 0.026)),
        (205, (0.066, 0.112, 0.029)),
        (245, (0.080, 0.110, 0.032)),
        (288, (0.150, 0.110, 0.040)),
        (330, (0.165, 0.122, 0.058)),
    ),
    Cover.FIELD: (
        (60, (0.130, 0.105, 0.062)),
        (110, (0.090, 0.110, 0.036)),
        (145, (0.055, 0.125, 0.026)),
        (205, (0.080, 0.122, 0.032)),
        (250, (0.088, 0.118, 0.034)),
        (288, (0.120, 0.112, 0.042)),
        (330, (0.130, 0.105, 0.062)),
    ),
    Cover.LARCH: (
        (100, (0.075, 0.058, 0.042)),
        (135, (0.055, 0.085, 0.022)),
        (205, (0.040, 0.066, 0.019)),
        (262, (0.070, 0.078, 0.018)),
        (288, (0.235, 0.155, 0.024)),
        (312, (0.190, 0.105, 0.024)),
        (330, (0.085, 0.062, 0.040)),
    ),
    Cover.BROADLEAF: (
        (95, (0.080, 0.066, 0.050)),
        (130, (0.052, 0.098, 0.018)),
        (205, (0.034, 0.068, 0.016)),
        (255, (0.050, 0.070, 0.016)),
        (285, (0.190, 0.100, 0.018)),
        (305, (0.170, 0.070, 0.022)),
        (325, (0.085, 0.066, 0.050)),
    ),
    Cover.SHRUB: (
        (80, (0.085, 0.072, 0.045)),
        (150, (0.056, 0.078, 0.026)),
        (205, (0.052, 0.074, 0.026)),
        (255, (0.072, 0.070, 0.026)),
        (288, (0.130, 0.064, 0.028)),
        (325, (0.090, 0.070, 0.045)),
    ),
}
_CONSTANT_ALBEDO = {
    Cover.WATER: (0.014, 0.034, 0.038),
    Cover.CONIFER: (0.022, 0.036, 0.017),
    Cover.SCREE: (0.240, 0.231, 0.214),
    Cover.ROCK: (0.200, 0.193, 0.180),
    Cover.ICE: (0.400, 0.470, 0.520),
    Cover.FIRN: (0.660, 0.690, 0.720),
}
# Fraction of the snow cover that is visible from above; tree crowns shed and cover snow.
_VISIBLE_SNOW = {Cover.CONIFER: 0.24, Cover.LARCH: 0.45, Cover.BROADLEAF: 0.55, Cover.SHRUB: 0.85, Cover.WATER: 0.0}
# Rows of the map that is made, four of which a processor's cache holds with all that they are made of.
_STRIP_ROWS = 160


def snow_line_m(day_of_year: float) -> float:
    """Compute the mean height of the snow line on level ground, continuous and periodic in the year.

    Parameters
    ----------
    day_of_year
        1 = 1 January; fractions and values outside the year are allowed.

    Returns
    -------
    float
        Height [m].
    """
    return float(_periodic(day_of_year, [(d, (h,)) for d, h in _SNOW_LINE])[..., 0])


def _periodic(day: ArrayLike, knots: Sequence[tuple[int, tuple[float, ...]]]) -> np.ndarray:
    """Periodic monotone cubic interpolation (PCHIP) over the year: ``day`` ``(...)`` → ``(..., C)`` float32."""
    table_days, table = _year_table(tuple(knots))
    day = np.mod(np.asarray(day, float), _YEAR)
    return np.stack([np.interp(day, table_days, column) for column in table], -1).astype(np.float32)


@lru_cache(maxsize=16)
def _year_table(knots: tuple[tuple[int, tuple[float, ...]], ...]) -> tuple[np.ndarray, np.ndarray]:
    """Days ``(T,)`` of the year and the values ``(C, T)`` between knots."""
    days = np.array([d for d, _ in knots], float)
    values = np.array([v for _, v in knots], float)
    days = np.concatenate([days[-3:] - _YEAR, days, days[:3] + _YEAR])
    values = np.concatenate([values[-3:], values, values[:3]])
    # Linear interpolation in a table of quarter days is accurate enough and much faster than splines per pixel.
    table_days = np.arange(-0.25, _YEAR + 0.5, 0.25)
    return table_days, np.ascontiguousarray(monotone_cubic(days, values, table_days).T)


def _smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _upsampled(field: np.ndarray, rows: slice, upsample: int, interpolation: int = cv2.INTER_CUBIC) -> np.ndarray:
    """Rows of a map upsampled by an integer factor, with unchanged outer edges."""
    if upsample == 1:
        return field[rows].astype(np.float32)
    low, high = max(rows.start - 4, 0), min(rows.stop + 4, field.shape[0])
    size = (field.shape[1] * upsample, (high - low) * upsample)
    resized = cv2.resize(field[low:high].astype(np.float32), size, interpolation=interpolation)
    return resized[(rows.start - low) * upsample : (rows.stop - low) * upsample]


def _axes(massif: SyntheticMassif, rows: slice, upsample: int) -> tuple[np.ndarray, np.ndarray]:
    """East of the columns ``(w,)`` and north of the rows ``(h,)`` [m] about the massif's centre, float32 as all maps."""
    height, width = massif.cover.shape
    step = massif.spacing_m / upsample
    column = np.arange(width * upsample) + 0.5
    row = np.arange(rows.start * upsample, rows.stop * upsample) + 0.5
    east, north = column * step - 0.5 * width * massif.spacing_m, 0.5 * height * massif.spacing_m - row * step
    return east.astype(np.float32), north.astype(np.float32)


@dataclass(frozen=True)
class _Strip:
    """Rows of a massif's maps with ``upsample`` texels per cell, w columns and h rows of them.

    Axes ``(w,)`` and ``(h,)``, heights ``(h, w)`` and heights within the strata ``(h, w)`` [m].
    """

    rows: slice
    upsample: int
    east_m: np.ndarray
    north_m: np.ndarray
    height_m: np.ndarray
    level_m: np.ndarray


def _strip(massif: SyntheticMassif, rows: slice, upsample: int) -> _Strip:
    east, north = _axes(massif, rows, upsample)
    z = _upsampled(massif.elevation.values[..., 0], rows, upsample)
    return _Strip(rows, upsample, east, north, z, strata_level_m(z, east, north, massif.seed))


@dataclass(frozen=True)
class _Shedding:
    """What decides where snow lies on a strip, whatever the day.

    ``northness`` and ``patches`` ``(h, w)``, concavity ``(h, w)`` [m], and the share of the snow ``(h, w)`` that the slope retains.
    """

    northness: np.ndarray
    concavity_m: np.ndarray
    patches: np.ndarray
    retained: np.ndarray


def _shedding(massif: SyntheticMassif, strip: _Strip) -> _Shedding:
    rows, upsample, east, north = strip.rows, strip.upsample, strip.east_m, strip.north_m
    slope, northness = (_upsampled(f, rows, upsample, cv2.INTER_LINEAR) for f in (massif.slope_deg, massif.northness))
    patches = fractal_noise(massif.seed + 301, 420.0, east, north, octaves=7, gain=0.7)
    concavity = _upsampled(massif.concavity_m, rows, upsample, cv2.INTER_LINEAR)
    # Slopes above about 55° shed snow, except on ledges; unresolved ledges retain 6 %.
    ledge = np.cos(strip.level_m * np.float32(2.0 * pi / LEDGES_M[1]))
    retained = 1.0 - _smoothstep(
        44.0,
        60.0,
        slope - 5.0 * patches - (1.2 + 2.2 * fractal_noise(massif.seed + 311, 700.0, east, north, octaves=3)) * ledge,
    )
    return _Shedding(northness, concavity, patches, retained)


def _snow(day: float, strip: _Strip, shedding: _Shedding) -> np.ndarray:
    """Fraction of the ground under seasonal snow, ``(h, w)`` float32 in [0, 1]."""
    # The dependence of the snow line on aspect is largest in early summer and smallest in early winter.
    contrast = 330.0 + 130.0 * sin(2.0 * pi * (day - 60.0) / _YEAR)
    hollows = 10.0 * np.clip(shedding.concavity_m, -12.0, 12.0)
    line = snow_line_m(day) - contrast * shedding.northness - hollows + 95.0 * shedding.patches
    return _smoothstep(-90.0, 130.0, strip.height_m - line) * (0.06 + 0.94 * shedding.retained)


def snow_fraction(massif: SyntheticMassif, day_of_year: float) -> np.ndarray:
    """Compute the seasonal snow cover on a day; permanent firn and ice are not included.

    Parameters
    ----------
    massif
        The massif.
    day_of_year
        1 = 1 January; fractions and values outside the year are allowed.

    Returns
    -------
    numpy.ndarray
        Fraction of each cell under snow, ``(H, W)`` float32 in [0, 1].
    """
    strips = (_strip(massif, rows, 1) for rows in _strips(massif.cover.shape[0], 1))
    return np.concatenate([_snow(day_of_year, strip, _shedding(massif, strip)) for strip in strips])


def _strips(height: int, upsample: int) -> list[slice]:
    step = max(1, _STRIP_ROWS // upsample)
    return [slice(start, min(start + step, height)) for start in range(0, height, step)]


def _upsampled_cover(massif: SyntheticMassif, rows: slice, upsample: int, grain: np.ndarray) -> np.ndarray:
    """Cover classes at the finer resolution, with class borders perturbed by noise."""
    if upsample == 1:
        return massif.cover[rows]
    shore = _upsampled(massif.shore_m, rows, upsample, cv2.INTER_LINEAR)
    # The rows, and those beside them that interpolation reads.
    around = slice(max(rows.start - 4, 0), rows.stop + 4)
    rows = slice(rows.start - around.start, rows.stop - around.start)
    # Lake cells are replaced by meadow here: the lake's outline follows from the shore distance below.
    cover = np.where(massif.shore_m[around] < 0.0, np.uint8(Cover.MEADOW), massif.cover[around])
    best, chosen = np.full(grain.shape, -np.inf, np.float32), np.zeros(grain.shape, np.uint8)
    for k, kind in enumerate(Cover):
        cells = cover == kind
        if not cells[rows].any():
            continue
        fraction = _upsampled(cells, rows, upsample, cv2.INTER_LINEAR)
        score = np.zeros_like(grain) if kind == Cover.WATER else np.roll(grain, 37 * k, axis=1)
        score *= 0.16
        score += fraction
        np.putmask(score, fraction <= 0.02, -1.0)
        np.putmask(chosen, score > best, np.uint8(kind))
        np.maximum(best, score, out=best)
    # The shore distance resolves the lake's outline below the cell size.
    return np.where(shore < 0.0, np.uint8(Cover.WATER), chosen)


@dataclass(frozen=True)
class _Ground:
    """Fields of the ground on a strip: cover class, short- and long-wave noise, each ``(h, w)``."""

    cover: np.ndarray
    grain: np.ndarray
    broad: np.ndarray


def _ground(massif: SyntheticMassif, strip: _Strip) -> _Ground:
    upsample = strip.upsample
    octaves = 3 + upsample.bit_length()
    grain = fractal_noise(massif.seed + 401, 60.0, strip.east_m, strip.north_m, octaves=octaves, gain=0.8)
    broad = fractal_noise(massif.seed + 411, 900.0, strip.east_m, strip.north_m, octaves=5, gain=0.6)
    return _Ground(_upsampled_cover(massif, strip.rows, upsample, grain), grain, broad)


def _bare_albedo(massif: SyntheticMassif, day: float, strip: _Strip, ground: _Ground) -> np.ndarray:
    """Albedo ``(3, h, w)`` of the classes, without what varies within them and without seasonal snow."""
    cover, z, grain, broad = ground.cover, strip.height_m, ground.grain, ground.broad
    # Spring is later and autumn earlier by about 3 days per 100 m of height (Hopkins 1918: four days in 400 feet).
    delay_days = np.clip((z - 1500.0) * 0.030, -25.0, 30.0) + 4.0 * broad
    spring_weight = 0.5 + 0.5 * cos(2.0 * pi * (day - 120.0) / _YEAR)
    local_day = day + delay_days * (1.0 - 2.0 * spring_weight)
    # A channel after the other: triples of numbers cost several times as much.
    albedo = np.stack(
        [
            _by_class(cover, {kind: constant[channel] for kind, constant in _CONSTANT_ALBEDO.items()})
            for channel in range(3)
        ]
    )
    for kind, knots in _SEASONAL_ALBEDO.items():
        cells = np.flatnonzero(cover == kind)
        if len(cells):
            for plane, values in zip(albedo, _periodic(local_day.ravel()[cells], knots).T, strict=True):
                plane.ravel()[cells] = values
    ice = np.flatnonzero(cover == Cover.ICE)
    if len(ice):
        debris = _upsampled(massif.debris, strip.rows, strip.upsample, cv2.INTER_LINEAR)
        debris, height_m, fine, coarse = (field.ravel()[ice] for field in (debris, z, grain, broad))
        dirt = np.clip(debris + 0.30 * fine + 0.45 * coarse - 0.65, 0.0, 0.75)
        dirt = np.clip(dirt + 0.30 * _smoothstep(2700.0, 1500.0, height_m), 0.0, 0.92)
        # Crevasses and ogives are transverse to the flow, along contour lines.
        crevasse = np.sin(height_m * (2.0 * pi / 11.0) + 2.5 * fine + 3.0 * coarse)
        for plane, clean, scree in zip(albedo, _CONSTANT_ALBEDO[Cover.ICE], _CONSTANT_ALBEDO[Cover.SCREE], strict=True):
            plane.ravel()[ice] = (clean + dirt * (0.8 * scree - clean)) * (1.0 + 0.07 * crevasse)
    return albedo


def _by_class(cover: np.ndarray, values: dict[Cover, float], *, otherwise: float = 0.0) -> np.ndarray:
    """A value of each cell's class, ``(h, w)`` float32."""
    return np.array([values.get(kind, otherwise) for kind in Cover], np.float32)[cover]


@dataclass(frozen=True)
class _Variation:
    """Factors ``(h, w)`` of the albedo within classes: of crowns, tufts and strata, of rust, and of plots where there are fields."""

    crowns: np.ndarray
    rust: np.ndarray
    plots: np.ndarray | None

    def apply(self, albedo: np.ndarray) -> None:
        """Multiply an albedo ``(3, h, w)`` by them, in place."""
        albedo *= self.crowns
        albedo[0] *= self.rust
        albedo[2] /= self.rust
        if self.plots is not None:
            albedo *= self.plots


def _variation(strip: _Strip, ground: _Ground, seed: int) -> _Variation:
    cover, grain, broad = ground.cover, ground.grain, ground.broad
    contrast = {
        Cover.MEADOW: 0.16,
        Cover.CONIFER: 0.42,
        Cover.LARCH: 0.36,
        Cover.BROADLEAF: 0.34,
        Cover.SHRUB: 0.24,
        Cover.SCREE: 0.12,
        Cover.ROCK: 0.27,
        Cover.ICE: 0.10,
        Cover.FIRN: 0.03,
        Cover.FIELD: 0.10,
    }
    of_class = partial(_by_class, cover)
    exponent = of_class(contrast) * grain + of_class({Cover.FIRN: 0.02, Cover.ICE: 0.02}, otherwise=0.10) * broad
    rock = np.flatnonzero(cover == Cover.ROCK)
    level = strip.level_m.ravel()[rock] + 8.0 * grain.ravel()[rock]
    exponent.ravel()[rock] += 0.13 * sum(
        np.sin(level * np.float32(2.0 * pi / period) + np.float32(0.8)) for period in LEDGES_M
    )
    rust = np.exp(of_class({Cover.ROCK: 0.06, Cover.SCREE: 0.06}) * broad)
    field, factor = cover == Cover.FIELD, None
    if field.any():
        plots = np.sign(spline_noise(seed + 421, 260.0, strip.east_m, strip.north_m)) + np.sign(
            spline_noise(seed + 422, 190.0, strip.east_m, strip.north_m)
        )
        factor = np.where(field, np.exp(0.16 * plots), np.float32(1.0))
    return _Variation(np.exp(exponent), rust, factor)


def alpine_albedo(massif: SyntheticMassif, day_of_year: float, *, upsample: int = 1) -> np.ndarray:
    """Compute the diffuse albedo of the massif on a day, including seasonal snow.

    Parameters
    ----------
    massif
        The massif.
    day_of_year
        1 = 1 January; fractions and values outside the year are allowed. The result is periodic in 365.25 days.
    upsample
        Texels per cell along each axis (1, 2, 4 or 8), which adds detail below the cell size. The map's outer edges are
        unchanged.

    Returns
    -------
    numpy.ndarray
        ``(H·upsample, W·upsample, 3)`` float32 linear Rec.709 in [0.01, 0.93].

    Raises
    ------
    ValueError
        ``upsample`` is not 1, 2, 4 or 8.
    """
    return alpine_albedos(massif, [day_of_year], upsample=upsample)


def alpine_albedos(massif: SyntheticMassif, days: Sequence[float], *, upsample: int = 1) -> np.ndarray:
    """`alpine_albedo` of D days side by side, ``(H·upsample, W·upsample, 3 D)``: what no day changes is computed once."""
    if upsample not in (1, 2, 4, 8):
        raise ValueError(f"upsample: got {upsample}, expected 1, 2, 4 or 8")
    height, width = massif.cover.shape
    result = np.empty((height * upsample, width * upsample, 3 * len(days)), np.float32)
    for rows in _strips(height, upsample):
        strip = _strip(massif, rows, upsample)
        ground, shedding = _ground(massif, strip), _shedding(massif, strip)
        variation = _variation(strip, ground, massif.seed)
        visible = _by_class(ground.cover, _VISIBLE_SNOW, otherwise=1.0)
        ageing = fractal_noise(massif.seed + 501, 200.0, strip.east_m, strip.north_m, octaves=3)
        ageing *= 0.014
        part = result[rows.start * upsample : rows.stop * upsample]
        for number, day in enumerate(days):
            albedo = _bare_albedo(massif, day, strip, ground)
            variation.apply(albedo)
            weight = _snow(day, strip, shedding)
            weight *= visible
            for channel, snow in enumerate(_snow_albedo(day)):
                covered = ageing + snow
                covered -= albedo[channel]
                covered *= weight
                covered += albedo[channel]
                np.clip(covered, 0.01, 0.93, out=part[..., 3 * number + channel])
    return result


def _snow_albedo(day: float) -> np.ndarray:
    """Albedo ``(3,)`` of seasonal snow: fresh snow in midwinter, coarse-grained snow with dust in July."""
    return _periodic(
        day,
        (
            (20, (0.86, 0.87, 0.88)),
            (100, (0.80, 0.81, 0.82)),
            (190, (0.66, 0.67, 0.68)),
            (250, (0.70, 0.71, 0.72)),
            (300, (0.84, 0.85, 0.86)),
        ),
    )


__all__ = ["FOREST", "SEASONS", "alpine_albedo", "alpine_albedos", "snow_fraction", "snow_line_m"]
