"""Outputs that cannot be written, inputs that are no files, workspaces that are none: refused before long work."""

import os
import stat

import pytest
from fault_harness import TIME, judge, run_in, with_flag
from fault_verbs import BASE, JSON_VERBS, SCENE_VERBS

FOLDER_OUTPUTS = ("annotate", "calibrate", "hours", "paint", "run", "timelapse", "view")
WITH_OUTPUT = [verb for verb, tokens in BASE.items() if "--output" in tokens]


def suffix_of(verb: str) -> str:
    name = BASE[verb][BASE[verb].index("--output") + 1]
    return os.path.splitext(name)[1]


def asking_json(verb: str) -> list[str]:
    return ["--json"] if verb in JSON_VERBS else []


@pytest.mark.fast
@pytest.mark.parametrize(
    "kind", ["folder", "below a file", "proc", "long name", "long path", "empty", "device", "below nothing readable"]
)
@pytest.mark.parametrize("verb", WITH_OUTPUT)
def test_outputs_that_cannot_be_written(land, record_property, verb, kind):
    suffix, inside = suffix_of(verb), land / "inside"
    (inside / f"taken{suffix}").mkdir(exist_ok=True)
    if kind == "folder" and verb in FOLDER_OUTPUTS:
        pytest.skip("the output is a folder")
    names = {
        "folder": f"taken{suffix}",
        "below a file": f"s.toml/a{suffix}",
        "proc": f"/proc/a{suffix}",
        "long name": "a" * 256 + suffix,
        "long path": "a/" * 3000 + f"a{suffix}",
        "empty": "",
        "device": f"/dev/null/a{suffix}",
        "below nothing readable": f"/proc/1/fd/nowhere/a{suffix}",
    }
    tokens = with_flag(BASE[verb], "--output", names[kind])
    judge(record_property, run_in(land, [verb, *tokens, *asking_json(verb)]), names="--output")


@pytest.mark.fast
@pytest.mark.parametrize("verb", [verb for verb in WITH_OUTPUT if verb not in FOLDER_OUTPUTS])
@pytest.mark.parametrize("name", ["a.exe", "a", "a.png.sh", ".png", "a.\x1b[31m"], ids=ascii)
def test_outputs_of_no_kind(land, record_property, verb, name):
    tokens = with_flag(BASE[verb], "--output", name)
    judge(record_property, run_in(land, [verb, *tokens, *asking_json(verb)]), names="--output")


@pytest.mark.fast
@pytest.mark.parametrize("output", ["dem.tif", "../inside/dem.tif", "linked.tif"])
def test_outputs_that_are_inputs(land, record_property, output):
    """A map must not replace the heights that it is a map of."""
    inside = land / "inside"
    if not (inside / "linked.tif").exists():
        (inside / "linked.tif").symlink_to("dem.tif")
    before = (inside / "dem.tif").read_bytes()
    judge(record_property, run_in(land, ["irradiance", "s.toml", "--time", TIME, "--output", output]), names="--output")
    assert (inside / "dem.tif").read_bytes() == before


# Scene files that are none, by the bytes that they hold.
BAD_SCENES = {
    "empty": b"",
    "binary": bytes(range(256)) * 8,
    "not utf-8": 'name = "gr\xfcn"\n'.encode("latin-1"),
    "utf-16": 'name = "x"\n'.encode("utf-16"),
    "nested": b"a = " + b"[" * 20_000,
    "nested tables": b"[" + b".".join([b"a"] * 5_000) + b"]\nx = 1\n",
    "huge integer": b"a = " + b"9" * 10_000,
    "huge key": b"k" * 100_000 + b" = 1\n",
    "nul": b'name = "a\0b"\n',
    "escapes": b'"\\u001b[31mred" = 1\n',
    "half a line": b'name = "x',
    "json": b'{"name": "x"}',
}


@pytest.mark.fast
@pytest.mark.parametrize("verb", SCENE_VERBS)
@pytest.mark.parametrize("kind", BAD_SCENES)
def test_scene_files_that_are_none(land, record_property, verb, kind):
    (land / "inside" / "bad.toml").write_bytes(BAD_SCENES[kind])
    said = "" if verb == "splat" else r"bad\.toml"  # its model is asked for first
    judge(record_property, run_in(land, [verb, "bad.toml", *BASE[verb][1:], *asking_json(verb)]), names=said)


@pytest.mark.fast
@pytest.mark.parametrize("verb", SCENE_VERBS)
@pytest.mark.parametrize("kind", ["missing", "folder", "pipe", "zero", "long", "below a file", "random", "loop"])
def test_scenes_that_are_no_files(land, record_property, verb, kind):
    inside = land / "inside"
    if not (inside / "pipe.toml").exists():
        os.mkfifo(inside / "pipe.toml")
    if not (inside / "loop.toml").is_symlink():
        (inside / "loop.toml").symlink_to("loop.toml")
    (inside / "folder.toml").mkdir(exist_ok=True)
    names = {
        "missing": "nowhere.toml",
        "folder": "folder.toml",
        "pipe": "pipe.toml",
        "zero": "/dev/zero",
        "long": "x" * 5000,
        "below a file": "s.toml/s.toml",
        "random": "/dev/urandom",
        "loop": "loop.toml",
    }
    judge(record_property, run_in(land, [verb, names[kind], *BASE[verb][1:], *asking_json(verb)]))


@pytest.mark.fast
@pytest.mark.parametrize(
    ("verb", "flag"),
    [
        ("render", "--albedo"),
        ("render", "--sky"),
        ("timelapse", "--times"),
        ("webcams", "--elevation"),
        ("webcams", "--pictures"),
        ("webcams", "--manifest"),
        ("calibrate", "--picture"),
        ("calibrate", "--points"),
        ("calibrate", "--mask"),
        ("calibrate", "--elevation"),
        ("calibrate", "--context"),
        ("paint", "--manifest"),
        ("paint", "--albedo"),
        ("inpaint", "--texture"),
        ("inpaint", "--albedo"),
        ("path", "--reference"),
        ("albedo", "--manifest"),
        ("splat", "--model"),
        ("run", "--manifest"),
        ("evaluate", "--truth"),
        ("evaluate", "--pictures"),
        ("evaluate", "--mask"),
        ("evaluate", "--lpips"),
        ("info", "--artefact"),
    ],
)
@pytest.mark.parametrize("kind", ["missing", "pipe", "zero", "long", "text", "binary", "below a file"])
def test_inputs_that_are_no_files_of_their_kind(land, record_property, verb, flag, kind):
    inside = land / "inside"
    ending = {"--sky": ".toml", "--points": ".csv", "--manifest": ".csv", "--reference": ".json", "--texture": ".npz"}
    ending |= {"--albedo": ".npz", "--model": ".safetensors", "--elevation": ".tif", "--context": ".tif"}
    suffix = ending.get(flag, ".png")
    if not (inside / f"pipe{suffix}").exists():
        os.mkfifo(inside / f"pipe{suffix}")
    (inside / f"text{suffix}").write_text("this is text\n")
    (inside / f"binary{suffix}").write_bytes(bytes(range(256)) * 16)
    names = {
        "missing": f"nowhere{suffix}",
        "pipe": f"pipe{suffix}",
        "zero": "/dev/zero",
        "long": "x" * 5000 + suffix,
        "text": f"text{suffix}",
        "binary": f"binary{suffix}",
        "below a file": f"s.toml/a{suffix}",
    }
    value = f"2024-09-18={names[kind]}" if (verb, flag) == ("render", "--albedo") else names[kind]
    tokens = [token for token in BASE[verb] if flag != "--artefact"]
    if (verb, flag) == ("path", "--reference"):
        tokens = ["s.toml", "--output", "out/p.json"]
    tokens = with_flag(tokens, flag, value)
    # A folder or list of pictures may be missing pictures without being wrong.
    lenient = (verb, flag) == ("webcams", "--pictures")
    outcome = run_in(land, [verb, *tokens, *asking_json(verb)])
    judge(record_property, outcome, "either" if lenient and kind != "missing" else "refuse")


@pytest.mark.parametrize("place", ["s.toml", "/dev/null", "/proc", "/proc/self/nowhere", "x" * 300, "s.toml/ws", ""])
@pytest.mark.parametrize("verb", ["terrain", "timelapse", "render"])
def test_workspaces_that_are_none(land, record_property, verb, place):
    tokens = with_flag(BASE[verb], "--workspace", place)
    judge(record_property, run_in(land, [verb, *tokens, "--json"]))


def test_files_and_folders_that_others_may_not_touch(own_land, record_property):
    if os.geteuid() == 0:
        pytest.skip("root may touch everything")
    (own_land / "inside" / "s.toml").chmod(0)
    judge(record_property, run_in(own_land, ["terrain", "s.toml", "--json"]), names="ermission")
    (own_land / "inside" / "s.toml").chmod(stat.S_IRUSR)
    (own_land / "inside").chmod(stat.S_IRUSR | stat.S_IXUSR)
    tokens = with_flag(BASE["sky"], "--output", "a.png")
    judge(record_property, run_in(own_land, ["sky", *tokens]), names="--output.*ermission")
    (own_land / "inside").chmod(stat.S_IRWXU)
