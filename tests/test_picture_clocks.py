"""A camera's clock from the cast shadows in its pictures: synthetic photographs whose stated times are wrong or right."""

import logging
from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest

import seasonscapes as ss
from seasonscapes.albedo.shadow_clock import crossing_min, edge_speed_m_per_min

CLEAR = ["2024-07-18T04:40Z", "2024-07-19T05:40Z", "2024-07-21T11:00Z", "2024-07-23T17:30Z"]
OVERCAST, SLOW_MIN = "2024-07-20T06:10Z", 17.0


@pytest.fixture(scope="module")
def photographs(tmp_path_factory, few_rays):
    """A place, four clear photographs and an overcast one of its aerial camera."""
    place = ss.load_place("alpine_small")
    camera = ss.camera(place, "aerial", size_px=(96, 64))
    taken = []
    for sky, times in (("clear", CLEAR), ("overcast", [OVERCAST])):
        folder = tmp_path_factory.mktemp(sky)
        sources = ss.synthetic_photographs(place, times, folder, sky=sky, cameras={"aerial": camera})
        taken += ss.open_photographs(place, sources.manifest, sources.calibrations, times)
    return place, taken


@pytest.fixture(scope="module")
def clocks(photographs):
    """Clocks, with the first picture's time stated too early; and the warnings."""
    place, taken = photographs
    stated = [replace(taken[0], time=taken[0].time - timedelta(minutes=SLOW_MIN)), *taken[1:]]
    messages: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: messages.append(record.getMessage())
    logger = logging.getLogger("seasonscapes.workflows.picture_clocks")
    logger.addHandler(handler)
    found = ss.picture_clocks(place, stated, window_min=40.0)
    logger.removeHandler(handler)
    return stated, found, messages


def test_a_wrong_clock_is_found_within_two_minutes_and_told(clocks):
    stated, found, messages = clocks
    assert found[0].trusted
    assert found[0].doubted
    assert abs(found[0].offset_min - SLOW_MIN) <= 2.0
    assert abs(found[0].offset_min - SLOW_MIN) <= 4.0 * found[0].sigma_min
    assert len(messages) == 1
    assert stated[0].time.isoformat() in messages[0]


def test_right_clocks_are_not_doubted_and_times_stay_as_stated(clocks):
    stated, found, _ = clocks
    assert [each.time for each in found] == [each.time for each in stated]
    right = [each for each in found[1:] if each.trusted]
    # One of the three pictures that tell the ground of each has a wrong time, and a high sun's shadows barely move.
    assert sum(abs(each.offset_min) <= 2.0 for each in right) >= 2
    assert all(abs(each.offset_min) <= 3.0 * each.sigma_min for each in right)
    assert not any(each.doubted for each in found[1:])


def test_clouds_that_hide_the_sun_leave_the_clock_untold(clocks):
    overcast = clocks[1][-1]
    assert not overcast.trusted
    assert overcast.reason == "no sunlight throws shadows in it"
    assert "clock not told" in overcast.told()


def test_shadows_of_a_low_sun_run_faster_and_heights_matter_less(clocks):
    low, *others = [each for each in clocks[1] if each.trusted]
    assert low.time == clocks[0][0].time
    assert low.edge_speed_m_per_min > 5.0
    assert 0.0 < low.heights_min_per_m < 0.3
    assert others
    assert all(each.edge_speed_m_per_min < low.edge_speed_m_per_min for each in others)
    assert all(each.heights_min_per_m > low.heights_min_per_m for each in others)


def test_two_photographs_are_too_few(photographs):
    place, taken = photographs
    with pytest.raises(ss.InputError, match="2 given"):
        ss.picture_clocks(place, taken[:2])
    with pytest.raises(ss.InputError, match="10 to 180"):
        ss.picture_clocks(place, taken, window_min=5.0)


def test_an_edge_that_runs_over_a_tilted_plane_has_its_speed_and_times():
    offsets, speed = np.arange(-30.0, 31.0, 2.0), 25.0
    x, y = np.meshgrid(np.arange(40.0) * 10.0, np.arange(30.0) * 20.0)
    ground = np.stack([x, y, 0.5 * x], axis=-1)
    # Along (1, 0, 0.5), the plane's line of steepest slope.
    run = np.array([1.0, 0.0, 0.5]) / np.hypot(1.0, 0.5)
    passes = (ground @ run) / speed - 8.0
    penumbra_min = 3.0
    visible = np.clip(0.5 + (offsets[:, None, None] - passes) / penumbra_min, 0.0, 1.0)
    found = crossing_min(visible, offsets)
    inside = passes < 26.0
    np.testing.assert_allclose(found[inside], passes[inside], atol=0.3)
    assert edge_speed_m_per_min(np.where(inside, passes, np.nan), ground) == pytest.approx(speed, rel=1e-6)


def test_ground_that_stays_in_the_sun_has_no_crossing():
    assert np.isnan(crossing_min(np.ones((5, 3)), np.arange(5.0))).all()
