"""Appearance model: colour of each Gaussian under a light, by physical shading and a learned affine correction.

    c = γ ĉ + β,   (γ − 1, β) = MLP([Gaussian embedding, time embedding, physical features, ĉ])

The affine form is that of WildGaussians (Kulhanek et al. 2024, arXiv:2407.08447), whose ĉ is a free colour and whose
time embedding is a free vector per photograph. Here ĉ is the physically shaded colour under the given sun and sky, the
time embedding is a continuous function of the instant, and the last layer is initialised to zero, so that the untrained
model equals physical shading.

    ĉ = a · (Σ V(ω) (n·ω)⁺ E_ω + s E_sky + b E_bounce)

with V the soft visibility above the horizon, or for sun and moon the traced one (`land_shadows`). Colours are radiance × π over the luminance of the horizontal illuminance,
so that noon and dusk have the same magnitude. `KINDS` lists ablations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from seasonscapes.gaussians.disc_geometry import DiscGeometry
from seasonscapes.gaussians.disc_transport import (
    AZIMUTHS,
    BODIES,
    HORIZON_RANGE_RAD,
    SOFTNESS_RAD,
    DiscTransport,
    LightState,
    bounce_terms,
)
from seasonscapes.images import REC709_LUMINANCE

# Ablations by network input: `code` a free vector per training time, as in WildGaussians; `sun` the time embedding
# alone; `physical` no network at all; `full` physical shading, its features and the time embedding.
KINDS = ("code", "sun", "physical", "full")
EMBEDDING, CODE = 6, 32
# Width of the hidden layers; without physical shading those of WildGaussians.
HIDDEN = {"code": 128, "sun": 128, "full": 64}
TIME_FEATURES, PHYSICAL_FEATURES = 14, 8


@dataclass(frozen=True)
class LightTensors:
    """T light states as tensors; radiometric values are relative to the luminance of the horizontal illuminance.

    Parameters
    ----------
    direction
        ``(T, 2, 3)`` unit vectors towards sun and moon.
    illuminance
        ``(T, 2, 3)`` relative normal illuminance; zero for a missing body.
    sky
        ``(T, r, 3)`` relative light per sky coefficient.
    bounce
        ``(T, 5, 3)`` relative light per bounce coefficient.
    features
        ``(T, 14)`` time embedding from `time_features`.
    season
        ``(T,)`` index of the dated albedo of each time.
    visible
        ``(T, 2, N)`` uint8: traced share of the light of sun and moon that reaches N discs past the land, 255 all of it; ``None``:
        the discs' horizons tell.
    """

    direction: torch.Tensor
    illuminance: torch.Tensor
    sky: torch.Tensor
    bounce: torch.Tensor
    features: torch.Tensor
    season: torch.Tensor
    visible: torch.Tensor | None = None


def light_tensors(
    states: Sequence[LightState], seasons: Sequence[int] | None = None, visible: np.ndarray | None = None
) -> LightTensors:
    """Stack light states into tensors.

    Parameters
    ----------
    states
        T light states; bodies beyond two are dropped.
    seasons
        Index of the dated albedo of each time; 0 if omitted.
    visible
        ``(T, 2, N)`` in [0, 1], from `land_shadows.DiscShadows.visible_share`; by the discs' horizons if omitted.

    Returns
    -------
    LightTensors
        Lights of T times.
    """
    rows = [_light_rows(state) for state in states]
    direction, illuminance, sky, bounce, features = (
        torch.as_tensor(np.stack(column), dtype=torch.float32) for column in zip(*rows, strict=True)
    )
    season = torch.as_tensor([0] * len(states) if seasons is None else list(seasons))
    shares = None if visible is None else torch.as_tensor(np.rint(255.0 * visible).astype(np.uint8))
    return LightTensors(direction, illuminance, sky, bounce, features, season, shares)


def _light_rows(state: LightState) -> tuple[np.ndarray, ...]:
    """Columns of `LightTensors` except ``season`` for one state."""
    direction, illuminance = np.zeros((BODIES, 3)), np.zeros((BODIES, 3))
    direction[:, 2] = 1.0
    count = min(len(state.bodies[0]), BODIES)
    direction[:count], illuminance[:count] = state.bodies[0][:count], state.bodies[1][:count] / state.global_lx
    terms = np.concatenate([bounce_terms(direction), np.zeros((BODIES, 1))], axis=1)
    bounce = terms.T @ illuminance
    bounce[-1] = state.sky_lx / state.global_lx
    return direction, illuminance, state.sky * np.pi / state.global_lx, bounce, time_features(state)


def time_features(state: LightState) -> np.ndarray:
    """Time embedding of a light state.

    Parameters
    ----------
    state
        Light of one instant.

    Returns
    -------
    numpy.ndarray
        ``(14,)``: direction, strength and colour of the sun, relative strength and colour of the sky, logarithm of the
        horizontal illuminance, two harmonics of the season, and a constant.
    """
    season = 2.0 * np.pi * state.day / 365.2425
    body = state.bodies[0][0] if len(state.bodies[0]) else np.zeros(3)
    strength = state.bodies[1][0] / state.global_lx if len(state.bodies[0]) else np.zeros(3)
    sky = state.sky_lx / state.global_lx
    return np.array(
        [
            *body,
            float(body @ body > 0.0),
            np.log1p(strength @ REC709_LUMINANCE),
            strength[0] - strength[2],
            sky @ REC709_LUMINANCE,
            sky[2] - sky[0],
            (np.log10(state.global_lx) - 4.5) / 2.0,
            np.sin(season),
            np.cos(season),
            np.sin(2.0 * season),
            np.cos(2.0 * season),
            1.0,
        ]
    )


def fourier_embedding(means: np.ndarray, size: int = EMBEDDING, *, seed: int = 0) -> np.ndarray:
    """Initial embedding of Gaussians as in WildGaussians: sines and cosines of their centres, with a little noise.

    Parameters
    ----------
    means
        ``(N, 3)`` centres [m].
    size
        Dimension of the embedding; low frequencies come first.
    seed
        Seed of the noise.

    Returns
    -------
    numpy.ndarray
        ``(N, size)`` float32.
    """
    centred = means - np.median(means, axis=0)
    unit = 0.5 * centred / np.quantile(np.abs(centred), 0.97) + 0.5
    waves = [wave(2.0 * np.pi * 2.0**octave * unit) for octave in range(-(-size // 6)) for wave in (np.sin, np.cos)]
    noise = np.random.default_rng(seed).normal(0.0, 1e-4, (len(means), size))
    return (np.concatenate(waves, axis=1)[:, :size] + noise).astype(np.float32)


class Appearance(nn.Module):
    """Colours of N Gaussians under a light.

    Parameters
    ----------
    kind
        One of `KINDS`.
    albedo, neighbourhood_albedo
        ``(M, N, 3)`` albedo of the discs on M dates, and its mean over their surroundings.
    transport
        Light transport of the discs; its values are used by ``physical`` and ``full`` only.
    embedding
        ``(N, D)`` from `fourier_embedding`.
    times
        Number T of free codes of ``code``.
    seed
        Seed of the network's initial weights.

    Raises
    ------
    ValueError
        If the kind is unknown.
    """

    albedo: torch.Tensor
    neighbourhood_albedo: torch.Tensor
    normals: torch.Tensor
    horizon: torch.Tensor
    sky: torch.Tensor
    bounce: torch.Tensor
    open_sky: torch.Tensor
    geometry: DiscGeometry | None

    def __init__(
        self,
        kind: str,
        albedo: np.ndarray,
        neighbourhood_albedo: np.ndarray,
        transport: DiscTransport,
        embedding: np.ndarray,
        *,
        times: int = 1,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if kind not in KINDS:
            raise ValueError(f"kind: got {kind!r}, expected one of {', '.join(KINDS)}")
        count = albedo.shape[1]
        self.kind = kind
        self.geometry = None  # the discs stay as they are, unless `refine` is called
        for name, values in (("albedo", albedo), ("neighbourhood_albedo", neighbourhood_albedo)):
            self.register_buffer(name, torch.as_tensor(np.asarray(values, np.float32)))
        low, high = HORIZON_RANGE_RAD
        self.register_buffer("normals", torch.as_tensor(transport.normals))
        self.register_buffer("horizon", torch.as_tensor(transport.horizon.reshape(-1)))
        self.horizon_step, self.horizon_low = (high - low) / 255.0, low
        self.register_buffer("sky", torch.as_tensor(transport.sky * transport.sky_scale))
        self.register_buffer("bounce", torch.as_tensor(transport.bounce * transport.bounce_scale))
        self.register_buffer("open_sky", torch.as_tensor(transport.open_sky))
        # Log gains of colour, and of sky and bounce; shift of the horizon [rad] and logarithm of its softness [rad].
        self.log_colour = nn.Parameter(torch.zeros(count, 3))
        self.log_gain = nn.Parameter(torch.zeros(count, 2))
        self.shift = nn.Parameter(torch.zeros(count))
        self.log_softness = nn.Parameter(torch.full((count,), float(np.log(SOFTNESS_RAD))))
        if kind != "physical":
            generator = torch.Generator().manual_seed(seed)
            self.embedding = nn.Parameter(torch.tensor(embedding, dtype=torch.float32))  # copied: modified by training
            if kind == "code":
                self.codes = nn.Parameter(0.01 * torch.randn(times, CODE, generator=generator))
            self.mlp = correction_network(self._inputs(embedding.shape[1]), HIDDEN[kind], generator)

    def refine(self, geometry: DiscGeometry) -> None:
        """Let training change the discs too, from pictures; `training.train` then needs frames with cameras."""
        self.geometry = geometry

    def _inputs(self, embedding: int) -> int:
        """Number of network inputs."""
        return (
            embedding + 3 + {"code": CODE, "sun": TIME_FEATURES, "full": TIME_FEATURES + PHYSICAL_FEATURES}[self.kind]
        )

    def forward(
        self, index: torch.Tensor, time: torch.Tensor, lights: LightTensors, code: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Compute the colours of Gaussians.

        Parameters
        ----------
        index
            ``(n,)`` Gaussians.
        time
            ``(n,)`` index of the light of each, or one for all ``()``.
        lights
            T light states.
        code
            ``(32,)``, replaces the codes of ``kind="code"``.

        Returns
        -------
        torch.Tensor
            ``(n, 3)`` colours, not negative.
        """
        season = lights.season[time]
        base = self.albedo[season, index] * self.log_colour[index].exp()
        features: list[torch.Tensor] = []
        if self.kind in ("physical", "full"):
            irradiance, features = self._physical(index, time, lights)
            base = base * irradiance
        if self.kind == "physical":
            return base
        embedded_time = lights.features[time] if self.kind != "code" else self.codes[time] if code is None else code
        parts = [self.embedding[index], base, embedded_time.expand(len(index), -1), *features]
        gamma, beta = self.mlp(torch.cat(parts, dim=1)).split(3, dim=1)
        # With physical shading β is a small correction; without it β is as large as the shaded colour.
        return ((1.0 + gamma) * base + (0.1 if self.kind == "full" else 1.0) * beta).clamp(min=0.0)

    def _physical(
        self, index: torch.Tensor, time: torch.Tensor, lights: LightTensors
    ) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Relative irradiance ``(n, 3)`` and features for the network, each ``(n, k)``."""
        normals, gain = self.normals[index], self.log_gain[index].exp()
        total, features = torch.zeros(len(index), 3), []
        for body in range(BODIES):
            direction, illuminance = lights.direction[time, body], lights.illuminance[time, body]
            if body and not bool(illuminance.any()):
                continue
            cosine = (normals * direction).sum(1)
            if lights.visible is None:
                visible = self.visibility(index, direction)
            else:
                visible = lights.visible[time, body, index].float() / 255.0
            visible_cosine = visible * cosine.clamp(min=0.0)
            total = total + visible_cosine[:, None] * illuminance
            if body == 0:
                features = [visible_cosine[:, None], cosine[:, None]]
        if time.ndim:
            sky = torch.einsum("nr,nrc->nc", self.sky[index], lights.sky[time])
            bounce = torch.einsum("nk,nkc->nc", self.bounce[index], lights.bounce[time])
        else:
            sky, bounce = self.sky[index] @ lights.sky[time], self.bounce[index] @ lights.bounce[time]
        sky = sky.clamp(min=0.0) * gain[:, :1]
        bounce = bounce.clamp(min=0.0) * self.neighbourhood_albedo[lights.season[time], index] * gain[:, 1:]
        features += [self.open_sky[index, None], sky[:, 1:2], bounce[:, 1:2], normals]
        return total + sky + bounce, features

    def visibility(self, index: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        """Soft visibility of directions above the horizon of discs.

        Parameters
        ----------
        index
            ``(n,)`` Gaussians.
        direction
            ``(n, 3)`` unit vectors, ENU, or one for all ``(3,)``.

        Returns
        -------
        torch.Tensor
            ``(n,)`` in [0, 1].
        """
        elevation = torch.asin(direction[..., 2].clamp(-1.0, 1.0))
        position = torch.atan2(direction[..., 0], direction[..., 1]) * (AZIMUTHS / (2.0 * np.pi))
        column = torch.floor(position)
        fraction, first = position - column, index * AZIMUTHS
        column = column.long()
        left = self.horizon[first + column % AZIMUTHS].float()
        right = self.horizon[first + (column + 1) % AZIMUTHS].float()
        angle = (left + (right - left) * fraction) * self.horizon_step + self.horizon_low
        return torch.sigmoid((elevation - angle - self.shift[index]) / self.log_softness[index].exp())


def correction_network(inputs: int, width: int, generator: torch.Generator) -> nn.Sequential:
    """The network of the affine correction: two hidden layers, six outputs, and a last layer of zeros."""
    layers = [nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 6)]
    for layer in layers[:-1:2]:
        bound = (6.0 / layer.in_features) ** 0.5
        with torch.no_grad():
            layer.weight.copy_(bound * (2.0 * torch.rand(layer.weight.shape, generator=generator) - 1.0))
            layer.bias.zero_()
    nn.init.zeros_(layers[-1].weight)
    nn.init.zeros_(layers[-1].bias)
    return nn.Sequential(*layers)


@torch.no_grad()
def colours_at(
    appearance: Appearance,
    state: LightState,
    season: int = 0,
    *,
    code: torch.Tensor | None = None,
    visible: np.ndarray | None = None,
) -> np.ndarray:
    """Compute the colours of all Gaussians under a light.

    Parameters
    ----------
    appearance
        Appearance of N Gaussians.
    state
        The light.
    season
        Index of the dated albedo.
    code
        ``(32,)``, replaces the codes of ``kind="code"``.
    visible
        ``(2, N)`` in [0, 1], from `land_shadows.DiscShadows.visible_share`; by the discs' horizons if omitted.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` float32; radiance is colour × ``state.global_lx`` / π.
    """
    lights = light_tensors([state], [season], None if visible is None else visible[None])
    time = torch.zeros((), dtype=torch.long)
    count = appearance.albedo.shape[1]
    parts = [
        appearance(torch.arange(start, min(start + 32768, count)), time, lights, code)
        for start in range(0, count, 32768)
    ]
    return torch.cat(parts).numpy()
