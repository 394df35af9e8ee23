"""Completion: exact laws of the fills, recovery of a known truth, controls that must fail, and the verb."""

import json
from dataclasses import replace

import cv2
import numpy as np
import places
import pytest
from command_line import command

from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame
from seasonscapes.terrain.hole_filling import harmonic_fill
from seasonscapes.terrain.mesh import build_mesh
from seasonscapes.terrain.surface import Raster, Texture, load_texture, save_texture
from seasonscapes.terrain.unwrap import unwrap
from seasonscapes.texturing.completion import INPAINTERS, CompletionOptions, complete
from seasonscapes.texturing.predictors import predictors_for, stack_predictors
from seasonscapes.texturing.smooth_fill import membrane_fill, propagate, push_pull, telea_fill
from seasonscapes.texturing.terrain_features import horizon_tangent, sun_margin_deg, terrain_features
from seasonscapes.texturing.top_down_grid import from_grid, grid_heights, to_grid
from seasonscapes.workflows.albedo_sources import scene_albedo
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workspace import Workspace

SIDE, SPACING_M = 128, 50.0


def smooth_noise(seed: int, sigma_px: float, side: int = SIDE) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((side, side)), (0, 0), sigma_px)
    return (noise / noise.std()).astype(np.float32)


def made_up_land(seed: int = 3):
    """A truth that follows from height, sun and a satellite image, a mask with holes of all sizes, and its guides."""
    z = 1500.0 + 400.0 * smooth_noise(seed, 9.0) + 60.0 * smooth_noise(seed + 1, 2.5)
    sun = np.array([0.5, -0.6, 0.624])
    layers = terrain_features(z, SPACING_M, sun_direction=sun)
    forest = smooth_noise(seed + 2, 5.0) > 0.2
    ground = np.where(forest[..., None], [0.03, 0.05, 0.02], [0.12, 0.14, 0.06])
    snow = 1.0 / (1.0 + np.exp(-(z - 1600.0) / 25.0))[..., None]
    albedo = ground + snow * (np.array([0.8, 0.82, 0.84]) - ground)
    albedo = albedo * np.exp(0.2 * smooth_noise(seed + 4, 1.5))[..., None]  # what no guide tells
    truth = albedo * (12_000.0 + 90_000.0 * layers["sun"][..., None]) / np.pi
    satellite = Texture((ground * (0.4 + layers["sky_view"][..., None])).astype(np.float32))
    seen = smooth_noise(seed + 3, 6.0) > 0.1
    seen[::9, ::7] = False  # holes of one texel
    return truth.astype(np.float32), seen, stack_predictors(layers, satellite)


def painted(truth: np.ndarray, seen: np.ndarray) -> Texture:
    return Texture(np.where(seen[..., None], truth, np.nan).astype(np.float32), seen.astype(np.float32))


def hidden_psnr(values: np.ndarray, truth: np.ndarray, seen: np.ndarray) -> float:
    shown = [np.clip(v / np.percentile(truth, 99.0), 0.0, 1.0) ** (1.0 / 2.4) for v in (values, truth)]
    return float(-10.0 * np.log10(np.mean((shown[0] - shown[1])[~seen] ** 2)))


# ---------------------------------------------------------------------------------------------- the land's layers


def test_layers_of_a_tilted_plane_are_those_of_geometry():
    east, north = np.meshgrid(np.arange(40) * 10.0, -np.arange(40) * 10.0)
    slope = np.radians(30.0)
    z = (-np.tan(slope) * north).astype(np.float32) + 0.0 * east.astype(np.float32)  # it faces north
    sun = np.array([0.0, np.sin(np.radians(40.0)), np.cos(np.radians(40.0))])
    layers = {name: layer[12:28, 12:28] for name, layer in terrain_features(z, 10.0, sun_direction=sun).items()}
    np.testing.assert_allclose(layers["slope"], 30.0, atol=1e-2)
    np.testing.assert_allclose(layers["facing_north"], np.sin(slope), atol=1e-4)
    np.testing.assert_allclose(layers["facing_east"], 0.0, atol=1e-4)
    np.testing.assert_allclose(layers["sun_cosine"], np.cos(np.radians(10.0)), atol=1e-4)
    np.testing.assert_allclose(layers["sun"], layers["sun_cosine"], atol=1e-6)
    # A plane that stretches without end sees (1 + cos slope) / 2 of the sky.
    np.testing.assert_allclose(layers["sky_view"], (1.0 + np.cos(slope)) / 2.0, atol=0.02)


def test_a_wall_throws_a_shadow_of_height_over_tangent():
    z = np.zeros((60, 200), np.float32)
    z[:, 150:] = 100.0
    elevation = np.radians(20.0)
    sun = np.array([np.cos(elevation), 0.0, np.sin(elevation)])
    dark = np.flatnonzero(sun_margin_deg(z, 10.0, sun)[30] < 0.0)
    length_m = (150 - dark.min()) * 10.0
    assert length_m == pytest.approx(100.0 / np.tan(elevation), abs=25.0)
    assert dark.max() == 149
    assert (terrain_features(z, 10.0, sun_direction=[0.0, 0.6, -0.8])["sun"] == 0.0).all()
    tangent = horizon_tangent(z, 10.0, np.pi / 2.0, stride=1.03)[30, 100]
    assert tangent == pytest.approx(100.0 / 500.0, rel=0.05)


def test_holes_of_the_heights_stay_holes_and_throw_no_shadow():
    z = np.full((50, 50), 800.0, np.float32)
    z[20:25, 20:25] = np.nan
    layers = terrain_features(
        z, 30.0, sun_direction=[0.7, 0.0, 0.714], day_suns=[[0.7, 0.0, 0.714], [0.0, 0.7, -0.714]]
    )
    for layer in layers.values():
        assert np.isnan(layer[20:25, 20:25]).all()
        assert np.isfinite(layer[:20]).all()
    np.testing.assert_allclose(layers["sun"][:20], 0.714, atol=1e-4)
    np.testing.assert_allclose(layers["insolation"][:20], 0.357, atol=1e-3)
    with pytest.raises(ValueError, match="no finite height"):
        terrain_features(np.full((5, 5), np.nan), 10.0)


# ---------------------------------------------------------------------------------------------- fills of pictures


def test_push_pull_keeps_what_is_known_and_fills_a_constant():
    seen = smooth_noise(8, 4.0) > 1.0
    values = np.where(seen[..., None], np.float32([3.0, 5.0, 7.0]), np.nan)
    filled = push_pull(values, seen)
    np.testing.assert_allclose(filled, np.broadcast_to(np.float32([3.0, 5.0, 7.0]), filled.shape), rtol=1e-5)
    odd = push_pull(np.arange(35.0).reshape(5, 7, 1), np.ones((5, 7)))
    np.testing.assert_array_equal(odd[..., 0], np.arange(35.0).reshape(5, 7))


@pytest.mark.parametrize("shape", [(37, 52), (1, 9), (64, 3)])
def test_push_pull_blends_weighted_means_of_four(shape):
    """Against sums over blocks of the array, level by level, with weights between 0 and 1."""
    rng = np.random.default_rng(2)
    values, seen = rng.normal(size=(*shape, 2)).astype(np.float32), rng.random(shape) > 0.6
    weight = (seen * rng.random(shape)).astype(np.float32)

    def level(values, weight):
        if max(weight.shape) <= 1:
            return values
        rows, columns = (-(-side // 2) for side in weight.shape)
        sums, total = np.zeros((rows, columns, 2), np.float32), np.zeros((rows, columns), np.float32)
        for r, c in np.ndindex(weight.shape):
            sums[r // 2, c // 2] += values[r, c] * weight[r, c]
            total[r // 2, c // 2] += weight[r, c]
        coarse = level(sums / np.maximum(total, 1e-6)[..., None], np.minimum(total, 1.0))
        up = cv2.resize(coarse, (2 * columns, 2 * rows), interpolation=cv2.INTER_LINEAR)
        return weight[..., None] * values + (1.0 - weight[..., None]) * up[: weight.shape[0], : weight.shape[1]]

    expected = level(values, weight)
    values[weight == 0.0] = np.nan
    np.testing.assert_allclose(push_pull(values, weight), expected, atol=1e-5)


def test_a_residual_fades_with_its_reach():
    seen = np.zeros((9, 101), bool)
    seen[:, 0] = True
    carried = propagate(np.ones((9, 101, 1)), seen, reach_px=12.0)[4, :, 0]
    np.testing.assert_allclose(carried[[1, 13, 25]], np.exp([0.0, -1.0, -2.0]), rtol=0.03)
    assert not propagate(np.ones((9, 9, 1)), np.zeros((9, 9), bool)).any()


def test_a_single_odd_pixel_leaves_no_blot_beside_it():
    seen = np.zeros((41, 41), bool)
    seen[:, :20] = True
    residual = np.zeros((41, 41, 3))
    residual[20, 19] = 1.0
    carried = propagate(residual, seen)
    assert np.abs(carried[:, 20:]).max() < 0.15
    np.testing.assert_array_equal(carried[seen], residual[seen])


def test_relief_of_a_terrain_is_that_of_its_heights_and_not_of_its_triangles():
    place = load_place("alpine_small", options=MeshOptions(max_error_m=40.0))
    heights, spacing_m = grid_heights(place.terrain, 60.0)
    bare = replace(place.terrain, surface=None)
    facets, _ = grid_heights(bare, 60.0)
    low, high = place.terrain.vertices[:, :2].min(axis=0), place.terrain.vertices[:, :2].max(axis=0)
    rows, columns = np.mgrid[5:15, 5:15]
    position = np.stack(
        [
            low[0] + (columns + 0.5) * spacing_m,
            high[1] - (rows + 0.5) * (high - low)[1] / heights.shape[0],
            heights[5:15, 5:15],
        ],
        -1,
    ).reshape(-1, 3)
    true = place.terrain.surface.up_at(position)
    np.testing.assert_allclose(heights[5:15, 5:15].ravel(), true, atol=0.5)
    assert np.abs(facets[5:15, 5:15].ravel() - true).max() > 2.0


def test_the_membrane_solves_laplace():
    seen = smooth_noise(5, 5.0, 64) > 0.5
    values = smooth_noise(6, 4.0, 64)
    exact = harmonic_fill(values.astype(float), ~seen)
    ours = membrane_fill(values[..., None], seen)[..., 0]
    assert np.abs(ours - exact).max() < 0.02 * np.ptp(values)
    np.testing.assert_array_equal(ours[seen], values[seen])


def test_telea_and_membrane_fill_a_ramp_between_its_ends():
    ramp = np.broadcast_to(np.linspace(-2.0, 3.0, 60, dtype=np.float32)[None, :, None], (40, 60, 3))
    seen = np.ones((40, 60), bool)
    seen[10:30, 20:40] = False
    np.testing.assert_allclose(membrane_fill(ramp, seen), ramp, atol=0.03)
    assert np.sqrt(np.mean((telea_fill(ramp, seen) - ramp)[~seen] ** 2)) < 0.4  # a constant would be off by 0.5
    for fill in (membrane_fill, telea_fill):
        with pytest.raises(ValueError, match="no known texel"):
            fill(ramp, np.zeros((40, 60), bool))


# ---------------------------------------------------------------------------------------------- completion


@pytest.fixture(scope="module")
def filled():
    truth, seen, predictors = made_up_land()
    return (
        truth,
        seen,
        predictors,
        {name: complete(painted(truth, seen), predictors, options=CompletionOptions(name)) for name in INPAINTERS},
    )


def test_painted_texels_stay_bit_identical_and_nothing_is_left_open(filled):
    truth, seen, _, done = filled
    for result in done.values():
        np.testing.assert_array_equal(result.values[seen], truth[seen])
        assert np.isfinite(result.values).all()
        assert (result.values >= 0.0).all()
        assert (result.sigma[seen] == 0.0).all()
        assert (result.sigma[~seen] > 0.0).all()
        np.testing.assert_array_equal(result.painted, seen)


def test_guided_beats_what_only_knows_pictures(filled):
    truth, seen, _, done = filled
    score = {name: hidden_psnr(result.values, truth, seen) for name, result in done.items()}
    assert score["guided"] > score["membrane"] + 5.0
    assert score["membrane"] > score["telea"] - 0.5


def test_sigma_is_as_large_as_the_error(filled):
    truth, seen, _, done = filled
    for name, slack in (("guided", 1.5), ("membrane", 2.0)):
        error = np.sqrt(np.mean((done[name].values - truth) ** 2, axis=2))[~seen]
        sigma = done[name].sigma[~seen]
        ratio = np.sqrt(np.mean(sigma**2) / np.mean(error**2))
        assert 1.0 / slack < ratio < slack, name
        # And it knows where: the half with the larger σ has the larger errors.
        half = sigma > np.median(sigma)
        assert np.sqrt(np.mean(error[half] ** 2)) > 1.3 * np.sqrt(np.mean(error[~half] ** 2)), name


def test_controls_lower_the_score(filled):
    truth, seen, predictors, done = filled
    score = hidden_psnr(done["guided"].values, truth, seen)
    shuffled = predictors.values.reshape(-1, len(predictors.names))[np.random.default_rng(0).permutation(seen.size)]
    permuted = stack_predictors(dict(zip(predictors.names, shuffled.T.reshape(-1, *seen.shape), strict=True)))
    assert (
        hidden_psnr(complete(painted(truth, seen), permuted, options=CompletionOptions(fast=True)).values, truth, seen)
        < score - 5.0
    )
    names = predictors.names
    moved = {name: predictors.values[..., i] for i, name in enumerate(names)}
    moved |= {name: np.roll(moved[name], 23, axis=1) for name in names if name.startswith("sun")}
    moved |= {name: np.zeros_like(moved[name]) for name in ("facing_east", "facing_north")}
    assert hidden_psnr(complete(painted(truth, seen), stack_predictors(moved)).values, truth, seen) < score - 0.5


def test_fast_and_seeds(filled):
    truth, seen, predictors, done = filled
    texture = painted(truth, seen)
    fast = complete(texture, predictors, options=CompletionOptions(fast=True))
    assert hidden_psnr(fast.values, truth, seen) > hidden_psnr(done["membrane"].values, truth, seen) + 4.0
    np.testing.assert_array_equal(
        fast.values, complete(texture, predictors, options=CompletionOptions(fast=True)).values
    )


def test_grain_is_the_seen_land_s_and_touches_no_painted_texel(filled):
    truth, seen, predictors, _ = filled
    rough = truth * np.exp(0.25 * np.random.default_rng(1).standard_normal(truth.shape[:2]))[..., None].astype(
        np.float32
    )
    texture = painted(rough, seen)
    plain, grained = (complete(texture, predictors, options=CompletionOptions(fast=True, detail=d)) for d in (0.0, 1.0))
    np.testing.assert_array_equal(grained.values[seen], rough[seen])

    def grain(values):
        cubes = np.cbrt(values)
        return float(np.std((cubes - cv2.GaussianBlur(cubes, (0, 0), 2.0))[~seen]))

    assert grain(plain.values) < 0.7 * grain(rough)
    assert 0.8 * grain(rough) < grain(grained.values) < 1.2 * grain(rough)


def test_a_satellite_image_that_covers_half_the_place():
    truth, seen, predictors = made_up_land()
    half = predictors.values.copy()
    image = [i for i, name in enumerate(predictors.names) if name.startswith("satellite")]
    half[:, SIDE // 2 :, image] = np.nan
    # And the cameras saw only where there is an image: what to do without one must be learned all the same.
    seen = seen & (np.arange(SIDE) < SIDE // 2)[None, :]
    beyond = ~seen & (np.arange(SIDE) >= SIDE // 2)[None, :]
    layers = dict(zip(predictors.names, np.moveaxis(half, -1, 0), strict=True))
    surface = np.ones(seen.shape, bool)
    with_half = complete(painted(truth, seen), stack_predictors(layers, surface=surface))
    without = complete(
        painted(truth, seen), stack_predictors({n: v for n, v in layers.items() if not n.startswith("sat")})
    )
    assert np.isfinite(with_half.values).all()
    inside = ~seen & ~beyond
    assert hidden_psnr(with_half.values, truth, ~inside) > hidden_psnr(without.values, truth, ~inside) + 1.0
    assert hidden_psnr(with_half.values, truth, ~beyond) > hidden_psnr(without.values, truth, ~beyond) - 1.0


def test_all_painted_none_painted_and_nonsense():
    truth, seen, predictors = made_up_land()
    whole = complete(Texture(truth), predictors)
    np.testing.assert_array_equal(whole.values, truth)
    assert not whole.sigma.any()
    with pytest.raises(ValueError, match="no painted texel"):
        complete(Texture(truth, np.zeros(seen.shape, np.float32)), predictors)
    with pytest.raises(ValueError, match="no painted texel"):
        complete(Texture(np.full_like(truth, np.nan)), predictors)
    with pytest.raises(ValueError, match="expected one of guided, membrane, telea"):
        CompletionOptions("magic")
    with pytest.raises(ValueError, match="expected 0 to 1"):
        CompletionOptions(detail=1.1)
    with pytest.raises(ValueError, match="negative"):
        complete(Texture(-truth), predictors)
    with pytest.raises(ValueError, match="the texture"):
        complete(Texture(truth[:50]), predictors)
    one = np.zeros(seen.shape, bool)
    one[40, 40] = True
    for name in INPAINTERS:
        lonely = complete(painted(truth, one), predictors, options=CompletionOptions(name))
        np.testing.assert_allclose(lonely.values, np.broadcast_to(truth[40, 40], truth.shape), rtol=1e-3)
        assert (lonely.sigma[~one] > 0.3 * truth[40, 40].mean()).all()


def test_charts_that_lie_apart_are_neighbours_on_the_land(monkeypatch):
    monkeypatch.setattr("seasonscapes.terrain.charts._CHART_PX", 20)
    heights = places.hill_heights(count=41)
    raster = Raster(
        heights[..., None].astype(np.float32), places.Affine(50, 0, 421_000, 0, -50, 5_156_000), "EPSG:32632"
    )
    terrain = build_mesh(raster, LocalFrame(46.55, 7.98, 0.0, 0.13), mesher="grid")
    terrain, atlas = unwrap(terrain, kind="xatlas", texel_m=40.0, max_side_px=1024)
    assert atlas.charts > 1
    predictors = predictors_for(terrain, atlas, sun_direction=[0.0, -0.7, 0.714])
    assert predictors.grid is not None
    east = predictors.grid.pixel[..., 0] / predictors.grid.width_px
    truth = np.stack([1.0 + east, 2.0 - east, 1.0 + 0.0 * east], -1).astype(np.float32)
    mean, count = to_grid(predictors.grid, truth, predictors.surface)
    back = from_grid(predictors.grid, push_pull(mean, count > 0))
    assert np.nanmax(np.abs(back - truth)[predictors.surface]) < 0.1
    seen = predictors.surface & (np.abs(east - 0.5) > 0.12)
    for method in ("membrane", "telea", "guided"):
        done = complete(painted(truth, seen), predictors, options=CompletionOptions(method))
        hole = predictors.surface & ~seen
        assert np.isfinite(done.values).all()
        assert np.sqrt(np.mean((done.values - truth)[hole] ** 2)) < 0.15, method  # a constant: 0.25 or more


# ---------------------------------------------------------------------------------------------- the verb


@pytest.fixture
def hill(tmp_path, monkeypatch):
    monkeypatch.setenv("SEASONSCAPES_WORKSPACE", str(tmp_path / "work"))
    path = places.write_place(tmp_path / "scene")
    place = load_place(path, Workspace(tmp_path / "work"), options=MeshOptions())
    albedo = scene_albedo(place, None)
    seen = np.ones(albedo.weight.shape, bool)
    seen[30:50, 12:70] = False
    texture = Texture(
        np.where(seen[..., None], 3000.0 * albedo.values, np.nan).astype(np.float32), seen.astype(np.float32)
    )
    save_texture(texture, tmp_path / "painted.npz")
    return path, texture


def test_inpaint_writes_a_texture_and_figures(hill, tmp_path, capsys):
    path, texture = hill
    output = tmp_path / "done.npz"
    command(
        "inpaint",
        path,
        time="2024-09-01T10:00",
        texture=tmp_path / "painted.npz",
        fast=True,
        output=output,
        json=True,
        figures=tmp_path / "fig",
        camera="south",
        size="96x64",
        sky="hosek",
    )
    record = json.loads(capsys.readouterr().out)
    seen = texture.weight > 0.0
    done = load_texture(output)
    np.testing.assert_array_equal(done.values[seen], texture.values[seen])
    np.testing.assert_array_equal(done.weight, texture.weight)
    assert record["filled_share"] == pytest.approx(np.mean(~seen), abs=0.02)
    assert {"satellite_1", "sun", "insolation"} <= set(record["guides"])
    assert record["method"] == "guided"
    assert sorted(p.name for p in (tmp_path / "fig").iterdir()) == [
        "hill_south_after.png",
        "hill_south_before.png",
        "hill_texture_after.png",
        "hill_texture_before.png",
        "hill_texture_sigma.png",
    ]
    # West is reddish on the map, and stays so in the hole.
    assert done.values[40, 15, 0] > 1.5 * done.values[40, 15, 1]
    assert done.values[40, 65, 0] == pytest.approx(done.values[40, 65, 1], rel=0.1)


@pytest.mark.parametrize("method", ["membrane", "telea"])
def test_a_method_that_asks_no_guide_records_none(hill, tmp_path, capsys, method):
    path, _ = hill
    files = {"texture": tmp_path / "painted.npz", "output": tmp_path / "done.npz"}
    command("inpaint", path, time="2024-09-01T10:00", method=method, json=True, **files)
    record = json.loads(capsys.readouterr().out)
    assert (record["method"], record["guides"]) == (method, [])


def test_inpaint_says_what_is_wrong(hill, tmp_path):
    path, texture = hill
    empty, small = tmp_path / "empty.npz", tmp_path / "small.npz"
    save_texture(Texture(texture.values, np.zeros_like(texture.weight)), empty)
    save_texture(Texture(texture.values[:9, :9], texture.weight[:9, :9]), small)
    for options, text in (
        ({"texture": tmp_path / "none.npz"}, "no such file"),
        ({"texture": path}, r"not a texture: no \.npz file"),
        ({"texture": empty}, "no painted texel"),
        ({"texture": small}, "made for another atlas"),
        ({"texture": empty, "method": "magic"}, "unknown method"),
        ({"texture": empty, "detail": 2.0}, "out of range"),
    ):
        with pytest.raises(InputError, match=text):
            command("inpaint", path, time="2024-09-01T10:00", output=tmp_path / "done.npz", **options)
    assert not (tmp_path / "done.npz").exists()
