"""``seasonscapes hours``: a fixed camera that photographed a synthetic valley, asked for an hour that was left out."""

import json
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

import seasonscapes as ss
from seasonscapes.cli import main
from seasonscapes.images import read_image_srgb8, write_png8

TAKEN = [f"2024-07-{day}T{hour}:00Z" for day, hour in ((18, "06"), (19, "08"), (20, "10"), (21, "13"), (22, "15"))]
HELD_OUT = "2024-07-20T11:30Z"
MASKED_ROWS = 6


@pytest.fixture(scope="module")
def valley(tmp_path_factory, few_rays) -> Path:
    """A folder with photographs, manifest.csv and calibrations of one webcam."""
    folder = tmp_path_factory.mktemp("valley")
    place = ss.load_place("alpine_small")
    camera = ss.camera(place, "aerial", size_px=(96, 64))
    ss.synthetic_photographs(place, [*TAKEN, HELD_OUT], folder, cameras={"aerial": camera})
    mask = np.full((64, 96, 3), 255, np.uint8)
    mask[-MASKED_ROWS:] = 0
    write_png8(folder / "masks" / "aerial.png", mask)
    return folder


def _arguments(folder: Path, output: Path, *more: str) -> list[str]:
    named = ("--manifest", str(folder / "manifest.csv"), "--calibrations", str(folder), "-o", str(output))
    return ["hours", "alpine_small", "--at-hours", HELD_OUT, *named, *more]


def _picture(path: Path) -> np.ndarray:
    return read_image_srgb8(path).astype(float) / 255.0


def _error_db(picture: np.ndarray, truth: np.ndarray) -> float:
    """PSNR [dB] after one gain for each colour."""
    gain = (picture * truth).sum(axis=(0, 1)) / (picture**2).sum(axis=(0, 1))
    return float(-10.0 * np.log10(np.mean((picture * gain - truth) ** 2)))


@pytest.fixture(scope="module")
def asked(valley, tmp_path_factory) -> tuple[Path, str, str]:
    """The folder, standard output and warnings of one run: the hour that was left out, and one of a season never seen."""
    folder = tmp_path_factory.mktemp("asked") / "out"
    arguments = _arguments(valley, folder, "--hold-out", HELD_OUT, "--sky", "sun", "--masks", str(valley / "masks"))
    arguments[arguments.index("--at-hours") + 1] = f"{HELD_OUT},2024-12-20T12:00Z"
    arguments += ["--check-clocks", "20"]
    out, error = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(error):
        assert main(arguments) == 0
    return folder, out.getvalue(), error.getvalue()


def test_the_hour_left_out_is_nearer_to_its_photograph_than_any_other_photograph_and_their_mean(valley, asked):
    rows = [row.split(",") for row in (valley / "manifest.csv").read_text().splitlines()[1:]]
    photographs = {row[1]: _picture(valley / row[2]) for row in rows}
    (time,) = [time for time in photographs if "T11:30" in time]
    truth, found = photographs.pop(time), _picture(asked[0] / "aerial_2024-07-20T1130Z.png")
    land = slice(24, -MASKED_ROWS)
    rivals = [*photographs.values(), np.mean(list(photographs.values()), axis=0)]
    assert len(rivals) == 6
    assert _error_db(found[land], truth[land]) > max(_error_db(each[land], truth[land]) for each in rivals) + 1.0


def test_what_a_mask_hides_stays_as_in_the_median_of_the_pictures(valley, asked):
    rows = [row.split(",") for row in (valley / "manifest.csv").read_text().splitlines()[1:]]
    median = np.median([_picture(valley / row[2]) for row in rows if "T11:30" not in row[1]], axis=0)
    found = _picture(asked[0] / "aerial_2024-07-20T1130Z.png")
    np.testing.assert_allclose(found[-MASKED_ROWS:], median[-MASKED_ROWS:], atol=1.5 / 255.0)


def test_weather_of_each_picture_is_written_and_the_sun_was_seen(asked):
    folder, out, _ = asked
    weather = json.loads((folder / "weather.json").read_text())
    assert [each["time_utc"][:16] + "Z" for each in weather] == TAKEN
    assert all(each["sun_shone"] and each["explained"] for each in weather)
    assert out.count("direct light") == len(TAKEN)


def test_clocks_are_told_for_each_picture_and_right_ones_are_not_doubted(asked):
    folder, out, error = asked
    clocks = json.loads((folder / "clocks.json").read_text())
    assert [each["time_utc"][:16] + "Z" for each in clocks] == TAKEN
    told = [each for each in clocks if each["trusted"]]
    assert told
    assert all(abs(each["offset_min"]) <= 2.0 for each in told)
    assert out.count("10 m of error of the heights") == len(told)
    assert out.count("clock not told: ") == len(clocks) - len(told)
    assert not any(each["doubted"] for each in clocks)
    assert "check the camera's clock" not in error


def test_a_season_never_seen_is_said(asked):
    assert "2024-12-20 lies" in asked[2]
    assert "never seen" in asked[2]


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (("--webcam", "hut"), "--webcam: has no picture in the manifest; got 'hut'; expected aerial"),
        (("--hold-out", "2024-01-01T12:00Z"), "--hold-out: no picture of that time"),
        (("--hold-out", ",".join(TAKEN)), "1 pictures of aerial"),
        (("--sky", "rain"), "--sky"),
        (("--check-clocks", "5"), "--check-clocks: out of range; got 5.0; expected 10 to 180"),
    ],
)
def test_mistakes_are_told_in_one_line(valley, tmp_path, capsys, more, told):
    assert main(_arguments(valley, tmp_path / "out", *more)) == 2
    error = capsys.readouterr().err.strip()
    assert told in error.splitlines()[-1], error
    assert not (tmp_path / "out").exists()
