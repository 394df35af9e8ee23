"""Webcam facts, camera clocks, and manifests that survive what real archives hold."""

import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from seasonscapes.cameras.observation import (
    ManifestRow,
    Observation,
    check_pictures,
    file_sha256,
    open_observation,
    read_manifest,
    write_manifest,
)
from seasonscapes.cameras.panorama import panorama_directions, project_panorama
from seasonscapes.cameras.picture_names import scan_folder, utc_from_camera_clock
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.cameras.webcam import (
    Webcam,
    check_heights,
    draw_webcam_map,
    find_webcam,
    read_webcams,
    webcam_heading_deg,
    webcam_model,
)
from seasonscapes.errors import InputError, UnreadableImage
from seasonscapes.frames import LocalFrame, angles_from_direction, enu_from_geodetic, local_axes

BERNESE = Path(__file__).parents[1] / "scenes" / "bernese_highlands.toml"
FRAME = LocalFrame(46.6, 8.0, 1500.0)


def webcam(**changes) -> Webcam:
    facts = {
        "id": "HUT",
        "latitude_deg": 46.6,
        "longitude_deg": 8.0,
        "height_m": 2000.0,
        "projection": "cylindrical",
        "width_px": 80,
        "height_px": 20,
        "horizontal_fov_deg": 360.0,
        "vertical_fov_deg": 62.8,
        "north_column_px": 0.0,
        "time_zone": "Europe/Zurich",
    }
    return Webcam(**{**facts, **changes})


def test_the_bernese_cameras_are_all_there_and_their_north_column_faces_north():
    webcams = read_webcams(BERNESE)
    assert len(webcams) == 32
    for facts in webcams:
        panorama = webcam_model(facts, FRAME)
        middle = np.array([[facts.north_column_px, facts.height_px / 2]])
        point = panorama.position_m + 1000.0 * panorama_directions(panorama, middle)
        assert (
            np.abs(
                np.array(enu_from_geodetic(FRAME, facts.latitude_deg, facts.longitude_deg, facts.height_m))
                - panorama.position_m
            ).max()
            < 1e-6
        )
        # Seen from its own horizon the middle row of the north column lies north, at the lens's tilt.
        direction = local_axes(FRAME, facts.latitude_deg, facts.longitude_deg) @ (point[0] - panorama.position_m)
        azimuth, elevation = angles_from_direction(direction)
        assert abs((azimuth + 180) % 360 - 180) < 1e-6
        assert elevation == pytest.approx(facts.lens_tilt_deg, abs=1e-6)
        pixel, _ = project_panorama(panorama, point)
        assert np.abs((pixel - middle)[0, 1]) < 1e-6


@pytest.mark.parametrize(("north", "heading"), [(40.0, 0.0), (0.0, 180.0), (60.0, 270.0), (20.0, 90.0)])
def test_heading_from_the_north_column_by_hand(north, heading):
    assert webcam_heading_deg(webcam(north_column_px=north)) == pytest.approx(heading)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"above_ground_m": 3.0}, "exactly one of height_m and above_ground_m"),
        ({"north_column_px": None}, "exactly one of north_column_px and heading_deg"),
        ({"projection": "perspective"}, "needs heading_deg"),
        ({"vertical_fov_deg": None}, "needs vertical_fov_deg"),
        ({"time_zone": "Europe/Bern"}, "unknown time zone 'Europe/Bern'"),
        ({"latitude_deg": 460.0}, "less than or equal to 90"),
    ],
)
def test_facts_that_cannot_be_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        webcam(**changes)


def test_errors_in_a_webcam_file_are_one_line(tmp_path):
    text = BERNESE.read_text()
    cases = {
        "two webcams have the id 1-HEISCH": text.replace('"2-BSPIEZ"', '"1-HEISCH"'),
        "did you mean 'height_m'": text.replace("height_m = 1134.0", "heigth_m = 1134.0"),
        "not valid TOML": text + "[[",
    }
    for message, broken in cases.items():
        (tmp_path / "w.toml").write_text(broken)
        with pytest.raises(InputError, match=message) as error:
            read_webcams(tmp_path / "w.toml")
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="did you mean '24-JUNGFJ'"):
        find_webcam(read_webcams(BERNESE), "24-JUNGFRAUJ")


def test_heights_are_checked_against_the_terrain():
    cams = [webcam(id=name) for name in ("fine", "sunk", "flying", "away")] + [
        webcam(id="mast", height_m=None, above_ground_m=12.0)
    ]
    checks = check_heights(cams, [1990.0, 2100.0, 1500.0, np.nan, 900.0])
    assert [c.plausible for c in checks] == [True, False, False, False, True]
    assert [c.verdict for c in checks] == [
        "10 m above ground",
        "100 m below ground",
        "500 m above ground, more than a mast",
        "outside the terrain",
        "12 m above ground",
    ]


def test_the_map_shows_each_webcam_in_its_place():
    picture = draw_webcam_map(read_webcams(BERNESE), width_px=900)
    red = np.argwhere((picture[..., 0] > 150) & (picture[..., 1] < 80) & (picture[..., 2] < 80))
    assert picture.shape[1] == 900
    assert len(red) > 32 * 20


@pytest.mark.parametrize(
    ("local", "utc"),
    [
        ("2024-03-31T01:59:59", "2024-03-31T00:59:59"),
        ("2024-03-31T03:00:00", "2024-03-31T01:00:00"),
        ("2024-10-27T01:59:59", "2024-10-26T23:59:59"),
        ("2024-10-27T03:00:00", "2024-10-27T02:00:00"),
        ("2024-12-21T12:00:00", "2024-12-21T11:00:00"),
        ("2024-06-21T12:00:00", "2024-06-21T10:00:00"),
    ],
)
def test_camera_clocks_keep_daylight_saving(local, utc):
    got = utc_from_camera_clock(datetime.fromisoformat(local), "Europe/Zurich")
    assert got == datetime.fromisoformat(utc).replace(tzinfo=UTC)


def test_hours_that_repeat_or_vanish_are_not_guessed():
    with pytest.raises(ValueError, match="ambiguous: 2024-10-27T02:30:00 happens twice"):
        utc_from_camera_clock(datetime(2024, 10, 27, 2, 30), "Europe/Zurich")
    with pytest.raises(ValueError, match="skipped: 2024-03-31T02:30:00 does not exist"):
        utc_from_camera_clock(datetime(2024, 3, 31, 2, 30), "Europe/Zurich")


def picture(path: Path, size=(80, 20), seed=0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), np.uint8)
    Image.fromarray(values).save(path, quality=95)


def test_a_folder_with_every_fault_is_reported_and_not_fatal(tmp_path):
    cams = [webcam(), webcam(id="TOP")]
    for seed, name in enumerate(
        [
            "2024-09-01/12-00-00/360/HUT.jpg",
            "2024-09-01/12-10-00/360/HUT.jpg",
            "2024-09-01/12-20-00/360/HUT.jpg",
            "2024-09-01/12-30-00/360/HUT.jpg",
            "2024-09-01/12-00-00/360/GONE.jpg",
            "2024-10-27/02-30-00/360/TOP.jpg",
            "2024-03-31/02-30-00/360/TOP.jpg",
            "notes/old.jpg",
        ]
    ):
        picture(tmp_path / name, seed=seed)
    day = tmp_path / "2024-09-01"
    picture(day / "12-40-00/360/HUT.jpg", size=(64, 20))
    (day / "12-50-00/360").mkdir(parents=True)
    (day / "12-50-00/360/HUT.jpg").write_bytes((day / "12-00-00/360/HUT.jpg").read_bytes())
    whole = (day / "12-20-00/360/HUT.jpg").read_bytes()
    (day / "12-20-00/360/HUT.jpg").write_bytes(whole[: len(whole) // 2])
    (day / "12-30-00/360/HUT.jpg").write_bytes(b"<html>busy</html>")
    (day / "13-00-00/360").mkdir(parents=True)
    (day / "13-00-00/360/HUT.jpg").touch()

    rows, problems = scan_folder(tmp_path, cams)
    assert {p.kind for p in problems} == {"unknown webcam", "ambiguous time", "skipped time", "unreadable name"}
    assert [r.time.hour for r in rows] == [10, 10, 10, 10, 10, 10, 11]
    write_manifest(tmp_path / "manifest.csv", [*rows, ManifestRow("HUT", rows[0].time, "2024-09-01/lost.jpg")])
    again = read_manifest(tmp_path / "manifest.csv")
    assert again[:-1] == rows
    found = {(p.kind, Path(p.path).parts[1]) for p in check_pictures(again, tmp_path, cams)}
    assert found == {
        ("truncated", "12-20-00"),
        ("unreadable", "12-30-00"),
        ("wrong size", "12-40-00"),
        ("duplicate picture", "12-50-00"),
        ("empty", "13-00-00"),
        ("missing", "lost.jpg"),
        ("duplicate time", "lost.jpg"),
    }


def test_a_checksum_that_changed_and_damage_in_the_middle_are_found(tmp_path):
    picture(tmp_path / "a.jpg")
    row = ManifestRow("HUT", datetime(2024, 9, 1, 10, tzinfo=UTC), "a.jpg", None, file_sha256(tmp_path / "a.jpg"))
    assert check_pictures([row], tmp_path, [webcam()], decode=True) == []
    picture(tmp_path / "a.jpg", seed=9)
    assert [p.kind for p in check_pictures([row], tmp_path, [webcam()])] == ["changed"]


def test_85000_rows_are_read_and_checked_for_repeats_in_seconds(tmp_path):
    start = datetime(2024, 1, 1, tzinfo=UTC)
    rows = [
        ManifestRow(f"CAM{i % 32}", start + timedelta(minutes=10 * (i // 32)), f"{i}.jpg", i) for i in range(85_000)
    ]
    write_manifest(tmp_path / "m.csv", rows)
    began = time.perf_counter()
    again = read_manifest(tmp_path / "m.csv")
    seconds = time.perf_counter() - began
    assert again == rows
    assert seconds < 10.0  # 0.5 s when measured; a shared machine may be slow, opening pictures would take hours


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("webcam,path\nHUT,a.jpg\n", "column 'time_utc' is missing"),
        ("webcam,time_utc,path\nHUT,2024-09-01T12:00,a.jpg\n", "line 2: time_utc '2024-09-01T12:00' has no offset"),
        ("webcam,time_utc,path\nHUT,noon,a.jpg\n", "line 2"),
        ("webcam,time_utc,path\nHUT\n", "line 2"),
    ],
)
def test_a_broken_manifest_names_its_line(tmp_path, text, message):
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        read_manifest(tmp_path / "m.csv")


def test_opening_a_picture_checks_it(tmp_path):
    camera = Camera(80, 20, 50.0, 50.0, 40.0, 10.0, np.eye(4))
    picture(tmp_path / "a.jpg")
    row = ManifestRow("HUT", datetime(2024, 9, 1, 10, tzinfo=UTC), "a.jpg")
    seen = open_observation(row, tmp_path, camera)
    assert seen.image.shape == (20, 80, 3)
    assert seen.mask.all()
    picture(tmp_path / "a.jpg", size=(40, 20))
    with pytest.raises(InputError, match="size differs"):
        open_observation(row, tmp_path, camera)
    (tmp_path / "a.jpg").write_bytes(b"nothing")
    with pytest.raises(UnreadableImage, match="not a readable picture"):
        open_observation(row, tmp_path, camera)
    with pytest.raises(ValueError, match="not UTC"):
        Observation(seen.image, seen.mask, camera, datetime(2024, 9, 1), "HUT")
