"""``seasonscapes paint`` on a small real place: files in, files out, and errors that say what to do."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import numpy as np
import pytest
from places import write_place

from seasonscapes.calibration.calibration_file import read_calibration
from seasonscapes.cameras.observation import ManifestRow, write_manifest
from seasonscapes.cameras.pinhole import pose_in_frame, project
from seasonscapes.cli import main
from seasonscapes.evaluation.webcam_faults import PoseSigmas
from seasonscapes.frames import LocalFrame, enu_from_geodetic
from seasonscapes.images import write_png8
from seasonscapes.terrain.surface import load_texture
from seasonscapes.workflows.place import load_place
from seasonscapes.workflows.synthetic_photographs import write_pose
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import Workspace

NOON = datetime(2024, 9, 1, 10, tzinfo=UTC)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A hill, a picture of it and its calibration, as other verbs leave them."""
    folder = tmp_path_factory.mktemp("town")
    scene = write_place(folder / "hill")
    place = load_place(scene, Workspace(folder / "work"))
    camera = camera_for(place, place.scene.cameras[0], size_px=(120, 80))
    picture = np.full((80, 120, 3), 90, np.uint8)
    picture[:30] = [120, 150, 200]
    write_png8(folder / "pictures" / "south.png", picture)
    write_manifest(folder / "pictures" / "manifest.csv", [ManifestRow("south", NOON, "south.png")])
    write_pose(folder / "poses" / "south_calibration.json", "south", camera, PoseSigmas(heading_deg=0.02), place.frame)
    return folder, scene, camera


def arguments(town, *more, time="2024-09-01T10:00Z"):
    folder, scene, _ = town
    return [
        "paint",
        str(scene),
        "--time",
        time,
        "--manifest",
        str(folder / "pictures" / "manifest.csv"),
        "--calibrations",
        str(folder / "poses"),
        "--workspace",
        str(folder / "work"),
        "-o",
        str(folder / "out"),
        "--sky",
        "hosek",
        *more,
    ]


def test_paint_writes_what_it_says(town, capsys):
    assert main(arguments(town, "--json")) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["webcams"] == ["south"]
    assert record["painted_share"] == pytest.approx(sum(record["shares"]))
    assert record["painted_share"] > 0.05
    texture = load_texture(record["painted"])
    assert np.mean(texture.weight > 0.0) == pytest.approx(record["painted_share"])
    assert (texture.values[texture.weight > 0.0] > 0.0).all()
    # "The first camera wins" is the same texture where there is one camera.
    assert main(arguments(town, "--json", "--mode", "first")) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["mode"] == "first"
    np.testing.assert_array_equal(load_texture(record["painted"]).values, texture.values)


@pytest.mark.parametrize(
    ("more", "time", "line"),
    [
        (("--mode", "best"), "2024-09-01T10:00Z", "--mode: unknown mode"),
        ((), "2024-09-02T10:00Z", "--time: no picture within 30 minutes"),
        (("--synthetic-webcams",), "2024-09-01T10:00Z", "--manifest: does nothing without real photographs"),
        (("--near-m", "-5"), "2024-09-01T10:00Z", "--near-m: out of range"),
        (("--near-m", "50000"), "2024-09-01T10:00Z", "no usable pixel shows terrain"),
    ],
)
def test_errors_say_what_to_do(town, capsys, more, time, line):
    assert main(arguments(town, *more, time=time)) == 2
    said = capsys.readouterr().err
    assert line in said
    assert "Traceback" not in said


def test_a_webcam_without_calibration_is_named(town, capsys, tmp_path):
    folder, scene, _ = town
    line = [
        "paint",
        str(scene),
        "--time",
        "2024-09-01T10:00Z",
        "--manifest",
        str(folder / "pictures" / "manifest.csv"),
        "--calibrations",
        str(tmp_path),
        "--workspace",
        str(folder / "work"),
        "-o",
        str(tmp_path / "out"),
    ]
    assert main(line) == 2
    said = capsys.readouterr().err
    assert "south" in said
    assert "seasonscapes calibrate" in said


def test_a_pose_means_the_same_in_another_frame(town):
    """What a camera sees at a pixel it still sees there when its record is moved to a scene's own frame."""
    folder, _, camera = town
    own = read_calibration(folder / "poses" / "south_calibration.json")
    other = LocalFrame(own.frame.latitude_deg + 0.02, own.frame.longitude_deg - 0.03, 500.0, own.frame.refraction_k)
    moved = type(camera)(
        *(getattr(camera, n) for n in ("width_px", "height_px", "fx", "fy", "cx", "cy")),
        pose_in_frame(own.view.world_from_camera, own.frame, other),
    )
    assert np.linalg.norm(moved.position_m - camera.position_m) > 1000.0
    places = [(46.551, 7.981, 1400.0), (46.556, 7.977, 1200.0)]
    for place in places:
        before = project(camera, enu_from_geodetic(own.frame, *place))[0]
        after = project(moved, enu_from_geodetic(other, *place))[0]
        np.testing.assert_allclose(after, before, atol=0.05)
