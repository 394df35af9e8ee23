"""Alignment without a hand: the terrain's horizon by closed forms, then pictures whose truth is known, then real ones."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from affine import Affine

from seasonscapes.calibration.boundary_map import boundary_map, detect_border_mask
from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.overlay import draw_overlay, save_overlay
from seasonscapes.calibration.pose_model import parameters_of_view, project_with_parameters, view_from_parameters
from seasonscapes.calibration.resection import resect
from seasonscapes.calibration.skyline import SearchRange, align_to_skyline
from seasonscapes.calibration.terrain_horizon import (
    HorizonOptions,
    cell_size_m,
    horizon_from,
    terrain_height,
    terrain_profile,
)
from seasonscapes.cameras.pinhole import camera_at
from seasonscapes.errors import CameraBelowGround, ImageSizeMismatch, NoTerrainInView
from seasonscapes.evaluation.calibration_pictures import panorama_trial, picture_trial
from seasonscapes.frames import MEAN_RADIUS_M, LocalFrame, enu_from_geodetic, geodetic_from_enu
from seasonscapes.images import read_image_srgb8
from seasonscapes.terrain.crs import geodetic_from_map, map_from_geodetic
from seasonscapes.terrain.raster import read_elevation
from seasonscapes.terrain.surface import Raster

CRS, EAST, NORTH = "EPSG:25832", 500_000.0, 5_160_000.0
TRIAL_SEARCH = SearchRange(priors=Priors(tilt_deg=2.0, roll_deg=1.0, horizontal_m=3.0, vertical_m=2.0, focal=0.0))


SIZE = (640, 427)


def raster_of(height_of, cells=400, cell=100.0) -> Raster:
    """Heights as a function of metres east and north of (EAST, NORTH), the grid's middle."""
    offset = (np.arange(cells) + 0.5 - cells / 2) * cell
    values = height_of(offset[None, :], -offset[:, None]).astype(np.float32)
    return Raster(
        np.broadcast_to(values, (cells, cells))[..., None].copy(),
        Affine(cell, 0, EAST - cells / 2 * cell, 0, -cell, NORTH + cells / 2 * cell),
        CRS,
    )


def frame_at_middle(refraction=0.0) -> LocalFrame:
    latitude, longitude = geodetic_from_map(CRS, EAST, NORTH)
    return LocalFrame(float(latitude), float(longitude), 0.0, refraction)


@pytest.mark.parametrize("refraction", [0.0, 0.13])
def test_a_wall_stands_as_high_as_curvature_and_refraction_let_it(refraction):
    """A ridge of 1000 m at 15 km: elevation angle h/d - d (1 - k) / 2R, to a hundredth of a degree."""
    raster = raster_of(lambda e, n: np.where(np.abs(n - 15_000.0) < 200.0, 1000.0, 0.0) + 0.0 * e)
    horizon = horizon_from(
        [raster], frame_at_middle(refraction), [0.0, 0.0, 100.0], azimuth_deg=np.array([-1.0, 0.0, 1.0])
    )
    distance = float(np.hypot(*horizon.skyline_m[1, :2]))
    assert 14_700.0 < distance < 15_000.0
    expected = np.degrees(np.arctan(900.0 / distance - distance * (1.0 - refraction) / (2.0 * MEAN_RADIUS_M)))
    assert horizon.skyline_elevation_deg[1] == pytest.approx(expected, abs=0.002)


def test_a_cone_is_seen_at_its_summit_and_true_north_is_not_grid_north():
    """Off the central meridian the grid turns; the summit must be found in its true azimuth."""
    frame = LocalFrame(46.6, 7.6)
    latitude, longitude = 46.6 + 0.09, 7.6
    x, y = (float(v) for v in map_from_geodetic(CRS, latitude, longitude))
    cells, cell = 500, 60.0
    east = x - 15_000 + (np.arange(cells) + 0.5) * cell
    north = y + 15_000 - (np.arange(cells) + 0.5) * cell
    height = np.maximum(2500.0 - 0.8 * np.hypot(east[None] - x, north[:, None] - y), 300.0).astype(np.float32)
    raster = Raster(height[..., None], Affine(cell, 0, x - 15_000, 0, -cell, y + 15_000), CRS)
    options = HorizonOptions(below_ground_m=50.0)
    horizon = horizon_from([raster], frame, [0, 0, 700.0], azimuth_deg=np.arange(-10, 10, 0.05), options=options)
    summit = horizon.azimuth_deg[np.argmax(horizon.skyline_elevation_deg)]
    assert abs(summit) < 0.15
    grid = np.degrees(np.arctan2(*(np.array([x, y]) - np.ravel(map_from_geodetic(CRS, 46.6, 7.6)))))
    assert abs(grid) > 0.9  # what subtracting map coordinates would have said


def test_profiles_agree_with_exact_transforms_point_by_point():
    raster = raster_of(lambda e, n: 1500.0 + 0.1 * e - 0.05 * n)
    frame = LocalFrame(46.62, 9.05, 800.0, 0.13)
    position = np.array([500.0, -700.0, 900.0])
    azimuth, distance = np.array([10.0, 130.0, 275.0]), np.array([100.0, 3000.0, 9000.0, 15_000.0])
    points = terrain_profile([raster], frame, position, azimuth, distance)
    latitude, longitude, height = geodetic_from_enu(frame, points)
    exact = terrain_height([raster], latitude, longitude)
    inside = np.isfinite(exact)
    assert inside.sum() >= 10
    assert np.abs(height - exact)[inside].max() < 0.6  # on a slope of 11 %, up to 1.5 km above and below the camera


def test_a_near_ridge_before_a_far_one_is_an_edge_and_flat_ground_is_not():
    raster = raster_of(
        lambda e, n: (
            300.0 * np.exp(-(((n - 4000.0) / 400.0) ** 2)) + 1500.0 * np.exp(-(((n - 12_000.0) / 600.0) ** 2)) + 0.0 * e
        )
    )
    horizon = horizon_from([raster], frame_at_middle(), [0.0, 0.0, 50.0], azimuth_deg=np.arange(-5.0, 5.0, 0.5))
    assert len(horizon.edges_m) == 20
    assert np.abs(horizon.edges_m[:, 1] - 4000.0).max() < 150.0
    assert (horizon.edge_gap > 1.0).all()
    flat = horizon_from(
        [raster_of(lambda e, n: 0.0 * e + 0.0 * n)],
        frame_at_middle(),
        [0.0, 0.0, 10.0],
        azimuth_deg=np.arange(0.0, 360.0, 30.0),
    )
    assert len(flat.edges_m) == 0


def test_terrain_that_ends_rising_gives_no_horizon_and_a_finer_raster_goes_first():
    rising = raster_of(lambda e, n: 0.02 * np.maximum(n, 0.0) + 1e-7 * n * np.abs(n) + 0.0 * e)
    horizon = horizon_from([rising], frame_at_middle(), [0.0, 0.0, 5.0], azimuth_deg=np.array([0.0, 180.0]))
    assert np.isnan(horizon.skyline_elevation_deg[0])
    coarse = raster_of(lambda e, n: np.full(np.broadcast(e, n).shape, 10.0))
    fine = raster_of(lambda e, n: np.full(np.broadcast(e, n).shape, 99.0), cells=40)
    latitude, longitude = geodetic_from_map(CRS, np.array([EAST, EAST + 9000.0]), np.array([NORTH, NORTH]))
    assert terrain_height([fine, coarse], latitude, longitude) == pytest.approx([99.0, 10.0])
    with pytest.raises(CameraBelowGround, match="94 m below ground"):
        horizon_from([fine, coarse], frame_at_middle(), [0.0, 0.0, 5.0])


def test_a_bowl_has_a_border_in_place_of_a_skyline():
    bowl = raster_of(lambda e, n: 0.15 * np.hypot(e, n) + (e**2 + n**2) / (2.0 * MEAN_RADIUS_M))
    azimuth = np.arange(0.0, 360.0, 30.0)
    horizon = horizon_from([bowl], frame_at_middle(), [0.0, 0.0, 30.0], azimuth_deg=azimuth)
    assert np.isnan(horizon.skyline_elevation_deg).all()
    assert np.isnan(horizon.skyline_m).all()
    assert horizon.edge_of_heights_deg == pytest.approx(np.degrees(np.arctan(0.15)), abs=0.3)
    half = 0.5 * bowl.values.shape[0] * abs(bowl.transform.a)
    assert np.abs(horizon.edge_of_heights_m[:, :2]).max(axis=1) == pytest.approx(half, rel=0.03)
    away = horizon_from([bowl], frame_at_middle(), [2.0 * half, 0.0, 9000.0], azimuth_deg=np.array([90.0, 270.0]))
    assert np.isnan(away.edge_of_heights_m[0]).all()
    with pytest.raises(NoTerrainInView):
        horizon_from([bowl], frame_at_middle(), [2.0 * half, 0.0, 9000.0], azimuth_deg=np.array([80.0, 90.0]))


@pytest.mark.parametrize("turned_deg", [0.0, 30.0])
def test_cell_size_of_rasters_in_metres_and_in_degrees(turned_deg):
    values, turn = np.zeros((2, 2, 1), np.float32), Affine.rotation(turned_deg)
    assert cell_size_m(Raster(values, turn * Affine.scale(25.0, -25.0), CRS)) == pytest.approx(25.0)
    assert cell_size_m(Raster(values, turn * Affine.scale(0.05, -0.05), CRS)) == pytest.approx(0.05)
    arc_second = Affine.scale(1 / 3600, -1 / 3600)
    assert cell_size_m(Raster(values, turn * arc_second, "EPSG:4326")) == pytest.approx(30.9, abs=0.05)
    assert cell_size_m(Raster(values, turn * Affine.scale(0.25, -0.25), "EPSG:4326")) == pytest.approx(27_800, abs=5)


@pytest.fixture(scope="module")
def trial():
    return picture_trial(np.random.default_rng(2), size_px=SIZE)


@pytest.fixture(scope="module")
def fit(trial):
    return align_to_skyline(trial.image, trial.start, trial.rasters, trial.frame, mask=trial.mask, search=TRIAL_SEARCH)


def heading_error(fit, trial):
    truth = parameters_of_view(trial.truth, fit.horizon.axes)[0]
    return abs((fit.calibration.parameters[0] - truth + 180.0) % 360.0 - 180.0)


def test_the_drawn_skyline_is_where_the_horizon_says(trial):
    """Two independent roads: the picture was ray-cast pixel by pixel, the horizon projected point by point."""
    position = trial.truth.position_m
    heading = parameters_of_view(trial.truth, np.eye(3))[0]
    horizon = horizon_from(
        trial.rasters,
        trial.frame,
        position,
        azimuth_deg=heading + np.arange(-30, 30, 0.05),
        options=HorizonOptions(nearest_m=120.0, below_ground_m=40.0),
    )
    pixel, front = project_with_parameters(
        trial.truth, np.eye(3), parameters_of_view(trial.truth, np.eye(3)), horizon.skyline_m
    )
    pixel = pixel[front & np.isfinite(pixel).all(1)]
    columns = np.arange(SIZE[0])
    rows = np.interp(columns + 0.5, pixel[:, 0], pixel[:, 1])
    drawn = np.argmin(trial.sky, axis=0)
    assert np.median(np.abs(rows - drawn)) < 1.5


def test_a_hazy_picture_with_a_roof_in_it_is_aligned_and_trusted(fit, trial):
    assert fit.reliable, fit.doubts
    assert heading_error(fit, trial) < 0.1
    assert fit.edge_fraction > 0.8


def test_a_full_panorama_finds_its_heading_its_horizon_row_and_its_lean():
    trial = panorama_trial(np.random.default_rng(3), size_px=(2400, 280))
    search = SearchRange(
        tilt_deg=3.0, priors=Priors(tilt_deg=1.0, roll_deg=1.0, horizontal_m=3.0, vertical_m=3.0, focal=0.02)
    )
    fit = align_to_skyline(trial.image, trial.start, trial.rasters, trial.frame, search=search)
    assert fit.reliable, fit.doubts
    assert heading_error(fit, trial) < 0.1
    truth = parameters_of_view(trial.truth, fit.horizon.axes)
    assert fit.calibration.parameters[1:3] == pytest.approx(truth[1:3], abs=0.1)
    # A pixel is 0.15°: a row and a half is the 0.2° that the lean and the horizon's row share.
    assert fit.calibration.view.cy == pytest.approx(trial.truth.cy, abs=1.5)


@pytest.mark.slow
def test_several_trials_from_within_ten_degrees():
    errors, trusted = [], []
    for seed in (0, 3, 8):
        each = picture_trial(np.random.default_rng(seed), size_px=SIZE)
        got = align_to_skyline(each.image, each.start, each.rasters, each.frame, mask=each.mask, search=TRIAL_SEARCH)
        errors.append(heading_error(got, each))
        trusted.append(got.reliable)
    assert max(errors) < 0.1
    assert all(trusted)


@pytest.mark.parametrize(("seed", "visibility_m"), [(1003, 380.0), (1000, 1200.0)])
def test_fog_is_not_trusted(seed, visibility_m):
    trial = picture_trial(np.random.default_rng(seed), visibility_m=visibility_m, size_px=SIZE)
    fit = align_to_skyline(trial.image, trial.start, trial.rasters, trial.frame, mask=trial.mask, search=TRIAL_SEARCH)
    assert not fit.reliable
    assert fit.doubts


def test_the_wrong_mountains_are_not_trusted(trial):
    """The same picture looked for 130° away, where other summits stand."""
    values = parameters_of_view(trial.start, np.eye(3))
    values[0] += 130.0
    elsewhere = view_from_parameters(trial.start, np.eye(3), values)
    fit = align_to_skyline(trial.image, elsewhere, trial.rasters, trial.frame, mask=trial.mask, search=TRIAL_SEARCH)
    assert not fit.reliable


def test_points_and_skyline_together(trial, fit):
    horizon = fit.horizon
    truth = parameters_of_view(trial.truth, np.eye(3))
    position = horizon.edges_m[::400] if len(horizon.edges_m) > 1600 else horizon.skyline_m[100:-100:150]
    position = position[np.isfinite(position).all(1)]
    pixel, front = project_with_parameters(trial.truth, np.eye(3), truth, position)
    inside = front & (pixel[:, 0] > 0) & (pixel[:, 0] < SIZE[0]) & (pixel[:, 1] > 0) & (pixel[:, 1] < SIZE[1])
    points = Correspondences(pixel[inside], position[inside])
    assert len(points) >= 3
    both = align_to_skyline(
        trial.image, trial.start, trial.rasters, trial.frame, mask=trial.mask, points=points, search=TRIAL_SEARCH
    )
    assert heading_error(both, trial) < 0.1
    assert len(both.calibration.names) == len(points)


def test_a_picture_of_another_size_is_refused(trial, fit):
    with pytest.raises(ImageSizeMismatch, match="the image is 639 x 427 px"):
        align_to_skyline(trial.image[:, 1:], trial.start, trial.rasters, trial.frame)
    with pytest.raises(ImageSizeMismatch, match="the image is 639 x 427 px"):
        draw_overlay(trial.image[:, 1:], fit.calibration)
    with pytest.raises(ValueError, match="expected \\(H, W, 3\\) uint8"):
        boundary_map(trial.image.astype(float), None, 10.0)
    with pytest.raises(ValueError, match="leaves 0 %"):
        boundary_map(trial.image, np.zeros(trial.image.shape[:2], bool), 10.0)


def test_heights_that_end_before_the_skyline_everywhere_are_named(trial):
    (raster,) = trial.rasters
    side = (np.arange(len(raster.values)) - 0.5 * len(raster.values)) * cell_size_m(raster)
    bowl = (0.15 * np.hypot(side[:, None], side) - 5000.0).astype(np.float32)
    with pytest.raises(NoTerrainInView, match="end before the skyline in every direction"):
        align_to_skyline(trial.image, trial.start, (replace(raster, values=bowl[..., None]),), trial.frame)


def test_a_uniform_frame_is_recognised():
    image = np.full((200, 300, 3), 250, np.uint8)
    image[20:180, 30:270] = np.random.default_rng(0).integers(0, 200, (160, 240, 3), np.uint8)
    mask = detect_border_mask(image)
    assert not mask[:20].any()
    assert not mask[:, :30].any()
    assert mask[30:170, 40:260].all()


def test_the_overlay_shows_ridges_points_and_arrows(tmp_path, trial, fit):
    picture = draw_overlay(trial.image, fit.calibration, horizon=fit.horizon, title="trial")
    red = (picture == [230, 40, 40]).all(axis=-1)
    assert red.any(axis=0).mean() > 0.5
    save_overlay(tmp_path / "o.png", trial.image, fit.calibration, horizon=fit.horizon)
    assert np.array_equal(
        read_image_srgb8(tmp_path / "o.png"), draw_overlay(trial.image, fit.calibration, horizon=fit.horizon)
    )


def column(rows, name):
    return np.array([float(row[name]) for row in rows])


@pytest.mark.data
@pytest.mark.slow
def test_finse_by_its_skyline_alone(data_dir):
    folder = data_dir / "finse-webcam"
    latitude, longitude = (float(v) for v in geodetic_from_map("EPSG:25832", 419169.2, 6718421.3))
    frame = LocalFrame(latitude, longitude, 0.0, 0.13)
    rasters = [read_elevation(folder / "dsm_4m.tif"), read_elevation(folder / "dem_context_aster_100m.tif")]
    rows = list(csv.DictReader((folder / "gcps.csv").read_text().splitlines()))
    at = geodetic_from_map("EPSG:25832", column(rows, "x_world"), column(rows, "y_world"))
    points = Correspondences(
        np.stack([column(rows, "x_img"), column(rows, "y_img")], -1),
        enu_from_geodetic(frame, *at, column(rows, "z_world")),
    )
    start = camera_at(frame, latitude, longitude, 1212.0, heading_deg=66.0, fov_deg=65.8, size_px=(1920, 1080))
    by_points = resect(start, points, priors=Priors(k1=np.inf))
    search = SearchRange(
        tilt_deg=10.0,
        focal=0.06,
        priors=Priors(tilt_deg=10.0, roll_deg=3.0, horizontal_m=3.0, vertical_m=3.0, focal=0.05, k1=0.1),
        k1=-0.2,
    )
    image = read_image_srgb8(folder / "2019-05-24_12-00-01.jpg")
    mask = np.ones(image.shape[:2], bool)
    mask[:60] = False  # the camera's lettering
    fit = align_to_skyline(image, start, rasters, frame, mask=mask, search=search)
    assert abs(fit.calibration.parameters[0] - by_points.parameters[0]) < 0.3
