"""Rounds of a joint recovery: a problem of photographs and unknowns, Gauss-Newton on some of them, loss of the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csr_array

from seasonscapes.albedo.closed_form import HIGHEST, LOWEST, fill_nearest
from seasonscapes.albedo.equations import usable_pixels
from seasonscapes.albedo.footprints import texel_pixel_count, whole_pixels
from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.photographs import AlbedoPhotograph, NoiseModel
from seasonscapes.albedo.recovery_pictures import HazeLights, RecoveryPicture, recovery_picture
from seasonscapes.albedo.recovery_prediction import (
    LitLand,
    PredictedPicture,
    RecoveryFrame,
    albedo_derivative,
    bounce_on_land,
    predict,
    sky_on_land,
)
from seasonscapes.albedo.recovery_system import RecoveryBlock, RecoverySystem
from seasonscapes.albedo.recovery_unknowns import CURVE, GAIN, HAZE, SKY, SUN, TURN, RecoveryPriors, UnknownLayout
from seasonscapes.rendering.receivers import luminaries

# Cauchy's scale with 95 % efficiency for normal errors.
_CAUCHY = 2.385
_LARGEST_STEP = 0.7


@dataclass(frozen=True)
class JointOptions:
    """How `recover_jointly` solves.

    Parameters
    ----------
    rounds, last_rounds
        Most Gauss-Newton rounds on the training photographs, and rounds after them on all.
    iterations
        Conjugate-gradient iterations in each.
    sun_grid
        Nodes of the sun's visible share along each side of the land.
    held_out
        Share of the photographs that only judge, at least one.
    smoothness
        As in `closed_form.SolverOptions`.
    priors
        Standard deviations of the unknowns.
    seed
        Of the choice of held-out photographs.
    """

    rounds: int = 8
    last_rounds: int = 2
    iterations: int = 16
    sun_grid: int = 12
    held_out: float = 0.12
    smoothness: float = 2e-3
    priors: RecoveryPriors = field(default_factory=RecoveryPriors)
    seed: int = 0


@dataclass
class RecoveryState:
    """Log albedo ``(R·S, 3)`` and the vector of all other unknowns ``(P,)``."""

    log_albedo: np.ndarray
    values: np.ndarray

    @property
    def albedo(self) -> np.ndarray:
        return np.exp(self.log_albedo).astype(np.float32)


@dataclass(frozen=True)
class RecoveryProblem:
    """All pictures, and what they share."""

    transport: TexelTransport
    pictures: list[RecoveryPicture]
    frame: RecoveryFrame
    start: np.ndarray
    precision: np.ndarray
    sky_of_instant: list[np.ndarray]
    pixel_count: np.ndarray
    options: JointOptions

    @property
    def layout(self) -> UnknownLayout:
        return self.frame.layout


def make_problem(
    transport: TexelTransport,
    photographs: Sequence[AlbedoPhotograph],
    haze: HazeLights,
    noise_model: NoiseModel,
    gains: np.ndarray,
    options: JointOptions,
) -> RecoveryProblem:
    """Group photographs by camera and instant, and lay out the unknowns with their priors.

    Photographs of one moment under different clouds count as two instants, since those of one instant share their light.
    """
    cameras = _numbers([id(photograph.footprints) for photograph in photographs])
    instants = _numbers([(each.observation.time, each.light.cloudiness) for each in photographs])
    layout = UnknownLayout(len(photographs), max(cameras) + 1, max(instants) + 1, options.sun_grid)
    priors = options.priors
    start, sigma = np.zeros(layout.size), np.zeros(layout.size)
    layout.view(start, HAZE)[:], layout.view(start, SUN)[:] = np.log(haze.start_km), 1.0
    layout.view(sigma, CURVE)[:] = (priors.curve_strength, priors.log_exponent) if noise_model.levels else 0.0
    layout.view(sigma, SKY)[:] = priors.log_sky
    layout.view(sigma, HAZE)[:] = priors.log_visibility if len(haze.visibility_km) > 1 else 0.0
    for photograph, camera in zip(photographs, cameras, strict=True):
        pose = photograph.observation.pose_sigma
        angles = [pose.get(name, 0.0) for name in ("pitch_deg", "heading_deg", "roll_deg")]
        layout.view(sigma, TURN)[camera] = np.radians(angles)
    layout.view(start, GAIN)[:] = np.log(gains)
    layout.view(sigma, GAIN)[:] = [
        [priors.log_gain if photograph.gain is None else photograph.gain_sigma] * 3 for photograph in photographs
    ]
    # An unknown that is exact keeps its start.
    precision = np.where(sigma > 0.0, priors.block / np.maximum(sigma, 1e-12) ** 2, 1e12)
    precision[layout.offset(SUN) :] = 0.0
    pixel_count = texel_pixel_count((each.footprints, _used_pixels(each, noise_model)) for each in photographs)
    weights = sun_weights(transport, photographs, pixel_count, options.sun_grid)
    pictures = [
        recovery_picture(
            photograph,
            (k, cameras[k], instants[k]),
            [lights[k] for lights in haze.lights],
            noise_model,
            weights[id(photograph.footprints)] if luminaries(photograph.light) else None,
        )
        for k, photograph in enumerate(photographs)
    ]
    first = [instants.index(t) for t in range(layout.instants)]
    sky = [sky_on_land(transport, [lights[k] for lights in haze.lights]) for k in first]
    frame = RecoveryFrame(layout, haze, noise_model, np.asarray(layout.view(sigma, TURN).any(axis=1)))
    return RecoveryProblem(transport, pictures, frame, start, precision, sky, pixel_count, options)


def _used_pixels(photograph: AlbedoPhotograph, noise_model: NoiseModel) -> np.ndarray:
    usable = usable_pixels(photograph.observation, photograph.noise(noise_model)).ravel()
    return whole_pixels(photograph.footprints) & usable[photograph.footprints.pixel]


def _numbers(keys: Sequence[Any]) -> list[int]:
    order = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return [order[key] for key in keys]


def sun_weights(
    transport: TexelTransport, photographs: Sequence[AlbedoPhotograph], pixel_count: np.ndarray, grid: int
) -> dict[int, Any]:
    """Bilinear weights ``(n, G²)`` of each footprint's pixels between the nodes of a grid over the seen land."""
    place = np.zeros((pixel_count.size, 2), np.float32)
    place[transport.texel] = transport.position_m[:, :2]
    seen = place[transport.texel][pixel_count.ravel()[transport.texel] > 0.0]
    low, width = seen.min(axis=0), np.maximum(np.ptp(seen, axis=0), 1.0)
    result = {}
    for footprints in {id(p.footprints): p.footprints for p in photographs}.values():
        centre = (footprints.matrix(footprints.share) @ place) / np.maximum(footprints.coverage, 1e-6)[:, None]
        x = np.clip((centre - low) / width, 0.0, 1.0) * (grid - 1)
        first = np.minimum(x.astype(int), grid - 2)
        f = x - first
        row = np.tile(np.arange(len(x)), 4)
        columns, values = [], []
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            columns.append((first[:, 1] + dy) * grid + first[:, 0] + dx)
            values.append((f[:, 0] if dx else 1.0 - f[:, 0]) * (f[:, 1] if dy else 1.0 - f[:, 1]))
        entries = (np.concatenate(values).astype(np.float32), (row, np.concatenate(columns)))
        result[id(footprints)] = csr_array(coo_array(entries, shape=(len(x), grid**2)))
    return result


# ---------------------------------------------------------------------------------------------- rounds


def lit_lands(problem: RecoveryProblem, state: RecoveryState) -> list[LitLand]:
    """Light on the land at each instant under the present state."""
    layout, shape = problem.layout, problem.transport.shape
    albedo = fill_nearest(state.albedo.reshape(*shape, 3), problem.pixel_count)
    sun, sky = layout.view(state.values, SUN), layout.view(state.values, SKY)
    first = {picture.instant: picture.number for picture in reversed(problem.pictures)}
    log_visibility = float(layout.view(state.values, HAZE)[0])
    lands = []
    for instant in range(layout.instants):
        light = problem.frame.haze.at(first[instant], log_visibility)
        bounce = bounce_on_land(problem.transport, light, albedo, float(sun[instant].mean()), sky[instant])
        lands.append(LitLand(problem.sky_of_instant[instant], bounce))
    return lands


def advance(problem: RecoveryProblem, state: RecoveryState, used: Sequence[int]) -> tuple[RecoveryState, float]:
    """One Gauss-Newton round on some of the photographs; the new state, and the cost per pixel of the old one."""
    options, layout = problem.options, problem.layout
    lands = lit_lands(problem, state)
    albedo, blocks = state.albedo, []
    precision, pull = problem.precision.copy(), problem.precision * (problem.start - state.values)
    cost, count = 0.0, 0
    for k in used:
        picture = problem.pictures[k]
        predicted = predict(picture, lands[picture.instant], albedo, state.values, problem.frame)
        robust, loss, number = _robust(predicted)
        cost, count = cost + loss, count + number
        root = np.sqrt(predicted.weight * robust)
        blocks.append(_block(problem, picture, predicted, albedo, root))
        _add_sky(problem, picture, predicted, blocks[-1])
    coupling = _sun_prior(problem, state.values, precision, pull)
    system = RecoverySystem(
        blocks,
        problem.transport.shape,
        layout.offset(SUN),
        layout.grid**2,
        precision,
        pull,
        coupling,
        options.smoothness,
        state.log_albedo,
    )
    by_albedo, by_other = system.solve(options.iterations)
    log_albedo = state.log_albedo + np.clip(by_albedo, -_LARGEST_STEP, _LARGEST_STEP)
    log_albedo = np.clip(log_albedo, np.log(LOWEST), np.log(HIGHEST))
    values = layout.clipped(state.values + np.clip(by_other, -_LARGEST_STEP, _LARGEST_STEP))
    return RecoveryState(log_albedo, values), cost / max(count, 1)


def _robust(predicted: PredictedPicture) -> tuple[np.ndarray, float, int]:
    """Cauchy's weights ``(n, 1)`` by the worst channel, the robust cost, and the number of values it sums."""
    normalised = np.abs(predicted.residual) * np.sqrt(predicted.weight)
    usable = predicted.weight[:, 0] > 0.0
    worst = normalised.max(axis=1, keepdims=True)
    # The empirical spread replaces variances that were underestimated, as in the closed form.
    scale = max(1.0, float(np.median(worst[usable])) / 1.4 if usable.any() else 1.0)
    cost = float(np.log1p((normalised[usable] / _CAUCHY) ** 2).sum())
    return 1.0 / (1.0 + (worst / (_CAUCHY * scale)) ** 2), cost, int(usable.sum()) * 3


def _block(
    problem: RecoveryProblem,
    picture: RecoveryPicture,
    predicted: PredictedPicture,
    albedo: np.ndarray,
    root: np.ndarray,
) -> RecoveryBlock:
    layout = problem.layout
    return RecoveryBlock(
        albedo_derivative(picture, predicted, albedo, root),
        problem.frame.columns(picture),
        predicted.dense * root.T[:, :, None],
        picture.sun_weights,
        (predicted.by_sun * root).T,
        layout.offset(SUN) + picture.instant * layout.grid**2,
        (predicted.residual * root).T,
    )


def _add_sky(
    problem: RecoveryProblem, picture: RecoveryPicture, predicted: PredictedPicture, block: RecoveryBlock
) -> None:
    """Append the evidence of the sky in a picture as one more row to the dense part of its block."""
    if predicted.sky_residual is None or predicted.sky_dense is None:
        return
    priors = problem.options.priors
    worst = float(np.abs(predicted.sky_residual).max()) / priors.sky_picture
    root = np.sqrt(priors.block / (1.0 + (worst / _CAUCHY) ** 2)) / priors.sky_picture
    block.evidence = (predicted.sky_dense * root, predicted.sky_residual * root)


def _sun_prior(
    problem: RecoveryProblem, values: np.ndarray, precision: np.ndarray, pull: np.ndarray
) -> list[np.ndarray]:
    """Add Cauchy's prior of the sun's visible share; the precision of its steps of the sun's share ``(G², G²)`` for each instant."""
    layout, priors, grid = problem.layout, problem.options.priors, problem.layout.grid
    first = layout.offset(SUN)
    share = layout.view(values, SUN)
    distance = layout.view(problem.start, SUN) - layout.view(values, SUN)
    weight = priors.block / priors.sun**2 / (1.0 + (distance / (_CAUCHY * priors.sun)) ** 2)
    layout.view(precision, SUN)[:] += weight
    layout.view(pull, SUN)[:] += weight * distance
    node = np.arange(grid**2).reshape(grid, grid)
    pairs = [np.stack([node[:, :-1].ravel(), node[:, 1:].ravel()]), np.stack([node[:-1].ravel(), node[1:].ravel()])]
    low, high = np.concatenate(pairs, axis=1)
    couplings = []
    for instant, nodes in enumerate(share):
        step = nodes[high] - nodes[low]
        stiff = priors.block / priors.sun_step**2 / (1.0 + (step / (_CAUCHY * priors.sun_step)) ** 2)
        matrix = np.zeros((grid**2, grid**2))
        np.add.at(matrix, (low, low), stiff)
        np.add.at(matrix, (high, high), stiff)
        np.add.at(matrix, (low, high), -stiff)
        np.add.at(matrix, (high, low), -stiff)
        couplings.append(matrix)
        begin = first + instant * grid**2
        pull[begin : begin + grid**2] -= matrix @ nodes
    return couplings


# ---------------------------------------------------------------------------------------------- held out


def held_out_loss(
    problem: RecoveryProblem, state: RecoveryState, held_out: Sequence[int]
) -> tuple[float, RecoveryState]:
    """Robust loss per value of photographs of which the exposure alone is fitted, and the state with their exposures."""
    lands, total, count = lit_lands(problem, state), 0.0, 0
    values, albedo, priors = state.values.copy(), state.albedo, problem.options.priors
    gains = problem.layout.view(values, GAIN)
    for k in held_out:
        picture = problem.pictures[k]
        for _ in range(6):
            predicted = predict(picture, lands[picture.instant], albedo, values, problem.frame)
            robust, _, _ = _robust(predicted)
            weight, slope = predicted.weight * robust, predicted.dense[:, :, 0].T
            pulled, stiff = (weight * slope * predicted.residual).sum(axis=0), (weight * slope**2).sum(axis=0)
            if predicted.sky_residual is not None:
                worst = float(np.abs(predicted.sky_residual).max()) / priors.sky_picture
                sky = priors.block / priors.sky_picture**2 / (1.0 + (worst / _CAUCHY) ** 2)
                pulled, stiff = pulled + sky * predicted.sky_residual, stiff + sky
            if problem.pictures[k].photograph.gain is None or problem.pictures[k].photograph.gain_sigma > 0.0:
                gains[k] += np.clip(pulled / np.maximum(stiff, 1e-12), -_LARGEST_STEP, _LARGEST_STEP)
        predicted = predict(picture, lands[picture.instant], albedo, values, problem.frame)
        _, loss, number = _robust(predicted)
        total, count = total + loss, count + number
    return total / max(count, 1), RecoveryState(state.log_albedo, values)
