"""Normals of the ground below the resolution of its heights, from photographs of several hours (photometric stereo).

Heights of 20 to 100 m leave the relief within their cells flat, and the closed form (`closed_form`) takes its shading for
albedo. Under suns of several directions the two are separable (Woodham 1980, doi:10.1117/12.7972479): albedo scales all hours
alike, a slope does not. Each texel of unit normal n has a tilt t in its tangent plane,

    normal   = (n + t) / |n + t|,
    sunlight = E_sun · visible · max(0, normal · sun),

with skylight, light between slopes and shadows as the heights have them. Tilts have a Gaussian prior of mean zero, whose
standard deviation is the roughness that such heights lose (`tilt_sigma`). Tilts and albedo alternate: one Gauss-Newton step over
the tilts of all texels in image space, through the pixels' footprints and with the closed form's robust weights, then the
closed form under the tilted normals. Texels that fewer than three suns lit keep the normals of the heights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from seasonscapes.albedo.closed_form import AlbedoFit, SolverOptions, solve_albedo, update_ambient
from seasonscapes.albedo.equations import equations_of, forward_product, light_factors, reweight
from seasonscapes.albedo.footprints import Footprints
from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.ground_pixels import ground_pixels
from seasonscapes.albedo.photographs import LINEAR, AlbedoPhotograph, NoiseModel
from seasonscapes.rendering.receivers import luminaries
from seasonscapes.sky.illumination import Illumination

FEWEST_SUNS = 3
# Suns nearer to each other are one [°].
_SAME_SUN_DEG = 4.0
# Alternations; conjugate-gradient iterations of each; rounds of the closed form after each.
_ROUNDS, _ITERATIONS, _CLOSED_ROUNDS = 2, 15, 2
# So many neighbouring pixels err together, since geometry and shadows are those of coarse heights.
_BLOCK = 32.0
# Cosine of incidence below which sunlight on the heights is no measure of that on a tilted normal.
_LEAST_COSINE = 0.1
# Slopes beyond 45° from the heights' are no relief that one texel may stand for.
_LARGEST_TILT = 1.0
# The central samples of the heights, to a side, tell the roughness of all: in bounded memory.
_WINDOW = 2048
# A texel is lit where this share of what is seen of it, times the cosine, is in sunlight; and seen from so many pixels on.
_LIT, _FEWEST_PIXELS = 0.05, 0.5


@dataclass(frozen=True)
class TiltEquations:
    """Sunlight of one photograph's n pixels as a function of the tilts of N texels.

    Parameters
    ----------
    sunlit
        ``(n, N)`` sparse: weights of the texels in the pixels, times cosine of incidence and visibility of the sun.
    unit
        ``(n, 3)`` radiance of a white pixel that faces the sun [cd/m²].
    weight
        ``(n, 3)`` inverse variances.
    residual
        ``(n, 3)`` picture - model [cd/m²].
    slope
        ``(N, 2)`` relative change of a texel's sunlight by its tilts, the same array for all cameras of an hour; 0 where they
        are not free.
    """

    sunlit: Any
    unit: np.ndarray
    weight: np.ndarray
    residual: np.ndarray
    slope: np.ndarray


def tilt_sigma(height_m: np.ndarray, spacing_m: float, texel_m: float) -> float:
    """Standard deviation of tilts along either tangent, from the heights themselves.

    Relief is about as rough from one octave to the next. What heights lack between their spacing and a texel is therefore
    taken to be what they lose where they are averaged over as many of their own cells.

    Parameters
    ----------
    height_m
        ``(H, W)`` heights without holes [m]; of larger ones the central 2048 × 2048 count.
    spacing_m
        Distance of neighbouring samples [m].
    texel_m
        Side of a texel [m]; where it is as coarse as the heights, cells of two samples are averaged.

    Returns
    -------
    float
        Dimensionless, about the angle in radians.

    Examples
    --------
    >>> import numpy as np
    >>> from seasonscapes.albedo.subgrid_normals import tilt_sigma
    >>> rough = np.random.default_rng(0).normal(size=(64, 64))
    >>> tilt_sigma(rough, 10.0, 5.0) < tilt_sigma(10.0 * rough, 10.0, 5.0)
    True
    """
    import cv2

    top, left = (max((side - _WINDOW) // 2, 0) for side in height_m.shape)
    height_m = height_m[top : top + _WINDOW, left : left + _WINDOW]
    factor = int(np.clip(round(spacing_m / texel_m), 2, 8))
    rows, columns = (max(each // factor, 2) for each in height_m.shape)
    height_m = np.ascontiguousarray(height_m[: rows * factor, : columns * factor], np.float32)
    mean = cv2.resize(height_m, (columns, rows), interpolation=cv2.INTER_AREA)
    smooth = cv2.resize(mean, height_m.shape[::-1], interpolation=cv2.INTER_CUBIC)
    (down, across), (smooth_down, smooth_across) = np.gradient(height_m, spacing_m), np.gradient(smooth, spacing_m)
    normals = [np.stack([-x, -y, np.ones_like(x)], -1) for x, y in ((across, down), (smooth_across, smooth_down))]
    fine, coarse = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in normals)
    cosine = np.maximum((fine * coarse).sum(axis=-1), _LEAST_COSINE)
    lost = np.clip(1.0 / cosine**2 - 1.0, 0.0, _LARGEST_TILT**2)
    # At the rim the means are extrapolated.
    inner = lost[factor:-factor, factor:-factor]
    return float(np.sqrt(0.5 * (inner if inner.size else lost).mean()))


def tangents(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit tangents ``(N, 3)`` each of unit normals ``(N, 3)`` that point upwards: the first has no part towards north."""
    first = np.stack([normal[:, 2], np.zeros(len(normal)), -normal[:, 0]], axis=1)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-9)
    return first, np.cross(normal, first)


def sunlight_factors(normal: np.ndarray, tilt: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Sunlight on tilted normals relative to that on the normals themselves.

    Parameters
    ----------
    normal
        ``(N, 3)`` unit normals.
    tilt
        ``(N, 3)`` tilts, perpendicular to them.
    direction
        ``(3,)`` unit vector towards the sun.

    Returns
    -------
    numpy.ndarray
        ``(N,)``; 1 without tilt, and where the sun stands behind the normal. Below a cosine of incidence of 0.1 the change is
        relative to that cosine, so that grazing light on rough ground stays bounded.

    Examples
    --------
    >>> import numpy as np
    >>> from seasonscapes.albedo.subgrid_normals import sunlight_factors
    >>> up, towards_sun, low_sun = np.array([[0.0, 0.0, 1.0]]), np.array([[0.1, 0.0, 0.0]]), np.array([0.96, 0.0, 0.28])
    >>> sunlight_factors(up, 0.0 * up, low_sun).tolist(), sunlight_factors(up, towards_sun, low_sun).round(2).tolist()
    ([1.0], [1.34])
    """
    tilted = normal + tilt
    cosine, before = tilted @ direction / np.linalg.norm(tilted, axis=1), normal @ direction
    factor = np.maximum(1.0 + (cosine - before) / np.maximum(before, _LEAST_COSINE), 0.0)
    return np.where(before > 0.0, factor, 1.0)


def tilted_photographs(
    photographs: Sequence[AlbedoPhotograph], normal: np.ndarray, tilt: np.ndarray
) -> list[AlbedoPhotograph]:
    """Photographs whose footprints have the direct light of tilted normals.

    Parameters
    ----------
    photographs
        With the light of the heights' normals.
    normal, tilt
        ``(R·S, 3)`` of the texels.
    """
    changed: dict[int, Footprints] = {}
    for each in photographs:
        old = each.footprints
        new = changed.setdefault(id(old), replace(old, sunlit=[list(bodies) for bodies in old.sunlit]))
        for number, body in enumerate(luminaries(each.light)):
            factor = sunlight_factors(normal, tilt, np.asarray(body.direction)).astype(np.float32)
            new.sunlit[each.number][number] = old.sunlit[each.number][number] * factor[old.texel]
    return [replace(each, footprints=changed[id(each.footprints)]) for each in photographs]


def suns_seen(photographs: Sequence[AlbedoPhotograph]) -> np.ndarray:
    """Number of distinct directions of the sun under which each texel is seen in sunlight ``(R·S,)``."""
    size = photographs[0].footprints.shape[0] * photographs[0].footprints.shape[1]
    directions: list[np.ndarray] = []
    lit: list[np.ndarray] = []
    for each in photographs:
        sun = _sun_of(each.light)
        if sun is None:
            continue
        footprints, (number, direction) = each.footprints, sun
        share = np.bincount(footprints.texel, footprints.share, size)
        sunlit = np.bincount(footprints.texel, footprints.sunlit[each.number][number], size) > _LIT * share
        same = [k for k, other in enumerate(directions) if other @ direction > np.cos(np.radians(_SAME_SUN_DEG))]
        if same:
            lit[same[0]] |= sunlit
        else:
            directions.append(direction)
            lit.append(sunlit)
    return np.sum(lit, axis=0) if lit else np.zeros(size, np.int64)


def _sun_of(light: Illumination) -> tuple[int, np.ndarray] | None:
    """Which of the bodies that footprints know is the sun, and the unit vector ``(3,)`` towards it.

    ``None`` where it is below the horizon, or so faint beside the sky that `luminaries` leaves it out.
    """
    bodies = enumerate(luminaries(light))
    return next(((number, np.asarray(body.direction)) for number, body in bodies if body is light.sun), None)


def solve_tilts(
    transport: TexelTransport,
    photographs: Sequence[AlbedoPhotograph],
    start: AlbedoFit,
    sigma: float,
    *,
    noise_model: NoiseModel = LINEAR,
    progress: Callable[[float], None] | None = None,
) -> tuple[np.ndarray, AlbedoFit]:
    """Find the tilts of the texels' normals, and the albedo under them.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels, with the normals of the heights.
    photographs
        Photographs of several hours.
    start
        The closed form's fit under the normals of the heights.
    sigma
        Standard deviation of tilts, from `tilt_sigma`.
    noise_model
        As the closed form had it.
    progress
        Called with the finished fraction.

    Returns
    -------
    tilt
        ``(R, S, 3)`` float32, to be added to unit normals (east-north-up); 0 where fewer than `FEWEST_SUNS` lit the texel.
    fit
        The closed form under the tilted normals.
    """
    report, size = progress or (lambda fraction: None), transport.shape[0] * transport.shape[1]
    normal = np.tile([0.0, 0.0, 1.0], (size, 1))
    normal[transport.texel] = transport.normal
    basis = tangents(normal)
    free = (suns_seen(photographs) >= FEWEST_SUNS) & (start.pixel_count.ravel() >= _FEWEST_PIXELS)
    fit, tilts, tilt, current = start, np.zeros((size, 2)), np.zeros((size, 3)), list(photographs)
    for done in range(_ROUNDS):
        parts = _equations(transport, photographs, current, fit, (normal, basis, free), noise_model)
        tilts = tilt_step(parts, fit.albedo.reshape(size, 3), tilts, sigma)
        tilt = tilts[:, :1] * basis[0] + tilts[:, 1:] * basis[1]
        # Before the next ones are made: together they would be the most memory that a recovery takes.
        del parts, current
        current = tilted_photographs(photographs, normal, tilt)
        solver = SolverOptions(rounds=_CLOSED_ROUNDS)
        fit = solve_albedo(transport, current, noise_model=noise_model, solver=solver, start=fit.albedo)
        report((done + 1) / _ROUNDS)
    return tilt.reshape(*transport.shape, 3).astype(np.float32), fit


def _equations(
    transport: TexelTransport,
    plain: Sequence[AlbedoPhotograph],
    current: Sequence[AlbedoPhotograph],
    fit: AlbedoFit,
    texels: tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray],
    noise_model: NoiseModel,
) -> list[TiltEquations]:
    """Equations of the sunlit photographs about the current tilts; ``texels``: normals, tangents and which are free."""
    (normal, basis, free), albedo = texels, fit.albedo.reshape(-1, 3)
    systems = [equations_of(each, noise_model, len(normal)) for each in current]
    update_ambient(systems, transport, fit.albedo)
    for equations, gain in zip(systems, fit.gains, strict=True):
        ground = ground_pixels(transport, equations.photograph)
        equations.ground = None if ground is None else ground.factors(albedo)
        equations.inverse_gain = 1.0 / gain
    reweight(systems, albedo, noise_model, robust=True)
    parts, slopes = [], {}
    for equations, before in zip(systems, plain, strict=True):
        sun = _sun_of(before.light)
        if sun is None:
            continue
        (number, direction), weight = sun, equations.weight
        assert weight is not None, "reweight sets it"
        radiance = forward_product(equations, albedo)[0] + equations.airlight
        residual = equations.picture * equations.inverse_gain.astype(np.float32) - radiance
        spread = np.abs(residual * np.sqrt(weight))[equations.usable[:, 0]]
        # The empirical spread replaces variances that were underestimated.
        scale = max(1.0, float(np.median(spread)) / 0.6745) if len(spread) else 1.0
        hour = tuple(direction)
        if hour not in slopes:
            change = np.stack([tangent @ direction for tangent in basis], axis=1) * free[:, None]
            slopes[hour] = (change / np.maximum(normal @ direction, _LEAST_COSINE)[:, None]).astype(np.float32)
        sunlit = before.footprints.matrix(before.footprints.sunlit[before.number][number])
        unit = equations.transmittance / np.float32(np.pi) * light_factors(equations)[0][number]
        parts.append(TiltEquations(sunlit, unit, weight / np.float32(scale**2 * _BLOCK), residual, slopes[hour]))
    return parts


def tilt_step(parts: Sequence[TiltEquations], albedo: np.ndarray, tilts: np.ndarray, sigma: float) -> np.ndarray:
    """Tilts after a Gauss-Newton step of all texels together.

    Parameters
    ----------
    parts
        Equations of each photograph about the present tilts.
    albedo
        ``(N, 3)``.
    tilts
        ``(N, 2)`` present tilts along the two tangents.
    sigma
        Their standard deviation.

    Returns
    -------
    numpy.ndarray
        ``(N, 2)``, at most 1 long.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.sparse import eye_array
    >>> from seasonscapes.albedo.subgrid_normals import TiltEquations, tilt_step
    >>> brighter = np.full((1, 3), 0.02)
    >>> part = TiltEquations(eye_array(1), np.ones((1, 3)), np.full((1, 3), 1e6), brighter, np.array([[1.0, 0.0]]))
    >>> tilt_step([part], np.full((1, 3), 0.2), np.zeros((1, 2)), 0.3).round(3).tolist()
    [[0.1, 0.0]]
    """
    from scipy.sparse.linalg import LinearOperator, cg

    prior, shape = 1.0 / max(sigma, 1e-6) ** 2, tilts.shape
    target, diagonal = -prior * tilts, np.full(shape, prior)
    for part in parts:
        target = target + part.slope * _back(part, albedo, part.residual)
        squares = part.sunlit.power(2).T @ (part.weight * part.unit**2)
        diagonal = diagonal + part.slope**2 * (albedo**2 * squares).sum(axis=1)[:, None]

    def curvature(step: np.ndarray) -> np.ndarray:
        step = step.reshape(shape)
        total = prior * step
        for part in parts:
            changed = part.sunlit @ (albedo * (part.slope * step).sum(axis=1)[:, None]) * part.unit
            total = total + part.slope * _back(part, albedo, changed)
        return total.ravel()

    count = tilts.size
    operator = LinearOperator((count, count), matvec=curvature, dtype=np.float64)  # pyright: ignore[reportCallIssue]
    scaled = LinearOperator((count, count), matvec=lambda z: z / diagonal.ravel(), dtype=np.float64)  # pyright: ignore[reportCallIssue]
    step, _ = cg(operator, target.ravel(), rtol=1e-4, maxiter=_ITERATIONS, M=scaled)
    tilts = tilts + step.reshape(shape)
    return tilts * np.minimum(1.0, _LARGEST_TILT / np.maximum(np.linalg.norm(tilts, axis=1, keepdims=True), 1e-9))


def _back(part: TiltEquations, albedo: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Weighted radiances ``(n, 3)`` of the pixels to the relative sunlight of the texels ``(N, 1)``."""
    return (albedo * (part.sunlit.T @ (part.weight * part.unit * values))).sum(axis=1)[:, None]
