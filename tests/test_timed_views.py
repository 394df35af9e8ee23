"""Folders of timed pictures: our export read back as transforms.json and as COLMAP's models, and trained from."""

import json
import shutil
import struct

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import places  # noqa: E402

from seasonscapes.cameras.exchange import read_transforms  # noqa: E402
from seasonscapes.cameras.timed_views import GEOREFERENCE, read_timed_views  # noqa: E402
from seasonscapes.cli import main  # noqa: E402
from seasonscapes.errors import InputError  # noqa: E402


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Scene, folder that `distill --export-views` wrote of it, and flags."""
    folder = tmp_path_factory.mktemp("views")
    scene, views = places.write_place(folder / "scene"), folder / "views"
    common = ["--workspace", str(folder / "work"), "--discs", "24"]
    small = [
        "--sky",
        "hosek",
        "--suns",
        "2",
        "--disc-px",
        "0",
        "--views",
        "2",
        "--view-px",
        "32",
        "--steps",
        "4",
        "--picture-steps",
        "0",
    ]
    model = str(folder / "m.safetensors")
    small += ["--no-refine-discs", "--export-views", str(views)]
    assert main(["distill", str(scene), "-o", model, *small, *common]) == 0
    return scene, views, common


def colmap_folder(views, folder, *, binary=False):
    """The export without transforms.json, with COLMAP's text or binary model, as `colmap model_converter` writes it."""
    shutil.copytree(views, folder)
    (folder / "transforms.json").unlink()
    model = folder / "sparse" / "0"
    if binary:
        rows = [line.split() for line in (model / "cameras.txt").read_text().splitlines() if line[:1] != "#"]
        packed = [
            struct.pack("<iiQQ4d", int(row[0]), 1, int(row[2]), int(row[3]), *map(float, row[4:])) for row in rows
        ]
        (model / "cameras.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(packed))
        rows = [line.split() for line in (model / "images.txt").read_text().splitlines()[1:] if line]
        packed = [
            struct.pack("<i7di", int(row[0]), *map(float, row[1:8]), int(row[8]))
            + row[9].encode()
            + b"\0"
            + struct.pack("<Q", 0)
            for row in rows
        ]
        (model / "images.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(packed))
        for name in ("cameras.txt", "images.txt"):
            (model / name).unlink()
    return folder


def nerfstudio_folder(views, folder):
    """The export as other programs would say it: ``time`` with an offset, and nothing of ours but the origin."""
    shutil.copytree(views, folder)
    shutil.rmtree(folder / "sparse")
    table = json.loads((folder / "transforms.json").read_text())
    kept = ("file_path", "w", "h", "fl_x", "fl_y", "cx", "cy", "transform_matrix")
    table["frames"] = [
        {key: each[key] for key in kept} | {"time": each["time_utc"].replace("Z", "+00:00")} for each in table["frames"]
    ]
    (folder / "transforms.json").write_text(json.dumps(table))
    return folder


@pytest.mark.parametrize("kind", ["ours", "nerfstudio", "text", "binary"])
def test_an_export_is_read_back_and_trained_from(exported, tmp_path, kind, capsys):
    scene, views, common = exported
    expected, frame = read_transforms(views / "transforms.json")
    folder = {
        "ours": lambda: views,
        "nerfstudio": lambda: nerfstudio_folder(views, tmp_path / "f"),
        "text": lambda: colmap_folder(views, tmp_path / "f"),
        "binary": lambda: colmap_folder(views, tmp_path / "f", binary=True),
    }[kind]()
    found = read_timed_views(folder)
    assert len(found) == len(expected) == 4
    for mine, theirs in zip(found, expected, strict=True):
        assert mine.camera.frame == frame
        assert (mine.file, mine.time) == (theirs.file, theirs.time)
        np.testing.assert_allclose(mine.camera.world_from_camera, theirs.camera.world_from_camera, atol=1e-6)
        for name in ("width_px", "height_px", "fx", "fy", "cx", "cy"):
            assert getattr(mine.camera, name) == pytest.approx(getattr(theirs.camera, name), abs=1e-6)
    model = tmp_path / "m.safetensors"
    flags = ["--appearance", "embedding", "--frames", str(folder), "--steps", "6", "-o", str(model), "--json"]
    capsys.readouterr()
    assert main(["distill", str(scene), *flags, *common]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["frames"], len(record["times"])) == (4, len({view.time for view in expected}))
    assert np.isfinite(record["loss"])


def without_times(folder):
    file = folder / "sparse" / "0" / GEOREFERENCE
    table = json.loads(file.read_text())
    del table["times"]
    file.write_text(json.dumps(table))
    return folder / "sparse" / "0" / "images.txt"


def test_names_of_colmaps_pictures_state_times(exported, tmp_path):
    """In the layouts of `webcams --pictures`; without Z in the place's civil time."""
    folder = colmap_folder(exported[1], tmp_path / "f")
    images = without_times(folder)
    named = ["2024-09-01T1200.png", "2024-09-01T1300.png", "2024-09-01T1400Z.png", "2024-12-01T1500.png"]
    for number, name in enumerate(named):
        (folder / "images" / f"{number:04d}.png").rename(folder / "images" / name)
        images.write_text(images.read_text().replace(f"{number:04d}.png", name))
    found = read_timed_views(folder, time_zone="Europe/Zurich")
    assert [f"{view.time:%m-%dT%H}" for view in found] == ["09-01T10", "09-01T11", "09-01T14", "12-01T14"]
    images.write_text(images.read_text().replace("12-01T1500", "10-27T0230"))
    with pytest.raises(InputError, match=r"happens twice.*; name it in UTC"):
        read_timed_views(folder, time_zone="Europe/Zurich")


def _remove(key):
    def change(folder):
        file = folder / "transforms.json"
        table = json.loads(file.read_text())
        table.pop(key, None)
        for each in table["frames"]:
            each.pop(key, None)
        file.write_text(json.dumps(table))

    return change


def _put(key, value):
    def change(folder):
        file = folder / "transforms.json"
        table = json.loads(file.read_text())
        if key != "time":
            table[key] = value
        else:
            for each in table["frames"]:
                each[key] = value
        file.write_text(json.dumps(table))

    return change


@pytest.mark.parametrize(
    ("kind", "change", "said"),
    [
        ("transforms", _remove("world"), 'states no origin on Earth; expected "world"'),
        ("transforms", _remove("time"), "states no time of a picture; got 'images/0000.png'; state time_utc"),
        ("transforms", _put("time", 0.5), "not an instant: .* got 0.5; expected ISO 8601"),
        ("transforms", _put("time", "2024-09-01T12:00"), "no offset from UTC"),
        ("transforms", _put("applied_scale", 0.1), "its poses were moved"),
        ("colmap", without_times, "states no time of a picture; got 'images/0000.png'; name them"),
        ("colmap", lambda f: (f / "sparse/0" / GEOREFERENCE).unlink(), "COLMAP model states no origin on Earth; write"),
        ("colmap", lambda f: (f / "sparse/0" / GEOREFERENCE).write_text("{}"), "not an origin and times"),
        ("colmap", lambda f: (f / "images/0000.png").unlink(), "no such picture"),
        ("colmap", lambda f: shutil.rmtree(f / "sparse"), "neither transforms.json nor a COLMAP model"),
        (
            "colmap",
            lambda f: (f / "sparse/0/cameras.txt").write_text(
                "".join(f"{number} SIMPLE_RADIAL 32 32 30 16 16 0.1\n" for number in range(1, 5))
            ),
            "its lens has distortion; got '0000.png'; undistort",
        ),
    ],
)
def test_what_is_missing_is_told_in_one_line(exported, tmp_path, kind, change, said):
    make = nerfstudio_folder if kind == "transforms" else colmap_folder
    folder = make(exported[1], tmp_path / "f")
    change(folder)
    with pytest.raises(InputError, match=said) as told:
        read_timed_views(folder)
    assert "\n" not in str(told.value)
