"""Land beyond the raster, which stands where the model has sky."""

import logging
from dataclasses import replace

import numpy as np
import places
import pytest

import seasonscapes as ss
from seasonscapes.cameras.observation import Observation
from seasonscapes.cameras.pinhole import ray_directions
from seasonscapes.workflows.photograph_skies import without_land_beyond
from seasonscapes.workflows.place import load_place, utc_at
from seasonscapes.workspace import Workspace


@pytest.fixture(scope="module")
def valley(tmp_path_factory):
    """Land that rises northwards: to the border of its heights in the west, to a ridge before it in the east."""
    north_m = 50.0 * (30 - np.arange(61))[:, None]
    rising = 1000.0 + 0.15 * np.maximum(north_m, 0.0) * np.ones((1, 61))
    ridge = np.where(north_m > 1000.0, 1150.0 - 0.3 * (north_m - 1000.0), rising)
    return _place_of(tmp_path_factory.mktemp("valley"), np.where(np.arange(61) < 30, rising, ridge))


def _place_of(folder, heights_m: np.ndarray):
    """A place of 3 km with such heights ``(61, 61)``."""
    scene = places.write_place(folder)
    places.write_raster(folder / "dem.tif", heights_m, spacing_m=50.0)
    return load_place(scene, Workspace(folder / "work"))


def _around(slope: float) -> np.ndarray:
    """Heights ``(61, 61)`` [m] that rise, or fall, from the middle to all sides."""
    side_m = 50.0 * (np.arange(61) - 30)
    return 1000.0 + slope * np.hypot(side_m[:, None], side_m)


def _elevation_deg(camera) -> np.ndarray:
    return np.degrees(np.arcsin(ray_directions(camera)[..., 2]))


def _northward(place, webcam: str = "hut", *, pitch_deg: float = 5.0, above_ground_m: float = 30.0) -> Observation:
    latitude, longitude = place.frame.latitude_deg, place.frame.longitude_deg
    view = ss.Viewpoint(
        latitude_deg=latitude,
        longitude_deg=longitude,
        above_ground_m=above_ground_m,
        heading_deg=0.0,
        pitch_deg=pitch_deg,
        fov_deg=50.0,
    )
    camera = ss.camera(place, view, size_px=(96, 64))
    picture = np.full((64, 96, 3), 0.5, np.float32)
    return Observation(picture, np.ones((64, 96), bool), camera, utc_at(place, "2024-07-20T12:00"), webcam)


def test_sky_above_the_border_of_the_heights_is_masked_and_above_a_ridge_it_is_not(valley, caplog):
    seen = _northward(valley)
    with caplog.at_level(logging.WARNING):
        masked = without_land_beyond(valley, [seen, seen])
    west, east = masked[0].mask[:, 4:40], masked[0].mask[:, 56:92]
    assert east.all()
    lost = ~west
    assert lost.any(axis=0).all()
    # From the border of the heights, 6 to 8 degrees high, to where slopes of 1 : 2 rise by the relief of all heights once more.
    height_deg = _elevation_deg(seen.camera)
    crest_m = 1500.0 + 225.0 / 0.5
    crest_deg = np.degrees(np.arctan((225.0 + 225.0 - 30.0) / crest_m))
    middle = lost[:, 34:36]
    assert height_deg[:, 4:40][:, 34:36][middle].min() == pytest.approx(7.4, abs=0.8)
    assert height_deg[:, 4:40][:, 34:36][middle].max() == pytest.approx(crest_deg, abs=0.8)
    assert west[-20:].all()
    assert west[:3].all()
    assert np.array_equal(masked[0].mask, masked[1].mask)
    told = [each.message for each in caplog.records if "end before the skyline" in each.message]
    assert len(told) == 1
    assert told[0].startswith("hut: the heights end before the skyline in ")


def test_land_that_rises_to_its_border_on_all_sides_is_masked(tmp_path, caplog):
    """No azimuth has a known skyline then."""
    bowl = _place_of(tmp_path, _around(0.15))
    seen = _northward(bowl)
    with caplog.at_level(logging.WARNING):
        mask = without_land_beyond(bowl, [seen])[0].mask
    assert (~mask).any(axis=0).all()
    assert sum("in 100 % of its columns" in each.message for each in caplog.records) == 1
    height_deg = _elevation_deg(seen.camera)
    assert mask[height_deg > 15.0].all()
    assert (height_deg > 15.0).any()
    assert not mask[(height_deg > 8.0) & (height_deg < 9.0)].any()


@pytest.mark.parametrize("slope", [-0.4, 0.0])
def test_a_camera_above_land_that_does_not_rise_keeps_its_sky(tmp_path, slope):
    """Below the horizon there is none, whatever lies there."""
    cone = _place_of(tmp_path, _around(slope))
    seen = _northward(cone, pitch_deg=-5.0)
    mask = without_land_beyond(cone, [seen])[0].mask
    height_deg = _elevation_deg(seen.camera)
    assert mask[height_deg > 0.0].all()
    assert (height_deg > 0.0).any(axis=0).all()
    border_deg = -np.degrees(np.arctan((30.0 - 1500.0 * slope) / 1500.0))
    between = (height_deg[:, 47:49] < -1.5) & (height_deg[:, 47:49] > max(border_deg, -10.0) + 1.0)
    assert between.any() == (slope < 0.0)
    assert not mask[:, 47:49][between].any()


def test_a_far_border_and_a_near_one_hide_different_shares_of_the_sky(tmp_path):
    """Land beyond a border at half the distance may stand higher."""
    highest = []
    for folder, north_m in (("near", 600.0), ("far", 0.0)):
        valley = _place_of(
            tmp_path / folder, 1000.0 + 0.15 * np.maximum(50.0 * (30 - np.arange(61)), 0.0)[:, None] + np.zeros((1, 61))
        )
        view = _northward(valley)
        camera = view.camera
        pose = camera.world_from_camera.copy()
        pose[1, 3] += north_m
        pose[2, 3] += 0.15 * north_m
        moved = replace(view, camera=replace(camera, world_from_camera=pose))
        lost = ~without_land_beyond(valley, [moved])[0].mask
        highest.append(_elevation_deg(moved.camera)[:, 47:49][lost[:, 47:49]].max())
    assert highest[0] > highest[1] + 1.0


def test_cameras_that_differ_in_their_principal_point_have_masks_of_their_own(valley):
    seen = _northward(valley)
    shifted = replace(seen, camera=replace(seen.camera, cy=seen.camera.cy + 8.0))
    first, second = (each.mask for each in without_land_beyond(valley, [seen, shifted]))
    assert np.array_equal(second[8:], first[:-8])
    assert not np.array_equal(second, first)


def test_heights_that_end_lower_than_a_finer_part_of_them(valley):
    """A wall that the finer heights alone have is the skyline."""
    seen = _northward(valley)
    fine = valley.elevation
    values = fine.values.copy()
    values[5:8] += 400.0
    finer = replace(valley, finer_heights=(replace(fine, values=values),))
    assert not without_land_beyond(valley, [seen])[0].mask.all()
    assert without_land_beyond(finer, [seen])[0].mask.all()


def test_a_synthetic_world_ends_with_its_heights():
    place = ss.load_place("alpine_small")
    camera = ss.camera(place, "meadow", size_px=(48, 32))
    seen = Observation(
        np.zeros((32, 48, 3), np.float32), np.ones((32, 48), bool), camera, utc_at(place, "2024-07-20T12:00"), "a"
    )
    assert without_land_beyond(place, [seen])[0] is seen
