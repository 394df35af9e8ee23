"""Looks of photographs that a model of frames has not seen: an embedding fitted to one half, judged on the other."""

import json

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import places  # noqa: E402
from PIL import Image  # noqa: E402

from seasonscapes.cli import main  # noqa: E402
from seasonscapes.errors import InputError  # noqa: E402
from seasonscapes.gaussians.frame_appearance import TimedFrame, fit_frame_code, save_frame_gaussians  # noqa: E402
from seasonscapes.workflows.path_stages import distil_frames, look_of_photograph, timed_views  # noqa: E402
from seasonscapes.workflows.place import load_place  # noqa: E402
from seasonscapes.workspace import Workspace  # noqa: E402


@pytest.fixture(scope="module")
def held_out(tmp_path_factory):
    """A place, a model of relit pictures of all suns but one, and the views and pictures of that one."""
    folder = tmp_path_factory.mktemp("codes")
    scene, views = places.write_place(folder / "scene"), folder / "views"
    flags = [
        "--discs",
        "48",
        "--sky",
        "hosek",
        "--suns",
        "5",
        "--disc-px",
        "0",
        "--views",
        "2",
        "--view-px",
        "64",
        "--steps",
        "1",
    ]
    flags += ["--picture-steps", "0", "--no-refine-discs", "--seed", "3", "--export-views", str(views)]
    flags += ["-o", str(folder / "relit.safetensors"), "--workspace", str(folder / "work")]
    assert main(["distill", str(scene), *flags]) == 0
    place = load_place(scene, Workspace(folder / "work"))
    every = timed_views(place, views)
    hidden = sorted({view.time for view in every})[2]
    file = views / "transforms.json"
    table = json.loads(file.read_text())
    table["frames"] = [record for record, view in zip(table["frames"], every, strict=True) if view.time != hidden]
    file.write_text(json.dumps(table))
    model, _ = distil_frames(place, views, discs=48, steps=300, directional=False)
    assert len(model.times) == 4
    assert hidden not in model.times
    save_frame_gaussians(model, folder / "frames.safetensors")
    return place, model, [(view.camera, views / view.file) for view in every if view.time == hidden], folder


def test_a_fitted_code_shows_the_other_half_better_than_the_nearest_learned_one(held_out):
    place, model, pictures, _ = held_out
    before = {name: value.clone() for name, value in model.appearance.state_dict().items()}
    assert len(pictures) == 2
    for camera, file in pictures:
        code, facts = look_of_photograph(place, model, camera, file)
        assert facts["psnr_fitted_db"] > facts["psnr_nearest_db"] + 4.0
        again, _ = look_of_photograph(place, model, camera, file)
        assert torch.equal(code, again)
    for name, value in model.appearance.state_dict().items():
        assert torch.equal(value, before[name]), "all else is frozen"


def test_what_is_not_seen_has_no_say(held_out):
    """Pixels outside the mask, the half that judges among them, do not change the code."""
    _, model, ((camera, _), *_), _ = held_out
    rng = np.random.default_rng(1)
    image = rng.uniform(0.1, 0.5, (camera.height_px, camera.width_px, 3))
    mask = np.broadcast_to(np.arange(camera.width_px) < 32, image.shape[:2])
    other = np.where(mask[..., None], image, 0.9)
    codes = [fit_frame_code(model, TimedFrame(camera, 0, each, mask), steps=5)[0] for each in (image, other)]
    assert torch.equal(*codes)


def test_splat_like_a_photograph(held_out, capsys):
    """A picture of the model at a learned time is recognised, and reproduced from that camera."""
    place, model, _, folder = held_out
    common = ["splat", str(place.path), "--model", str(folder / "frames.safetensors"), "--json"]
    common += ["--workspace", str(folder / "work")]
    photograph, again, time = folder / "photo.png", folder / "again.png", model.times[3]
    assert main([*common, "--time", time.isoformat(), "--size", "96x64", "-o", str(photograph)]) == 0
    capsys.readouterr()
    assert main([*common, "--like", str(photograph), "--size", "72x48", "-o", str(again)]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (record["like"], record["nearest_time_utc"]) == ("photo.png", time.isoformat())
    assert record["psnr_fitted_db"] > 40.0
    shown, truth = Image.open(again), Image.open(photograph).resize((72, 48), Image.Resampling.BOX)
    assert np.abs(np.asarray(shown, float) - np.asarray(truth, float)).mean() < 4.0
    for arguments, said in (
        (["--like", str(photograph), "--time", "2024-07-18T12:00"], "name an hour, or a photograph with --like"),
        ([], "name an hour, or a photograph with --like"),
        (["--like", str(photograph), "--size", "64x64"], "another shape than the view; got '96 x 64'"),
        (["--like", "none.png"], "no such file"),
        (["--like", str(photograph), "--subpixels", "1"], "--subpixels: does nothing without a model that is relit"),
        (["--like", str(photograph), "--device", "cuda"], "--device: does nothing without a model that is relit"),
    ):
        assert main([*common, *arguments, "-o", str(again)]) == 2
        assert said in capsys.readouterr().err


def test_a_photograph_of_the_sky_is_refused(held_out, tmp_path):
    place, model, ((camera, _), *_), _ = held_out
    up = np.eye(4)
    up[2, 3] = 5000.0
    sky = type(camera)(64, 64, 60.0, 60.0, 32.0, 32.0, up, camera.frame)
    Image.new("RGB", (64, 64), (80, 120, 200)).save(tmp_path / "sky.png")
    with pytest.raises(InputError, match=r"no Gaussian is in view|pixels of terrain"):
        look_of_photograph(place, model, sky, tmp_path / "sky.png")
