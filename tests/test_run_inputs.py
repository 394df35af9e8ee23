"""What makes the stages of a run stale: contents of files, whatever they are called; and nothing else."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from places import MASSIF, SCENE, hill_heights, write_place, write_raster

from seasonscapes.calibration.calibration_file import write_calibration
from seasonscapes.calibration.pose_model import parameters_of_view
from seasonscapes.calibration.resection import Calibration
from seasonscapes.cameras.observation import ManifestRow, read_manifest, write_manifest
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame
from seasonscapes.images import write_png8
from seasonscapes.sky.models import read_sky_model
from seasonscapes.workflows.distillation import DistilOptions
from seasonscapes.workflows.full_run import RunJob, stages_of
from seasonscapes.workflows.photograph_files import PhotographSources
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workflows.run_photographs import RunPhotographs
from seasonscapes.workflows.stage_runner import run_stages
from seasonscapes.workspace import Workspace

NOON = datetime(2024, 9, 1, 10, tzinfo=UTC)
AFTER = ["albedo", "paint", "inpaint", "relight", "distil", "splat"]
ALL = ["pictures", "calibrate", *AFTER]


class Real:
    """A real place with two webcams at two times, whose later stages are stand-ins that only count."""

    def __init__(self, folder):
        self.folder, self.count = folder, 0
        self.scene = write_place(folder / "place")
        self.inputs = folder / "shots"
        rows = []
        for webcam in ("a", "b"):
            for hour in range(3):
                self.picture(f"{webcam}{hour}.png", 10 * hour + len(webcam))
                rows.append(ManifestRow(webcam, NOON + timedelta(hours=hour), f"{webcam}{hour}.png"))
            self.record(webcam)
            self.mask(webcam, 255)
        write_manifest(self.inputs / "manifest.csv", rows)

    def picture(self, name, value):
        write_png8(self.inputs / name, np.full((8, 12, 3), value, np.uint8))

    def mask(self, webcam, value):
        write_png8(self.folder / "masks" / f"{webcam}.png", np.full((8, 12, 3), value, np.uint8))

    def record(self, webcam, focal=10.0):
        camera = Camera(12, 8, focal, focal, 6.0, 4.0, np.eye(4))
        solved = Calibration(
            camera, 0.0, parameters_of_view(camera, np.eye(3)), np.eye(9), (), np.zeros((0, 2)), np.zeros(0, bool), 0.0
        )
        write_calibration(
            self.folder / "records" / f"{webcam}_calibration.json", webcam, solved, LocalFrame(46.55, 7.98)
        )

    def job(self, **changed) -> RunJob:
        sources = PhotographSources(self.inputs / "manifest.csv", self.folder / "records", self.folder / "masks")
        place = load_place(self.scene, Workspace(self.folder / "work"), options=MeshOptions(texel_m=50.0))
        times = tuple(NOON + timedelta(hours=hour) for hour in range(2))
        job = RunJob(
            place, times, (NOON,), place.scene.camera(None), (12, 8), read_sky_model("hosek"), RunPhotographs(sources)
        )
        return replace(job, **changed)

    def made(self, **changed) -> list[str]:
        """Names of the stages that a run makes now."""
        job = self.job(**changed)
        made = []

        def counted(stage):
            def build(run):
                made.append(stage.name)
                if stage.name not in AFTER:
                    return stage.build(run)
                self.count += 1
                (run / stage.own).mkdir(exist_ok=True)
                (run / stage.own / "made.txt").write_text(str(self.count))
                return [run / stage.own / "made.txt"]

            return replace(stage, build=build)

        run_stages(self.folder / "run", [counted(stage) for stage in stages_of(job)])
        return made


@pytest.fixture
def real(tmp_path) -> Real:
    made = Real(tmp_path)
    assert made.made() == ALL
    assert made.made() == []
    return made


def test_a_changed_picture_record_or_mask_is_noticed(real):
    real.picture("b1.png", 99)
    assert real.made() == ALL
    real.record("a", focal=10.5)
    assert real.made() == ["calibrate", *AFTER]
    real.mask("b", 0)
    assert real.made() == ALL
    (real.folder / "masks" / "b.png").unlink()
    assert real.made() == ALL
    assert not (real.folder / "run" / "pictures" / "masks" / "b.png").exists(), "none is left of what is no more"
    (real.folder / "records" / "b_calibration.json").unlink()
    assert real.made() == ["calibrate", *AFTER]
    assert [path.name for path in (real.folder / "run" / "calibration").glob("*_calibration.json")] == [
        "a_calibration.json"
    ]
    assert real.made() == []


def test_a_changed_manifest_is_noticed_where_it_concerns_the_times(real):
    rows = read_manifest(real.inputs / "manifest.csv")
    write_manifest(real.inputs / "manifest.csv", [replace(rows[0], time=NOON + timedelta(minutes=5)), *rows[1:]])
    assert real.made() == ALL
    # A picture of another hour is none of these times' business, and neither is its name.
    real.picture("a2.png", 77)
    assert real.made() == []
    real.inputs.rename(real.folder / "elsewhere")
    real.inputs = real.folder / "elsewhere"
    assert real.made() == []
    (real.inputs / "b0.png").unlink()
    with pytest.raises(InputError, match="no such picture"):
        real.made()


def test_the_pictures_of_a_run_are_its_own(real):
    """Those that were taken over stay what they are while others come."""
    taken = real.folder / "run" / "pictures"
    rows = read_manifest(taken / "manifest.csv")
    assert len(rows) == 4
    assert all((taken / row.path).is_file() for row in rows)
    # Somebody writes into the run's folder: made again, and not from what stands there.
    write_png8(taken / rows[0].path, np.zeros((8, 12, 3), np.uint8))
    assert real.made() == ["pictures"], "the same pictures again leave the rest fresh"
    assert (taken / rows[0].path).read_bytes() == (real.inputs / "a0.png").read_bytes()


def test_a_changed_scene_is_noticed(real):
    text = real.scene.read_text()
    real.scene.write_text("# a remark\n" + text)
    assert real.made() == []
    real.scene.write_text(text.replace("heading_deg = 0.0", "heading_deg = 3.0"))
    # Discs follow the view; those of one size do not.
    assert real.made() == ["relight", "distil", "splat"]
    assert real.made(size_px=(24, 16)) == ["relight", "distil", "splat"]
    one_size = DistilOptions(disc_px=0.0)
    assert real.made(size_px=(24, 16), distil=one_size) == ["distil", "splat"]
    assert real.made(distil=one_size) == ["relight", "splat"]
    real.scene.write_text(SCENE + "[origin]\nlatitude_deg = 46.552\nlongitude_deg = 7.98\n")
    assert real.made() == ALL


def test_changed_heights_or_imagery_are_noticed(real):
    write_raster(real.scene.parent / "dem.tif", hill_heights() + 1.0, spacing_m=50.0)
    assert real.made() == ALL
    write_raster(real.scene.parent / "image.tif", np.full((40, 40, 3), 0.4), spacing_m=75.0)
    assert real.made() == ALL
    assert real.made() == []


def test_arguments_of_later_stages_leave_the_earlier_ones_fresh(real):
    assert real.made(distil=DistilOptions(steps=3)) == ["distil", "splat"]
    assert real.made(distil=DistilOptions(steps=3), hours=(NOON + timedelta(hours=5),)) == ["relight", "splat"]
    assert real.made(seed=1) == ALL
    assert real.made(seed=1, sky=read_sky_model("clear")) == ALL


def test_photographs_of_a_synthetic_scene_are_keyed_by_how_they_are_taken(tmp_path):
    (tmp_path / "little.toml").write_text(MASSIF)

    def key(text=MASSIF, **pictures) -> dict:
        (tmp_path / "little.toml").write_text(text)
        options = MeshOptions(texel_m=240.0, refine=1)
        place = load_place(tmp_path / "little.toml", Workspace(tmp_path / "work"), options=options)
        model, photographs = read_sky_model("hosek"), RunPhotographs(**pictures)
        job = RunJob(place, (NOON,), (NOON,), place.scene.camera(None), (768, 512), model, photographs)
        return stages_of(job)[0].inputs

    plain = key()
    assert plain == key()
    others = [
        key(size_px=(720, 120)),
        key(kind="perspective", size_px=(720, 480)),
        key(leave_out=frozenset({"meadow"})),
        key(MASSIF.replace("60.0\nheading_deg = 164.3", "70.0\nheading_deg = 164.3")),
    ]
    assert all(other != plain for other in others)
    assert others[1]["pictures"]["size"] == (720, 480)
