"""Albedo in closed form: robust linear least squares of all photographs over the texels, with gains projected out.

For photograph i and channel c let ``m(a) = T · M a + A`` be the radiance at the camera under albedo ``a``
(`forward_model`) and ``y`` the linear pixel values. With inverse gain h the equations ``h y = m(a)`` are linear in both
unknowns. Where a photograph shows sky, h is the ratio of modelled sky radiance to pixel value; the gains of photographs
without sky are eliminated by variable projection (Golub & Pereyra 1973, doi:10.1137/0710036). One sparse linear system
in ``a`` remains, which preconditioned conjugate gradients solve.
Projecting the gains of all photographs, with sky pixels among the equations, would let the common scale shrink: terrain
pixels outnumber sky pixels, and any misfit of theirs is smallest where all radiance is small.
Residuals are weighted by the variances of camera and model, and iteratively reweighted with Cauchy's function, so that
buildings, cloud shadows and misregistered pixels lose their influence. Snow and forest reflect as in the renderer, under the
albedo of the round before (`ground_pixels`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from seasonscapes.albedo.equations import (
    PhotographEquations,
    adjoint,
    equations_of,
    forward_product,
    projected_gain,
    radiance_floor,
    reweight,
    squared_adjoint,
)
from seasonscapes.albedo.footprints import texel_pixel_count
from seasonscapes.albedo.forward_model import TexelTransport, ambient_on_texels
from seasonscapes.albedo.ground_pixels import ground_pixels
from seasonscapes.albedo.photographs import LINEAR, AlbedoPhotograph, NoiseModel
from seasonscapes.errors import NotEnoughEvidence, NoUsablePixels

Progress = Callable[[float], None]
# Bounds of natural albedos: fresh snow reflects 95 % at most, lakes and conifers 2 %.
LOWEST, HIGHEST = 0.004, 0.98


@dataclass(frozen=True)
class SolverOptions:
    """Options of the closed-form solver.

    Parameters
    ----------
    rounds
        Outer iterations, each of which updates interreflection and robust weights.
    iterations
        Conjugate-gradient iterations in each round.
    smoothness
        Weight of the texel grid's Laplacian, relative to the median diagonal of the normal matrix.
    """

    rounds: int = 5
    iterations: int = 12
    smoothness: float = 2e-3


@dataclass(frozen=True)
class AlbedoFit:
    """Result of the closed-form solver.

    Parameters
    ----------
    albedo
        ``(R, S, 3)`` float32; where ``pixel_count`` is 0, copied from the nearest observed texel (no measurement).
    pixel_count
        ``(R, S)`` float32 number of usable pixels that each texel covers, summed over cameras.
    information
        ``(R, S)`` float32 diagonal of the information matrix, in 1/variance of albedo (green).
    gains
        ``(K, 3)`` pixel value over radiance.
    residual
        ``(K,)`` robust relative residual of each photograph: median of |picture / model - 1|.
    cost
        Robust cost per pixel, comparable between fits of the same photographs.
    history
        ``round``, ``cost`` and median ``residual`` of each outer iteration.
    noise_model
        Standard deviations that weighted the residuals.
    """

    albedo: np.ndarray
    pixel_count: np.ndarray
    information: np.ndarray
    gains: np.ndarray
    residual: np.ndarray
    cost: float
    history: list[dict[str, float]] = field(default_factory=list)
    noise_model: NoiseModel = LINEAR


@dataclass(frozen=True)
class SearchOptions:
    """Options of a search over one unknown of the light or the camera, with one albedo fit for each candidate value.

    Parameters
    ----------
    fraction
        Fraction of the terrain pixels used.
    seed
        Seed of the drawn pixels.
    start
        Initial albedo fit.
    solver
        Numbers of iterations of each albedo fit.
    """

    fraction: float = 0.2
    seed: int = 0
    start: AlbedoFit | None = None
    solver: SolverOptions = SolverOptions(rounds=3, iterations=8)


def solve_albedo(
    transport: TexelTransport,
    photographs: Sequence[AlbedoPhotograph],
    *,
    noise_model: NoiseModel = LINEAR,
    solver: SolverOptions = SolverOptions(),
    start: np.ndarray | None = None,
    prior: tuple[np.ndarray, float] | None = None,
    progress: Progress | None = None,
) -> AlbedoFit:
    """Estimate albedo, exposures and white balances from photographs under known light.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    photographs
        K photographs with their lights and footprints.
    noise_model
        Standard deviations that weight the residuals.
    solver
        Numbers of iterations and smoothness.
    start
        ``(R, S, 3)`` initial albedo; 0.25 everywhere if omitted.
    prior
        Another albedo ``(R, S, 3)`` (from a satellite, for example) and its weight; weight 1 equals one good pixel per
        texel.
    progress
        Called with the finished fraction after each round.

    Returns
    -------
    AlbedoFit
        Albedo, gains, residuals and the diagonal of the information matrix.

    Raises
    ------
    NoUsablePixels
        If every terrain pixel is clipped, black or masked.
    NotEnoughEvidence
        If no photograph has any light, or nothing fixes the exposure: no sky, no airlight and no known gain.
    """
    report = progress or (lambda fraction: None)
    size = transport.shape[0] * transport.shape[1]
    systems = [equations_of(photograph, noise_model, size) for photograph in photographs]
    _require_usable(systems)
    pixel_count = texel_pixel_count(
        (each.photograph.footprints, np.asarray(each.usable.any(axis=1))) for each in systems
    )
    albedo = np.full((size, 3), 0.25, np.float32) if start is None else start.reshape(size, 3).astype(np.float32)
    observed = pixel_count.ravel() > 0.0
    grounds = [ground_pixels(transport, photograph) for photograph in photographs]
    history = []
    for number in range(solver.rounds):
        filled = fill_nearest(albedo.reshape(*transport.shape, 3), pixel_count)
        update_ambient(systems, transport, filled)
        for equations, ground in zip(systems, grounds, strict=True):
            equations.ground = None if ground is None else ground.factors(albedo)
        reweight(systems, albedo, noise_model, robust=number > 0)
        albedo, diagonal = _solve(systems, albedo, solver, transport.shape, prior)
        albedo = np.clip(albedo, LOWEST, HIGHEST)
        cost, residual = _assess(systems, albedo, noise_model)
        history.append({"round": number, "cost": cost, "residual": float(np.median(residual))})
        report((number + 1) / solver.rounds)
    albedo = fill_nearest(albedo.reshape(*transport.shape, 3), pixel_count)
    gains = np.stack([1.0 / equations.inverse_gain for equations in systems])
    information = np.where(observed, diagonal[:, 1], 0.0).reshape(transport.shape).astype(np.float32)
    return AlbedoFit(albedo, pixel_count, information, gains, residual, cost, history, noise_model)


def update_ambient(systems: list[PhotographEquations], transport: TexelTransport, albedo: np.ndarray) -> None:
    """Ambient illuminance under an albedo ``(R, S, 3)``, once for all photographs of one sky, sun and moon."""
    known: dict[tuple[int, int, int], np.ndarray] = {}
    for equations in systems:
        light = equations.photograph.light
        key = (id(light.sky_radiance), id(light.sun), id(light.moon))
        if key not in known:
            known[key] = ambient_on_texels(transport, light, albedo)
        equations.ambient = known[key]


def _require_usable(systems: list[PhotographEquations]) -> None:
    if not any(equations.usable.any() for equations in systems):
        raise NoUsablePixels("solve_albedo: no usable pixel in any photograph: all clipped, black or masked")
    # Interreflection needs no test of its own: it is zero where no luminary and no sky emits light.
    if not any(equations.luminary_lx or equations.photograph.light.sky_radiance.max() > 0.0 for equations in systems):
        raise NotEnoughEvidence("solve_albedo: no photograph has any light")
    anchored = any(not equations.projected or equations.airlight.max() > 0.0 for equations in systems)
    if not anchored:
        raise NotEnoughEvidence(
            "solve_albedo: nothing fixes the exposure: give a gain, or photographs with sky in the picture"
        )


# ---------------------------------------------------------------------------------------------- conjugate gradients


def _solve(
    systems: list[PhotographEquations],
    start: np.ndarray,
    solver: SolverOptions,
    shape: tuple[int, int],
    prior: tuple[np.ndarray, float] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Minimise the weighted squares over albedo, gains projected out. Returns albedo and the normal diagonal."""
    diagonal = np.zeros_like(start)
    target = np.zeros_like(start)
    # Squared norm of the weighted pixel values, the denominator of a projected gain; None where the gain is known.
    gain_norms: list[np.ndarray | None] = []
    for equations in systems:
        weight = equations.weight
        assert weight is not None
        diagonal += squared_adjoint(equations)
        if equations.projected:
            norm = np.maximum((weight * equations.picture**2).sum(axis=0), 1e-30)
            gain_norms.append(norm)
            known = (weight * equations.picture * equations.airlight).sum(axis=0)
            right = equations.picture * (known / norm) - equations.airlight
        else:
            gain_norms.append(None)
            right = equations.picture * equations.inverse_gain.astype(np.float32) - equations.airlight
        target += adjoint(equations, weight * right)
    typical = np.array([np.median(d[d > 0.0]) if (d > 0.0).any() else 1.0 for d in diagonal.T], np.float32)
    smooth = solver.smoothness * typical
    prior_weight = np.zeros(3, np.float32)
    if prior is not None:
        prior_weight = prior[1] * typical
        target = target + prior_weight * prior[0].reshape(start.shape)

    def normal(a: np.ndarray) -> np.ndarray:
        total = smooth * grid_laplacian(a, shape) + (prior_weight + 1e-6 * typical) * a
        for equations, norm in zip(systems, gain_norms, strict=True):
            weight = equations.weight
            assert weight is not None
            model = forward_product(equations, a)[0]
            if norm is not None:
                model -= equations.picture * ((weight * equations.picture * model).sum(axis=0) / norm)
            total += adjoint(equations, weight * model)
        return total

    preconditioner = 1.0 / (diagonal + 4.0 * smooth + prior_weight + 1e-6 * typical)
    target = target + 1e-6 * typical * start
    return _conjugate_gradients(normal, target, start, preconditioner, solver.iterations), diagonal


def _conjugate_gradients(
    normal: Callable[[np.ndarray], np.ndarray],
    target: np.ndarray,
    x: np.ndarray,
    preconditioner: np.ndarray,
    iterations: int,
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
        curvature = normal(direction)
        alpha = rho / np.maximum(_dots(direction, curvature), 1e-30)
        x += (alpha * direction).astype(np.float32)
        residual = residual - (alpha * curvature).astype(np.float32)
        z = preconditioner * residual
        next_rho = _dots(residual, z)
        direction = z + (next_rho / np.maximum(rho, 1e-30) * direction).astype(np.float32)
        rho = next_rho
    return x


def _dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products of the columns, in double precision ``(3,)``."""
    return np.einsum("nc,nc->c", a.astype(np.float64), b.astype(np.float64))


def grid_laplacian(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Graph Laplacian of the texel grid: four neighbours."""
    grid = values.reshape(*shape, -1)
    result = np.zeros_like(grid)
    down, across = np.diff(grid, axis=0), np.diff(grid, axis=1)
    result[:-1] -= down
    result[1:] += down
    result[:, :-1] -= across
    result[:, 1:] += across
    return result.reshape(values.shape)


def _assess(
    systems: list[PhotographEquations], albedo: np.ndarray, noise_model: NoiseModel
) -> tuple[float, np.ndarray]:
    """Robust cost per pixel, from relative residuals, and the median relative residual of each photograph ``(K,)``."""
    total, count, residuals = 0.0, 0, []
    for equations in systems:
        radiance = forward_product(equations, albedo)[0] + equations.airlight
        if equations.projected:
            equations.inverse_gain = projected_gain(equations, radiance)
        h = equations.inverse_gain.astype(np.float32)
        floor = radiance_floor(radiance)
        relative = (h * equations.picture - radiance) / (radiance + floor)
        own = equations.photograph.noise(noise_model)
        sigma = np.sqrt(own.model**2 + (equations.noise * h / (radiance + floor)) ** 2)
        keep = equations.usable[:, 0]
        total += float(np.log1p((relative[keep] / (2.385 * sigma[keep])) ** 2).sum())
        count += int(keep.sum()) * 3
        if len(equations.sky_picture):
            sky_residual = (h * equations.sky_picture - equations.sky_radiance) / (equations.sky_radiance + floor)
            total += float(np.log1p((sky_residual / (2.385 * noise_model.sky)) ** 2).sum())
            count += sky_residual.size
        residuals.append(float(np.median(np.abs(relative[keep]))) if keep.any() else np.nan)
    return total / max(count, 1), np.array(residuals)


def fill_nearest(values: np.ndarray, pixel_count: np.ndarray) -> np.ndarray:
    """Fill unobserved texels with the value of the nearest observed texel.

    Parameters
    ----------
    values
        ``(R, S, 3)``.
    pixel_count
        ``(R, S)``, positive where a texel was observed.

    Returns
    -------
    numpy.ndarray
        ``(R, S, 3)``; the input itself where all texels or none were observed.
    """
    from scipy.ndimage import distance_transform_edt

    if (pixel_count > 0.0).all() or not (pixel_count > 0.0).any():
        return values
    nearest = distance_transform_edt(pixel_count <= 0.0, return_distances=False, return_indices=True)
    assert nearest is not None
    row, column = nearest
    return values[row, column]
