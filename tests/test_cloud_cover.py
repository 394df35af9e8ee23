"""Clouds that hang before a mountain are found; the mountain, and snow under a blue sky, are not taken for them."""

import numpy as np
import pytest

from seasonscapes.albedo.cloud_cover import closed_clouds, clouds_before, grey_share, sky_above

WIDTH, HEIGHT = 200, 120
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
# A mountain whose top is at row 30.
TERRAIN = (30 + np.abs(COLUMNS - 100) * 0.5) <= ROWS
CLOUD = TERRAIN & (ROWS < 60)


def _picture(sky: tuple[float, float, float]) -> np.ndarray:
    rng = np.random.default_rng(1)
    image = (
        np.where(TERRAIN[..., None], (0.2, 0.25, 0.2), sky)
        + 0.05 * np.sin(COLUMNS / 3.0)[..., None] * TERRAIN[..., None]
    )
    return np.clip(image + rng.normal(0.0, 0.01, image.shape), 0.0, 1.0)


@pytest.mark.parametrize("sky", [(1.0, 1.0, 1.0), (0.8, 0.8, 0.78)])
def test_a_cloud_of_the_sky_s_brightness_is_found_and_the_slope_below_it_kept(sky):
    image = _picture(sky)
    image[CLOUD] = np.clip(np.asarray(sky) + np.random.default_rng(2).normal(0.0, 0.01, (CLOUD.sum(), 3)), 0.0, 1.0)
    found = clouds_before(image, TERRAIN)
    assert (found & CLOUD).sum() > 0.98 * CLOUD.sum()
    assert (found & ~CLOUD & (ROWS > 62)).sum() < 0.01 * TERRAIN.sum()
    assert not (found & ~TERRAIN).any()


def test_clear_pictures_lose_the_skyline_alone_and_snow_under_a_blue_sky_is_kept():
    image = _picture((0.4, 0.6, 0.95))
    image[CLOUD] = 0.97
    assert clouds_before(image, TERRAIN).sum() < 0.05 * TERRAIN.sum()


def test_bright_ground_that_does_not_touch_the_sky_is_kept():
    image = _picture((0.8, 0.8, 0.8))
    image[80:100, 60:140] = 0.8
    assert not clouds_before(image, TERRAIN)[80:100, 60:140].any()


def test_a_picture_without_sky_has_no_cloud_before_its_terrain():
    assert not clouds_before(_picture((1.0, 1.0, 1.0)), np.ones_like(TERRAIN)).any()


def test_a_sky_is_grey_as_far_as_clouds_cover_it_and_clipped_sky_tells_nothing():
    rng = np.random.default_rng(3)
    sky = np.ones((40, 50), bool)
    for share in (0.0, 0.3, 1.0):
        cloud = rng.random((40, 50, 1)) < share
        image = np.where(cloud, [0.78, 0.79, 0.81], [0.42, 0.58, 0.86])
        assert grey_share(image, sky) == pytest.approx(cloud.mean())
    assert grey_share(np.ones((40, 50, 3)), sky) is None
    few = np.zeros((40, 50), bool)
    few[0, :5] = True
    assert grey_share(np.full((40, 50, 3), 0.7), few) is None


def test_only_a_sky_seen_whole_and_grey_is_closed():
    terrain = np.zeros((60, 80), bool)
    terrain[30:] = True
    sky = sky_above(terrain)
    assert sky[:29].all()
    assert not sky[30:].any()
    cloud = np.full((60, 80, 3), 0.75)
    glare, gap = cloud.copy(), cloud.copy()
    glare[:15, :30] = 1.0
    gap[:10, :30] = 0.42, 0.58, 0.86
    assert [closed_clouds(each, sky) for each in (cloud, glare, gap)] == [True, False, False]
