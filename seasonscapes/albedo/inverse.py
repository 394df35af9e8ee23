"""Albedo by differentiable rendering, from the closed form on: every bounce, and any unknown that Mitsuba can differentiate.

What the closed form linearises (interreflection by rounds, haze by search, sun and sky as given) is here one loss over one
set of unknowns: albedo texture, gains, scale of sun and of sky, haze, and whatever of Mitsuba's own parameters is named in
``extra``. Adam with bounds; pixels are weighed as the closed form weighs them; texture corrections start coarse and end
fine; photographs held out decide the step and when to stop.
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
from seasonscapes.albedo.photographs import LINEAR, AlbedoPhotograph, NoiseModel
from seasonscapes.images import atomic_path
from seasonscapes.terrain.surface import Terrain


@dataclass(frozen=True)
class ExtraUnknown:
    """An experiment's own unknown: a parameter of Mitsuba's by its key, its start, bounds and step."""

    start: np.ndarray
    low: float = -np.inf
    high: float = np.inf
    step: float = 0.01


@dataclass(frozen=True)
class InverseOptions:
    """How to optimise.

    Parameters
    ----------
    unknowns
        Of ``albedo``, ``log_gain``, ``sun``, ``sky``, ``haze``.
    levels
        Coarseness of the albedo's correction, stage by stage: 4 means one value for 4 × 4 texels, 1 the texels themselves.
    iterations
        In each stage.
    pictures
        Photographs in an iteration.
    spp
        Samples a pixel.
    held_out
        Share of the photographs that only judge.
    check_every
        Iterations between judgements; the step is halved when they get worse, and the stage ends at the third time.
    steps
        Adam's step of each unknown: of albedo in units of albedo, of all others relative.
    """

    unknowns: tuple[str, ...] = ("albedo", "log_gain")
    levels: tuple[int, ...] = (4, 1)
    iterations: int = 60
    pictures: int = 2
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
    """Where an optimisation stands; callbacks get it after every iteration and may set ``stop``.

    Parameters
    ----------
    values
        Best values by name.
    stage, iteration
        Of `InverseOptions.levels`, and within it.
    history
        A record for each iteration: loss, and held-out loss where it was judged.
    """

    values: dict[str, np.ndarray]
    stage: int = 0
    iteration: int = 0
    history: list[dict[str, float]] = field(default_factory=list)
    stop: bool = False


Callback = Callable[[IterationState], None]


@dataclass(frozen=True)
class InverseFit:
    """What was found: the closed form's record with new albedo and gains, all values by name, and the loss history."""

    fit: AlbedoFit
    values: dict[str, np.ndarray]
    history: list[dict[str, float]]


def refine_albedo(
    terrain: Terrain,
    land: TexelTransport,
    photographs: Sequence[AlbedoPhotograph],
    start: AlbedoFit,
    *,
    noise_model: NoiseModel = LINEAR,
    options: InverseOptions | None = None,
    extra: Mapping[str, ExtraUnknown] | None = None,
    callbacks: Sequence[Callback] = (),
    resume: Path | None = None,
) -> InverseFit:
    """Refine a closed-form albedo by differentiable rendering.

    Parameters
    ----------
    terrain
        The surface of ``land``.
    extra
        More unknowns, by Mitsuba's key (``sky.data``, ``terrain.vertex_positions``, …).
    callbacks
        Called with the `IterationState` after each iteration.
    resume
        A file to save the state in at every judgement, and to go on from where it exists.

    Raises
    ------
    InputError
        Where the device has no gradients.
    ValueError
        Fewer than two photographs, or an unknown without meaning.
    """
    options, extra = options or InverseOptions(), dict(extra or {})
    if len(photographs) < 2:
        raise ValueError("refine_albedo: two photographs at least, one of them to judge by")
    strange = set(options.unknowns) - {"albedo", "log_gain", "sun", "sky", "haze"}
    if strange:
        raise ValueError(f"refine_albedo: unknown {', '.join(sorted(strange))}; Mitsuba's own go into extra")
    views = differentiable_views(terrain, start.albedo, photographs, max_depth=options.max_depth)
    task = _Task(
        views, _targets(land, photographs, start, noise_model), options, extra, *_split(len(photographs), options)
    )
    state = (
        _loaded(resume)
        if resume is not None and resume.is_file()
        else IterationState(_start_values(start, options, extra))
    )
    for stage in range(state.stage, len(options.levels)):
        first = state.iteration if stage == state.stage else 0
        state.stage = stage
        _run_stage(task, state, first, callbacks, resume)
        if state.stop:
            break
    values = state.values
    gains = np.exp(values["log_gain"]) if "log_gain" in values else start.gains
    albedo = values.get("albedo", start.albedo).astype(np.float32)
    return InverseFit(replace(start, albedo=albedo, gains=gains, history=[*start.history]), values, state.history)


@dataclass(frozen=True)
class _Task:
    views: DifferentiableViews
    targets: list[tuple[Any, Any]]
    options: InverseOptions
    extra: dict[str, ExtraUnknown]
    fitted: np.ndarray
    judges: np.ndarray


def _split(count: int, options: InverseOptions) -> tuple[np.ndarray, np.ndarray]:
    """Photographs to fit and to judge by, at least one of each."""
    order = np.random.default_rng(options.seed).permutation(count)
    held = int(np.clip(round(options.held_out * count), 1, count - 1))
    return np.sort(order[held:]), np.sort(order[:held])


def _targets(
    land: TexelTransport, photographs: Sequence[AlbedoPhotograph], start: AlbedoFit, noise_model: NoiseModel
) -> list[tuple[Any, Any]]:
    """Each photograph ``(H, W, 3)`` and the root of its pixels' weights [1 / picture value], as tensors."""
    import mitsuba as mi

    found = []
    for photograph, weight, gain in zip(
        photographs, pixel_weights(land, photographs, start, noise_model), start.gains, strict=True
    ):
        camera = photograph.footprints.camera
        image = np.zeros((camera.height_px * camera.width_px, 3), np.float32)
        image[photograph.footprints.pixel] = np.sqrt(weight) / np.asarray(gain, np.float32)
        image *= 1.0 / np.sqrt(max(float((weight > 0.0).mean(axis=1).sum()), 1.0))
        shape = (camera.height_px, camera.width_px, 3)
        found.append(
            (
                mi.TensorXf(np.nan_to_num(photograph.observation.image.astype(np.float32))),
                mi.TensorXf(image.reshape(shape)),
            )
        )
    return found


def _start_values(start: AlbedoFit, options: InverseOptions, extra: dict[str, ExtraUnknown]) -> dict[str, np.ndarray]:
    # Gains always take part, as pictures have their own unit; they move only where they are unknowns.
    values = {"albedo": start.albedo.astype(np.float32), "log_gain": np.log(start.gains).astype(np.float32)}
    values |= {name: np.ones(1, np.float32) for name in ("sun", "sky", "haze") if name in options.unknowns}
    return values | {name: np.asarray(one.start, np.float32) for name, one in extra.items()}


def _run_stage(
    task: _Task, state: IterationState, first: int, callbacks: Sequence[Callback], resume: Path | None
) -> None:
    import drjit as dr

    options = task.options
    level = options.levels[state.stage]
    base = state.values["albedo"]
    optimizer = _optimizer(task, state.values, level)
    scale, worse = 1.0, 0
    best = _judge(task, state.values)
    rng = np.random.default_rng((options.seed, state.stage, first))
    mean: dict[str, np.ndarray] | None = None
    for iteration in range(first, options.iterations):
        chosen = rng.choice(task.fitted, min(options.pictures, len(task.fitted)), replace=False)
        loss = 0.0
        for index in chosen:
            unknowns = _lanes(task, optimizer, base, level, state.values)
            part = _loss(task, int(index), unknowns, seed=int(rng.integers(2**30)))
            dr.backward(part / float(len(chosen)))
            loss += float(part.array[0]) / len(chosen)
        optimizer.step()
        _bound(task, optimizer)
        now = _values(task, optimizer, base, level, state.values)
        # The path of a stochastic optimiser jitters about the answer: its running mean is nearer to it.
        mean = now if mean is None else {name: 0.9 * mean[name] + 0.1 * now[name] for name in now}
        state.iteration = iteration + 1
        record = {"stage": float(state.stage), "iteration": float(iteration), "loss": loss}
        if (iteration + 1) % options.check_every == 0 or iteration + 1 == options.iterations:
            judged = _judge(task, mean)
            record["held_out"] = judged
            if judged < best:
                best, state.values = judged, mean
            else:
                worse, scale = worse + 1, 0.5 * scale
                optimizer.set_learning_rate({name: scale * step for name, step in _steps(task, level).items()})
        state.history.append(record)
        if "held_out" in record and resume is not None:
            _save(state, resume)
        for callback in callbacks:
            callback(state)
        if state.stop or worse >= 3:
            break
    state.iteration = options.iterations if worse >= 3 else state.iteration


def _steps(task: _Task, level: int) -> dict[str, float]:
    """Adam's step of each unknown that moves, by its name in the optimiser."""
    names = {"albedo": "albedo" if level == 1 else "correction"}
    steps = {names.get(name, name): task.options.steps[name] for name in task.options.unknowns}
    return steps | {name: one.step for name, one in task.extra.items()}


def _optimizer(task: _Task, values: dict[str, np.ndarray], level: int) -> Any:
    import mitsuba as mi

    steps = _steps(task, level)
    optimizer = mi.ad.Adam(lr=0.01, beta_2=0.99, mask_updates=True)
    for name in steps:
        if name == "correction":
            height, width = (max(2, -(-side // level)) for side in values["albedo"].shape[:2])
            optimizer[name] = mi.TensorXf(np.ones((height, width, 3), np.float32))
        elif name in ("albedo", "log_gain"):
            optimizer[name] = mi.TensorXf(values[name])
        else:
            optimizer[name] = mi.Float(values[name].ravel())
    optimizer.set_learning_rate(steps)
    return optimizer


def _lanes(task: _Task, optimizer: Any, base: np.ndarray, level: int, values: dict[str, np.ndarray]) -> dict[str, Any]:
    """All unknowns as `mi_picture` wants them; those of the optimiser carry gradients."""
    import drjit as dr
    import mitsuba as mi

    unknowns = {"log_gain": mi.TensorXf(values["log_gain"])} | {name: optimizer[name] for name in optimizer.keys()}  # noqa: SIM118
    if "correction" in unknowns:
        texture = mi.Texture2f(unknowns.pop("correction"), wrap_mode=dr.WrapMode.Clamp)
        height, width = base.shape[:2]
        column, row = dr.meshgrid(dr.arange(mi.Float, width), dr.arange(mi.Float, height))
        factor = mi.Color3f(texture.eval(mi.Point2f((column + 0.5) / width, (row + 0.5) / height)))
        unknowns["albedo"] = mi.TensorXf(base) * mi.TensorXf(dr.ravel(factor), shape=base.shape)
    return unknowns


def _loss(task: _Task, index: int, unknowns: dict[str, Any], *, seed: int) -> Any:
    """Weighted mean square of what a photograph and its picture differ by."""
    import drjit as dr

    target, root = task.targets[index]
    image = mi_picture(task.views, index, unknowns, spp=task.options.spp, seed=seed)
    return dr.sum(dr.square((image - target) * root), axis=None)


def _judge(task: _Task, values: dict[str, np.ndarray]) -> float:
    """Loss of the photographs held out, with equal random numbers each time.

    The product of two independent pictures' errors: the square of one would count its noise, which grows with albedo,
    and a darker answer would always seem the better one.
    """
    import drjit as dr
    import mitsuba as mi

    unknowns = {name: mi.TensorXf(v) if v.ndim > 1 else mi.Float(v.ravel()) for name, v in values.items()}
    losses = []
    with dr.suspend_grad():
        for index in map(int, task.judges):
            target, root = task.targets[index]
            first, second = (
                (
                    mi_picture(task.views, index, unknowns, spp=2 * task.options.spp, seed=7_000_000 + 2 * index + k)
                    - target
                )
                * root
                for k in (0, 1)
            )
            losses.append(float(dr.sum(first * second, axis=None).array[0]))
    return float(np.mean(losses))


def _bound(task: _Task, optimizer: Any) -> None:
    """Keep every unknown within what it can be."""
    import drjit as dr

    limits = {
        "albedo": (LOWEST, HIGHEST),
        "correction": (0.2, 5.0),
        "sun": (0.05, 20.0),
        "sky": (0.05, 20.0),
        "haze": (0.0, 20.0),
    } | {name: (one.low, one.high) for name, one in task.extra.items()}
    for name in optimizer.keys():  # noqa: SIM118 (not a dict)
        if name in limits:
            optimizer[name] = dr.clip(dr.detach(optimizer[name]), *limits[name])


def _values(
    task: _Task, optimizer: Any, base: np.ndarray, level: int, values: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    import drjit as dr

    with dr.suspend_grad():
        lanes = _lanes(task, optimizer, base, level, values)
        found = {name: np.array(value, np.float32).reshape(values[name].shape) for name, value in lanes.items()}
    if "albedo" in found:
        found["albedo"] = np.clip(found["albedo"], LOWEST, HIGHEST)
    return values | found


def _save(state: IterationState, path: Path) -> None:
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        note = json.dumps({"stage": state.stage, "iteration": state.iteration, "history": state.history})
        np.savez(file, note=note, **{f"value:{name}": value for name, value in state.values.items()})


def _loaded(path: Path) -> IterationState:
    with np.load(path, allow_pickle=False) as held:
        note = json.loads(str(held["note"]))
        values = {name.removeprefix("value:"): held[name] for name in held.files if name.startswith("value:")}
    return IterationState(values, note["stage"], note["iteration"], note["history"])
