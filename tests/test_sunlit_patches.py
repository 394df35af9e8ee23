"""Sunlight on a patch of ground between cloud shadows is seen; mist, new snow, and an even hidden sun are not taken for it."""

from dataclasses import replace

import numpy as np
import pytest
from test_fixed_camera import _conditions

from seasonscapes.albedo.fixed_camera import FixedCamera
from seasonscapes.albedo.picture_conditions import Ground, ViewLight, picture_under
from seasonscapes.albedo.sunlit_patches import sun_shone, sunlit_share

WIDTH, HEIGHT = 120, 80
COUNT = WIDTH * HEIGHT
PIXEL = np.arange(COUNT)
ROWS, COLUMNS = np.divmod(PIXEL, WIDTH)
PATCH = np.hypot(ROWS - 40, COLUMNS - 70) < 12
EVERYWHERE = np.ones(COUNT, bool)


@pytest.fixture(scope="module")
def camera() -> FixedCamera:
    """Green ground with crowns a pixel or two wide, and a light of a morning."""
    rng = np.random.default_rng(11)
    crowns = np.exp(rng.normal(0.0, 0.35, (COUNT, 1)))
    reflectance = crowns * np.array([0.08, 0.1, 0.05]) * np.exp(rng.normal(0.0, 0.05, (COUNT, 3)))
    shading = np.column_stack([rng.normal(0.0, 0.1, (COUNT, 2)), np.ones(COUNT), np.full(COUNT, 0.05)])
    ground = Ground(reflectance, shading, 1.0 + 5.0 * (HEIGHT - ROWS) / HEIGHT)
    return FixedCamera(ground, [], np.empty((0, 3)), np.empty(0), np.empty((0, COUNT, 3)), np.empty(0), np.empty(0), 64)


def _light() -> ViewLight:
    azimuth, elevation = np.radians([120.0, 45.0])
    direction = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    sky, clouds = np.tile([0.16, 0.2, 0.3], (COUNT, 1)), np.ones((COUNT, 3))
    return ViewLight(np.array([1.2, 1.0, 0.75]), np.ones(COUNT), direction, sky, clouds, 180)


def _picture(camera: FixedCamera, lit: np.ndarray, ground: Ground | None = None) -> np.ndarray:
    """A picture with noise whose sun shines on ``lit`` alone."""
    light = replace(_light(), sun_visible=lit.astype(float))
    rng = np.random.default_rng(5)
    made = picture_under(ground or camera.ground, light, _conditions(0.8, 0.5, 0.03, 0.6).values)
    return np.clip(made + rng.normal(0.0, 0.004, made.shape), 0.0, 1.0)


def _share(camera: FixedCamera, picture: np.ndarray, usable: np.ndarray = EVERYWHERE) -> float:
    return sunlit_share(camera, picture, usable, _light(), PIXEL, (WIDTH, HEIGHT))


def test_a_patch_in_the_sun_is_found_by_its_size(camera):
    assert _share(camera, _picture(camera, PATCH)) == pytest.approx(PATCH.mean(), rel=0.35)


def test_ground_without_sun_has_no_patch(camera):
    assert _share(camera, _picture(camera, ~EVERYWHERE)) == 0.0


def test_warm_mist_is_not_taken_for_sun(camera):
    picture = _picture(camera, ~EVERYWHERE)
    picture[PATCH] = 0.3 * picture[PATCH] + 0.7 * np.array([0.8, 0.78, 0.7])
    assert _share(camera, picture) < 0.002


def test_new_snow_is_not_taken_for_sun(camera):
    white = np.where(PATCH[:, None], 0.5 * np.sqrt(camera.ground.reflectance.mean(axis=1, keepdims=True)), 0.0)
    snowy = replace(camera.ground, reflectance=np.maximum(camera.ground.reflectance, white))
    assert _share(camera, _picture(camera, ~EVERYWHERE, snowy)) < 0.002


def test_a_patch_that_is_masked_or_lies_where_the_sun_cannot_reach_is_none(camera):
    picture = _picture(camera, PATCH)
    assert _share(camera, picture, ~PATCH) < 0.002
    shade = np.hypot(ROWS - 40, COLUMNS - 70) < 20
    dark = replace(_light(), sun_visible=(~shade).astype(float))
    assert sunlit_share(camera, picture, EVERYWHERE, dark, PIXEL, (WIDTH, HEIGHT)) < 0.005


@pytest.mark.parametrize(
    ("lit", "direct", "closed", "shone"),
    [
        (~EVERYWHERE, 0.1, False, False),
        (~EVERYWHERE, 0.4, True, False),
        (~EVERYWHERE, 0.4, False, True),
        (PATCH, 0.1, False, True),
        (PATCH, 0.4, True, True),
    ],
)
def test_the_sun_shone_on_all_of_the_ground_or_on_a_patch_of_it(camera, lit, direct, closed, shone):
    picture = _picture(camera, lit)
    found = sun_shone(camera, direct, picture, EVERYWHERE, _light(), PIXEL, (WIDTH, HEIGHT), closed=closed)
    assert found is shone


def test_no_sun_shines_from_below_the_horizon(camera):
    night = replace(_light(), sun=np.zeros(3))
    picture = _picture(camera, PATCH)
    assert not sun_shone(camera, 0.9, picture, EVERYWHERE, night, PIXEL, (WIDTH, HEIGHT), closed=False)
