"""Land beyond the raster, which stands where the model has sky."""

import logging

import numpy as np
import places
import pytest

import seasonscapes as ss
from seasonscapes.cameras.observation import Observation
from seasonscapes.workflows.photograph_skies import without_land_beyond
from seasonscapes.workflows.place import load_place, utc_at
from seasonscapes.workspace import Workspace


@pytest.fixture(scope="module")
def valley(tmp_path_factory):
    """Land that rises northwards: to the border of its heights in the west, to a ridge before it in the east."""
    folder = tmp_path_factory.mktemp("valley")
    scene = places.write_place(folder)
    north_m = 50.0 * (30 - np.arange(61))[:, None]
    rising = 1000.0 + 0.15 * np.maximum(north_m, 0.0) * np.ones((1, 61))
    ridge = np.where(north_m > 1000.0, 1150.0 - 0.3 * (north_m - 1000.0), rising)
    places.write_raster(folder / "dem.tif", np.where(np.arange(61) < 30, rising, ridge), spacing_m=50.0)
    return load_place(scene, Workspace(folder / "work"))


def _northward(place, webcam: str = "hut") -> Observation:
    latitude, longitude = place.frame.latitude_deg, place.frame.longitude_deg
    view = ss.Viewpoint(
        latitude_deg=latitude,
        longitude_deg=longitude,
        above_ground_m=30.0,
        heading_deg=0.0,
        pitch_deg=5.0,
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
    # From the border of the heights, 6 to 8 degrees high, to 15 degrees: no ground, and no sky higher up.
    rows_per_degree = masked[0].camera.fy * np.radians(1.0)
    assert lost.sum(axis=0) == pytest.approx(8.0 * rows_per_degree, rel=0.4)
    assert west[-20:].all()
    assert west[:3].all()
    assert np.array_equal(masked[0].mask, masked[1].mask)
    told = [each.message for each in caplog.records if "end before the skyline" in each.message]
    assert len(told) == 1
    assert told[0].startswith("hut: the heights end before the skyline in ")


def test_a_synthetic_world_ends_with_its_heights():
    place = ss.load_place("alpine_small")
    camera = ss.camera(place, "meadow", size_px=(48, 32))
    seen = Observation(
        np.zeros((32, 48, 3), np.float32), np.ones((32, 48), bool), camera, utc_at(place, "2024-07-20T12:00"), "a"
    )
    assert without_land_beyond(place, [seen])[0] is seen
