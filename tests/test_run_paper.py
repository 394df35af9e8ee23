"""The paper's method from panoramas to Gaussians and film, unattended, killed and resumed; and its stages exchanged."""

import json
import shutil
import signal
from importlib.util import find_spec

import numpy as np
import pytest
import trimesh
from command_server import CommandServer
from file_contents import contents
from PIL import Image
from places import MASSIF
from plyfile import PlyData
from tiny_diffusion import write_tiny_weights

from seasonscapes.calibration.calibration_file import read_calibration
from seasonscapes.cli import main
from seasonscapes.errors import InputError
from seasonscapes.terrain.surface import load_texture
from seasonscapes.workflows.plane_views import plane_views
from seasonscapes.workflows.run_methods import METHODS, run_method

# Not imported here: that takes seconds in each process that collects this file.
pytestmark = pytest.mark.skipif(find_spec("diffusers") is None, reason="the extra 'diffusion' is not installed")

STAGES = ("cloud", "pictures", "calibrate", "views", "paint", "path", "inpaint", "film", "distil", "splat")

# All runs do with one import of what takes the longest.
IMPORTS = (
    "torch",
    "transformers:CLIPTextModel",
    "transformers:CLIPTokenizer",
    "diffusers:StableDiffusionControlNetInpaintPipeline",
    "seasonscapes.workflows.full_run",
)


class PaperRuns:
    """Runs of one job in processes of their own, each in its own folder and workspace."""

    def __init__(self, folder):
        self.folder = folder
        (folder / "little.toml").write_text(MASSIF)
        self.server = CommandServer(folder, IMPORTS)
        write_tiny_weights(folder / "weights")

    def arguments(self, name):
        flags = {
            "--workspace": self.folder / f"{name}-work",
            "--times": "2024-07-20T10:00,2024-07-20T15:00",
            "--at-hours": "2024-07-20T12:00",
            "--photo-size": "720x120",
            "--size": "96x64",
            "--texel-m": "120",
            "--refine": "1",
            "--max-error-m": "6",
            "--discs": "24",
            "--sky": "hosek",
            "--method": "paper",
            "--weights": self.folder / "weights",
            "--diffusion-steps": "2",
            "--path-views": "2",
            "--paper-steps": "150",
            "-o": self.folder / name,
        }
        return ["run", str(self.folder / "little.toml"), *(str(part) for pair in flags.items() for part in pair)]

    def run(self, name, log, **kill):
        """Exit code of a run, and all that it said."""
        code = self.server.run(self.arguments(name), log, **kill)["code"]
        return code, (self.folder / log).read_text()


@pytest.fixture(scope="module")
def paper_runs(tmp_path_factory):
    runs = PaperRuns(tmp_path_factory.mktemp("paper"))
    code, told = runs.run("whole", "whole.log")
    assert code == 0, told
    yield runs
    runs.server.close()


@pytest.mark.slow
def test_panoramas_to_gaussians_and_film(paper_runs):
    whole = paper_runs.folder / "whole"
    assert tuple(json.loads((whole / "run.json").read_text())) == STAGES
    about = json.loads((whole / "cloud" / "cloud.json").read_text())
    points = PlyData.read(whole / "cloud" / "points.ply")["vertex"]
    mesh = trimesh.load(whole / "cloud" / "mesh.ply", process=False)
    assert len(points) == about["points"]
    assert len({bytes(colour) for colour in zip(points["red"], points["green"], points["blue"], strict=True)}) > 1000
    assert about["mesher"] == "poisson"
    assert len(mesh.faces) == about["triangles"]
    assert 0.0 < about["vertical_rmse_m"] < 6.0
    # Both lie over the same ground.
    for axis, name in enumerate("xy"):
        assert (mesh.vertices[:, axis].min(), mesh.vertices[:, axis].max()) == pytest.approx(
            (points[name].min(), points[name].max()), abs=0.01
        )
    errors_deg = {}
    for webcam in ("aerial", "meadow"):
        true = read_calibration(whole / "pictures" / f"{webcam}_calibration.json").view
        views = plane_views(webcam, true)
        assert 4 <= len(views) <= 6
        for view in views:
            record = whole / "calibration" / f"{view.name}_calibration.json"
            if record.is_file():
                calibration = read_calibration(record)
                found = calibration.view.world_from_camera[:3, :3]
                turn = found @ view.camera.world_from_camera[:3, :3].T
                errors_deg[view.name] = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
                assert errors_deg[view.name] < 3.5 * calibration.sigma["heading_deg"], view.name
                assert calibration.view.fx == pytest.approx(view.camera.fx, rel=0.06)
                assert calibration.view.fy == pytest.approx(view.camera.fy, rel=0.06)
    # To two pixels of half a degree; views whose points leave more than that open are left out.
    assert len(errors_deg) >= 5
    assert 0.0 < max(errors_deg.values()) < 1.1
    assert np.median(list(errors_deg.values())) < 0.3
    for stamp in ("20240720T080000Z", "20240720T130000Z"):
        painted = load_texture(whole / "paint" / stamp / "painted.npz")
        done = load_texture(whole / "inpaint" / stamp / "completed.npz")
        known = painted.weight > 0.0
        assert 0.05 < known.mean() < 0.95
        np.testing.assert_array_equal(done.values[known], painted.values[known])
        assert np.isfinite(done.values).all()
        record = json.loads((whole / "inpaint" / stamp / "completion.json").read_text())
        assert record["method"] == "diffusion"
        assert {"base", "depth", "inpaint", "adapter"} <= set(record["weights"])
        assert record["coverage"][-1] > record["coverage"][0]
        assert (whole / "film" / f"{stamp}.mp4").stat().st_size > 1000
    frames = json.loads((whole / "film" / "transforms.json").read_text())["frames"]
    assert len(frames) == 4
    assert len({frame["time_utc"] for frame in frames}) == 2
    learned = json.loads((whole / "gaussians" / "distillation.json").read_text())
    assert learned["loss"] < 0.85 * learned["loss_first"]
    picture = np.asarray(Image.open(next((whole / "splat").glob("*.png"))), float)
    assert picture.shape == (64, 96, 3)
    assert picture.std() > 5.0


@pytest.mark.slow
def test_killed_while_it_inpaints_it_goes_on_to_the_same_result(paper_runs):
    # The same terrain, by its key, and none of what is made of it.
    for artefact in paper_runs.folder.glob("whole-work/little/terrain*"):
        (paper_runs.folder / "killed-work" / "little").mkdir(parents=True, exist_ok=True)
        shutil.copy(artefact, paper_runs.folder / "killed-work" / "little")
    at = ("painting 2 views", "run: inpaint: …")
    code, told = paper_runs.run("killed", "kill.log", kill_after_s=0.0, said=at)
    assert code == -signal.SIGKILL, told
    done = json.loads((paper_runs.folder / "killed" / "run.json").read_text())
    assert "path" in done
    assert "inpaint" not in done
    code, told = paper_runs.run("killed", "again.log")
    assert code == 0, told
    assert "run: paint: up to date" in told
    for name in ("cloud", "calibration", "views", "paint", "inpaint", "film", "gaussians", "splat"):
        files = [
            {path.relative_to(paper_runs.folder / run): path for path in (paper_runs.folder / run / name).rglob("*.*")}
            for run in ("killed", "whole")
        ]
        kept = [{at: file for at, file in each.items() if file.is_file() and at.name[0] != "."} for each in files]
        assert kept[0].keys() == kept[1].keys()
        for at in kept[0]:
            if at.name != "completion.json":  # names its own workspace
                assert contents(kept[0][at]) == contents(kept[1][at]), at


def test_methods_exchange_their_stages():
    mixed = run_method("paper", completion="telea", appearance="physical", poses="skyline")
    assert (mixed.painting, mixed.grade, mixed.needs_path, mixed.needs_albedo) == ("first", "none", False, True)
    assert not METHODS["physical"].needs_path
    for flags, words in (
        ({"name": "magic"}, "--method: unknown method"),
        ({"name": "paper", "poses": "stars"}, "--poses"),
        ({"name": "physical", "grade": "paper"}, "--grade: is for the plane views"),
    ):
        with pytest.raises(InputError, match=words):
            run_method(**flags)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--weights", "."], "--weights: does nothing without --completion diffusion"),
        (["--paper-steps", "3"], "--paper-steps: does nothing without --appearance paper"),
        (["--path-views", "3"], "--path-views: does nothing without a path"),
        (["--points", "."], "--points: does nothing without --poses joint or points"),
        (["--method", "paper"], "--weights: no folder of weights"),
        (["--appearance", "paper", "--suns", "3"], "--suns: does nothing without --appearance physical"),
    ],
)
def test_flags_that_would_do_nothing_are_refused(flags, words, tmp_path, capsys):
    base = ["run", "alpine_small", "--times", "2024-07-20T10:00", "--at-hours", "2024-07-20T12:00"]
    assert main([*base, "-o", str(tmp_path / "out"), *flags]) == 2
    assert words in capsys.readouterr().err
