"""The Gaussian model: known geometry, traced transport, learned corrections. One record, one file.

A file holds about 100 bytes for each Gaussian. What follows from the grid is not stored: a disc's place in plan is its
cell, its turn and size follow from its normal. Everything else is a byte where a byte is enough.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field, fields

import numpy as np

from seasonscapes.albedo.seasons import albedo_at
from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame
from seasonscapes.gaussians.disc_transport import DiscTransport
from seasonscapes.gaussians.surfels import SurfelGrid, Surfels, disc_shapes
from seasonscapes.images import atomic_path
from seasonscapes.terrain.attributes import attributes_at

FORMAT = "seasonscapes gaussians 1"
# Learned numbers of each disc and the range that their bytes span; beyond it they are clipped.
_RANGES = {"log_colour": (-1.0, 1.0), "log_gain": (-2.0, 2.0), "shift": (-0.1, 0.1), "log_softness": (-6.2, -1.0)}


@dataclass(frozen=True)
class GaussianModel:
    """N Gaussians on a terrain that can be lit for any instant.

    Parameters
    ----------
    means
        ``(N, 3)`` float32 ENU [m].
    quaternions
        ``(N, 4)`` float32 wxyz.
    log_scales
        ``(N, 3)`` float32, natural logarithms of standard deviations [m].
    opacity_logits
        ``(N,)`` float32.
    features
        ``(N, D)`` float32 embedding; no column for a physical model.
    albedo
        ``(M, N, 3)`` float32 at M dates.
    days
        ``(M,)`` days of the year of these, rising.
    transport
        What each disc knows of the land around it.
    appearance
        Learned numbers: ``log_colour (N, 3)``, ``log_gain (N, 2)``, ``shift (N,)``, ``log_softness (N,)``, and the
        network's ``mlp.*``.
    kind
        Which appearance, a name in `appearance.KINDS`.
    plan, cell
        The grid that the discs stand on, see `surfels.Surfels`.
    frame
        The local frame that positions are in.
    note
        Plain values about how it was made.
    """

    means: np.ndarray
    quaternions: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    features: np.ndarray
    albedo: np.ndarray
    days: np.ndarray
    transport: DiscTransport
    appearance: dict[str, np.ndarray]
    kind: str
    plan: SurfelGrid
    cell: np.ndarray
    frame: LocalFrame
    note: dict = field(default_factory=dict)

    def __post_init__(self):
        count = len(self.means)
        wanted = {
            "means": (count, 3),
            "quaternions": (count, 4),
            "log_scales": (count, 3),
            "opacity_logits": (count,),
            "albedo": (len(self.days), count, 3),
            "cell": (count,),
        }
        for name, shape in wanted.items():
            values = getattr(self, name)
            if values.shape != shape:
                raise ValueError(f"GaussianModel: {name} has shape {values.shape}, expected {shape}")
            if not np.isfinite(values).all():
                raise ValueError(f"GaussianModel: {int(np.sum(~np.isfinite(values)))} values of {name} are not finite")
        if np.any(np.diff(self.days) <= 0.0):
            raise ValueError(f"GaussianModel: days {self.days.tolist()} do not rise")

    def albedo_on(self, day: float) -> np.ndarray:
        """Albedo ``(N, 3)`` of a day of the year; see `albedo.seasons.albedo_at`."""
        if len(self.days) == 1:
            return self.albedo[0]
        ground = attributes_at(self.means, self.transport.normals, self.plan.spacing_m)
        return albedo_at(self.albedo, self.days, day, ground)


def model_from(
    surfels: Surfels,
    albedo: np.ndarray,
    days,
    transport: DiscTransport,
    *,
    kind: str,
    frame: LocalFrame,
    appearance: dict[str, np.ndarray],
    note: dict | None = None,
) -> GaussianModel:
    """A model of discs, dated albedos ``(M, N, 3)`` and learned numbers, as `splat_view.learned_numbers` gives them."""
    learned = dict(appearance)
    features = learned.pop("embedding", np.zeros((len(surfels.means), 0), np.float32))
    return GaussianModel(
        surfels.means,
        surfels.quaternions,
        surfels.log_scales,
        surfels.opacity_logits,
        features,
        np.asarray(albedo, np.float32),
        np.asarray(days, np.float64),
        transport,
        learned,
        kind,
        surfels.plan,
        surfels.cell,
        frame,
        note or {},
    )


def save_model(model: GaussianModel, path: str | os.PathLike) -> None:
    """Write a model to one ``.safetensors`` file, packed, atomically."""
    from safetensors.numpy import save_file

    tensors, facts = packed(model)
    with atomic_path(path) as temporary:
        save_file(
            {name: np.ascontiguousarray(values) for name, values in tensors.items()},
            temporary,
            metadata={"format": FORMAT, "facts": json.dumps(facts)},
        )


def load_model(path: str | os.PathLike) -> GaussianModel:
    """Read what `save_model` wrote; `InputError` where the file is missing or something else."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(os.fspath(path), "np") as file:
            facts = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except FileNotFoundError:
        raise InputError(path, "no such file", cure="make one with `seasonscapes distill`") from None
    except SafetensorError as error:
        raise InputError(path, f"not a safetensors file: {error}") from None
    if facts.get("format") != FORMAT:
        raise InputError(path, "not a Gaussian model", got=str(facts.get("format")), expected=FORMAT)
    return unpacked(tensors, json.loads(facts["facts"]))


def packed(model: GaussianModel) -> tuple[dict[str, np.ndarray], dict]:
    """A model's arrays in few bytes, and the plain values that bring them back.

    Raises
    ------
    ValueError
        Where the geometry is not what follows from grid and normals, and would be lost.
    """
    shape = disc_shapes(model.transport.normals, model.plan.spacing_m)
    for name, expected in zip(("quaternions", "log_scales", "opacity_logits"), shape, strict=True):
        if not np.allclose(getattr(model, name), expected, atol=1e-3):
            raise ValueError(f"save_model: {name} are not those of discs on the terrain; export a .ply instead")
    taken = np.zeros(model.plan.columns * model.plan.rows, bool)
    taken[model.cell] = True
    low, high = float(model.means[:, 2].min()), float(model.means[:, 2].max())
    step = max(high - low, 1e-3) / 65535.0
    transport = model.transport
    tensors = {
        "taken": np.packbits(taken),
        "height": np.rint((model.means[:, 2] - low) / step).astype(np.uint16),
        "normal": octahedral(transport.normals),
        "roughness": np.rint(255.0 * np.clip(np.linalg.norm(transport.normals, axis=1), 0.0, 1.0)).astype(np.uint8),
        "albedo": np.rint(255.0 * np.sqrt(np.clip(model.albedo, 0.0, 1.0))).astype(np.uint8),
        **{
            f"transport.{name}": getattr(transport, name)
            for name in ("horizon", "sky", "sky_scale", "from_sky", "bounce", "bounce_scale")
        },
    }
    feature_scale = np.maximum(np.abs(model.features).max(axis=0, initial=0.0), 1e-9) / 127.0
    tensors["features"] = np.rint(model.features / feature_scale).astype(np.int8)
    for name, values in model.appearance.items():
        tensors[f"appearance.{name}"] = _bytes(values, *_RANGES[name]) if name in _RANGES else values
    facts = {
        "kind": model.kind,
        "days": model.days.tolist(),
        "height": [low, step],
        "plan": asdict(model.plan),
        "frame": asdict(model.frame),
        "note": model.note,
        "patches": transport.patches,
        "feature_scale": feature_scale.tolist(),
    }
    return tensors, facts


def unpacked(tensors: dict[str, np.ndarray], facts: dict) -> GaussianModel:
    """The model of `packed` arrays."""
    plan, (low, step) = SurfelGrid(**facts["plan"]), facts["height"]
    cell = np.flatnonzero(np.unpackbits(tensors["taken"])[: plan.columns * plan.rows]).astype(np.int32)
    row, column = np.divmod(cell, plan.columns)
    means = np.stack(
        [
            plan.west_m + (column + 0.5) * plan.east_step_m,
            plan.north_m - (row + 0.5) * plan.north_step_m,
            low + tensors["height"] * step,
        ],
        axis=1,
    ).astype(np.float32)
    normals = from_octahedral(tensors["normal"]) * (tensors["roughness"][:, None] / np.float32(255.0))
    held = {
        item.name: tensors[f"transport.{item.name}"]
        for item in fields(DiscTransport)
        if f"transport.{item.name}" in tensors
    }
    transport = DiscTransport(normals=normals, patches=facts["patches"], **held)
    appearance = {}
    for name, values in tensors.items():
        if name.startswith("appearance."):
            short = name.removeprefix("appearance.")
            appearance[short] = _values(values, *_RANGES[short]) if short in _RANGES else values
    features = tensors["features"] * np.array(facts["feature_scale"], np.float32)
    albedo = ((tensors["albedo"] / np.float32(255.0)) ** 2).astype(np.float32)
    return GaussianModel(
        means,
        *disc_shapes(normals, plan.spacing_m),
        features,
        albedo,
        np.array(facts["days"]),
        transport,
        appearance,
        facts["kind"],
        plan,
        cell,
        LocalFrame(**facts["frame"]),
        facts["note"],
    )


def bytes_each(model: GaussianModel) -> float:
    """Bytes of the file for each Gaussian, one date of albedo counted, what all share left out."""
    tensors, _ = packed(model)
    count = len(model.means)
    own = {
        name: values.nbytes
        for name, values in tensors.items()
        if values.shape[:1] == (count,) or name in ("taken", "albedo")
    }
    own["albedo"] //= len(model.days)
    return sum(own.values()) / count


def _bytes(values: np.ndarray, low: float, high: float) -> np.ndarray:
    return np.rint((np.clip(values, low, high) - low) * (255.0 / (high - low))).astype(np.uint8)


def _values(levels: np.ndarray, low: float, high: float) -> np.ndarray:
    return (low + levels * np.float32((high - low) / 255.0)).astype(np.float32)


def octahedral(direction: np.ndarray) -> np.ndarray:
    """Directions ``(N, 3)`` of any length as ``(N, 2)`` int16 on an unfolded octahedron (Cigolle et al. 2014)."""
    unit = direction / np.maximum(np.abs(direction).sum(axis=1, keepdims=True), 1e-30)
    flat = unit[:, :2]
    folded = (1.0 - np.abs(flat[:, ::-1])) * np.where(flat >= 0.0, 1.0, -1.0)
    return np.rint(32767.0 * np.where(unit[:, 2:] >= 0.0, flat, folded)).astype(np.int16)


def from_octahedral(code: np.ndarray) -> np.ndarray:
    """Unit directions ``(N, 3)`` float32, the inverse of `octahedral`."""
    flat = code.astype(np.float64) / 32767.0
    height = 1.0 - np.abs(flat).sum(axis=1)
    folded = (1.0 - np.abs(flat[:, ::-1])) * np.where(flat >= 0.0, 1.0, -1.0)
    direction = np.concatenate([np.where(height[:, None] >= 0.0, flat, folded), height[:, None]], axis=1)
    return (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
