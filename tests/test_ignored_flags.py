"""No flag is ignored: each of every verb does something always, or is refused where it would do nothing."""

import re

import pytest

from seasonscapes.cli import main

TIME = "2024-07-20T12:00Z"


def _each(flags, beside):
    """The same arguments for several flags."""
    return {flag: list(beside) for flag in flags}


_TERRAIN = {"--mesher", "--refine", "--atlas", "--texel-m", "--workspace", "--allow-outside"}
_SKY = {"--sky", "--turbidity", "--visibility-km", "--ozone-du", "--cloudiness"}
_VIEW = {"--camera", "--at", "--size"}
_OF_POSITION = _each(("--heading", "--pitch", "--fov"), [])
_NO_BOUND = {"--max-error-m": ["--mesher", "grid"]}
_REAL = _each(("--manifest", "--calibrations", "--masks", "--within-min", "--doubtful-poses"), ["--synthetic-webcams"])
_NEUTRAL = {"--white-balance": ["--look", "neutral"]}
_DIFFUSION = (
    *("--path", "--weights", "--base", "--depth-net", "--inpaint-net", "--adapter", "--prompt", "--guide-image"),
    *("--hybrid", "--strength", "--steps", "--guidance", "--without", "--mask", "--dilate-px", "--least-hole"),
    *("--paint-sky", "--frames", "--film", "--fps", "--device", "--dtype", "--offload"),
)
_RELIT = (
    "--suns",
    "--dates",
    "--views",
    "--view-px",
    "--disc-px",
    "--picture-steps",
    "--kind",
    "--refine-discs",
    "--export-views",
    "--albedo",
    *_SKY,
)
_LEARNED = ["--appearance", "paper", "--frames", "."]

# Of each verb: arguments that would do; flags that always do something; and flags that are refused, beside which others.
VERBS: dict[str, tuple[list[str], set[str], dict[str, list[str]]]] = {
    "render": (
        ["alpine_small", "--time", TIME],
        {*_TERRAIN, *_SKY, *_VIEW, "--time", "--at-url", "--albedo", "--engine", "--seed", "--lambertian", "--amplify"}
        | {"--output", "--exposure", "--look", "--device"},
        {**_OF_POSITION, **_NO_BOUND, **_NEUTRAL, "--season": []}
        | _each(("--spp", "--max-depth"), ["--engine", "transport"]),
    ),
    "timelapse": (
        ["alpine_small", "--from", "2024-07-20T10:00", "--to", "2024-07-20T11:00"],
        {*_TERRAIN, *_SKY, "--path", "--from", "--to", "--times", "--albedo", "--seed", "--output", "--cluster"}
        | {"--shard", "--device", "--amplify"},
        {**_OF_POSITION, **_NO_BOUND}
        | _each((*_VIEW, "--every", "--exr", "--cluster"), ["--path", "p.json"])
        | {"--season": [], "--fps": ["--output", "folder"]}
        | _each(("--smooth", "--exposure", "--look", "--white-balance", "--keep-frames"), ["--shard", "1/2"]),
    ),
    "lit-texture": (
        ["alpine_small", "--time", TIME],
        {*_TERRAIN, *_SKY, "--time", "--albedo", "--rays", "--seed", "--output", "--device"},
        {**_NO_BOUND, "--exposure": ["--output", "a.exr"]},
    ),
    "irradiance": (
        ["alpine_small", "--times", TIME],
        {*_TERRAIN, *_SKY, "--time", "--from", "--to", "--times", "--spacing-m", "--rays", "--seed", "--output"}
        | {"--device"},
        {**_NO_BOUND, "--every": []},
    ),
    "sky": (
        ["--at", "46.5,8,1500", "--time", TIME],
        {*_SKY, "--time", "--at", "--output", "--workspace", "--allow-outside"},
        _each(("--mesher", "--max-error-m", "--refine", "--atlas", "--texel-m"), []),
    ),
    "terrain": (["alpine_small"], _TERRAIN, _NO_BOUND),
    "paint": (
        ["alpine_small", "--time", TIME],
        {*_TERRAIN, *_SKY, "--time", "--synthetic-webcams", "--mode", "--near-m", "--harmonise", "--albedo", "--output"}
        | {"--no-harmonise", "--find-foreground"},
        {**_NO_BOUND, **_REAL, "--leave-out": [], "--size": []},
    ),
    "albedo": (
        ["alpine_small", "--times", TIME],
        {*_TERRAIN, *_SKY, "--times", "--synthetic-webcams", "--method", "--painted", "--output"}
        | {"--fit-curve"},
        {**_NO_BOUND, **_REAL, "--size": [], **_each(("--fit-haze", "--normals"), ["--method", "differentiable"])},
    ),
    "inpaint": (
        ["alpine_small", "--time", TIME],
        {*_TERRAIN, "--time", "--texture", "--method", "--output", "--figures"},
        _each(_DIFFUSION, ["--method", "telea"])
        | {"--albedo": ["--method", "telea"], "--fast": ["--method", "membrane"], "--detail": ["--albedo", "a.npz"]}
        | {"--seed": ["--albedo", "a.npz"], **_each((*_VIEW, *_SKY), []), **_OF_POSITION, **_NO_BOUND},
    ),
    "path": (
        ["alpine_small"],
        {*_TERRAIN, "--via", "--reference", "--views", "--curve", "--turn", "--look-at", "--closed", "--clearance-m"}
        | {"--size", "--output", "--map"},
        {**_NO_BOUND, "--kind": [], "--fov": ["--reference", "r.json"]},
    ),
    "distill": (
        ["alpine_small"],
        {*_TERRAIN, "--appearance", "--discs", "--steps", "--seed", "--output"},
        {**_NO_BOUND, "--frames": [], **_each(_RELIT, _LEARNED)},
    ),
    "splat": (
        ["alpine_small", "--time", TIME],
        {*_TERRAIN, *_SKY, "--time", "--model", "--output", "--exposure", "--camera", "--at"},
        {**_OF_POSITION, **_NO_BOUND, "--like": []}
        | _each(("--size", "--subpixels", "--device", "--look", "--white-balance"), ["--output", "a.ply"]),
    ),
    "run": (
        ["alpine_small", "--times", TIME, "--at-hours", TIME],
        {*_TERRAIN, *_SKY, *_VIEW, "--times", "--at-hours", "--manifest", "--masks", "--method", "--poses", "--grade"}
        | {"--painting", "--completion", "--appearance", "--discs", "--from", "--until", "--seed", "--output"}
        | {"--recovery", "--use-painted", "--no-use-painted", "--use-inpainted", "--no-use-inpainted", "--find-foreground"},
        {**_OF_POSITION, **_NO_BOUND}
        | _each(("--calibrations", "--within-min", "--doubtful-poses"), [])
        | _each(("--photo-kind", "--photo-size", "--leave-out"), ["--manifest", "m.csv"])
        | {"--season": []}
        | _each(("--points", "--path", "--path-views", "--weights", "--prompt", "--guide-image"), [])
        | _each(("--diffusion-steps", "--paper-steps"), [])
        | _each(
            ("--steps", "--picture-steps", "--suns", "--views", "--disc-px"), ["--appearance", "paper"]
        ),
    ),
    "relight": (
        ["box.ply", "--sun", "170,40"],
        {*_SKY, "--time", "--sun", "--from", "--to", "--times", "--taken", "--taken-sun", "--turntable", "--exposure"}
        | {"--at", "--on", "--up", "--north", "--crs", "--offset", "--ground-albedo", "--ground", "--no-ground", "--rays"}
        | {"--white-reflectance", "--seed", "--bits", "--textures", "--look", "--output", "--workspace", "--size"}
        | {"--allow-outside", "--device", "--azimuth", "--elevation", "--eye", "--target", "--fov"},
        {**_NEUTRAL, "--every": [], "--fps": ["--output", "a.png"]},
    ),
    "export": (
        ["alpine_small", "--to", "glb", "--output", "a.glb"],
        {*_TERRAIN, *_SKY, *_VIEW, "--to", "--time", "--day", "--unlit", "--albedo", "--exposure", "--rays", "--seed"}
        | {"--output", "--heading", "--pitch", "--fov"},
        {**_NO_BOUND, "--every": [], "--geoid-m": []},
    ),
    "view": (
        ["alpine_small"],
        {*_TERRAIN, *_SKY, "--time", "--albedo", "--output", "--single-file", "--camera", "--gaussians", "--port", "--open", "--no-open"},
        _NO_BOUND,
    ),
    "delight": (
        ["alpine_small", "--sun", "170,40"],
        {*_TERRAIN, *_SKY, "--time", "--sun", "--image", "--sensor-height-m", "--land-classes", "--output"},
        {
            **_NO_BOUND,
            **_each(
                ("--at", "--on", "--up", "--north", "--crs", "--offset", "--ground-albedo", "--no-ground", "--white-reflectance",
                 "--rays", "--seed", "--bits", "--textures"),
                [],
            ),
            "--ground": ["--up", "y"],
        },
    ),
    "hours": (
        ["alpine_small", "--at-hours", TIME, "--manifest", "m.csv"],
        {*_TERRAIN, "--at-hours", "--manifest", "--webcam", "--calibrations", "--masks", "--hold-out", "--sky"}
        | {"--most-pixels", "--doubtful-poses", "--check-clocks", "--output"},
        _NO_BOUND,
    ),
    "evaluate": (
        ["--truth", "t.png", "--pictures", "p.png"],
        {"--truth", "--pictures", "--mask", "--mode", "--match", "--used", "--lpips", "--table", "--figures"},
        # Beside truths without depth too, for which `evaluate`'s own tests have files.
        _each(("--near-m", "--far-m"), ["--mode", "paper"]),
    ),
    "demo": ([], {"--output", "--camera", "--size", "--gallery", "--device", "--workspace"}, {}),
    "lpips": (["a.pth", "l.whl"], {"--output"}, {}),
    "info": (["a.png"], {"--artefact"}, {}),
    "doctor": ([], set(), {}),
}  # fmt: skip
# Verbs with checks of their own (tests of `fetch`, `webcams` and `calibrate`).
OTHERS = {"fetch", "webcams", "calibrate", "annotate"}
_VALUES = {
    "--season": "nearest",
    "--within-min": "3",
    "--texel-m": "50",
    "--max-error-m": "3",
    "--photo-size": "72x48",
    "--albedo": "2024-07-20=a.npz",
}


def helped(verb, capsys):
    """The flags that a verb's help names, and whether each takes a value."""
    assert main([verb, "--help"]) == 0
    text = capsys.readouterr().out
    found = re.findall(r"(--[a-z][a-z0-9-]*)(?: (INT|FLOAT|STR|PATH))?", text.split("Parameters", 1)[-1])
    flags: dict[str, str] = {}
    for flag, kind in re.findall(
        r"^\W*(?:[A-Z-]+ )?(--[a-z][a-z0-9-]*)(?: -[a-z])?(?: (--[a-z-]+))?", text, re.MULTILINE
    ):
        flags[flag] = ""
        if kind:
            flags[kind] = ""
    return flags | {flag: kind for flag, kind in found if kind}


def test_every_verb_has_its_verdicts(capsys):
    assert main(["--help"]) == 0
    named = set(re.findall(r"^\W*([a-z][a-z-]+) {2,}\S", capsys.readouterr().out, re.MULTILINE))
    assert {verb for verb in named if verb[0] != "-"} >= set(VERBS) | OTHERS


@pytest.mark.parametrize("verb", VERBS)
def test_every_flag_has_a_verdict(verb, capsys):
    _, always, refused = VERBS[verb]
    known = always | set(refused) | {"--json", "--scene", "--source"}
    flags = set(helped(verb, capsys)) - {"--help", "--version"}
    # A switch and its negation are one.
    new = {flag for flag in flags - known if flag.replace("--no-", "--", 1) not in known}
    assert not new, f"new flags of {verb}: say whether they always do something, or where they are refused"
    assert {flag for flag in refused if flag not in flags} == set()


@pytest.mark.parametrize(
    ("verb", "flag"), [(verb, flag) for verb, (*_, refused) in VERBS.items() for flag in sorted(refused)]
)
def test_a_flag_that_would_do_nothing_is_refused(verb, flag, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    base, _, refused = VERBS[verb]
    kind = helped(verb, capsys)[flag]
    value = {"": [], "INT": ["3"], "FLOAT": ["0.5"], "STR": ["x"], "PATH": ["x"]}[kind]
    value = [_VALUES[flag]] if flag in _VALUES else value
    assert main([verb, *base, *refused[flag], flag, *value]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("seasonscapes: ")]
    assert len(lines) == 1
    told = lines[0]
    assert re.search(r"does nothing|of no use|go with|goes with|belongs to|flags of meshes", told), told
    assert flag in told or "flags of meshes" in told or "--spp" in told, told
