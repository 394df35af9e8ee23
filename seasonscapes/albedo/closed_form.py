"""Albedo in closed form: robust least squares of all photographs' pixels over texels, with gains projected out.

For photograph i and channel c let ``m(a) = T · M a + A`` be the radiance that albedo ``a`` would send to the camera
(`forward`) and ``y`` the picture's linear values. With inverse gain h, ``h y = m(a)``: linear in both. Where a picture
shows sky, h is the ratio of the sky's known radiance to the picture's; the gains of pictures without sky are eliminated
(variable projection: Golub & Pereyra 1973, doi:10.1137/0710036), which leaves one sparse linear system in ``a``, solved
by conjugate gradients. Projecting all gains, sky pixels among the equations, lets the scale of everything shrink: terrain
pixels outnumber the sky's, and any misfit of theirs is least where all is dark.
Residuals are weighed by what camera and model can promise, and re-weighted by Cauchy's function, so that houses, clouds'
shadows and mistaken pixels fade.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from seasonscapes.albedo.equations import (
    PhotographEquations,
    adjoint,
    equations_of,
    forward_product,
    projected_gain,
    reweight,
    squared_adjoint,
)
from seasonscapes.albedo.footprints import seen_weight
from seasonscapes.albedo.forward_model import TexelTransport, ambient_on_texels
from seasonscapes.albedo.photographs import LINEAR, AlbedoPhotograph, NoiseModel

Progress = Callable[[float], None]
# Albedos of nature lie within these; fresh snow is 0.95 at most, lakes and conifers reflect 2 %.
LOWEST, HIGHEST = 0.004, 0.98


@dataclass(frozen=True)
class SolverOptions:
    """How hard to try: rounds of interreflection and re-weighting, iterations of conjugate gradients in each."""

    rounds: int = 5
    iterations: int = 12
    smoothness: float = 2e-3


@dataclass(frozen=True)
class AlbedoFit:
    """What was found.

    Parameters
    ----------
    albedo
        ``(R, S, 3)`` float32; where ``seen`` is 0 it is the nearest seen texel's, which is no measurement.
    seen
        ``(R, S)`` float32 pixels that each texel fills, over cameras.
    information
        ``(R, S)`` float32 diagonal of the information matrix, in 1/variance of albedo (green).
    gains
        ``(K, 3)`` picture value over radiance.
    residual
        ``(K,)`` robust relative residual of each photograph: median of |picture / model - 1|.
    cost
        Robust cost a pixel, comparable between fits of the same photographs.
    """

    albedo: np.ndarray
    seen: np.ndarray
    information: np.ndarray
    gains: np.ndarray
    residual: np.ndarray
    cost: float
    history: list[dict] = field(default_factory=list)


def solve_albedo(
    land: TexelTransport,
    photographs: Sequence[AlbedoPhotograph],
    *,
    noise_model: NoiseModel = LINEAR,
    solver: SolverOptions = SolverOptions(),
    start: np.ndarray | None = None,
    prior: tuple[np.ndarray, float] | None = None,
    progress: Progress | None = None,
) -> AlbedoFit:
    """Albedo, exposures and white balances from photographs under known light.

    Parameters
    ----------
    start
        ``(R, S, 3)`` albedo to begin with; left out, a middling grey.
    prior
        Another albedo ``(R, S, 3)`` (from a satellite) and its weight: 1 counts like one good pixel a texel.

    Raises
    ------
    ValueError
        No pixel is usable (all clipped, black or masked), or nothing fixes the exposure: no sky, no air, no known gain.
    """
    tell = progress or (lambda share: None)
    size = land.shape[0] * land.shape[1]
    rows = [equations_of(photograph, noise_model, size) for photograph in photographs]
    _require_usable(rows)
    seen = seen_weight(_unique([photograph.footprints for photograph in photographs]))
    albedo = np.full((size, 3), 0.25, np.float32) if start is None else start.reshape(size, 3).astype(np.float32)
    observed = seen.ravel() > 0.0
    history = []
    for number in range(solver.rounds):
        filled = fill_nearest(albedo.reshape(*land.shape, 3), seen)
        for row in rows:
            row.ambient = ambient_on_texels(land, row.photograph.light, filled)
        reweight(rows, albedo, noise_model, robust=number > 0)
        albedo, diagonal = _solve(rows, albedo, solver, land.shape, prior)
        albedo = np.clip(albedo, LOWEST, HIGHEST)
        cost, residual = _assess(rows, albedo, noise_model)
        history.append({"round": number, "cost": cost, "residual": float(np.median(residual))})
        tell((number + 1) / solver.rounds)
    albedo = fill_nearest(albedo.reshape(*land.shape, 3), seen)
    gains = np.stack([1.0 / row.inverse_gain for row in rows])
    information = np.where(observed, diagonal[:, 1], 0.0).reshape(land.shape).astype(np.float32)
    return AlbedoFit(albedo, seen, information, gains, residual, cost, history)


def _unique(items: Sequence) -> list:
    return list({id(item): item for item in items}.values())


def _require_usable(rows: list[PhotographEquations]) -> None:
    counts = [int(row.usable[:, 0].sum()) for row in rows]
    if sum(counts) == 0:
        raise ValueError("solve_albedo: no usable pixel in any photograph: all clipped, black or masked")
    dark = [
        row
        for row in rows
        if not row.suns and row.ambient.max() <= 0.0 and row.photograph.light.sky_radiance.max() <= 0.0
    ]
    if len(dark) == len(rows):
        raise ValueError("solve_albedo: no photograph has any light")
    anchored = any(not row.projected or row.airlight.max() > 0.0 for row in rows)
    if not anchored:
        raise ValueError("solve_albedo: nothing fixes the exposure: give a gain, or photographs that show sky")


# ---------------------------------------------------------------------------------------------- conjugate gradients


def _solve(
    rows: list[PhotographEquations],
    start: np.ndarray,
    solver: SolverOptions,
    shape: tuple[int, int],
    prior: tuple[np.ndarray, float] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Minimise the weighted squares over albedo, gains projected out. Returns albedo and the normal diagonal."""
    diagonal = np.zeros_like(start)
    target = np.zeros_like(start)
    bottoms = []
    for row in rows:
        diagonal += squared_adjoint(row)
        if row.projected:
            bottoms.append(np.maximum((row.weight * row.picture**2).sum(axis=0), 1e-30))
            known = (row.weight * row.picture * row.airlight).sum(axis=0)
            right = row.picture * (known / bottoms[-1]) - row.airlight
        else:
            bottoms.append(None)
            right = row.picture * row.inverse_gain.astype(np.float32) - row.airlight
        target += adjoint(row, row.weight * right)
    typical = np.array([np.median(d[d > 0.0]) if (d > 0.0).any() else 1.0 for d in diagonal.T], np.float32)
    smooth = solver.smoothness * typical
    pull = np.zeros(3, np.float32)
    if prior is not None:
        pull = prior[1] * typical
        target = target + pull * prior[0].reshape(start.shape)

    def normal(a: np.ndarray) -> np.ndarray:
        total = smooth * _laplacian(a, shape) + (pull + 1e-6 * typical) * a
        for row, bottom in zip(rows, bottoms, strict=True):
            model = forward_product(row, a)[0]
            if bottom is not None:
                model -= row.picture * ((row.weight * row.picture * model).sum(axis=0) / bottom)
            total += adjoint(row, row.weight * model)
        return total

    preconditioner = 1.0 / (diagonal + 4.0 * smooth + pull + 1e-6 * typical)
    target = target + 1e-6 * typical * start
    return _conjugate_gradients(normal, target, start, preconditioner, solver.iterations), diagonal


def _conjugate_gradients(
    normal: Callable, target: np.ndarray, x: np.ndarray, preconditioner: np.ndarray, iterations: int
) -> np.ndarray:
    """Preconditioned conjugate gradients for three independent systems side by side."""
    x = x.copy()
    residual = target - normal(x)
    z = preconditioner * residual
    direction = z.copy()
    rho = _dots(residual, z)
    first = np.maximum(rho, 1e-30)
    for _ in range(iterations):
        if np.all(rho < 1e-8 * first):
            break
        step = normal(direction)
        alpha = rho / np.maximum(_dots(direction, step), 1e-30)
        x += (alpha * direction).astype(np.float32)
        residual = residual - (alpha * step).astype(np.float32)
        z = preconditioner * residual
        after = _dots(residual, z)
        direction = z + (after / np.maximum(rho, 1e-30) * direction).astype(np.float32)
        rho = after
    return x


def _dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nc,nc->c", a.astype(np.float64), b.astype(np.float64))


def _laplacian(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Graph Laplacian of the texel grid: four neighbours."""
    grid = values.reshape(*shape, -1)
    result = np.zeros_like(grid)
    down, across = np.diff(grid, axis=0), np.diff(grid, axis=1)
    result[:-1] -= down
    result[1:] += down
    result[:, :-1] -= across
    result[:, 1:] += across
    return result.reshape(values.shape)


def _assess(rows: list[PhotographEquations], albedo: np.ndarray, noise_model: NoiseModel) -> tuple[float, np.ndarray]:
    """Robust cost a pixel in the pictures' own relative scale, and median relative residual of each photograph."""
    total, count, residuals = 0.0, 0, []
    for row in rows:
        radiance = forward_product(row, albedo)[0] + row.airlight
        if row.projected:
            row.inverse_gain = projected_gain(row, radiance)
        h = row.inverse_gain.astype(np.float32)
        floor = 1e-3 * float(np.median(radiance)) + 1e-9
        relative = (h * row.picture - radiance) / (radiance + floor)
        promised = np.sqrt(noise_model.model**2 + (row.noise * h / (radiance + floor)) ** 2)
        keep = row.usable[:, 0]
        total += float(np.log1p((relative[keep] / (2.385 * promised[keep])) ** 2).sum())
        count += int(keep.sum()) * 3
        if len(row.sky_picture):
            apart = (h * row.sky_picture - row.sky_radiance) / (row.sky_radiance + floor)
            total += float(np.log1p((apart / (2.385 * noise_model.sky)) ** 2).sum())
            count += apart.size
        residuals.append(float(np.median(np.abs(relative[keep]))) if keep.any() else np.nan)
    return total / max(count, 1), np.array(residuals)


def fill_nearest(values: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Values ``(R, S, 3)`` with those of texels that were never seen taken from the nearest seen one."""
    from scipy.ndimage import distance_transform_edt

    if (seen > 0.0).all() or not (seen > 0.0).any():
        return values
    row, column = distance_transform_edt(seen <= 0.0, return_distances=False, return_indices=True)
    return values[row, column]


def pixel_weights(
    land: TexelTransport, photographs: Sequence[AlbedoPhotograph], fit: AlbedoFit, noise_model: NoiseModel = LINEAR
) -> list[np.ndarray]:
    """Weights ``(n, 3)`` [1 / (cd/m²)²] that a fit's last round gives the terrain pixels of each photograph."""
    size = land.shape[0] * land.shape[1]
    albedo = fit.albedo.reshape(size, 3)
    weights = []
    for photograph, gain in zip(photographs, fit.gains, strict=True):
        row = equations_of(replace(photograph, gain=np.asarray(gain, float)), noise_model, size)
        row.ambient = ambient_on_texels(land, photograph.light, fit.albedo)
        reweight([row], albedo, noise_model, robust=True)
        weights.append(row.weight)
    return weights
