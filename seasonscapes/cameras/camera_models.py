"""Camera models of other programs: OpenCV, COLMAP, glimpse, ImGRAFT, PyTrx, and plain JSON.

Each states intrinsics with Brown's distortion (`seasonscapes.cameras.lens`), and most a pose. Conventions differ in where a
pixel's centre lies, in units, in the sense of angles, in whether heights are above the ellipsoid, and in what north is:

========= ======================= =============================================== ========================================
format    first pixel's centre    rotation                                        position
========= ======================= =============================================== ========================================
json      (0.5, 0.5)              heading, pitch, roll [deg] against true north,  WGS 84, or ``xyz`` in a map's coordinates
                                  or rows of a rotation matrix in the map's axes
opencv    (0, 0)                  ``rvec``, ``tvec`` in the map's axes, if any    with ``tvec``
colmap    (0.5, 0.5)              quaternion in the map's axes                    with the translation
glimpse   (0.5, 0.5)              yaw from grid north, pitch up, roll [deg]       ``xyz`` in a map's coordinates
imgraft   (1, 1)                  yaw from the x axis, pitch down, roll [rad]     ``xyz`` in a map's coordinates
pytrx     (1, 1)                  as imgraft                                      as imgraft
========= ======================= =============================================== ========================================

ImGRAFT and PyTrx apply tangential distortion by a formula that is not Brown's, although PyTrx's coefficients come from a
calibration that means Brown's: they are read as Brown's from PyTrx, and refused from ImGRAFT. Skew is refused beyond a
thousandth of the focal length, and left out below it, as PyTrx does.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Literal

import cv2
import numpy as np

from seasonscapes import text_files
from seasonscapes.cameras.exchange import read_json
from seasonscapes.cameras.lens import Lens
from seasonscapes.cameras.pinhole import rotation_from_angles
from seasonscapes.errors import InputError

ModelFormat = Literal["json", "opencv", "colmap", "glimpse", "imgraft", "pytrx"]
FORMATS: tuple[ModelFormat, ...] = ("json", "opencv", "colmap", "glimpse", "imgraft", "pytrx")

# Parameters of COLMAP's cameras that are Brown's: how many, and the names of those after the principal point.
_COLMAP: dict[str, tuple[int, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (1, ()),
    "PINHOLE": (2, ()),
    "SIMPLE_RADIAL": (1, ("k1",)),
    "RADIAL": (1, ("k1", "k2")),
    "OPENCV": (2, ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (2, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}
_COLMAP_NUMBERS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")
_OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_LARGEST_SKEW = 1e-3


@dataclass(frozen=True)
class CameraModel:
    """A camera as another program states it.

    Parameters
    ----------
    size_px
        Width and height [px]; ``None`` where the file does not state them.
    fx, fy, cx, cy
        Focal lengths and principal point [px]; pixel centres at +0.5.
    lens
        Distortion.
    rotation
        ``world_from_camera`` ``(3, 3)`` with OpenCV axes; ``None`` where the file states no pose.
    position
        ``(3,)``: x, y and height in the map's coordinates, or longitude, latitude [deg] and height [m]; ``None`` without.
    geographic
        Whether ``position`` is WGS 84, and ``rotation`` against true north; else both are in a map's axes.
    name
        Of the view in files of several.
    """

    size_px: tuple[int, int] | None
    fx: float
    fy: float
    cx: float
    cy: float
    lens: Lens
    rotation: np.ndarray | None = None
    position: np.ndarray | None = None
    geographic: bool = False
    name: str = ""


def read_camera_model(path: Path, kind: ModelFormat | None = None, *, view: str | None = None) -> CameraModel:
    """Read the camera of a file of another program.

    Parameters
    ----------
    path
        A file, or COLMAP's folder of a model.
    kind
        Its format; ``None`` recognises it, except that files with ImGRAFT's and glimpse's keys must say which they are.
    view
        In files of several views: the name of one.

    Returns
    -------
    CameraModel
        Intrinsics, distortion, and the pose if the file has one.

    Raises
    ------
    InputError
        The file is missing, of an unknown or ambiguous format, has a lens that is not Brown's, holds several views and none
        is named, or states numbers that are no camera.
    """
    models = read_camera_models(path, kind)
    chosen = models if view is None else [model for model in models if model.name == view]
    if len(chosen) == 1:
        return chosen[0]
    names = ", ".join(sorted(model.name for model in models)[:20])
    problem = "holds no view of that name" if not chosen else f"holds {len(chosen)} views"
    raise InputError(path, problem, got=view, expected=f"one of {names}", cure="name one with --model-view")


def read_camera_models(path: Path, kind: ModelFormat | None = None) -> list[CameraModel]:
    """Read all cameras of a file of another program, in its order; arguments and errors as `read_camera_model`."""
    kind = _recognised(path) if kind is None else kind
    try:
        return [_checked(model, path) for model in _READERS[kind](path)]
    except text_files.MALFORMED as error:
        problem = f"key {error} is missing" if isinstance(error, KeyError) else f"not a camera of {kind}: {error}"
        raise InputError(path, problem) from None


def _checked(model: CameraModel, path: Path) -> CameraModel:
    numbers = [model.fx, model.fy, model.cx, model.cy]
    for array in (model.rotation, model.position):
        numbers += [] if array is None else np.ravel(array).tolist()
    if not np.isfinite(numbers).all() or min(model.fx, model.fy) <= 0.0:
        raise InputError(path, "not a camera: focal lengths must be positive and all numbers finite")
    if model.rotation is not None:
        rotation = np.asarray(model.rotation, float)
        proper = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
        if not proper or np.linalg.det(rotation) < 0.0:
            raise InputError(path, "its rotation is no rotation (a mirrored axis?)")
        u, _, vt = np.linalg.svd(rotation)
        model = replace(model, rotation=u @ vt)
    return model


def _recognised(path: Path) -> ModelFormat:
    suffix = path.suffix.lower()
    if path.is_dir():
        return "colmap"
    if suffix in (".yml", ".yaml", ".xml"):
        return "opencv"
    if suffix == ".txt":
        return "pytrx"
    if suffix == ".mat":
        return "imgraft"
    if suffix != ".json":
        raise InputError(
            path, "not a known format of camera models", expected=", ".join(FORMATS), cure="--model-format"
        )
    table = read_json(path)
    if "viewdir" in table:
        if "sensorsz" in table or "fmm" in table:
            return "glimpse"
        cure = "say which with --model-format glimpse (degrees) or imgraft (radians)"
        raise InputError(path, "may be glimpse's or ImGRAFT's", cure=cure)
    return "opencv" if "camera_matrix" in table else "json"


def _lens(values: Mapping[str, float]) -> Lens:
    return Lens(**{name: float(value) for name, value in values.items()})


def _opencv_lens(coefficients: Sequence[float] | np.ndarray) -> Lens:
    """The lens of OpenCV's distortion vector; `ValueError` for its thin prism and tilted sensor."""
    values = np.ravel(np.asarray(coefficients, float))
    if np.any(values[len(_OPENCV_ORDER) :]):
        raise ValueError("a thin prism or tilted sensor is not supported")
    return _lens(dict(zip(_OPENCV_ORDER, values.tolist(), strict=False)))


def _size(value: Any) -> tuple[int, int]:
    width, height = (round(float(number)) for number in np.ravel(value))
    if min(width, height) < 1:
        raise ValueError(f"image size {width} x {height}")
    return width, height


def _pair(value: Any) -> tuple[float, float]:
    values = np.ravel(np.asarray(value, float))
    return float(values[0]), float(values[-1])


def _matrix(values: Any) -> tuple[float, float, float, float]:
    """Focal lengths and principal point of a camera matrix ``(3, 3)``; `ValueError` for skew."""
    matrix = np.asarray(values, float).reshape(3, 3)
    if abs(matrix[0, 1]) > _LARGEST_SKEW * abs(matrix[0, 0]):
        raise ValueError(f"skew {matrix[0, 1]:g} is not supported")
    return matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]


def _plain_json(path: Path) -> list[CameraModel]:
    table = read_json(path)
    known = {"size_px", "focal_px", "K", "principal_point_px", "distortion", "name"}
    known |= {
        "heading_deg",
        "pitch_deg",
        "roll_deg",
        "R_world_to_camera",
        "xyz",
        "latitude_deg",
        "longitude_deg",
        "height_m",
    }
    unknown = sorted(set(table) - known)
    if unknown:
        raise InputError(path, "unknown keys", got=", ".join(unknown), expected=", ".join(sorted(known)))
    size = _size(table["size_px"])
    if "K" in table:
        fx, fy, cx, cy = _matrix(table["K"])
    else:
        fx, fy = _pair(table["focal_px"])
        cx, cy = _pair(table.get("principal_point_px", (0.5 * size[0], 0.5 * size[1])))
    rotation = position = None
    if "R_world_to_camera" in table:
        rotation = np.asarray(table["R_world_to_camera"], float).T
    elif "heading_deg" in table:
        angles = (float(table.get(key, 0.0)) for key in ("heading_deg", "pitch_deg", "roll_deg"))
        rotation = rotation_from_angles(*angles)
    geographic = "latitude_deg" in table
    if geographic:
        position = np.array([table["longitude_deg"], table["latitude_deg"], table["height_m"]], float)
    elif "xyz" in table:
        position = np.asarray(table["xyz"], float).reshape(3)
    lens = _lens(table.get("distortion", {}))
    return [CameraModel(size, fx, fy, cx, cy, lens, rotation, position, geographic, str(table.get("name", "")))]


def _opencv(path: Path) -> list[CameraModel]:
    values = _opencv_values(path)
    matrix = values.get("camera_matrix", values.get("cameraMatrix", values.get("K")))
    if matrix is None:
        raise KeyError("camera_matrix")
    fx, fy, cx, cy = _matrix(matrix)
    lens = _opencv_lens(next((values[key] for key in _OPENCV_LENS_KEYS if key in values), []))
    width, height = (values.get(key) for key in ("image_width", "image_height"))
    size = None if width is None or height is None else _size((width, height))
    rotation = position = None
    if "rvec" in values and "tvec" in values:
        rotation = cv2.Rodrigues(np.asarray(values["rvec"], float).reshape(3, 1))[0].T
        position = -rotation @ np.asarray(values["tvec"], float).reshape(3)
    return [CameraModel(size, fx, fy, cx + 0.5, cy + 0.5, lens, rotation, position)]


_OPENCV_LENS_KEYS = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "distortion", "D")


def _opencv_values(path: Path) -> dict[str, Any]:
    """The numbers and matrices of a file of OpenCV's: YAML, XML, or JSON of plain lists."""
    text = text_files.read_text(path)
    if path.suffix.lower() == ".json" and '"opencv-matrix"' not in text:
        return dict(read_json(path))
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        raise InputError(path, f"not a file of OpenCV: {error}") from None
    root = storage.root()
    found: dict[str, Any] = {}
    for key in root.keys() if root.isMap() else ():
        node = root.getNode(key)
        if node.isReal() or node.isInt():
            found[key] = node.real()
        elif node.isSeq():
            found[key] = [node.at(index).real() for index in range(node.size())]
        elif node.isMap() and (matrix := node.mat()) is not None:
            found[key] = matrix
    storage.release()
    return found


def _glimpse(path: Path) -> list[CameraModel]:
    table = read_json(path)
    size = _size(table.get("imgsz", table.get("size")))
    if "fmm" in table:
        unit = np.array(size) / np.array(_pair(table["sensorsz"]))
        focal, centre = np.array(_pair(table["fmm"])) * unit, np.array(_pair(table.get("cmm", (0.0, 0.0)))) * unit
    else:
        focal, centre = np.array(_pair(table["f"])), np.array(_pair(table.get("c", (0.0, 0.0))))
    centre = centre + 0.5 * np.array(size)
    yaw, pitch, roll = (float(angle) for angle in np.asarray(table["viewdir"], float).reshape(3))
    position = np.asarray(table["xyz"], float).reshape(3)
    lens = _radial_tangential(table.get("k", []), table.get("p", []))
    (fx, fy), (cx, cy) = _pair(focal), _pair(centre)
    return [CameraModel(size, fx, fy, cx, cy, lens, rotation_from_angles(yaw, pitch, roll), position)]


def _radial_tangential(k: Sequence[float], p: Sequence[float]) -> Lens:
    radial = {f"k{index + 1}": value for index, value in enumerate(np.ravel(k).tolist()[:6])}
    return _lens(radial | {f"p{index + 1}": value for index, value in enumerate(np.ravel(p).tolist()[:2])})


def _imgraft(path: Path) -> list[CameraModel]:
    table = _imgraft_values(path)
    rows, columns = _size(table["imgsz"])
    fx, fy = _pair(table["f"])
    centre = table.get("c")
    cx, cy = _pair(((columns + 1) / 2.0, (rows + 1) / 2.0) if centre is None or not len(centre) else centre)
    lens = _radial_tangential(table.get("k", []), table.get("p", []))
    if lens.p1 or lens.p2:
        problem = "its tangential terms p are not Brown's"
        raise InputError(path, problem, expected="p = 0", cure="fit the camera again with k alone")
    rotation = _imgraft_rotation(np.asarray(table["viewdir"], float).reshape(3))
    position = np.asarray(table["xyz"], float).reshape(3)
    return [CameraModel((columns, rows), fx, fy, cx - 0.5, cy - 0.5, lens, rotation, position)]


def _imgraft_values(path: Path) -> dict[str, Any]:
    """Values of a camera by name: JSON, or a ``.mat`` file of a struct or of the 20 numbers of ``fullmodel``."""
    if path.suffix.lower() == ".json":
        return read_json(path)
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        variables = loadmat(str(path), simplify_cells=True)
    except FileNotFoundError:
        raise InputError(path, "no such file") from None
    except (MatReadError, NotImplementedError, ValueError) as error:
        raise InputError(
            path, f"not a file of MATLAB that can be read: {error}", cure="save -v7 of cam.fullmodel"
        ) from None
    for name, value in variables.items():
        if name.startswith("__"):
            continue
        if isinstance(value, dict) and "viewdir" in value:
            return value
        if isinstance(value, np.ndarray) and value.size == 20 and value.dtype.kind == "f":
            v = value.ravel()
            return {
                "xyz": v[:3],
                "imgsz": v[3:5],
                "viewdir": v[5:8],
                "f": v[8:10],
                "c": v[10:12],
                "k": v[12:18],
                "p": v[18:],
            }
    raise InputError(path, "holds no camera", expected="cam.fullmodel (20 numbers), or a struct with viewdir")


def _imgraft_rotation(viewdir: np.ndarray) -> np.ndarray:
    """World from camera of yaw (from the x axis, anticlockwise), pitch (downwards) and roll [rad]."""
    yaw, pitch, roll = np.degrees(viewdir)
    return rotation_from_angles(90.0 - yaw, -pitch, roll)


def _pytrx(path: Path) -> list[CameraModel]:
    """A calibration of PyTrx, or a camera environment, whose calibration lies beside it or under its own path."""
    text = text_files.read_text(path)
    rotation = position = None
    calibration = text
    if "Camera_location" in text:
        position = _pytrx_numbers(text, "Camera_location", 3, path)
        angles = _pytrx_numbers(text, "Yaw_pitch_roll", 3, path)
        rotation = _imgraft_rotation(angles) if np.any(angles) else None
        calibration = text_files.read_text(_pytrx_calibration(text, path))
    k = _pytrx_numbers(calibration, "RadialDistortion", None, path)
    p = _pytrx_numbers(calibration, "TangentialDistortion", None, path)
    fx, fy, cx, cy = _matrix(_pytrx_numbers(calibration, "IntrinsicMatrix", 9, path).reshape(3, 3).T)
    lens = _radial_tangential(k.tolist(), p.tolist())
    return [CameraModel(None, fx, fy, cx - 0.5, cy - 0.5, lens, rotation, position)]


def _pytrx_calibration(text: str, path: Path) -> Path:
    """The first calibration that an environment names: its file name in the environment's folder or one beside it."""
    match = re.search(r"^Calibration_path[^\n]*\n\s*\[?([^\],\n]+)", text, re.MULTILINE)
    if match is None:
        raise KeyError("Calibration_path")
    name = re.split(r"[\\/]", match[1].strip())[-1]
    for folder in (path.parent, path.parent / "calib", path.parent.parent / "calib"):
        if (folder / name).is_file():
            return folder / name
    raise InputError(path, "its calibration is not there", got=name, cure=f"put {name} beside it")


def _pytrx_numbers(text: str, key: str, count: int | None, path: Path) -> np.ndarray:
    """The numbers in brackets that follow a key, over as many lines as they take."""
    match = re.search(rf"^{key}\b[^\n]*\n((?:\s*\[[^\]]*\])+)", text, re.MULTILINE)
    if match is None:
        raise KeyError(key)
    numbers = np.array([float(each) for each in re.findall(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?", match[1])])
    if count is not None and len(numbers) != count:
        raise InputError(path, f"{key} has {len(numbers)} numbers", expected=str(count))
    return numbers


def _colmap(folder: Path) -> list[CameraModel]:
    binary = (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file()
    cameras = dict(_colmap_cameras_binary(folder) if binary else _colmap_cameras_text(folder))
    from scipy.spatial.transform import Rotation

    models = []
    for name, number, quaternion, translation in (
        _colmap_images_binary(folder) if binary else _colmap_images_text(folder)
    ):
        if number not in cameras:
            raise InputError(folder, f"image {name} has an unknown camera", got=number)
        w, x, y, z = quaternion
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix().T
        models.append(replace(cameras[number], rotation=rotation, position=-rotation @ translation, name=name))
    return models


def _colmap_camera(model: str, numbers: Sequence[float], where: str) -> CameraModel:
    """A camera of a COLMAP model: width, height and parameters."""
    if model not in _COLMAP:
        cure = "undistort the images first (colmap image_undistorter)"
        raise InputError(where, f"camera model {model} is not Brown's", expected=", ".join(_COLMAP), cure=cure)
    focals, names = _COLMAP[model]
    count = focals + 2 + len(names)
    if len(numbers) != 2 + count:
        raise InputError(where, f"wrong number of {model} parameters", got=len(numbers) - 2, expected=str(count))
    size, values = _size(numbers[:2]), list(numbers[2:])
    fx, fy = values[0], values[focals - 1]
    cx, cy = values[focals : focals + 2]
    return CameraModel(size, fx, fy, cx, cy, _lens(dict(zip(names, values[focals + 2 :], strict=True))))


def _colmap_cameras_text(folder: Path) -> Iterator[tuple[int, CameraModel]]:
    path = folder / "cameras.txt"
    for number, line in enumerate(text_files.read_text(path).splitlines(), 1):
        fields = line.split()
        if fields and not line.startswith("#"):
            where = f"{path}: line {number}"
            yield int(fields[0]), _colmap_camera(fields[1], [float(field) for field in fields[2:]], where)


def _colmap_images_text(folder: Path) -> Iterator[tuple[str, int, list[float], np.ndarray]]:
    lines = [line for line in text_files.read_text(folder / "images.txt").splitlines() if not line.startswith("#")]
    # Every second line lists 2-D points and may be blank.
    for line in lines[::2]:
        if line.strip():
            _, *numbers, camera, name = line.split(maxsplit=9)
            values = [float(number) for number in numbers]
            yield name, int(camera), values[:4], np.array(values[4:7])


def _unpacked(file: BinaryIO, layout: str) -> tuple[Any, ...]:
    size = struct.calcsize("<" + layout)
    data = file.read(size)
    if len(data) != size:
        raise ValueError("the file ends early")
    return struct.unpack("<" + layout, data)


def _colmap_cameras_binary(folder: Path) -> Iterator[tuple[int, CameraModel]]:
    with open(folder / "cameras.bin", "rb") as file:
        for _ in range(_unpacked(file, "Q")[0]):
            number, model, width, height = _unpacked(file, "iiQQ")
            name = _COLMAP_NUMBERS[model] if 0 <= model < len(_COLMAP_NUMBERS) else f"number {model}"
            where = str(folder / "cameras.bin")
            if name not in _COLMAP:
                _colmap_camera(name, [], where)
            focals, names = _COLMAP[name]
            values = _unpacked(file, f"{focals + 2 + len(names)}d")
            yield number, _colmap_camera(name, [width, height, *values], where)


def _colmap_images_binary(folder: Path) -> Iterator[tuple[str, int, list[float], np.ndarray]]:
    with open(folder / "images.bin", "rb") as file:
        for _ in range(_unpacked(file, "Q")[0]):
            _, *values, camera = _unpacked(file, "i7di")
            name = b""
            while (character := _unpacked(file, "c")[0]) != b"\0":
                name += character
            file.seek(24 * _unpacked(file, "Q")[0], 1)
            yield name.decode("utf-8"), camera, list(values[:4]), np.array(values[4:7])


_READERS: dict[ModelFormat, Callable[[Path], list[CameraModel]]] = {
    "json": _plain_json,
    "opencv": _opencv,
    "colmap": _colmap,
    "glimpse": _glimpse,
    "imgraft": _imgraft,
    "pytrx": _pytrx,
}
