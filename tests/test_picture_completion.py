"""The rest of a half-seen picture: new snow that the other pictures know, layers of the ground, nothing seen."""

import numpy as np
import pytest
from test_fixed_camera import PIXELS, _psnr, pictures  # noqa: F401  (a fixture)

from seasonscapes.albedo.fixed_camera import conditions_of, fit_fixed_camera
from seasonscapes.albedo.picture_completion import SeenPart, completed_picture, ground_layers
from seasonscapes.albedo.picture_conditions import picture_under
from seasonscapes.errors import NoUsablePixels

# Share of the snow of each picture; that of the last one is asked for.
SNOW = (0.0, 0.5, 0.0, 0.6, 0.1, 0.0, 0.35)


@pytest.fixture(scope="module")
def snowy(pictures):  # noqa: F811
    """Pictures, camera of the first six, layers, and a half of the seventh that is seen."""
    ground, normal, lights, _, values = pictures
    rng = np.random.default_rng(3)
    height = 300.0 * ground.distance_km + rng.uniform(0.0, 50.0, PIXELS)
    patches = (height > np.median(height))[:, None] * rng.random((PIXELS, 1)) * np.ones(3)
    white = [each + share * patches * (1.0 - each) for each, share in zip(values, SNOW, strict=True)]
    everywhere = [np.ones(PIXELS, bool)] * 6
    camera = fit_fixed_camera(white[:6], everywhere, lights[:6], ground.distance_km, normal)
    seen = np.arange(PIXELS) % 2 == 0
    part = SeenPart(white[6], seen, lights[6], conditions_of(camera, white[6], seen, lights[6]))
    return np.stack(white), camera, ground_layers(ground.distance_km, height), part


def test_snow_that_no_weather_explains_is_found_by_the_seen_half(snowy):
    white, camera, layers, part = snowy
    unseen = ~part.seen
    found = completed_picture(camera, white[:6], part, layers)[unseen]
    alone = picture_under(camera.ground, part.light, part.conditions.values)[unseen]
    blend = np.linalg.lstsq(white[:6][:, part.seen].reshape(6, -1).T, white[6][part.seen].ravel(), rcond=None)[0]
    blended = np.tensordot(blend, white[:6], 1)[unseen]
    truth = white[6][unseen]
    assert _psnr(found, truth) > _psnr(alone, truth) + 4.0
    assert _psnr(found, truth) > _psnr(blended, truth) + 4.0


def test_what_is_not_seen_has_no_influence(snowy):
    white, camera, layers, part = snowy
    other = SeenPart(np.where(part.seen[:, None], part.picture, 0.7), part.seen, part.light, part.conditions)
    a, b = (completed_picture(camera, white[:6], each, layers) for each in (part, other))
    np.testing.assert_array_equal(a, b)


def test_layers_share_each_pixel_and_near_ground_has_none_of_the_far():
    distance, height = np.array([0.3, 0.4, 0.5, 6.0, 7.0, 9.0]), np.array([0.0, 50.0, 200.0, 100.0, 1500.0, 3000.0])
    layers = ground_layers(distance, height)
    np.testing.assert_allclose(layers.sum(axis=1), 1.0)
    assert layers.shape == (6, 8)
    assert not layers[:3, 4:].any()
    assert not layers[3:, :4].any()
    assert ground_layers(np.array([2.0, 2.0]), np.array([0.0, 9.0])).shape == (2, 4)


def test_nothing_seen_is_refused(snowy):
    white, camera, layers, part = snowy
    blind = SeenPart(part.picture, np.zeros(PIXELS, bool), part.light, part.conditions)
    with pytest.raises(NoUsablePixels, match="no pixel"):
        completed_picture(camera, white[:6], blind, layers)
