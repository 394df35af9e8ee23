"""Films, lit textures and insolation: seasons, exposure, frames that survive kills, maps whose truth is known."""

import json
import os
import signal
import subprocess
import sys
import time
from datetime import UTC, date, datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np
import places
import pytest

from seasonscapes.albedo.seasons import season_weights
from seasonscapes.cli import main
from seasonscapes.errors import AtlasMismatch, InputError
from seasonscapes.images import read_exr
from seasonscapes.relighting.exposure_smoothing import smoothed_ev100
from seasonscapes.relighting.film import write_video
from seasonscapes.relighting.frame_file import frame_header, load_frame, save_frame
from seasonscapes.relighting.luminous_efficacy import efficacies_lm_w
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.scene import read_scene
from seasonscapes.sky.models import read_sky_model
from seasonscapes.sky.night import air_mass
from seasonscapes.terrain.surface import Texture
from seasonscapes.workflows.albedo_sources import AlbedoFile, AlbedoSeries, DatedAlbedo
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workflows.relight_session import RenderJob, open_session, still_session, view_at, view_of_day
from seasonscapes.workflows.timelapse import cached_session, frames_folder, render_frame, shard
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import Workspace

NOON = datetime(2024, 6, 21, 11, tzinfo=UTC)
SIZE = (48, 32)


@pytest.fixture(scope="module")
def hill(tmp_path_factory) -> RenderJob:
    """A hill of 3 km under the Hosek sky, whose light costs little."""
    folder = tmp_path_factory.mktemp("hill")
    path = places.write_place(folder)
    return RenderJob(
        path,
        folder / "workspace",
        MeshOptions(),
        read_scene(path).camera(None),
        SIZE,
        read_sky_model("hosek"),
        base_day=date(2024, 6, 21),
    )


def place_of(job: RenderJob):
    return load_place(Path(job.scene), Workspace(Path(job.workspace)))


def hours(count: int, minutes: float = 10.0) -> list[datetime]:
    return [NOON + timedelta(minutes=minutes * index) for index in range(count)]


@pytest.mark.parametrize(
    ("day", "season", "expected"),
    [
        (date(2023, 7, 20), "nearest", [(1, 1.0)]),
        (date(2023, 12, 31), "nearest", [(0, 1.0)]),
        (date(2025, 1, 15), "blended", [(0, 1.0)]),
        (date(2025, 4, 15), "blended", [(0, 0.5), (1, 0.5)]),
        (date(2025, 10, 14), "blended", [(1, 0.505), (0, 0.495)]),
    ],
)
def test_colours_go_round_the_year(day, season, expected):
    weights = season_weights([date(2019, 1, 15), date(2022, 7, 14)], day, season=season)
    assert [index for index, _ in weights] == [index for index, _ in expected]
    np.testing.assert_allclose([w for _, w in weights], [w for _, w in expected], atol=0.01)
    assert season_weights([date(2024, 3, 1)], day, season=season) == [(0, 1.0)]


def test_exposure_follows_a_dusk_and_loses_its_flicker():
    seconds = np.arange(60) * 600.0
    ramp = 14.0 - seconds / 3600.0
    np.testing.assert_allclose(smoothed_ev100(seconds, ramp, window_s=1800.0), ramp, atol=1e-9)
    flicker = ramp + 0.2 * np.random.default_rng(3).choice([-1.0, 1.0], 60)
    smooth = smoothed_ev100(seconds, flicker, window_s=1800.0)
    assert np.diff(smooth - ramp).std() < 0.2 * np.diff(flicker - ramp).std()
    np.testing.assert_array_equal(smoothed_ev100(seconds, flicker, window_s=0.0), flicker)
    # A fall far quicker than the window is followed to within half a stop.
    cliff = np.where(seconds < 18000.0, 14.0, -3.0)
    assert np.abs(smoothed_ev100(seconds, cliff, window_s=7200.0) - cliff).max() <= 0.5
    # Hours apart from each other, frames keep their own.
    np.testing.assert_allclose(smoothed_ev100(seconds * 60.0, flicker, window_s=900.0), flicker, atol=1e-6)


@pytest.mark.parametrize("level", [1e-4, 1.0, 3e4])
def test_frame_files_hold_night_and_day(tmp_path, level):
    radiance = (level * np.random.default_rng(1).uniform(0.01, 3.0, (8, 6, 3))).astype(np.float32)
    radiance[0, 0] = 1.6e9  # the sun's disc
    metered = float(np.log2(level / 0.125))
    save_frame(tmp_path / "a.exr", radiance, metered_ev100=metered, provenance={"scene": "x"})
    back, ev100 = load_frame(tmp_path / "a.exr")
    np.testing.assert_allclose(back[1:], radiance[1:], rtol=1e-3)
    assert ev100 == frame_header(tmp_path / "a.exr")[0] == pytest.approx(metered, abs=1e-5)
    assert np.isfinite(back).all()
    # The same to other programs, which read it by the library.
    layers, header = read_exr(tmp_path / "a.exr")
    saturation = np.float32(1.2 * 2.0**metered)
    np.testing.assert_array_equal(layers[""].astype(np.float32) * np.float32(1.2 * 2.0**ev100), back)
    np.testing.assert_allclose(layers[""][1:].astype(np.float32) * saturation, radiance[1:], rtol=1e-3)
    assert json.loads(header["seasonscapes:provenance"]) == {"scene": "x"}


def test_a_film_plays(tmp_path):
    import imageio_ffmpeg

    images = [np.full((33, 48, 3), level, np.float32) for level in (0.0, 0.05, 0.21404, 1.0)]
    assert write_video(tmp_path / "f.mp4", iter(images), fps=2.0) == 4
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "f.mp4"))
    about = next(reader)
    assert about["size"] == (48, 32)
    assert about["fps"] == 2.0
    frames = [np.frombuffer(frame, np.uint8).mean() for frame in reader]
    np.testing.assert_allclose(frames, [0.5, 63.5, 127.5, 255.0], atol=4.0)
    with pytest.raises(ValueError, match="got no images"):
        write_video(tmp_path / "empty.mp4", iter([]))
    assert [path.name for path in tmp_path.iterdir()] == ["f.mp4"]


def test_a_frame_equals_path_tracing(hill):
    """The whole way from a file and a time, against Monte Carlo."""
    from seasonscapes.rendering.mitsuba_scene import build_scene
    from seasonscapes.rendering.radiance import render_view

    session = open_session(hill)
    view, light, _ = view_at(session, NOON)
    scene = build_scene(session.place.terrain, session_albedo(session), light)
    reference = render_view(scene, session.camera, spp=512)
    land = (view.coverage == 1.0) & (reference.coverage == 1.0)
    assert land.mean() > 0.3
    ratio = view.radiance[land].mean() / reference.radiance[land].mean()
    assert ratio == pytest.approx(1.0, abs=0.01)
    assert np.abs(view.radiance - reference.radiance)[land].mean() < 0.03 * reference.radiance[land].mean()


def session_albedo(session):
    from seasonscapes.workflows.albedo_sources import scene_albedo

    return scene_albedo(session.place, NOON).values


def test_dated_albedos_dress_the_view(hill, tmp_path):
    """Midway between two dated textures the picture is midway too, wherever light comes straight from the sky."""
    from dataclasses import replace

    from seasonscapes.terrain.surface import Texture, save_texture

    place = place_of(hill)
    shape = (place.atlas.height_px, place.atlas.width_px, 3)
    pairs = []
    for day, level in (("2024-03-22", 0.1), ("2024-09-19", 0.3)):
        save_texture(Texture(np.full(shape, level, np.float32)), tmp_path / f"{day}.npz")
        pairs.append(AlbedoFile(date.fromisoformat(day), tmp_path / f"{day}.npz"))
    dressed = open_session(replace(hill, albedo=tuple(pairs)))
    pictures = [
        view_at(dressed, datetime(2024, month, day, 11, tzinfo=UTC))[0] for month, day in ((3, 22), (6, 20), (9, 19))
    ]
    # Equinoxes have the same sun within a degree: albedo alone differs, by three, and bounces a little more.
    land = pictures[0].coverage == 1.0
    ratio = np.median(pictures[2].surface[land] / pictures[0].surface[land])
    assert 2.9 < ratio < 3.4
    middle = view_of_day(dressed, date(2024, 6, 20))
    np.testing.assert_allclose(middle.coefficients.albedo[middle.coefficients.coverage == 1.0], 0.2, atol=2e-3)
    with pytest.raises(InputError, match="no such file"):
        open_session(replace(hill, albedo=(AlbedoFile(date(2024, 3, 22), tmp_path / "missing.npz"),)))
    coarse = replace(hill, mesh=MeshOptions(texel_m=100.0), albedo=tuple(pairs))
    with pytest.raises(AtlasMismatch, match="another atlas"):
        open_session(coarse)


def test_a_still_and_a_film_of_one_view_keep_their_albedos_apart(hill):
    """Both keep the albedo of each date in the workspace; they sample a pixel differently."""
    place = place_of(hill)
    camera = camera_for(place, hill.view, size_px=(24, 16))
    shape = (place.atlas.height_px, place.atlas.width_px, 3)
    textures = [np.full(shape, level, np.float32) for level in (0.1, 0.3)]
    series = AlbedoSeries(
        tuple(
            DatedAlbedo(date(2024, month, 21), f"level {level}", lambda texture=texture: Texture(texture))
            for month, level, texture in zip((3, 9), (0.1, 0.3), textures, strict=True)
        )
    )
    for samples in (16, 4):
        sampling = SamplingOptions(shadow_samples=samples, albedo_samples=16, rays=16, clusters=64)
        session = still_session(place, camera, albedo=series, sampling=sampling)
        assert len(view_of_day(session, date(2024, 6, 21)).coefficients.albedo) == len(session.coefficients.pixel)


def test_shards_are_a_partition():
    times = hours(10)
    parts = [shard(times, part, 3) for part in (1, 2, 3)]
    assert sorted(time for part in parts for time in part) == times
    for wrong in ((0, 3), (4, 3), (1, 0)):
        with pytest.raises(InputError, match="shard"):
            shard(times, *wrong)


def arguments(hill: RenderJob, output: Path, *more: str) -> list[str]:
    return [
        "timelapse",
        str(hill.scene),
        "--workspace",
        str(hill.workspace),
        "--sky",
        "hosek",
        "--size",
        "48x32",
        "-o",
        str(output),
        "--json",
        *more,
    ]


def test_timelapse_resumes_and_grows(hill, tmp_path, capsys):
    def run(*more: str) -> dict:
        assert main(arguments(hill, *more)) == 0
        return json.loads(capsys.readouterr().out)

    span = ("--from", "2024-06-21T12:00", "--to", "2024-06-21T13:00")
    first = run(tmp_path / "film.mp4", *span, "--every", "20min", "--keep-frames")
    assert (first["frames"], first["rendered"]) == (4, 4)
    longer = run(tmp_path / "folder", *span, "--every", "10min", "--keep-frames")
    assert (longer["frames"], longer["rendered"]) == (7, 3)
    assert len(list((tmp_path / "folder").glob("*.png"))) == 7
    again = run(tmp_path / "film2.mp4", *span, "--every", "10min")
    assert again["rendered"] == 0
    assert main(["info", str(tmp_path / "film2.mp4"), "--json"]) == 0
    about = json.loads(capsys.readouterr().out)
    assert (about["frames"], about["seasonscapes"]["camera"]) == (7, "south")
    for kind in ("terrain-*.npz", "coefficients-*"):
        assert main(["info", str(next((Path(hill.workspace) / "hill").glob(kind))), "--json"]) == 0
        record = capsys.readouterr().out
        assert '"inputs"' in record or '"key"' in record
    assert main(["info", str(hill.scene)]) == 2
    assert "carries no provenance" in capsys.readouterr().err
    # Without --keep-frames the undeveloped frames are gone when the film is there.
    assert run(tmp_path / "film3.mp4", *span, "--every", "10min")["rendered"] == 7


def test_shards_then_the_film(hill, tmp_path, capsys):
    times = tmp_path / "times.txt"
    times.write_text("2024-06-21T08:00Z\n# a remark\n2024-06-21T09:30Z\n2024-06-21T10:15Z  # the last\n")
    for part in ("1/2", "2/2"):
        assert main(arguments(hill, tmp_path / "x.mp4", "--times", str(times), "--shard", part)) == 0
        assert not (tmp_path / "x.mp4").exists()
    capsys.readouterr()
    assert main(arguments(hill, tmp_path / "x", "--times", str(times), "--exr")) == 0
    # Frames were there, yet their full-precision copies were not.
    assert json.loads(capsys.readouterr().out)["frames"] == 3
    assert len(list((tmp_path / "x").glob("*.exr"))) == 3


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--from", "2024-06-21T12:00"], "--to are needed|and --to"),
        (["--from", "2024-06-21T12:00", "--to", "2024-06-21T11:00"], "before --from"),
        (["--from", "2024-06-21T12:00", "--to", "2024-06-21T13:00", "--every", "soon"], "length of time"),
        (["--times", ","], "no time in it"),
        (["--times", "2024-06-21T12:00", "--season", "dry"], "--season"),
        (["--times", "2024-06-21T12:00", "--albedo", "summer.npz"], "--albedo"),
        (["--times", "2024-06-21T12:00", "--cluster", "cloud:9"], "--cluster"),
        (["--times", "2024-06-21T12:00", "--cluster", "slurm:none.toml"], "no such file"),
        (["--times", "2024-06-21T12:00", "--exr"], "wants a folder"),
        (["--times", "2024-06-21T12:00", "--albedo", "March=summer.npz"], "not a date"),
        (["--times", "2024-06-21T12:00", "--shard", "4/3"], "not a part of the whole"),
        (
            ["--times", "2024-06-21T12:00", "--at", "46.551,7.98,+300", "--heading", "0", "--pitch", "80"],
            "sees no terrain",
        ),
    ],
)
def test_timelapse_says_what_is_wrong(hill, tmp_path, capsys, more, message):
    import re

    assert main([*arguments(hill, tmp_path / "film.mp4"), *more]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert re.search(message, error), error
    assert not (tmp_path / "film.mp4").exists()


@pytest.mark.slow
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_film_goes_on(hill, tmp_path, capsys, sign):
    output = tmp_path / "film.mp4"
    more = ("--from", "2024-06-20T08:00", "--to", "2024-06-20T18:00", "--every", "10min", "--seed", str(int(sign)))
    command = [sys.executable, "-m", "seasonscapes", *arguments(hill, output, *more)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE)
    pattern, deadline = "hill/frames-*/20240620T*.exr", time.monotonic() + 120
    while len(done := list(Path(hill.workspace).glob(pattern))) < 5:
        assert time.monotonic() < deadline
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    process.send_signal(sign)
    _, said = process.communicate(timeout=60)
    assert process.returncode == (130 if sign == signal.SIGINT else -signal.SIGKILL), said
    assert not output.exists()
    # Every frame that bears its name is whole.
    done = list(Path(hill.workspace).glob(pattern))
    assert 5 <= len(done) < 61
    assert all(np.isfinite(load_frame(path)[0]).all() for path in done)
    assert main(arguments(hill, output, *more)) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["rendered"] == 61 - len(done)
    assert output.stat().st_size > 1000


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(hill):
    """Sixty frames on two processes, one of which dies in the middle: all arrive, equal to the digit."""
    from dataclasses import replace

    from seasonscapes.cluster import connected, run_by

    times = hours(60, 7.0)
    # A seed of its own: no other test's frames lie in this folder.
    job = replace(hill, seed=5)
    folder = frames_folder(cached_session(job))
    for each in times:
        render_frame(job, each)
    expected = {path.name: load_frame(path)[0] for path in folder.iterdir()}
    for path in folder.iterdir():
        path.unlink()
    with connected("local:2") as client:
        victim = next(iter(client.run(os.getpid).values()))
        records = []
        for record in run_by(client, partial(render_frame, job), times):
            records.append(record)
            if len(records) == 20:
                os.kill(victim, signal.SIGKILL)
        assert len(client.run(os.getpid)) >= 1
    assert sorted({record["time_utc"] for record in records}) == sorted(each.isoformat() for each in times)
    found = {path.name: load_frame(path)[0] for path in folder.iterdir()}
    assert found.keys() == expected.keys()
    for name, picture in found.items():
        np.testing.assert_array_equal(picture, expected[name])
    assert not any(render_frame(job, each)["rendered"] for each in times)


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_slurm_jobs_render(hill, tmp_path, monkeypatch):
    """A stand-in for sbatch runs the very job script that a cluster would get."""
    from seasonscapes.cluster import run_on_cluster

    tools = tmp_path / "bin"
    tools.mkdir()
    sbatch = tools / "sbatch"
    # The script's own file is gone as soon as sbatch answers, as it may be on a cluster.
    sbatch.write_text(
        f'#!/bin/sh\ncp "$1" {tmp_path}/job.sh\nsetsid sh {tmp_path}/job.sh >{tmp_path}/job.log 2>&1 &\n'
        'echo "Submitted batch job 7"\n'
    )
    (tools / "scancel").write_text("#!/bin/sh\nexit 0\n")
    for tool in tools.iterdir():
        tool.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")
    wishes = tmp_path / "cluster.toml"
    wishes.write_text(
        'jobs = 1\n[slurm]\ncores = 1\nmemory = "4GB"\nwalltime = "00:10:00"\nqueue = "alpine"\ninterface = "lo"\n'
    )
    times = [NOON + timedelta(days=1, hours=index) for index in range(3)]
    records = list(run_on_cluster(f"slurm:{wishes}", partial(render_frame, hill), times))
    assert len(records) == 3
    assert all(record["rendered"] for record in records)
    script = (tmp_path / "job.sh").read_text()
    assert "#SBATCH -p alpine" in script
    assert "#SBATCH -t 00:10:00" in script
    wishes.write_text("jobs = 0\n")
    with pytest.raises(InputError, match="not a number of jobs; got 0"):
        list(run_on_cluster(f"slurm:{wishes}", partial(render_frame, hill), times))


def test_efficacies_are_those_of_a_clear_day_and_of_an_overcast_one():
    """Perez et al. 1990, table 4 with equations 7 and 8, at the irradiances that the answer means: it is a fixed point."""
    water_cm, zenith = 1.4, np.radians(30.0)
    direct, diffuse = efficacies_lm_w(100_000.0, 12_000.0, 60.0)
    beam, sky = 100_000.0 / direct, 12_000.0 / diffuse
    clearness = ((sky + beam) / sky + 1.041 * zenith**3) / (1.0 + 1.041 * zenith**3)
    assert clearness > 6.2, "the clearest of the eight classes"
    brightness = sky * air_mass(60.0) / 1361.0
    assert direct == pytest.approx(
        101.18 + 1.58 * water_cm - 1.10 * np.exp(5.73 * zenith - 5.0) - 8.29 * brightness, rel=1e-4
    )
    assert diffuse == pytest.approx(
        152.23 + 0.35 * water_cm - 45.27 * np.cos(zenith) - 7.98 * np.log(brightness), rel=1e-4
    )
    _, overcast = efficacies_lm_w(0.0, 15_000.0, 40.0)
    brightness = 15_000.0 / overcast * air_mass(40.0) / 1361.0
    assert overcast == pytest.approx(
        97.24 - 0.46 * water_cm + 12.00 * np.cos(np.radians(50.0)) - 8.91 * np.log(brightness), rel=1e-4
    )


def test_watts_agree_with_pvlib():
    """Broadband irradiance of our clear sky, by way of lux, against Ineichen & Perez's clear-sky model."""
    import pandas as pd
    import pvlib

    from seasonscapes.relighting.lit_texture import _efficacies
    from seasonscapes.sky.illumination import diffuse_horizontal_illuminance, direct_horizontal_illuminance, luminance
    from seasonscapes.workflows.illumination import illumination_at, sun_moon_position
    from seasonscapes.workspace import default_workspace

    when = datetime(2024, 6, 21, 11, 20, tzinfo=UTC)
    place = pvlib.location.Location(46.55, 7.98, altitude=2000.0)
    expected = place.get_clearsky(pd.DatetimeIndex([when]), linke_turbidity=2.6).iloc[0]
    light = illumination_at(
        read_sky_model("clear"),
        sun_moon_position(when, 46.55, 7.98, 2000.0),
        2000.0,
        workspace=default_workspace(),
        with_aerial_perspective=False,
    )
    direct, diffuse = _efficacies(light)
    beam = luminance(direct_horizontal_illuminance(light.sun)) / direct
    sky = luminance(diffuse_horizontal_illuminance(light.sky_radiance)) / diffuse
    assert beam + sky == pytest.approx(expected["ghi"], rel=0.07)


def test_irradiance_map_of_a_hill(hill, tmp_path, capsys):
    """Flat ground gets sun × sine of its elevation; sun and sky arrive as the report of the sky says."""
    import rasterio

    from seasonscapes.sky.illumination import global_horizontal_illuminance, luminance
    from seasonscapes.workflows.illumination import illumination_at, sun_moon_position

    common = [
        "irradiance",
        str(hill.scene),
        "--workspace",
        str(hill.workspace),
        "--sky",
        "hosek",
        "--rays",
        "64",
        "--json",
    ]
    assert main([*common, "--time", "2024-06-21T11:00Z", "-o", str(tmp_path / "a.tif")]) == 0
    record = json.loads(capsys.readouterr().out)
    place = place_of(hill)
    height_m = float(np.median(place.elevation.values))
    moment = sun_moon_position(NOON, place.frame.latitude_deg, place.frame.longitude_deg, height_m)
    light = illumination_at(hill.sky, moment, height_m, workspace=place.workspace)
    with rasterio.open(tmp_path / "a.tif") as file:
        assert file.descriptions == ("total W/m2", "direct W/m2", "sky W/m2", "reflected W/m2", "total lx")
        assert file.crs.to_epsg() == 32632
        assert file.transform.almost_equals(place.elevation.transform)
        values = file.read()
    flat = values[:, 2:8, 2:8]
    expected = float(luminance(global_horizontal_illuminance(light)))
    assert np.nanmean(flat[4]) == pytest.approx(expected, rel=0.02)
    np.testing.assert_allclose(values[0], values[1:4].sum(axis=0), rtol=1e-5)
    # The southern flank of the hill faces the noon sun, the northern one does not.
    assert np.nanmean(values[1, 30:34, 28:33]) > 1.1 * np.nanmean(values[1, 20:23, 28:33])
    assert record["mean"]["total W/m2"] == pytest.approx(float(np.nanmean(values[0])), rel=1e-3)


def test_insolation_of_a_day(hill, tmp_path, capsys):
    import rasterio

    common = [
        "irradiance",
        str(hill.scene),
        "--workspace",
        str(hill.workspace),
        "--sky",
        "hosek",
        "--rays",
        "16",
        "--json",
    ]
    span = ["--from", "2024-06-21T04:00Z", "--to", "2024-06-21T19:00Z", "--every", "1h", "--spacing-m", "100"]
    assert main([*common, *span, "-o", str(tmp_path / "day.tif")]) == 0
    capsys.readouterr()
    with rasterio.open(tmp_path / "day.tif") as file:
        total, sunshine = file.read(1), file.read(6)
    # From half an hour after sunrise to half an hour before sunset on the longest day; some 8 kWh/m² under a clear sky.
    assert 14.0 < np.nanmean(sunshine[1:4, 1:4]) <= 15.0
    assert 7.0 < np.nanmean(total[1:4, 1:4]) < 9.5
    night = ["--from", "2024-06-21T22:00Z", "--to", "2024-06-21T23:00Z", "--every", "10min"]
    assert main([*common, *night]) == 2
    assert "below the horizon" in capsys.readouterr().err
    assert main(common) == 2
    assert "either an instant or a period" in capsys.readouterr().err


def test_lit_texture(hill, tmp_path, capsys):
    import pygltflib

    from seasonscapes.images import read_exr

    common = [
        "lit-texture",
        str(hill.scene),
        "--workspace",
        str(hill.workspace),
        "--sky",
        "hosek",
        "--time",
        "2024-06-21T11:00Z",
        "--texel-m",
        "50",
    ]
    for suffix in ("exr", "png", "glb"):
        assert main([*common, "--rays", "16", "-o", str(tmp_path / f"lit.{suffix}")]) == 0
    layers, header = read_exr(tmp_path / "lit.exr")
    light = layers["sun"] + layers["sky"] + layers["bounce"]
    known = np.isfinite(light).all(axis=-1)
    assert known.mean() > 0.9
    np.testing.assert_allclose(layers[""][known], (light * layers["albedo"] / np.pi)[known], rtol=1e-4)
    assert json.loads(header["seasonscapes:provenance"])["sun"]["elevation_deg"] > 60.0
    model = pygltflib.GLTF2.load(str(tmp_path / "lit.glb"))
    assert "KHR_materials_unlit" in model.materials[0].extensions
    assert len(model.images) == 1
    assert model.asset.extras["scene"] == "hill"
    assert model.asset.extras["origin"]["latitude_deg"] == pytest.approx(46.551, abs=0.01)
    assert model.asset.extras["origin"]["vertical_datum"] == "local"
    assert model.asset.extras["source_crs"] == "EPSG:32632"
    # No file tells where on the maker's disk it was made from or written to.
    for suffix in ("exr", "png", "glb"):
        assert str(tmp_path).encode() not in (tmp_path / f"lit.{suffix}").read_bytes()
        assert str(hill.scene).encode() not in (tmp_path / f"lit.{suffix}").read_bytes()
    for suffix in ("exr", "png", "glb"):
        capsys.readouterr()
        assert main(["info", str(tmp_path / f"lit.{suffix}"), "--json"]) == 0
        assert "elevation_deg" in capsys.readouterr().out
    capsys.readouterr()
    assert main([*common, "--rays", "100", "-o", str(tmp_path / "x.png")]) == 2
    assert "power of two" in capsys.readouterr().err
