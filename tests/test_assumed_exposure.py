"""Photographs without sky: what stands for their exposure and white balance, and that it is said."""

import logging
from dataclasses import replace

import numpy as np
import pytest

import seasonscapes as ss
from seasonscapes.albedo import tone_curve
from seasonscapes.albedo.assumed_exposure import with_assumed_exposure
from seasonscapes.albedo.closed_form import AlbedoFit, solve_albedo
from seasonscapes.albedo.forward_model import aerial_perspective_of
from seasonscapes.albedo.natural_colours import with_natural_colours
from seasonscapes.albedo.photographs import EIGHT_BIT, prepare_photographs
from seasonscapes.albedo.standard_error import observed_sigma
from seasonscapes.cameras.observation import Observation
from seasonscapes.images import linear_from_srgb, srgb_from_linear
from seasonscapes.workflows.albedo_recovery import RecoveryOptions, _prepared, photographs_of_ground, texel_transport
from seasonscapes.workflows.albedo_sources import scene_albedo
from seasonscapes.workflows.illumination import illumination_for_camera, sky_model
from seasonscapes.workflows.place import utc_at
from seasonscapes.workflows.recovery_methods import closed_fit

MORNING, NOON = "2024-07-20T09:00", "2024-07-20T13:30"


@pytest.fixture(scope="module")
def taken():
    """A small place, its transport, and photographs of two hours, exposed and balanced for level ground, with and without sky."""
    place = ss.load_place("alpine_small")
    camera = ss.camera(place, "aerial", size_px=(96, 64))
    with_sky, without = [], []
    for time in (MORNING, NOON):
        view = ss.render(place, camera, time, sky="clear", spp=16)
        utc = utc_at(place, time)
        light = illumination_for_camera(place, camera, sky_model("clear"), utc)[0]
        linear = np.clip(view.radiance * np.pi / light.global_horizontal_lx, 0.0, 1.0)
        picture = linear_from_srgb(np.round(255.0 * srgb_from_linear(linear)) / 255.0).astype(np.float32)
        ground = np.isfinite(view.gbuffer.depth)
        with_sky.append(Observation(picture, np.ones_like(ground), camera, utc, "hut"))
        without.append(Observation(picture, ground, camera, utc, "hut"))
    return place, texel_transport(place), with_sky, without


def _error(place, fit) -> tuple[float, float]:
    """Errors of the mean albedo over measured texels: of its brightness, and of its colour, relative."""
    seen = fit.pixel_count > 0.5
    ratio = fit.albedo[seen].mean(axis=0) / scene_albedo(place, "2024-07-20").values[seen].mean(axis=0)
    return abs(float(np.log(ratio.mean()))), float(np.ptp(ratio) / ratio.mean())


def test_without_sky_albedo_has_the_cameras_own_brightness_and_colour(taken, caplog):
    place, transport, _, without = taken
    with caplog.at_level(logging.WARNING):
        prepared, _, _ = photographs_of_ground(place, transport, without, sky_model("clear"))
    assert sum("exposure and white balance" in each.message for each in caplog.records) == 1
    brightness, colour = _error(place, closed_fit(transport, prepared))
    assert brightness < 0.1
    assert colour < 0.06
    # The airlight before the terrain is all that told them otherwise.
    unknown = [replace(each, gain=None) for each in prepared]
    worse = _error(place, solve_albedo(transport, unknown, noise_model=EIGHT_BIT))
    assert worse[0] > 2.0 * brightness or worse[1] > 2.0 * colour


def test_one_photograph_of_a_day_is_assumed_and_the_sky_comes_first(taken):
    place, transport, with_sky, without = taken
    lights = [illumination_for_camera(place, each.camera, sky_model("clear"), each.time)[0] for each in without]
    dark = prepare_photographs(transport, without, lights)
    gains = [each.gain for each in with_assumed_exposure(dark)]
    assert gains[0] is None
    assert gains[1] == pytest.approx(np.pi / lights[1].global_horizontal_lx)
    seen = prepare_photographs(transport, [without[0], with_sky[1]], lights)
    assert [each.gain for each in with_assumed_exposure(seen)] == [None, None]


def test_every_camera_has_its_own_exposure_whatever_the_order(taken):
    place, transport, _, without = taken
    noon = without[1]
    views = [replace(noon, webcam=name) for name in ("hut", "mast", "mast/0", "mast/1")]
    lights = [illumination_for_camera(place, each.camera, sky_model("clear"), each.time)[0] for each in views]
    for order in ([0, 1], [1, 0], [2, 3], [0, 2, 3]):
        prepared = prepare_photographs(transport, [views[k] for k in order], [lights[k] for k in order])
        assert all(each.gain is not None for each in with_assumed_exposure(prepared))


def test_exposures_of_the_night_are_not_assumed(taken, caplog):
    place, transport, _, without = taken
    night = replace(without[0], time=utc_at(place, "2024-07-22T01:00"))
    pictures = [without[1], night]
    with caplog.at_level(logging.WARNING):
        gains = [each.gain for each in photographs_of_ground(place, transport, pictures, sky_model("clear"))[0]]
    assert gains[0] is not None
    assert gains[1] is None
    assert [each.message for each in caplog.records if each.message.startswith("2024-07-21: ")]
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        alone = photographs_of_ground(place, transport, pictures[1:], sky_model("clear"))[0]
    assert alone[0].gain is None
    assert not any("set for level ground" in each.message for each in caplog.records)
    assert sum("at night" in each.message for each in caplog.records) == 1


def test_the_tone_curve_of_one_such_photograph_is_not_guessed(taken, monkeypatch):
    place, transport, _, without = taken
    monkeypatch.setattr(tone_curve, "fit_tone_curve", lambda *given, **named: tone_curve.ToneCurveFit(0.4, {}))
    options = RecoveryOptions(fit_curve=True)
    one = _prepared(place, transport, without[:1], sky_model("clear"), options, None)[2]
    two = _prepared(place, transport, without, sky_model("clear"), options, None)[2]
    assert "curve_strength" not in one
    assert one["exposure"].startswith("assumed")
    assert two["curve_strength"] == 0.4


def _of_noon(taken, picture_of):
    """The noon photograph without sky, prepared, its picture changed by ``picture_of(picture, photograph)``."""
    place, transport, _, without = taken
    light = illumination_for_camera(place, without[1].camera, sky_model("clear"), without[1].time)[0]
    first = with_assumed_exposure(prepare_photographs(transport, [without[1]], [light]))[0]
    changed = replace(first.observation, image=picture_of(first.observation.image, first).astype(np.float32))
    return transport, replace(first, observation=changed)


def test_land_bluer_than_land_is_told_as_the_cameras_balance(taken):
    def near(picture, photograph):
        """The picture without the kilometres of air before all of its ground."""
        count = len(photograph.footprints.pixel)
        transmittance, air = aerial_perspective_of(photograph.atmosphere, photograph.light, count)
        bare = picture.reshape(-1, 3).copy()
        seen = photograph.footprints.pixel
        bare[seen] = np.clip((bare[seen] - photograph.gain * air) / transmittance, 0.002, 0.95)
        return bare.reshape(picture.shape)

    transport, as_it_was = _of_noon(taken, near)
    _, blue = _of_noon(taken, lambda picture, photograph: np.minimum(near(picture, photograph) * [0.8, 0.9, 1.7], 0.95))
    as_it_was, blue = (replace(each, light=replace(each.light, aerial_perspective=None)) for each in (as_it_was, blue))
    kept = with_natural_colours(transport, [as_it_was])[0]
    balanced = with_natural_colours(transport, [blue])[0]
    before, after = kept.gain / as_it_was.gain, balanced.gain / blue.gain
    np.testing.assert_array_equal(before, 1.0)
    # Shaded snow of this place is bluer than neutral by less than a white balance is known; beyond that it is made neutral.
    assert 1.7 / 0.8 < after[2] / after[0] < 1.35 * 1.7 / 0.8
    # The corrected photograph has nothing left to correct, and others are not touched.
    np.testing.assert_allclose(with_natural_colours(transport, [balanced])[0].gain, balanced.gain)
    assert with_natural_colours(transport, [replace(blue, gain=None)])[0].gain is None


def test_blue_air_before_far_land_is_not_the_lands_colour(taken):
    def bluer(picture, photograph):
        air = aerial_perspective_of(photograph.atmosphere, photograph.light, len(photograph.footprints.pixel))[1]
        more = np.zeros_like(picture).reshape(-1, 3)
        more[photograph.footprints.pixel, 2] = photograph.gain[2] * 3.0 * air[:, 2]
        return np.minimum(picture + more.reshape(picture.shape), 0.95)

    transport, plain = _of_noon(taken, lambda picture, _: picture)
    _, hazy = _of_noon(taken, bluer)
    true = closed_fit(transport, [plain])
    far = true.pixel_count > 0.5
    errors = []
    for photograph in (hazy, with_natural_colours(transport, [hazy])[0]):
        fit = closed_fit(transport, [photograph])
        ratio = fit.albedo[far].mean(axis=0) / true.albedo[far].mean(axis=0)
        errors.append(float(np.log(ratio[2] / ratio[0])))
    assert errors[0] > 0.1
    assert abs(errors[1]) < 0.6 * errors[0]


def test_green_of_the_air_changes_with_its_blue(taken):
    factor = np.array([1.0, 4.0**0.38, 4.0])

    def hazier(picture, photograph):
        air = aerial_perspective_of(photograph.atmosphere, photograph.light, len(photograph.footprints.pixel))[1]
        more = np.zeros_like(picture).reshape(-1, 3)
        more[photograph.footprints.pixel] = photograph.gain * (factor - 1.0) * air
        return np.minimum(picture + more.reshape(picture.shape), 0.95)

    transport, hazy = _of_noon(taken, hazier)
    corrected = with_natural_colours(transport, [hazy])[0]
    count = len(hazy.footprints.pixel)
    before, after = (aerial_perspective_of(each.atmosphere, each.light, count)[1] for each in (hazy, corrected))
    found = np.median(after / before, axis=0)
    assert found[2] > 2.0
    assert found[1] == pytest.approx(found[2] ** 0.38, rel=0.1)


def test_noise_of_single_pixels_is_not_blue_land(taken):
    random = np.random.default_rng(3)
    transport, plain = _of_noon(taken, lambda picture, _: picture)
    noise = random.normal(0.0, 0.06, plain.observation.image.shape[:2])[..., None] * [0.0, 0.0, 1.0]
    _, noisy = _of_noon(taken, lambda picture, _: np.clip(picture + noise, 0.01, 0.95))
    kept, corrected = (with_natural_colours(transport, [each])[0] for each in (plain, noisy))
    np.testing.assert_allclose(corrected.gain, kept.gain, rtol=0.02)
    count = len(plain.footprints.pixel)
    before, after = (aerial_perspective_of(each.atmosphere, each.light, count)[1] for each in (kept, corrected))
    assert (np.abs(np.median(after / before, axis=0) - 1.0) < 0.2).all()


def test_pixels_that_a_mask_leaves_out_measure_no_texel(taken):
    place, transport, _, without = taken
    light = illumination_for_camera(place, without[1].camera, sky_model("clear"), without[1].time)[0]
    mask = without[1].mask.copy()
    mask[:, : mask.shape[1] // 2] = False
    half, whole = (
        closed_fit(transport, with_assumed_exposure(prepare_photographs(transport, [each], [light])))
        for each in (replace(without[1], mask=mask), without[1])
    )
    seen, all_seen = half.pixel_count > 0.0, whole.pixel_count > 0.0
    assert 0.2 < seen.sum() / all_seen.sum() < 0.8
    assert not (half.information > 0.0)[~seen].any()


def test_texels_cut_by_the_border_of_a_picture_are_not_measured():
    count = np.zeros((6, 6), np.float32)
    count[:, :3] = 20.0
    count[:, 3] = 5.0
    ridge = np.full((6, 6), 20.0, np.float32)
    ridge[:, 3] = 5.0
    known = []
    for pixels in (count, ridge):
        shape = pixels.shape
        fit = AlbedoFit(np.full((*shape, 3), 0.3), pixels, 1e6 * pixels, np.ones((1, 3)), np.array([0.01]), 0.0)
        known.append(np.isfinite(observed_sigma(fit)))
    assert known[0][:, :3].all()
    assert not known[0][:, 3].any()
    # Amid others that are seen, foreshortened texels are measured.
    assert known[1].all()
