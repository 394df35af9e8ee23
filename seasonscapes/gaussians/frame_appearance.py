"""Gaussians whose appearance is learned from pictures alone, as in the SeasonScapes paper and WildGaussians.

    c̃ = γ ⊙ ĉ(r) + β,   (γ, β) = MLP([Gaussian embedding, time embedding, ĉ(r), r])

ĉ(r) is a colour of spherical harmonics of degree 2 in the viewing direction r; the time embedding is a free vector for each
timestamp of the training pictures (Kulhanek et al. 2024, arXiv:2407.08447). The Gaussians lie on the terrain, whose shape is
known, and do not move. Nothing here knows of sun or sky: between timestamps embeddings are interpolated.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.errors import InputError, NoTerrainInView
from seasonscapes.gaussians.appearance import correction_network, fourier_embedding
from seasonscapes.gaussians.losses import SparseProduct, TrainingFrame, image_loss, sampled_loss, training_picture
from seasonscapes.gaussians.model import content_digest
from seasonscapes.gaussians.rasterise import splat_colours, view_weights
from seasonscapes.gaussians.splat_view import FULL_COVERAGE
from seasonscapes.gaussians.surfels import Surfels
from seasonscapes.gaussians.training_views import front_facing_splats
from seasonscapes.images import atomic_path

# Of `fit_frame_code`: cost of a squared distance from the start, beside a mean difference in sRGB; chosen by measurement.
_STAY = 0.1
# An instant, or a time embedding ``(32,)``.
Look = datetime | torch.Tensor

_HARMONICS, _CODE, _HIDDEN = 9, 32, 128
_RATES = {"colour": 1e-2, "embedding": 5e-3, "codes": 5e-3, "mlp": 2e-3}
_DECAY, _FORMAT = 0.1, "seasonscapes frame Gaussians 1"


class FrameAppearance(nn.Module):
    """Colours of N Gaussians at T timestamps, seen from a direction.

    Parameters
    ----------
    embedding
        ``(N, D)`` from `fourier_embedding`.
    times
        Number T of timestamps.
    mean
        Colour to start from.
    directional
        Whether colours depend on the viewing direction, as in the paper; without, ĉ is one colour and r no input.
    seed
        Of the network's initial weights.
    """

    def __init__(
        self,
        embedding: np.ndarray,
        times: int,
        *,
        mean: Sequence[float] = (0.2, 0.2, 0.2),
        directional: bool = True,
        seed: int = 0,
    ) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        count, size = embedding.shape
        self.directional = directional
        colour = torch.zeros(count, _HARMONICS if directional else 1, 3)
        colour[:, 0] = torch.as_tensor(mean)
        self.colour = nn.Parameter(colour)
        self.embedding = nn.Parameter(torch.tensor(embedding, dtype=torch.float32))
        self.codes = nn.Parameter(0.01 * torch.randn(times, _CODE, generator=generator))
        self.mlp = correction_network(size + _CODE + (6 if directional else 3), _HIDDEN, generator)

    def forward(self, index: torch.Tensor, direction: torch.Tensor, code: torch.Tensor) -> torch.Tensor:
        """Colours ``(n, 3)``, display-linear and not negative.

        Parameters
        ----------
        index
            ``(n,)`` Gaussians.
        direction
            ``(n, 3)`` unit vectors from the camera to them, ENU.
        code
            ``(32,)`` time embedding.
        """
        parts = [self.embedding[index], code.expand(len(index), -1)]
        if self.directional:
            base = torch.einsum("nk,nkc->nc", harmonics(direction), self.colour[index])
            parts += [base, direction]
        else:
            base = self.colour[index, 0]
            parts.append(base)
        gamma, beta = self.mlp(torch.cat(parts, dim=1)).split(3, dim=1)
        return ((1.0 + gamma) * base + beta).clamp(min=0.0)


def harmonics(direction: torch.Tensor) -> torch.Tensor:
    """Real spherical harmonics to degree 2 ``(n, 9)`` of unit vectors ``(n, 3)``, each scaled to unit coefficient."""
    x, y, z = direction.unbind(1)
    return torch.stack([torch.ones_like(x), y, z, x, x * y, y * z, 3.0 * z * z - 1.0, x * z, x * x - y * y], dim=1)


@dataclass(frozen=True)
class TimedFrame:
    """A training picture.

    Parameters
    ----------
    camera
        Its view, in the frame of the Gaussians.
    time
        Index of its timestamp.
    image
        ``(H, W, 3)`` display-linear in [0, 1].
    mask
        ``(H, W)`` bool, True where it shows terrain.
    """

    camera: Camera
    time: int
    image: np.ndarray
    mask: np.ndarray


@dataclass(frozen=True)
class FrameGaussians:
    """A trained model: Gaussians, their appearance, its timestamps and plain values about it."""

    surfels: Surfels
    appearance: FrameAppearance
    times: tuple[datetime, ...]
    note: dict[str, Any]


def train_on_frames(
    surfels: Surfels,
    frames: Sequence[TimedFrame],
    times: Sequence[datetime],
    *,
    steps: int = 2000,
    directional: bool = True,
    seed: int = 0,
    note: dict[str, Any] | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[FrameGaussians, list[float]]:
    """Train Gaussians on pictures of several timestamps with 0.8 L1 + 0.2 D-SSIM in sRGB.

    Parameters
    ----------
    surfels
        N discs on the terrain.
    frames
        The pictures; those without a Gaussian in view are left out.
    times
        Their timestamps, aware, in rising order.
    steps
        Of Adam, each on one picture.
    directional
        Whether colours depend on the viewing direction.
    seed
        Equal seeds give equal models.
    note
        Plain values to keep with the model.
    progress
        Called with the finished share.

    Returns
    -------
    FrameGaussians, list of float
        The model, and the loss of each step.

    Raises
    ------
    NoTerrainInView
        Where no picture shows a Gaussian.
    FloatingPointError
        If the loss is not finite.
    """
    pictures, directions = [], []
    for frame in frames:
        weights = view_weights(front_facing_splats(surfels, frame.camera), frame.camera, subpixels=2)
        try:
            pictures.append(training_picture(TrainingFrame(weights, frame.time, frame.image, frame.mask)))
        except NoTerrainInView:
            continue
        directions.append(_directions(surfels, frame.camera)[pictures[-1].discs])
    if not pictures:
        raise NoTerrainInView("distil: no frame shows a Gaussian")
    mean = np.mean([frame.image[frame.mask].mean(axis=0) for frame in frames if frame.mask.any()], axis=0)
    embedding = fourier_embedding(surfels.means, seed=seed)
    appearance = FrameAppearance(embedding, len(times), mean=mean.tolist(), directional=directional, seed=seed)
    groups = [
        {"params": [p for n, p in appearance.named_parameters() if n.split(".")[0] == name], "lr": rate, "rate": rate}
        for name, rate in _RATES.items()
    ]
    optimiser, losses = torch.optim.Adam(groups, eps=1e-15), []
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = group["rate"] * _DECAY ** (step / steps)
        epoch, place = divmod(step, len(pictures))
        number = int(np.random.default_rng([seed, 7, epoch]).permutation(len(pictures))[place])
        picture = pictures[number]
        values = appearance(picture.discs, directions[number], appearance.codes[picture.time])
        loss = image_loss(SparseProduct.apply(values, picture.forward, picture.backward), picture)
        if not bool(torch.isfinite(loss)):
            raise FloatingPointError(f"train_on_frames: the loss of step {step} is {float(loss)}")
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
        if progress is not None:
            progress((step + 1) / steps)
    return FrameGaussians(surfels, appearance, tuple(times), dict(note or {})), losses


def _directions(surfels: Surfels, camera: Camera) -> torch.Tensor:
    """Unit vectors ``(N, 3)`` from a camera to the discs."""
    offset = torch.as_tensor(surfels.means - camera.position_m.astype(np.float32))
    return nn.functional.normalize(offset, dim=1)


@torch.no_grad()
def code_at(model: FrameGaussians, time: datetime) -> torch.Tensor:
    """Time embedding ``(32,)`` of an instant: linear between the timestamps, the nearest one's outside them."""
    seconds = np.array([each.timestamp() for each in model.times])
    position = float(np.interp(time.timestamp(), seconds, np.arange(len(seconds))))
    lower = min(int(position), len(seconds) - 1)
    upper = min(lower + 1, len(seconds) - 1)
    codes = model.appearance.codes
    return codes[lower] + (position - lower) * (codes[upper] - codes[lower])


def fit_frame_code(
    model: FrameGaussians, frame: TimedFrame, *, steps: int = 256, rate: float = 5e-3, seed: int = 0
) -> tuple[torch.Tensor, int]:
    """Fit a time embedding to a picture that the model was not trained on, with all else as it is.

    This is the test-time optimisation of WildGaussians (Kulhanek et al. 2024, arXiv:2407.08447). It starts from the timestamp
    whose embedding explains the picture best, and leaving it costs: without, what is not seen can become worse.

    Parameters
    ----------
    model
        Trained; it is not changed.
    frame
        The picture and its usable pixels, such as one half of them; its time is not used.
    steps
        Of Adam, each on 1024 pixels.
    rate
        Learning rate; it falls linearly to 0.
    seed
        Of the pixels.

    Returns
    -------
    code, nearest
        The embedding ``(32,)``, and the number of the timestamp from whose embedding it started.

    Raises
    ------
    NoTerrainInView
        Where no usable pixel shows a Gaussian.
    """
    weights = view_weights(front_facing_splats(model.surfels, frame.camera), frame.camera, subpixels=2)
    picture = training_picture(TrainingFrame(weights, 0, frame.image, frame.mask))
    if not picture.mask.any():
        raise NoTerrainInView("fit_frame_code: no usable pixel shows a Gaussian")
    directions = _directions(model.surfels, frame.camera)[picture.discs]

    def loss(code: torch.Tensor, step: int) -> torch.Tensor:
        def colours(visible: torch.Tensor) -> torch.Tensor:
            return model.appearance(picture.discs[visible], directions[visible], code)

        return sampled_loss(picture, colours, np.random.default_rng([seed, step]))

    with torch.no_grad():
        nearest = int(np.argmin([float(loss(code, 0)) for code in model.appearance.codes]))
    start = model.appearance.codes[nearest].detach()
    code = start.clone().requires_grad_()
    optimiser = torch.optim.Adam([code], lr=rate)
    for step in range(steps):
        optimiser.param_groups[0]["lr"] = rate * (1.0 - step / steps)
        total = loss(code, step) + _STAY * (code - start).square().sum()
        (code.grad,) = torch.autograd.grad(total, [code])
        optimiser.step()
    return code.detach(), nearest


@torch.no_grad()
def render_frame(model: FrameGaussians, camera: Camera, time: Look) -> tuple[np.ndarray, np.ndarray]:
    """Render a model at an instant.

    Parameters
    ----------
    model
        The model.
    camera
        The view.
    time
        Aware; see `code_at`. Or an embedding ``(32,)``, such as that of `fit_frame_code`.

    Returns
    -------
    picture, coverage
        ``(H, W, 3)`` display-linear over black, and ``(H, W)`` in [0, 1], both without the gaps between neighbours.

    Raises
    ------
    NoTerrainInView
        If no Gaussian is in view.
    """
    weights = view_weights(front_facing_splats(model.surfels, camera), camera, subpixels=2)
    if weights.matrix.nnz == 0:
        raise NoTerrainInView("no Gaussian is in view")
    everyone = torch.arange(len(model.surfels.means))
    code = time if isinstance(time, torch.Tensor) else code_at(model, time)
    colours = model.appearance(everyone, _directions(model.surfels, camera), code).numpy()
    solid = np.clip(weights.coverage / FULL_COVERAGE, 0.0, 1.0)
    scale = solid / np.maximum(weights.coverage, 1e-6)
    return splat_colours(weights, colours) * scale[..., None].astype(np.float32), solid


def save_frame_gaussians(model: FrameGaussians, path: Path) -> None:
    """Write the learned part of a model as ``.safetensors``; the Gaussians are those of the terrain, made again by reading.

    Parameters
    ----------
    model
        The model.
    path
        File to write, atomically.
    """
    from safetensors.numpy import save_file

    tensors = {name: value.detach().numpy() for name, value in model.appearance.state_dict().items()}
    tensors["means"] = model.surfels.means
    directional = model.appearance.directional
    facts = json.dumps(
        {
            "format": _FORMAT,
            "directional": directional,
            "times": [time.isoformat() for time in model.times],
            "note": model.note,
        }
    )
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata={"facts": facts, "sha256": content_digest(tensors, facts)})


def is_frame_model(path: Path) -> bool:
    """Whether a file is a model that `save_frame_gaussians` wrote, rather than a relightable one or none."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "np") as file:
            return _FORMAT in ((file.metadata() or {}).get("facts") or "")
    except (SafetensorError, OSError, ValueError):
        return False


def load_frame_gaussians(path: Path, surfels_of: Callable[[float], Surfels]) -> FrameGaussians:
    """Read what `save_frame_gaussians` wrote.

    Parameters
    ----------
    path
        The file.
    surfels_of
        Makes the discs of the place for a spacing [m].

    Returns
    -------
    FrameGaussians
        The model.

    Raises
    ------
    InputError
        For a damaged file, another format, or a place with other terrain.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "np") as file:
            stored = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(path, f"not a Gaussian model, or damaged: {error}") from None
    facts = stored.get("facts", "")
    if stored.get("sha256") != content_digest(tensors, facts):
        raise InputError(path, "damaged: its content is not what its checksum says")
    header = json.loads(facts)
    if header.get("format") != _FORMAT:
        raise InputError(path, "another format", got=header.get("format"), expected=_FORMAT)
    means = tensors.pop("means")
    surfels = surfels_of(float(header["note"]["spacing_m"]))
    if surfels.means.shape != means.shape or not np.allclose(surfels.means, means, atol=0.01):
        raise InputError(
            path, "was distilled from another terrain", cure="pass the --mesher, --atlas and --refine of then"
        )
    times = tuple(datetime.fromisoformat(text) for text in header["times"])
    appearance = FrameAppearance(tensors["embedding"], len(times), directional=header["directional"])
    appearance.load_state_dict({name: torch.as_tensor(value) for name, value in tensors.items()})
    return FrameGaussians(surfels, appearance, times, header["note"])
