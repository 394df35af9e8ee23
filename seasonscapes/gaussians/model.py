"""Relightable Gaussian model: known geometry, traced light transport, learned corrections; and its file format.

A file takes about 175 bytes per Gaussian. Values that follow from the grid are not stored: the horizontal position of a
disc is its cell, and its rotation and size follow from its plane, up to the changes that training made. All other values
are quantised, to one byte where possible.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

from seasonscapes.albedo.seasons import albedo_at
from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame
from seasonscapes.gaussians.disc_cells import cell_centres_m, packed_cells, unpacked_cells
from seasonscapes.gaussians.disc_transport import DiscTransport
from seasonscapes.gaussians.surfels import (
    CHANGES,
    SurfelGrid,
    Surfels,
    axes_from_quaternions,
    changed_discs,
    disc_offsets_m,
    disc_shapes,
)
from seasonscapes.images import atomic_path
from seasonscapes.terrain.attributes import attributes_at

FORMAT = "seasonscapes gaussians 2"
# Learned parameters of each disc and the range of their quantisation; values beyond it are clipped.
_RANGES = {"log_colour": (-1.0, 1.0), "log_gain": (-2.0, 2.0), "shift": (-0.1, 0.1), "log_softness": (-6.2, -1.0)} | {
    f"geometry.{name}": (-limit, limit) for name, (_, limit) in CHANGES.items()
}
# On level ground the axes of a disc turn with the last digit of its normal, and with them the stored angle.
_RANGES["geometry.twist"] = (-0.5 * np.pi, 0.5 * np.pi)


@dataclass(frozen=True)
class GaussianModel:
    """N Gaussians on a terrain that can be relit for any instant.

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
        ``(N, D)`` float32 embedding; D = 0 for a physical model.
    albedo
        ``(M, N, 3)`` float32 on M dates.
    days
        ``(M,)`` days of the year of these dates, rising.
    transport
        Light transport of the discs.
    appearance
        Learned parameters: ``log_colour (N, 3)``, ``log_gain (N, 2)``, ``shift (N,)``, ``log_softness (N,)``, and the
        network's ``mlp.*``; ``geometry.*``, see `surfels.CHANGES`, if training changed the discs, which have these
        changes already.
    kind
        Kind of appearance, a name in `appearance.KINDS`.
    grid, level, cell, facing
        Grid and planes of the discs, see `surfels.Surfels`.
    frame
        Local frame of the positions.
    note
        Plain values that record how the model was made.

    Raises
    ------
    ValueError
        If array shapes do not agree, values are not finite, or the days do not rise.
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
    grid: SurfelGrid
    level: np.ndarray
    cell: np.ndarray
    facing: np.ndarray
    frame: LocalFrame
    note: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.means)
        expected = {
            "means": (count, 3),
            "quaternions": (count, 4),
            "log_scales": (count, 3),
            "opacity_logits": (count,),
            "albedo": (len(self.days), count, 3),
            "level": (count,),
            "cell": (count,),
            "facing": (count, 3),
        }
        for name, shape in expected.items():
            values = getattr(self, name)
            if values.shape != shape:
                raise ValueError(f"GaussianModel: {name} has shape {values.shape}, expected {shape}")
            if not np.isfinite(values).all():
                raise ValueError(f"GaussianModel: {int(np.sum(~np.isfinite(values)))} values of {name} are not finite")
        if np.any(np.diff(self.days) <= 0.0):
            raise ValueError(f"GaussianModel: days {self.days.tolist()} do not rise")

    @property
    def spacing_m(self) -> np.ndarray:
        """Distance ``(N,)`` of each disc from its neighbours [m]."""
        return self.grid.spacings_m(self.level)

    @property
    def changes(self) -> dict[str, np.ndarray]:
        """Changes of the discs that training made, by the names of `surfels.CHANGES`; empty if it made none."""
        return _changes(self.appearance)

    def albedo_on(self, day: float) -> np.ndarray:
        """Interpolate the dated albedos to a day of the year; see `albedo.seasons.albedo_at`.

        Parameters
        ----------
        day
            Day of the year.

        Returns
        -------
        numpy.ndarray
            ``(N, 3)``.
        """
        if len(self.days) == 1:
            return self.albedo[0]
        attributes = attributes_at(self.means, self.transport.normals, self.spacing_m)
        return albedo_at(self.albedo, self.days, day, attributes)


@dataclass(frozen=True)
class LearnedParameters:
    """Trained parameters of an appearance, from `splat_view.learned_parameters`.

    Parameters
    ----------
    kind
        Kind of appearance, a name in `appearance.KINDS`.
    arrays
        Parameters by name: those of `GaussianModel.appearance`, and ``embedding (N, D)`` unless the kind has no network.
    """

    kind: str
    arrays: dict[str, np.ndarray]


def model_from(
    surfels: Surfels,
    albedo: np.ndarray,
    days: Sequence[float] | np.ndarray,
    transport: DiscTransport,
    learned: LearnedParameters,
    *,
    frame: LocalFrame,
    note: dict[str, Any] | None = None,
) -> GaussianModel:
    """Assemble a model from discs, dated albedos, transport and learned parameters.

    Parameters
    ----------
    surfels
        N discs as the terrain gives them; changes that training made are applied here.
    albedo
        ``(M, N, 3)`` on M dates.
    days
        ``(M,)`` days of the year of these dates, rising.
    transport
        Light transport of the discs.
    learned
        Trained parameters of the appearance.
    frame
        Local frame of the positions.
    note
        Plain values that record how the model was made.

    Returns
    -------
    GaussianModel
        Relightable model.
    """
    parameters = dict(learned.arrays)
    features = parameters.pop("embedding", np.zeros((len(surfels.means), 0), np.float32))
    changes = _changes(parameters)
    discs = (surfels.means, surfels.quaternions, surfels.log_scales, surfels.opacity_logits)
    return GaussianModel(
        *(changed_discs(surfels.means, surfels.facing, surfels.spacing_m, changes) if changes else discs),
        features,
        np.asarray(albedo, np.float32),
        np.asarray(days, np.float64),
        transport,
        parameters,
        learned.kind,
        surfels.grid,
        surfels.level,
        surfels.cell,
        surfels.facing,
        frame,
        note or {},
    )


def _changes(learned: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: learned[f"geometry.{name}"] for name in CHANGES if f"geometry.{name}" in learned}


def save_model(model: GaussianModel, path: str | os.PathLike[str]) -> None:
    """Write a model to one packed ``.safetensors`` file, atomically.

    Parameters
    ----------
    model
        Model whose geometry follows from grid, planes and learned changes.
    path
        Output file.

    Raises
    ------
    ValueError
        If the geometry does not follow from grid, planes and learned changes, so that it would be lost.
    """
    from safetensors.numpy import save_file

    tensors, header = pack_model(model)
    facts = json.dumps(header)
    with atomic_path(path) as temporary:
        save_file(
            {name: np.ascontiguousarray(values) for name, values in tensors.items()},
            temporary,
            metadata={"format": FORMAT, "facts": facts, "sha256": content_digest(tensors, facts)},
        )


def content_digest(tensors: Mapping[str, np.ndarray], facts: str) -> str:
    """SHA-256 of named arrays and a text, whatever their order."""
    digest = hashlib.sha256(facts.encode())
    for name in sorted(tensors):
        values = np.ascontiguousarray(tensors[name])
        digest.update(f"\0{name}\0{values.dtype.str}\0{values.shape}\0".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def load_model(path: str | os.PathLike[str]) -> GaussianModel:
    """Read a model written by `save_model`.

    Parameters
    ----------
    path
        ``.safetensors`` file.

    Returns
    -------
    GaussianModel
        Relightable model.

    Raises
    ------
    InputError
        If the file is missing, is no Gaussian model, or is not what was written.
    """
    from safetensors import SafetensorError, safe_open

    where = os.fspath(path)
    try:
        with safe_open(where, "np") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except FileNotFoundError:
        raise InputError(where, "no such file", cure="make one with `seasonscapes distill`") from None
    except SafetensorError as error:
        raise InputError(where, f"not a safetensors file: {error}") from None
    if metadata.get("format") != FORMAT:
        raise InputError(where, "not a Gaussian model", got=str(metadata.get("format")), expected=FORMAT)
    cure = "copy it again, or make it with `seasonscapes distill`"
    if metadata.get("sha256") != content_digest(tensors, metadata.get("facts", "")):
        raise InputError(where, "damaged, or of an older version: its content is not what its checksum says", cure=cure)
    try:
        return unpack_model(tensors, json.loads(metadata["facts"]))
    except (KeyError, TypeError, ValueError, IndexError, RecursionError) as error:
        raise InputError(where, f"not a Gaussian model: {error!r}", cure=cure) from None


def pack_model(model: GaussianModel) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Quantise the arrays of a model for storage.

    Parameters
    ----------
    model
        Model whose geometry follows from grid, planes and learned changes.

    Returns
    -------
    tensors
        Arrays by name.
    header
        Plain values needed to restore them.

    Raises
    ------
    ValueError
        If the geometry does not follow from grid, planes and learned changes, so that it would be lost.
    """
    spacing_m, changes, means = model.spacing_m, model.changes, model.means
    if changes:
        means = means - disc_offsets_m(disc_shapes(model.facing, spacing_m)[0], spacing_m, changes)
    shape = changed_discs(means, model.facing, spacing_m, changes)[1:]
    for name, expected in zip(("quaternions", "log_scales", "opacity_logits"), shape, strict=True):
        if not np.allclose(getattr(model, name), expected, atol=1e-3):
            raise ValueError(f"save_model: {name} do not follow from the discs' grid and planes; export a .ply instead")
    low, high = float(means[:, 2].min()), float(means[:, 2].max())
    step = max(high - low, 1e-3) / 65535.0
    transport = model.transport
    tensors = {
        **packed_cells(model.grid, model.level, model.cell),
        "height": np.rint((means[:, 2] - low) / step).astype(np.uint16),
        "facing": octahedral(model.facing),
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
    learned = model.appearance
    if changes:
        changes = _relative_to(disc_shapes(from_octahedral(tensors["facing"]), spacing_m)[0], model, means)
        learned = learned | {f"geometry.{name}": values for name, values in changes.items()}
    for name, values in learned.items():
        tensors[f"appearance.{name}"] = _quantised(values, *_RANGES[name]) if name in _RANGES else values
    header = {
        "kind": model.kind,
        "days": model.days.tolist(),
        "height": [low, step],
        "plan": asdict(model.grid),
        "levels": int(model.level.max(initial=0)),
        "frame": asdict(model.frame),
        "note": model.note,
        "patches": transport.patches,
        "feature_scale": feature_scale.tolist(),
    }
    return tensors, header


def _relative_to(quaternions: np.ndarray, model: GaussianModel, means: np.ndarray) -> dict[str, np.ndarray]:
    """The model's changes as seen from unchanged discs of other axes ``quaternions (N, 4)`` and centres ``means (N, 3)``."""
    axes = axes_from_quaternions(quaternions)
    offset = np.einsum("nij,ni->nj", axes, model.means - means) / model.spacing_m[:, None]
    first = np.einsum("nij,ni->nj", axes, axes_from_quaternions(model.quaternions)[:, :, 0])
    twist = np.arctan2(first[:, 1], first[:, 0])
    # An ellipse is the same after half a turn.
    twist = (twist + 0.5 * np.pi) % np.pi - 0.5 * np.pi
    return model.changes | {"offset": offset, "twist": twist[:, None]}


def unpack_model(tensors: dict[str, np.ndarray], header: dict[str, Any]) -> GaussianModel:
    """Restore a model from the arrays of `pack_model`.

    Parameters
    ----------
    tensors
        Arrays by name.
    header
        Plain values, both from `pack_model`.

    Returns
    -------
    GaussianModel
        The model, up to quantisation.
    """
    grid, (low, step) = SurfelGrid(**header["plan"]), header["height"]
    level, cell = unpacked_cells(grid, tensors, header["levels"])
    east_m, north_m = cell_centres_m(grid, level, cell)
    means = np.stack([east_m, north_m, low + tensors["height"] * step], axis=1).astype(np.float32)
    facing = from_octahedral(tensors["facing"])
    normals = from_octahedral(tensors["normal"]) * (tensors["roughness"][:, None] / np.float32(255.0))
    stored = {
        item.name: tensors[f"transport.{item.name}"]
        for item in fields(DiscTransport)
        if f"transport.{item.name}" in tensors
    }
    transport = DiscTransport(normals=normals, patches=header["patches"], **stored)
    appearance = {}
    for name, values in tensors.items():
        if name.startswith("appearance."):
            short = name.removeprefix("appearance.")
            appearance[short] = _dequantised(values, *_RANGES[short]) if short in _RANGES else values
    features = tensors["features"] * np.array(header["feature_scale"], np.float32)
    albedo = ((tensors["albedo"] / np.float32(255.0)) ** 2).astype(np.float32)
    return GaussianModel(
        *changed_discs(means, facing, grid.spacings_m(level), _changes(appearance)),
        features,
        albedo,
        np.array(header["days"]),
        transport,
        appearance,
        header["kind"],
        grid,
        level,
        cell,
        facing,
        LocalFrame(**header["frame"]),
        header["note"],
    )


def bytes_per_gaussian(model: GaussianModel) -> float:
    """Compute the storage per Gaussian, with one date of albedo and without shared arrays.

    Parameters
    ----------
    model
        Model whose geometry follows from grid, planes and learned changes.

    Returns
    -------
    float
        Bytes per Gaussian.
    """
    tensors, _ = pack_model(model)
    count = len(model.means)
    own = {
        name: values.nbytes
        for name, values in tensors.items()
        if values.shape[:1] == (count,) or name in ("taken", "split", "albedo")
    }
    own["albedo"] //= len(model.days)
    return sum(own.values()) / count


def _quantised(values: np.ndarray, low: float, high: float) -> np.ndarray:
    return np.rint((np.clip(values, low, high) - low) * (255.0 / (high - low))).astype(np.uint8)


def _dequantised(levels: np.ndarray, low: float, high: float) -> np.ndarray:
    return (low + levels * np.float32((high - low) / 255.0)).astype(np.float32)


def octahedral(direction: np.ndarray) -> np.ndarray:
    """Encode directions on an unfolded octahedron (Cigolle et al. 2014).

    Parameters
    ----------
    direction
        ``(N, 3)`` of any length.

    Returns
    -------
    numpy.ndarray
        ``(N, 2)`` int16.
    """
    unit = direction / np.maximum(np.abs(direction).sum(axis=1, keepdims=True), 1e-30)
    flat = unit[:, :2]
    folded = (1.0 - np.abs(flat[:, ::-1])) * np.where(flat >= 0.0, 1.0, -1.0)
    return np.rint(32767.0 * np.where(unit[:, 2:] >= 0.0, flat, folded)).astype(np.int16)


def from_octahedral(code: np.ndarray) -> np.ndarray:
    """Decode directions encoded by `octahedral`.

    Parameters
    ----------
    code
        ``(N, 2)`` int16.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` float32 unit vectors.
    """
    flat = code.astype(np.float64) / 32767.0
    height = 1.0 - np.abs(flat).sum(axis=1)
    folded = (1.0 - np.abs(flat[:, ::-1])) * np.where(flat >= 0.0, 1.0, -1.0)
    direction = np.concatenate([np.where(height[:, None] >= 0.0, flat, folded), height[:, None]], axis=1)
    return (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
