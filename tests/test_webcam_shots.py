"""Synthetic webcams' files: one function photographs for `run`, `paint` and `albedo`; finished ones are kept."""

import logging
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from places import MASSIF

from seasonscapes.calibration.calibration_file import read_calibration
from seasonscapes.cameras.observation import read_manifest
from seasonscapes.cameras.panorama import Panorama, level_panorama
from seasonscapes.errors import InputError, NoTerrainInView
from seasonscapes.evaluation import synthetic_webcams
from seasonscapes.images import read_image_srgb8
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import mi_mesh
from seasonscapes.sky.models import read_sky_model
from seasonscapes.workflows.albedo_recovery import with_terrain
from seasonscapes.workflows.painting import painting_inputs
from seasonscapes.workflows.photograph_files import observations, photographs_at, rows_at, uncalibrated
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workflows.synthetic_photographs import photograph_each, photograph_series
from seasonscapes.workflows.views import scene_cameras
from seasonscapes.workspace import Workspace

TIMES = [datetime(2024, 7, 20, hour, tzinfo=UTC) for hour in (8, 13)]


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """A place, its two webcams as panoramas, and where their pictures lie."""
    folder = tmp_path_factory.mktemp("webcams")
    (folder / "little.toml").write_text(MASSIF)
    options = MeshOptions(texel_m=240.0, refine=1, max_error_m=20.0)
    place = load_place(folder / "little.toml", Workspace(folder / "work"), options=options)
    size = (240, 48)
    cameras = {
        name: level_panorama(camera, place.frame, size) for name, camera in scene_cameras(place, size_px=size).items()
    }
    before = synthetic_webcams.QUICK
    synthetic_webcams.QUICK = SamplingOptions(4, 4, 16, 1, 64, 16, 8)
    model = read_sky_model("hosek")
    yield place, cameras, model, photograph_series(place, TIMES, model, folder / "shots", cameras=cameras)
    synthetic_webcams.QUICK = before


def test_a_level_panorama_turns_about_the_cameras_own_vertical(taken):
    place, cameras, _, _ = taken
    views = scene_cameras(place, size_px=(240, 48))
    from seasonscapes.calibration.pose_model import angles_from_rotation
    from seasonscapes.frames import geodetic_from_enu, local_axes

    for name, heading in (("aerial", 141.3), ("meadow", 164.3)):
        panorama = cameras[name]
        assert panorama.full_circle
        assert panorama.fx == panorama.fy
        np.testing.assert_array_equal(panorama.position_m, views[name].position_m)
        latitude, longitude, _ = geodetic_from_enu(place.frame, panorama.position_m)
        own = local_axes(place.frame, float(latitude), float(longitude)) @ panorama.world_from_camera[:3, :3]
        assert angles_from_rotation(own) == pytest.approx((heading, 0.0, 0.0), abs=1e-9)


def test_the_files_are_what_was_photographed(taken):
    place, cameras, model, sources = taken
    rows = read_manifest(sources.manifest)
    assert [(row.webcam, row.time) for row in rows] == [(name, time) for name in cameras for time in TIMES]
    made = dict(photograph_each(place, TIMES, model, {"meadow": cameras["meadow"]}))["meadow"]
    assert made[0].observation.camera.fx == cameras["meadow"].fx
    exact = read_image_srgb8(sources.manifest.parent / rows[2].path)
    # Poses apart, the pictures of `albedo --synthetic-webcams` are those that `run` writes.
    np.testing.assert_array_equal(made[0].encoded, exact)
    assert isinstance(read_calibration(sources.calibrations / "meadow_calibration.json").view, Panorama)


def test_finished_webcams_are_kept_and_others_made(taken):
    place, cameras, model, sources = taken
    folder = sources.manifest.parent
    files = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    lost = next(folder.glob("meadow_*.png"))
    content = lost.read_bytes()
    lost.unlink()
    photograph_series(place, TIMES, model, folder, cameras=cameras)
    assert lost.read_bytes() == content
    again = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert again.keys() == files.keys()
    assert all(again[name] == files[name] for name in files if name.startswith("aerial"))


def test_views_of_panoramas_serve_paint_and_albedo_alike(taken, tmp_path, caplog):
    place, _, model, sources = taken
    rows = rows_at(sources, TIMES[0], within_min=1.0)
    assert uncalibrated(rows, sources) == []
    opened = photographs_at(place, sources, TIMES[:1], within_min=1.0)
    assert {each.webcam.split("/")[0] for each in opened} == {"aerial", "meadow"}
    for painting_input, photograph in zip(painting_inputs(place, opened, model), opened, strict=True):
        assert painting_input.observation.webcam == photograph.webcam
        assert painting_input.observation.pose_sigma["heading_deg"] == 0.01
        np.testing.assert_array_equal(painting_input.observation.image, photograph.image)

    # Parts of a panorama that show sky alone are left out, and so is what a mask leaves nothing of.
    class Traced:
        ray_scene = ray_scene(mi_mesh(place.terrain, np.full(3, 0.2)))

    with caplog.at_level(logging.INFO, logger="seasonscapes"):
        kept = with_terrain(Traced, opened)
    assert 0 < len(kept) < len(opened)
    assert "left out: aerial/0: it sees none of the terrain" in caplog.text
    nothing = [replace(one, mask=np.zeros_like(one.mask)) for one in opened]
    with pytest.raises(NoTerrainInView, match="no photograph shows any of the terrain"):
        with_terrain(Traced, nothing)
    with pytest.raises(InputError, match="holds no calibration"):
        observations(rows, replace(sources, calibrations=tmp_path), place.frame)
    with pytest.raises(InputError, match="--times: no picture within"):
        photographs_at(place, sources, [TIMES[0].replace(month=3)], within_min=1.0)


def test_a_webcam_that_sees_no_land_is_named(taken):
    place, cameras, model, _ = taken
    pose = cameras["aerial"].world_from_camera.copy()
    pose[:3, 3] = [0.0, 0.0, 8900.0]  # the land lies below its rows
    with pytest.raises(InputError, match="camera 'high': sees no terrain"):
        list(photograph_each(place, TIMES[:1], model, {"high": replace(cameras["aerial"], world_from_camera=pose)}))
