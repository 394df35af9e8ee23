"""Albedo by differentiable rendering, started from the closed form, with any further parameter Mitsuba differentiates.

The closed form's approximations (interreflection by outer iterations, haze by search, given sun and sky) are replaced
by one loss over one set of unknowns: albedo texture, gains, scales of sun and sky, haze, and any Mitsuba parameters
named in `InverseOptions.extra`. The optimiser is Adam with bounds; pixels have the weights of the closed form; texture corrections
proceed from coarse to fine; held-out photographs control the step size and early stopping.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.albedo.closed_form import HIGHEST, LOWEST, AlbedoFit, pixel_weights
from seasonscapes.albedo.differentiable_views import DifferentiableViews, differentiable_views, mi_picture
from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.photographs import AlbedoPhotograph
from seasonscapes.array_files import read_arrays
from seasonscapes.errors import InputError, NotEnoughEvidence
from seasonscapes.images import atomic_path
from seasonscapes.terrain.surface import Terrain


@dataclass(frozen=True)
class ExtraUnknown:
    """An additional unknown: a Mitsuba parameter.

    Parameters
    ----------
    start
        Initial value.
    low, high
        Bounds.
    step
        Learning rate of Adam.
    """

    start: np.ndarray
    low: float = -np.inf
    high: float = np.inf
    step: float = 0.01


@dataclass(frozen=True)
class InverseOptions:
    """Options of the optimisation.

    Parameters
    ----------
    unknowns
        Names out of ``albedo``, ``log_gain``, ``sun``, ``sky`` and ``haze``.
    extra
        Further unknowns, by Mitsuba's key (``sky.data``, ``terrain.vertex_positions``, …).
    levels
        Resolution of the albedo correction in each stage: 4 means one value per 4 × 4 texels, 1 the texels themselves.
    iterations
        Iterations in each stage.
    photographs_per_iteration
        Photographs drawn in each iteration.
    spp
        Samples per pixel.
    max_depth
        Longest path, in segments.
    held_out
        Fraction of the photographs used for validation only.
    check_every
        Iterations between validations; the step is halved when the validation loss rises, and the stage ends the third
        time.
    steps
        Learning rate of each unknown: of albedo in units of albedo, of all others relative.
    seed
        Seed of the split, the mini-batches and the rendering.
    """

    unknowns: tuple[str, ...] = ("albedo", "log_gain")
    extra: Mapping[str, ExtraUnknown] = field(default_factory=dict)
    levels: tuple[int, ...] = (4, 1)
    iterations: int = 60
    photographs_per_iteration: int = 2
    spp: int = 8
    max_depth: int = 6
    held_out: float = 0.12
    check_every: int = 15
    steps: Mapping[str, float] = field(
        default_factory=lambda: {"albedo": 0.006, "log_gain": 0.004, "sun": 0.01, "sky": 0.01, "haze": 0.02}
    )
    seed: int = 0


@dataclass
class IterationState:
    """State of an optimisation, passed to callbacks after every iteration; they may set ``stop``.

    Parameters
    ----------
    values
        Best values by name.
    stage, iteration
        Index into `InverseOptions.levels`, and finished iterations of that stage.
    history
        A record for each iteration: ``stage``, ``iteration``, ``loss``, and ``held_out`` loss where it was evaluated.
    stop
        End the optimisation after this iteration.
    """

    values: dict[str, np.ndarray]
    stage: int = 0
    iteration: int = 0
    history: list[dict[str, float]] = field(default_factory=list)
    stop: bool = False


Callback = Callable[[IterationState], None]
# A stage ends when the validation loss has risen this many times.
_MOST_FAILURES = 3


@dataclass(frozen=True)
class InverseFit:
    """Result of the optimisation.

    Parameters
    ----------
    fit
        The closed-form fit with new albedo and gains.
    values
        All unknowns by name.
    history
        See `IterationState.history`.
    """

    fit: AlbedoFit
    values: dict[str, np.ndarray]
    history: list[dict[str, float]]


def refine_albedo(
    terrain: Terrain,
    transport: TexelTransport,
    photographs: Sequence[AlbedoPhotograph],
    start: AlbedoFit,
    *,
    options: InverseOptions | None = None,
    callbacks: Sequence[Callback] = (),
    resume: Path | None = None,
) -> InverseFit:
    """Refine a closed-form albedo by differentiable rendering.

    Parameters
    ----------
    terrain
        The terrain of ``transport``.
    transport
        Daylight coefficients of the texels.
    photographs
        K photographs, at least two.
    start
        Closed-form fit of these photographs; its noise model weights the residuals.
    options
        Unknowns, iterations and steps; defaults if omitted.
    callbacks
        Called with the `IterationState` after each iteration.
    resume
        Checkpoint file (``.npz``), written at every validation and read if it exists. It holds the state of the
        optimiser and of the random numbers, so that an interrupted refinement continues as an uninterrupted one would.

    Returns
    -------
    InverseFit
        Refined albedo and gains, all unknowns, and the loss history.

    Raises
    ------
    InputError
        If the device has no gradients.
    NotEnoughEvidence
        If there are fewer than two photographs.
    ValueError
        If an unknown is not supported, or a camera is a panorama or has pixels that are not square.

    Notes
    -----
    Results of equal seeds agree up to rounding only, because the renderer sums gradients over threads in no fixed
    order; Adam normalises gradients, so that single texels of tiny gradient may differ by a fraction of a step.
    """
    options = options or InverseOptions()
    if len(photographs) < 2:
        raise NotEnoughEvidence("refine_albedo: at least two photographs are needed, one of them for validation")
    unsupported = set(options.unknowns) - {"albedo", "log_gain", "sun", "sky", "haze"}
    if unsupported:
        raise ValueError(
            f"refine_albedo: unsupported unknowns {', '.join(sorted(unsupported))}; "
            "pass Mitsuba parameters in options.extra"
        )
    views = differentiable_views(terrain, start.albedo, photographs, max_depth=options.max_depth)
    problem = _Problem(views, _targets(transport, photographs, start), options, *_split(len(photographs), options))
    state, stage = IterationState(_start_values(start, options)), None
    if resume is not None and resume.is_file():
        state, stage = _load(problem, resume)
    for number in range(state.stage, len(options.levels)):
        if number > state.stage:
            state.stage, state.iteration, stage = number, 0, None
        _run_stage(problem, state, stage or _start_stage(problem, state), callbacks, resume)
        if state.stop:
            break
    values = state.values
    gains = np.exp(values["log_gain"]) if "log_gain" in values else start.gains
    albedo = values.get("albedo", start.albedo).astype(np.float32)
    return InverseFit(replace(start, albedo=albedo, gains=gains, history=[*start.history]), values, state.history)


@dataclass(frozen=True)
class _Problem:
    """Scenes, targets ``(picture, weight root)``, unknowns, and indices of training and validation photographs."""

    views: DifferentiableViews
    targets: list[tuple[Any, Any]]
    options: InverseOptions
    training: np.ndarray
    validation: np.ndarray


def _split(count: int, options: InverseOptions) -> tuple[np.ndarray, np.ndarray]:
    """Indices of training and validation photographs, at least one of each."""
    order = np.random.default_rng(options.seed).permutation(count)
    held_out = int(np.clip(round(options.held_out * count), 1, count - 1))
    return np.sort(order[held_out:]), np.sort(order[:held_out])


def _targets(
    transport: TexelTransport, photographs: Sequence[AlbedoPhotograph], start: AlbedoFit
) -> list[tuple[Any, Any]]:
    """Each photograph ``(H, W, 3)`` and the root of its pixels' weights [1 / pixel value], as tensors."""
    import mitsuba as mi

    targets = []
    for photograph, weight, gain in zip(
        photographs, pixel_weights(transport, photographs, start), start.gains, strict=True
    ):
        camera = photograph.footprints.camera
        image = np.zeros((camera.height_px * camera.width_px, 3), np.float32)
        image[photograph.footprints.pixel] = np.sqrt(weight) / np.asarray(gain, np.float32)
        image *= 1.0 / np.sqrt(max(float((weight > 0.0).mean(axis=1).sum()), 1.0))
        shape = (camera.height_px, camera.width_px, 3)
        targets.append(
            (
                mi.TensorXf(np.nan_to_num(photograph.observation.image.astype(np.float32))),
                mi.TensorXf(image.reshape(shape)),
            )
        )
    return targets


def _start_values(start: AlbedoFit, options: InverseOptions) -> dict[str, np.ndarray]:
    # Gains are always present, because pictures have their own unit; they change only if they are unknowns.
    values = {"albedo": start.albedo.astype(np.float32), "log_gain": np.log(start.gains).astype(np.float32)}
    values |= {name: np.ones(1, np.float32) for name in ("sun", "sky", "haze") if name in options.unknowns}
    return values | {name: np.asarray(unknown.start, np.float32) for name, unknown in options.extra.items()}


@dataclass
class _StageState:
    """State of the optimisation at one resolution, besides `IterationState`.

    Parameters
    ----------
    base
        ``(R, S, 3)`` albedo at the start of the stage, which a correction multiplies.
    optimizer
        Mitsuba's Adam with the current values and their moments.
    rng
        Generator of mini-batches and render seeds.
    best
        Lowest validation loss.
    mean
        Running mean of the iterates by name; ``None`` before the first iteration.
    step_scale, failures
        Factor of the learning rates, and number of validations at which the loss rose.
    """

    base: np.ndarray
    optimizer: Any
    rng: np.random.Generator
    best: float
    mean: dict[str, np.ndarray] | None = None
    step_scale: float = 1.0
    failures: int = 0


def _start_stage(problem: _Problem, state: IterationState) -> _StageState:
    rng = np.random.default_rng((problem.options.seed, state.stage, state.iteration))
    optimizer = _optimizer(problem, state.values, problem.options.levels[state.stage])
    return _StageState(state.values["albedo"], optimizer, rng, _validation_loss(problem, state.values))


def _run_stage(
    problem: _Problem, state: IterationState, stage: _StageState, callbacks: Sequence[Callback], resume: Path | None
) -> None:
    """Optimise at one resolution, from ``state.iteration`` on, and update ``state``."""
    import drjit as dr

    options = problem.options
    optimizer, rng = stage.optimizer, stage.rng
    batch = min(options.photographs_per_iteration, len(problem.training))
    for iteration in range(state.iteration, options.iterations):
        # Here and not after the callbacks only, because a finished stage may be resumed.
        if state.stop or stage.failures >= _MOST_FAILURES:
            break
        chosen = rng.choice(problem.training, batch, replace=False)
        loss = 0.0
        for index in chosen:
            unknowns = _unknowns(optimizer, stage.base, state.values)
            part = _loss(problem, int(index), unknowns, seed=int(rng.integers(2**30)))
            dr.backward(part / float(len(chosen)))
            loss += float(part.array[0]) / len(chosen)
        optimizer.step()
        _clip_to_bounds(problem, optimizer)
        current = _current_values(optimizer, stage.base, state.values)
        # Iterates of a stochastic optimiser scatter about the minimum; their running mean is closer to it.
        mean = stage.mean
        mean = current if mean is None else {name: 0.9 * mean[name] + 0.1 * current[name] for name in current}
        stage.mean, state.iteration = mean, iteration + 1
        record = {"stage": float(state.stage), "iteration": float(iteration), "loss": loss}
        if (iteration + 1) % options.check_every == 0 or iteration + 1 == options.iterations:
            record["held_out"] = _validation_loss(problem, mean)
            _judge(problem, state, stage, record["held_out"])
        state.history.append(record)
        if "held_out" in record and resume is not None:
            _save(state, stage, resume)
        for callback in callbacks:
            callback(state)
    state.iteration = options.iterations if stage.failures >= _MOST_FAILURES else state.iteration


def _judge(problem: _Problem, state: IterationState, stage: _StageState, validation: float) -> None:
    """Keep the mean of the iterates if it lowers the validation loss; halve the learning rates otherwise."""
    assert stage.mean is not None
    if validation < stage.best:
        stage.best, state.values = validation, stage.mean
    else:
        stage.failures, stage.step_scale = stage.failures + 1, 0.5 * stage.step_scale
        _set_learning_rates(problem, state, stage)


def _set_learning_rates(problem: _Problem, state: IterationState, stage: _StageState) -> None:
    rates = _learning_rates(problem, problem.options.levels[state.stage])
    stage.optimizer.set_learning_rate({name: stage.step_scale * rate for name, rate in rates.items()})


def _learning_rates(problem: _Problem, level: int) -> dict[str, float]:
    """Learning rate of each unknown, by its name in the optimiser."""
    names = {"albedo": "albedo" if level == 1 else "correction"}
    rates = {names.get(name, name): problem.options.steps[name] for name in problem.options.unknowns}
    return rates | {name: unknown.step for name, unknown in problem.options.extra.items()}


def _optimizer(problem: _Problem, values: dict[str, np.ndarray], level: int) -> Any:
    import mitsuba as mi

    rates = _learning_rates(problem, level)
    optimizer = mi.ad.Adam(lr=0.01, beta_2=0.99, mask_updates=True)
    for name in rates:
        if name == "correction":
            height, width = (max(2, -(-side // level)) for side in values["albedo"].shape[:2])
            optimizer[name] = mi.TensorXf(np.ones((height, width, 3), np.float32))
        elif name in ("albedo", "log_gain"):
            optimizer[name] = mi.TensorXf(values[name])
        else:
            optimizer[name] = mi.Float(values[name].ravel())
    optimizer.set_learning_rate(rates)
    return optimizer


def _unknowns(optimizer: Any, base: np.ndarray, values: dict[str, np.ndarray]) -> dict[str, Any]:
    """All unknowns as input of `mi_picture`; those of the optimiser carry gradients."""
    import drjit as dr
    import mitsuba as mi

    unknowns: dict[str, Any] = {"log_gain": mi.TensorXf(values["log_gain"])}
    unknowns |= {name: optimizer[name] for name in optimizer.keys()}  # noqa: SIM118 (not a dict)
    if "correction" in unknowns:
        correction = unknowns.pop("correction")
        texture = mi.Texture2f(correction, wrap_mode=dr.WrapMode.Clamp)  # pyright: ignore[reportCallIssue]
        height, width = base.shape[:2]
        column, row = dr.meshgrid(dr.arange(mi.Float, width), dr.arange(mi.Float, height))
        factor = mi.Color3f(texture.eval(mi.Point2f((column + 0.5) / width, (row + 0.5) / height)))
        mi_factor: Any = dr.ravel(factor)
        unknowns["albedo"] = mi.TensorXf(base) * mi.TensorXf(mi_factor, shape=base.shape)
    return unknowns


def _loss(problem: _Problem, index: int, unknowns: dict[str, Any], *, seed: int) -> Any:
    """Weighted mean squared difference between a photograph and its rendering."""
    import drjit as dr

    target, root = problem.targets[index]
    image = mi_picture(problem.views, index, unknowns, spp=problem.options.spp, seed=seed)
    return dr.sum(dr.square((image - target) * root), axis=None)


def _validation_loss(problem: _Problem, values: dict[str, np.ndarray]) -> float:
    """Loss of the validation photographs, with the same random numbers each time.

    The product of the errors of two independent renderings: the squared error of one rendering would include its noise,
    which grows with albedo, and would bias the choice towards dark albedos.
    """
    import drjit as dr
    import mitsuba as mi

    unknowns = {name: mi.TensorXf(v) if v.ndim > 1 else mi.Float(v.ravel()) for name, v in values.items()}
    losses = []
    with dr.suspend_grad():
        for index in map(int, problem.validation):
            target, root = problem.targets[index]
            first, second = (
                (
                    mi_picture(
                        problem.views, index, unknowns, spp=2 * problem.options.spp, seed=7_000_000 + 2 * index + k
                    )
                    - target
                )
                * root
                for k in (0, 1)
            )
            losses.append(float(dr.sum(first * second, axis=None).array[0]))
    return float(np.mean(losses))


def _clip_to_bounds(problem: _Problem, optimizer: Any) -> None:
    import drjit as dr

    limits = {
        "albedo": (LOWEST, HIGHEST),
        "correction": (0.2, 5.0),
        "sun": (0.05, 20.0),
        "sky": (0.05, 20.0),
        "haze": (0.0, 20.0),
    } | {name: (unknown.low, unknown.high) for name, unknown in problem.options.extra.items()}
    for name in optimizer.keys():  # noqa: SIM118 (not a dict)
        if name in limits:
            optimizer[name] = dr.clip(dr.detach(optimizer[name]), *limits[name])


def _current_values(optimizer: Any, base: np.ndarray, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The optimiser's values as numpy arrays, and all others unchanged."""
    import drjit as dr

    with dr.suspend_grad():
        unknowns = _unknowns(optimizer, base, values)
        current = {name: np.array(value, np.float32).reshape(values[name].shape) for name, value in unknowns.items()}
    if "albedo" in current:
        current["albedo"] = np.clip(current["albedo"], LOWEST, HIGHEST)
    return values | current


def _save(state: IterationState, stage: _StageState, path: Path) -> None:
    note: dict[str, Any] = {"stage": state.stage, "iteration": state.iteration, "history": state.history}
    note |= {"best": stage.best, "step_scale": stage.step_scale, "failures": stage.failures}
    note["rng"] = stage.rng.bit_generator.state
    arrays: dict[str, Any] = {f"value:{name}": value for name, value in state.values.items()}
    arrays |= {f"mean:{name}": value for name, value in (stage.mean or {}).items()}
    arrays["base"] = stage.base
    for name, (value, _, _, (steps, first, second, _)) in stage.optimizer.state.items():
        arrays |= {f"adam:{name}": np.array(value), f"first moment:{name}": np.array(first)}
        arrays |= {f"second moment:{name}": np.array(second), f"steps:{name}": np.array(steps)}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, note=json.dumps(note), **arrays)


def _load(problem: _Problem, path: Path) -> tuple[IterationState, _StageState | None]:
    """State of a checkpoint, and of its stage unless the file lacks it."""
    arrays = read_arrays(path, what="a checkpoint of the refinement", cure="remove it to start anew")
    if "note" not in arrays:
        raise InputError(path, "not a checkpoint of the refinement", cure="remove it to start anew")
    note = json.loads(str(arrays.pop("note")))
    state = IterationState(_named(arrays, "value:"), note["stage"], note["iteration"], note["history"])
    if "rng" not in note:
        return state, None
    optimizer = _optimizer(problem, state.values, problem.options.levels[state.stage])
    _restore_optimizer(optimizer, arrays)
    rng = np.random.default_rng()
    rng.bit_generator.state = note["rng"]
    mean = _named(arrays, "mean:")
    stage = _StageState(arrays["base"], optimizer, rng, note["best"], mean, note["step_scale"], note["failures"])
    _set_learning_rates(problem, state, stage)
    return state, stage


def _named(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}


def _restore_optimizer(optimizer: Any, arrays: dict[str, np.ndarray]) -> None:
    """Set the values and moments of Adam to those of a checkpoint."""
    import mitsuba as mi

    for name, value in _named(arrays, "adam:").items():
        optimizer[name] = type(optimizer[name])(value)
        moments = mi.Float(arrays[f"first moment:{name}"]), mi.Float(arrays[f"second moment:{name}"])
        steps = mi.UInt32(arrays[f"steps:{name}"])
        optimizer.state[name] = (*optimizer.state[name][:3], (steps, *moments, None))
