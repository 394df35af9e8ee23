"""The whole way on a small synthetic massif: panoramas, poses, texture, albedo, other hours, Gaussians; killed anywhere."""

import json
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from command_server import CommandServer
from file_contents import contents
from PIL import Image
from places import MASSIF

from seasonscapes.cli import main
from seasonscapes.workspace import file_hash

STAGES = ("pictures", "calibrate", "albedo", "paint", "inpaint", "relight", "distil", "splat")


class Runs:
    """Runs of one and the same job as processes of their own, each in its own folder and workspace."""

    def __init__(self, folder: Path):
        self.folder = folder
        (folder / "little.toml").write_text(MASSIF)
        self.server = CommandServer(folder, imports=["torch._dynamo", "seasonscapes.workflows.full_run"])

    def arguments(self, name: str) -> list[str]:
        return [
            "run",
            str(self.folder / "little.toml"),
            "--workspace",
            str(self.folder / f"{name}-work"),
            "--times",
            "2024-07-20T10:00,2024-07-20T15:00",
            "--at-hours",
            "2024-07-20T18:00",
            "--photo-size",
            "764x128",
            "--size",
            "96x64",
            "--texel-m",
            "120",
            "--refine",
            "1",
            "--max-error-m",
            "6",
            "--discs",
            "24",
            "--suns",
            "2",
            "--steps",
            "40",
            "--picture-steps",
            "2",
            "--views",
            "1",
            "--sky",
            "hosek",
            "-o",
            str(self.folder / name),
        ]

    def run(self, name: str, log: str, **kill) -> tuple[int, str]:
        """Exit code of a run, and all that it said, which stays in a file."""
        code = self.server.run(self.arguments(name), log, **kill)["code"]
        return code, (self.folder / log).read_text()


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Iterator[Runs]:
    """With one run that nothing disturbed, ``whole``."""
    runs = Runs(tmp_path_factory.mktemp("runs"))
    code, told = runs.run("whole", "whole.log")
    assert code == 0, told
    yield runs
    runs.server.close()


def ledger_of(folder: Path) -> dict:
    path = folder / "run.json"
    return json.loads(path.read_text()) if path.is_file() else {}


@pytest.mark.slow
def test_panoramas_to_gaussians(runs, capsys):
    whole = runs.folder / "whole"
    assert list(ledger_of(whole)) == list(STAGES)
    photographs = sorted((whole / "pictures").glob("aerial_*.png"))
    assert [Image.open(path).size for path in photographs] == [(764, 128)] * 2
    true, found = (
        json.loads((whole / name / "aerial_calibration.json").read_text()) for name in ("pictures", "calibration")
    )
    assert true["projection"] == found["projection"] == "cylindrical"
    off = [abs(true["angles_deg"][name] - found["angles_deg"][name]) for name in ("heading", "roll")]
    # Found by the skyline to a fraction of a pixel of half a degree, and not copied from the truth.
    assert 0.0 < off[0] < 0.4
    assert off[1] < 0.4
    # Mountains that stand too near for so coarse a picture: their webcam is left out, and the rest goes on.
    told = (runs.folder / "whole.log").read_text()
    assert "meadow is left out: the horizon is too smooth" in told
    assert "1 of 2 webcams found by their skylines" in told
    assert not (whole / "calibration" / "meadow_calibration.json").exists()
    albedo = np.load(whole / "albedo" / "albedo.npz")
    assert (albedo["source"] == 1).mean() > 0.1
    relit, splat = (np.asarray(Image.open(next((whole / name).glob("*.png"))), float) for name in ("relight", "splat"))
    assert relit.shape == splat.shape == (64, 96, 3)
    assert relit.std() > 5.0
    # Two ways to the same hour from the same albedo. A splat of so few discs is blurred: pixels correlate by 0.91, means
    # over 8 × 8 pixels by 0.97.
    assert abs(relit.mean() - splat.mean()) < 5.0
    grey = [picture.mean(axis=2) for picture in (relit, splat)]
    blocks = [picture.reshape(8, 8, 12, 8).mean(axis=(1, 3)) for picture in grey]
    assert np.corrcoef(*(picture.ravel() for picture in grey))[0, 1] > 0.85
    assert np.corrcoef(*(picture.ravel() for picture in blocks))[0, 1] > 0.94
    assert main(["info", str(whole)]) == 0
    capsys.readouterr()
    assert main([*runs.arguments("whole"), "--from", "splat", "--until", "paint"]) == 2
    assert "--until" in capsys.readouterr().err
    assert main([*runs.arguments("whole"), "--until", "everything"]) == 2
    assert "no such stage" in capsys.readouterr().err
    assert main([*runs.arguments("whole"), "--photo-kind", "fisheye"]) == 2
    assert "panorama or perspective" in capsys.readouterr().err


def killed_in(runs: Runs, name: str, stage: str, delay_s: float) -> list[str]:
    """Start a run, kill it so long after it says that it begins a stage; all that it said."""
    code, told = runs.run(name, f"{name}-{stage}.log", kill_after_s=delay_s, said=[f"run: {stage}: …"])
    assert code == -signal.SIGKILL or stage == "splat", (stage, code, told)
    return [line.strip() for line in told.splitlines()]


@pytest.mark.slow
def test_a_run_killed_in_every_stage_ends_as_one_that_nothing_disturbed(runs):
    whole, killed = runs.folder / "whole", runs.folder / "killed"
    seconds = {name: entry["seconds"] for name, entry in ledger_of(whole).items()}
    rng = np.random.default_rng()
    for number, stage in enumerate(STAGES):
        delay_s = rng.uniform(0.0, 0.6) * min(seconds[stage], 4.0)
        told = killed_in(runs, "killed", stage, delay_s)
        kept = [line for line in told if line.endswith(": up to date")]
        assert kept == [f"run: {name}: up to date" for name in STAGES[: len(kept)]]
        # On a loaded machine the stage before may have ended before the signal came.
        assert len(kept) in (max(number - 1, 0), number)
        ledger = ledger_of(killed)
        assert list(ledger)[:number] == list(STAGES[:number]), (stage, delay_s)
        for entry in ledger.values():
            for name, digest in entry["files"].items():
                assert file_hash(killed / name) == digest, (stage, delay_s, name)
    code, told = runs.run("killed", "killed.log")
    assert code == 0, told
    files = {name for entry in ledger_of(whole).values() for name in entry["files"]}
    assert {name for entry in ledger_of(killed).values() for name in entry["files"]} == files
    for name in sorted(files):
        assert contents(killed / name) == contents(whole / name), name
    assert not list(killed.rglob(".*.part*")), "nothing half-written is left"
