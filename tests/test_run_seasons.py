"""Photographs of two seasons in one run: grouped by what they show, an albedo of each, refined, and pictures between them."""

import json
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_server import CommandServer
from PIL import Image
from places import MASSIF

from seasonscapes.cli import main
from seasonscapes.sky.models import read_sky_model, with_overrides
from seasonscapes.terrain import surface
from seasonscapes.workflows import full_run, run_albedo
from seasonscapes.workflows.run_job import RunJob

DAYS = {"summer": ("2024-07-10", "2024-07-20"), "winter": ("2024-01-20",)}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Three days at an hour each, to the pictures of a summer's, a winter's and a day between."""
    folder = tmp_path_factory.mktemp("seasons")
    (folder / "little.toml").write_text(MASSIF)
    times = [f"{day}T13:00" for days in DAYS.values() for day in days]
    arguments = [
        *("run", str(folder / "little.toml"), "--workspace", str(folder / "work"), "--times", ",".join(times)),
        *("--at-hours", "2024-01-20T12:30,2024-04-10T12:30,2024-07-20T12:30", "--leave-out", "meadow"),
        *("--photo-size", "720x120", "--size", "96x64", "--texel-m", "120", "--refine", "1", "--max-error-m", "6"),
        *("--sky", "hosek", "--use-painted", "--use-inpainted", "--until", "relight", "-o", str(folder / "run")),
    ]
    server = CommandServer(folder)
    made = server.run(arguments, "log.txt")
    server.close()
    assert made["code"] == 0, (folder / "log.txt").read_text()
    return folder / "run"


@pytest.mark.slow
def test_days_are_grouped_and_each_season_has_its_albedo(run):
    records = json.loads((run / "albedo" / "seasons.json").read_text())
    assert [tuple(record["days"]) for record in records] == [DAYS["winter"], DAYS["summer"]]
    assert [record["file"] for record in records] == ["albedo_2024-01-20.npz", "albedo_2024-07-10.npz"]
    assert sorted(time[:10] for time in records[1]["times_utc"]) == ["2024-07-10", "2024-07-20"]
    winter, summer = (np.load(run / "albedo" / record["file"]) for record in records)
    assert (str(winter["date"]), str(summer["date"])) == ("2024-01-20", "2024-07-10")
    both = (winter["source"] == 1) & (summer["source"] == 1)
    assert both.sum() > 200
    assert winter["values"][both].mean() > summer["values"][both].mean() + 0.15, "snow lies on one of them"


@pytest.mark.slow
def test_paintings_and_completions_go_back_into_both_albedos(run):
    entry = json.loads((run / "run.json").read_text())["refine"]
    assert {Path(name).name for name in entry["files"]} >= {"albedo_2024-01-20.npz", "albedo_2024-07-10.npz"}
    for name in ("albedo_2024-01-20.npz", "albedo_2024-07-10.npz"):
        before, after = (np.load(run / stage / name) for stage in ("albedo", "refined"))
        measured = before["source"] == 1
        change = np.abs(after["values"] - before["values"]).max(axis=2)
        assert 0.0 < np.median(change[measured]) < 0.03, "measured texels: the paintings agree with the photographs"
        assert np.median(change[before["source"] == 2]) > 0.0


@pytest.mark.slow
def test_pictures_between_the_seasons_lie_between_them(run):
    january, april, july = (np.asarray(Image.open(path), float) for path in sorted((run / "relight").glob("*.png")))
    assert january.shape == april.shape == july.shape == (64, 96, 3)
    land = [picture[40:].mean(axis=2) for picture in (january, april, july)]
    assert np.abs(land[1] - land[2]).mean() > 3.0
    assert np.abs(land[1] - land[0]).mean() > 3.0


def test_a_season_between_photographs_of_one_day_is_refused(tmp_path, capsys):
    (tmp_path / "little.toml").write_text(MASSIF)
    times = ["--times", "2024-07-20T10:00,2024-07-20T15:00", "--at-hours", "2024-07-20T12:00"]
    place = ["--workspace", str(tmp_path / "work"), "--texel-m", "240", "--refine", "1"]
    where = ["-o", str(tmp_path / "run")]
    assert main(["run", str(tmp_path / "little.toml"), *times, *place, *where, "--season", "nearest"]) == 2
    assert "--times of two days" in capsys.readouterr().err


def test_a_day_that_tells_nothing_alone_joins_the_nearest(monkeypatch):
    """Of the recoveries of each day only the outcome counts here: one fails, the others are snow above two heights."""
    from test_albedo import _snow_above

    from seasonscapes.albedo import standard_error
    from seasonscapes.errors import NotEnoughEvidence
    from seasonscapes.workflows import season_recovery

    line_m = {date(2024, 9, 10): 2900.0, date(2024, 9, 20): 2890.0, date(2024, 11, 9): 2300.0, date(2023, 11, 20): None}
    days = [SimpleNamespace(time=datetime(day.year, day.month, day.day, 11, tzinfo=UTC)) for day in line_m]

    def solved(transport, own):
        day = own[0].observation.time.date()
        if line_m[day] is None:
            raise NotEnoughEvidence("nothing fixes the exposure")
        return line_m[day]

    monkeypatch.setattr(season_recovery, "closed_fit", solved)
    monkeypatch.setattr(
        season_recovery,
        "photographs_of_ground",
        lambda place, transport, seen, model, progress: (
            [SimpleNamespace(observation=each, gain=np.ones(3), gain_sigma=0.0) for each in seen],
            [],
            0.0,
        ),
    )
    monkeypatch.setattr(standard_error, "albedo_estimate", lambda transport, own, fit: _snow_above(fit))
    groups = season_recovery._grouped_days(None, None, days, None, None)
    assert [sorted(group) for group in groups] == [
        [date(2024, 9, 10), date(2024, 9, 20)],
        [date(2023, 11, 20), date(2024, 11, 9)],
    ]
    # Far from every other day, it is left out rather than mixed into a season that it may not show.
    line_m[date(2024, 11, 9)] = None
    assert [sorted(group) for group in season_recovery._grouped_days(None, None, days, None, None)] == [
        [date(2024, 9, 10), date(2024, 9, 20)]
    ]
    line_m.update(dict.fromkeys(line_m))
    assert [sorted(group) for group in season_recovery._grouped_days(None, None, days, None, None)] == [sorted(line_m)]


NOON = datetime(2024, 7, 20, 12, tzinfo=UTC)


def cloudy_job(folder, sky) -> RunJob:
    """A run whose albedo stage found clouds: webcam a at noon clear and twenty minutes later overcast, b near noon overcast."""
    found = [("a", 0, 0.0), ("a", 20, 1.0), ("b", 5, 0.8), ("b", 150, 0.2)]
    photographs = [
        {"webcam": webcam, "time_utc": (NOON + timedelta(minutes=minutes)).isoformat(), "cloudiness": cloudiness}
        for webcam, minutes, cloudiness in found
    ]
    (folder / "albedo").mkdir(parents=True)
    (folder / "albedo" / "albedo.json").write_text(json.dumps({"photographs": photographs}))
    record = {"file": "albedo.npz", "days": ["2024-07-20"], "times_utc": [each["time_utc"] for each in photographs]}
    (folder / "albedo" / "seasons.json").write_text(json.dumps([record]))
    place = SimpleNamespace(scene=None)
    times = (NOON, NOON + timedelta(minutes=20), NOON + timedelta(hours=5))
    return RunJob(place, times, (), None, (96, 64), sky)  # pyright: ignore[reportArgumentType]


def test_an_instant_has_the_clouds_of_each_webcams_nearest_photograph(tmp_path, monkeypatch):
    clear = read_sky_model("clear")
    job = cloudy_job(tmp_path, clear)
    expected = [0.4, 0.9, 0.0]
    found = [run_albedo.sky_at(job, tmp_path, time).cloudiness for time in job.times]
    assert found == pytest.approx(expected)
    stated = with_overrides(clear, cloudiness=0.0)
    assert run_albedo.sky_at(cloudy_job(tmp_path / "stated", stated), tmp_path / "stated", NOON) is stated
    # The film of a time has its sky behind.
    filmed = []

    def film_path(place, folder, textures, own, *, cloudiness, **rest):
        assert [time for time, _, _ in textures] == list(job.times)
        filmed.extend(cloudiness)
        return []

    texture = SimpleNamespace(values=None, weight=np.ones((2, 2)))
    monkeypatch.setattr(full_run, "film_path", film_path)
    monkeypatch.setattr(full_run.completion, "read_painted", lambda path, place: texture)
    monkeypatch.setattr(surface, "load_texture", lambda path: texture)
    full_run._film(job, tmp_path, None)
    assert filmed == pytest.approx(expected)


def test_what_later_stages_read_belongs_to_the_files_of_the_albedo_stage(tmp_path, monkeypatch):
    monkeypatch.setattr(run_albedo, "save_albedo_figures", lambda *arguments: {})
    photograph = SimpleNamespace(
        observation=SimpleNamespace(webcam="a", time=NOON), light=SimpleNamespace(cloudiness=0.6)
    )
    recovered = SimpleNamespace(
        day=NOON.date(),
        estimate=SimpleNamespace(source=np.ones((2, 2))),
        photographs=[photograph],
        fit=SimpleNamespace(residual=np.array([0.1])),
        facts={},
        save=lambda path: path.write_bytes(b"albedo"),
    )
    (tmp_path / "albedo").mkdir()
    season = SimpleNamespace(recovered=recovered, record={"times_utc": [NOON.isoformat()]})
    job = cloudy_job(tmp_path / "other", read_sky_model("clear"))
    files = run_albedo.save_seasons(job, [season], tmp_path / "albedo")
    assert [file.name for file in files] == ["albedo.npz", "albedo.json", "seasons.json"]
    assert run_albedo.sky_at(job, tmp_path, NOON).cloudiness == 0.6
