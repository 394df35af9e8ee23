"""Discs refined from pictures: what is learned, that files and interrupted runs keep it, and who is refused."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from test_gaussians import LIGHTS, appearance, hill, told  # noqa: E402, F401 (fixtures)
from test_rendering import FRAME, looking_down  # noqa: E402

from seasonscapes.cli import main  # noqa: E402
from seasonscapes.gaussians.appearance import colours_at  # noqa: E402
from seasonscapes.gaussians.disc_geometry import DiscGeometry, normalised_picture, uncovered_loss  # noqa: E402
from seasonscapes.gaussians.losses import TrainingFrame  # noqa: E402
from seasonscapes.gaussians.model import bytes_per_gaussian, load_model, model_from, save_model  # noqa: E402
from seasonscapes.gaussians.rasterise import splat_colours, view_weights  # noqa: E402
from seasonscapes.gaussians.splat_view import learned_parameters, splats_of  # noqa: E402
from seasonscapes.gaussians.surfels import CHANGES, axes_from_quaternions, changed_discs  # noqa: E402
from seasonscapes.gaussians.training import Checkpoint, Schedule, SurfaceTargets, train  # noqa: E402
from seasonscapes.gaussians.training_views import front_facing_splats, relit_frames  # noqa: E402
from seasonscapes.rendering.hemisphere_rays import ray_scene  # noqa: E402

SCHEDULE = Schedule(60, 40, batch=512)


def cameras(size: int = 40) -> list:
    """Three views from above: two to learn from, and one between them."""
    views = [looking_down(size=size, view_m=850.0) for _ in range(3)]
    poses = [view.world_from_camera.copy() for view in views]
    for pose, east_m in zip(poses, (-260.0, 260.0, 0.0), strict=True):
        # Moved aside along a circle about the middle of the hill, and turned towards it.
        height = pose[2, 3]
        angle = np.arcsin(east_m / height)
        turn = np.array([[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]])
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] = [east_m, pose[1, 3], height * np.cos(angle)]
    return [replace(view, world_from_camera=pose) for view, pose in zip(views, poses, strict=True)]


@pytest.fixture(scope="module")
def pictures(hill, told):  # noqa: F811
    """Frames of all three cameras at all three lights."""
    _, surfels, mesh, *_ = hill
    lights = [(number, light, told.states[number]) for number, light in enumerate(LIGHTS)]
    return relit_frames(ray_scene(mesh), surfels, cameras(), lights)


@pytest.fixture(scope="module")
def refined(hill, told, pictures):  # noqa: F811
    """Trained on two cameras at two of the lights."""
    found = appearance(hill)
    found.refine(DiscGeometry(hill[1]))
    train(found, _two(told), _lessons(pictures), SCHEDULE, seed=3)
    return found


def _two(told) -> SurfaceTargets:  # noqa: F811
    return SurfaceTargets(told.states[:2], [0, 0], told.colours[:2])


def _lessons(pictures) -> list[TrainingFrame]:
    return [frame for number, frame in enumerate(pictures[:6]) if number % 3 < 2]


def _error(trained, hill, told, frame) -> float:  # noqa: F811
    """Mean square error of a picture drawn with an appearance's own discs."""
    camera = frame.camera
    with torch.no_grad():
        splats = trained.geometry.splats(camera) if trained.geometry else front_facing_splats(hill[1], camera)
    weights = view_weights(splats, camera, subpixels=2)
    drawn = splat_colours(weights, colours_at(trained, told.states[frame.time]))
    drawn = drawn / np.maximum(weights.coverage, 1e-3)[..., None]
    return float(np.mean((drawn - frame.image)[frame.mask] ** 2))


def test_refined_discs_draw_what_fixed_ones_cannot(hill, told, pictures, refined):  # noqa: F811
    """At a light that was never seen: the views that were learned from, and one that was not."""
    fixed = appearance(hill)
    train(fixed, _two(told), _lessons(pictures), SCHEDULE, seed=3)
    unseen_light, unseen_view = [pictures[2], pictures[5]], [pictures[8]]
    for frames, share in ((unseen_light, 0.8), (unseen_view, 0.95)):
        better = np.mean([_error(refined, hill, told, frame) for frame in frames])
        worse = np.mean([_error(fixed, hill, told, frame) for frame in frames])
        assert better < share * worse


def test_refinement_leaves_no_holes(pictures, refined):
    for frame in pictures[2::3]:
        weights = view_weights(refined.geometry.splats(frame.camera), frame.camera, subpixels=2)
        assert np.quantile(weights.coverage[frame.mask], 0.02) > 0.75
    bare, full = torch.zeros(4, 4), torch.ones(4, 4)
    mask = torch.ones(4, 4, dtype=torch.bool)
    assert float(uncovered_loss(full, mask)) == 0.0
    assert float(uncovered_loss(bare, mask)) > 1.0


def test_changes_are_the_same_in_torch_in_numpy_and_on_disk(hill, refined, tmp_path):  # noqa: F811
    _, surfels, _, albedo, transport = hill
    for name, (_, limit) in CHANGES.items():
        values = getattr(refined.geometry, name)
        assert 0.0 < float(values.detach().abs().max()) <= limit
    model = model_from(surfels, albedo[None], [100.0], transport, learned_parameters(refined), frame=FRAME)
    camera = cameras()[0]
    with torch.no_grad():
        expected = refined.geometry.splats(camera)
    for mine, theirs in zip(splats_of(model, viewpoint_m=camera.position_m), expected, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=2e-4)
    changes = {name: getattr(refined.geometry, name).detach().numpy() for name in CHANGES}
    assert np.abs(changed_discs(surfels.means, surfels.facing, 1.0, changes)[0] - surfels.means).max() < 0.9
    save_model(model, tmp_path / "hill.safetensors")
    again = load_model(tmp_path / "hill.safetensors")
    # Axes of level discs are those of noise in the normal: the file must keep the ellipses, not their coordinates.
    np.testing.assert_allclose(again.means, model.means, atol=0.01 * surfels.grid.spacing_m)
    for one, other in zip(_covariances(again), _covariances(model), strict=True):
        assert np.abs(one - other).max() < 0.03 * np.abs(other).max()
    np.testing.assert_allclose(again.opacity_logits, model.opacity_logits, atol=0.05)
    assert bytes_per_gaussian(model) < 176.0
    with pytest.raises(ValueError, match="log_scales do not follow"):
        save_model(replace(model, log_scales=model.log_scales + 0.1), tmp_path / "other.safetensors")


def _covariances(model) -> np.ndarray:
    axes = axes_from_quaternions(model.quaternions) * np.exp(model.log_scales)[:, None, :]
    return axes @ axes.swapaxes(1, 2)


def test_an_interrupted_refinement_goes_on(hill, told, pictures, tmp_path):  # noqa: F811
    class Stop(Exception):
        pass

    def stop_after(share: float) -> None:
        if share > 0.6:
            raise Stop

    lessons, schedule = _lessons(pictures), Schedule(6, 8, batch=128, checkpoint_every=5)

    def fresh(seed: int = 0):
        found = appearance(hill, seed=seed)
        found.refine(DiscGeometry(hill[1]))
        return found

    whole, again, checkpoint = fresh(), fresh(9), Checkpoint(tmp_path / "run.safetensors", "key")
    train(whole, _two(told), lessons, schedule, seed=5)
    with pytest.raises(Stop):
        train(fresh(), _two(told), lessons, schedule, seed=5, checkpoint=checkpoint, progress=stop_after)
    assert len(train(again, _two(told), lessons, schedule, seed=5, checkpoint=checkpoint)) == 14 - 5
    for one, other in zip(whole.parameters(), again.parameters(), strict=True):
        assert torch.equal(one, other)


def test_gradients_reach_every_change(hill):  # noqa: F811
    geometry, camera = DiscGeometry(hill[1]), cameras(24)[0]
    colours = torch.as_tensor(np.random.default_rng(0).uniform(0, 1, (len(hill[1].means), 3)).astype(np.float32))
    picture, _ = normalised_picture(geometry.splats(camera), colours, camera)
    (picture * torch.linspace(0.0, 1.0, picture.numel()).reshape(picture.shape)).sum().backward()
    for name in CHANGES:
        assert float(getattr(geometry, name).grad.abs().sum()) > 0.0


def test_who_cannot_refine_is_told(hill, told, pictures, capsys):  # noqa: F811
    found = appearance(hill)
    found.refine(DiscGeometry(hill[1]))
    nameless = [replace(frame, camera=None) for frame in _lessons(pictures)]
    with pytest.raises(ValueError, match="names no camera"):
        train(found, _two(told), nameless, SCHEDULE)
    for flags in (("--views", "0"), ("--picture-steps", "0")):
        assert main(["distill", "alpine_small", "--refine-discs", *flags]) == 2
        assert "--refine-discs" in capsys.readouterr().err


def test_fixed_discs_stay_as_they_are(hill):  # noqa: F811
    _, surfels, *_ = hill
    fixed = np.arange(len(surfels.means)) % 3 == 0
    geometry = DiscGeometry(surfels, fixed)
    with torch.no_grad():
        for name in CHANGES:
            getattr(geometry, name).fill_(-100.0)
    geometry.keep_within_limits()
    for name, (_, limit) in CHANGES.items():
        changes = getattr(geometry, name).detach().numpy()
        assert (changes[fixed] == 0.0).all()
        assert (changes[~fixed] == -np.float32(limit)).all()
