"""Clouds that photographs show in their own skies, in the recovery of albedo."""

import logging
from dataclasses import replace

import numpy as np
import pytest

import seasonscapes as ss
from seasonscapes.albedo import joint_recovery
from seasonscapes.albedo.recovery_rounds import JointOptions, make_problem
from seasonscapes.errors import NotEnoughEvidence
from seasonscapes.rendering.sightlines import visible_faces
from seasonscapes.sky.models import with_overrides
from seasonscapes.workflows import albedo_recovery
from seasonscapes.workflows.albedo_recovery import RecoveryOptions, _prepared, recovered_over, texel_transport
from seasonscapes.workflows.illumination import sky_model
from seasonscapes.workflows.photograph_skies import photograph_skies
from seasonscapes.workflows.recovery_methods import PaintedTexture


@pytest.fixture(scope="module")
def taken(tmp_path_factory, few_rays):
    """A small place, its texels' transport, and one photograph of it under a clear sky and one under clouds."""
    place = ss.load_place("alpine_small")
    times = ["2024-07-20T16:00"]
    camera = ss.camera(place, "aerial", size_px=(96, 64))
    observations = []
    for name, sky in (("clear", "clear"), ("clouds", "overcast")):
        folder = tmp_path_factory.mktemp(name)
        sources = ss.synthetic_photographs(place, times, folder, sky=sky, cameras={"aerial": camera})
        observations += ss.open_photographs(place, sources.manifest, sources.calibrations, times)
    return place, texel_transport(place), observations


def _with_sky(taken, number: int, colour) -> "ss.Observation":
    _, transport, observations = taken
    each = observations[number]
    sky = visible_faces(transport.ray_scene, each.camera) < 0
    return replace(each, image=np.where(sky[..., None], np.float32(colour), each.image), webcam=f"cam{number}")


def test_a_grey_sky_is_taken_as_clouds_and_a_blue_one_is_not(taken):
    place, transport, _ = taken
    clear = sky_model("clear")
    blue, grey = _with_sky(taken, 0, (0.12, 0.25, 0.6)), _with_sky(taken, 1, (0.5, 0.5, 0.52))
    found = photograph_skies(place, transport, [blue, grey], clear)
    assert [each.cloudiness for each in found] == [0.0, 1.0]
    for cloudiness in (0.3, 0.0):
        stated = with_overrides(clear, cloudiness=cloudiness)
        assert [each.cloudiness for each in photograph_skies(place, transport, [grey], stated)] == [cloudiness]


def test_views_of_a_panorama_have_the_sky_that_any_of_them_tells(taken):
    place, transport, _ = taken
    clear = sky_model("clear")
    grey, blue = _with_sky(taken, 1, (0.5, 0.5, 0.52)), _with_sky(taken, 0, (0.12, 0.25, 0.6))
    ground = visible_faces(transport.ray_scene, grey.camera) >= 0
    views = [replace(grey, webcam="hut/0"), replace(grey, webcam="hut/1", mask=ground)]
    assert [each.cloudiness for each in photograph_skies(place, transport, views, clear)] == [1.0, 1.0]
    assert [each.cloudiness for each in photograph_skies(place, transport, views[::-1], clear)] == [1.0, 1.0]
    # Of the sky, one view shows about a tenth.
    rows = np.cumsum((~ground).sum(axis=1))
    few = (np.arange(len(rows)) <= np.searchsorted(rows, rows[-1] / 10))[:, None] & ~ground
    views = [replace(blue, webcam="hut/0"), replace(grey, webcam="hut/1", mask=few | ground)]
    assert [each.cloudiness for each in photograph_skies(place, transport, views, clear)] == [0.0, 0.0]
    views = [replace(grey, webcam="hut/0"), replace(blue, webcam="hut/1", mask=few | ground)]
    first, second = (each.cloudiness for each in photograph_skies(place, transport, views, clear))
    assert first == second
    assert 0.7 < first < 0.95
    # Other webcams and other instants have their own.
    mixed = [replace(grey, webcam="hut/0"), replace(blue, webcam="mast/0")]
    assert [each.cloudiness for each in photograph_skies(place, transport, mixed, clear)] == [1.0, 0.0]


def test_a_low_sun_is_named_as_the_reason_that_the_weather_is_not_told(taken, caplog):
    place, transport, _ = taken
    grey = _with_sky(taken, 1, (0.5, 0.5, 0.52))
    evening = replace(grey, time=grey.time.replace(hour=18, minute=45))
    covered = replace(grey, webcam="mast", mask=visible_faces(transport.ray_scene, grey.camera) >= 0)
    with caplog.at_level(logging.WARNING):
        photograph_skies(place, transport, [evening, covered], sky_model("clear"))
    low, unseen = sorted(each.message for each in caplog.records if "weather is not told" in each.message)
    assert low.startswith("cam1 2024-07-20 18:45 UTC: ")
    assert "the sun stands lower than 10°" in low
    assert "no unclipped sky" not in low
    assert unseen.startswith("mast 2024-07-20 14:00 UTC: ")
    assert "no unclipped sky away from the sun is seen" in unseen


def test_a_low_sun_and_a_synthetic_clear_sky_stay_clear(taken):
    place, transport, observations = taken
    clear = sky_model("clear")
    grey = _with_sky(taken, 1, (0.5, 0.5, 0.52))
    evening = replace(grey, time=grey.time.replace(hour=18, minute=45))
    assert [each.cloudiness for each in photograph_skies(place, transport, [observations[0], evening], clear)] == [
        0.0,
        0.0,
    ]


def test_a_picture_whose_weather_is_not_told_is_named(taken, caplog):
    place, transport, _ = taken
    seen = _with_sky(taken, 0, (0.12, 0.25, 0.6))
    ground = visible_faces(transport.ray_scene, seen.camera) >= 0
    views = [replace(seen, webcam="hut/0", mask=ground), replace(seen, webcam="hut/1")]
    alone = replace(seen, webcam="mast", mask=ground)
    with caplog.at_level(logging.WARNING):
        found = photograph_skies(place, transport, [*views, alone], sky_model("clear"))
    assert [each.cloudiness for each in found] == [0.0, 0.0, 0.0]
    told = [each.message for each in caplog.records if "weather is not told" in each.message]
    assert len(told) == 1
    assert told[0].startswith("mast 2024-07-20 14:00 UTC: ")
    caplog.clear()
    photograph_skies(place, transport, [alone], with_overrides(sky_model("clear"), cloudiness=0.3))
    assert not caplog.records


def test_albedo_is_recovered_under_the_clouds_that_a_photograph_shows(taken):
    """The light of the recovery is dimmer and less blue where the photograph's sky is grey."""
    place, transport, _ = taken
    blue, grey = _with_sky(taken, 0, (0.12, 0.25, 0.6)), _with_sky(taken, 1, (0.5, 0.5, 0.52))
    prepared, _, _ = _prepared(place, transport, [blue, grey], sky_model("clear"), RecoveryOptions(), None)
    suns = [each.light.sun for each in prepared]
    direct = [0.0 if sun is None else float(np.sum(sun.normal_illuminance_lx)) for sun in suns]
    assert direct[1] < 0.3 * direct[0]
    colour = [each.light.sky_radiance[: each.light.sky_radiance.shape[0] // 2].mean((0, 1)) for each in prepared]
    assert colour[1][2] / colour[1][0] < 0.7 * colour[0][2] / colour[0][0]


def test_the_joint_recovery_starts_from_the_sky_of_each_photograph(taken, monkeypatch):
    """At every visibility, and two photographs of one moment do not share their light."""
    place, transport, _ = taken
    blue, grey = _with_sky(taken, 0, (0.12, 0.25, 0.6)), _with_sky(taken, 1, (0.5, 0.5, 0.52))
    tried = []

    def recovered(transport, photographs, start, *, haze, progress):
        problem = make_problem(transport, photographs, haze, start.noise_model, start.gains, JointOptions())
        tried.append([picture.instant for picture in problem.pictures])
        tried.extend([light.cloudiness for light in lights] for lights in haze.lights)
        raise NotEnoughEvidence("far enough for this test")

    monkeypatch.setattr(joint_recovery, "recover_jointly", recovered)
    options = RecoveryOptions(method="differentiable")
    with pytest.raises(NotEnoughEvidence):
        recovered_over(place, transport, [blue, grey], sky_model("clear"), options)
    assert tried[0] == [0, 1]
    assert len(tried) > 3
    assert all(each == [0.0, 1.0] for each in tried[1:])


def test_a_painting_is_taken_under_the_sky_that_it_was_painted_under(taken, monkeypatch):
    place, transport, _ = taken
    clear, shape, tried = sky_model("clear"), (*place.texture_shape, 3), []
    lit = ss.Texture(np.full(shape, 2e3, np.float32), np.ones(shape[:2], np.float32))
    blue = _with_sky(taken, 0, (0.12, 0.25, 0.6))
    cloudy = with_overrides(clear, cloudiness=0.7)
    painted = [PaintedTexture(blue.time, lit), PaintedTexture(blue.time, lit, sky=cloudy)]

    def fitted(transport, prepared, progress):
        tried.extend(each.light.cloudiness for each in prepared)
        raise NotEnoughEvidence("far enough for this test")

    # No albedo explains an even painting in sun and shade: what counts is the light that it is fitted under.
    monkeypatch.setattr(albedo_recovery, "closed_fit", fitted)
    with pytest.raises(NotEnoughEvidence, match="far enough"):
        recovered_over(place, transport, [blue], clear, RecoveryOptions(), painted)
    assert tried == [0.0, 0.0, 0.7]
