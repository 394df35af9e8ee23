"""What a recovery states before it starts: texels as fine as pixels see the ground."""

import json

import numpy as np
import pytest
from places import MASSIF, SCENE, write_place

from seasonscapes.calibration.calibration_file import write_calibration
from seasonscapes.calibration.pose_model import parameters_of_view
from seasonscapes.calibration.resection import Calibration
from seasonscapes.cameras.observation import ManifestRow, write_manifest
from seasonscapes.errors import InputError
from seasonscapes.workflows.photograph_files import PhotographSources
from seasonscapes.workflows.place import MeshOptions, load_place, utc_at
from seasonscapes.workflows.recovery_plan import plan_recovery
from seasonscapes.workflows.views import camera
from seasonscapes.workspace import Workspace


def sources_of(place, name: str, folder) -> PhotographSources:
    """A manifest of one picture of a scene's camera, 96 pixels wide, and its calibration."""
    view = camera(place, name, size_px=(96, 64))
    write_manifest(folder / "manifest.csv", [ManifestRow(name, utc_at(place, "2024-07-20T12:00"), f"{name}.png")])
    points = (np.zeros((0, 2)), np.zeros(0, bool))
    solved = Calibration(view, 0.0, parameters_of_view(view, np.eye(3)), np.eye(9), (), *points, 0.0)
    write_calibration(folder / f"{name}_calibration.json", name, solved, place.frame)
    return PhotographSources(folder / "manifest.csv", folder)


@pytest.mark.parametrize(("text", "name", "side_m"), [(None, "south", 3050.0), (MASSIF, "aerial", 12000.0)])
def test_places_of_files_and_synthetic_ones_are_planned(text, name, side_m, tmp_path):
    path, workspace = write_place(tmp_path), Workspace(tmp_path / "work")
    path.write_text(text or SCENE)
    place = load_place(path, workspace, options=MeshOptions(texel_m=240.0, refine=1))
    plan = plan_recovery(str(path), sources_of(place, name, tmp_path), workspace=workspace)
    assert plan.pixels == 96 * 64
    assert plan.texels == pytest.approx((side_m / plan.texel_m) ** 2, rel=0.02)
    # A pixel of 0.6 to 0.8 degrees covers some metres at half a kilometre, and tens of metres at some kilometres.
    assert 5.0 < plan.footprint_m < 100.0


def test_a_scene_without_elevation_is_one_line(tmp_path):
    scene = tmp_path / "bare.toml"
    scene.write_text(SCENE.split("[elevation]")[0])
    with pytest.raises(InputError, match="names no elevation raster"):
        plan_recovery(str(scene), PhotographSources(tmp_path / "manifest.csv", tmp_path))


def lowered(sources: PhotographSources, by_m: float) -> PhotographSources:
    """The same photograph with a record whose camera lies so much lower."""
    for path in sources.calibrations.glob("*_calibration.json"):
        record = json.loads(path.read_text(encoding="utf-8"))
        record["world_from_camera"][2][3] -= by_m
        path.write_text(json.dumps(record), encoding="utf-8")
    return sources


@pytest.mark.parametrize("depth_m", [3.0, 20.0])
def test_a_camera_in_the_ground_is_planned_from_above_it_as_it_is_used(depth_m, tmp_path):
    text = SCENE.replace("above_ground_m = 120.0", "above_ground_m = 1.0").replace(
        "pitch_deg = -8.0", "pitch_deg = 5.0"
    )
    path, workspace = write_place(tmp_path), Workspace(tmp_path / "work")
    path.write_text(text)
    place = load_place(path, workspace, options=MeshOptions(texel_m=240.0, refine=1))
    sources = sources_of(place, "south", tmp_path)
    above = plan_recovery(str(path), sources, workspace=workspace)
    inside = plan_recovery(str(path), lowered(sources, 1.0 + depth_m), workspace=workspace)
    assert np.isfinite(above.footprint_m)
    assert inside.footprint_m == pytest.approx(above.footprint_m, rel=0.05)
    assert inside.texel_m == pytest.approx(above.texel_m, rel=0.05)
    assert "see no ground" not in str(inside)
