"""Resection from matched points: known truths, stated errors, and every way in which matches can be wrong."""

import csv

import numpy as np
import pytest

from seasonscapes.calibration.evidence import Correspondences, Priors, read_points, select_points, write_points
from seasonscapes.calibration.pose_model import angles_from_rotation
from seasonscapes.calibration.resection import ResectionOptions, leave_one_out, report_lines, resect
from seasonscapes.cameras.panorama import project_panorama
from seasonscapes.cameras.pinhole import Camera, camera_at, project, rotation_from_angles
from seasonscapes.errors import CameraBelowGround, InputError
from seasonscapes.evaluation.calibration_trials import point_trial, reproject, score_points
from seasonscapes.frames import LocalFrame, enu_from_geodetic

FREE = Priors(horizontal_m=np.inf, vertical_m=np.inf)
SQUARES = ResectionOptions(loss="squares")


def test_angles_are_the_inverse_of_the_rotation():
    rng = np.random.default_rng(0)
    for heading, pitch, roll in zip(
        rng.uniform(0, 360, 50), rng.uniform(-80, 80, 50), rng.uniform(-170, 170, 50), strict=True
    ):
        assert angles_from_rotation(rotation_from_angles(heading, pitch, roll)) == pytest.approx((heading, pitch, roll))


@pytest.mark.parametrize("panoramic", [True, False])
def test_the_solver_projects_as_the_cameras_do(panoramic):
    trial = point_trial(np.random.default_rng(4), panoramic=panoramic)
    independent = (project_panorama if panoramic else project)(trial.truth, trial.points.position_m)[0]
    assert np.abs(reproject(trial) - independent).max() < 1e-7


@pytest.mark.parametrize("panoramic", [True, False])
@pytest.mark.parametrize("loss", ["cauchy", "l1", "squares"])
def test_clean_matches_give_the_truth_to_the_last_digit(panoramic, loss):
    trial = point_trial(np.random.default_rng(5), panoramic=panoramic, noise_px=0.0, outlier_share=0.0)
    solved = resect(trial.start, trial.points, priors=FREE, options=ResectionOptions(loss=loss))
    assert np.abs(solved.view.position_m - trial.truth.position_m).max() < 1e-3
    assert np.abs(solved.view.world_from_camera - trial.truth.world_from_camera)[:3, :3].max() < 1e-6
    assert solved.view.fy == pytest.approx(trial.truth.fy, rel=1e-6)


def coverage(trials: int, seed: int) -> dict:
    rng = np.random.default_rng(seed)
    scores = [score_points(point_trial(rng, panoramic=i % 2 == 0), noise_px=1.0) for i in range(trials)]
    return {
        "heading": np.array([s.heading_error_deg for s in scores]),
        "focal": np.array([s.focal_error for s in scores]),
        "inside": np.array([s.within_two_sigma for s in scores]),
        "found": np.array([s.outliers_found for s in scores]),
    }


@pytest.mark.slow
def test_200_trials_with_a_fifth_of_the_matches_wrong_keep_what_they_state():
    got = coverage(200, 20261123)
    assert np.median(got["heading"]) < 0.01
    assert np.mean(got["heading"] < 0.02) > 0.88
    assert np.mean(got["focal"] < 0.002) > 0.94
    assert got["found"].mean() > 0.97
    # 600 coordinates inside ± 2 sigma: 95.4 % expected; three binomial sigmas (of 200 independent trials) are 4.4 %.
    assert 0.91 < got["inside"].mean() <= 0.99


def test_a_start_40_degrees_off_does_no_harm():
    for seed in range(6):
        trial = point_trial(np.random.default_rng(seed), panoramic=seed % 2 == 0, heading_error_deg=40.0)
        assert score_points(trial, noise_px=1.0).heading_error_deg < 0.06


def test_a_radial_term_is_recovered_and_its_points_named():
    from seasonscapes.cameras.lens import distort

    trial = point_trial(np.random.default_rng(8), panoramic=False, count=40, noise_px=0.5, outlier_share=0.1)
    pixel = distort(trial.points.pixel, trial.truth, -0.12)
    solved = resect(
        trial.start,
        Correspondences(pixel, trial.points.position_m),
        priors=Priors(horizontal_m=20, vertical_m=20, k1=np.inf),
    )
    assert solved.k1 == pytest.approx(-0.12, abs=3.0 * solved.sigma["k1"])
    assert solved.sigma["k1"] < 0.01
    assert set(solved.outlier_names) == {str(i + 1) for i in np.flatnonzero(trial.outlier)}
    assert any(line.endswith("outlier") for line in report_lines(solved))


def test_an_unknown_held_fixed_stays_and_has_no_error():
    trial = point_trial(np.random.default_rng(9), panoramic=False, outlier_share=0.0)
    solved = resect(trial.start, trial.points, priors=Priors(horizontal_m=0.0, vertical_m=0.0, focal=0.0))
    assert np.array_equal(solved.view.position_m, trial.start.position_m)
    assert solved.view.fx == trial.start.fx
    assert solved.sigma["east_m"] == solved.sigma["focal"] == 0.0


def broken(points, how):
    if how == "few":
        return select_points(points, [0, 1])
    if how == "mirror x":
        return Correspondences(np.array([3072.0, 0.0]) + points.pixel * [-1, 1], points.position_m)
    if how == "mirror y":
        return Correspondences(np.array([0.0, 2048.0]) + points.pixel * [1, -1], points.position_m)
    if how == "turned":
        return Correspondences(np.array([3072.0, 2048.0]) - points.pixel, points.position_m)
    if how == "reversed":
        return Correspondences(points.pixel[::-1], points.position_m)
    rng = np.random.default_rng(0)
    return Correspondences(points.pixel, points.position_m[rng.permutation(len(points))])


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("few", r"2 points for 4 unknowns without a prior: at least 3 are needed"),
        ("mirror x", "mirrored"),
        ("mirror y", "mirrored"),
        ("turned", "upside down"),
        ("reversed", "in reverse order"),
        ("shuffled", "no pose in common|upside down|behind the camera"),
    ],
)
def test_matches_that_cannot_be_are_refused_with_a_reason(how, message):
    for seed in (1, 2, 3):
        trial = point_trial(np.random.default_rng(seed), panoramic=False, outlier_share=0.0)
        with pytest.raises(ValueError, match=message):
            resect(trial.start, broken(trial.points, how))


def test_a_point_behind_the_camera_is_named():
    trial = point_trial(np.random.default_rng(3), panoramic=False, outlier_share=0.0)
    position = trial.points.position_m.copy()
    position[4] = 2.0 * trial.truth.position_m - position[4]
    with pytest.raises(ValueError, match="behind the camera: P5"):
        resect(trial.start, Correspondences(trial.points.pixel, position, tuple(f"P{i + 1}" for i in range(12))))


def test_nan_and_a_camera_below_ground_and_no_evidence_are_refused():
    trial = point_trial(np.random.default_rng(3), outlier_share=0.0)
    pixel = trial.points.pixel.copy()
    pixel[2, 0] = np.nan
    with pytest.raises(ValueError, match="point 3 holds NaN"):
        Correspondences(pixel, trial.points.position_m)
    height = trial.truth.position_m[2]
    options = ResectionOptions(ground_m=lambda e, n: height + 100.0)
    with pytest.raises(CameraBelowGround, match=r"the start puts the camera \d+ m below ground"):
        resect(trial.start, trial.points, options=options)
    with pytest.raises(ValueError, match="neither points nor a skyline"):
        resect(trial.start)
    with pytest.raises(ValueError, match="must not be negative or NaN"):
        Priors(focal=-1.0)


def test_a_camera_on_a_slope_is_not_solved_into_it():
    # A hillside that falls northwards to a plain with the matched points: seen so flatly, they hardly tell how far back and
    # up the camera stands.
    def ground_m(east: float, north: float) -> float:
        return max(300.0 - 0.4 * north, 10.0)

    def solved(seed: int, options: ResectionOptions) -> np.ndarray:
        rng = np.random.default_rng(seed)
        camera = camera_at(
            LocalFrame(78.17, 15.91, 0.0, 0.13),
            78.17,
            15.91,
            302.0,
            heading_deg=8.0,
            pitch_deg=-13.0,
            fov_deg=46.0,
            size_px=(1438, 898),
        )
        ground = np.column_stack([rng.uniform(-250.0, 350.0, 9), rng.uniform(760.0, 2200.0, 9), np.full(9, 10.0)])
        pixel = project(camera, ground)[0] + rng.normal(scale=5.0, size=(9, 2))
        priors = Priors(horizontal_m=50.0, vertical_m=50.0, k1=0.0)
        return resect(camera, Correspondences(pixel, ground), priors=priors, options=options).view.position_m

    above = ResectionOptions(ground_m=ground_m, ground_sigma_m=1.0)
    free = np.array([solved(seed, ResectionOptions()) for seed in range(12)])
    kept = np.array([solved(seed, above) for seed in range(12)])
    depth_free, depth_kept = (np.array([ground_m(*each[:2]) - each[2] for each in found]) for found in (free, kept))
    assert depth_free.max() > 5.0
    assert depth_kept.max() < 2.0
    truth = [0.0, 0.0, 302.0]
    assert np.linalg.norm(kept - truth, axis=1).mean() < 0.9 * np.linalg.norm(free - truth, axis=1).mean()
    # Where the ground leaves the camera free, nothing changes.
    clear = depth_free < -5.0
    assert clear.any()
    assert np.allclose(kept[clear], free[clear], atol=0.1)


def test_undetermined_unknowns_are_named():
    trial = point_trial(np.random.default_rng(3), panoramic=False, count=12, outlier_share=0.0, noise_px=0.0)
    one = select_points(trial.points, np.zeros(8, int))
    with pytest.raises(ValueError, match=r"leaves (focal|roll_deg|tilt_deg|heading_deg) undetermined"):
        resect(trial.start, one, options=ResectionOptions(noise_px=1.0))


def test_points_survive_their_file(tmp_path):
    trial = point_trial(np.random.default_rng(3))
    frame = LocalFrame(46.6, 8.0, 0.0, 0.13)
    write_points(tmp_path / "p.csv", trial.points, frame)
    again = read_points(tmp_path / "p.csv", frame)
    assert again.names == trial.points.names
    assert np.abs(again.position_m - trial.points.position_m).max() < 1e-3
    text = (tmp_path / "p.csv").read_text()
    for wrong, message in (
        (text.replace("height_m", "alt"), "'height_m' is missing"),
        (text + "x,1,2,nan,8,9\n", "line 14: not a point"),
        (text + "x,1\n", "line 14"),
    ):
        (tmp_path / "p.csv").write_text(wrong)
        with pytest.raises(InputError, match=message):
            read_points(tmp_path / "p.csv", frame)


def finse(folder):
    from pyproj import Transformer

    rows = list(csv.DictReader((folder / "finse-webcam" / "gcps.csv").read_text().splitlines()))
    column = {
        name: np.array([float(r[name]) for r in rows]) for name in ("x_img", "y_img", "x_world", "y_world", "z_world")
    }
    to_wgs84 = Transformer.from_crs(25832, 4326, always_xy=True, allow_ballpark=False)
    longitude, latitude = to_wgs84.transform(column["x_world"], column["y_world"])
    at = to_wgs84.transform(419169.2, 6718421.3)
    frame = LocalFrame(at[1], at[0], 0.0, 0.13)
    points = Correspondences(
        np.stack([column["x_img"], column["y_img"]], -1),
        enu_from_geodetic(frame, latitude, longitude, column["z_world"]),
        tuple(r["name"] for r in rows),
    )
    start = camera_at(frame, at[1], at[0], 1212.0, heading_deg=70.0, fov_deg=65.8, size_px=(1920, 1080))
    return start, points


@pytest.mark.data
def test_finse_resection_with_one_radial_term(data_dir):
    start, points = finse(data_dir)
    priors = Priors(k1=np.inf)
    solved = resect(start, points, priors=priors, options=SQUARES)
    assert solved.rms_px < 5.55  # 5.51, the least-squares optimum of this model over all 45 points
    assert solved.k1 == pytest.approx(-0.266, abs=0.01)
    assert solved.parameters[0] == pytest.approx(61.0, abs=0.1)
    without = leave_one_out(start, points, priors=priors, options=SQUARES)
    assert np.sqrt(np.mean(np.sum(without**2, axis=1))) < 6.5  # 5.96
    assert resect(start, points, priors=priors).inlier_rms_px < 4.6


@pytest.mark.data
def test_aletsch_resection(data_dir):
    rows = list(csv.DictReader((data_dir / "aletsch-photo" / "gcps.csv").read_text().splitlines()))
    frame = LocalFrame(46.4314217, 8.0932999, 0.0, 0.13)
    column = {
        name: np.array([float(r[name]) for r in rows]) for name in ("col_px", "row_px", "lat_deg", "lon_deg", "z_m")
    }
    points = Correspondences(
        np.stack([column["col_px"], column["row_px"]], -1),
        enu_from_geodetic(frame, column["lat_deg"], column["lon_deg"], column["z_m"]),
    )
    start: Camera = camera_at(
        frame, 46.4314217, 8.0932999, 2929.0, heading_deg=-63.37, pitch_deg=-11.3, fov_deg=63.08, size_px=(1024, 763)
    )
    solved = resect(start, points, priors=Priors(horizontal_m=100.0, vertical_m=100.0), options=SQUARES)
    assert solved.rms_px < 8.0
    assert solved.parameters[0] == pytest.approx(296.9, abs=0.3)
