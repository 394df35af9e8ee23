"""Commands killed at random moments (SIGKILL) leave nothing half, and end as ones that nothing disturbed.

``SEASONSCAPES_KILLS`` is the number of kills, 4 by default and at least 100 before a release; they are spread over the
commands below (over the first two where there are fewer than 20). ``SEASONSCAPES_KILL_SEED`` repeats a sequence.
"""

import os
import shutil
from pathlib import Path

import numpy as np
import places
import pytest
from command_server import CommandServer
from file_contents import contents

KILLS = int(os.environ.get("SEASONSCAPES_KILLS", "4"))
SEED = int(os.environ.get("SEASONSCAPES_KILL_SEED", str(np.random.SeedSequence().entropy % 2**32)))
# Kills before a command is left to end.
MOST_IN_A_ROW = 3

HILL, MASSIF = ("hill.toml", "--texel-m", "50", "--refine", "1"), ("little.toml", "--texel-m", "120", "--refine", "1")
SPAN = (
    "--from",
    "2024-06-20T09:00",
    "--to",
    "2024-06-20T18:00",
    "--every",
    "90min",
    "--size",
    "48x32",
    "--sky",
    "hosek",
)
NOON = ("--time", "2024-07-20T13:00", "--sky", "hosek")
COMMANDS = {
    "pictures": ("timelapse", *HILL, *SPAN, "-o", "out/film"),
    "render": ("render", *HILL, *NOON, "--size", "64x48", "-o", "out/a.exr"),
    "film": ("timelapse", *HILL, *SPAN, "-o", "out/film.mp4"),
    "path": ("render", *HILL, *NOON, "--size", "64x48", "--engine", "path", "--spp", "4", "-o", "out/a.png"),
    "terrain": ("terrain", *MASSIF),
    "lit-texture": ("lit-texture", *HILL, *NOON, "-o", "out/lit.exr"),
    "irradiance": ("irradiance", *HILL, *NOON, "-o", "out/map.tif"),
    "paint": ("paint", *MASSIF, *NOON, "--synthetic-webcams", "--size", "96x64", "-o", "out/paint"),
    "run": (
        *("run", *MASSIF, "--max-error-m", "6", "--times", "2024-07-20T10:00,2024-07-20T15:00", "--sky", "hosek"),
        *(
            "--at-hours",
            "2024-07-20T18:00",
            "--photo-size",
            "720x120",
            "--size",
            "48x32",
            "-o",
            "out",
            "--until",
            "relight",
        ),
    ),
    "export": ("export", *HILL, "--to", "glb", "-o", "out/hill.glb"),
    "distill": (
        *("distill", *HILL, "--sky", "hosek", "--discs", "16", "--suns", "2", "--views", "1", "--view-px", "32"),
        *("--steps", "600", "--picture-steps", "4", "-o", "out/model.safetensors"),
    ),
}


def unfinished(name: str) -> bool:
    """Whether a file exists only until its command has ended, or grows until then."""
    return "frames-" in name or "tiles-" in name or "checkpoint" in name or name == "run.json"


def results(folder: Path) -> dict[str, Path]:
    """Finished files below a folder by name: no ledgers, locks or temporary files, whose names begin with a dot."""
    return {
        str(path.relative_to(folder)): path
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    }


class Killer:
    """Commands in one folder, with a server that runs and kills them."""

    def __init__(self, folder: Path):
        self.folder = folder
        places.write_place(folder)
        (folder / "little.toml").write_text(places.MASSIF)
        self.server = CommandServer(folder, environment={"SEASONSCAPES_WORKSPACE": "work"})

    def run(self, name: str, kill_after_s: float | None = None) -> dict:
        return self.server.run(COMMANDS[name], "log.txt", kill_after_s=kill_after_s)

    def reset(self) -> None:
        for name in ("out", "work"):
            shutil.rmtree(self.folder / name, ignore_errors=True)

    def told(self) -> str:
        return (self.folder / "log.txt").read_text()[-3000:]


@pytest.fixture(scope="module")
def killer(tmp_path_factory):
    killer = Killer(tmp_path_factory.mktemp("killed"))
    yield killer
    killer.server.close()


def kills_of(number: int) -> int:
    """How many of all kills fall on the command of this number."""
    used = len(COMMANDS) if KILLS >= 20 else 2
    return 0 if number >= used else KILLS // used + (number < KILLS % used)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize(("number", "name"), [(n, name) for n, name in enumerate(COMMANDS) if kills_of(n)])
def test_killed_anywhere_a_command_ends_as_one_that_nothing_disturbed(killer, number, name):
    rng = np.random.default_rng([SEED, number])
    killer.reset()
    whole = killer.run(name)
    assert whole["code"] == 0, killer.told()
    expected = {kind: {n: contents(p) for n, p in results(killer.folder / kind).items()} for kind in ("out", "work")}
    left = kills_of(number)
    while left:
        killer.reset()
        for _ in range(min(left, int(rng.integers(1, MOST_IN_A_ROW + 1)))):
            moment_s = float(rng.uniform(0.0, whole["seconds"]))
            code = killer.run(name, moment_s)["code"]
            left -= 1
            assert code in (-9, 0), (SEED, moment_s, killer.told())
            for kind in ("out", "work"):
                for file, path in results(killer.folder / kind).items():
                    if not unfinished(file) and (kind == "out" or path.suffix == ".npz"):
                        assert file in expected[kind], (SEED, moment_s, file)
                        assert contents(path) == expected[kind][file], (SEED, moment_s, file)
        assert killer.run(name)["code"] == 0, (SEED, killer.told())
        for kind in ("out", "work"):
            found = results(killer.folder / kind)
            assert {n for n in found if "frames-" not in n} == {n for n in expected[kind] if "frames-" not in n}, SEED
            for file in found.keys() & expected[kind].keys():
                assert contents(found[file]) == expected[kind][file], (SEED, file)
