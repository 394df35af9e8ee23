"""Calibrated cameras that come to lie in the ground: lifted where heights are known no better, left out where they are."""

import json
import logging
from dataclasses import replace

import pytest

import seasonscapes as ss
from seasonscapes.cameras.observation import read_manifest
from seasonscapes.errors import InputError
from seasonscapes.terrain.surface import mesh_up_m
from seasonscapes.workflows.photograph_files import PhotographSources, observations
from seasonscapes.workflows.views import camera_geodetic

TIME = "2024-07-20T13:30"


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """A small place and the sources of a photograph from 3 m above its ground."""
    place = ss.load_place("alpine_small")
    view = ss.Viewpoint(latitude_deg=46.556, longitude_deg=7.98, above_ground_m=3.0, heading_deg=180.0)
    camera = ss.camera(place, view, size_px=(48, 32))
    folder = tmp_path_factory.mktemp("hut")
    sources = ss.synthetic_photographs(place, [TIME], folder, sky="hosek", cameras={"hut": camera})
    return place, PhotographSources(sources.manifest, sources.calibrations)


def _sunk(sources: PhotographSources, folder, by_m: float) -> PhotographSources:
    """The same photograph with a record whose camera lies so much lower."""
    for record in sources.calibrations.glob("*_calibration.json"):
        content = json.loads(record.read_text(encoding="utf-8"))
        content["world_from_camera"][2][3] -= by_m
        (folder / record.name).write_text(json.dumps(content), encoding="utf-8")
    return replace(sources, calibrations=folder)


def _opened(place, sources: PhotographSources):
    rows = read_manifest(sources.manifest)
    return observations(rows, sources, place.frame, terrain=place.terrain)


def _above_m(place, opened) -> float:
    position = opened[0].camera.position_m
    return float(position[2]) - mesh_up_m(place.terrain, position)


def test_a_camera_above_ground_stays_and_one_slightly_in_it_is_lifted(taken, tmp_path, caplog):
    place, sources = taken
    above_m = _above_m(place, _opened(place, sources))
    # The mesh lies lower than the samples on which the camera was placed.
    assert 3.0 < above_m < 4.5
    with caplog.at_level(logging.WARNING):
        opened = _opened(place, _sunk(sources, tmp_path, above_m + 2.0))
    assert _above_m(place, opened) == pytest.approx(1.0, abs=0.05)
    assert any("2.0 m below the ground" in each.message for each in caplog.records)


def test_a_camera_deep_in_the_ground_is_left_out_unless_doubtful_poses_are_taken(taken, tmp_path):
    place, sources = taken
    sunk = _sunk(sources, tmp_path, _above_m(place, _opened(place, sources)) + 27.0)
    with pytest.raises(InputError, match=r"27\.0 m below the ground"):
        _opened(place, sunk)
    assert _above_m(place, _opened(place, replace(sunk, accept_doubtful=True))) == pytest.approx(1.0, abs=0.05)


def test_a_stated_view_slightly_in_the_ground_is_lifted_too(taken, caplog):
    place, _ = taken
    view = ss.Viewpoint(latitude_deg=46.556, longitude_deg=7.98, above_ground_m=10.0, heading_deg=180.0)
    _, _, height = camera_geodetic(place, ss.camera(place, view, size_px=(8, 8)))
    low = view.model_copy(update={"above_ground_m": None, "height_m": height - 12.0})
    with caplog.at_level(logging.WARNING):
        camera = ss.camera(place, low, size_px=(8, 8))
    assert camera_geodetic(place, camera)[2] == pytest.approx(height - 9.0, abs=0.01)
    assert any("stands 2.0 m below the ground" in each.message for each in caplog.records)
