"""Export of Gaussians: baked 3DGS ``.ply``, glTF, and training views for other trainers.

These formats have no light, so one instant is exported: display-referred sRGB colours as spherical harmonics of degree
0. Positions are east-north-up [m].
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.cameras.exchange import NamedView, write_colmap, write_transforms
from seasonscapes.cameras.timed_views import GEOREFERENCE, write_georeference
from seasonscapes.errors import InputError
from seasonscapes.export.gltf_file import GltfFile
from seasonscapes.frames import LocalFrame, frame_record
from seasonscapes.gaussians.disc_transport import LightState
from seasonscapes.images import atomic_path

# Where training pictures lie below the folder of `write_training_views`.
IMAGE_FOLDER = "images"
# Y₀₀, the constant spherical harmonic.
SH0 = 0.28209479177387814
_COLUMNS = ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
            "rot_0", "rot_1", "rot_2", "rot_3")  # fmt: skip


@dataclass(frozen=True)
class BakedSplats:
    """N Gaussians with the colours of one instant, float32.

    Parameters
    ----------
    means
        ``(N, 3)`` ENU [m].
    quaternions
        ``(N, 4)`` wxyz.
    log_scales
        ``(N, 3)`` natural logarithms of standard deviations [m].
    opacity_logits
        ``(N,)``.
    rgb
        ``(N, 3)`` display-referred sRGB in [0, 1].

    Raises
    ------
    ValueError
        If there is no Gaussian, or arrays differ in length or are not finite.
    """

    means: np.ndarray
    quaternions: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    rgb: np.ndarray

    def __post_init__(self) -> None:
        if len(self.means) == 0:
            raise ValueError("BakedSplats: got no Gaussian, expected at least one")
        for name in self.__dataclass_fields__:
            values = getattr(self, name)
            if len(values) != len(self.means) or not np.isfinite(values).all():
                raise ValueError(f"BakedSplats: {name} differs in length from means, or has values that are not finite")


def write_ply(path: Path, splats: BakedSplats, *, note: dict[str, Any] | None = None) -> None:
    """Write a 3DGS ``.ply``, 68 bytes per splat: log scales, logit opacity, wxyz, f_dc = (rgb − ½) / Y₀₀.

    Parameters
    ----------
    path
        Output file, written atomically.
    splats
        Gaussians of one instant.
    note
        Plain values, each a comment ``NAME JSON`` of the header, such as the origin.
    """
    table = np.zeros((len(splats.means), len(_COLUMNS)), "<f4")
    table[:, 0:3], table[:, 6:9] = splats.means, (splats.rgb - 0.5) / SH0
    table[:, 9], table[:, 10:13], table[:, 13:17] = splats.opacity_logits, splats.log_scales, splats.quaternions
    _write_vertices(path, table.tobytes(), len(table), [f"float {name}" for name in _COLUMNS], note)


def write_points(path: Path, splats: BakedSplats, *, note: dict[str, Any] | None = None) -> None:
    """Write the centres of Gaussians with their colours as a point cloud ``.ply``: x, y, z, red, green, blue.

    Parameters
    ----------
    path
        Output file, written atomically.
    splats
        The Gaussians.
    note
        As of `write_ply`.
    """
    columns = [*((axis, "<f4") for axis in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    table = np.zeros(len(splats.means), columns)
    levels = np.rint(255.0 * np.clip(splats.rgb, 0.0, 1.0))
    for index, (name, _) in enumerate(columns):
        table[name] = splats.means[:, index] if index < 3 else levels[:, index - 3]
    properties = [f"{'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in columns]
    _write_vertices(path, table.tobytes(), len(table), properties, note)


def _write_vertices(path: Path, body: bytes, count: int, properties: list[str], note: dict[str, Any] | None) -> None:
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment east-north-up metres, sRGB",
        *(f"comment {name} {json.dumps(value, default=float)}" for name, value in (note or {}).items()),
        f"element vertex {count}",
        *(f"property {text}" for text in properties),
        "end_header",
    ]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(body)


def read_ply(path: Path) -> BakedSplats:
    """Read a 3DGS ``.ply`` of binary little-endian floats; harmonics above degree 0 are dropped.

    Parameters
    ----------
    path
        Input file.

    Returns
    -------
    BakedSplats
        Gaussians of the file.

    Raises
    ------
    InputError
        If the file is missing, truncated or of another format.
    """
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(path, "no such file") from None
    end = data.find(b"end_header\n")
    lines = data[: max(end, 0)].decode("ascii", "replace").splitlines()
    if end < 0 or "format binary_little_endian 1.0" not in lines:
        raise InputError(path, "not a binary little-endian .ply")
    count = next((int(line.split()[2]) for line in lines if line.startswith("element vertex")), 0)
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    missing = [name for name in _COLUMNS if name not in names and not name.startswith("n")]
    body = data[end + len(b"end_header\n") :]
    if missing or len(body) < 4 * count * len(names):
        raise InputError(path, "not a whole 3DGS .ply", got=f"no {missing[0]}" if missing else f"{len(body)} bytes")
    table = np.frombuffer(body, "<f4", count * len(names)).reshape(count, len(names))

    def columns(*wanted: str) -> np.ndarray:
        return table[:, [names.index(name) for name in wanted]].copy()

    return BakedSplats(
        columns("x", "y", "z"),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        columns("scale_0", "scale_1", "scale_2"),
        columns("opacity")[:, 0],
        columns("f_dc_0", "f_dc_1", "f_dc_2") * np.float32(SH0) + np.float32(0.5),
    )


def write_gltf(path: Path, splats: BakedSplats, *, note: dict[str, Any] | None = None) -> None:
    """Write a ``.glb`` with ``KHR_gaussian_splatting`` (Khronos release candidate of 2026).

    Readers without the extension display points. Scales are linear, opacity is in [0, 1], quaternions are xyzw; a node
    rotates the scene to glTF's y-up axes.

    Parameters
    ----------
    path
        Output file, written atomically.
    splats
        Gaussians of one instant.
    note
        Plain values for the ``extras`` of the asset.
    """
    file = GltfFile({"up_axis": "y", "colour_space": "sRGB, display-referred", **(note or {})})
    arrays = {
        "POSITION": splats.means,
        "COLOR_0": np.concatenate([_linear(splats.rgb), _sigmoid(splats.opacity_logits)[:, None]], axis=1),
        "KHR_gaussian_splatting:ROTATION": np.roll(splats.quaternions, -1, axis=1),
        "KHR_gaussian_splatting:SCALE": np.exp(splats.log_scales),
        "KHR_gaussian_splatting:OPACITY": _sigmoid(splats.opacity_logits),
        "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": (splats.rgb - 0.5) / SH0,
    }
    primitive = {
        "mode": 0,
        "attributes": {name: file.add_array(values, bounds=name == "POSITION") for name, values in arrays.items()},
        "extensions": {"KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    file.use("KHR_gaussian_splatting")
    root2 = float(np.sqrt(0.5))
    mesh = file.add("meshes", {"primitives": [primitive]})
    node = file.add("nodes", {"name": "east-north-up", "mesh": mesh, "rotation": [-root2, 0.0, 0.0, root2]})
    file.table |= {"scene": 0, "scenes": [{"nodes": [node]}]}
    file.write_glb(path)


def _sigmoid(values: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-values))


def _linear(encoded: np.ndarray) -> np.ndarray:
    from seasonscapes.images import linear_from_srgb

    return linear_from_srgb(encoded)


@dataclass(frozen=True)
class TrainingView:
    """A training picture for other trainers.

    Parameters
    ----------
    view
        Camera, file and time.
    light
        Light of the picture.
    """

    view: NamedView
    light: LightState


def write_training_views(folder: Path, views: Sequence[TrainingView], splats: BakedSplats, frame: LocalFrame) -> None:
    """Write ``transforms.json`` (nerfstudio), ``sparse/0/*.txt`` (COLMAP) and ``points.ply`` for other trainers.

    Every frame of ``transforms.json`` has ``timestamp_utc``, ``sun_enu`` (unit, towards the sun; absent by night),
    ``sun_lx``, ``sky_lx`` and ``exposure`` (1 over the luminance of the horizontal illuminance [lx]); readers ignore
    unknown keys. COLMAP's ``points3D.txt`` and ``points.ply`` contain the centres of the discs with their colours.
    Pictures are named relative to the folder in the former, relative to its ``images/`` in COLMAP's model, beside which
    ``georeference.json`` states origin and times.

    Parameters
    ----------
    folder
        Output folder.
    views
        Training pictures, each with a time.
    splats
        Initial Gaussians.
    frame
        Local frame of cameras and Gaussians.

    Raises
    ------
    ValueError
        If there is no view, or a view has no time.
    """
    if not views:
        raise ValueError("write_training_views: no view to write")
    named = [training_view.view for training_view in views]
    times = [view.time for view in named if view.time is not None]
    if len(times) != len(named):
        raise ValueError("write_training_views: a view has no time")
    write_transforms(folder / "transforms.json", named, frame)
    table = json.loads((folder / "transforms.json").read_text())
    table["ply_file_path"] = "points.ply"
    for record, time, training_view in zip(table["frames"], times, views, strict=True):
        light = training_view.light
        record["timestamp_utc"] = time.astimezone(UTC).isoformat().replace("+00:00", "Z")
        record |= {"sky_lx": light.sky_lx.tolist(), "exposure": 1.0 / light.global_lx, "day_of_year": light.day}
        if len(light.bodies[0]):
            record |= {"sun_enu": light.bodies[0][0].tolist(), "sun_lx": light.bodies[1][0].tolist()}
    with atomic_path(folder / "transforms.json") as temporary:
        temporary.write_text(json.dumps(table, indent=1) + "\n")
    write_colmap(folder / "sparse" / "0", named, image_folder=IMAGE_FOLDER)
    write_georeference(folder / "sparse" / "0" / GEOREFERENCE, named, frame, image_folder=IMAGE_FOLDER)
    levels = np.rint(255.0 * np.clip(splats.rgb, 0.0, 1.0)).astype(int)
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"]
    lines += [
        f"{number} {x:.3f} {y:.3f} {z:.3f} {r} {g} {b} 0"
        for number, ((x, y, z), (r, g, b)) in enumerate(zip(splats.means, levels, strict=True), 1)
    ]
    with atomic_path(folder / "sparse" / "0" / "points3D.txt") as temporary:
        temporary.write_text("\n".join(lines) + "\n")
    write_points(folder / "points.ply", splats, note=frame_record(frame))
