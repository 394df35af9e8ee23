"""The command line as a person uses it: verbs, records, errors, interruption."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import places
import pytest
from PIL import Image

from seasonscapes.cli import main
from seasonscapes.images import read_exr

SMALL = ["--size", "96x64", "--spp", "4", "--sky", "hosek"]


@pytest.fixture
def hill(tmp_path, monkeypatch):
    monkeypatch.setenv("SEASONSCAPES_WORKSPACE", str(tmp_path / "work"))
    return places.write_place(tmp_path / "scene")


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def test_render_a_picture_and_its_record(hill, tmp_path, capsys):
    output = tmp_path / "a.png"
    assert run("render", hill, "--time", "2024-09-01T12:00", "-o", output, "--json", *SMALL) == 0
    said = capsys.readouterr()
    record = json.loads(said.out)
    assert record["time_utc"] == "2024-09-01T10:00:00+00:00"
    assert "Europe/Zurich" in said.err
    assert "sun at azimuth" in said.err
    assert 40.0 < record["sun"]["elevation_deg"] < 52.0
    picture = Image.open(output)
    assert picture.size == (96, 64)
    assert json.loads(picture.text["seasonscapes"])["camera"] == "south"
    pixels = np.asarray(picture, float)
    assert pixels[:8].mean(axis=(0, 1))[2] > pixels[:8].mean(axis=(0, 1))[0], "the sky is blue"
    # The meter brings the mean luminance, of land and sky together, near middle grey: 118 of 255, by at most a stop more.
    assert 118.0 < pixels.mean() < 165.0
    assert pixels[-16:].mean(axis=(0, 1))[0] > pixels[-16:].mean(axis=(0, 1))[2], (
        "sunlit grey land is warm under a blue sky"
    )
    assert record["output"] == str(output)
    assert str(tmp_path).encode() not in output.read_bytes(), "no path of the maker's disk"


def test_exr_layers_and_header_agree_with_the_picture(hill, tmp_path):
    output = tmp_path / "a.exr"
    assert run("render", hill, "--time", "2024-09-01T10:00Z", "-o", output, *SMALL) == 0
    layers, header = read_exr(output)
    assert set(layers) == {"", "surface", "alpha", "depth", "position", "normal", "uv", "albedo"}
    assert header["capDate"] == "2024:09:01 10:00:00"
    assert header["latitude"] == pytest.approx(46.5405, abs=1e-4)
    world_from_camera = np.array(json.loads(header["seasonscapes:world_from_camera"]))
    hit = np.isfinite(layers["depth"])
    away = np.linalg.norm(layers["position"] - world_from_camera[:3, 3], axis=-1)
    np.testing.assert_allclose(away[hit], layers["depth"][hit], rtol=1e-4)
    assert np.isnan(layers["albedo"][~hit]).all()
    # The western half of the image is reddish, in the albedo layer as on the map.
    west = layers["position"][..., 0] < -100.0
    assert layers["albedo"][hit & west][:, 0].mean() > 0.35
    assert layers["albedo"][hit & (layers["position"][..., 0] > 100.0)][:, 0].mean() < 0.25
    provenance = json.loads(header["seasonscapes:provenance"])
    assert provenance["spp"] == 4
    assert provenance["variant"]
    for folder in (tmp_path, hill.parent):
        assert str(folder).encode() not in output.read_bytes(), "no path of the maker's disk"


def test_equal_calls_equal_files(hill, tmp_path):
    for name in ("a.exr", "b.exr"):
        assert run("render", hill, "--time", "2024-09-01T10:00Z", "-o", tmp_path / name, *SMALL) == 0
    a, b = read_exr(tmp_path / "a.exr")[0], read_exr(tmp_path / "b.exr")[0]
    for name, values in a.items():
        np.testing.assert_array_equal(values, b[name])


def test_a_place_of_ones_own(hill, tmp_path, capsys):
    assert (
        run(
            "render",
            hill,
            "--at",
            "46.5405,7.98,+30",
            "--heading",
            "10",
            "--time",
            "2024-09-01T08:00",
            "-o",
            tmp_path / "a.png",
            *SMALL,
        )
        == 0
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--time", "2024-09-01T02:00"], r"the solar elevation is -\d+.*choose an atmosphere model"),
        (["--time", "2024-03-31T02:30"], "offset"),
        (["--time", "noon"], "--time|time"),
        (["--time", "2024-09-01T12:00", "--camera", "north"], "no such camera"),
        (["--time", "2024-09-01T12:00", "--at", "46.53;7.98", "--heading", "0"], "--at: not a place"),
        (
            ["--time", "2024-09-01T12:00", "--at", "7.98,146.53", "--heading", "0"],
            "stands 12721 km from the terrain; .* expected near latitude 46",
        ),
        (
            ["--time", "2024-09-01T12:00", "--at", "97.98,46.53", "--heading", "0"],
            "--at: latitude or longitude out of range",
        ),
        (["--time", "2024-09-01T12:00", "--at", "46.5405,7.98,500", "--heading", "0"], "below the ground"),
        (["--time", "2024-09-01T12:00", "--at", "46.5405,7.98"], "--heading: missing"),
        (["--time", "2024-09-01T12:00", "--heading", "5"], "--heading: does nothing without --at"),
        (["--time", "2024-09-01T12:00", "--size", "huge"], "--size: not a picture size"),
        (["--time", "2024-09-01T12:00", "--spp", "0"], "--spp: out of range"),
        (["--time", "2024-09-01T12:00", "--exposure", "bright"], "--exposure: not an exposure"),
        (["--time", "2024-09-01T12:00", "--turbidity", "40"], "turbidity"),
        (["--time", "2024-09-01T12:00", "--device", "tpu"], "--device: unknown device"),
        (["--time", "2024-09-01T12:00", "-o", "a.jpg"], "--output: unknown kind"),
        (["--time", "2024-09-01T12:00", "--sky", "purple"], "purple"),
    ],
)
def test_each_mistake_is_one_line_and_leaves_no_file(hill, tmp_path, capsys, monkeypatch, arguments, message):
    import re

    monkeypatch.chdir(tmp_path)
    before = {path for path in tmp_path.rglob("*") if "work" not in path.parts}
    flags = {"-o": "x.png", **dict(zip(SMALL[::2], SMALL[1::2], strict=True))}
    flags |= dict(zip(arguments[::2], arguments[1::2], strict=True))
    assert run("render", hill, *(token for pair in flags.items() for token in pair)) == 2
    said = capsys.readouterr()
    complaint = [line for line in said.err.splitlines() if line.startswith("seasonscapes: ")]
    assert len(complaint) == 1
    assert re.search(message, complaint[0])
    assert {path for path in tmp_path.rglob("*") if "work" not in path.parts} == before


def test_errors_are_records_too(hill, capsys):
    assert run("render", hill, "--time", "never", "--json", *SMALL) == 2
    assert "error" in json.loads(capsys.readouterr().out)


def test_terrain_reports(hill, capsys):
    assert run("terrain", hill, "--json", "--max-error-m", "5", "--refine", "1") == 0
    record = json.loads(capsys.readouterr().out)
    assert record["mesh"]["vertical_max_m"] <= 5.0
    assert record["mesh"]["saved_ratio"] > 0.5
    assert record["atlas"]["kind"] == "planar"


def test_doctor_never_crashes(capsys, monkeypatch):
    assert run("doctor", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert record["test_render"] is True


def extras_at_hand(folder, **sources):
    """Environment with modules of the extras that are quick to import: empty ones, or of the given sources."""
    for module in ("torch", "gsplat", "diffusers", "distributed", "pystac_client", "pxr"):
        (folder / f"{module}.py").write_text(sources.get(module, ""))
    return {"PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}


@pytest.mark.parametrize("bad", ["missing", "text", "old"])
def test_doctor_names_an_unusable_libllvm(tmp_path, bad):
    path = tmp_path / "libLLVM-14.so"
    if bad == "text":
        path.write_text("this is no library")
    if bad == "old":
        # A library that loads but cannot say its version, as LLVM 14 and 15 cannot.
        source = tmp_path / "old.c"
        source.write_text("int LLVMOld(void) { return 14; }")
        if subprocess.run(["cc", "-shared", "-fPIC", "-o", path, source], check=False).returncode:
            pytest.skip("no C compiler to make an old library with")
    environment = {**os.environ, **extras_at_hand(tmp_path), "DRJIT_LIBLLVM_PATH": str(path)}
    done = subprocess.run(
        [sys.executable, "-m", "seasonscapes", "doctor"], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "libLLVM-14.so" in done.stdout
    assert "scalar_rgb" in done.stdout
    assert "libllvm19" in done.stdout


def test_an_extra_that_is_there_but_broken_is_no_extra(tmp_path):
    environment = {**os.environ, **extras_at_hand(tmp_path, torch="raise ImportError('libgomp.so.1: no such file')")}
    command = [sys.executable, "-m", "seasonscapes", "doctor", "--json"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    record = json.loads(done.stdout)
    assert [name for name, there in record["extras"].items() if not there] == ["gaussians"]
    assert record["extras_faults"] == {"gaussians": "BROKEN (ImportError: libgomp.so.1: no such file)"}


def test_extras_are_those_of_the_page_and_of_doctor(tmp_path):
    root = Path(__file__).parents[1]
    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    page = re.findall(r"^\| `([a-z]+)` \| ", (root / "docs" / "start" / "install.md").read_text(), re.MULTILINE)
    assert sorted(set(page) - {"cuda", "llvm", "scalar"}) == sorted(extras)
    environment = {**os.environ, **extras_at_hand(tmp_path)}
    command = [sys.executable, "-m", "seasonscapes", "doctor", "--json"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert sorted([*json.loads(done.stdout)["extras"], "dev"]) == sorted(extras)


def test_a_fall_back_to_the_scalar_variant_says_why(tmp_path):
    program = "from seasonscapes.rendering.backend import use_backend; print(use_backend().device)"
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": str(tmp_path / "none.so")}
    environment.pop("SEASONSCAPES_DEVICE", None)
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    if done.stdout.strip() == "cuda":
        pytest.skip("a CUDA device needs no libLLVM")
    assert done.stdout.strip() == "scalar"
    assert "the scalar variant, since libLLVM at" in done.stderr
    assert "none.so is older than 16" in done.stderr


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_killed_render_leaves_no_half_file(hill, tmp_path, how):
    """Killed in the middle of path tracing: no picture, no temporary file; the same call then succeeds."""
    out = tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "seasonscapes",
        "render",
        str(hill),
        "--time",
        "2024-09-01T12:00",
        "-o",
        str(out / "a.png"),
        "--sky",
        "hosek",
    ]
    process = subprocess.Popen([*command, "--size", "1024x1024", "--spp", "512"], stderr=subprocess.PIPE, text=True)
    for line in process.stderr:
        if "sun at azimuth" in line:
            break
    time.sleep(2.0)
    assert process.poll() is None
    process.send_signal(how)
    process.wait(timeout=120)
    if how == signal.SIGINT:
        assert process.returncode == 130
    assert not out.exists() or list(out.iterdir()) == []
    assert not list((tmp_path / "work").rglob("*.part*"))
    assert subprocess.run([*command, "--size", "32x32", "--spp", "1"], capture_output=True).returncode == 0
    assert [path.name for path in out.iterdir()] == ["a.png"]


def test_a_killed_build_is_not_taken_for_a_whole_one(hill, tmp_path):
    """An artefact without its manifest does not exist; a temporary file of a killed build is never read."""
    assert run("terrain", hill, "--json") == 0
    (artefact,) = (tmp_path / "work").rglob("terrain-*.npz")
    manifest = artefact.with_name(artefact.name + ".json")
    manifest.unlink()
    artefact.write_bytes(artefact.read_bytes()[:1000])
    assert run("terrain", hill, "--json") == 0
    assert manifest.is_file()
    assert artefact.stat().st_size > 1000


def test_version_and_help(capsys):
    for flag in ("--version", "--help"):
        done = subprocess.run([sys.executable, "-m", "seasonscapes", flag], capture_output=True, text=True, check=True)
        assert done.stdout.strip()
    done = subprocess.run(
        [sys.executable, "-m", "seasonscapes", "render", "--help"], capture_output=True, text=True, check=True
    )
    assert "ISO 8601" in done.stdout
