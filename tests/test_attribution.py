"""The credit of a scene's data stands in the files that are made of it; the page for browsers is in `test_viewer`."""

from __future__ import annotations

import json
import struct

import places
import pytest
from command_line import command
from PIL import Image

CREDIT = "© Airbus Defence and Space GmbH; modified Copernicus Sentinel data 2024"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("credit")
    return places.write_place(folder, places.SCENE.replace("made by a test", CREDIT))


@pytest.fixture
def made(scene, tmp_path_factory, tmp_path):
    """Runs a verb on the scene and returns what it wrote."""

    def run(verb: str, name: str, **flags):
        command(verb, scene, output=tmp_path / name, workspace=scene.parent / "work", **flags)
        return tmp_path / name

    return run


VIEW = {"time": "2024-07-14T12:00", "size": "24x16", "sky": "hosek"}


def test_pictures(made):
    with Image.open(made("render", "p.png", **VIEW)) as picture:
        assert picture.info["Copyright"] == CREDIT
        assert json.loads(picture.info["seasonscapes"])["attribution"] == CREDIT


def test_openexr(made, capsys):
    path = made("render", "p.exr", **VIEW)
    capsys.readouterr()
    command("info", path, json=True)
    assert json.loads(capsys.readouterr().out)["provenance"]["attribution"] == CREDIT


def test_gltf(made):
    content = made("export", "p.glb", to="glb").read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    asset = json.loads(content[20 : 20 + length])["asset"]
    assert asset["copyright"] == CREDIT
    assert asset["extras"]["attribution"] == CREDIT


def test_films(made, capsys):
    flags = VIEW | {"from": "2024-07-14T12:00", "to": "2024-07-14T13:00", "every": "30min"}
    film = made("timelapse", "f.mp4", **{key: value for key, value in flags.items() if key != "time"})
    capsys.readouterr()
    command("info", film, json=True)
    assert json.loads(capsys.readouterr().out)["seasonscapes"]["attribution"] == CREDIT
