"""Normals of the ground below the resolution of its heights, from photographs of several hours (photometric stereo).

Heights of 20 to 100 m leave the relief within their cells flat, and the closed form (`closed_form`) takes its shading for
albedo. Under suns from several directions the two are separable: albedo scales all hours alike, a slope does not
(Woodham 1980, doi:10.1117/12.7972479). Each texel of unit normal n has a tilt t in its tangent plane,

    normal  = (n + t) / |n + t|
    sunlight = E_sun · visible · max(0, normal · sun),

with skylight, interreflection and shadows as the heights have them. Tilts have a Gaussian prior of mean zero, whose standard
deviation tells how much the ground is rougher than its heights (`tilt_sigma`). Tilts and albedo alternate: the closed form
under the tilted normals, then a Gauss-Newton step over the tilts of all texels by conjugate gradients in image space, through
the pixels' footprints and with the same robust weights. Texels under fewer than three suns keep the normals of the heights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.albedo.closed_form import AlbedoFit, SolverOptions, _conjugate_gradients, grid_laplacian, solve_albedo
from seasonscapes.albedo.equations import PhotographEquations, equations_of, forward_product, reweight
from seasonscapes.albedo.forward_model import TexelTransport, ambient_on_texels
from seasonscapes.albedo.photographs import LINEAR, AlbedoPhotograph, NoiseModel
from seasonscapes.rendering.receivers import luminaries

# Incidence below which a texel's sunlight on the heights is no measure of that on a tilted normal.
_LEAST_COSINE = 0.1
_LARGEST_TILT = 1.0
_SAME_SUN_DEG = 4.0


@dataclass(frozen=True)
class TiltOptions:
    sigma: float = 0.3
    smoothness: float = 0.0
    rounds: int = 3
    iterations: int = 15
    fewest_suns: int = 3
    scale: bool = True
    block: float = 1.0


def tangents(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit tangents ``(N, 3)`` each of normals ``(N, 3)``: towards east along the slope, and up it."""
    east = np.stack([normal[:, 2], np.zeros(len(normal)), -normal[:, 0]], axis=1)
    east /= np.maximum(np.linalg.norm(east, axis=1, keepdims=True), 1e-9)
    return east, np.cross(normal, east)


def sunlight_factors(normal: np.ndarray, tilt: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Sunlight on tilted normals relative to that on the normals themselves ``(N,)``."""
    tilted = normal + tilt
    cosine = np.maximum(tilted @ direction, 0.0) / np.linalg.norm(tilted, axis=1)
    before = normal @ direction
    return np.where(before > 0.0, cosine / np.maximum(before, _LEAST_COSINE), 1.0)


def tilted_photographs(
    photographs: Sequence[AlbedoPhotograph], normal: np.ndarray, tilt: np.ndarray
) -> list[AlbedoPhotograph]:
    made, result = {}, []
    for each in photographs:
        key = id(each.footprints)
        if key not in made:
            made[key] = (each.footprints, [list(x) for x in each.footprints.sunlit])
        footprints, sunlit = made[key]
        for number, body in enumerate(luminaries(each.light)):
            factor = sunlight_factors(normal, tilt, np.asarray(body.direction)).astype(np.float32)
            sunlit[each.number][number] = footprints.sunlit[each.number][number] * factor[footprints.texel]
    new = {key: replace(footprints, sunlit=sunlit) for key, (footprints, sunlit) in made.items()}
    return [replace(each, footprints=new[id(each.footprints)]) for each in photographs]


def suns_seen(photographs: Sequence[AlbedoPhotograph], size: int) -> np.ndarray:
    """Number of distinct directions of the sun under which each texel is seen sunlit ``(R·S,)``."""
    directions, seen = [], []
    for each in photographs:
        if each.light.sun is None:
            continue
        footprints = each.footprints
        share = np.bincount(footprints.texel, footprints.share, size)
        lit = np.bincount(footprints.texel, footprints.sunlit[each.number][0], size) > 0.05 * share
        lit &= share > 0
        direction = np.asarray(each.light.sun.direction)
        for k, other in enumerate(directions):
            if direction @ other > np.cos(np.radians(_SAME_SUN_DEG)):
                seen[k] |= lit
                break
        else:
            directions.append(direction)
            seen.append(lit)
    return np.sum(seen, axis=0) if seen else np.zeros(size, int)


def solve_tilts(transport, photographs, *, noise_model=LINEAR, options=TiltOptions(), solver=SolverOptions(), start=None, progress=None):
    size = transport.shape[0] * transport.shape[1]
    normal = np.tile(np.array([0.0, 0.0, 1.0]), (size, 1))
    normal[transport.texel] = transport.normal
    east, up = tangents(normal)
    free = suns_seen(photographs, size) >= options.fewest_suns
    tilt = np.zeros((size, 2))
    fit = start or solve_albedo(transport, photographs, noise_model=noise_model, solver=solver)
    for _ in range(options.rounds):
        world = tilt[:, :1] * east + tilt[:, 1:] * up
        current = tilted_photographs(photographs, normal, world)
        step = _tilt_step(transport, photographs, current, fit, normal, (east, up), tilt, free, noise_model, options)
        tilt = np.where(free[:, None], tilt + step, 0.0)
        length = np.linalg.norm(tilt, axis=1, keepdims=True)
        tilt *= np.minimum(1.0, _LARGEST_TILT / np.maximum(length, 1e-9))
        world = tilt[:, :1] * east + tilt[:, 1:] * up
        current = tilted_photographs(photographs, normal, world)
        fit = solve_albedo(transport, current, noise_model=noise_model, solver=replace(solver, rounds=2), start=fit.albedo)
    return world.reshape(*transport.shape, 3), fit, free.reshape(transport.shape)


def _tilt_step(transport, plain, current, fit, normal, basis, tilt, free, noise_model, options):
    size = len(normal)
    albedo = fit.albedo.reshape(size, 3)
    systems = [equations_of(each, noise_model, size) for each in current]
    known = {}
    for equations, gain in zip(systems, fit.gains, strict=True):
        light = equations.photograph.light
        key = (id(light.sky_radiance), id(light.sun))
        if key not in known:
            known[key] = ambient_on_texels(transport, light, fit.albedo)
        equations.ambient = known[key]
        equations.inverse_gain = 1.0 / gain
    reweight(systems, albedo, noise_model, robust=True)
    target, diagonal = np.zeros((size, 2)), np.zeros((size, 2))
    parts = []
    for equations, before in zip(systems, plain, strict=True):
        sun = equations.photograph.light.sun
        if sun is None:
            continue
        radiance = forward_product(equations, albedo)[0] + equations.airlight
        residual = equations.picture * equations.inverse_gain.astype(np.float32) - radiance
        weight = equations.weight
        normalised = np.abs(residual * np.sqrt(weight))[equations.usable[:, 0]]
        scale = max(1.0, float(np.median(normalised)) / 0.6745) if options.scale else 1.0
        weight = weight / (scale**2 * options.block)
        footprints = before.footprints
        values = footprints.sunlit[before.number][0]
        direction = np.asarray(sun.direction)
        cosine = np.maximum(normal @ direction, _LEAST_COSINE)
        slope = np.stack([(each @ direction) / cosine for each in basis], axis=1)
        slope[~free] = 0.0
        matrix, square = footprints.matrix(values), footprints.matrix(values**2)
        unit = equations.transmittance / np.float32(np.pi) * equations.luminary_lx[0]
        parts.append((matrix, unit, weight, slope))
        target += slope * (albedo * (matrix.T @ (weight * unit * residual))).sum(axis=1)[:, None]
        diagonal += slope**2 * (albedo**2 * (square.T @ (weight * unit**2))).sum(axis=1)[:, None]
    prior = 1.0 / options.sigma**2
    smooth = options.smoothness * prior
    target -= prior * tilt + smooth * grid_laplacian(tilt, transport.shape)

    def curvature(step):
        step = step[:, :2]
        total = prior * step + smooth * grid_laplacian(step, transport.shape)
        for matrix, unit, weight, slope in parts:
            changed = matrix @ (albedo * (slope * step).sum(axis=1)[:, None]) * unit
            total += slope * (albedo * (matrix.T @ (weight * unit * changed))).sum(axis=1)[:, None]
        return total

    return _cg(curvature, target, 1.0 / (diagonal + prior + 4.0 * smooth), options.iterations)


def _cg(apply, target, preconditioner, iterations):
    x, residual = np.zeros_like(target), target.copy()
    z = preconditioner * residual
    direction, rho = z.copy(), float((residual * z).sum())
    first = rho
    for _ in range(iterations):
        if rho <= 1e-8 * first:
            break
        changed = apply(direction)
        alpha = rho / float((direction * changed).sum())
        x += alpha * direction
        residual -= alpha * changed
        z = preconditioner * residual
        following = float((residual * z).sum())
        direction = z + following / rho * direction
        rho = following
    return x
