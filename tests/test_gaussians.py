"""Gaussians: the rasteriser against its twin, the discs against the path tracer, exports through their readers."""

import json
import re
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

torch = pytest.importorskip("torch")

import places  # noqa: E402
from PIL import Image  # noqa: E402
from test_rendering import FRAME, heightfield, looking_down, sun_at  # noqa: E402

from seasonscapes.cameras.camera_models import read_camera_models  # noqa: E402
from seasonscapes.cameras.exchange import NamedView, read_transforms  # noqa: E402
from seasonscapes.cameras.pinhole import Camera, rotation_from_angles  # noqa: E402
from seasonscapes.cli import main  # noqa: E402
from seasonscapes.errors import InputError, NoTerrainInView  # noqa: E402
from seasonscapes.frames import equirectangular_directions  # noqa: E402
from seasonscapes.gaussians.appearance import Appearance, colours_at, fourier_embedding, light_tensors  # noqa: E402
from seasonscapes.gaussians.disc_transport import (  # noqa: E402
    light_state,
    neighbourhood_mean,
    surfel_irradiance,
    trace_disc_transport,
)
from seasonscapes.gaussians.interchange import (  # noqa: E402
    BakedSplats,
    TrainingView,
    read_ply,
    write_gltf,
    write_ply,
    write_training_views,
)
from seasonscapes.gaussians.model import (  # noqa: E402
    GaussianModel,
    bytes_per_gaussian,
    load_model,
    model_from,
    pack_model,
    save_model,
)
from seasonscapes.gaussians.rasterise import (  # noqa: E402
    Splats,
    rasterise,
    rotations,
    set_torch_threads,
    splat_colours,
    splats_from,
    view_weights,
)
from seasonscapes.gaussians.rasterise_cuda import rasterise_cuda  # noqa: E402
from seasonscapes.gaussians.rasterise_reference import rasterise_reference  # noqa: E402
from seasonscapes.gaussians.splat_view import (  # noqa: E402
    SPLAT_LIMITS,
    RasterOptions,
    draw_layers,
    learned_parameters,
    model_colours,
    model_weights,
    render_model,
)
from seasonscapes.gaussians.surfels import axes_from_quaternions, surfel_albedo, terrain_surfels  # noqa: E402
from seasonscapes.gaussians.training import (  # noqa: E402
    Checkpoint,
    Schedule,
    SurfaceTargets,
    TrainingFrame,
    fit_code,
    surface_targets,
    train,
)
from seasonscapes.rendering.hemisphere_rays import ray_scene  # noqa: E402
from seasonscapes.rendering.horizon_angles import horizon_angles  # noqa: E402
from seasonscapes.rendering.irradiance import surface_at  # noqa: E402
from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight  # noqa: E402
from seasonscapes.rendering.radiance import path_trace  # noqa: E402
from seasonscapes.rendering.splatting import splat_layers, upload_splats  # noqa: E402
from seasonscapes.sky.illumination import Illumination, global_horizontal_illuminance  # noqa: E402

set_torch_threads(1)
CAMERA = Camera(24, 20, 26.0, 24.0, 12.5, 9.5, np.eye(4))


def some_splats(count: int, *, seed: int = 0, dtype=torch.float32) -> tuple[Splats, torch.Tensor]:
    rng = np.random.default_rng(seed)
    means = np.stack([rng.uniform(-6, 6, count), rng.uniform(-6, 6, count), rng.uniform(4, 20, count)], axis=1)
    columns = (means, rng.normal(size=(count, 4)), rng.uniform(-2.5, 0.3, (count, 3)), rng.uniform(-2, 4, count))
    return Splats(*(torch.as_tensor(c, dtype=dtype) for c in columns)), torch.as_tensor(
        rng.uniform(0, 1, (count, 3)), dtype=dtype
    )


def test_rasteriser_equals_its_twin():
    splats, colours = some_splats(150)
    image, coverage = rasterise(splats, colours, CAMERA)
    expected, expected_coverage = rasterise_reference(splats, colours, CAMERA)
    assert expected_coverage.max() > 0.9
    assert expected_coverage.min() < 0.5, "the scene must have both"
    assert float((image - expected).abs().max()) < 1e-4
    assert float((coverage - expected_coverage).abs().max()) < 1e-4


@pytest.mark.parametrize("cut", [1.0 / 255.0, 0.0])
def test_gradients_equal_the_twin_s(cut):
    grads = []
    for draw in (rasterise, rasterise_reference):
        splats, colours = some_splats(60, seed=1, dtype=torch.float64)
        leaves = [tensor.clone().requires_grad_() for tensor in (*splats, colours)]
        image, _ = draw(Splats(*leaves[:4]), leaves[4], CAMERA, alpha_cut=cut)
        weight = torch.as_tensor(np.random.default_rng(2).normal(size=tuple(image.shape)))
        (image * weight).sum().backward()
        grads.append([leaf.grad for leaf in leaves])
    for mine, theirs in zip(*grads, strict=True):
        assert float((mine - theirs).norm() / theirs.norm()) < 1e-3


def test_gradients_equal_finite_differences():
    """With the cut off, so that no pixel enters or leaves a splat."""
    splats, colours = some_splats(40, seed=3, dtype=torch.float64)
    rng = np.random.default_rng(4)
    leaves = [tensor.clone().requires_grad_() for tensor in (*splats, colours)]
    weight = torch.as_tensor(rng.normal(size=(20, 24, 3)))

    def value(parts) -> torch.Tensor:
        return (rasterise(Splats(*parts[:4]), parts[4], CAMERA, alpha_cut=0.0)[0] * weight).sum()

    value(leaves).backward()
    for number, leaf in enumerate(leaves):
        step = torch.as_tensor(rng.normal(size=tuple(leaf.shape)))
        sides = [
            value([p.detach() + (1e-6 * sign * step if k == number else 0.0) for k, p in enumerate(leaves)])
            for sign in (1, -1)
        ]
        difference = float(sides[0] - sides[1]) / 2e-6
        assert float((leaf.grad * step).sum()) == pytest.approx(difference, rel=1e-3)


def test_frozen_weights_give_the_same_picture():
    splats, colours = some_splats(150, seed=5)
    weights = view_weights(splats, CAMERA)
    image, coverage = rasterise(splats, colours, CAMERA)
    np.testing.assert_allclose(splat_colours(weights, colours.numpy()), image.numpy(), atol=2e-3)
    np.testing.assert_allclose(weights.coverage, coverage.numpy(), atol=2e-3)


def test_ties_in_depth_keep_their_order():
    """Two splats at one depth: the first one is in front, in both."""
    both = splats_from(
        np.array([[0.0, 0.0, 5.0]] * 2), np.array([[1.0, 0, 0, 0]] * 2), np.zeros((2, 3)), np.full(2, 6.0)
    )
    colours = torch.tensor([[1.0, 0, 0], [0, 1.0, 0]])
    for draw in (rasterise, rasterise_reference):
        red, green, _ = draw(both, colours, CAMERA)[0][9, 12]
        assert red > 0.9 > 0.1 > green


def test_no_splat_in_view_is_an_empty_picture():
    behind = splats_from(np.array([[0.0, 0.0, -5.0]]), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 3)), np.zeros(1))
    image, coverage = rasterise(behind, torch.ones(1, 3), CAMERA)
    assert float(image.abs().max()) == 0.0
    assert float(coverage.max()) == 0.0
    assert view_weights(behind, CAMERA).matrix.nnz == 0


def test_values_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="log_scales: 1 values are not finite"):
        splats_from(np.zeros((1, 3)), np.ones((1, 4)), np.array([[0.0, np.nan, 0.0]]), np.zeros(1))
    with pytest.raises(ValueError, match="one for each splat"):
        rasterise(some_splats(3)[0], torch.ones(2, 3), CAMERA)


@pytest.fixture(scope="module")
def hill():
    """A hill 1 km wide with 24 × 24 discs, its transport, and the renderer's terrain."""
    terrain = heightfield(lambda e, n: 160.0 * np.exp(-(e**2 + (n - 80.0) ** 2) / 180.0**2), count=61)
    surfels = terrain_surfels(terrain, 1000.0 / 24)
    ramp = np.linspace(0.2, 0.6, 32, dtype=np.float32)
    texture = np.stack(
        [np.tile(ramp, (32, 1)), np.full((32, 32), 0.4, np.float32), np.tile(ramp[:, None], (1, 32))], -1
    )
    mesh = mi_mesh(terrain, texture)
    albedo = surfel_albedo(surfels, texture)
    transport = trace_disc_transport(ray_scene(mesh), surfels, albedo, rays=64)
    return terrain, surfels, mesh, albedo, transport


def light(azimuth_deg: float, elevation_deg: float) -> Illumination:
    sky = np.where(equirectangular_directions(32, 64)[..., 2:] > 0.0, np.float32([2000.0, 2600.0, 3600.0]), 0.0)
    return Illumination(sky.astype(np.float32), sun_at(azimuth_deg, elevation_deg, 8e4).sun)


LIGHTS = [light(100.0, 12.0), light(180.0, 40.0), light(250.0, 25.0)]


def appearance(hill, kind: str = "full", *, seed: int = 0, times: int = 3) -> Appearance:
    _, surfels, _, albedo, transport = hill
    around = neighbourhood_mean(surfels.means, albedo, surfels.spacing_m)
    return Appearance(
        kind, albedo[None], around[None], transport, fourier_embedding(surfels.means), times=times, seed=seed
    )


def targets(hill) -> SurfaceTargets:
    _, surfels, mesh, albedo, transport = hill
    states = [light_state(transport, each, 180.0) for each in LIGHTS]
    received = surfel_irradiance(ray_scene(mesh), surfels, LIGHTS, rays=64)
    return surface_targets(states, [0] * len(LIGHTS), albedo[None], received)


@pytest.fixture(scope="module")
def told(hill) -> SurfaceTargets:
    return targets(hill)


def test_discs_lie_on_the_terrain_and_close_it(hill):
    surfels = hill[1]
    assert len(surfels.means) == 24 * 24
    height = 160.0 * np.exp(-(surfels.means[:, 0] ** 2 + (surfels.means[:, 1] - 80.0) ** 2) / 180.0**2)
    assert np.abs(surfels.means[:, 2] - height).max() < 4.0
    turned = axes_from_quaternions(surfels.quaternions.astype(np.float64))
    np.testing.assert_allclose(turned[..., 2], surfels.facing, atol=1e-5)
    # The plane of the mesh, which the smooth normals follow to some hundredths.
    np.testing.assert_allclose(surfels.facing, surfels.normals, atol=0.05)
    splats = splats_from(surfels.means, surfels.quaternions, surfels.log_scales, surfels.opacity_logits)
    coverage = view_weights(splats, looking_down(size=96, view_m=700.0), subpixels=2).coverage
    assert coverage.min() > 0.8


def test_a_plane_in_the_sun_is_lambert_s():
    """Untrained physics on a plane: albedo times horizontal illuminance, sky and sun, in closed form."""
    terrain = heightfield(lambda e, n: 0.0 * e, count=3)
    surfels = terrain_surfels(terrain, 200.0)
    albedo = np.full((len(surfels.means), 3), 0.3, np.float32)
    transport = trace_disc_transport(ray_scene(mi_mesh(terrain, np.full(3, 0.3))), surfels, albedo, rays=256)
    model = Appearance("physical", albedo[None], albedo[None], transport, fourier_embedding(surfels.means))
    state = light_state(transport, LIGHTS[1], 180.0)
    expected = 0.3 * global_horizontal_illuminance(LIGHTS[1]) / state.global_lx
    np.testing.assert_allclose(colours_at(model, state), np.tile(expected, (len(albedo), 1)), rtol=0.02)
    assert transport.open_sky == pytest.approx(1.0, abs=0.02)


def test_untrained_physics_is_near_the_traced_truth(hill, told):
    """Within a tenth of the mean on a hill with cast shadows; without the horizon it is far off."""
    model = appearance(hill, "physical")
    for state, truth in zip(told.states, told.colours, strict=True):
        error = np.sqrt(np.mean((colours_at(model, state) - truth) ** 2)) / truth.mean()
        assert error < 0.1
    traced = colours_at(model, told.states[0])
    model.horizon = torch.zeros_like(model.horizon)
    blind = colours_at(model, told.states[0])
    errors = [np.sqrt(np.mean((guess - told.colours[0]) ** 2)) for guess in (traced, blind)]
    assert errors[1] > 3.0 * errors[0]


def test_horizon_of_a_cliff_is_its_angle():
    """200 m of cliff, 100 m to the west of the places: atan 2 towards it, nothing towards the plain."""
    terrain = heightfield(lambda e, n: np.where(e < -100.0, 200.0, 0.0), side_m=800.0, count=401)
    places = np.array([[0.0, 0.0, 0.0], [0.0, 50.0, 0.0]], np.float32)
    bare = ray_scene(mi_mesh(terrain, np.full(3, 0.3)))
    angle = horizon_angles(bare, surface_at(bare, places)[0])
    assert angle[:, 48] == pytest.approx(np.arctan2(200.0, 102.0), abs=0.01)
    assert angle[:, 16].max() < 0.001


@pytest.mark.parametrize("kind", ["code", "sun", "physical", "full"])
def test_training_lowers_the_loss(hill, told, kind):
    losses = train(appearance(hill, kind), told, (), Schedule(120, 0, batch=512), seed=3)
    assert np.mean(losses[-10:]) < 0.8 * np.mean(losses[:10])


def test_pictures_teach_and_an_interrupted_run_goes_on(hill, told, tmp_path):
    """Stopped after a checkpoint and started again, a run ends in the very same numbers."""
    _, surfels, *_ = hill
    camera = looking_down(size=48, view_m=900.0)
    weights = view_weights(splats_of_surfels(surfels), camera)
    image = splat_colours(weights, told.colours[0]) / np.maximum(weights.coverage, 1e-3)[..., None]
    frames = [TrainingFrame(weights, 0, image, weights.coverage > 0.9)]
    schedule = Schedule(20, 10, batch=256, checkpoint_every=8)
    whole = appearance(hill)
    losses = train(whole, told, frames, schedule, seed=5)
    assert losses[-1] < losses[20]

    class Stop(Exception):
        pass

    def stop_after(share: float) -> None:
        if share > 0.6:
            raise Stop

    path = tmp_path / "run.safetensors"
    checkpoint = Checkpoint(path, "of this sky")
    with pytest.raises(Stop):
        train(appearance(hill), told, frames, schedule, seed=5, checkpoint=checkpoint, progress=stop_after)
    again = appearance(hill, seed=9)
    rest = train(again, told, frames, schedule, seed=5, checkpoint=checkpoint)
    assert len(rest) == 30 - 16
    for one, other in zip(whole.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)
    with pytest.raises(InputError, match="another run; got 'another seed'"):
        train(appearance(hill), told, frames, schedule, seed=6, checkpoint=checkpoint)
    with pytest.raises(InputError, match="another run; got 'another scene, sky or albedo'"):
        train(appearance(hill), told, frames, schedule, seed=5, checkpoint=replace(checkpoint, key="of another sky"))
    content = path.read_bytes()
    for damaged in (content[:100], content[:-7], content[:-99] + b"x" + content[-98:], b"", b"{}"):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="damaged"):
            train(appearance(hill), told, frames, schedule, seed=5, checkpoint=checkpoint)
    assert not [p for p in tmp_path.iterdir() if p != path]


def splats_of_surfels(surfels) -> Splats:
    return splats_from(surfels.means, surfels.quaternions, surfels.log_scales, surfels.opacity_logits)


def test_one_time_and_no_view_are_enough(hill, told):
    model = appearance(hill, times=1)
    once = SurfaceTargets(told.states[:1], [0], told.colours[:1])
    losses = train(model, once, (), Schedule(5, 50, batch=64))
    assert len(losses) == 5
    assert losses[-1] < losses[0]


def test_bad_lessons_and_frames_are_refused(hill, told):
    broken = told.colours.copy()
    broken[1, 7] = np.nan
    with pytest.raises(ValueError, match="3 colours are not finite"):
        SurfaceTargets(told.states, told.seasons, broken)
    with pytest.raises(ValueError, match="0 lights"):
        SurfaceTargets([], [], np.zeros((0, 5, 3)))
    empty = view_weights(splats_of_surfels(hill[1]), under_the_hill())
    with pytest.raises(NoTerrainInView, match="inside the mountain"):
        TrainingFrame(empty, 0, np.zeros((8, 8, 3)), np.ones((8, 8), bool))
    with pytest.raises(ValueError, match="expected light"):
        light_state(hill[4], Illumination(np.zeros((16, 32, 3), np.float32)), 1.0)


@pytest.fixture(scope="module")
def model(hill, told) -> GaussianModel:
    _, surfels, _, albedo, transport = hill
    trained = appearance(hill)
    train(trained, told, (), Schedule(30, 0, batch=256))
    return model_from(
        surfels,
        np.stack([albedo, 0.5 * albedo]),
        [100.0, 200.0],
        transport,
        learned_parameters(trained),
        frame=FRAME,
        note={"seed": 0},
    )


def test_model_survives_its_file(model, tmp_path):
    """Packed into bytes and read back: the same colours within a hundredth, at 168 bytes for each Gaussian."""
    save_model(model, tmp_path / "hill.safetensors")
    again = load_model(tmp_path / "hill.safetensors")
    np.testing.assert_allclose(again.means, model.means, atol=0.01)
    normals = [axes_from_quaternions(each.quaternions)[..., 2] for each in (again, model)]
    np.testing.assert_allclose(*normals, atol=1e-4)
    np.testing.assert_allclose(again.log_scales, model.log_scales, atol=1e-3)
    assert again.frame == model.frame
    assert again.note == {"seed": 0}
    for each in LIGHTS:
        before, after = model_colours(model, each, 100.0)[0], model_colours(again, each, 100.0)[0]
        assert np.sqrt(np.mean((after - before) ** 2)) < 0.01 * before.mean()
    tensors, _ = pack_model(model)
    shared = re.compile(r"appearance\.mlp\.|transport\.(from_sky|\w+_scale)")
    own = sum(values.nbytes for name, values in tensors.items() if not shared.match(name))
    own -= tensors["albedo"].nbytes // 2  # of two dates
    assert bytes_per_gaussian(model) == pytest.approx(own / len(model.means))
    assert bytes_per_gaussian(model) <= 168.5
    (tmp_path / "other.safetensors").write_bytes(b"no")
    with pytest.raises(InputError, match="not a safetensors file"):
        load_model(tmp_path / "other.safetensors")
    with pytest.raises(InputError, match="no such file"):
        load_model(tmp_path / "none.safetensors")


def test_a_picture_has_terrain_air_and_sky(hill, model):
    camera = Camera(64, 48, 70.0, 70.0, 32.0, 24.0, looking_north(-900.0, 250.0))
    view = render_model(model, camera, LIGHTS[1], 100.0)
    assert view.coverage[-1].min() > 0.95
    assert view.coverage[0].max() == 0.0
    np.testing.assert_allclose(view.radiance[0, 0], [2000.0, 2600.0, 3600.0], rtol=0.01)
    assert np.isinf(view.depth[0, 0])
    mesh = hill[2]
    truth, covered = path_trace(relight(mesh, LIGHTS[1]), camera, spp=64)
    solid = (covered > 0.999) & (view.coverage > 0.999)
    assert view.surface[solid].mean() == pytest.approx(truth[solid].mean(), rel=0.03)


def looking_north(north_m: float, height_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(0.0, -10.0)
    pose[:3, 3] = [0.0, north_m, height_m]
    return pose


def under_the_hill() -> Camera:
    """Inside the rock, looking down: all discs lie behind it."""
    camera = looking_down(size=8)
    pose = camera.world_from_camera.copy()
    pose[2, 3] = -500.0
    return replace(camera, world_from_camera=pose)


def test_a_camera_that_sees_nothing_says_so(model):
    with pytest.raises(NoTerrainInView, match="no Gaussian in the camera's view"):
        model_weights(model, under_the_hill())


def baked(hill) -> BakedSplats:
    _, surfels, _, albedo, _ = hill
    return BakedSplats(surfels.means, surfels.quaternions, surfels.log_scales, surfels.opacity_logits, albedo)


def test_ply_is_read_by_mitsuba_to_the_digits(hill, tmp_path):
    import mitsuba as mi

    splats = baked(hill)
    write_ply(tmp_path / "hill.ply", splats)
    again = read_ply(tmp_path / "hill.ply")
    for name in ("means", "quaternions", "log_scales", "opacity_logits"):
        np.testing.assert_array_equal(getattr(again, name), getattr(splats, name))
    np.testing.assert_allclose(again.rgb, splats.rgb, atol=1e-6)
    held = mi.traverse(mi.load_dict({"type": "ellipsoids", "filename": str(tmp_path / "hill.ply")}))
    data = np.array(held["data"]).reshape(-1, 10)
    np.testing.assert_array_equal(data[:, :3], splats.means)
    np.testing.assert_allclose(data[:, 3:6], np.exp(splats.log_scales), rtol=1e-6)
    np.testing.assert_allclose(data[:, 6:], np.roll(splats.quaternions, -1, axis=1), atol=1e-6)
    coefficients = np.array(held["sh_coeffs"]).reshape(len(data), -1)
    np.testing.assert_allclose(coefficients[:, :3] * 0.28209479 + 0.5, splats.rgb, atol=1e-5)


def test_ply_is_read_by_plyfile(hill, tmp_path):
    from plyfile import PlyData

    splats = baked(hill)
    write_ply(tmp_path / "hill.ply", splats)
    vertex = PlyData.read(tmp_path / "hill.ply")["vertex"]
    np.testing.assert_array_equal(vertex["rot_0"], splats.quaternions[:, 0])
    np.testing.assert_array_equal(vertex["opacity"], splats.opacity_logits)
    (tmp_path / "half.ply").write_bytes((tmp_path / "hill.ply").read_bytes()[:-100])
    with pytest.raises(InputError, match="not a whole 3DGS"):
        read_ply(tmp_path / "half.ply")


def test_gltf_is_read_by_pygltflib(hill, tmp_path):
    from pygltflib import GLTF2

    splats = baked(hill)
    write_gltf(tmp_path / "hill.glb", splats)
    document = GLTF2().load(str(tmp_path / "hill.glb"))
    primitive = document.meshes[0].primitives[0]
    assert primitive.mode == 0
    assert primitive.extensions["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    attributes = vars(primitive.attributes)
    accessor = document.accessors[attributes["KHR_gaussian_splatting:ROTATION"]]
    view = document.bufferViews[accessor.bufferView]
    blob = document.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    np.testing.assert_array_equal(np.frombuffer(blob, "<f4").reshape(-1, 4)[:, 3], splats.quaternions[:, 0])
    # The node turns east-north-up into glTF's y-up: up becomes +y, north becomes -z.
    x, y, z, w = document.nodes[0].rotation
    turn = axes_from_quaternions(np.array([[w, x, y, z]]))[0]
    np.testing.assert_allclose(turn @ [0.0, 0.0, 1.0], [0.0, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(turn @ [0.0, 1.0, 0.0], [0.0, 0.0, -1.0], atol=1e-6)


def test_training_views_are_read_back(hill, tmp_path):
    """By the package's own readers of both formats, with time and sun beside each frame."""
    from plyfile import PlyData

    camera = looking_down(size=32)
    time = datetime(2024, 6, 21, 10, 30, tzinfo=UTC)
    state = light_state(hill[4], LIGHTS[0], 173.0)
    views = [TrainingView(NamedView("noon", camera, "images/noon.png", time), state)]
    write_training_views(tmp_path, views, baked(hill), FRAME)
    (again,), frame = read_transforms(tmp_path / "transforms.json")
    assert frame == FRAME
    np.testing.assert_allclose(again.camera.world_from_camera, camera.world_from_camera, atol=1e-9)
    record = json.loads((tmp_path / "transforms.json").read_text())["frames"][0]
    assert record["timestamp_utc"] == "2024-06-21T10:30:00Z"
    np.testing.assert_allclose(record["sun_enu"], LIGHTS[0].sun.direction, atol=1e-6)
    (colmap,) = read_camera_models(tmp_path / "sparse" / "0", "colmap")
    np.testing.assert_allclose(colmap.rotation, camera.world_from_camera[:3, :3], atol=1e-6)
    np.testing.assert_allclose(colmap.position, camera.position_m, atol=1e-6)
    assert len((tmp_path / "sparse" / "0" / "points3D.txt").read_text().splitlines()) == 1 + 24 * 24
    # COLMAP looks for images below a folder that it is given; nerfstudio beside transforms.json.
    assert (again.file, colmap.name) == ("images/noon.png", "noon.png")
    seeds = PlyData.read(tmp_path / "points.ply")
    colours = np.stack([seeds["vertex"][name] for name in ("red", "green", "blue")], axis=1)
    np.testing.assert_allclose(colours / 255.0, baked(hill).rgb, atol=0.51 / 255.0)
    np.testing.assert_array_equal(seeds["vertex"]["z"], baked(hill).means[:, 2])
    origin = next(line for line in seeds.comments if line.startswith("origin "))
    assert json.loads(origin.removeprefix("origin "))["latitude_deg"] == FRAME.latitude_deg
    stray = TrainingView(NamedView("noon", camera, "noon.png", time), state)
    with pytest.raises(ValueError, match="subpath"):
        write_training_views(tmp_path, [stray], baked(hill), FRAME)
    with pytest.raises(ValueError, match="no view"):
        write_training_views(tmp_path, [], baked(hill), FRAME)


def test_cuda_says_what_is_missing():
    if torch.cuda.is_available():
        pytest.skip("a CUDA device is here: nothing is missing")
    with pytest.raises(InputError, match="no CUDA device found"):
        rasterise_cuda(*some_splats(3), CAMERA)


@pytest.fixture(scope="module")
def distilled(tmp_path_factory):
    """The hill of the tests' places, distilled from the command line in seconds."""
    folder = tmp_path_factory.mktemp("distil")
    scene, model = places.write_place(folder / "scene"), folder / "hill.safetensors"
    common = ["--sky", "hosek", "--workspace", str(folder / "work")]
    small = ["--discs", "24", "--suns", "4", "--views", "1", "--view-px", "32", "--steps", "30", "--picture-steps", "4"]
    exported = ["--export-views", str(folder / "views")]
    assert main(["distill", str(scene), "-o", str(model), *small, *exported, *common]) == 0
    return scene, model, common


def test_distill_leaves_a_model_and_views(distilled):
    _, model, _ = distilled
    made = load_model(model)
    assert made.note["scene"] == "hill"
    assert not model.with_suffix(".checkpoint.safetensors").exists()
    views, _ = read_transforms(model.parent / "views" / "transforms.json")
    # Four hours from the scene's camera and from the one around the terrain.
    assert len(views) == 8
    assert made.level.max() > 0
    assert all((model.parent / "views" / view.file).is_file() for view in views)


@pytest.mark.parametrize("suffix", ["png", "exr", "ply", "glb"])
def test_splat_writes_what_is_asked_for(distilled, suffix, capsys):
    scene, model, common = distilled
    output = model.parent / f"noon.{suffix}"
    arguments = ["splat", str(scene), "--model", str(model), "--time", "2024-09-01T12:00", "-o", str(output)]
    size = ["--size", "64x48"] if suffix in ("png", "exr") else []
    assert main([*arguments, *size, "--json", *common]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["time_utc"] == "2024-09-01T10:00:00+00:00"
    content = output.read_bytes()
    assert len(content) > 1000
    assert str(model.parent).encode() not in content, "no path of the maker's disk"
    if suffix in ("ply", "glb"):
        assert b'"latitude_deg": 46.5' in content or b'"latitude_deg":46.5' in content, "the origin"
    if suffix == "png":
        pixels = np.asarray(Image.open(output), float)
        assert pixels[:4].mean(axis=(0, 1))[2] > pixels[:4].mean(axis=(0, 1))[0], "the sky is blue"
        assert pixels[-8:].mean(axis=(0, 1))[0] > pixels[-8:].mean(axis=(0, 1))[2], "the ground is not"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--model", "none.safetensors"], "no such file"),
        (["--device", "tpu"], "unknown device"),
        (["-o", "a.jpg"], "unknown kind of file"),
        (["--at", "46.551,7.98,800", "--heading", "0"], "stands below the ground"),
        (["--at", "46.551,7.98,+3000", "--heading", "0", "--pitch", "80"], "no Gaussian in the camera's view"),
    ],
)
def test_splat_says_what_is_wrong(distilled, arguments, said, capsys):
    scene, model, common = distilled
    given = {"--model": str(model), "-o": str(model.parent / "a.png")}
    given |= {flag: value for flag, value in zip(arguments[::2], arguments[1::2], strict=True) if flag in given}
    rest = [word for pair in zip(arguments[::2], arguments[1::2], strict=True) if pair[0] not in given for word in pair]
    flags = [word for pair in given.items() for word in pair]
    assert main(["splat", str(scene), "--time", "2024-09-01T12:00", "--size", "32x24", *flags, *rest, *common]) == 2
    assert said in capsys.readouterr().err


def test_distill_says_what_is_wrong(tmp_path, capsys):
    scene = places.write_place(tmp_path)
    for arguments, said in (
        (["--kind", "magic"], "unknown kind"),
        (["--suns", "0"], "out of range"),
        (["--views", "0", "--export-views", "x"], "no views to export"),
    ):
        assert main(["distill", str(scene), *arguments]) == 2
        assert said in capsys.readouterr().err


def test_a_free_code_is_found_for_a_new_picture(hill, told):
    """WildGaussians' protocol: after fitting, the picture is nearer than with the code of another time."""
    trained = appearance(hill, "code")
    train(trained, told, (), Schedule(80, 0, batch=512), seed=1)
    weights = view_weights(splats_of_surfels(hill[1]), looking_down(size=32, view_m=900.0))
    image = splat_colours(weights, told.colours[0]) / np.maximum(weights.coverage, 1e-3)[..., None]
    lights = light_tensors(told.states)
    code = fit_code(trained, lights, TrainingFrame(weights, 0, image, weights.coverage > 0.9), steps=30)
    with torch.no_grad():
        errors = [
            float(
                (trained(torch.arange(576), torch.tensor(0), lights, one) - torch.as_tensor(told.colours[0]))
                .abs()
                .mean()
            )
            for one in (code, trained.codes[2])
        ]
    assert errors[0] < 0.8 * errors[1]


def test_fast_splatting_draws_the_same_picture():
    """On the renderer's device; what the opacity cut leaves out may differ by rounding, four thousandths at most."""
    splats, colours = some_splats(150, seed=6)
    axes = rotations(splats.quaternions) * splats.log_scales.exp()[:, None, :]
    ready = upload_splats(splats.means.numpy(), axes.numpy(), torch.sigmoid(splats.opacity_logits).numpy())
    expected, covered = rasterise_reference(splats, colours, CAMERA)
    image, coverage = splat_layers(ready, colours.numpy(), CAMERA, SPLAT_LIMITS._replace(one_sided=False))
    assert image.shape == (20, 24, 3)
    assert np.abs(image - expected.numpy()).max() < 4.5e-3
    assert np.abs(image - expected.numpy()).mean() < 1e-4
    np.testing.assert_allclose(coverage, covered.numpy(), atol=4.5e-3)


def test_backs_of_discs_are_not_drawn(hill, model):
    """From above, with and without: the same picture; from below, none."""
    camera = looking_down(size=48, view_m=900.0)
    layers = model.albedo[0]
    image, _ = draw_layers(model, camera, layers, RasterOptions(subpixels=2))
    weights = view_weights(splats_of_surfels(hill[1]), camera, subpixels=2)
    np.testing.assert_allclose(image, splat_colours(weights, layers), atol=0.01)
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.0, -800.0]
    with pytest.raises(NoTerrainInView, match="no Gaussian in the camera's view"):
        draw_layers(model, replace(camera, world_from_camera=pose), layers, RasterOptions(subpixels=1))
