"""Cast shadows at discs against closed form: a ridge's shadow on a plain, its penumbra, and what models do with them."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from test_rendering import heightfield, sun_at  # noqa: E402

import seasonscapes as ss  # noqa: E402
from seasonscapes.gaussians.appearance import Appearance, colours_at, fourier_embedding, light_tensors  # noqa: E402
from seasonscapes.gaussians.disc_transport import light_state, surfel_irradiance, trace_disc_transport  # noqa: E402
from seasonscapes.gaussians.land_shadows import disc_shadows  # noqa: E402
from seasonscapes.gaussians.losses import surface_loss  # noqa: E402
from seasonscapes.gaussians.rasterise import set_torch_threads  # noqa: E402
from seasonscapes.gaussians.surfels import terrain_surfels  # noqa: E402
from seasonscapes.gaussians.training import Schedule, surface_targets, train  # noqa: E402
from seasonscapes.rendering.hemisphere_rays import ray_scene  # noqa: E402
from seasonscapes.rendering.mitsuba_scene import mi_mesh  # noqa: E402
from seasonscapes.workflows.gaussian_views import cast_shadows  # noqa: E402

set_torch_threads(1)
WALL_M, SIDE_M = 100.0, 1000.0
# Low suns in the west-south-west, between azimuths that the discs' horizons store.
SUNS = [sun_at(azimuth, elevation) for azimuth, elevation in ((258.4, 20.0), (270.0, 30.0), (281.3, 14.0))]


@pytest.fixture(scope="module")
def plain():
    """A plain with a wall 100 m high along its western end, discs 20 m apart, their transport and shadow rays."""
    terrain = heightfield(lambda e, n: np.where(e < -400.0, WALL_M, 0.0), side_m=SIDE_M, count=201)
    surfels = terrain_surfels(terrain, 20.0)
    land = ray_scene(mi_mesh(terrain, np.full(3, 0.3)))
    albedo = np.full((len(surfels.means), 3), 0.3, np.float32)
    transport = trace_disc_transport(land, surfels, albedo, rays=16)
    return (surfels, land, albedo, transport, disc_shadows(land, surfels))


def states_of(plain):
    return [light_state(plain[3], sun, 180.0) for sun in SUNS]


def test_the_shadow_of_a_wall_ends_where_geometry_says(plain):
    """Each disc has the share of its cell beyond the shadow's edge, in the penumbra to the sun's width."""
    surfels, shadows = plain[0], plain[4]
    for sun, state in zip(SUNS, states_of(plain), strict=True):
        direction = sun.sun.direction
        # Off the ends of the wall; its crest lies at the last high vertices.
        away_m = surfels.means[:, 0] + 405.0
        middle = (np.abs(surfels.means[:, 1]) < 200.0) & (away_m > 20.0)
        length_m = WALL_M * -direction[0] / direction[2]
        share = shadows.visible_share(state)[0]
        expected = np.clip((away_m - length_m) / 20.0 + 0.5, 0.0, 1.0)
        assert np.mean(expected[middle] == 0.0) > 0.05
        assert np.mean(expected[middle] == 1.0) > 0.2
        np.testing.assert_allclose(share[middle], expected[middle], atol=0.2)
        sharp = middle & (np.abs(away_m - length_m) > 20.0)
        np.testing.assert_array_equal(share[sharp], expected[sharp])


def test_quartered_cells_are_sampled_in_their_quarter(plain):
    """Cells of a finer level see what the coarse grid's cells of that size see."""
    surfels, land, _, _, shadows = plain
    grid, level, cell = surfels.grid, surfels.level, surfels.cell
    quarters = np.full(4 * len(cell), 1, level.dtype)
    row, column = np.divmod(cell, grid.columns)
    fine = [(2 * row + i) * 2 * grid.columns + 2 * column + j for i in range(2) for j in range(2)]
    finer = disc_shadows(
        land, replace(surfels, level=quarters, cell=np.concatenate(fine), means=np.tile(surfels.means, (4, 1)))
    )
    state = states_of(plain)[0]
    mean = finer.visible_share(state)[0].reshape(4, -1).mean(axis=0)
    np.testing.assert_allclose(mean, shadows.visible_share(state)[0], atol=0.2)


def test_discs_that_have_no_land_are_refused(plain):
    surfels, land = plain[:2]
    small = ray_scene(mi_mesh(heightfield(lambda e, n: 0.0 * e, side_m=300.0, count=3), np.full(3, 0.3)))
    with pytest.raises(ValueError, match="discs have no land below them; use the terrain"):
        disc_shadows(small, surfels)
    with pytest.raises(ValueError, match="300 m or more above or below the land"):
        disc_shadows(land, replace(surfels, means=surfels.means + np.float32([0.0, 0.0, 300.0])))


def appearance(plain, kind="physical"):
    surfels, _, albedo, transport, _ = plain
    return Appearance(kind, albedo[None], albedo[None], transport, fourier_embedding(surfels.means))


def test_traced_shadows_are_nearer_the_truth_than_horizons(plain):
    surfels, land, albedo, _, shadows = plain
    model, states = appearance(plain), states_of(plain)
    truth = surfel_irradiance(land, surfels, SUNS, rays=16)
    level = surfels.means[:, 0] > -380.0  # a disc across the wall has no one plane
    for state, received in zip(states, truth, strict=True):
        true = albedo * received / np.float32(state.global_lx)
        errors = [
            np.sqrt(np.mean((colours_at(model, state, visible=visible) - true)[level] ** 2))
            for visible in (None, shadows.visible_share(state))
        ]
        assert errors[1] < 0.5 * errors[0]


def test_training_keeps_horizons_for_browsers(plain):
    """With traced shadows colours tell horizons nothing; they still come nearer to the shadows that were traced."""
    surfels, land, albedo, _, shadows = plain
    states = states_of(plain)
    received = surfel_irradiance(land, surfels, SUNS, rays=16)
    targets = surface_targets(states, [0, 0, 0], albedo[None], received, shadows)
    assert targets.visible.shape == (3, 2, len(surfels.means))
    model = appearance(plain)

    def error() -> float:
        with torch.no_grad():
            every = torch.arange(len(surfels.means))
            found = [model.visibility(every, torch.as_tensor(state.bodies[0][0])).numpy() for state in states]
        return float(np.mean((np.array(found) - targets.visible[:, 0]) ** 2))

    before = error()
    train(model, targets, (), Schedule(150, 0, batch=2048), seed=1)
    assert error() < 0.8 * before


def test_the_loss_counts_traced_shadows(plain):
    surfels, land, albedo, _, shadows = plain
    states = states_of(plain)
    targets = surface_targets(states, [0, 0, 0], albedo[None], surfel_irradiance(land, surfels, SUNS, rays=16), shadows)
    colours, rng = torch.as_tensor(targets.colours), np.random.default_rng
    losses = [
        float(surface_loss(appearance(plain), light_tensors(states, None, visible), colours, 8192, rng(0)).detach())
        for visible in (targets.visible, 1.0 - targets.visible)
    ]
    assert losses[0] < 0.2 * losses[1]


@pytest.fixture(scope="module")
def distilled():
    place = ss.load_place("alpine_small")
    quick = ss.DistilOptions(discs=12, suns=2, dates=1, views=0, steps=2, picture_steps=0)
    return ss.distil(place, sky="hosek", options=quick), place


def test_rays_are_placed_once_for_a_loop_over_hours(distilled):
    model, place = distilled
    first = cast_shadows(model, place)
    assert first is cast_shadows(model, place)
    assert first is not cast_shadows(replace(model), place)
    assert cast_shadows(replace(model, kind="sun"), place) is None


def test_models_of_other_land_are_refused(distilled):
    model, place = distilled
    higher = replace(model, means=model.means + np.float32([0.0, 0.0, 3.0 * model.grid.spacing_m]))
    elsewhere = replace(model, frame=replace(model.frame, latitude_deg=model.frame.latitude_deg + 0.1))
    for wrong, match in ((higher, "does not lie on the scene's land"), (elsewhere, "about another origin")):
        with pytest.raises(ss.InputError, match=match) as told:
            cast_shadows(wrong, place)
        assert "\n" not in str(told.value)
