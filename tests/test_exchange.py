"""Cameras to other programs and back; the reference repository's stretched poses made metric."""

import json
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest

from seasonscapes.cameras.camera_models import read_camera_models
from seasonscapes.cameras.exchange import (
    NamedView,
    camera_from_opencv,
    opencv_from_camera,
    read_opencv,
    read_transforms,
    write_colmap,
    write_opencv,
    write_transforms,
)
from seasonscapes.cameras.lens import distort
from seasonscapes.cameras.pinhole import Camera, project, ray_directions, rotation_from_angles
from seasonscapes.cameras.reference_poses import (
    geodetic_of_translation,
    grid_from_metric,
    metric_from_grid,
    read_reference_matches,
    read_reference_poses,
    reference_records,
    steps_per_metre,
)
from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame, geodetic_from_enu

FRAME = LocalFrame(46.6, 8.0, 1500.0, 0.13)
BERNESE = Path(__file__).parents[1] / "scenes" / "bernese_highlands.toml"


def some_views(count=6):
    rng = np.random.default_rng(7)
    views = []
    for i in range(count):
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_angles(rng.uniform(0, 360), rng.uniform(-30, 30), rng.uniform(-179, 179))
        pose[:3, 3] = rng.uniform(-2e4, 2e4, 3)
        camera = Camera(1536 + i, 1024, *rng.uniform(800, 2500, 2), *rng.uniform(400, 900, 2), pose)
        views.append(NamedView(f"v{i}", camera, f"images/v{i}.jpg", datetime(2024, 5, 12, 10, i, tzinfo=UTC)))
    return views


def same(a: Camera, b: Camera, tolerance=1e-9):
    assert (a.width_px, a.height_px) == (b.width_px, b.height_px)
    assert np.allclose([a.fx, a.fy, a.cx, a.cy], [b.fx, b.fy, b.cx, b.cy], rtol=0, atol=1e-9)
    assert np.abs(a.world_from_camera[:3, :3] - b.world_from_camera[:3, :3]).max() < tolerance
    assert np.abs(a.position_m - b.position_m).max() < 1e-6


def test_colmap_and_nerfstudio_come_back(tmp_path):
    views = some_views()
    write_colmap(tmp_path / "sparse", views)
    write_transforms(tmp_path / "transforms.json", views, FRAME)
    back, frame = read_transforms(tmp_path / "transforms.json")
    assert frame == FRAME
    for view, colmap, nerf in zip(views, read_camera_models(tmp_path / "sparse", "colmap"), back, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = colmap.rotation, colmap.position
        same(view.camera, Camera(*colmap.size_px, colmap.fx, colmap.fy, colmap.cx, colmap.cy, pose))
        same(view.camera, nerf.camera)
        assert colmap.name == view.file
        assert (nerf.name, nerf.file, nerf.time) == (view.name, view.file, view.time)


def test_colmap_text_means_what_its_manual_says(tmp_path):
    """Project a point by hand from the file's own numbers: quaternion, translation, PINHOLE."""
    view = some_views(1)[0]
    write_colmap(tmp_path, [view])
    w, x, y, z, *t = (float(v) for v in (tmp_path / "images.txt").read_text().splitlines()[1].split()[1:8])
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    fx, fy, cx, cy = (float(v) for v in (tmp_path / "cameras.txt").read_text().splitlines()[1].split()[4:])
    point = view.camera.position_m + 500.0 * ray_directions(view.camera, [[300.0, 200.0]])[0]
    local = rotation @ point + t
    assert (fx * local[0] / local[2] + cx, fy * local[1] / local[2] + cy) == pytest.approx((300.0, 200.0), abs=1e-6)


def test_nerfstudio_axes_are_opengl(tmp_path):
    view = some_views(1)[0]
    write_transforms(tmp_path / "t.json", [view], FRAME)
    matrix = np.array(json.loads((tmp_path / "t.json").read_text())["frames"][0]["transform_matrix"])
    assert np.allclose(-matrix[:3, 2], ray_directions(view.camera, [[view.camera.cx, view.camera.cy]])[0])


def test_opencv_projects_the_same_points_with_distortion(tmp_path):
    view = some_views(1)[0].camera
    pixel = np.random.default_rng(0).uniform([0, 0], [1536, 1024], (50, 2))
    points = view.position_m + 700.0 * ray_directions(view, pixel)
    matrix, distortion, rvec, tvec = opencv_from_camera(view, -0.05)
    drawn, _ = cv2.projectPoints(points, rvec, tvec, matrix, distortion)
    # Pixel centres: integer in OpenCV, +0.5 here.
    assert np.abs(drawn[:, 0] + 0.5 - distort(project(view, points)[0], view, -0.05)).max() < 1e-6
    write_opencv(tmp_path / "c.json", view, -0.05)
    again, k1 = read_opencv(tmp_path / "c.json")
    same(view, again)
    assert k1 == -0.05
    with pytest.raises(ValueError, match="only k1"):
        camera_from_opencv((8, 8), matrix, [0.1, 0.2, 0, 0, 0], rvec, tvec)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("transforms.json", '{"frames": [{"file_path": "a"}]}', r"frames\[0\]: key 'fl_x' is missing"),
        (
            "transforms.json",
            '{"fl_x": 1, "cx": 1, "cy": 1, "w": 2, "h": 2, "k1": 0.1, "frames": [{"file_path": "a", '
            '"transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}',
            "distortion k1 is not zero",
        ),
        ("transforms.json", "[]", "not a JSON object"),
        ("transforms.json", "{", "not valid JSON"),
    ],
)
def test_foreign_files_that_do_not_fit_say_so(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_transforms(tmp_path / name)


def test_stretching_and_back_is_the_identity_and_the_steps_are_those_measured():
    steps = 1.0 / steps_per_metre(46.6)
    # 50.02 km and 57.44 km over the area of interest, at its middle latitude on the ellipsoid.
    assert steps == pytest.approx([59.84, 41.25, 60.0], abs=0.02)
    rng = np.random.default_rng(1)
    for _ in range(50):
        k = np.array(
            [
                [rng.uniform(800, 2500), rng.uniform(-9, 9), rng.uniform(1000, 2000)],
                [0.0, rng.uniform(800, 2500), rng.uniform(800, 1200)],
                [0.0, 0.0, 1.0],
            ]
        )
        rotation = rotation_from_angles(rng.uniform(0, 360), rng.uniform(-30, 30), rng.uniform(-9, 9))
        k2, rotation2 = metric_from_grid(*grid_from_metric(k, rotation, 46.6), 46.6)
        assert np.abs(k2 - k).max() < 1e-8
        assert np.abs(rotation2 - rotation).max() < 1e-12


def test_an_unstretched_camera_sees_the_same_pixels():
    """Project a point in the grid with the grid's camera, and in metres with the metric one."""
    k = np.array([[860.0, 0.0, 1536.0], [0.0, 1500.0, 1024.0], [0.0, 0.0, 1.0]])
    grid_from_camera = rotation_from_angles(120.0, -3.0, 2.0)
    k2, metric = metric_from_grid(k, grid_from_camera, 46.6)
    offset_m = np.random.default_rng(3).uniform(-5000, 5000, (40, 3))
    in_grid = (offset_m * steps_per_metre(46.6)) @ grid_from_camera @ k.T
    in_metres = offset_m @ metric @ k2.T
    ahead = in_grid[:, 2] > 0
    assert ahead.any()
    assert np.abs(in_grid[ahead, :2] / in_grid[ahead, 2:] - in_metres[ahead, :2] / in_metres[ahead, 2:]).max() < 1e-6


def poses(data_dir, name):
    return data_dir / "seasonscapes-config" / "transformation_matrices" / name


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "count", "kind"),
    [
        ("Rshot/transformation_Roundshot_flat.json", 138, "unrefined"),
        ("Rshot/transformation_final_v4_flat.json", 138, "refined"),
        ("Rshot/transformation_manCorr_flat.json", 112, "refined"),
        ("GRIND/transforms_novelLaubH_wayp_3_all.json", 40, "refined"),
        ("REGION_J/transforms_novelLaubH_wayp_video_pix.json", 6, "refined"),
    ],
)
def test_the_reference_files_come_in_and_go_back(data_dir, name, count, kind):
    views = read_reference_poses(poses(data_dir, name), FRAME, kind=kind)
    assert len(views) == count
    records, original = reference_records(views, FRAME, kind=kind), json.loads(poses(data_dir, name).read_text())
    for view in views:
        was, now = original[view.name], records[view.name]
        assert np.abs(np.array([was[k] - now[k] for k in ("fx", "fy", "cx", "cy")])).max() < 1e-6
        place = geodetic_of_translation(np.array(was["transform_matrix"])[:3, 3])
        assert np.abs(np.array(now["transform_matrix"])[:3, 3] - np.array(place)[[1, 0, 2]]).max() < 1e-6
        u, _, vt = np.linalg.svd(np.array(was["transform_matrix"])[:3, :3])
        assert np.abs(np.array(now["transform_matrix"])[:3, :3] - u @ vt).max() < 1e-6
        latitude, longitude, _ = geodetic_from_enu(FRAME, view.camera.position_m)
        assert 46.3 < latitude < 46.9
        assert 7.5 < longitude < 8.4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transform_matrix": [[1, 0], [0, 1]]}, "not a finite 4 x 4"),
        ({"fx": None}, "not a camera record"),
        ({"transform_matrix": np.diag([2.0, 1.0, 1.0, 1.0]).tolist()}, "not a rotation"),
    ],
)
def test_broken_reference_records_are_named(tmp_path, change, message):
    record = {
        "fx": 1000,
        "fy": 1000,
        "cx": 10,
        "cy": 10,
        "wid": 20,
        "hei": 20,
        "k3 ": 0,
        "surprise": 1,
        "transform_matrix": np.eye(4).tolist(),
    }
    (tmp_path / "p.json").write_text(json.dumps({"meta": {}, "0_1-CAM_0": record}))
    view = read_reference_poses(tmp_path / "p.json", FRAME, kind="unrefined")[0]
    assert (view.webcam, view.index) == ("1-CAM", 0)
    (tmp_path / "p.json").write_text(json.dumps({"0_1-CAM_0": {**record, **change}}))
    with pytest.raises(InputError, match=message):
        read_reference_poses(tmp_path / "p.json", FRAME)


def test_the_reference_picking_tools_matches_come_in(tmp_path):
    (tmp_path / "m.json").write_text(
        json.dumps({"3_1-CAM_0": {"match3D": [[418.0, 696.5, 30.0]], "match2D": [[5, 6]]}})
    )
    pixel, position = read_reference_matches(tmp_path / "m.json", FRAME)["3_1-CAM_0"]
    latitude, longitude, height = geodetic_from_enu(FRAME, position[0])
    assert (latitude, longitude, height) == pytest.approx((46.625, 7.975, 1800.0), abs=1e-6)
    assert pixel.tolist() == [[5.0, 6.0]]
    (tmp_path / "m.json").write_text(json.dumps({"a": {"match3D": [[1, 2, 3]], "match2D": []}}))
    with pytest.raises(InputError, match="1 positions for 0 pixels"):
        read_reference_matches(tmp_path / "m.json", FRAME)
