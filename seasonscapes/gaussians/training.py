"""Distillation of a Gaussian model from path-traced targets in two stages.

1. Surface stage: radiance of (disc, time) pairs, from irradiance traced at the discs. No rasterisation, occlusion or
   blur is involved; most of the training happens here.
2. Picture stage: a few steps over cameras and times, 0.8 L1 + 0.2 D-SSIM in sRGB. Where the appearance has a
   `DiscGeometry`, place, size, direction and opacity of the discs are learned together with their colours through the
   differentiable rasteriser; otherwise colours alone, through frozen sparse weights. The surface loss is kept, because
   discs outside all pictures would drift otherwise.

Every step has its own random generator, seeded by (seed, step), so that an
interrupted run continues from its checkpoint with identical results.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from seasonscapes.errors import InputError
from seasonscapes.gaussians.appearance import Appearance, LightTensors, light_tensors
from seasonscapes.gaussians.disc_transport import LightState
from seasonscapes.gaussians.land_shadows import DiscShadows
from seasonscapes.gaussians.losses import (
    TrainingFrame,
    picture_loss,
    refining_loss,
    sampled_loss,
    surface_loss,
    training_picture,
)
from seasonscapes.gaussians.model import content_digest
from seasonscapes.gaussians.rasterise import set_torch_threads
from seasonscapes.images import atomic_path

Progress = Callable[[float], None]
# Initial learning rates. They decay exponentially by `_DECAY` over each stage; the second stage starts at
# `_SECOND_STAGE` times these.
RATES = {
    "log_colour": 1e-2,
    "log_gain": 5e-3,
    "shift": 1e-3,
    "log_softness": 1e-2,
    "embedding": 5e-3,
    "codes": 5e-3,
    "mlp": 2e-3,
    "geometry.offset": 2e-2,
    "geometry.stretch": 4e-2,
    "geometry.twist": 4e-2,
    "geometry.opacity": 2e-1,
}
_SECOND_STAGE, _DECAY = 0.5, 0.1
# Times of one camera in a step that refines the discs: rasterising costs more than more colours do.
_TIMES_PER_STEP = 3
# Weight of the surface loss in the second stage.
_SURFACE_WEIGHT = 0.5


@dataclass(frozen=True)
class Schedule:
    """Numbers of training steps.

    Parameters
    ----------
    surface_steps, picture_steps
        Steps of the two stages.
    batch
        (Disc, time) pairs per step.
    checkpoint_every
        Steps between checkpoints.
    threads
        Number of torch threads; see `rasterise.set_torch_threads`.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    surface_steps: int = 2500
    picture_steps: int = 240
    batch: int = 6144
    checkpoint_every: int = 250
    threads: int = 1

    def __post_init__(self) -> None:
        if min(self.surface_steps, self.picture_steps) < 0 or min(self.batch, self.checkpoint_every, self.threads) < 1:
            raise ValueError("Schedule: steps must not be negative, batch, checkpoint_every and threads at least 1")


@dataclass(frozen=True)
class Checkpoint:
    """File that an interrupted training continues from.

    Parameters
    ----------
    path
        ``.safetensors`` file.
    key
        Identifier of everything that the training data were made from: scene, sky, albedo and code. A checkpoint of
        another key is refused.
    """

    path: Path
    key: str = ""


@dataclass(frozen=True)
class SurfaceTargets:
    """Training targets of the surface stage: colours of N discs at T times.

    Parameters
    ----------
    states
        T light states.
    seasons
        T indices of dated albedos.
    colours
        ``(T, N, 3)`` float32: radiance × π over the luminance of the horizontal illuminance.
    visible
        ``(T, 2, N)`` traced share of the light of sun and moon, from `land_shadows`, if models are to be relit with it. The
        horizons of the discs then learn from it instead of from colours.

    Raises
    ------
    ValueError
        If the lengths differ or are zero, or a colour is not finite.
    """

    states: Sequence[LightState]
    seasons: Sequence[int]
    colours: np.ndarray
    visible: np.ndarray | None = None

    def __post_init__(self) -> None:
        if not len(self.states) == len(self.seasons) == len(self.colours) > 0:
            raise ValueError(
                f"SurfaceTargets: got {len(self.states)} lights, {len(self.seasons)} seasons and "
                f"{len(self.colours)} sets of colours, expected one of each for every time"
            )
        if not np.isfinite(self.colours).all():
            raise ValueError(f"SurfaceTargets: {int(np.sum(~np.isfinite(self.colours)))} colours are not finite")


def surface_targets(
    states: Sequence[LightState],
    seasons: Sequence[int],
    albedo: np.ndarray,
    irradiance: np.ndarray,
    shadows: DiscShadows | None = None,
) -> SurfaceTargets:
    """Compute training targets from traced irradiance and dated albedos.

    Parameters
    ----------
    states
        T light states.
    seasons
        T indices of dated albedos.
    albedo
        ``(M, N, 3)`` of N discs on M dates.
    irradiance
        ``(T, N, 3)`` of the discs [lx], from `disc_transport.surfel_irradiance`.
    shadows
        Shadow rays of the discs: the model is to be relit with traced shadows; by the discs' horizons if omitted.

    Returns
    -------
    SurfaceTargets
        Colours of N discs at T times.
    """
    colours = np.stack(
        [
            albedo[season] * received / np.float32(state.global_lx)
            for state, season, received in zip(states, seasons, irradiance, strict=True)
        ]
    )
    visible = np.stack([shadows.visible_share(state).astype(np.float16) for state in states]) if shadows else None
    return SurfaceTargets(list(states), list(seasons), colours.astype(np.float32), visible)


def train(
    appearance: Appearance,
    targets: SurfaceTargets,
    frames: Sequence[TrainingFrame] = (),
    schedule: Schedule | None = None,
    *,
    seed: int = 0,
    checkpoint: Checkpoint | None = None,
    progress: Progress | None = None,
) -> list[float]:
    """Train an appearance in place.

    Parameters
    ----------
    appearance
        Module to train.
    targets
        Colours of the discs for the surface stage.
    frames
        Pictures for the picture stage, which is skipped if there are none.
    schedule
        Numbers of steps; defaults if omitted.
    seed
        Seed of the random draws.
    checkpoint
        File to save to; training continues from it if it exists.
    progress
        Called with the finished fraction after each step.

    Returns
    -------
    list of float
        Loss of each step taken by this call.

    Raises
    ------
    InputError
        If the checkpoint is damaged or belongs to another run: kind, seed, schedule or key differ.
    FloatingPointError
        If the loss is not finite.
    ValueError
        If the discs are to be refined and a frame names no camera.
    """
    schedule = schedule or Schedule()
    set_torch_threads(schedule.threads)
    if not frames:
        schedule = replace(schedule, picture_steps=0)
    optimiser = _optimiser(appearance)
    run = {
        "kind": appearance.kind,
        "seed": seed,
        "schedule": asdict(replace(schedule, threads=1)),
        "times": len(targets.states),
        "refined": appearance.geometry is not None,
        "traced": targets.visible is not None,
    }
    if checkpoint:
        run["key"] = checkpoint.key
    start = (
        load_checkpoint(checkpoint.path, appearance, optimiser, run) if checkpoint and checkpoint.path.exists() else 0
    )
    lights = light_tensors(targets.states, targets.seasons, targets.visible)
    colours = torch.as_tensor(targets.colours)
    pictures = [training_picture(frame) for frame in frames]
    geometry = appearance.geometry
    if geometry is not None and any(picture.camera is None for picture in pictures):
        raise ValueError("train: a frame names no camera, through which the discs could be refined")
    cameras = _by_camera(frames)
    total, losses = schedule.surface_steps + schedule.picture_steps, []
    for step in range(start, total):
        _set_rates(optimiser, step, schedule)
        rng = np.random.default_rng([seed, step])
        loss = surface_loss(appearance, lights, colours, schedule.batch, rng)
        if step >= schedule.surface_steps:
            number = step - schedule.surface_steps
            if geometry is None:
                told = picture_loss(appearance, lights, pictures[_picture_index(number, len(pictures), seed)])
            else:
                own = cameras[_picture_index(number, len(cameras), seed)]
                drawn = rng.choice(own, min(_TIMES_PER_STEP, len(own)), replace=False)
                told = refining_loss(appearance, lights, [pictures[each] for each in drawn])
            loss = _SURFACE_WEIGHT * loss + told
        if not bool(torch.isfinite(loss)):
            raise FloatingPointError(f"train: the loss of step {step} is {float(loss)}, expected a finite number")
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        if geometry is not None:
            geometry.keep_within_limits()
        losses.append(float(loss.detach()))
        if checkpoint and ((step + 1) % schedule.checkpoint_every == 0 or step + 1 == total):
            save_checkpoint(checkpoint.path, appearance, optimiser, run, step + 1)
        if progress is not None:
            progress((step + 1) / total)
    return losses


def _by_camera(frames: Sequence[TrainingFrame]) -> list[list[int]]:
    """Indices of the frames of each camera; frames of one camera share their weights."""
    groups: dict[int, list[int]] = {}
    for number, frame in enumerate(frames):
        groups.setdefault(id(frame.weights), []).append(number)
    return list(groups.values())


def _picture_index(step: int, count: int, seed: int) -> int:
    """Picture (or camera) of a step of the second stage: all of them in random order, reshuffled every epoch."""
    return int(np.random.default_rng([seed, 7, step // count]).permutation(count)[step % count])


def _optimiser(appearance: Appearance) -> torch.optim.Adam:
    """Adam with one parameter group per entry of `RATES`."""
    groups: dict[str, list[torch.nn.Parameter]] = {}
    for name, parameter in appearance.named_parameters():
        groups.setdefault(name if name in RATES else name.split(".")[0], []).append(parameter)
    return torch.optim.Adam(
        [{"params": group, "lr": RATES[name], "name": name} for name, group in groups.items()], eps=1e-15, fused=True
    )


def _set_rates(optimiser: torch.optim.Adam, step: int, schedule: Schedule) -> None:
    second = step >= schedule.surface_steps
    fraction = (step - schedule.surface_steps) / schedule.picture_steps if second else step / schedule.surface_steps
    for group in optimiser.param_groups:
        group["lr"] = RATES[group["name"]] * (_SECOND_STAGE if second else 1.0) * _DECAY**fraction


def fit_code(
    appearance: Appearance,
    lights: LightTensors,
    frame: TrainingFrame,
    *,
    steps: int = 128,
    rate: float = 0.1,
    seed: int = 0,
) -> torch.Tensor:
    """Fit the free code of a picture outside the training set to its usable pixels (WildGaussians' protocol).

    Parameters
    ----------
    appearance
        Trained module of ``kind="code"``, which is not changed.
    lights
        Light states of the training times.
    frame
        The picture.
    steps
        Number of Adam steps.
    rate
        Learning rate.
    seed
        Seed of the drawn pixels.

    Returns
    -------
    torch.Tensor
        ``(32,)``.
    """
    picture = training_picture(frame)
    # Start from the mean of the learned codes, within the network's training range.
    code = appearance.codes.detach().mean(dim=0).requires_grad_()
    optimiser = torch.optim.Adam([code], lr=rate)

    def colours(visible: torch.Tensor) -> torch.Tensor:
        return appearance(picture.discs[visible], picture.time, lights, code)

    for step in range(steps):
        loss = sampled_loss(picture, colours, np.random.default_rng([seed, step]))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return code.detach()


def save_checkpoint(
    path: Path, appearance: Appearance, optimiser: torch.optim.Adam, run: dict[str, Any], step: int
) -> None:
    """Write parameters and optimiser state to one ``.safetensors`` file, atomically.

    Parameters
    ----------
    path
        Output file.
    appearance
        Module in training.
    optimiser
        Optimiser of the module.
    run
        Plain values that identify the run.
    step
        Number of finished steps.
    """
    from safetensors.torch import save_file

    tensors: dict[str, torch.Tensor] = {
        f"value.{name}": parameter.detach() for name, parameter in appearance.named_parameters()
    }
    names = {id(parameter): name for name, parameter in appearance.named_parameters()}
    for parameter, moments in optimiser.state.items():
        tensors |= {
            f"{key}.{names[id(parameter)]}": value.reshape(-1) if key == "step" else value
            for key, value in moments.items()
        }
    facts = json.dumps({"run": run, "step": step}, sort_keys=True)
    digest = content_digest({name: value.numpy() for name, value in tensors.items()}, facts)
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata={"facts": facts, "sha256": digest})


def load_checkpoint(path: Path, appearance: Appearance, optimiser: torch.optim.Adam, run: dict[str, Any]) -> int:
    """Restore parameters and optimiser state from a checkpoint, in place.

    Parameters
    ----------
    path
        File written by `save_checkpoint`.
    appearance
        Module to restore.
    optimiser
        Optimiser of the module.
    run
        Plain values that identify the run.

    Returns
    -------
    int
        Number of finished steps.

    Raises
    ------
    InputError
        If the file is damaged, or belongs to another run.
    """
    from safetensors import SafetensorError, safe_open

    cure = "remove it to start anew, or name another --output"
    try:
        with safe_open(path, "pt") as file:
            stored = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(path, f"not a checkpoint, or damaged: {error}", cure=cure) from None
    facts = stored.get("facts", "")
    if stored.get("sha256") != content_digest({name: value.numpy() for name, value in tensors.items()}, facts):
        raise InputError(path, "a damaged checkpoint: its content is not what its checksum says", cure=cure)
    known, wanted = json.loads(facts), json.loads(json.dumps(run))
    if known["run"] != wanted:
        differs = sorted(
            name for name in wanted.keys() | known["run"].keys() if known["run"].get(name) != wanted.get(name)
        )
        told = ", ".join("scene, sky or albedo" if name == "key" else name for name in differs)
        raise InputError(path, "a checkpoint of another run", got=f"another {told}", cure=cure)
    for name, parameter in appearance.named_parameters():
        parameter.data.copy_(tensors[f"value.{name}"])
        if f"step.{name}" not in tensors:  # has had no gradient yet
            continue
        optimiser.state[parameter] = {
            "step": tensors[f"step.{name}"].reshape(()),
            "exp_avg": tensors[f"exp_avg.{name}"],
            "exp_avg_sq": tensors[f"exp_avg_sq.{name}"],
        }
    return int(known["step"])
