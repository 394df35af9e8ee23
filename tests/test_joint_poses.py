"""Poses from points: of whole panoramas, and of each of their plane views; the same clicks, from a compass that is off."""

import numpy as np
import pytest
from places import MASSIF

from seasonscapes.calibration.calibration_file import read_calibration
from seasonscapes.calibration.pose_model import parameters_of_view
from seasonscapes.cameras.panorama import Panorama, level_panorama
from seasonscapes.errors import InputError
from seasonscapes.evaluation.webcam_faults import PoseSigmas
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workflows.plane_views import plane_views, pose_panoramas, pose_plane_views
from seasonscapes.workflows.run_methods import run_method
from seasonscapes.workflows.synthetic_photographs import write_pose
from seasonscapes.workflows.views import scene_cameras
from seasonscapes.workspace import Workspace


def heading_deg(view) -> float:
    return float(parameters_of_view(view, np.eye(3))[0])


def test_a_panorama_solved_whole_is_better_than_its_views(tmp_path):
    (tmp_path / "little.toml").write_text(MASSIF)
    place = load_place(tmp_path / "little.toml", Workspace(tmp_path / "work"), options=MeshOptions(refine=1))
    camera = scene_cameras(place, size_px=(720, 120))["aerial"]
    true = level_panorama(camera, place.frame, (720, 120))
    stated = tmp_path / "stated" / "aerial_calibration.json"
    write_pose(stated, "aerial", true, PoseSigmas(heading_deg=0.02), place.frame)
    files, doubts = pose_panoramas(place, [stated], tmp_path / "joint", points=None, seed=3)
    assert not doubts
    (record,) = [path for path in files if path.suffix == ".json"]
    found = read_calibration(record).view
    assert isinstance(found, Panorama)
    off = abs((heading_deg(found) - heading_deg(true) + 180.0) % 360.0 - 180.0)
    # A click is a pixel of half a degree; some sixty of them leave a tenth of that.
    assert 0.0 < off < 0.15
    alone, _ = pose_plane_views(place, [stated], tmp_path / "views", points=None, seed=3)
    truth = {view.name: heading_deg(view.camera) for view in plane_views("aerial", true)}
    errors = [
        abs((heading_deg(each.view) - truth[each.webcam] + 180.0) % 360.0 - 180.0)
        for each in (read_calibration(path) for path in alone if path.suffix == ".json")
    ]
    # Some of the four see too few points of their own for a heading; together all are posed.
    assert 0 < len(errors) < 4
    assert off < max(errors) < 1.0


def test_a_whole_panorama_has_no_grade():
    assert run_method("paper", poses="joint").grade == "none"
    with pytest.raises(InputError, match="plane views"):
        run_method("physical", poses="joint", grade="paper")
