"""Panoramas against an independent ray formula, and views cut from them against views rendered directly."""

import numpy as np
import pytest

from seasonscapes.cameras.lens import distort, rectify, undistort
from seasonscapes.cameras.panorama import (
    Panorama,
    cut_view,
    panorama_directions,
    panorama_from_angles,
    project_panorama,
    split_panorama,
)
from seasonscapes.cameras.pinhole import Camera, project, ray_directions, rotation_from_angles

CASES = [
    # projection, size, horizontal and vertical field of view, heading, tilt, roll, horizon row
    ("cylindrical", (10771, 2048), 360.0, 62.8, 17.0, 0.0, 0.0, None),
    ("cylindrical", (6901, 2048), 150.0, 42.6, 200.0, 12.0, -3.0, 1100.0),
    ("equirectangular", (9384, 2048), 360.0, 75.9, 301.0, 12.0, 1.5, 1161.0),
    ("equirectangular", (10138, 2048), 200.0, 42.6, 95.0, -5.0, 0.0, 950.0),
]


def make(projection, size, fov_h, fov_v, heading, tilt, roll, row) -> Panorama:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(heading, tilt, roll)
    pose[:3, 3] = [120.0, -40.0, 2000.0]
    return panorama_from_angles(
        projection, size, horizontal_fov_deg=fov_h, vertical_fov_deg=fov_v, pose=pose, horizon_row_px=row
    )


def ray_by_hand(case, column, row):
    """World direction of a panorama pixel by scipy rotations in sequence: none of the package's matrices."""
    from scipy.spatial.transform import Rotation

    projection, (width, height), fov_h, fov_v, heading, tilt, roll, horizon = case
    horizon = height / 2 if horizon is None else horizon
    azimuth = (column / width - 0.5) * fov_h
    if projection == "cylindrical":
        elevation = np.degrees(np.arctan((horizon - row) / (height / 2) * np.tan(np.radians(fov_v / 2))))
    else:
        elevation = (horizon - row) / height * fov_v
    # East-north-up axes: start north, lift by elevation about east, turn clockwise about up: first within the camera …
    ray = Rotation.from_euler("x", elevation, degrees=True).apply([0.0, 1.0, 0.0])
    ray = Rotation.from_euler("z", -azimuth, degrees=True).apply(ray)
    # … then the camera: roll about north (the axis of sight), tilt about east, heading about up.
    for axis, angle in (("y", roll), ("x", tilt), ("z", -heading)):
        ray = Rotation.from_euler(axis, angle, degrees=True).apply(ray)
    return ray


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c[0]}-{c[2]:.0f}")
def test_a_world_point_lands_on_the_same_pixel_through_panorama_and_view(case):
    rng = np.random.default_rng(1)
    panorama = make(*case)
    worst = 0.0
    for camera in split_panorama(panorama, fov_deg=85.0, overlap_deg=8.0):
        pixel = rng.uniform([0, 0], [camera.width_px, camera.height_px], (400, 2))
        point = camera.position_m + ray_directions(camera, pixel) * rng.uniform(50, 3e4, (400, 1))
        in_panorama, _ = project_panorama(panorama, point)
        by_hand = np.array([ray_by_hand(case, column, row) for column, row in in_panorama[:60]])
        again, _ = project(camera, camera.position_m + by_hand)
        worst = max(worst, np.abs(again - pixel[:60]).max())
    assert worst < 1e-5  # px; the issue asks for 0.1


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c[0]}-{c[2]:.0f}")
def test_projection_inverts_directions(case):
    rng = np.random.default_rng(2)
    panorama = make(*case)
    pixel = rng.uniform([0, 0], [panorama.width_px, panorama.height_px], (500, 2))
    again, distance = project_panorama(panorama, panorama.position_m + 777.0 * panorama_directions(panorama, pixel))
    assert np.abs(again - pixel).max() < 1e-6
    assert np.allclose(distance, 777.0)


def test_the_two_models_differ_by_as_much_as_the_reference_gets_wrong():
    """A 62.8° cylinder read as equirectangular misses by 42 px of 2048, measured along the row."""
    truth = make("cylindrical", (10771, 2048), 360.0, 62.8, 0.0, 0.0, 0.0, None)
    wrong = make("equirectangular", (10771, 2048), 360.0, 62.8, 0.0, 0.0, 0.0, None)
    rows = np.stack([np.full(2048, 5385.5), np.arange(2048) + 0.5], -1)
    seen, _ = project_panorama(wrong, truth.position_m + panorama_directions(truth, rows))
    assert 41.0 < np.abs(seen[:, 1] - rows[:, 1]).max() < 43.0


def test_tilt_is_a_rotation_of_rays_and_not_a_shift_of_rows():
    panorama = make("equirectangular", (9384, 2048), 360.0, 75.9, 0.0, 12.0, 0.0, None)
    up = panorama_directions(panorama, np.array([[4692.0, 1024.0], [2346.0, 1024.0], [0.0, 1024.0]]))[:, 2]
    assert np.degrees(np.arcsin(up)) == pytest.approx([12.0, 0.0, -12.0], abs=1e-9)


@pytest.mark.parametrize(
    ("span", "fov", "count"),
    [(360.0, 100.0, 4), (360.0, 85.0, 5), (360.0, 70.0, 6), (150.0, 85.0, 2), (260.0, 90.0, 4)],
)
def test_views_cover_the_panorama_with_the_overlap_asked_for(span, fov, count):
    panorama = make("cylindrical", (round(span * 30), 2048), span, 45.0, 33.0, 0.0, 0.0, None)
    views = split_panorama(panorama, fov_deg=fov, overlap_deg=8.0)
    assert len(views) == count
    columns = np.arange(0.5, panorama.width_px, 3.0)
    point = panorama.position_m + panorama_directions(panorama, np.stack([columns, np.full_like(columns, 1024)], -1))
    seen = np.zeros(len(columns), int)
    for view in views:
        pixel, depth = project(view, point)
        seen += (depth > 0) & (pixel[:, 0] >= 0) & (pixel[:, 0] <= view.width_px)
    assert seen.min() >= 1
    assert (seen >= 2).mean() >= 0.9 * (count if span == 360 else count - 1) * 8.0 / span


def scene_colour(direction):
    """A smooth landscape of waves over all directions; band-limited well below the pixel pitch."""
    x, y, z = np.moveaxis(direction, -1, 0)
    return np.stack(
        [
            0.5 + 0.4 * np.sin(30 * x + 3) * np.cos(20 * y),
            0.4 + 0.3 * np.cos(25 * z + 10 * x),
            0.3 + 0.2 * np.sin(35 * y - 15 * z),
        ],
        -1,
    ).astype(np.float32)


@pytest.mark.parametrize("projection", ["cylindrical", "equirectangular"])
def test_a_cut_view_equals_a_view_rendered_directly(projection):
    panorama = make(projection, (3600, 680), 360.0, 62.8, 40.0, 6.0, -2.0, 360.0)
    image = scene_colour(panorama_directions(panorama))
    for camera in split_panorama(panorama, fov_deg=80.0, overlap_deg=5.0, size_px=(240, 180)):
        view, inside = cut_view(image, panorama, camera)
        assert 0.5 < inside.mean() <= 1.0
        # The truth is the mean over the pixel's area too.
        offsets = (np.arange(4) + 0.5) / 4 - 0.5
        x, y = np.meshgrid(np.arange(240) + 0.5, np.arange(180) + 0.5)
        truth = np.mean(
            [scene_colour(ray_directions(camera, np.stack([x + dx, y + dy], -1))) for dx in offsets for dy in offsets],
            axis=0,
        )
        error = (view - truth)[inside]
        assert 10 * np.log10(1.0 / np.mean(error**2)) > 50.0


def test_averaging_happens_in_linear_light():
    panorama = make("cylindrical", (3600, 700), 360.0, 62.8, 0.0, 0.0, 0.0, None)
    stripes = np.zeros((700, 3600, 3), np.uint8)
    stripes[:, ::2] = 255
    camera = split_panorama(panorama, fov_deg=80.0, size_px=(120, 90))[0]
    view, inside = cut_view(stripes, panorama, camera)
    assert view[inside].mean() == pytest.approx(0.5, abs=0.01)


def test_a_picture_of_another_size_is_refused():
    panorama = make("cylindrical", (3600, 700), 360.0, 62.8, 0.0, 0.0, 0.0, None)
    with pytest.raises(ValueError, match="the image is 3599 x 700 px, the panorama model 3600 x 700"):
        cut_view(np.zeros((700, 3599, 3), np.uint8), panorama, split_panorama(panorama)[0])
    with pytest.raises(ValueError, match="leave gaps"):
        split_panorama(panorama, fov_deg=80.0, count=4)
    with pytest.raises(ValueError, match="over 360°"):
        Panorama("cylindrical", 3700, 700, 3600 / (2 * np.pi), 500.0, 1800.0, 350.0, np.eye(4))


@pytest.mark.parametrize("k1", [-0.2, 0.1, 0.0])
def test_distortion_inverts_and_rectified_lines_are_straight(k1):
    rng = np.random.default_rng(3)
    camera = Camera(640, 360, 476.0, 476.0, 320.0, 180.0, np.eye(4))
    pixel = rng.uniform([0, 0], [640, 360], (500, 2))
    assert np.abs(distort(undistort(pixel, camera, k1), camera, k1) - pixel).max() < 1e-8
    x, y = np.meshgrid(np.arange(640) + 0.5, np.arange(360) + 0.5)
    ideal = undistort(np.stack([x, y], -1), camera, k1)
    drawn = np.repeat((0.5 + 0.5 * np.sin(ideal[..., :1] / 25.0)).astype(np.float32), 3, axis=2)
    straight, inside = rectify(drawn, camera, k1)
    expected = 0.5 + 0.5 * np.sin(x / 25.0)
    assert np.abs(straight[..., 0] - expected)[inside].max() < 0.01


def test_pixels_beyond_the_fold_of_a_barrel_lens_have_no_ray():
    camera = Camera(200, 200, 50.0, 50.0, 100.0, 100.0, np.eye(4))
    assert np.isnan(undistort([[0.0, 0.0]], camera, -0.3)).all()
    assert np.isnan(distort([[-400.0, 100.0]], camera, -0.3)).all()
