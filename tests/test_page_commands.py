"""Commands of the start and how-to pages, each page in its order, on the place that the pages speak of.

They are run as printed, but for what their time depends on: size of pictures, number of rays, detail of the browser's page.
"""

import re
import shlex
from itertools import pairwise
from pathlib import Path

import pytest
from page_place import write_page_place, write_photographs
from test_docs import PAGES, commands_of

from seasonscapes.cli import main

# Commands that are only parsed (`test_docs.py`), and why; a pattern that matches none is stale and fails.
NOT_RUN = {
    r"^seasonscapes (fetch|render scenes/)": "asks catalogues on the net; tests/test_fetch.py runs it against a local one",
    r"--cluster (tcp|slurm):": "needs a scheduler",
    r"--cluster local:4|--shard 3/8": "the scene at full detail; tests/test_run.py and tests/test_relighting.py film in parts",
    r"^seasonscapes render alpine --time": "the scene at full detail, for minutes",
    r"^seasonscapes run alpine --times": "half an hour; tests/test_run.py runs all stages on a small place",
    r"^seasonscapes (distill|splat) ": "trains for minutes; tests/test_gaussians.py runs both",
    r"--gaussians ": "a model that training makes; tests/test_viewer_gaussians.py shows one",
    r"--method diffusion": "needs weights; tests/test_diffusion.py runs it on tiny ones",
    r"^seasonscapes annotate|^seasonscapes view (alpine_small --camera|my-valley)": "serves a page until Ctrl-C",
    r"--points points.csv": "needs points that a person matched; tests/test_cli_webcams.py runs it",
    r"^seasonscapes lpips ": "needs the two published files; tests/test_evaluate_command.py joins files of their layout",
    r"^seasonscapes (run|evaluate) ": "a run of all stages and its score; tests/test_run.py has both",
    r"^seasonscapes render alpine_lake|--engine path -o view.png": "a large picture, for minutes; tests/test_water.py renders small ones",
    r"--turntable 36": "traces the light of 36 views; tests/test_meshes.py turns through fewer",
    r"^seasonscapes (albedo|paint|inpaint) my-valley": "needs panoramas large enough for a pose; tests/test_run.py runs these stages",
    r"^seasonscapes (webcams|render) bolternosa.toml": "photographs that are not distributed",
    r"--picture noon.jpg": "as on the page of webcams",
    r"^seasonscapes timelapse|^seasonscapes relight .*--every": "a film of many frames; tests/test_relighting.py films fewer",
    r"^seasonscapes irradiance my-valley.toml --from": "48 half-hours; that of the small scene runs",
    r"^seasonscapes hours|pictures/hut_|--layout": "needs the photographs of a fixed camera; tests/test_hours.py runs it",
}


def reason_not_to_run(command: str) -> str | None:
    return next((reason for pattern, reason in NOT_RUN.items() if re.search(pattern, command)), None)


def runnable(page: Path) -> list[str]:
    """The commands of a page that are run; README's are those of the pages that it names."""
    if page.parent.name not in ("start", "howto"):
        return []
    return [command for command in commands_of(page) if reason_not_to_run(command) is None]


def outputs_of(tokens: list[str]) -> list[Path]:
    """What a command was asked to write."""
    flags = ("-o", "--output", "--map", "--manifest", "--single-file")
    return [Path(value) for flag, value in pairwise(tokens) if flag in flags]


def with_a_small_picture(tokens: list[str]) -> list[str]:
    """The words of a command; those that compute a picture get its size."""
    if tokens[0] not in ("render", "relight") or outputs_of(tokens)[0].suffix not in (".png", ".exr"):
        return tokens
    if "--size" in tokens:
        at = tokens.index("--size")
        tokens = tokens[:at] + tokens[at + 2 :]
    return [*tokens, "--size", "120x80"]


@pytest.fixture(scope="module")
def valley(tmp_path_factory, few_rays, coarse_viewer):
    """The folder of the place, with a workspace that all pages share."""
    folder = tmp_path_factory.mktemp("valley")
    scene = write_page_place(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SEASONSCAPES_WORKSPACE", str(folder / "workspace"))
        write_photographs(folder, scene)
        yield folder


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("page", [page for page in PAGES if runnable(page)], ids=lambda page: page.stem)
def test_commands_of_a_page_run(page, valley, monkeypatch):
    monkeypatch.chdir(valley)
    for command in runnable(page):
        tokens = shlex.split(command, comments=True)[1:]
        for path in outputs_of(tokens):
            path.parent.mkdir(parents=True, exist_ok=True)
        assert main(with_a_small_picture(tokens)) == 0, command
        for path in outputs_of(tokens):
            assert path.stat().st_size > 0, command


def test_every_reason_not_to_run_is_of_a_command():
    every = [command for page in PAGES for command in commands_of(page)]
    assert [pattern for pattern in NOT_RUN if not any(re.search(pattern, command) for command in every)] == []
    assert sum(len(runnable(page)) for page in PAGES) > 20
