"""Teach Gaussians what a path tracer knows, in two stages.

1. On the surface: the radiance of (disc, time) pairs, from irradiance traced at the discs. No rasteriser, no hidden
   discs, no blur; most of the learning happens here.
2. In pictures: a short stage over cameras and times, 0.8 L1 + 0.2 D-SSIM in sRGB, through frozen sparse weights, so
   that colours make up for the width of the splats. The first loss stays beside it, or what no camera sees would drift.

Geometry is known and stays as it is. Every step draws from a generator seeded by (seed, stage, step): a run that was
interrupted goes on from its checkpoint as if nothing had happened.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from seasonscapes.gaussians.appearance import Appearance, LightTensors, light_tensors
from seasonscapes.gaussians.disc_transport import LightState
from seasonscapes.gaussians.losses import (
    SparseProduct,
    TrainingFrame,
    encoded,
    picture_loss,
    surface_loss,
    training_picture,
)
from seasonscapes.gaussians.rasterise import choose_threads
from seasonscapes.images import atomic_path

Progress = Callable[[float], None]
# Learning rates of the parameters; all fall to a tenth over each stage, and begin the second at `_SECOND` of these.
RATES = {
    "log_colour": 2e-3,
    "log_gain": 5e-3,
    "shift": 1e-3,
    "log_softness": 1e-2,
    "embedding": 5e-3,
    "codes": 5e-3,
    "mlp": 2e-3,
}
_SECOND, _FALL = 0.5, 0.1
_SURFACE_SHARE = 0.5


@dataclass(frozen=True)
class Schedule:
    """How long to learn.

    Parameters
    ----------
    surface_steps, picture_steps
        Steps of the two stages.
    batch
        (Disc, time) pairs in a step of the first.
    checkpoint_every
        Steps between checkpoints.
    threads
        Of torch, chosen and not inherited; see `rasterise.choose_threads`.
    """

    surface_steps: int = 2500
    picture_steps: int = 240
    batch: int = 6144
    checkpoint_every: int = 250
    threads: int = 1

    def __post_init__(self):
        if min(self.surface_steps, self.picture_steps) < 0 or min(self.batch, self.checkpoint_every, self.threads) < 1:
            raise ValueError("Schedule: steps must not be negative, batch, checkpoint_every and threads at least 1")


@dataclass(frozen=True)
class SurfaceTargets:
    """What is learned on the surface: T times of N discs.

    Parameters
    ----------
    states
        T light states.
    seasons
        T numbers of dated albedos.
    colours
        ``(T, N, 3)`` float32: radiance × π over the luminance of the horizontal illuminance.
    """

    states: Sequence[LightState]
    seasons: Sequence[int]
    colours: np.ndarray

    def __post_init__(self):
        if not len(self.states) == len(self.seasons) == len(self.colours) > 0:
            raise ValueError(
                f"Lessons: got {len(self.states)} lights, {len(self.seasons)} seasons and "
                f"{len(self.colours)} sets of colours, expected one of each for every time"
            )
        if not np.isfinite(self.colours).all():
            raise ValueError(f"Lessons: {int(np.sum(~np.isfinite(self.colours)))} colours are not finite")


def surface_targets(
    states: Sequence[LightState], seasons: Sequence[int], albedo: np.ndarray, irradiance: np.ndarray
) -> SurfaceTargets:
    """Lessons from irradiance ``(T, N, 3)`` [lx] of discs with dated albedos ``(M, N, 3)``."""
    colours = np.stack(
        [
            albedo[season] * received / np.float32(state.global_lx)
            for state, season, received in zip(states, seasons, irradiance, strict=True)
        ]
    )
    return SurfaceTargets(list(states), list(seasons), colours.astype(np.float32))


def train(
    appearance: Appearance,
    targets: SurfaceTargets,
    frames: Sequence[TrainingFrame] = (),
    schedule: Schedule | None = None,
    *,
    seed: int = 0,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> list[float]:
    """Train an appearance in place; the loss of every step that was taken by this call.

    Parameters
    ----------
    frames
        Pictures for the second stage; without any it is left out.
    checkpoint
        A ``.safetensors`` file to save to, and to go on from where it exists.

    Raises
    ------
    ValueError
        A checkpoint of another run: kind, seed, sizes or schedule differ.
    FloatingPointError
        The loss is no longer finite.
    """
    schedule = schedule or Schedule()
    choose_threads(schedule.threads)
    if not frames:
        schedule = replace(schedule, picture_steps=0)
    optimiser = _optimiser(appearance)
    run = {
        "kind": appearance.kind,
        "seed": seed,
        "schedule": asdict(replace(schedule, threads=1)),
        "times": len(targets.states),
    }
    start = load_checkpoint(checkpoint, appearance, optimiser, run) if checkpoint and Path(checkpoint).is_file() else 0
    lights = light_tensors(targets.states, targets.seasons)
    targets = torch.as_tensor(targets.colours)
    pictures = [training_picture(frame) for frame in frames]
    total, losses = schedule.surface_steps + schedule.picture_steps, []
    for step in range(start, total):
        _set_rates(optimiser, step, schedule)
        rng = np.random.default_rng([seed, step])
        loss = surface_loss(appearance, lights, targets, schedule.batch, rng)
        if step >= schedule.surface_steps:
            picture = pictures[_turn(step - schedule.surface_steps, len(pictures), seed)]
            loss = _SURFACE_SHARE * loss + picture_loss(appearance, lights, picture)
        if not bool(torch.isfinite(loss)):
            raise FloatingPointError(f"distilling: the loss of step {step} is {float(loss)}")
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
        if checkpoint and ((step + 1) % schedule.checkpoint_every == 0 or step + 1 == total):
            save_checkpoint(checkpoint, appearance, optimiser, run, step + 1)
        if progress is not None:
            progress((step + 1) / total)
    return losses


def _turn(step: int, count: int, seed: int) -> int:
    """Which picture a step of the second stage takes: all of them, shuffled anew each round."""
    return int(np.random.default_rng([seed, 7, step // count]).permutation(count)[step % count])


def _optimiser(appearance: Appearance) -> torch.optim.Adam:
    groups: dict[str, list] = {}
    for name, parameter in appearance.named_parameters():
        groups.setdefault(name.split(".")[0], []).append(parameter)
    return torch.optim.Adam(
        [{"params": group, "lr": RATES[name], "name": name} for name, group in groups.items()], eps=1e-15, fused=True
    )


def _set_rates(optimiser: torch.optim.Adam, step: int, schedule: Schedule) -> None:
    second = step >= schedule.surface_steps
    share = (step - schedule.surface_steps) / schedule.picture_steps if second else step / schedule.surface_steps
    for group in optimiser.param_groups:
        group["lr"] = RATES[group["name"]] * (_SECOND if second else 1.0) * _FALL**share


def fit_code(
    appearance: Appearance,
    lights: LightTensors,
    frame: TrainingFrame,
    *,
    steps: int = 128,
    rate: float = 0.1,
    seed: int = 0,
) -> torch.Tensor:
    """The free code ``(32,)`` of a picture that was not trained on, from its usable pixels (WildGaussians' protocol)."""
    picture = training_picture(frame)
    # From the middle of the codes that were learned, where the network is at home.
    code = appearance.codes.detach().mean(dim=0).requires_grad_()
    optimiser = torch.optim.Adam([code], lr=rate)
    rows = np.flatnonzero(picture.mask.numpy().ravel())
    for step in range(steps):
        # A few thousand pixels tell as much of 32 numbers as all do.
        chosen = np.random.default_rng([seed, step]).choice(rows, min(1024, len(rows)), replace=False)
        some = picture.forward[chosen]
        seen = np.unique(some.indices)
        some = some[:, seen]
        values = appearance(picture.discs[torch.from_numpy(seen).long()], picture.time, lights, code)
        drawn = SparseProduct.apply(values, some, some.T.tocsr())
        loss = (encoded(drawn) - picture.target.reshape(-1, 3)[chosen]).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return code.detach()


def save_checkpoint(path: Path, appearance: Appearance, optimiser: torch.optim.Adam, run: dict, step: int) -> None:
    """Parameters, the optimiser's memory and what run this is, in one file, atomically."""
    from safetensors.torch import save_file

    tensors = {f"value.{name}": parameter.detach() for name, parameter in appearance.named_parameters()}
    names = {id(parameter): name for name, parameter in appearance.named_parameters()}
    for parameter, memory in optimiser.state.items():
        tensors |= {
            f"{key}.{names[id(parameter)]}": value.reshape(-1) if key == "step" else value
            for key, value in memory.items()
        }
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata={"run": json.dumps(run, sort_keys=True), "step": str(step)})


def load_checkpoint(path: Path, appearance: Appearance, optimiser: torch.optim.Adam, run: dict) -> int:
    """Put a checkpoint back and return how many steps it has behind it."""
    from safetensors import safe_open

    with safe_open(path, "pt") as file:
        stored = file.metadata()
        if json.loads(stored["run"]) != json.loads(json.dumps(run)):
            raise ValueError(f"{path}: a checkpoint of another run ({stored['run']}); remove it or name another file")
        for name, parameter in appearance.named_parameters():
            value = file.get_tensor(f"value.{name}")
            if value.shape != parameter.shape:
                raise ValueError(f"{path}: {name} has shape {tuple(value.shape)}, expected {tuple(parameter.shape)}")
            parameter.data.copy_(value)
            optimiser.state[parameter] = {
                "step": file.get_tensor(f"step.{name}").reshape(()),
                "exp_avg": file.get_tensor(f"exp_avg.{name}"),
                "exp_avg_sq": file.get_tensor(f"exp_avg_sq.{name}"),
            }
        return int(stored["step"])
