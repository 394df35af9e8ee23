"""A fixed camera's ground and its pictures' conditions, recovered from pictures made by the model itself or slightly not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from seasonscapes.albedo.fixed_camera import FitOptions, conditions_of, fit_fixed_camera, relit_at, relit_mean
from seasonscapes.albedo.picture_conditions import (
    AIRLIGHT,
    CONTRAST,
    EXTINCTION,
    FLARE,
    GAIN,
    OVERCAST,
    START,
    SUN,
    Conditions,
    Ground,
    ViewLight,
    picture_under,
)
from seasonscapes.errors import NoUsablePixels

PIXELS = 900


def _ground(rng: np.random.Generator) -> tuple[Ground, np.ndarray]:
    """Rough ground: its mean normals scatter about those of the heights, which are given back too."""
    slopes = rng.normal(0.0, 0.35, (PIXELS, 2))
    normal = np.column_stack([slopes, np.ones(PIXELS)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    rough = normal + rng.normal(0.0, 0.25, normal.shape)
    reflectance = np.exp(rng.normal(np.log(0.12), 0.4, (PIXELS, 1)) + rng.normal(0.0, 0.1, (PIXELS, 3)))
    distance = np.where(np.arange(PIXELS) % 3 == 0, rng.uniform(5.0, 9.0, PIXELS), rng.uniform(0.5, 3.0, PIXELS))
    return Ground(reflectance, np.column_stack([rough, np.full(PIXELS, 0.05)]), distance), normal


def _light(rng: np.random.Generator, azimuth_deg: float, elevation_deg: float) -> ViewLight:
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    direction = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    visible = (rng.random(PIXELS) > 0.2).astype(float)
    sky = 0.2 * rng.uniform(0.8, 1.2, (PIXELS, 1)) * np.array([0.8, 1.0, 1.5])
    clouds = np.ones((PIXELS, 3)) * rng.uniform(0.8, 1.2, (PIXELS, 1))
    return ViewLight(np.array([1.2, 1.0, 0.85]), visible, direction, sky, clouds, 180)


def _conditions(sun: float, overcast: float, extinction: float, gain: float) -> Conditions:
    values = START.copy()
    values[[SUN, OVERCAST, EXTINCTION, CONTRAST]] = sun, overcast, np.log(extinction), 0.2
    values[GAIN], values[AIRLIGHT], values[FLARE] = gain, -1.2, -4.0
    return Conditions(values, np.zeros(len(values)))


@pytest.fixture(scope="module")
def pictures():
    """Seven pictures of rough ground with noise of two levels; the last one is not fitted."""
    rng = np.random.default_rng(5)
    ground, normal = _ground(rng)
    suns = [(95, 25), (120, 45), (160, 60), (200, 62), (240, 45), (265, 25), (140, 55)]
    lights = [_light(rng, *each) for each in suns]
    weather = [(1.0, 0.1, 0.04, 0.2), (0.9, 0.2, 0.05, 0.1), (0.05, 0.9, 0.08, 0.3), (1.0, 0.1, 0.03, 0.0)]
    weather += [(0.0, 1.0, 0.1, 0.4), (0.8, 0.3, 0.06, 0.1), (0.95, 0.15, 0.05, 0.2)]
    conditions = [_conditions(*each) for each in weather]
    values = [
        np.clip(picture_under(ground, light, each.values) + rng.normal(0.0, 0.008, (PIXELS, 3)), 0.0, 1.0)
        for light, each in zip(lights, conditions, strict=True)
    ]
    return ground, normal, lights, conditions, values


def _psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean((a - b) ** 2)))


def _fit(pictures, **options):
    ground, normal, lights, _, values = pictures
    usable = [np.ones(PIXELS, bool)] * 6
    return fit_fixed_camera(values[:6], usable, lights[:6], ground.distance_km, normal, options=FitOptions(**options))


@pytest.fixture(scope="module")
def fitted(pictures):
    return _fit(pictures)


def test_an_unseen_hour_is_predicted_from_half_of_its_pixels_and_better_than_by_any_picture(pictures, fitted):
    _, _, lights, _, values = pictures
    seen = np.arange(PIXELS) % 2 == 0
    found = conditions_of(fitted, values[6], seen, lights[6])
    predicted = picture_under(fitted.ground, lights[6], found.values)[~seen]
    best = max(_psnr(each[~seen], values[6][~seen]) for each in values[:6])
    assert _psnr(predicted, values[6][~seen]) > 33.0
    assert _psnr(predicted, values[6][~seen]) > best + 4.0


def test_pictures_without_sun_are_told_from_pictures_with_it(pictures, fitted):
    _, _, _, truth, _ = pictures
    for found, known in zip(fitted.conditions, truth, strict=False):
        assert (found.sun > 0.3) == (known.sun > 0.3), (found.sun, known.sun)


def test_shading_learnt_from_the_pictures_beats_that_of_the_heights(pictures, fitted):
    _, _, lights, _, values = pictures
    errors = []
    for camera in (_fit(pictures, shading_sigma=0.0), fitted):
        found = conditions_of(camera, values[6], np.ones(PIXELS, bool), lights[6])
        errors.append(_psnr(picture_under(camera.ground, lights[6], found.values), values[6]))
    assert errors[1] > errors[0] + 2.0, errors


def test_a_cloud_before_the_terrain_is_an_outlier_of_its_pixels_and_picture(pictures):
    ground, normal, lights, _, values = pictures
    cloudy = [each.copy() for each in values[:6]]
    cloudy[3][:60] = 0.9
    usable = [np.ones(PIXELS, bool)] * 6
    camera = fit_fixed_camera(cloudy, usable, lights[:6], ground.distance_km, normal)
    found = conditions_of(camera, values[6], np.ones(PIXELS, bool), lights[6])
    assert _psnr(picture_under(camera.ground, lights[6], found.values)[:60], values[6][:60]) > 26.0
    assert np.abs(camera.misfit[3, :60]).mean() > 10.0 * camera.residual[3]


def test_haze_has_the_right_order_and_its_sigma_covers_the_error(pictures, fitted):
    ground, _, lights, truth, _ = pictures
    rng = np.random.default_rng(0)
    for extinction in (0.02, 0.15):
        known = truth[6].values.copy()
        known[EXTINCTION] = np.log(extinction)
        picture = np.clip(picture_under(ground, lights[6], known) + rng.normal(0.0, 0.008, (PIXELS, 3)), 0.0, 1.0)
        camera = replace(fitted, ground=ground)
        found = conditions_of(camera, picture, np.ones(PIXELS, bool), lights[6])
        error = abs(found.values[EXTINCTION] - known[EXTINCTION])
        assert error < max(3.0 * found.sigma[EXTINCTION], 0.1), (extinction, error, found.sigma[EXTINCTION])


def test_one_picture_or_a_hidden_one_is_refused(pictures, fitted):
    ground, normal, lights, _, values = pictures
    everything, nothing = np.ones(PIXELS, bool), np.zeros(PIXELS, bool)
    with pytest.raises(NoUsablePixels, match="two or more"):
        fit_fixed_camera(values[:1], [everything], lights[:1], ground.distance_km, normal)
    with pytest.raises(NoUsablePixels, match="no usable pixel"):
        conditions_of(fitted, values[6], nothing, lights[6])


def test_relit_means_take_pictures_of_like_suns_and_near_days(fitted, pictures):
    *_, lights, _, _ = pictures
    asked = replace(lights[1], day=3)
    suns = np.stack([asked.sun_direction] * 5 + [-asked.sun_direction])
    year = replace(fitted, sun_direction=suns, day=np.array([180, 120, 240, 150, 362, 3]))
    # The year is a circle: of pictures under one sun, that of 28 December alone is near 3 January.
    near = relit_at(year, asked, 4)
    np.testing.assert_allclose(relit_mean(year, asked, range(6)), near, atol=1e-3)
    np.testing.assert_array_equal(relit_mean(year, asked, [2]), relit_at(year, asked, 2))
    alike = replace(year, day=np.full(6, 3), sun_direction=np.stack([asked.sun_direction] * 6))
    mean = np.mean([relit_at(alike, asked, k) for k in (1, 2)], axis=0)
    np.testing.assert_allclose(relit_mean(alike, asked, [1, 2]), mean)


def test_kriging_leaves_out_what_is_unlike_and_equals_the_definition_of_leave_one_out(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    from realbench_kriging import gram, kriged, kriging_weights

    rng = np.random.default_rng(2)
    known = rng.normal(size=(9, 2))
    residual = np.outer(np.sin(2.0 * known[:, 0]), np.ones(50)) + rng.normal(0.0, 0.05, (9, 50))
    near = kriged(known, np.array([known[0, 0], known[0, 1]]), residual)
    assert abs(near.mean() - residual[0].mean()) < 0.25
    assert np.abs(kriged(known, np.array([1e3, 1e3]), residual)).max() < 1e-6
    assert kriging_weights(known, known[0], gram(residual)).shape == (9,)
