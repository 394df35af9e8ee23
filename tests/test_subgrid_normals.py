"""Normals below the resolution of heights: known tilts path-traced, found again, and shaded with by both engines."""

from dataclasses import replace

import albedo_cases
import numpy as np
import pytest
from places import MASSIF
from scipy.ndimage import gaussian_filter
from scipy.sparse import eye_array

from seasonscapes.albedo.closed_form import SolverOptions, solve_albedo
from seasonscapes.albedo.photographs import LINEAR, prepare_photographs
from seasonscapes.albedo.subgrid_normals import (
    FEWEST_SUNS,
    TiltEquations,
    solve_tilts,
    sunlight_factors,
    suns_seen,
    tangents,
    tilt_sigma,
    tilt_step,
    tilted_photographs,
)
from seasonscapes.errors import InputError
from seasonscapes.frames import direction_from_angles
from seasonscapes.relighting.lit_texture import bake_lit_texture
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.hosek import hosek_illumination
from seasonscapes.rendering.irradiance import surface_at
from seasonscapes.rendering.mitsuba_scene import build_scene, mi_mesh, relight
from seasonscapes.rendering.radiance import render_view
from seasonscapes.rendering.sun_visibility import sun_rays, visible_cosine
from seasonscapes.terrain.surface import Texture, load_texture, save_texture
from seasonscapes.terrain.surface_grid import surface_grid
from seasonscapes.workflows.albedo_recovery import RecoveryOptions, recover_albedo
from seasonscapes.workflows.edited_textures import read_albedo
from seasonscapes.workflows.illumination import sky_model
from seasonscapes.workflows.place import load_place, utc_at
from seasonscapes.workflows.relight_session import relight as relit_at
from seasonscapes.workflows.relight_session import relight_session
from seasonscapes.workflows.synthetic_photographs import photograph_each
from seasonscapes.workflows.terrain_building import MeshOptions
from seasonscapes.workflows.view_rendering import render
from seasonscapes.workflows.views import camera, tilted_terrain

SUNS = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [-0.6, 0.0, 0.8], [0.0, -0.8, 0.6], [0.5, 0.5, 0.7071]])
COUNT = 200


def _truth(seed):
    rng = np.random.default_rng(seed)
    normal = np.column_stack([rng.normal(0.0, 0.2, (COUNT, 2)), np.ones(COUNT)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return rng, normal, rng.normal(0.0, 0.15, (COUNT, 2)), rng.uniform(0.1, 0.5, (COUNT, 3))


def _pixels(normal, tilts, albedo, sun, visible, sky=0.3):
    """Radiance of pixels that show one texel each."""
    first, second = tangents(normal)
    tilted = normal + tilts[:, :1] * first + tilts[:, 1:] * second
    cosine = np.maximum(tilted @ sun, 0.0) / np.linalg.norm(tilted, axis=1) * visible
    return albedo * (cosine[:, None] + sky), cosine


def _found(normal, albedo, pictures, visible, sigma, weight=1e4, rounds=6):
    """Tilts and albedo of pixels of one texel each, in alternation."""
    tilts, guess = np.zeros((COUNT, 2)), np.full((COUNT, 3), 0.3)
    basis = tangents(normal)
    for _ in range(rounds):
        cosines = [
            _pixels(normal, tilts, guess, sun, seen)[1][:, None] + 0.3 for sun, seen in zip(SUNS, visible, strict=True)
        ]
        guess = np.sum([c * p for c, p in zip(cosines, pictures, strict=True)], 0) / np.sum([c * c for c in cosines], 0)
        parts = []
        for sun, picture, seen in zip(SUNS, pictures, visible, strict=True):
            before = np.maximum(normal @ sun, 0.1)
            slope = np.stack([(each @ sun) / before for each in basis], axis=1)
            residual = picture - _pixels(normal, tilts, guess, sun, seen)[0]
            lit = eye_array(COUNT).tocsr() * (before * seen)[:, None]
            parts.append(TiltEquations(lit.tocsr(), np.ones((COUNT, 3)), np.full((COUNT, 3), weight), residual, slope))
        tilts = tilt_step(parts, guess, tilts, sigma)
    return tilts, guess


def test_tilts_and_albedo_are_found_from_several_suns():
    _, normal, truth, albedo = _truth(1)
    visible = np.ones((len(SUNS), COUNT))
    pictures = [_pixels(normal, truth, albedo, sun, seen)[0] for sun, seen in zip(SUNS, visible, strict=True)]
    tilts, found = _found(normal, albedo, pictures, visible, 0.3, rounds=40)
    error = np.sqrt(np.mean((tilts - truth) ** 2))
    assert error < 0.2 * np.sqrt(np.mean(truth**2))
    assert np.median(np.abs(found / albedo - 1.0)) < 0.02


def test_ground_without_tilt_keeps_its_sunlight_however_low_the_sun():
    normal = np.tile([0.0, 0.0, 1.0], (6, 1))
    tilt = np.zeros((6, 3))
    tilt[3:, 0] = 0.05, -0.05, -0.4
    for elevation_deg in (0.5, 2.0, 5.0, 30.0, 80.0):
        elevation = np.radians(elevation_deg)
        sun = np.array([np.cos(elevation), 0.0, np.sin(elevation)])
        factor = sunlight_factors(normal, tilt, sun)
        assert np.allclose(factor[:3], 1.0, atol=1e-12)
        assert factor[3] > 1.0 > factor[4] >= factor[5] >= 0.0
        # The slope that the equations of the tilts have.
        slope = sun[0] / max(sun[2], 0.1)
        step = sunlight_factors(normal[:1], np.array([[1e-4, 0.0, 0.0]]), sun)[0] - 1.0
        assert step == pytest.approx(1e-4 * slope, rel=1e-3)
        if elevation_deg > 10.0:
            tilted = (normal + tilt) / np.linalg.norm(normal + tilt, axis=1, keepdims=True)
            assert np.allclose(factor, np.maximum(tilted @ sun, 0.0) / sun[2])
    assert sunlight_factors(normal, tilt, np.array([0.8, 0.0, -0.6])).tolist() == [1.0] * 6


def test_noise_gives_the_prior_and_shadow_tells_nothing():
    rng, normal, _, albedo = _truth(2)
    visible = np.ones((len(SUNS), COUNT))
    visible[:, : COUNT // 2] = 0.0
    flat = np.zeros((COUNT, 2))
    pictures = [
        _pixels(normal, flat, albedo, sun, seen)[0] + rng.normal(0.0, 0.05, (COUNT, 3))
        for sun, seen in zip(SUNS, visible, strict=True)
    ]
    tilts, _ = _found(normal, albedo, pictures, visible, 0.3, weight=1.0 / 0.05**2)
    assert np.abs(tilts[: COUNT // 2]).max() == 0.0
    # A narrow prior holds what a wide one lets follow the noise.
    wide, narrow = (
        np.sqrt(np.mean(_found(normal, albedo, pictures, visible, sigma, weight=400.0)[0] ** 2))
        for sigma in (1.0, 0.02)
    )
    assert narrow < 0.02 < wide


@pytest.fixture(scope="module")
def rough():
    """The place of the albedo tests with ground that is tilted from its heights, path-traced; and what its heights alone tell."""
    case = albedo_cases.case()
    rng = np.random.default_rng(3)
    size = case.albedo.shape[0] * case.albedo.shape[1]
    normal = np.tile([0.0, 0.0, 1.0], (size, 1))
    normal[case.transport.texel] = case.transport.normal
    along = [gaussian_filter(rng.normal(size=case.albedo.shape[:2]), 1.0).ravel() for _ in range(2)]
    tilt = sum(
        0.2 / part.std() * part[:, None] * tangent for part, tangent in zip(along, tangents(normal), strict=True)
    )
    mesh = mi_mesh(replace(case.terrain, tilt=tilt.reshape(case.albedo.shape).astype(np.float32)), case.albedo)
    pictures = [
        [
            render_view(relight(mesh, light), view, spp=32, seed=10 * t + c).radiance
            for c, view in enumerate(case.cameras)
        ]
        for t, light in enumerate(case.lights)
    ]
    seen, lights = replace(case, pictures=pictures).observations()
    photographs = prepare_photographs(case.transport, seen, lights, gains=[np.ones(3)] * len(seen))
    start = solve_albedo(case.transport, photographs, noise_model=LINEAR)
    return case, normal, tilt, photographs, start


def test_known_tilts_are_found_in_path_traced_pictures(rough):
    case, normal, truth, photographs, start = rough
    found, fit = solve_tilts(case.transport, photographs, start, 0.2)
    tilt = found.reshape(-1, 3)
    assert np.abs((tilt * normal).sum(axis=1)).max() < 1e-5
    few = suns_seen(photographs) < FEWEST_SUNS
    assert few.any()
    assert not tilt[few].any()
    good = ~few & (start.pixel_count.ravel() > 2.0)
    assert good.sum() > 100
    left = np.sqrt(np.mean((tilt - truth)[good] ** 2) / np.mean(truth[good] ** 2))
    assert left < 0.75
    assert np.median(fit.residual) < 0.95 * np.median(start.residual)
    # Albedo is rid of the shading.
    error = [np.abs(each.albedo - case.albedo).reshape(-1, 3)[good].mean() for each in (start, fit)]
    assert error[1] < 0.9 * error[0]


def test_a_light_that_was_held_out_is_predicted_better(rough):
    case, normal, truth_tilt, photographs, _ = rough
    held, kept = photographs[3:6], [*photographs[:3], *photographs[6:]]
    solver = SolverOptions(rounds=9)
    flat = solve_albedo(case.transport, kept, noise_model=LINEAR, solver=solver)
    tilt, fit = solve_tilts(case.transport, kept, solve_albedo(case.transport, kept, noise_model=LINEAR), 0.2)
    known = tilt.reshape(-1, 3).any(axis=1)

    # What the picture shows is the sunlight of the true tilts.
    true = tilted_photographs(held, normal, truth_tilt)

    def against_truth(model_photographs, albedo):
        total = []
        for model, exact in zip(model_photographs, true, strict=True):
            prints, other = model.footprints, exact.footprints
            inside = prints.matrix(prints.share) @ known.astype(np.float32) > 0.95
            predicted = prints.matrix(prints.sunlit[model.number][0]) @ albedo.reshape(-1, 3)
            shown = other.matrix(other.sunlit[exact.number][0]) @ case.albedo.reshape(-1, 3)
            total.append((predicted - shown)[inside])
        return np.sqrt(np.mean(np.concatenate(total) ** 2))

    assert against_truth(tilted_photographs(held, normal, tilt.reshape(-1, 3)), fit.albedo) < 0.9 * against_truth(
        held, flat.albedo
    )


def test_a_sun_too_faint_beside_the_sky_tells_no_tilts(rough):
    case, _, _, photographs, _ = rough
    few = photographs[: 2 * len(case.cameras) : len(case.cameras)]
    light = few[0].light
    dim = replace(light.sun, normal_illuminance_lx=np.full(3, 1e-6))
    moon = replace(light.sun, direction=np.array([0.0, 0.6, 0.8]))
    # A moon that is kept is the first body, and no sun.
    for bodies in ([], [few[0].footprints.sunlit[few[0].number][0]]):
        dawn = replace(
            few[0],
            light=replace(light, sun=dim, moon=moon if bodies else None),
            footprints=replace(few[0].footprints, sunlit=[bodies]),
            number=0,
        )
        assert np.array_equal(suns_seen([*few, dawn]), suns_seen(few))
        assert not suns_seen([dawn]).any()
        start = solve_albedo(case.transport, [*few, dawn], noise_model=LINEAR, solver=SolverOptions(rounds=1))
        tilt, fit = solve_tilts(case.transport, [*few, dawn], start, 0.2)
        assert not tilt.any()
        assert np.isfinite(fit.albedo).all()


def test_both_engines_shade_with_the_tilts_of_an_albedo():
    place = load_place("alpine_small")
    view = camera(place, "aerial", size_px=(36, 24))
    values = np.full((*place.texture_shape, 3), 0.3, np.float32)
    towards_west = np.zeros_like(values)
    towards_west[..., 0] = -0.6
    plain = Texture(values, atlas_id=place.atlas_id)
    tilted = replace(plain, tilt=towards_west)
    assert tilted.content != plain.content
    evening, few = utc_at(place, "2024-07-20T17:00"), SamplingOptions(albedo_samples=4, rays=32, clusters=512)
    means = {}
    for name, albedo in (("plain", plain), ("tilted", tilted)):
        session = relight_session(place, view, sky="hosek", albedo=albedo, sampling=few)
        for engine, seen in (
            ("transport", relit_at(session, evening)),
            ("path", render(place, view, albedo=albedo, engine="path", spp=32, time=evening, sky="hosek")),
        ):
            means[name, engine] = seen.radiance[np.isfinite(seen.gbuffer.depth)].mean()
    gain = {engine: means["tilted", engine] / means["plain", engine] for engine in ("transport", "path")}
    assert gain["path"] > 1.05
    assert gain["transport"] == pytest.approx(gain["path"], abs=0.03)


def test_skylight_and_bounces_are_those_of_the_heights(rough):
    """As the recovery has them: tilts change the light of sun and moon alone."""
    case, _, tilt, _, _ = rough
    smooth = replace(case.terrain, surface=surface_grid(case.place.elevation, case.terrain.frame))
    tilted = replace(smooth, tilt=tilt.reshape(case.albedo.shape).astype(np.float32))
    dull = replace(case.lights[0], sun=None)
    view = case.cameras[0]
    cloudy = [
        render_view(build_scene(each, case.albedo, dull), view, spp=4, seed=0).radiance for each in (smooth, tilted)
    ]
    assert cloudy[0].max() > 0.0
    assert np.array_equal(*cloudy)
    positions = case.transport.position_m[None, ::4]
    colours = np.full_like(positions, 0.3, np.float32)
    sampling = SamplingOptions(shadow_samples=1, rays=64, clusters=256, clusters_per_receiver=16)
    lit = [
        bake_lit_texture(ray_scene(mi_mesh(each, case.albedo)), positions, colours, case.lights[0], sampling=sampling)
        for each in (smooth, tilted)
    ]
    assert np.array_equal(lit[0].sky, lit[1].sky, equal_nan=True)
    assert np.nanmean(np.abs(lit[0].sun - lit[1].sun)) > 0.02 * np.nanmean(lit[0].sun)


def test_tilts_cast_no_shadows_on_their_own_ground():
    place = load_place("alpine_small")
    light = hosek_illumination(direction_from_angles(285.0, 4.0), shape=(16, 32))
    values = np.full((*place.texture_shape, 3), 0.3, np.float32)
    tilt = np.zeros_like(values)
    # Towards the sun: the cosine to the tilted normal is large where that to the surface is small.
    tilt[..., :2] = 0.6 * light.sun.direction[:2] / np.linalg.norm(light.sun.direction[:2])
    terrains = [place.terrain, replace(place.terrain, tilt=tilt)]

    low, high = place.terrain.vertices.min(axis=0), place.terrain.vertices.max(axis=0)
    position_m = np.random.default_rng(0).uniform(low, high, (20_000, 3))
    position_m[:, 2] = 0.5 * (low[2] + high[2])
    visible = []
    for terrain in terrains:
        scene = ray_scene(mi_mesh(terrain, values))
        points, _ = surface_at(scene, position_m, search_m=float(high[2] - low[2]))
        normals = (each[:, None] for each in (points.normal, points.geometric_normal))
        rays = sun_rays(scene, points.origin[:, None], *normals, np.ones((len(points.uv), 1)), np.zeros(len(points.uv)))
        visible.append(visible_cosine(rays, light.sun)[:, 0] > 0.0)
        towards = (points.geometric_normal @ light.sun.direction).astype(np.float32)
    grazing = (towards > 0.01) & (towards < 0.06)
    assert visible[0][grazing].sum() > 50
    assert np.array_equal(visible[0][grazing], visible[1][grazing])

    # The path tracer: the sun alone, and paths without bounces.
    dark = replace(light, sky_radiance=np.zeros_like(light.sky_radiance))
    view = camera(place, "aerial", size_px=(96, 64))
    lit = [
        render_view(build_scene(each, values, dark), view, spp=1, seed=0, max_depth=2).radiance[..., 1] > 0.0
        for each in terrains
    ]
    assert lit[0].sum() > 200
    assert not (lit[0] & ~lit[1]).any()


def test_invented_relief_stands_in_place_of_tilts(caplog):
    terrain = load_place("alpine_small").terrain
    plain = Texture(np.full((4, 5, 3), 0.2, np.float32))
    tilted = replace(plain, tilt=np.full((4, 5, 3), 0.1, np.float32))
    caplog.set_level("INFO")
    assert tilted_terrain(terrain, tilted, amplify=False).tilt is tilted.tilt
    assert tilted_terrain(terrain, plain, amplify=True).tilt is None
    assert "left out" not in caplog.text
    assert tilted_terrain(terrain, tilted, amplify=True).tilt is None
    assert "left out" in caplog.text


def test_textures_keep_their_tilts_in_files(tmp_path):
    values = np.full((4, 5, 3), 0.2, np.float32)
    tilt = np.random.default_rng(0).normal(0.0, 0.1, values.shape).astype(np.float32)
    save_texture(Texture(values, tilt=tilt), tmp_path / "t.npz")
    assert np.array_equal(load_texture(tmp_path / "t.npz").tilt, tilt)
    np.savez(tmp_path / "bad.npz", values=values, weight=values[..., 0], tilt=np.full((4, 5, 3), np.nan, np.float32))
    with pytest.raises(InputError, match="tilt"):
        load_texture(tmp_path / "bad.npz")


def test_a_recovery_keeps_its_tilts_where_they_are_asked_for(tmp_path):
    (tmp_path / "little.toml").write_text(MASSIF)
    place = load_place(tmp_path / "little.toml", options=MeshOptions(texel_m=120.0))
    times = [utc_at(place, f"2024-07-20T{hour}:00") for hour in ("10", "13", "16")]
    view = {"aerial": camera(place, "aerial", size_px=(60, 40))}
    each = photograph_each(place, times, sky_model("clear"), view)
    photographs = [picture.observation for _, pictures in each for picture in pictures]
    recovered = recover_albedo(place, photographs, options=RecoveryOptions(normals=True))
    assert recovered.facts["tilted_share"] > 0.02
    assert recovered.facts["tilt_prior_sigma"] > 0.02
    recovered.save(tmp_path / "a.npz")
    texture = read_albedo(place, tmp_path / "a.npz")
    assert np.array_equal(texture.tilt, recovered.tilt)
    assert 0.0 < recovered.facts["tilt_rms"] < 1.0
    with pytest.raises(ValueError, match="normals belong to the closed form"):
        RecoveryOptions(method="differentiable", normals=True)


def test_sigma_of_tilts_follows_the_roughness_that_heights_lose():
    rng = np.random.default_rng(4)
    noise = gaussian_filter(rng.normal(size=(256, 256)), 1.5)
    rough, smooth = (tilt_sigma(100.0 * each, 30.0, 10.0) for each in (noise, gaussian_filter(noise, 8.0)))
    assert 0.03 < rough < 0.6
    assert smooth < 0.2 * rough
    # Of large heights the middle counts.
    wide = np.zeros((2304, 2304), np.float32)
    wide[128:-128, 128:-128] = np.tile(100.0 * noise, (8, 8))
    assert tilt_sigma(wide, 30.0, 10.0) == tilt_sigma(wide[128:-128, 128:-128], 30.0, 10.0)
    assert tilt_sigma(np.fromfunction(lambda r, c: 9.0 * r + 4.0 * c, (90, 80)), 30.0, 10.0) < 0.02
