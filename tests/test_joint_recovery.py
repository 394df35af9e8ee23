"""Joint recovery: derivatives against finite differences, its solver against a dense one, and truths that it must find."""

from dataclasses import replace
from datetime import UTC, datetime

import cv2
import numpy as np
import pytest
from albedo_cases import Case, case, psnr

from seasonscapes.albedo.closed_form import SolverOptions, solve_albedo
from seasonscapes.albedo.forward_model import ambient_on_texels, sun_on_texels
from seasonscapes.albedo.joint_recovery import recover_jointly
from seasonscapes.albedo.painted_textures import painted_photograph
from seasonscapes.albedo.photographs import EIGHT_BIT, LINEAR, prepare_photographs
from seasonscapes.albedo.recovery_pictures import HazeLights, turned_camera
from seasonscapes.albedo.recovery_prediction import albedo_derivative, predict
from seasonscapes.albedo.recovery_rounds import JointOptions, RecoveryState, lit_lands, make_problem
from seasonscapes.albedo.recovery_system import RecoveryBlock, RecoverySystem
from seasonscapes.albedo.recovery_unknowns import CURVE, GAIN, HAZE, SKY, SUN, TURN, bent, straightened
from seasonscapes.errors import NotEnoughEvidence, NoUsablePixels
from seasonscapes.evaluation.webcam_faults import WebcamFaults, degrade
from seasonscapes.images import linear_from_srgb
from seasonscapes.terrain.surface import Texture

POSE_SIGMA = {"heading_deg": 0.2, "pitch_deg": 0.2, "roll_deg": 0.2}
QUICK = SolverOptions(rounds=3, iterations=8)


@pytest.fixture(scope="module")
def place() -> Case:
    return case()


def webcam_pictures(place: Case, *, strength: float = 0.0, turns: np.ndarray | None = None, seed: int = 3):
    """8-bit pictures of unknown exposure with their lights; the cameras told are wrong by ``turns`` [rad]."""
    rng, faults = np.random.default_rng(seed), WebcamFaults(tone_strength=strength)
    observations, lights = place.observations(
        image_of=lambda image: linear_from_srgb(degrade(image, faults, rng)[0] / 255.0)
    )
    told = []
    for k, each in enumerate(observations):
        turn = np.zeros(3) if turns is None else turns[k % len(place.cameras)]
        told.append(replace(each, camera=turned_camera(each.camera, -turn), pose_sigma=POSE_SIGMA))
    return told, lights


class Fog:
    """Homogeneous air of one visibility."""

    def __init__(self, visibility_km: float):
        self.extinction = 3.912 / (1000.0 * visibility_km)

    def __call__(self, depth_m, direction):
        through = np.repeat(np.exp(-self.extinction * np.asarray(depth_m))[..., None], 3, axis=-1)
        return through, 4000.0 * (1.0 - through)


def test_response_curves_are_inverted_and_differentiated():
    values, curve, step = np.linspace(0.02, 0.98, 50), np.array([0.4, -0.1]), 1e-5
    bending, slope, by_curve = bent(values, curve)
    np.testing.assert_allclose(straightened(bending, curve), values, atol=2e-4)
    np.testing.assert_allclose(slope, (bent(values + step, curve)[0] - bending) / step, atol=1e-3)
    for k, change in enumerate(np.eye(2) * step):
        np.testing.assert_allclose(by_curve[:, k], (bent(values, curve + change)[0] - bending) / step, atol=1e-3)


@pytest.fixture(scope="module")
def problem(place):
    observations, lights = webcam_pictures(place)
    nodes = (20.0, 80.0)
    hazy = [[replace(light, aerial_perspective=Fog(km)) for light in lights] for km in nodes]
    photographs = prepare_photographs(place.transport, observations, hazy[1])
    gains = np.full((len(photographs), 3), 1e-4)
    return make_problem(
        place.transport, photographs, HazeLights(nodes, hazy, 50.0), EIGHT_BIT, gains, JointOptions(sun_grid=4)
    )


def test_masked_pixels_measure_no_texel(place):
    observations, lights = webcam_pictures(place)
    shape = observations[0].mask.shape
    left = np.indices(shape)[1] < shape[1] // 2
    masked = [replace(each, mask=each.mask & left) for each in observations]
    counts = []
    for each in (observations, masked):
        photographs = prepare_photographs(place.transport, each, lights)
        fit = solve_albedo(place.transport, photographs, noise_model=EIGHT_BIT, solver=QUICK)
        haze = HazeLights((1.0,), [lights], 1.0)
        made = make_problem(place.transport, photographs, haze, EIGHT_BIT, fit.gains, JointOptions(sun_grid=4))
        np.testing.assert_array_equal(made.pixel_count, fit.pixel_count)
        counts.append(made.pixel_count)
    assert (counts[1] > 0.0).sum() < 0.8 * (counts[0] > 0.0).sum()


@pytest.mark.parametrize(
    ("name", "column", "step"), [(GAIN, 0, 1e-3), (CURVE, 1, 1e-3), (HAZE, 6, 2e-2), (SKY, 7, 1e-3), (SUN, None, 1e-3)]
)
def test_derivatives_equal_finite_differences(place, problem, name, column, step):
    albedo = place.albedo.reshape(-1, 3)
    state = RecoveryState(np.log(np.maximum(albedo, 0.01)), problem.start.copy())
    picture = problem.pictures[4]
    land = lit_lands(problem, state)[picture.instant]

    def value(change):
        moved = state.values.copy()
        problem.layout.view(moved, name)[:] += change
        return predict(picture, land, state.albedo, moved, problem.frame)

    at, change = value(0.0), (value(step).value - value(-step).value) / (2.0 * step)
    analytic = at.by_sun if column is None else at.dense[:, :, column].T + (at.dense[:, :, 2].T if name == CURVE else 0)
    usable = at.weight[:, 0] > 0.0
    assert np.abs(change[usable]).mean() > 1e-4, "the unknown has an influence"
    assert np.abs(analytic - change)[usable].mean() < 0.02 * np.abs(change[usable]).mean()


def test_derivative_to_albedo_and_turn(place, problem):
    albedo = np.maximum(place.albedo.reshape(-1, 3), 0.01).astype(np.float32)
    state = RecoveryState(np.log(albedo), problem.start.copy())
    picture = problem.pictures[4]
    land = lit_lands(problem, state)[picture.instant]
    at = predict(picture, land, albedo, state.values, problem.frame)
    direction = np.random.default_rng(0).normal(size=albedo.shape[0]).astype(np.float32)
    moved = predict(picture, land, albedo * np.exp(1e-3 * direction)[:, None], state.values, problem.frame)
    matrices = albedo_derivative(picture, at, albedo, np.ones_like(at.value))
    for c in range(3):
        change = (moved.value - at.value)[:, c] / 1e-3
        assert np.abs(matrices[c] @ direction - change).mean() < 0.02 * np.abs(change).mean()
    turned = state.values.copy()
    problem.layout.view(turned, TURN)[picture.camera, 1] += 1e-3
    later = predict(picture, land, albedo, turned, problem.frame)
    both = (at.weight[:, 1] > 0.0) & (later.weight[:, 1] > 0.0)
    predicted, seen = -1e-3 * at.dense[1, both, 4], (later.residual - at.residual)[both, 1]
    assert np.corrcoef(predicted, seen)[0, 1] > 0.8
    # The derivative is that of the slightly blurred picture, which is less steep.
    assert 0.7 < (predicted @ seen) / (predicted @ predicted) < 2.0


def test_solver_equals_a_dense_one():
    from scipy.sparse import csr_array

    rng, size, n, dense, nodes = np.random.default_rng(1), 12, 40, 5, 4
    blocks, rows, targets = [], [], []
    for _ in range(2):
        albedo = [csr_array(rng.random((n, size)) * (rng.random((n, size)) < 0.4)) for _ in range(3)]
        columns = np.array([[c, 3, 4] for c in range(3)])
        slopes, weights = rng.normal(size=(3, n, 3)), csr_array(rng.random((n, nodes)))
        by_sun, residual = rng.normal(size=(3, n)), rng.normal(size=(3, n))
        blocks.append(RecoveryBlock(albedo, columns, slopes, weights, by_sun, dense, residual))
        for c in range(3):
            row = np.zeros((n, 3 * size + dense + nodes))
            row[:, c * size : (c + 1) * size] = albedo[c].toarray()
            row[:, 3 * size + columns[c]] = slopes[c]
            row[:, 3 * size + dense :] = by_sun[c][:, None] * weights.toarray()
            rows.append(row)
            targets.append(residual[c])
    precision = np.full(dense + nodes, 0.5)
    coupling = [np.eye(nodes) * 0.3]
    system = RecoverySystem(
        blocks,
        (3, 4),
        dense,
        nodes,
        precision,
        np.zeros(dense + nodes),
        coupling,
        1e-6,
        np.zeros((size, 3), np.float32),
    )
    by_albedo, by_other = system.solve(400)
    jacobian, prior = np.concatenate(rows), np.zeros(3 * size + dense + nodes)
    prior[3 * size :] = precision
    prior[3 * size + dense :] += 0.3
    expected = np.linalg.solve(jacobian.T @ jacobian + np.diag(prior + 1e-5), jacobian.T @ np.concatenate(targets))
    np.testing.assert_allclose(by_other, expected[3 * size :], atol=0.02)
    np.testing.assert_allclose(by_albedo.T.ravel(), expected[: 3 * size], atol=0.05)


def test_response_and_poses_are_found(place):
    """The closed form takes an S-curve and turned cameras for albedo; held-out photographs tell the difference."""
    rng = np.random.default_rng(7)
    turns = np.radians(0.35) * np.array([axis / np.linalg.norm(axis) for axis in rng.normal(size=(3, 3))])
    observations, lights = webcam_pictures(place, strength=0.45, turns=turns)
    photographs = prepare_photographs(place.transport, observations, lights)
    closed = solve_albedo(place.transport, photographs, noise_model=EIGHT_BIT, solver=QUICK)
    found = recover_jointly(place.transport, photographs, closed)
    assert found.accepted
    assert found.held_out_end < 0.8 * found.held_out_start
    seen = closed.pixel_count >= 1.0
    assert psnr(found.fit.albedo, place.albedo, seen) > psnr(closed.albedo, place.albedo, seen) + 2.0
    np.testing.assert_allclose(found.conditions.curve_strength, 0.45, atol=0.15)
    for got, turn in zip(np.radians(found.conditions.turn_deg), turns, strict=True):
        relative = cv2.Rodrigues(got)[0] @ cv2.Rodrigues(turn)[0].T
        assert np.degrees(np.linalg.norm(cv2.Rodrigues(relative)[0])) < 0.2


def test_a_cloud_before_the_sun_is_found(place):
    """At two of four hours the sun is hidden; the pictures do not say so."""
    hidden = [1, 2]
    moments = [place.observations(times=[t])[0][0].time for t in hidden]
    observations, lights = webcam_pictures(place)
    photographs = prepare_photographs(place.transport, observations, lights)
    cloudy, rng = list(photographs), np.random.default_rng(5)
    for k, photograph in enumerate(photographs):
        if photograph.observation.time in moments:
            footprints, size = photograph.footprints, place.albedo.shape[0] * place.albedo.shape[1]
            ambient = ambient_on_texels(place.transport, replace(photograph.light, sun=None), place.albedo)
            image = place.pictures[k // len(place.cameras)][k % len(place.cameras)].copy().reshape(-1, 3)
            image[footprints.pixel] = (
                footprints.matrix(footprints.share) @ (ambient * place.albedo.reshape(size, 3)) / np.pi
            )
            levels, _ = degrade(image.reshape(photograph.observation.image.shape), WebcamFaults(tone_strength=0.0), rng)
            seen = replace(photograph.observation, image=linear_from_srgb(levels / 255.0))
            cloudy[k] = replace(photograph, observation=seen)
    closed = solve_albedo(place.transport, cloudy, noise_model=EIGHT_BIT, solver=QUICK)
    found = recover_jointly(place.transport, cloudy, closed, options=JointOptions(sun_grid=3))
    shares = found.conditions.sun_share.reshape(len(place.lights), -1).mean(axis=1)
    assert (shares[hidden] < 0.4).all()
    assert (np.delete(shares, hidden) > 0.85).all()
    mask = closed.pixel_count >= 1.0
    assert psnr(found.fit.albedo, place.albedo, mask) > psnr(closed.albedo, place.albedo, mask)


def test_painted_textures_are_observations(place):
    rng, painted = np.random.default_rng(2), []
    seen = rng.random(place.albedo.shape[:2]) < 0.5
    for k, light in enumerate(place.lights[:3]):
        received = ambient_on_texels(place.transport, light, place.albedo) + sun_on_texels(place.transport, light)
        radiance = place.albedo * received.reshape(place.albedo.shape) / np.pi
        # Each painting is too bright or too dark as a whole, as exposures from the sky are.
        radiance = radiance * np.array([1.1, 0.92, 1.0])[k] * rng.normal(1.0, 0.03, radiance.shape)
        moment = datetime(2024, 9, 10, 8 + 2 * k, tzinfo=UTC)
        texture = Texture(radiance.astype(np.float32), seen.astype(np.float32))
        painted.append(painted_photograph(place.transport, texture, light, moment))
    closed = solve_albedo(place.transport, painted, noise_model=LINEAR)
    shown = closed.pixel_count > 0.0
    assert not shown[~seen].any(), "what is not painted is not observed"
    assert psnr(closed.albedo, place.albedo, shown) > 25.0
    joint = recover_jointly(place.transport, painted, closed)
    assert joint.accepted
    assert psnr(joint.fit.albedo, place.albedo, shown) > psnr(closed.albedo, place.albedo, shown)


def test_recovery_refuses(place):
    observations, lights = webcam_pictures(place)
    photographs = prepare_photographs(place.transport, observations[:1], lights[:1])
    closed = solve_albedo(
        place.transport, [replace(photographs[0], gain=np.ones(3))], noise_model=EIGHT_BIT, solver=QUICK
    )
    with pytest.raises(NotEnoughEvidence, match="two photographs"):
        recover_jointly(place.transport, photographs, closed)
    nothing = Texture(np.ones_like(place.albedo), np.zeros(place.albedo.shape[:2], np.float32))
    with pytest.raises(NoUsablePixels, match="nothing is painted"):
        painted_photograph(place.transport, nothing, lights[0], datetime(2024, 9, 10, tzinfo=UTC))
