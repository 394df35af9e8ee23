"""Photographs are painted where they see, nowhere else, and agree."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
import pytest
from oracles_visibility import BinnedTriangles
from test_rendering import heightfield

from seasonscapes.cameras.observation import Observation
from seasonscapes.cameras.pinhole import Camera, project, rotation_from_angles
from seasonscapes.errors import NoUsablePixels
from seasonscapes.evaluation.webcam_faults import (
    CLEAN,
    SEVERE,
    TYPICAL,
    PoseSigmas,
    WebcamFaults,
    add_foreground,
    degrade,
    perturb_pose,
    undo_development,
)
from seasonscapes.images import linear_from_srgb, srgb_from_linear
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh
from seasonscapes.terrain.atlas import measure_atlas
from seasonscapes.terrain.surface import load_texture, sample_texture
from seasonscapes.terrain.texels import texel_positions
from seasonscapes.terrain.unwrap import unwrap
from seasonscapes.texturing.atlas_tiles import tile_surface, tiles_of, tiling
from seasonscapes.texturing.camera_overlaps import CameraSamples
from seasonscapes.texturing.foreground import cross_validated_prediction, foreground_mask
from seasonscapes.texturing.inputs import PaintingInput, prepare_input, sample_input
from seasonscapes.texturing.painting import PaintOptions, PaintTarget, paint_atlas, paint_tile, prepare_inputs
from seasonscapes.texturing.painting_file import load_painting, save_painting, write_figures
from seasonscapes.texturing.radiometric_fit import (
    RadiometricFit,
    RadiometricReference,
    _by_gain,
    _linearise,
    _log_surface,
    fit_radiometry,
    invert_contrast,
    radiance_at_surface,
)
from seasonscapes.texturing.silhouette import depth_jumps, pose_sigma_px, silhouette_guard
from seasonscapes.texturing.texel_weights import sharpened, texel_weight
from seasonscapes.texturing.visibility import project_texels, visible_by_depth, visible_by_faces, visible_by_ray
from seasonscapes.workflows.painting import painting_record

NOON = datetime(2024, 9, 1, 12, tzinfo=UTC)
SKY = np.array([3000.0, 4000.0, 6000.0])


def camera_towards(position, target, *, size=(160, 120), fov_deg=60.0) -> Camera:
    """A camera at a place that looks at another."""
    offset = np.subtract(target, position, dtype=float)
    heading = np.degrees(np.arctan2(offset[0], offset[1]))
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(heading, np.degrees(np.arctan2(offset[2], np.hypot(*offset[:2]))))
    pose[:3, 3] = position
    focal = 0.5 * size[0] / np.tan(np.radians(fov_deg) / 2.0)
    return Camera(*size, focal, focal, size[0] / 2.0, size[1] / 2.0, pose)


class Land:
    """A terrain with its atlas and radiance (any smooth pattern), and pictures of it without any light transport."""

    def __init__(self, height, *, count=121, side_m=1200.0, texel_m=5.0):
        self.terrain, self.atlas = unwrap(heightfield(height, count=count, side_m=side_m), texel_m=texel_m)
        self.ray_scene = ray_scene(mi_mesh(self.terrain, np.full(3, 0.3)))
        self.target = PaintTarget(self.terrain, self.atlas, self.ray_scene)
        self.cut = tiling(self.terrain, self.atlas)
        place, _ = texel_positions(self.terrain, self.atlas.width_px, self.atlas.height_px)
        e, n = place[..., 0], place[..., 1]
        pattern = np.stack([1.5 + np.sin(e / 60.0), 1.5 + np.cos(n / 45.0), 1.5 + np.sin((e + n) / 80.0)], axis=-1)
        self.radiance = (1500.0 * np.nan_to_num(pattern)).astype(np.float32)

    def look(self, camera):
        """The G-buffer of a camera."""
        return trace_gbuffer(RenderScene(self.ray_scene.mi_scene, self.ray_scene.mi_terrain), camera)

    def picture(self, camera, air=None) -> np.ndarray:
        """Radiance at a camera, through the air, against a sky of one colour."""
        buffer = self.look(camera)
        land = np.nan_to_num(sample_texture(self.radiance, buffer.uv))
        if air is not None:
            transmittance, airlight = air(
                np.where(np.isfinite(buffer.depth), buffer.depth, 1.0), np.zeros((*land.shape,))
            )
            land = land * transmittance + airlight
        return np.where(np.isfinite(buffer.depth)[..., None], land, SKY).astype(np.float32)

    def item(self, camera, name, *, gains=1e-4, faults=None, seed=0, air=None, foreground=False) -> PaintingInput:
        """What a webcam would deliver: with fixed gains, or with faults."""
        radiance = self.picture(camera, air)
        if foreground:
            radiance, _ = add_foreground(radiance, np.random.default_rng(seed))
        if faults is None:
            image = np.clip(radiance * gains, 0.0, 1.0).astype(np.float32)
        else:
            image = linear_from_srgb(degrade(radiance, faults, np.random.default_rng(seed))[0] / np.float32(255.0))
        return PaintingInput(Observation(image, np.ones(image.shape[:2], bool), camera, NOON, name), air)

    def paint(self, inputs, **options):
        """Painted with no near limit."""
        return paint_atlas(inputs, self.target, options=PaintOptions(near_m=1.0, **options))


def hills(e, n):
    return 60.0 * np.cos(e / 90.0) + 40.0 * np.sin(n / 70.0) + 15.0 * np.sin((e + 2.0 * n) / 31.0)


@pytest.fixture(scope="module")
def land():
    return Land(hills)


@pytest.fixture(scope="module")
def cameras():
    places = [(-500.0, -450.0, 170.0), (450.0, -500.0, 190.0), (0.0, 550.0, 150.0)]
    return [camera_towards(place, (0.0, 0.0, 0.0)) for place in places]


@pytest.fixture(scope="module")
def overlapping():
    places = [(-500.0, -450.0, 270.0), (450.0, -500.0, 250.0), (0.0, -900.0, 350.0)]
    return [camera_towards(place, (0.0, 0.0, 40.0), size=(320, 240)) for place in places]


def clear_air(depth_m, direction):
    """Koschmieder's law: what the air takes it gives back in the sky's colour; the sky itself at infinity."""
    transmittance = np.exp(-np.asarray(depth_m)[..., None] * np.array([2e-4, 2.5e-4, 4e-4]))
    return transmittance, (1.0 - transmittance) * SKY


def thick_air(depth_m, direction):
    return clear_air(3.0 * np.asarray(depth_m), direction)


# --- what is seen ----------------------------------------------------------------------------------------------------


def test_rays_agree_with_a_scalar_oracle(land, cameras):
    surface = tile_surface(land.cut, next(tiles_of(land.cut)))
    oracle, rng = BinnedTriangles(land.terrain.vertices, land.terrain.faces, bins=40), np.random.default_rng(5)
    for camera in cameras:
        sight = project_texels(camera, surface)
        inside, grazing = np.flatnonzero(sight.inside), np.flatnonzero(sight.inside & (sight.cosine < 0.2))
        some = np.concatenate([rng.permutation(inside)[:200], rng.permutation(grazing)[:100]])
        truth = oracle.sees(surface.position_m[some], surface.face[some], camera.position_m)
        seen = visible_by_ray(land.ray_scene, camera, surface[some], sight[some])
        assert 0.2 < truth.mean() < 0.98, "the sample must hold seen and hidden texels"
        assert np.count_nonzero(seen & ~truth) <= 0.001 * seen.sum()
        assert np.count_nonzero(seen & truth) >= 0.995 * truth.sum()


def test_other_visibility_tests_are_worse(land, cameras):
    """Depth maps and faces leak or lose: that is why rays are cast."""
    surface = tile_surface(land.cut, next(tiles_of(land.cut)))
    wrong = {"depth": 0, "faces": 0}
    for camera in cameras:
        sight = project_texels(camera, surface)
        truth = visible_by_ray(land.ray_scene, camera, surface, sight)
        wrong["depth"] += np.count_nonzero(visible_by_depth(land.look(camera).depth, sight) != truth)
        wrong["faces"] += np.count_nonzero(visible_by_faces(land.ray_scene, camera, surface, sight) != truth)
    assert min(wrong.values()) > 500


def test_two_ridges_leak_nothing():
    """Behind a knife-edge ridge a texel is seen exactly where the straight line clears the crest."""
    slope = 0.5

    def height(e, n):
        return np.maximum(0.0, 100.0 - slope * np.abs(n + 100.0)) + np.maximum(0.0, 160.0 - slope * np.abs(n - 400.0))

    ridges = Land(height)
    eye = np.array([0.0, -550.0, 120.0])
    painting = ridges.paint(
        [ridges.item(camera_towards(eye, (0.0, 400.0, 80.0), fov_deg=80.0), "south")], guard=False, fit_gains=False
    )
    place, _ = texel_positions(ridges.terrain, ridges.atlas.width_px, ridges.atlas.height_px)
    n, z = place[..., 1].astype(float), place[..., 2].astype(float)
    # The line of sight in the profile at the height of the first crest, n = -100, and of the second, n = 400.
    clear = np.ones(n.shape, bool)
    for crest_n, crest_z in ((-100.0, 100.0), (400.0, 160.0)):
        beyond = n > crest_n + 1e-3
        share = (crest_n - eye[1]) / np.where(beyond, n - eye[1], 1.0)
        clear &= ~(beyond & (eye[2] + share * (z - eye[2]) < crest_z - 0.05))
    facing = np.abs(place[..., 0]) < 560.0
    painted = painting.texture.weight > 0.0
    assert np.count_nonzero(painted & ~clear) == 0
    assert np.count_nonzero(~clear & facing) > 2000, "much must be hidden"
    assert painted.mean() > 0.2


def test_painted_view_projects_back_into_its_own_camera():
    fine = Land(hills, texel_m=1.25)
    camera = camera_towards((-250.0, -650.0, 260.0), (0.0, 0.0, 0.0), size=(320, 240))
    painting = fine.paint([fine.item(camera, "south")], fit_gains=False)
    buffer = fine.look(camera)
    sound = sample_texture((painting.texture.weight > 0)[..., None].astype(np.float32), buffer.uv)[..., 0] > 0.999
    gain_of = np.exp(painting.radiometry.log_gain[0])
    back = srgb_from_linear(np.clip(gain_of * sample_texture(painting.texture.values, buffer.uv)[sound], 0, 1))
    seen = srgb_from_linear(1e-4 * fine.picture(camera)[sound])
    assert sound.mean() > 0.4
    assert -10.0 * np.log10(np.mean((back - seen) ** 2)) > 35.0


# --- what is trusted --------------------------------------------------------------------------------------------------


def test_guard_rises_from_silhouettes():
    depth = np.full((40, 60), 1000.0)
    depth[:, 30:] = 3000.0
    depth[:5] = np.inf
    assert set(np.flatnonzero(depth_jumps(depth)[20])) == {29, 30}
    sharp, soft = silhouette_guard(depth), silhouette_guard(depth, 4.0)
    assert (sharp[:5] == 0.0).all()
    assert sharp[20, 29] == 0.0
    assert sharp[20, 32] == 1.0
    row = soft[20, 30:40]
    assert all(a < b for a, b in pairwise(row[:7])), "1 + 1.5 sigma = 7 px"
    assert row[8] == 1.0


def test_guard_is_as_wide_as_the_pose_is_unsure():
    camera = camera_towards((0, 0, 0), (0, 100, 0), size=(1000, 800))
    depth = np.array([[100.0, 10_000.0]])
    assert pose_sigma_px(camera, {}, depth).max() == 0.0
    turned = pose_sigma_px(camera, {"heading_deg": 0.1, "tilt_deg": 0.1}, depth)
    np.testing.assert_allclose(turned, np.radians(0.1) * camera.fx, rtol=1e-9)
    moved = pose_sigma_px(camera, {"east_m": 2.0}, depth)
    np.testing.assert_allclose(moved, [[camera.fx * 0.02, camera.fx * 0.0002]], rtol=1e-9)


def test_weights_are_what_the_formula_says():
    np.testing.assert_allclose(texel_weight(np.array([1.0, 0.5, -0.2]), np.array([1.5, 0.75, 3.0])), [1.0, 0.125, 0.0])
    assert sharpened(np.array([0.5])) == pytest.approx(0.0625)


def test_a_texel_larger_than_pixels_gets_their_mean(land, cameras):
    noise = np.random.default_rng(0).uniform(0.1, 0.9, (120, 160, 3)).astype(np.float32)
    item = PaintingInput(Observation(noise, np.ones((120, 160), bool), cameras[0], NOON, "noisy"))
    ready = prepare_input(item, land.ray_scene, land.cut, near_m=0.0)
    usable = ready.levels[0][..., 3]
    row, column = np.argwhere(np.lib.stride_tricks.sliding_window_view(usable, (8, 8)).all(axis=(2, 3)))[0] // 8 * 8 + 8
    value, confidence = sample_input(ready, np.array([[column + 4.0, row + 4.0]]), np.array([8.0]))
    around = noise[row : row + 8, column : column + 8].mean(axis=(0, 1))
    np.testing.assert_allclose(value[0], around, atol=0.06)
    # Of 64 pixels those count that are neither too dark nor too bright to be trusted; the noise has both.
    trusted = ready.levels[0][row : row + 8, column : column + 8, 4].mean()
    assert 0.0 < trusted < 1.0
    assert confidence[0] == pytest.approx(trusted, abs=1e-6)


# --- agreement --------------------------------------------------------------------------------------------------------


def test_gains_and_haze_are_recovered(land, overlapping):
    gains = np.array([[1.0, 1.0, 1.0], [1.9, 1.6, 1.2], [0.6, 0.7, 0.8]]) * 5e-5
    inputs = [
        land.item(c, f"cam-{k}", gains=g, air=thick_air)
        for k, (c, g) in enumerate(zip(overlapping, gains, strict=True))
    ]
    ready, _ = prepare_inputs(inputs, land.ray_scene, land.cut, PaintOptions(near_m=1.0))
    found = fit_radiometry(ready, land.ray_scene, fit_contrast=False)
    np.testing.assert_allclose(found.log_gain, np.log(gains), atol=0.06)
    assert found.haze == pytest.approx(1.0, abs=0.1)
    assert found.scatter_after < 0.04 < found.scatter_before

    def more(depth_m, direction):
        return thick_air(1.4 * np.asarray(depth_m), direction)

    ready, _ = prepare_inputs(
        [replace(item, air=more) for item in inputs], land.ray_scene, land.cut, PaintOptions(near_m=1.0)
    )
    assert fit_radiometry(ready, land.ray_scene, fit_contrast=False).haze == pytest.approx(1.0 / 1.4, abs=0.1)


def test_without_sky_the_airlight_has_the_gain_of_the_surface(land, overlapping):
    gains = np.array([1.3, 1.0, 0.6]) * 5e-5
    item = land.item(overlapping[2], "valley", gains=gains, air=thick_air)
    ground = np.isfinite(land.look(overlapping[2]).depth)
    item = replace(item, observation=replace(item.observation, mask=ground))
    ready, _ = prepare_inputs([item], land.ray_scene, land.cut, PaintOptions(near_m=1.0))
    assert np.isnan(ready[0].sky_value).all()
    reference = RadiometricReference(land.radiance, 0.2)
    found = fit_radiometry(ready, land.ray_scene, reference=reference, fit_contrast=False)
    np.testing.assert_allclose(found.log_gain, [np.log(gains)], atol=0.06)
    assert found.haze == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("contrast", [1.0, 1.5])
@pytest.mark.parametrize("sees_sky", [True, False])
def test_log_radiance_changes_with_the_gain_as_its_derivative_says(sees_sky, contrast):
    rng = np.random.default_rng(3)
    count = 40
    air = rng.uniform(0.3, 0.9, (count, 3)), rng.uniform(200.0, 900.0, (count, 3))
    samples = CameraSamples(np.zeros(count, int), rng.uniform(0.2, 0.8, (count, 3)), *air)
    fit = RadiometricFit(np.full((1, 3), np.log(2e-4)), np.full((1, 3), np.log(1.5e-4)), np.array([contrast]))

    def log_radiance(log_gain):
        airlight = fit.log_sky_gain + (0.0 if sees_sky else log_gain)
        return _log_surface(samples, replace(fit, log_sky_gain=airlight))[0] - log_gain

    measured = (log_radiance(5e-3) - log_radiance(-5e-3)) / 1e-2
    told = _by_gain(np.array([sees_sky]), samples.camera, _linearise(samples, fit))
    # Where hardly any surface is left in the value, its share is clipped.
    clear = np.abs(measured) < 5.0
    assert clear.mean() > 0.7
    np.testing.assert_allclose(told[clear], measured[clear], rtol=0.05)


def test_the_record_of_a_single_camera_is_json(land, cameras):
    record = json.loads(json.dumps(painting_record(land.paint([land.item(cameras[0], "alone")])), allow_nan=False))
    assert record["overlaps"] == 0
    assert record["scatter_before"] is None
    assert 0.0 < record["painted_share"] < 1.0


def test_air_is_subtracted_exactly_when_all_is_known():
    land_value = np.array([[800.0, 900.0, 400.0]])
    transmittance, airlight = clear_air(np.array([500.0]), None)
    picture = np.array([2e-4, 1.5e-4, 1e-4]) * (land_value * transmittance + airlight)
    gains = np.log(np.array([[2e-4, 1.5e-4, 1e-4]]))
    radiance, share = radiance_at_surface(
        picture, 0, (transmittance, airlight), RadiometricFit(gains, gains, np.ones(1))
    )
    np.testing.assert_allclose(radiance, land_value, rtol=1e-4)
    np.testing.assert_allclose(
        share, (land_value * transmittance / (land_value * transmittance + airlight)).min(), rtol=1e-4
    )


def test_straightening_is_monotone_and_keeps_the_middle():
    value = np.linspace(0.0, 1.0, 201)
    for contrast in (0.8, 1.0, 1.4):
        straight = invert_contrast(value, contrast)
        assert (np.diff(straight) >= 0.0).all()
        assert straight[0] == 0.0
        assert straight[-1] == pytest.approx(1.0)
    np.testing.assert_allclose(invert_contrast(value, 1.0), value, atol=1e-5)
    middle = linear_from_srgb(np.array([0.5]))
    np.testing.assert_allclose(invert_contrast(middle, 1.5), middle, rtol=1e-4)


def test_harmonising_helps_under_webcam_faults(land, overlapping):
    faults = replace(TYPICAL, tone_strength=0.2)
    inputs = [land.item(c, f"cam-{k}", faults=faults, seed=k, air=clear_air) for k, c in enumerate(overlapping)]
    error = {}
    for fit in (False, True):
        painting = land.paint(inputs, fit_gains=fit)
        painted = painting.texture.weight > 0.0
        ratio = np.log(painting.texture.values[painted] / land.radiance[painted])
        error[fit] = np.std(ratio - np.median(ratio, axis=0))
    assert error[True] < 0.85 * error[False]


# --- order, tiles, edges ----------------------------------------------------------------------------------------------


def same(a, b):
    return (
        np.array_equal(a.texture.values, b.texture.values)
        and np.array_equal(a.texture.weight, b.texture.weight)
        and np.array_equal(a.best, b.best)
        and np.array_equal(a.coverage, b.coverage)
    )


def test_order_does_not_matter_when_weighted_and_does_when_first(land, cameras):
    gains = (1e-4, 1.4e-4, 0.8e-4)
    inputs = [land.item(c, f"cam-{k}", gains=g) for k, (c, g) in enumerate(zip(cameras, gains, strict=True))]
    assert same(land.paint(inputs), land.paint(inputs[::-1]))
    first, last = (land.paint(order, mode="first", fit_gains=False) for order in (inputs, inputs[::-1]))
    assert first.webcams == ("cam-0", "cam-1", "cam-2")
    assert last.webcams == ("cam-2", "cam-1", "cam-0")
    assert not np.array_equal(first.texture.values, last.texture.values)
    painted = first.texture.weight > 0.0
    np.testing.assert_array_equal(painted, last.texture.weight > 0.0)


def test_tiles_change_nothing_and_resume(land, cameras, tmp_path, monkeypatch):
    inputs = [land.item(c, f"cam-{k}") for k, c in enumerate(cameras)]
    whole = land.paint(inputs)
    assert same(whole, land.paint(inputs, tile_px=64))
    cut = PaintOptions(near_m=1.0, tile_px=100)
    killed = []

    def stop(share):
        killed.append(share)
        if share > 0.6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        paint_atlas(inputs, land.target, options=cut, resume=tmp_path, progress=stop)
    done = sorted(tmp_path.glob("tile-*.npz"))
    assert 0 < len(done) < 9
    assert not list(tmp_path.glob(".*"))
    stamps = [path.stat().st_mtime_ns for path in done]
    again = paint_atlas(inputs, land.target, options=cut, resume=tmp_path)
    assert [path.stat().st_mtime_ns for path in done] == stamps, "finished tiles are not painted again"
    assert same(whole, again)


def test_views_without_anything_to_say_are_left_out_and_told(land, cameras):
    good = land.item(cameras[0], "good")
    away = land.item(camera_towards((0.0, 0.0, 300.0), (0.0, 10.0, 900.0)), "away")
    dark = replace(good, observation=replace(good.observation, mask=np.zeros((120, 160), bool), webcam="masked"))
    broken = replace(
        good, observation=replace(good.observation, image=np.full((120, 160, 3), np.nan, np.float32), webcam="broken")
    )
    painting = land.paint([good, away, dark, broken])
    assert painting.webcams == ("good",)
    assert sorted(painting.skipped) == [
        "away: no terrain in view",
        "broken: its image has no finite pixel",
        "masked: its mask excludes every pixel",
    ]
    assert same(painting, land.paint([good]))
    with pytest.raises(NoUsablePixels, match="no photograph has usable pixels: away: no terrain in view"):
        land.paint([away])


def test_single_nan_pixels_spoil_only_themselves(land, cameras):
    good = land.item(cameras[0], "good")
    image = good.observation.image.copy()
    image[60:63, 80:83] = np.nan
    spoilt = land.paint([replace(good, observation=replace(good.observation, image=image))], fit_gains=False)
    whole = land.paint([good], fit_gains=False)
    assert np.isfinite(spoilt.texture.values).all()
    lost = (whole.texture.weight > 0) & (spoilt.texture.weight == 0)
    assert 0 < lost.sum() < 0.02 * (whole.texture.weight > 0).sum()


def test_unpainted_is_told_by_weight_not_by_colour(land, cameras):
    """A picture as red as an alpenglow is painted like any other."""
    item = land.item(cameras[0], "glow")
    red = np.broadcast_to(np.array([0.8, 0.05, 0.02], np.float32), item.observation.image.shape).copy()
    painting = land.paint([replace(item, observation=replace(item.observation, image=red))], fit_gains=False)
    painted = painting.texture.weight > 0.0
    assert painted.mean() > 0.1
    assert (painting.best[painted] == 0).all()
    assert (painting.coverage[painted] == 1).all()
    assert (painting.texture.values[~painted] == 0.0).all()
    assert (painting.best[~painted] == -1).all()


def test_more_cameras_than_eight_bits_hold(land, cameras):
    """The number of contributing cameras does not wrap at 256."""
    count, atlas_tiling = 300, tiling(land.terrain, land.atlas, tile_px=32)
    prepared = prepare_input(land.item(cameras[0], "one"), land.ray_scene, atlas_tiling)
    radiometry = RadiometricFit(np.zeros((count, 3)), np.zeros((count, 3)), np.ones(count))
    tiles = (
        paint_tile([prepared] * count, land.ray_scene, atlas_tiling, tile, radiometry)
        for tile in tiles_of(atlas_tiling)
        if paint_tile([prepared], land.ray_scene, atlas_tiling, tile, radiometry).coverage.any()
    )
    painted = next(tiles)
    assert set(np.unique(painted.coverage)) <= {0, count}
    assert painted.coverage.max() == count


def test_the_pose_error_of_the_observation_guards_silhouettes(land, cameras):
    exact = land.item(cameras[0], "one")
    uncertain = replace(exact, observation=replace(exact.observation, pose_sigma={"heading_deg": 0.5}))
    sure, unsure = (prepare_input(item, land.ray_scene, land.cut).confidence for item in (exact, uncertain))
    assert (unsure <= sure).all()
    assert unsure.sum() < 0.95 * sure.sum()


def test_painting_on_disk(land, cameras, tmp_path):
    painting = land.paint([land.item(c, f"cam-{k}") for k, c in enumerate(cameras)])
    save_painting(painting, tmp_path / "p.npz")
    back = load_painting(tmp_path / "p.npz")
    assert same(painting, back)
    assert back.texture.atlas_id is None
    assert back.coverage.dtype == painting.coverage.dtype
    identified = replace(painting, texture=replace(painting.texture, atlas_id="0123456789abcdef"))
    save_painting(identified, tmp_path / "identified.npz")
    assert load_painting(tmp_path / "identified.npz").texture.atlas_id == "0123456789abcdef"
    assert back.webcams == painting.webcams
    np.testing.assert_allclose(back.radiometry.log_gain, painting.radiometry.log_gain)
    np.testing.assert_array_equal(load_texture(tmp_path / "p.npz").values, painting.texture.values)
    files = write_figures(painting, tmp_path / "figures")
    assert all(
        (tmp_path / "figures" / name).stat().st_size > 500 for name in ("painted.exr", "texture.png", "cameras.png")
    )
    assert set(files) == {"exr", "texture", "coverage", "cameras"}


# --- foreground, faults -------------------------------------------------------------------------------------------------


def test_houses_and_masts_are_found(land, cameras):
    camera = camera_towards((-500.0, -450.0, 170.0), (0.0, 0.0, 0.0), size=(320, 240))
    item = land.item(camera, "village", foreground=True)
    _, truth = add_foreground(land.picture(camera), np.random.default_rng(0))
    ready = prepare_input(item, land.ray_scene, land.cut, near_m=1.0)
    log_gain = np.full((1, 3), np.log(1e-4))
    rng = np.random.default_rng(2)
    guess = land.radiance * np.exp(rng.normal(0.0, 0.05, land.radiance.shape)).astype(np.float32)
    uv = land.look(camera).uv
    found = foreground_mask(ready, 0, RadiometricFit(log_gain, log_gain, np.ones(1)), guess, uv)
    on_land = np.isfinite(uv).all(axis=2)
    assert found[truth & on_land].mean() > 0.85
    assert found[~truth & on_land].mean() < 0.05


def test_predictions_owe_nothing_to_their_own_fold(land):
    from seasonscapes.terrain.surface import Texture

    predictors = np.log(land.radiance) @ np.array([[1.0, 0.2], [0.1, 1.0], [0.3, 0.4]], np.float32)
    seen = []

    def fit(x, y):
        seen.append(len(x))
        solution = np.linalg.lstsq(np.column_stack([x, np.ones(len(x))]), y, rcond=None)[0]
        return lambda z: np.column_stack([z, np.ones(len(z))]) @ solution

    spoilt = Texture(land.radiance.copy())
    clean = cross_validated_prediction(spoilt, predictors, fit)
    assert len(seen) == 4
    assert np.isfinite(clean).all()
    spoilt.values[:20, :20] *= 50.0
    again = cross_validated_prediction(Texture(spoilt.values), predictors, fit)
    inner = np.log(again[:16, :16] / clean[:16, :16])
    assert np.abs(inner).max() < 1.5, "a block that is fifty times too bright does not predict itself"


def test_webcam_faults_are_told_and_undone(land, cameras):
    radiance = land.picture(cameras[0])
    for faults, close in ((CLEAN, 0.02), (TYPICAL, 0.06), (SEVERE, 0.25)):
        levels, done = degrade(radiance, faults, np.random.default_rng(3))
        error = np.abs(undo_development(levels, done) / radiance - 1.0)[~done.clipped]
        assert levels.dtype == np.uint8
        assert np.median(error) < close
    with pytest.raises(ValueError, match="not finite"):
        degrade(np.full((8, 8, 3), np.nan), TYPICAL, np.random.default_rng(0))
    with pytest.raises(ValueError, match="tone_strength"):
        WebcamFaults(tone_strength=2.0)


def test_pose_errors_are_as_large_as_told(cameras):
    same_camera, error = perturb_pose(cameras[0], PoseSigmas(), np.random.default_rng(0))
    np.testing.assert_allclose(same_camera.world_from_camera, cameras[0].world_from_camera, atol=1e-12)
    assert set(error.values()) == {0.0}
    turned, error = perturb_pose(cameras[0], PoseSigmas(heading_deg=0.5), np.random.default_rng(0))
    ahead = cameras[0].position_m + 1000.0 * cameras[0].world_from_camera[:3, 2]
    moved = project(turned, ahead)[0][0] - project(cameras[0], ahead)[0][0]
    level = np.hypot(*cameras[0].world_from_camera[:2, 2])
    assert moved == pytest.approx(-np.radians(error["heading_deg"]) * cameras[0].fx * level, rel=0.02)


def test_atlas_of_charts_is_painted_too():
    """Nothing in painting takes the atlas for a plan."""
    cliffs = Land(hills, count=41, texel_m=10.0)
    terrain, atlas = unwrap(cliffs.terrain, kind="xatlas", texel_m=10.0)
    item = cliffs.item(camera_towards((-500.0, -450.0, 170.0), (0.0, 0.0, 0.0)), "one")
    painting = paint_atlas(
        [item],
        PaintTarget(terrain, atlas, ray_scene(mi_mesh(terrain, np.full(3, 0.3)))),
        options=PaintOptions(near_m=1.0, fit_gains=False),
    )
    place, _ = texel_positions(terrain, atlas.width_px, atlas.height_px)
    painted = painting.texture.weight > 0.0
    e, n = place[painted][:, 0], place[painted][:, 1]
    truth = 1500.0 * np.stack([1.5 + np.sin(e / 60.0), 1.5 + np.cos(n / 45.0), 1.5 + np.sin((e + n) / 80.0)], axis=-1)
    ratio = painting.texture.values[painted] * np.exp(painting.radiometry.log_gain[0]) / (1e-4 * truth)
    assert painted.mean() > 0.1
    assert np.median(np.abs(np.log(ratio))) < 0.05
    assert measure_atlas(terrain, "xatlas", atlas.width_px, atlas.height_px).width_px == atlas.width_px
