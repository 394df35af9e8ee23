"""Calibrated cameras that come to lie in the ground: lifted where heights are known no better, left out where they are."""

import json
import logging
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import places
import pytest
from affine import Affine

import seasonscapes as ss
from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.ground_clearance import ground_tolerance_m, height_sigma_m
from seasonscapes.calibration.resection import ResectionOptions, resect
from seasonscapes.cameras.observation import read_manifest
from seasonscapes.cameras.pinhole import project
from seasonscapes.cameras.webcam import Webcam, webcam_model
from seasonscapes.errors import CameraBelowGround, InputError
from seasonscapes.frames import LocalFrame, geodetic_from_enu, local_axes
from seasonscapes.terrain.crs import geodetic_from_map
from seasonscapes.terrain.surface import Raster, mesh_up_m
from seasonscapes.workflows import photograph_files
from seasonscapes.workflows.camera_ground import ground_below
from seasonscapes.workflows.photograph_files import PhotographSources, observations
from seasonscapes.workflows.views import camera_geodetic, view_with_terrain
from seasonscapes.workflows.webcam_calibration import WebcamStation

TIME = "2024-07-20T13:30"
# Where the coarse mesh lies 1.5 m below the surface towards which it is refined about a camera.
LATITUDE_DEG, LONGITUDE_DEG = 46.57326, 7.97552


@pytest.fixture(scope="module")
def taken(tmp_path_factory, few_rays):
    """A small place and the sources of a photograph from 3 m above its ground."""
    place = ss.load_place("alpine_small")
    view = ss.Viewpoint(latitude_deg=LATITUDE_DEG, longitude_deg=LONGITUDE_DEG, above_ground_m=3.0, heading_deg=180.0)
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
    return observations(read_manifest(sources.manifest), sources, place.frame, place=place)


def _stands_m(place, sources: PhotographSources) -> float:
    """How far the photograph's camera stands above ground: some 3 m, with the error of its record."""
    (opened,) = _opened(place, sources)
    return -ground_below(place, opened.camera.position_m).depth_m


def _above_m(place, camera) -> float:
    """Height above the ground that is rendered for this camera: the mesh as it is refined about it."""
    view, terrain = view_with_terrain(place, camera)
    return float(view.position_m[2]) - mesh_up_m(terrain, view.position_m)


def test_a_camera_above_ground_stays_and_one_slightly_in_it_is_lifted(taken, tmp_path, caplog):
    place, sources = taken
    (stays,) = _opened(place, sources)
    above_m = _stands_m(place, sources)
    assert 2.0 < above_m < 4.0
    assert float(stays.camera.position_m[2]) - mesh_up_m(place.terrain, stays.camera.position_m) > above_m + 1.0
    with caplog.at_level(logging.WARNING):
        (lifted,) = _opened(place, _sunk(sources, tmp_path, above_m + 2.0))
    assert _above_m(place, lifted.camera) == pytest.approx(1.0, abs=0.1)
    assert any("2.0 m below the ground" in each.message for each in caplog.records)


@pytest.mark.parametrize("above_m", [0.1, -0.1])
def test_cameras_just_above_and_just_below_the_ground_are_lifted_to_the_same_height(above_m, taken, tmp_path, caplog):
    place, sources = taken
    with caplog.at_level(logging.WARNING):
        (lifted,) = _opened(place, _sunk(sources, tmp_path, _stands_m(place, sources) - above_m))
    assert ground_below(place, lifted.camera.position_m).depth_m == pytest.approx(-1.0, abs=0.01)
    assert any(f"0.1 m {'above' if above_m > 0.0 else 'below'} the ground" in each.message for each in caplog.records)


def test_a_series_looks_at_its_ground_once_and_tells_of_it_once(taken, tmp_path, caplog, monkeypatch):
    place, sources = taken
    sunk = _sunk(sources, tmp_path, _stands_m(place, sources) + 2.0)
    (row,) = read_manifest(sources.manifest)
    looked = []

    def counted(*arguments):
        looked.append(arguments)
        return ground_below(*arguments)

    monkeypatch.setattr(photograph_files, "ground_below", counted)
    with caplog.at_level(logging.WARNING):
        opened = observations([row] * 5, sunk, place.frame, place=place)
    assert len(looked) == 1
    assert sum("lifted" in each.message for each in caplog.records) == 1
    assert {round(ground_below(place, each.camera.position_m).depth_m, 2) for each in opened} == {-1.0}


def test_a_camera_deeper_than_heights_are_known_to_is_left_out_unless_doubtful_poses_are_taken(taken, tmp_path, caplog):
    place, sources = taken
    # Half a cell of 60 m.
    assert ground_tolerance_m([place.elevation], LATITUDE_DEG, LONGITUDE_DEG) == pytest.approx(30.0)
    (tmp_path / "near").mkdir()
    assert len(_opened(place, _sunk(sources, tmp_path / "near", _stands_m(place, sources) + 20.0))) == 1
    sunk = _sunk(sources, tmp_path, _stands_m(place, sources) + 45.0)
    with pytest.raises(InputError, match=r"4\d\.\d m below the ground of the terrain, whose heights are known to 30 m"):
        _opened(place, sunk)
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        (lifted,) = _opened(place, replace(sunk, accept_doubtful=True))
    assert _above_m(place, lifted.camera) == pytest.approx(1.0, abs=0.1)
    assert any("45.0 m below the ground" in each.message for each in caplog.records)


@pytest.mark.parametrize("above_m", [0.4, -2.0])
def test_a_stated_view_slightly_in_the_ground_is_lifted_too(above_m, taken, caplog):
    place, _ = taken
    view = ss.Viewpoint(latitude_deg=LATITUDE_DEG, longitude_deg=LONGITUDE_DEG, above_ground_m=10.0, heading_deg=180.0)
    _, _, height = camera_geodetic(place, ss.camera(place, view, size_px=(8, 8)))
    low = view.model_copy(update={"above_ground_m": None, "height_m": height - 10.0 + above_m})
    with caplog.at_level(logging.WARNING):
        camera = ss.camera(place, low, size_px=(8, 8))
    assert camera_geodetic(place, camera)[2] == pytest.approx(height - 9.0, abs=0.01)
    told = f"stands {abs(above_m):.1f} m {'above' if above_m > 0.0 else 'below'} the ground"
    assert any(told in each.message for each in caplog.records)
    with pytest.raises(InputError, match="stands below the ground"):
        ss.camera(place, low.model_copy(update={"height_m": height - 50.0}), size_px=(8, 8))


def _station(cell_m: float) -> WebcamStation:
    """A webcam stated 7 m in the ground of a basin 500 m high, with cells of this size."""
    count = round(6000.0 / cell_m)
    transform = Affine(cell_m, 0.0, places.EAST_M - 3000.0, 0.0, -cell_m, places.NORTH_M + 3000.0)
    east, north = np.meshgrid(*2 * [(np.arange(count) + 0.5) * cell_m - 3000.0])
    heights = 500.0 + 400.0 * np.exp(-(((np.hypot(east, north) - 1800.0) / 300.0) ** 2))
    basin = Raster(heights[..., None].astype(np.float32), transform, "EPSG:32632")
    latitude, longitude = (float(each) for each in geodetic_from_map("EPSG:32632", places.EAST_M, places.NORTH_M))
    webcam = Webcam(
        id="hut",
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=493.0,
        position_sigma_m=50.0,
        projection="perspective",
        width_px=1200,
        height_px=800,
        horizontal_fov_deg=50.0,
        heading_deg=0.0,
        time_zone="UTC",
    )
    frame = LocalFrame(latitude, longitude, 0.0, 0.13)
    axes = local_axes(frame, latitude, longitude)
    return WebcamStation(webcam, webcam_model(webcam, frame, ground_m=500.0), frame, axes, [basin])


def _seen_from(station: WebcamStation, height_m: float, seed: int) -> Correspondences:
    """Points of a slope before the webcam as a camera at this height sees them, to half a pixel."""
    rng = np.random.default_rng(seed)
    where = rng.uniform([-150.0, 300.0, 500.0], [150.0, 900.0, 640.0], (14, 3))
    pose = station.view.world_from_camera.copy()
    pose[2, 3] += height_m - 493.0
    pixel = project(replace(station.view, world_from_camera=pose), where)[0]
    return Correspondences(pixel + rng.normal(scale=0.5, size=pixel.shape), where)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_start_in_the_ground_that_its_prior_allows_is_solved_out_of_it(seed):
    station = _station(2.0)
    picture = np.zeros((800, 1200, 3), np.uint8)
    found = ss.calibrate(station, picture, points=_seen_from(station, 504.0, seed))
    _, _, height = (float(each) for each in geodetic_from_enu(station.frame, found.solution.view.position_m))
    assert height == pytest.approx(504.0, abs=2.0)


@pytest.mark.parametrize(("cell_m", "known_to_m"), [(2.0, 5.0), (30.0, 15.0), (93.0, 46.5)])
def test_calibration_and_what_uses_it_tolerate_the_same_depth(cell_m, known_to_m):
    station = _station(cell_m)
    at = station.webcam.latitude_deg, station.webcam.longitude_deg
    assert ground_tolerance_m(station.rasters, *at) == pytest.approx(known_to_m)
    sigma_m = height_sigma_m(station.rasters, *at)
    for depth_m, allowed in ((0.9 * known_to_m, True), (1.1 * known_to_m, False)):
        # Many sharp points far stronger than the prior of the ground.
        points = _seen_from(station, 500.0 - depth_m, 3)
        options = ResectionOptions(
            noise_px=0.01, ground_m=lambda east, north: 500.0, ground_sigma_m=sigma_m, loss="squares"
        )
        with nullcontext() if allowed else pytest.raises(CameraBelowGround, match="the solution"):
            resect(station.view, points, priors=Priors(horizontal_m=50.0, vertical_m=50.0), options=options)
