"""The paper's loop with an image model, on tiny weights in the real layout: every condition counts, nothing is lost."""

import json
import shutil
import sys
from dataclasses import replace
from datetime import UTC, datetime
from importlib.util import find_spec
from itertools import pairwise

import numpy as np
import places
import pytest
from command_line import command
from PIL import Image
from tiny_diffusion import ADAPTER, BASE, DEPTH, INPAINT, write_tiny_weights

from seasonscapes.cameras.path_file import save_path
from seasonscapes.cameras.pinhole import camera_at
from seasonscapes.cameras.trajectory import cameras_along_path
from seasonscapes.errors import InputError
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh
from seasonscapes.terrain.surface import Texture, load_texture, save_texture
from seasonscapes.texturing.atlas_tiles import tiling
from seasonscapes.texturing.diffusion import (
    DeviceSettings,
    DiffusionSettings,
    load_inpainter,
    required_parts,
    whole_cells,
)
from seasonscapes.texturing.model_weights import WeightNames, find_weights, weights_fingerprint
from seasonscapes.texturing.path_inpainting import (
    InpaintingState,
    PathInpaintingInputs,
    PathInpaintingOptions,
    inpaint_along_path,
    textured_frames,
)
from seasonscapes.texturing.prompts import prompt_for
from seasonscapes.texturing.view_conditions import (
    ViewConditions,
    decode,
    depth_picture,
    dilated,
    encode,
    red_pixels,
    sample_covered,
    white_radiance,
)
from seasonscapes.workflows import path_completion
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workspace import Workspace

torch = pytest.importorskip("torch", reason="the extra 'diffusion' is not installed")
# Not imported here: that takes seconds in each process that collects this file.
pytestmark = pytest.mark.skipif(find_spec("diffusers") is None, reason="the extra 'diffusion' is not installed")

HEIGHT, WIDTH = 50, 70  # not divisible by 8


@pytest.fixture(scope="session")
def weights(tmp_path_factory):
    torch.set_num_threads(1)
    return write_tiny_weights(tmp_path_factory.mktemp("weights"))


# ---------------------------------------------------------------------------------------------- conditions


def test_near_is_white_in_the_depth_picture():
    depth_m = np.geomspace(50.0, 20_000.0, 400).reshape(20, 20).astype(np.float32)
    depth_m[0, :3] = np.inf
    picture = depth_picture(depth_m)
    land = np.isfinite(depth_m)
    order = np.argsort(depth_m[land])
    assert (np.diff(picture[land][order]) <= 0.0).all()
    assert picture[land].max() == 1.0
    assert 0.05 < picture[land].min() < 0.12
    assert not picture[~land].any()
    # A far ridge still differs from the one before it.
    assert (
        picture[land][np.argmin(np.abs(depth_m[land] - 5000.0))]
        > picture[land][np.argmin(np.abs(depth_m[land] - 8000.0))] + 0.03
    )
    assert not depth_picture(np.full((3, 3), np.inf)).any()
    assert np.isfinite(depth_picture(np.full((3, 3), 100.0))).all()


def test_a_view_from_a_mast_has_its_foot_in_white(hill):
    land, _, _ = hill
    view = camera_at(land.frame, 46.5405, 7.98, 1120.0, heading_deg=0.0, pitch_deg=-8.0, size_px=(48, 32))
    terrain = ray_scene(mi_mesh(land.terrain, np.full(3, 0.2)))
    picture = depth_picture(trace_gbuffer(RenderScene(terrain.mi_scene, terrain.mi_terrain), view).depth)
    assert picture[-1].min() > 0.8
    assert picture[-1].mean() > picture[16].mean() + 0.2


def test_pictures_keep_radiances():
    values = np.random.default_rng(0).uniform(10.0, 4000.0, (30, 30, 3)).astype(np.float32)
    painted = np.ones((30, 30), bool)
    white = white_radiance(values, painted)
    np.testing.assert_allclose(decode(encode(values, white), white), values, rtol=2e-4)
    assert encode(values, white).max() < 1.0
    # Values of unpainted texels have no say.
    values[0, 0], painted[0, 0] = 1e9, False
    assert white_radiance(values, painted) == pytest.approx(white, rel=0.01)


def test_holes_are_where_coverage_ends_and_look_no_colour_from_there():
    values = np.full((8, 8, 3), 5.0, np.float32)
    covered = np.ones((8, 8), bool)
    values[:, 4:], covered[:, 4:] = 1e6, False
    u = np.linspace(0.01, 0.99, 99)
    uv = np.stack([u, np.full_like(u, 0.5)], axis=-1)[None]
    radiance, known = sample_covered(values, covered, uv)
    np.testing.assert_array_equal(known[0], u <= 0.5)
    np.testing.assert_allclose(radiance[known], 5.0)
    assert not sample_covered(values, covered, np.full((1, 3, 2), np.nan))[1].any()


def test_red_is_a_hole_to_the_reference_and_so_is_autumn():
    colours = np.array(
        [[[1, 0, 0], [0.8, 0.35, 0.2], [0.2, 0.6, 0.2], [0.5, 0.6, 0.9], [0.1, 0, 0], [0.9, 0.86, 0.85]]]
    )
    np.testing.assert_array_equal(red_pixels(colours)[0], [True, True, False, False, False, False])


def test_masks_grow_by_a_disc_and_to_whole_cells():
    hole = np.zeros((40, 40), bool)
    hole[20, 20] = True
    grown = dilated(hole, 5)
    assert grown[20, 25]
    assert grown[25, 20]
    assert not grown[20, 26]
    assert not grown[25, 25]
    assert dilated(hole, 0) is hole
    cells = whole_cells(hole)
    assert cells.sum() == 64
    assert cells[16:24, 16:24].all()


def test_prompts_know_season_hour_and_sky():
    noon = prompt_for(datetime(2024, 1, 15, 11, tzinfo=UTC), 46.5, 22.0)
    assert "winter" in noon
    assert "daylight" in noon
    assert "clear" in noon
    assert "summer" in prompt_for(datetime(2024, 1, 15, 11, tzinfo=UTC), -43.5, 60.0)
    assert "winter" in prompt_for(datetime(2024, 7, 15, 11, tzinfo=UTC), -43.5, 60.0)
    months = {prompt_for(datetime(2024, month, 1, tzinfo=UTC), 46.5, 30.0) for month in range(1, 13)}
    assert len(months) == 12
    hours = {prompt_for(datetime(2024, 6, 1, tzinfo=UTC), 46.5, sun) for sun in (-40.0, -8.0, -3.0, 2.0, 10.0, 50.0)}
    assert len(hours) == 6
    assert "overcast" in prompt_for(datetime(2024, 6, 1, tzinfo=UTC), 46.5, 30.0, cloudiness=1.0)


# ---------------------------------------------------------------------------------------------- the model


def made_up_view(seed=5):
    rng = np.random.default_rng(0)
    picture = rng.random((HEIGHT, WIDTH, 3)).astype(np.float32)
    hole = np.zeros((HEIGHT, WIDTH), bool)
    hole[:, 30:] = True
    depth = np.broadcast_to(np.linspace(0.1, 1.0, HEIGHT, dtype=np.float32)[:, None], hole.shape).copy()
    return ViewConditions(picture, hole, depth, seed)


GUIDE = np.random.default_rng(3).random((40, 60, 3))
SETTINGS = DiffusionSettings(prompt="A mountain in summer", steps=3)


@pytest.fixture(scope="module")
def inpainter(weights):
    return load_inpainter(weights, SETTINGS, image=GUIDE)


def test_every_condition_changes_the_output(weights, inpainter):
    """One factor at a time: what is asked, each ControlNet and what it is shown, the guide image, the sampler."""
    view = made_up_view()
    base = inpainter(view)
    assert base.shape == (HEIGHT, WIDTH, 3)
    assert base.min() >= 0.0
    assert base.max() <= 1.0

    def moved(picture):
        return float(np.abs(picture - base)[view.hole].mean())

    changed = {
        name: moved(load_inpainter(weights, replace(SETTINGS, **change), image=GUIDE)(view))
        for name, change in {
            "other prompt": {"prompt": "A lake in winter"},
            "no prompt": {"prompt": ""},
            "negative": {"negative": "snow"},
            "no depth": {"depth_scale": 0.0},
            "weak depth": {"depth_scale": 0.7},
            "no mask": {"inpaint_scale": 0.0},
            "neither": {"depth_scale": 0.0, "inpaint_scale": 0.0},
            "no image": {"image_scale": 0.0},
            "weak image": {"image_scale": 0.4},
            "guidance": {"guidance": 6.0},
            "steps": {"steps": 4},
            "strength": {"strength": 0.7},
        }.items()
    }
    changed["other image"] = moved(load_inpainter(weights, SETTINGS, image=1.0 - GUIDE)(view))
    changed["depth inverted"] = moved(inpainter(replace(view, depth=1.0 - view.depth)))
    changed["other picture"] = moved(inpainter(replace(view, picture=1.0 - view.picture)))
    changed["other hole"] = moved(inpainter(replace(view, hole=~view.hole)))
    changed["other seed"] = moved(inpainter(replace(view, seed=6)))
    assert min(changed.values()) > 1e-5, changed
    assert changed["other seed"] > 1e-2


def test_equal_seeds_give_equal_pictures(weights, inpainter):
    view = made_up_view()
    np.testing.assert_array_equal(inpainter(view), inpainter(view))
    np.testing.assert_array_equal(load_inpainter(weights, SETTINGS, image=GUIDE)(view), inpainter(view))


def test_progress_and_number_formats(weights, monkeypatch):
    shares = []
    small = load_inpainter(weights, replace(SETTINGS, strength=0.7), device_settings=DeviceSettings("cpu", "bfloat16"))
    found = small(made_up_view(), shares.append)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(shares, [0.5, 1.0])
    parts = [small.pipe.unet, small.pipe.vae, small.pipe.text_encoder, *small.pipe.controlnet.nets]
    assert len(parts) == 5
    assert {parameter.dtype for part in parts for parameter in part.parameters()} == {torch.bfloat16}
    assert not small.slow
    monkeypatch.setattr("seasonscapes.texturing.diffusion._LARGE", 1000)
    assert small.slow


def test_only_what_counts_is_looked_for(weights, tmp_path):
    shutil.copytree(weights / BASE, tmp_path / BASE)
    shutil.copytree(weights / INPAINT, tmp_path / INPAINT)
    # Without depth and without a guide image neither is needed.
    assert required_parts(replace(SETTINGS, depth_scale=0.0), False) == ["base", "inpaint"]
    load_inpainter(tmp_path, replace(SETTINGS, depth_scale=0.0))
    with pytest.raises(InputError, match="the depth weights"):
        load_inpainter(tmp_path, SETTINGS)


def test_hub_names_stand_for_folders(weights):
    assert find_weights(weights, "depth", DEPTH) == weights / DEPTH
    assert find_weights(None, "depth", str(weights / DEPTH)) == weights / DEPTH
    assert find_weights(weights / "lllyasviel", "depth", DEPTH) == weights / DEPTH
    prints = {
        weights_fingerprint(weights / name, part, name) for part, name in (("depth", DEPTH), ("inpaint", INPAINT))
    }
    assert len(prints) == 2


@pytest.mark.parametrize(
    ("part", "name"), [("base", BASE), ("depth", DEPTH), ("inpaint", INPAINT), ("adapter", ADAPTER)]
)
def test_missing_weights_say_which_where_how_and_what_else(tmp_path, part, name):
    with pytest.raises(InputError) as caught:
        find_weights(tmp_path, part, name)
    text = str(caught.value)
    assert "\n" not in text
    for words in (
        f"the {part} weights '{name}' are missing",
        str(tmp_path / name),
        f"hf download {name} --local-dir",
        "--method guided, which needs no weights",
    ):
        assert words in text


def test_missing_weights_without_a_folder(monkeypatch, tmp_path):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(
        InputError, match=r"the hub's cache on this machine; get them with `hf download .* --weights DIR"
    ):
        find_weights(None, "base", BASE)
    with pytest.raises(InputError, match="no such folder"):
        find_weights(tmp_path / "nowhere", "base", BASE)


def cut(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def test_wrong_and_half_downloaded_weights(weights, tmp_path):
    """Each is found before anything is loaded, in one line that names the file."""
    name = "diffusion_pytorch_model.safetensors"

    def spoil(part, change):
        copy = tmp_path / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(weights, copy)
        change(copy)
        with pytest.raises(InputError) as caught:
            load_inpainter(copy, SETTINGS, image=GUIDE)
        assert "\n" not in str(caught.value)
        assert part in str(caught.value)
        return str(caught.value)

    unet = f"{BASE}/unet/{name}"
    assert "is half-downloaded" in spoil(unet, lambda at: cut(at / unet, 0.6))
    assert "is not a weights file" in spoil(
        unet, lambda at: (at / unet).write_text("version https://git-lfs.example/spec/v1\n")
    )
    assert "is not a weights file" in spoil(unet, lambda at: (at / unet).write_bytes(b""))
    assert "is missing" in spoil(unet, lambda at: (at / unet).unlink())
    assert "half-downloaded" in spoil(f"{DEPTH}/{name}", lambda at: cut(at / DEPTH / name, 0.99))
    adapter = f"{ADAPTER}/models/ip-adapter_sd15.safetensors"
    assert "half-downloaded" in spoil(adapter, lambda at: cut(at / adapter, 0.5))
    assert "is missing" in spoil("model_index.json", lambda at: (at / BASE / "model_index.json").unlink())
    assert "cut off" in spoil("config.json", lambda at: cut(at / INPAINT / "config.json", 0.5))
    # A folder of something else.
    swapped = spoil(
        "another kind of model", lambda at: shutil.copy(at / BASE / "vae/config.json", at / DEPTH / "config.json")
    )
    assert "expected ControlNetModel" in swapped

    def other_base(at):
        config = at / DEPTH / "config.json"
        config.write_text(json.dumps(json.loads(config.read_text()) | {"cross_attention_dim": 1024}))

    assert DEPTH in spoil(DEPTH, other_base)
    # Tensors that are whole but of another model.
    assert "lacks" in spoil(f"{BASE}/unet", lambda at: shutil.copy(at / DEPTH / name, at / unet))


def test_weights_by_shards_and_in_half_precision(weights, tmp_path):
    whole = weights / DEPTH / "diffusion_pytorch_model.safetensors"
    half = tmp_path / "half"
    shutil.copytree(weights / DEPTH, half)
    (half / whole.name).rename(half / "diffusion_pytorch_model.fp16.safetensors")
    names = WeightNames(depth=str(half))
    view = made_up_view()
    np.testing.assert_array_equal(
        load_inpainter(weights, SETTINGS, names=names)(view), load_inpainter(weights, SETTINGS)(view)
    )


def test_memory_that_runs_out_is_one_line(inpainter, monkeypatch):
    def full(*_args, **_kwargs):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB.\nMore lines follow.")

    monkeypatch.setattr(type(inpainter.pipe), "__call__", full)
    with pytest.raises(InputError) as caught:
        inpainter(made_up_view())
    text = str(caught.value)
    assert "\n" not in text
    for words in ("memory ran out at 70 × 50", "20.00 GiB", "finished views are kept", "--offload", "--size"):
        assert words in text


def test_a_model_that_overflows(inpainter, monkeypatch):
    class Output:
        images = np.full((1, 56, 72, 3), np.nan)

    monkeypatch.setattr(type(inpainter.pipe), "__call__", lambda *_a, **_k: Output)
    with pytest.raises(InputError, match="bfloat16"):
        inpainter(made_up_view())


def test_machines_and_settings_that_cannot_be(weights, monkeypatch):
    with pytest.raises(InputError, match="unknown device"):
        load_inpainter(weights, SETTINGS, device_settings=DeviceSettings("abacus"))
    with pytest.raises(InputError, match="unknown number format"):
        load_inpainter(weights, SETTINGS, device_settings=DeviceSettings(dtype="float7"))
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="no CUDA GPU"):
            load_inpainter(weights, SETTINGS, device_settings=DeviceSettings("cuda"))
    with pytest.raises(ValueError, match="leave none to do"):
        DiffusionSettings(steps=2, strength=0.3)
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(InputError, match=r"diffusers is not installed; pip install 'seasonscapes\[diffusion\]'"):
        load_inpainter(weights, SETTINGS)


# ---------------------------------------------------------------------------------------------- the loop

TEXEL_M = 60.0


@pytest.fixture(scope="module")
def hill(tmp_path_factory):
    """A hill with a hole on top and its north side never seen, and a path around it."""
    folder = tmp_path_factory.mktemp("hill")
    scene = places.write_place(folder / "scene")
    land = load_place(scene, Workspace(folder / "work"), options=MeshOptions(texel_m=TEXEL_M))
    shape = (land.atlas.height_px, land.atlas.width_px)
    rng = np.random.default_rng(0)
    values = (1000.0 * rng.uniform(0.5, 1.5, (*shape, 3))).astype(np.float32)
    seen = np.ones(shape, bool)
    seen[shape[0] * 2 // 5 : shape[0] * 3 // 5, shape[1] * 2 // 5 : shape[1] * 3 // 5] = False
    seen[: shape[0] // 4] = False
    texture = Texture(np.where(seen[..., None], values, np.nan), seen.astype(np.float32))
    at = [(46.5405, 7.98, 1250.0, 0.0), (46.545, 7.99, 1300.0, 330.0), (46.5510, 7.992, 1350.0, 280.0)]
    known = [
        camera_at(land.frame, *place, heading_deg=heading, pitch_deg=-12.0, size_px=(50, 34)) for *place, heading in at
    ]
    return land, texture, cameras_along_path(known, 4)


def walk_on(hill, base=None):
    land, texture, cameras = hill
    return PathInpaintingInputs(
        texture, cameras, tiling(land.terrain, land.atlas), ray_scene(mi_mesh(land.terrain, np.full(3, 0.2))), base
    )


def noise(view, tell):
    """A model that needs no weights: noise by seed, and a colour that gives away what it was shown."""
    tell(1.0)
    rng = np.random.default_rng(view.seed)
    return (0.5 * rng.random(view.picture.shape) + 0.5 * view.picture).astype(np.float32)


OPTIONS = PathInpaintingOptions(dilate_px=2, least_share=0.0, seed=7)


def walked(hill, inpaint_with=noise, options=OPTIONS, base=None, folder=None):
    state = InpaintingState(hill[1])
    return state, list(inpaint_along_path(walk_on(hill, base), state, inpaint_with, options, folder=folder))


def test_coverage_grows_and_painted_texels_stay_to_the_bit(hill):
    state, covered = InpaintingState(hill[1]), []
    for step in inpaint_along_path(walk_on(hill), state, noise, OPTIONS):
        covered.append(state.covered.copy())
        assert not step.skipped
        assert np.isfinite(step.values).all()
    assert all((later | ~earlier).all() for earlier, later in pairwise(covered))
    assert state.covered.sum() > state.painted.sum() + 50
    seen = hill[1].weight > 0.0
    np.testing.assert_array_equal(state.values[seen], hill[1].values[seen])
    np.testing.assert_array_equal(state.painted, seen)
    with pytest.raises(ValueError, match="would overwrite"):
        state.superpose(replace(step, texels=np.flatnonzero(seen)[:1], values=np.ones((1, 3), np.float32)))


def test_only_what_a_view_truly_sees_is_painted(hill):
    """From the south alone nothing behind the top gets a colour, though all of it is open."""
    land, texture, cameras = hill
    state = InpaintingState(texture)
    step = next(inpaint_along_path(walk_on((land, texture, cameras[:1])), state, noise, OPTIONS))
    rows = step.texels // land.atlas.width_px
    # The top lies a little north of the middle; rows run southwards.
    assert len(rows) > 20
    top = 0.5 * land.atlas.height_px - 200.0 / TEXEL_M
    assert (rows > top - 3).mean() > 0.98


def test_what_is_painted_is_what_the_model_gave(hill):
    """A model that paints holes green: green texels in the holes, and frames that show everything else untouched."""
    green = np.array([0.1, 0.8, 0.2], np.float32)
    state, steps = walked(hill, lambda view, tell: np.broadcast_to(green, view.picture.shape))
    white = white_radiance(state.values, state.painted)
    # But for rims, where a texel's pixels are painted ones too.
    assert np.median(np.abs(encode(steps[0].values, white) - green).max(axis=1)) < 0.02
    # Composed: outside the hole (dilated for the model) the frame is the partial picture.
    shown = {}

    def keep(view, tell):
        shown.setdefault("view", view)
        return np.broadcast_to(green, view.picture.shape)

    _, again = walked(hill, keep)
    view, frame = shown["view"], again[0].frame / 255.0
    np.testing.assert_allclose(frame[~view.hole], view.picture[~view.hole], atol=0.5 / 255 + 1e-6)
    assert view.hole.sum() > (np.abs(frame - green).max(axis=2) < 0.01).sum() > 20


def test_views_draw_their_own_seeds_and_walks_repeat(hill):
    seeds = []

    def keep(view, tell):
        seeds.append(view.seed)
        return noise(view, tell)

    first, _ = walked(hill, keep)
    second, _ = walked(hill)
    np.testing.assert_array_equal(first.values, second.values)
    assert len(set(seeds)) == 4
    other, _ = walked(hill, options=replace(OPTIONS, seed=8))
    assert np.abs(other.values - first.values)[first.generated].max() > 1.0


def test_killed_in_the_middle_it_goes_on_with_the_same_result(hill, tmp_path):
    whole, steps = walked(hill)
    calls = []

    def killed(view, tell):
        calls.append(view.seed)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return noise(view, tell)

    with pytest.raises(KeyboardInterrupt):
        walked(hill, killed, folder=tmp_path)
    # A kill may also leave pictures without their record, or a temporary file.
    Image.new("RGB", (3, 3)).save(tmp_path / "view_0002_result.png")
    (tmp_path / ".view_0002-x.part.npz").write_bytes(b"half")
    more = []
    resumed, again = walked(hill, lambda view, tell: more.append(view.seed) or noise(view, tell), folder=tmp_path)
    assert len(calls) == 3
    assert len(more) == 2
    np.testing.assert_array_equal(resumed.values, whole.values)
    np.testing.assert_array_equal(resumed.covered, whole.covered)
    for one, other in zip(steps, again, strict=True):
        np.testing.assert_array_equal(one.frame, other.frame)
    third, _ = walked(hill, lambda view, tell: pytest.fail("all views are there"), folder=tmp_path)
    np.testing.assert_array_equal(third.values, whole.values)
    names = {path.name for path in tmp_path.glob("view_0001*")}
    assert names == {"view_0001.npz", *(f"view_0001_{name}.png" for name in ("partial", "mask", "depth", "result"))}
    depth = np.asarray(Image.open(tmp_path / "view_0001_depth.png"))
    assert depth[-1].mean() > depth[:17][depth[:17] > 0].mean() + 50
    mask = np.asarray(Image.open(tmp_path / "view_0001_mask.png"))
    assert set(np.unique(mask)) == {0, 255}


def test_a_view_without_a_hole_is_skipped(hill):
    land, texture, cameras = hill
    full = (land, Texture(np.nan_to_num(texture.values, nan=500.0)), cameras)
    state, steps = walked(full, lambda view, tell: pytest.fail("nothing to paint"))
    assert all(step.skipped and step.hole_share == 0.0 and len(step.texels) == 0 for step in steps)
    np.testing.assert_array_equal(state.values, full[1].values)
    # And so are views with hardly any.
    _, few = walked(hill, lambda view, tell: pytest.fail("too little"), replace(OPTIONS, least_share=1.0))
    assert all(step.skipped and 0.0 < step.hole_share < 1.0 for step in few)


def test_the_reference_s_mask_takes_red_land_for_holes(hill):
    land, texture, cameras = hill
    red = Texture(np.where(texture.weight[..., None] > 0, np.float32([900.0, 150.0, 100.0]), np.nan), texture.weight)
    shares = {}
    for mask in ("coverage", "hsv"):
        state, steps = walked((land, red, cameras), options=replace(OPTIONS, mask=mask))
        shares[mask] = steps[0].hole_share
        # Even so, painted texels are left alone.
        np.testing.assert_array_equal(state.values[state.painted], red.values[state.painted])
    assert shares["coverage"] < 0.6
    assert shares["hsv"] == 1.0
    with pytest.raises(ValueError, match="expected one of coverage, hsv"):
        PathInpaintingOptions(mask="xor")


def test_hybrid_shows_the_model_a_completion(hill):
    base = np.zeros((*hill[1].weight.shape, 3), np.float32) + np.float32([100.0, 200.0, 1200.0])
    views = []
    state, _ = walked(hill, lambda view, tell: views.append(view) or view.picture, base=base)
    white = white_radiance(state.values, state.painted)
    expected = encode(np.float32([100.0, 200.0, 1200.0]), white)
    inside = state.generated.copy()
    assert np.median(np.abs(encode(state.values[inside], white) - expected)) < 0.01
    # Without it, holes show their rims' colours.
    plain = []
    walked(hill, lambda view, tell: plain.append(view) or view.picture)
    hole = views[0].hole
    assert np.abs(plain[0].picture[hole] - expected).mean() > np.abs(views[0].picture[hole] - expected).mean()


def test_the_sky_may_be_painted_but_never_reaches_the_texture(hill):
    holes = {}
    for paint_sky in (False, True):
        shown = []
        state, steps = walked(
            hill,
            lambda view, tell, shown=shown: shown.append(view) or np.ones_like(view.picture),
            replace(OPTIONS, paint_sky=paint_sky),
        )
        holes[paint_sky] = (shown[0], state, steps)
    sky = holes[False][0].depth == 0.0
    if not sky.any():
        pytest.fail("the test's first view shows no sky")
    assert holes[True][0].hole[sky].all()
    assert not holes[False][0].hole[sky].all()
    assert (holes[True][2][0].frame[sky] == 255).all()
    np.testing.assert_array_equal(holes[True][1].covered, holes[False][1].covered)


def test_a_model_that_misbehaves_and_nothing_painted(hill):
    with pytest.raises(ValueError, match="not finite"):
        walked(hill, lambda view, tell: np.full_like(view.picture, np.nan))
    with pytest.raises(ValueError, match="returned"):
        walked(hill, lambda view, tell: view.picture[:5])
    land, texture, cameras = hill
    with pytest.raises(ValueError, match="no painted texel"):
        walked((land, Texture(texture.values, np.zeros_like(texture.weight)), cameras))


def test_frames_show_the_finished_texture(hill):
    land, _, cameras = hill
    values = np.full((land.atlas.height_px, land.atlas.width_px, 3), 500.0, np.float32)
    frames = list(textured_frames(values, cameras[:2], walk_on(hill).terrain, 1000.0))
    assert len(frames) == 2
    assert frames[0].shape == (34, 50, 3)
    np.testing.assert_allclose(frames[0][-1], 0.5, atol=2e-3)


# ---------------------------------------------------------------------------------------------- the verb


@pytest.fixture(scope="module")
def run(hill, weights, tmp_path_factory):
    """A function that runs the verb on the hill."""
    land, texture, cameras = hill
    folder = tmp_path_factory.mktemp("run")
    save_texture(texture, folder / "painted.npz")
    save_path(folder / "path.json", cameras, land.frame)

    def call(output, **flags):
        options = {"path": folder / "path.json", "weights": weights, "steps": 2, "dilate_px": 2, "least_hole": 0.0}
        command(
            "inpaint",
            land.path,
            time="2024-09-01T10:00",
            texture=folder / "painted.npz",
            method="diffusion",
            fast=True,
            output=output,
            json=True,
            texel_m=TEXEL_M,
            workspace=folder / "work",
            **(options | flags),
        )

    return call


def test_end_to_end_interrupted_and_resumed(run, hill, tmp_path, capsys, monkeypatch):
    """All texels get a value, painted ones keep theirs, coverage grows; a run that ran out of memory loses nothing."""
    flags = {"frames": tmp_path / "views"}
    run(tmp_path / "whole.npz", film=tmp_path / "film.mp4", frames=tmp_path / "other")
    record = json.loads(capsys.readouterr().out)
    coverage = record["coverage"]
    assert len(coverage) == 5
    assert all(a <= b for a, b in pairwise(coverage))
    assert coverage[-1] > coverage[0] + 0.02
    assert "early autumn" in record["prompt"]
    assert (tmp_path / "film.mp4").stat().st_size > 1000
    whole = load_texture(tmp_path / "whole.npz")
    seen = hill[1].weight > 0.0
    np.testing.assert_array_equal(whole.values[seen], hill[1].values[seen])
    np.testing.assert_array_equal(whole.weight, hill[1].weight)
    assert np.isfinite(whole.values).all()
    with np.load(tmp_path / "whole.npz") as stored:
        surface = np.isfinite(stored["sigma"])
        assert surface.all()
        assert not stored["sigma"][seen].any()
        assert (stored["sigma"][~seen] > 0.0).mean() > 0.99

    real, count = path_completion._load_inpainter, []

    def fails_at_third(*args):
        inpainter, identity = real(*args)

        class Failing:
            slow, device = False, "cpu"

            def __call__(self, view, tell):
                count.append(view.seed)
                if len(count) == 3:
                    raise InputError("--device", "the GPU's memory ran out")
                return inpainter(view, tell)

        return Failing(), identity

    monkeypatch.setattr(path_completion, "_load_inpainter", fails_at_third)
    with pytest.raises(InputError, match="memory ran out"):
        run(tmp_path / "resumed.npz", **flags)
    assert not (tmp_path / "resumed.npz").exists()
    capsys.readouterr()
    run(tmp_path / "resumed.npz", **flags)
    assert len(count) == 3 + 2
    np.testing.assert_array_equal(load_texture(tmp_path / "resumed.npz").values, whole.values)
    # Another seed or mode is another run: nothing of this one is taken for it.
    folders = {path.name for path in (tmp_path / "views").iterdir()}
    assert len(folders) == 1


def test_hybrid_and_ablations_end_to_end(run, hill, tmp_path, capsys):
    run(tmp_path / "hybrid.npz", hybrid=True, steps=5, without="image,depth", prompt="snow")
    record = json.loads(capsys.readouterr().out)
    assert sorted(record["weights"]) == ["base", "inpaint"]
    assert record["prompt"] == "snow"
    done = load_texture(tmp_path / "hybrid.npz")
    seen = hill[1].weight > 0.0
    assert np.isfinite(done.values).all()
    np.testing.assert_array_equal(done.values[seen], hill[1].values[seen])


def test_without_paint_the_model_paints_everything_it_sees(run, hill, tmp_path, capsys):
    run(tmp_path / "bare.npz", without="paint")
    record = json.loads(capsys.readouterr().out)
    assert record["without"] == ["paint"]
    assert record["coverage"][0] == 0.0
    assert record["coverage"][-1] > 0.1
    done = load_texture(tmp_path / "bare.npz")
    assert not done.weight.any()
    assert np.isfinite(done.values).all()
    seen = hill[1].weight > 0.0
    assert np.abs(done.values[seen] - hill[1].values[seen]).mean() > 0.05 * hill[1].values[seen].mean()


def test_the_verb_says_what_is_wrong(run, tmp_path):
    for flags, words in (
        ({"path": None}, "--path: missing"),
        ({"path": tmp_path / "none.json"}, "no such file"),
        ({"weights": tmp_path / "none"}, "no such folder"),
        ({"weights": tmp_path}, "the base weights .* are missing"),
        ({"guide_image": tmp_path / "none.jpg"}, "--guide-image"),
        ({"mask": "xor"}, "coverage or hsv"),
        ({"without": "prompt,sky"}, "of prompt, depth, mask, image, paint"),
        ({"without": "paint", "hybrid": True}, "--hybrid: of no use with --without paint"),
        ({"steps": 0}, "--steps"),
        ({"strength": 0.1}, "--strength"),
        ({"film": tmp_path / "a.gif"}, "mp4"),
    ):
        with pytest.raises(InputError, match=words):
            run(tmp_path / "done.npz", **flags)
    assert not (tmp_path / "done.npz").exists()
