"""The webcam verbs on the command line."""

import csv
import json

import cv2
import numpy as np
import places
import pytest

from seasonscapes.cli import main

WEBCAM = """
[[webcam]]
id = "south"
latitude_deg = 46.5405
longitude_deg = 7.98
above_ground_m = 60.0
projection = "perspective"
width_px = 320
height_px = 200
horizontal_fov_deg = 60.0
heading_deg = 2.0
time_zone = "Europe/Zurich"
"""


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def scene_with_webcam(folder):
    return places.write_place(folder, places.SCENE + WEBCAM)


def test_webcams_lists_checks_and_maps(tmp_path, capsys):
    scene = scene_with_webcam(tmp_path)
    good = tmp_path / "pictures" / "2024-09-01" / "12-00-00" / "360" / "south.jpg"
    good.parent.mkdir(parents=True)
    cv2.imwrite(str(good), np.random.default_rng(0).integers(0, 255, (200, 320, 3), np.uint8))
    cut = tmp_path / "pictures" / "2024-09-01" / "13-00-00" / "360" / "south.jpg"
    cut.parent.mkdir(parents=True)
    cut.write_bytes(good.read_bytes()[:2000])
    assert (
        run(
            "webcams",
            scene,
            "--pictures",
            tmp_path / "pictures",
            "--manifest",
            tmp_path / "good.csv",
            "-o",
            tmp_path / "map.png",
            "--json",
        )
        == 0
    )
    record = json.loads(capsys.readouterr().out)
    assert record["heights"][0]["plausible"]
    assert record["pictures"] == 2
    assert [problem["kind"] for problem in record["problems"]] == ["truncated"]
    rows = list(csv.DictReader((tmp_path / "good.csv").open()))
    assert len(rows) == 1
    assert rows[0]["time_utc"].startswith("2024-09-01T10:00")
    assert (tmp_path / "map.png").stat().st_size > 1000


def test_a_camera_below_the_ground_is_doubted(tmp_path, capsys):
    text = places.SCENE + WEBCAM.replace("above_ground_m = 60.0", "height_m = 200.0")
    assert run("webcams", places.write_place(tmp_path, text), "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert not record["heights"][0]["plausible"]
    (warning,) = record["warnings"]
    assert "m below ground; its position, its height or their datum is wrong" in warning


@pytest.mark.parametrize(
    "name",
    ["hut/2024-09-18T12-00.jpg", "hut/2024-09-18/12-00-00.jpg", "hut_20240918_120000.jpg", "2024-09-18_12-00.jpg"],
)
def test_the_names_of_pictures_that_the_how_to_shows_are_found(tmp_path, capsys, name):
    scene = places.write_place(tmp_path, places.SCENE + WEBCAM.replace('"south"', '"hut"'))
    picture = tmp_path / "pictures" / name
    picture.parent.mkdir(parents=True)
    cv2.imwrite(str(picture), np.random.default_rng(0).integers(0, 255, (200, 320, 3), np.uint8))
    assert run("webcams", scene, "--pictures", tmp_path / "pictures", "--manifest", tmp_path / "m.csv") == 0
    capsys.readouterr()
    (row,) = csv.DictReader((tmp_path / "m.csv").read_text().splitlines())
    assert row["time_utc"] == "2024-09-18T10:00:00Z"
    assert row["path"] == f"pictures/{name}"


def test_the_bernese_cameras_travel_with_the_package(capsys):
    assert run("webcams", "bernese_highlands", "--json") == 0
    assert len(json.loads(capsys.readouterr().out)["webcams"]) == 32


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--picture", "none.jpg", "--skyline"], "--picture: no such file"),
        (["--picture", "bad.jpg", "--skyline"], "not a readable picture"),
        (["--picture", "small.png", "--skyline"], """got '10 x 10 px'; expected 320 x 200 px"""),
        (["--picture", "small.png"], "no evidence"),
        (["--picture", "good.png", "--points", "none.csv"], "none.csv: no such file"),
        (["--picture", "good.png", "--points", "few.csv"], "points"),
        (["--picture", "good.png", "--skyline", "--webcam", "north"], "north"),
        (["--picture", "good.png", "--skyline", "--mask", "bad.jpg"], "not a readable picture"),
        (
            ["--picture", "good.png", "--skyline", "-o", "out/hut.json"],
            "--output: several files are written, into a folder; got 'out/hut.json'; give the folder alone: out",
        ),
    ],
)
def test_calibrate_says_what_is_wrong(tmp_path, capsys, monkeypatch, arguments, message):
    scene = scene_with_webcam(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.jpg").write_text("no picture")
    cv2.imwrite("small.png", np.zeros((10, 10, 3), np.uint8))
    cv2.imwrite("good.png", np.zeros((200, 320, 3), np.uint8))
    (tmp_path / "few.csv").write_text("name,x_px,y_px,latitude_deg,longitude_deg,height_m\na,10,10,46.55,7.98,1200\n")
    assert run("calibrate", scene, *arguments, *([] if "-o" in arguments else ["-o", "out"])) == 2
    complaint = [line for line in capsys.readouterr().err.splitlines() if line.startswith("seasonscapes: ")]
    assert len(complaint) == 1
    assert message in complaint[0]
    assert not (tmp_path / "out").exists()


def test_calibrate_from_points(tmp_path, capsys):
    """Points of the terrain seen by a known camera bring back its heading; the figure and the record are written."""
    from seasonscapes.cameras.pinhole import camera_at, project
    from seasonscapes.frames import LocalFrame, enu_from_geodetic, geodetic_from_enu

    scene = scene_with_webcam(tmp_path)
    frame = LocalFrame(46.5405, 7.98, 0.0, 0.13)
    camera = camera_at(frame, 46.5405, 7.98, 1060.0, heading_deg=5.0, pitch_deg=3.0, fov_deg=60.0, size_px=(320, 200))
    rng = np.random.default_rng(1)
    distance, angle = rng.uniform(300, 1500, 12), np.radians(5.0 + rng.uniform(-25, 25, 12))
    plan = np.stack([distance * np.sin(angle), distance * np.cos(angle), rng.uniform(950, 1300, 12)], -1)
    latitude, longitude, height = geodetic_from_enu(frame, plan)
    pixel, _ = project(camera, enu_from_geodetic(frame, latitude, longitude, height))
    with (tmp_path / "points.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["name", "x_px", "y_px", "latitude_deg", "longitude_deg", "height_m"])
        writer.writerows([str(i), *pixel[i], latitude[i], longitude[i], height[i]] for i in range(12))
    cv2.imwrite(str(tmp_path / "photo.png"), np.full((200, 320, 3), 90, np.uint8))
    assert (
        run(
            "calibrate",
            scene,
            "--picture",
            tmp_path / "photo.png",
            "--points",
            tmp_path / "points.csv",
            "-o",
            tmp_path / "out",
            "--json",
        )
        == 0
    )
    record = json.loads(capsys.readouterr().out)
    assert record["values"][0] == pytest.approx(5.0, abs=0.05)
    assert record["values"][1] == pytest.approx(3.0, abs=0.05)
    assert (tmp_path / "out" / "south_overlay.png").is_file()
    assert (tmp_path / "out" / "south_calibration.json").is_file()


def test_calibrate_takes_the_camera_of_another_program(tmp_path, capsys):
    """The pose of a model is kept as it is, its distortion goes into the record, and later stages take it out."""
    from seasonscapes.calibration.calibration_file import read_calibration
    from seasonscapes.cameras.lens import Lens

    scene = scene_with_webcam(tmp_path)
    model = {
        "size_px": [320, 200],
        "focal_px": 300.0,
        "heading_deg": 4.0,
        "pitch_deg": 2.0,
        "distortion": {"k1": -0.1, "p1": 0.001},
    }
    model |= {"latitude_deg": 46.5405, "longitude_deg": 7.98, "height_m": 1060.0, "principal_point_px": [150.0, 110.0]}
    (tmp_path / "model.json").write_text(json.dumps(model))
    cv2.imwrite(str(tmp_path / "photo.png"), np.full((200, 320, 3), 90, np.uint8))
    arguments = ("--picture", tmp_path / "photo.png", "--camera-model", tmp_path / "model.json", "-o", tmp_path / "out")
    assert run("calibrate", scene, *arguments, "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert record["values"][:2] == pytest.approx([4.0, 2.0], abs=1e-6)
    found = read_calibration(tmp_path / "out" / "south_calibration.json")
    assert found.lens == Lens(k1=-0.1, p1=0.001)
    assert (found.view.cx, found.view.cy) == (150.0, 110.0)
    assert run("calibrate", scene, "--picture", tmp_path / "photo.png", "--skyline", "--model-crs", "EPSG:32632") == 2
    assert "--camera-model: missing" in capsys.readouterr().err
