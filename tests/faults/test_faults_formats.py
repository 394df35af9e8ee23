"""Fuzzing by structure: whole files of each format, with some parts replaced, must be read or refused in one line.

Each example takes a file that is right and replaces, removes or repeats some of its values, keys, cells or lines. What is
read in spite of that must be usable: finite numbers and names that files can have.
"""

import copy
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

from seasonscapes.calibration.calibration_file import read_calibration
from seasonscapes.calibration.evidence import PARAMETERS, read_points
from seasonscapes.cameras.camera_models import read_camera_models
from seasonscapes.cameras.exchange import read_opencv, read_transforms
from seasonscapes.cameras.observation import read_manifest
from seasonscapes.cameras.path_file import load_path, read_reference_path
from seasonscapes.cameras.timed_views import read_timed_views
from seasonscapes.errors import SeasonscapesError
from seasonscapes.frames import LocalFrame
from seasonscapes.scene import read_scene
from seasonscapes.sky.models import read_sky_model

FRAME = LocalFrame(46.5, 8.0, 1000.0)
EYE = np.eye(4).tolist()
SCENE = {
    "name": "hill",
    "attribution": "made by a test",
    "vertical_datum": "local",
    "elevation": {"file": "dem.tif"},
    "imagery": {"file": "image.tif", "encoding": "linear", "full_scale": 1.0, "reflectance_scale": 1.0},
    "camera": [
        {
            "name": "south",
            "latitude_deg": 46.5405,
            "longitude_deg": 7.98,
            "above_ground_m": 120.0,
            "heading_deg": 0.0,
            "pitch_deg": -8.0,
        }
    ],
    "webcam": [
        {
            "id": "hut",
            "latitude_deg": 46.5405,
            "longitude_deg": 7.98,
            "height_m": 1000.0,
            "projection": "cylindrical",
            "horizontal_fov_deg": 360.0,
            "vertical_fov_deg": 45.0,
            "width_px": 1600,
            "height_px": 200,
            "north_column_px": 100.0,
            "time_zone": "Europe/Zurich",
        }
    ],
}
SKY = tomllib.loads((Path(__file__).parents[2] / "sun_models" / "alpine_winter.toml").read_text())
SIGMA = dict.fromkeys(PARAMETERS, 0.1)
CALIBRATION = {
    "webcam": "hut",
    "projection": "perspective",
    "size_px": [160, 120],
    "fx": 140.0,
    "fy": 140.0,
    "cx": 80.0,
    "cy": 60.0,
    "k1": 0.0,
    "world_from_camera": EYE,
    "sigma": SIGMA,
    "frame": {"latitude_deg": 46.5, "longitude_deg": 8.0, "height_m": 1000.0, "refraction_k": 0.13},
}
VIEW = {"latitude_deg": 46.5, "longitude_deg": 8.0, "height_m": 1500.0, "heading_deg": 10.0, "pitch_deg": -5.0}
PATH = {
    "kind": "seasonscapes path",
    "size_px": [160, 120],
    "views": [{**VIEW, "roll_deg": 0.0, "fov_deg": 60.0, "fx": 140.0, "fy": 140.0, "cx": 80.0, "cy": 60.0}],
}
TRANSFORMS = {
    "camera_model": "PINHOLE",
    "world": {"origin": {"latitude_deg": 46.5, "longitude_deg": 8.0, "height_m": 1000.0, "refraction_k": 0.0}},
    "frames": [
        {
            "file_path": "a.png",
            "name": "a",
            "time_utc": "2024-09-18T10:00:00+00:00",
            "transform_matrix": EYE,
            "fl_x": 140.0,
            "fl_y": 140.0,
            "cx": 80.0,
            "cy": 60.0,
            "w": 160,
            "h": 120,
        }
    ],
}
OPENCV = {
    "image_width": 160,
    "image_height": 120,
    "camera_matrix": [[140.0, 0.0, 80.0], [0.0, 140.0, 60.0], [0.0, 0.0, 1.0]],
    "distortion_coefficients": [0.0, 0.0, 0.0, 0.0, 0.0],
    "rvec": [0.1, 0.2, 0.3],
    "tvec": [1.0, 2.0, 3.0],
}
MANIFEST = "webcam,time_utc,path\nhut,2024-09-18T10:00:00Z,p.png\nhut,2024-09-18T11:00:00Z,q.png\n"
POINTS = "name,x_px,y_px,latitude_deg,longitude_deg,height_m\n1,5.0,6.0,46.5,8.0,1500\n2,50.0,60.0,46.6,8.0,1500\n"
GEOREFERENCE = {
    "world": TRANSFORMS["world"],
    "times": {"a.png": "2024-09-18T10:00Z", "b.png": "2024-09-18T12:00+02:00"},
}
CAMERAS_TXT = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, FX, FY, CX, CY\n1 PINHOLE 160 120 140.0 140.0 80.0 60.0\n"
IMAGES_TXT = "# IMAGE_ID\n1 1.0 0.0 0.0 0.0 5.0 6.0 7.0 1 a.png\n\n2 1.0 0.0 0.0 0.0 5.0 6.0 7.0 1 b.png\n\n"

NUMBERS = st.one_of(
    st.sampled_from([0, -1, 1e400, -1e400, float("nan"), 1e300, 10**400, 2**63, 1e-320, 181.0, 91, 360.5, True, False]),
    st.floats(),
    st.integers(),
)
TEXTS = st.one_of(
    st.sampled_from(
        ["", " ", "..", "../x", "/etc/passwd", "a/b", "a\0b", "a\nb", "x" * 400, "-o", "NaN", "²", "\x1b[31m"]
    ),
    st.text(max_size=8),
)
JUNK = st.recursive(
    st.none() | NUMBERS | TEXTS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)
CHANGES = st.lists(
    st.tuples(st.integers(0, 10_000), st.sampled_from(["set", "drop", "add"]), JUNK), min_size=1, max_size=3
)


def slots(value, found=None):
    """Every container with each of its keys."""
    found = [] if found is None else found
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in keys:
        found.append((value, key))
        slots(value[key], found)
    return found


def changed(document, changes):
    document = copy.deepcopy(document)
    for number, how, junk in changes:
        places = slots(document)
        if not places:
            break
        container, key = places[number % len(places)]
        if how == "set":
            container[key] = junk
        elif how == "drop":
            del container[key]
        elif isinstance(container, dict):
            container["x" if not isinstance(junk, str) else junk] = junk
        else:
            container.append(junk)
    return document


def toml(value):
    """A value as TOML; `None` is no value of it."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(str(k))} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return repr(value) if np.isfinite(value) else {"nan": "nan", "inf": "inf", "-inf": "-inf"}[str(value)]
    return '""' if value is None else json.dumps(value)


def toml_file(document):
    return "".join(f"{json.dumps(str(key))} = {toml(value)}\n" for key, value in document.items())


LINES = st.lists(
    st.tuples(st.integers(0, 100), st.integers(0, 100), st.sampled_from(["cell", "drop", "twice", "cut"]), JUNK),
    min_size=1,
    max_size=3,
)


def changed_lines(text, changes, separator):
    lines = text.split("\n")
    for row, column, how, junk in changes:
        row %= len(lines)
        cells = lines[row].split(separator)
        if how == "cell":
            cells[column % len(cells)] = junk if isinstance(junk, str) else json.dumps(junk)
            lines[row] = separator.join(cells)
        elif how == "drop":
            del cells[column % len(cells)]
            lines[row] = separator.join(cells)
        elif how == "twice":
            lines.insert(row, lines[row])
        else:
            lines[row] = lines[row][: column % (len(lines[row]) + 1)]
    return "\n".join(lines)


def finite_camera(camera):
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, *camera.world_from_camera.ravel()]
    assert np.isfinite(numbers).all()
    assert camera.width_px > 0
    assert camera.height_px > 0


def read_or_refused(read, check=lambda value: None):
    """Read and check; a refusal is one line."""
    refusal = None
    try:
        check(read())
    except SeasonscapesError as error:
        refusal = str(error)
    assert refusal is None or (refusal.strip() and "\n" not in refusal)


def check_scene(scene):
    names = [scene.name, *(c.name for c in scene.cameras), *(w.id for w in scene.webcams)]
    assert all(name and "/" not in name and name.isprintable() for name in names)


def timed_views_of(name):
    """Reads a file as the one of that name among the pictures of a folder."""

    def read(path):
        folder = path.parent / "pictures"
        folder.mkdir(exist_ok=True)
        for other, text in {"cameras.txt": CAMERAS_TXT, "images.txt": IMAGES_TXT, "a.png": "", "b.png": ""}.items():
            (folder / other).write_text(text)
        (folder / name).write_bytes(path.read_bytes())
        return read_timed_views(folder)

    return read


def check_timed(views):
    assert views
    for view in views:
        finite_camera(view.camera)
        assert view.camera.frame is not None
        assert view.time.utcoffset() is not None
        assert view.file in ("a.png", "b.png")


JSON_FORMATS = {
    "georeference": (GEOREFERENCE, timed_views_of("georeference.json"), check_timed),
    "timed transforms": (TRANSFORMS, timed_views_of("transforms.json"), check_timed),
    "calibration": (CALIBRATION, read_calibration, lambda found: finite_camera(found.view)),
    "path": (PATH, lambda path: load_path(path, FRAME), lambda found: [finite_camera(c) for c in found]),
    "transforms": (TRANSFORMS, read_transforms, lambda found: [finite_camera(view.camera) for view in found[0]]),
    "opencv": (OPENCV, read_opencv, lambda found: finite_camera(found[0])),
}


@pytest.mark.parametrize("name", JSON_FORMATS)
def test_json(tmp_path, record_property, fuzz, name):
    document, read, check = JSON_FORMATS[name]
    path = tmp_path / "file.json"

    def holds(changes):
        path.write_text(json.dumps(changed(document, changes)), encoding="utf-8", errors="surrogatepass")
        read_or_refused(lambda: read(path), check)

    path.write_text(json.dumps(document))
    check(read(path))
    record_property("fault", {"cases": fuzz(CHANGES, holds), "wrong": []})


def test_scene(land, record_property, fuzz):
    path = land / "inside" / "fuzz.toml"

    def holds(changes):
        path.write_text(toml_file(changed(SCENE, changes)), encoding="utf-8", errors="replace")
        read_or_refused(lambda: read_scene(path), check_scene)

    path.write_text(toml_file(SCENE))
    check_scene(read_scene(path))
    record_property("fault", {"cases": fuzz(CHANGES, holds), "wrong": []})


def test_sky(tmp_path, record_property, fuzz):
    path = tmp_path / "sky.toml"

    def holds(changes):
        path.write_text(toml_file(changed(SKY, changes)), encoding="utf-8", errors="replace")
        read_or_refused(lambda: read_sky_model(path))

    path.write_text(toml_file(SKY))
    read_sky_model(path)
    record_property("fault", {"cases": fuzz(CHANGES, holds), "wrong": []})


def test_manifest(tmp_path, record_property, fuzz):
    path = tmp_path / "m.csv"

    def check(rows):
        for row in rows:
            assert row.webcam
            assert "/" not in row.webcam
            assert ".." not in row.path.split("/")
            assert row.time.utcoffset() is not None

    def holds(changes):
        path.write_text(changed_lines(MANIFEST, changes, ","), encoding="utf-8", errors="replace", newline="")
        read_or_refused(lambda: read_manifest(path), check)

    path.write_text(MANIFEST)
    assert len(read_manifest(path)) == 2
    record_property("fault", {"cases": fuzz(LINES, holds), "wrong": []})


def test_points(tmp_path, record_property, fuzz):
    path = tmp_path / "p.csv"

    def check(points):
        assert np.isfinite(points.pixel).all()
        assert np.isfinite(points.position_m).all()

    def holds(changes):
        path.write_text(changed_lines(POINTS, changes, ","), encoding="utf-8", errors="replace", newline="")
        read_or_refused(lambda: read_points(path, FRAME), check)

    path.write_text(POINTS)
    check(read_points(path, FRAME))
    record_property("fault", {"cases": fuzz(LINES, holds), "wrong": []})


@pytest.mark.parametrize("part", ["cameras.txt", "images.txt"])
def test_colmap(tmp_path, record_property, fuzz, part):
    texts = {"cameras.txt": CAMERAS_TXT, "images.txt": IMAGES_TXT}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)

    def check(models):
        for model in models:
            assert np.isfinite([model.fx, model.fy, model.cx, model.cy, *model.rotation.ravel(), *model.position]).all()
            assert min(model.size_px) > 0

    def holds(changes):
        text = changed_lines(texts[part], changes, " ")
        (tmp_path / part).write_text(text, encoding="utf-8", errors="replace", newline="")
        read_or_refused(lambda: read_camera_models(tmp_path, "colmap"), check)

    assert len(read_camera_models(tmp_path, "colmap")) == 2
    record_property("fault", {"cases": fuzz(LINES, holds), "wrong": []})


REFERENCE_VIEW = {
    "transform_matrix": EYE,
    "fx": 140.0,
    "fy": 140.0,
    "cx": 80.0,
    "cy": 60.0,
    "wid": 160,
    "hei": 120,
    "file_path": "a.png",
}


def test_reference_path(tmp_path, record_property, fuzz):
    path = tmp_path / "r.json"
    document: dict = {"1_A_0": REFERENCE_VIEW, "2_A_1": REFERENCE_VIEW}
    document["meta"] = {"waypoints": ["1_A_0", "2_A_1"], "nbr_points": 5, "interpolation": "linear"}

    def check(found):
        for camera in found.cameras:
            finite_camera(camera)

    def holds(changes):
        path.write_text(json.dumps(changed(document, changes)), encoding="utf-8", errors="surrogatepass")
        read_or_refused(lambda: read_reference_path(path, FRAME, kind="unrefined"), check)

    record_property("fault", {"cases": fuzz(CHANGES, holds), "wrong": []})


@pytest.mark.parametrize("read", [read_transforms, read_opencv, read_calibration, lambda path: load_path(path, FRAME)])
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[" * 100_000,
        b'{"a": ' + b"9" * 5_000 + b"}",
        b'{"a": NaN}',
        b"\xff",
        b"[]",
        b"null",
        b'{"a": 1e999}',
    ],
    ids=lambda content: ascii(content[:12]),
)
def test_files_that_are_no_json(tmp_path, record_property, read, content):
    (tmp_path / "a.json").write_bytes(content)
    record_property("fault", {"cases": 1, "wrong": []})
    with pytest.raises(SeasonscapesError):
        read(tmp_path / "a.json")
