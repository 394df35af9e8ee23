"""Cameras of other programs see known points where those programs' own formulas put them."""

import json
import struct

import cv2
import numpy as np
import pytest
from pyproj import Transformer

from seasonscapes.cameras.camera_models import read_camera_model
from seasonscapes.cameras.lens import Lens, distort, undistort
from seasonscapes.cameras.pinhole import Camera, project
from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame, enu_from_geodetic, geodetic_from_enu, local_axes
from seasonscapes.terrain.geoid import geoid_of
from seasonscapes.terrain.surface import Raster
from seasonscapes.workflows.camera_import import ModelSource, station_of_model
from seasonscapes.workflows.webcam_calibration import WebcamStation

CRS = "EPSG:32606"
XYZ = np.array([499211.0, 6783755.99, 479.0])
SIZE = (968, 648)
K = [-0.108, 0.087, 0.01, 0.002, -0.001, 0.0005]
P = [-0.0007, 0.0014]
# A map's metres are 0.04 % longer here than those of heights, which its programs do not know: 0.2 px at the picture's rim.
TOLERANCE_PX = 0.2


def station(datum="ellipsoidal", size=SIZE) -> WebcamStation:
    """A webcam about 40 m from the model's camera, whose stated angles are of no use."""
    from affine import Affine

    from seasonscapes.cameras.webcam import Webcam, webcam_model

    longitude, latitude = Transformer.from_crs(CRS, 4326, always_xy=True).transform(*(XYZ[:2] + 30.0))
    webcam = Webcam(
        id="A",
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=470.0,
        projection="perspective",
        width_px=size[0],
        height_px=size[1],
        horizontal_fov_deg=50.0,
        heading_deg=10.0,
        time_zone="UTC",
    )
    frame = LocalFrame(latitude, longitude, 0.0, 0.13)
    view = webcam_model(webcam, frame)
    heights = Raster(np.full((4, 4, 1), 100.0, np.float32), Affine(500.0, 0, 498000.0, 0, -500.0, 6784500.0), CRS)
    axes = local_axes(frame, latitude, longitude)
    return WebcamStation(webcam, view, frame, axes, [heights], vertical_datum=datum)


def map_points(rotation: np.ndarray, count=40) -> np.ndarray:
    """Points ``(N, 3)`` of the map within 150 m before a camera with rows right, down, forward in map axes."""
    rng = np.random.default_rng(3)
    local = np.column_stack([rng.uniform(-0.4, 0.4, count), rng.uniform(-0.25, 0.25, count), np.ones(count)])
    return XYZ + (local * rng.uniform(60.0, 150.0, (count, 1))) @ rotation


def normalised(points, rotation):
    local = (points - XYZ) @ rotation.T
    return local[:, :2] / local[:, 2:]


def seen(found: WebcamStation, points: np.ndarray, shift_m: float = 0.0) -> np.ndarray:
    """Pixels of points of the map, through the local frame of the station and the lens."""
    longitude, latitude = Transformer.from_crs(CRS, 4326, always_xy=True).transform(points[:, 0], points[:, 1])
    position = enu_from_geodetic(found.frame, latitude, longitude, points[:, 2] + shift_m)
    assert isinstance(found.view, Camera)
    return distort(project(found.view, position)[0], found.view, found.lens)


def brown(xy):
    return Lens(**{f"k{i + 1}": k for i, k in enumerate(K)}, p1=P[0], p2=P[1]).distorted(xy)


def glimpse_rotation(viewdir):
    """The camera rotation of glimpse (`Camera.R`), as its source states it."""
    c, s = np.cos(np.radians(viewdir)), np.sin(np.radians(viewdir))
    return np.array(
        [
            [c[0] * c[2] + s[0] * s[1] * s[2], c[0] * s[1] * s[2] - c[2] * s[0], -c[1] * s[2]],
            [c[2] * s[0] * s[1] - c[0] * s[2], s[0] * s[2] + c[0] * c[2] * s[1], -c[1] * c[2]],
            [c[1] * s[0], c[0] * c[1], s[1]],
        ]
    )


def imgraft_rotation(viewdir):
    """The camera rotation of ImGRAFT (`camera.m`) and PyTrx (`getRotation`), as their sources state it."""
    c, s = np.cos(viewdir), np.sin(viewdir)
    rows = np.array(
        [
            [s[2] * s[1] * c[0] - c[2] * s[0], s[2] * s[1] * s[0] + c[2] * c[0], s[2] * c[1]],
            [c[2] * s[1] * c[0] + s[2] * s[0], c[2] * s[1] * s[0] - s[2] * c[0], c[2] * c[1]],
            [c[1] * c[0], c[1] * s[0], -s[1]],
        ]
    )
    rows[:2] = -rows[:2]
    return rows


def test_the_lens_is_opencvs_and_its_inverse_is_exact():
    camera = Camera(1000, 700, 900.0, 910.0, 480.0, 360.0, np.eye(4))
    lens = Lens(*K, *P)
    pixel = np.random.default_rng(0).uniform([0, 0], [1000, 700], (300, 2))
    rays = np.column_stack([(pixel - [480.0, 360.0]) / [900.0, 910.0], np.ones(300)])
    matrix = np.array([[900.0, 0, 480.0], [0, 910.0, 360.0], [0, 0, 1]])
    drawn, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, lens.opencv)
    assert np.abs(distort(pixel, camera, lens) - drawn[:, 0]).max() < 1e-9
    assert np.abs(undistort(drawn[:, 0], camera, lens) - pixel).max() < 1e-9


def test_a_lens_is_undefined_beyond_its_fold():
    camera = Camera(1000, 700, 300.0, 300.0, 500.0, 350.0, np.eye(4))
    lens = Lens(k1=-0.3, k2=0.01)
    assert np.isfinite(distort([[500.0 + 0.99 * lens.fold * 300.0, 350.0]], camera, lens)).all()
    assert np.isnan(distort([[500.0 + 1.01 * lens.fold * 300.0, 350.0]], camera, lens)).all()


def test_glimpse(tmp_path):
    viewdir, sensor, focal, centre = [-149.24, -9.127, -3.175], [23.6, 15.8], [20.494, 20.492], [0.0151, -0.058]
    table = {"xyz": XYZ.tolist(), "viewdir": viewdir, "fmm": focal, "cmm": centre, "k": K, "p": P}
    (tmp_path / "c.json").write_text(json.dumps({**table, "sensorsz": sensor, "imgsz": SIZE}))
    found = station_of_model(station(), ModelSource(tmp_path / "c.json", crs=CRS))
    rotation = glimpse_rotation(np.array(viewdir))
    points = map_points(rotation)
    unit = np.array(SIZE) / sensor
    expected = brown(normalised(points, rotation)) * (focal * unit) + centre * unit + 0.5 * np.array(SIZE)
    assert np.abs(seen(found, points) - expected).max() < TOLERANCE_PX
    assert found.pose_is_known


def test_heights_above_the_ellipsoid_become_the_scenes(tmp_path):
    table = {
        "xyz": XYZ.tolist(),
        "viewdir": [10.0, 0.0, 0.0],
        "f": [900, 900],
        "imgsz": SIZE,
        "fmm": [20],
        "sensorsz": [23, 15],
    }
    (tmp_path / "c.json").write_text(json.dumps(table))
    found = station_of_model(station("EGM96"), ModelSource(tmp_path / "c.json", crs=CRS, ellipsoidal=True))
    latitude, longitude, height = (float(v) for v in geodetic_from_enu(found.frame, found.view.position_m))
    undulation = geoid_of("EGM96", latitude, longitude).undulation_m(np.array(latitude), np.array(longitude))
    assert 5.0 < float(undulation) < 25.0  # Gulf of Alaska
    assert height == pytest.approx(XYZ[2] - float(undulation), abs=1e-3)


@pytest.mark.parametrize("form", ["json", "struct", "fullmodel"])
def test_imgraft(tmp_path, form):
    from scipy.io import savemat

    viewdir, focal, centre = np.array([4.73, 0.0925, 0.139]), [900.0, 905.0], [480.0, 330.0]
    values = {
        "xyz": XYZ,
        "imgsz": np.array(SIZE[::-1], float),
        "viewdir": viewdir,
        "f": focal,
        "c": centre,
        "k": K,
        "p": [0.0, 0.0],
    }
    path = tmp_path / ("c.json" if form == "json" else "c.mat")
    if form == "json":
        path.write_text(json.dumps({key: np.asarray(value).tolist() for key, value in values.items()}))
    elif form == "struct":
        savemat(path, {"cam": values})
    else:
        savemat(path, {"m": np.concatenate([np.asarray(value, float) for value in values.values()])})
    found = station_of_model(station(), ModelSource(path, kind="imgraft", crs=CRS))
    rotation = imgraft_rotation(viewdir)
    points = map_points(rotation)
    lens = Lens(*K)
    expected = lens.distorted(normalised(points, rotation)) * focal + centre - 0.5  # MATLAB counts from 1
    assert np.abs(seen(found, points) - expected).max() < TOLERANCE_PX


def test_imgrafts_own_tangential_terms_are_refused(tmp_path):
    table = {"xyz": [0, 0, 0], "imgsz": [10, 10], "viewdir": [0, 0, 0], "f": [9], "p": [0.01, 0.0]}
    (tmp_path / "c.json").write_text(json.dumps(table))
    with pytest.raises(InputError, match="not Brown's"):
        read_camera_model(tmp_path / "c.json", "imgraft")
    with pytest.raises(InputError, match="glimpse's or ImGRAFT's"):
        read_camera_model(tmp_path / "c.json")


def test_pytrx(tmp_path):
    (tmp_path / "calib.txt").write_text(
        "RadialDistortion\n[-0.132 0.094 -0.015]   \nTangentialDistortion\n[8.37e-04  1.03e-04]\nIntrinsicMatrix\n"
        "[9.0e+02 0. 0.]\n[-0.15 9.05e+02 0.]\n[4.8e+02 3.3e+02 1.]\nEnd"
    )
    (tmp_path / "env.txt").write_text(
        "Camera_environment_name # Name\nKR1\n\nCalibration_path #Path\n[..\\calib\\calib.txt,..\\calib\\other.txt] \n\n"
        f"Camera_location #xyz\n[{XYZ[0]} {XYZ[1]} {XYZ[2]}]\n\nYaw_pitch_roll # of camera\n[4.73 0.0925 0.139] \n"
    )
    found = station_of_model(station(), ModelSource(tmp_path / "env.txt", crs=CRS))
    rotation = imgraft_rotation(np.array([4.73, 0.0925, 0.139]))
    points = map_points(rotation)
    lens = Lens(k1=-0.132, k2=0.094, k3=-0.015, p1=8.37e-4, p2=1.03e-4)
    expected = lens.distorted(normalised(points, rotation)) * [900.0, 905.0] + [480.0 - 0.5, 330.0 - 0.5]
    assert np.abs(seen(found, points) - expected).max() < TOLERANCE_PX
    intrinsics = read_camera_model(tmp_path / "calib.txt")
    assert intrinsics.rotation is None
    assert intrinsics.lens == lens


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_opencv(tmp_path, suffix):
    rotation = glimpse_rotation(np.array([40.0, -5.0, 2.0]))
    matrix = np.array([[900.0, 0, 479.5], [0, 905.0, 329.5], [0, 0, 1]])
    coefficients = np.array([K[0], K[1], P[0], P[1], K[2], K[3], K[4], K[5]])
    rvec, tvec = cv2.Rodrigues(rotation)[0], -rotation @ XYZ
    path = tmp_path / f"c.{suffix}"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", SIZE[0])
    file.write("image_height", SIZE[1])
    for name, value in (
        ("camera_matrix", matrix),
        ("distortion_coefficients", coefficients),
        ("rvec", rvec),
        ("tvec", tvec),
    ):
        file.write(name, value)
    file.release()
    found = station_of_model(station(), ModelSource(path, crs=CRS))
    points = map_points(rotation)
    drawn, _ = cv2.projectPoints(points - XYZ, rvec, np.zeros(3), matrix, coefficients)
    assert np.abs(seen(found, points) - (drawn[:, 0] + 0.5)).max() < TOLERANCE_PX


COLMAP = {
    "SIMPLE_PINHOLE": (0, [900.0, 480.0, 330.0], Lens()),
    "PINHOLE": (1, [900.0, 905.0, 480.0, 330.0], Lens()),
    "SIMPLE_RADIAL": (2, [900.0, 480.0, 330.0, K[0]], Lens(k1=K[0])),
    "RADIAL": (3, [900.0, 480.0, 330.0, *K[:2]], Lens(k1=K[0], k2=K[1])),
    "OPENCV": (4, [900.0, 905.0, 480.0, 330.0, *K[:2], *P], Lens(k1=K[0], k2=K[1], p1=P[0], p2=P[1])),
    "FULL_OPENCV": (6, [900.0, 905.0, 480.0, 330.0, *K[:2], *P, *K[2:]], Lens(*K, *P)),
}


@pytest.mark.parametrize("model", COLMAP)
@pytest.mark.parametrize("binary", [False, True])
def test_colmap(tmp_path, model, binary):
    from scipy.spatial.transform import Rotation

    number, parameters, lens = COLMAP[model]
    rotation = glimpse_rotation(np.array([40.0, -5.0, 2.0]))
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    pose = [w, x, y, z, *(-rotation @ XYZ)]
    if binary:
        camera = struct.pack("<QiiQQ", 1, 7, number, *SIZE) + struct.pack(f"<{len(parameters)}d", *parameters)
        one = (
            struct.pack("<i7di", 1, *pose, 7) + b"noon.jpg\0" + struct.pack("<Q", 1) + struct.pack("<ddq", 1.0, 2.0, -1)
        )
        other = struct.pack("<i7di", 2, 1.0, *[0.0] * 6, 7) + b"dusk.jpg\0" + struct.pack("<Q", 0)
        (tmp_path / "cameras.bin").write_bytes(camera)
        (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 2) + one + other)
    else:
        (tmp_path / "cameras.txt").write_text(
            f"# ids\n7 {model} {SIZE[0]} {SIZE[1]} {' '.join(map(repr, parameters))}\n"
        )
        numbers = " ".join(repr(float(value)) for value in pose)
        (tmp_path / "images.txt").write_text(
            f"# ids\n1 {numbers} 7 noon.jpg\n\n2 1 0 0 0 0 0 0 7 dusk.jpg\n1.0 2.0 -1\n"
        )
    with pytest.raises(InputError, match="holds 2 views"):
        read_camera_model(tmp_path)
    found = station_of_model(station(), ModelSource(tmp_path, view="noon.jpg", crs=CRS))
    points = map_points(rotation)
    focal = [900.0, 900.0 if parameters[1] == 480.0 else 905.0]
    expected = lens.distorted(normalised(points, rotation)) * focal + [480.0, 330.0]
    assert np.abs(seen(found, points) - expected).max() < TOLERANCE_PX


def test_plain_json_against_true_north(tmp_path):
    table = {
        "size_px": SIZE,
        "focal_px": 900.0,
        "principal_point_px": [500.0, 310.0],
        "heading_deg": 75.0,
        "pitch_deg": -4.0,
    }
    table |= {"latitude_deg": 61.188251, "longitude_deg": -147.014675, "height_m": 479.0, "distortion": {"k1": -0.1}}
    (tmp_path / "c.json").write_text(json.dumps(table))
    found = station_of_model(station(), ModelSource(tmp_path / "c.json"))
    forward = found.axes @ found.view.world_from_camera[:3, 2]
    assert np.degrees(np.arctan2(forward[0], forward[1])) == pytest.approx(75.0, abs=1e-9)
    assert np.degrees(np.arcsin(forward[2])) == pytest.approx(-4.0, abs=1e-9)
    assert (found.view.cx, found.view.cy, found.lens) == (500.0, 310.0, Lens(k1=-0.1))


def test_a_model_of_a_larger_picture_is_scaled_and_of_another_shape_refused(tmp_path, caplog):
    table = {"size_px": [2 * SIZE[0], 2 * SIZE[1]], "focal_px": 1800.0}
    (tmp_path / "c.json").write_text(json.dumps(table))
    found = station_of_model(station(), ModelSource(tmp_path / "c.json"))
    assert (found.view.fx, found.view.cx, found.pose_is_known) == (900.0, 0.5 * SIZE[0], False)
    assert "scaled" in caplog.text
    (tmp_path / "c.json").write_text(json.dumps({"size_px": [1000, 1000], "focal_px": 900.0}))
    with pytest.raises(InputError, match="another shape"):
        station_of_model(station(), ModelSource(tmp_path / "c.json"))


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("c.json", '{"size_px": [10, 10], "focal_px": 9, "tilt": 3}', "unknown keys; got 'tilt'"),
        ("c.json", '{"size_px": [10, 10]}', "key 'focal_px' is missing"),
        ("c.json", '{"size_px": [10, 10], "focal_px": -9}', "focal lengths must be positive"),
        (
            "c.json",
            '{"size_px": [10, 10], "focal_px": 9, "R_world_to_camera": [[1,0,0],[0,1,0],[0,0,-1]], "xyz": [1,2,3]}',
            "no rotation",
        ),
        ("c.json", '{"size_px": [10, 10], "K": [[9, 1, 5], [0, 9, 5], [0, 0, 1]]}', "skew"),
        ("c.yml", "%YAML:1.0\n---\nimage_width: 3\n", "key 'camera_matrix' is missing"),
        ("c.txt", "RadialDistortion\n", "key 'RadialDistortion' is missing"),
        ("c.ini", "", "not a known format"),
        ("c.mat", "text", "not a file of MATLAB"),
    ],
)
def test_files_that_are_no_camera_say_so(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_camera_model(tmp_path / name)


def test_fisheye_models_of_colmap_are_refused_by_name(tmp_path):
    (tmp_path / "cameras.txt").write_text("1 OPENCV_FISHEYE 10 10 9 9 5 5 0 0 0 0\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    with pytest.raises(InputError, match="OPENCV_FISHEYE is not Brown's"):
        read_camera_model(tmp_path)


def test_the_columbia_cameras_put_the_surveyed_skyline_on_the_visible_one(data_dir, tmp_path):
    """Published models and an independent reference skyline: the edge in the picture is met within two pixels."""
    folder = data_dir / "columbia-glacier"
    if not folder.is_dir():
        pytest.skip("columbia-glacier is not there")
    table = {entry["file"]: entry for entry in json.loads((folder / "pictures.json").read_text())}
    for name in ("AK10b_20121012_160709", "AKJNC_20120813_223326", "AK01b_20131106_192014"):
        entry = table[f"pictures/{name}.jpg"]
        (tmp_path / "c.json").write_text(json.dumps({**entry["camera"], "imgsz": entry["size"]}))
        found = station_of_model(station(size=tuple(entry["size"])), ModelSource(tmp_path / "c.json", crs=CRS))
        offset = skyline_offset_px(found, folder, entry)
        assert abs(offset) <= 2.0, (name, offset)


def skyline_offset_px(found: WebcamStation, folder, entry) -> float:
    """Rows by which the visible skyline lies below the projected reference one (strongest gradient)."""
    from seasonscapes.images import read_image_srgb8

    table = json.loads((folder / f"horizon_{entry['station']}.geojson").read_text())
    lines = [np.array(feature["geometry"]["coordinates"]) for feature in table["features"]]
    longitude, latitude, height = np.concatenate(lines).T
    position = enu_from_geodetic(found.frame, latitude, longitude, height)
    assert isinstance(found.view, Camera)
    pixel = distort(project(found.view, position)[0], found.view, found.lens)
    pixel = pixel[np.isfinite(pixel).all(1)]
    width, rows_px = entry["size"]
    inside = (pixel[:, 0] > 5) & (pixel[:, 0] < width - 5) & (pixel[:, 1] > 25) & (pixel[:, 1] < rows_px - 25)
    columns, rows = np.floor(pixel[inside]).astype(int).T
    assert len(rows) > 50
    grey = cv2.cvtColor(read_image_srgb8(folder / entry["file"]), cv2.COLOR_RGB2GRAY).astype(float)
    slope = np.abs(np.gradient(cv2.GaussianBlur(grey, (0, 0), 1.0), axis=0))
    offsets = np.arange(-20, 21)
    strength = [np.mean(np.minimum(slope[rows + offset, columns], 20.0)) for offset in offsets]
    return float(offsets[int(np.argmax(strength))])
