"""Films of a camera path under the sun: hours of the views, frames that are kept, and light that moves."""

import json
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from PIL import Image
from places import MASSIF

from seasonscapes.cli import main
from seasonscapes.errors import InputError
from seasonscapes.workflows.path_films import hours_of_views

pytestmark = pytest.mark.usefixtures("few_rays")

NOON = datetime(2024, 7, 20, 10, tzinfo=UTC)


def test_hours_are_one_for_all_or_each_or_spread():
    later = NOON + timedelta(hours=6)
    assert hours_of_views([NOON], 3) == [NOON] * 3
    assert hours_of_views([NOON, later], 4)[1] == NOON + timedelta(hours=2)
    assert hours_of_views([NOON, later], 4)[-1] == later
    assert hours_of_views([later, NOON, later], 3) == [later, NOON, later]
    with pytest.raises(InputError, match="--times: does not fit the path"):
        hours_of_views([NOON] * 3, 5)


def test_a_path_is_filmed_once_and_the_sun_moves(tmp_path, capsys):
    scene = tmp_path / "little.toml"
    scene.write_text(MASSIF)
    common = [str(scene), "--workspace", str(tmp_path / "work"), "--texel-m", "120", "--refine", "1", "--json"]
    path, output = tmp_path / "p.json", tmp_path / "film"
    waypoints = ["--via", "aerial", "--via", "meadow", "--views", "3", "--size", "48x32"]
    assert main(["path", *common, *waypoints, "-o", str(path)]) == 0
    film = ["timelapse", *common, "--path", str(path), "--sky", "hosek", "-o", str(output), "--exposure", "15"]
    hours = ["--from", "2024-07-20T08:00", "--to", "2024-07-20T18:00"]
    capsys.readouterr()
    for expected in (3, 0):
        assert main([*film, *hours]) == 0
        record = json.loads(capsys.readouterr().out)
        assert (record["frames"], record["rendered"]) == (3, expected)
    frames = sorted(output.glob("*.png"))
    assert len(frames) == 3
    morning = np.asarray(Image.open(frames[0]), float)
    facts = json.loads(Image.open(frames[2]).text["seasonscapes"])
    assert facts["time_utc"] == "2024-07-20T16:00:00+00:00"
    assert main([*film, "--times", "2024-07-20T13:00"]) == 0
    assert np.abs(np.asarray(Image.open(frames[0]), float) - morning).mean() > 3.0, "another hour, another light"
    capsys.readouterr()
    capsys.readouterr()
    assert main([*film, *hours, "--amplify"]) == 0
    assert json.loads(capsys.readouterr().out)["rendered"] == 3, "other frames than the plain ones"
    assert np.abs(np.asarray(Image.open(frames[0]), float) - morning).mean() > 0.5, "detail is seen"
    assert main([*film, *hours, "--every", "1h"]) == 2
    assert "--every: does nothing" in capsys.readouterr().err
