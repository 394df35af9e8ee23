"""Skylight from horizons equals that of many hemisphere rays, and closed forms."""

import numpy as np
import pytest

import seasonscapes as ss
from seasonscapes.rendering.hemisphere_rays import ESCAPED, SurfacePoints, gather_hemisphere, ray_scene
from seasonscapes.rendering.horizons import _drawn, is_height_field, sky_above, trace_horizons
from seasonscapes.rendering.irradiance import surface_at
from seasonscapes.rendering.mitsuba_scene import mi_mesh
from seasonscapes.rendering.sky_patches import sky_patches


@pytest.fixture(scope="module")
def alpine():
    place = ss.load_place("alpine_small")
    return place, ray_scene(mi_mesh(place.terrain, np.full(3, 0.3, np.float32)))


def test_coefficients_equal_those_of_hemisphere_rays(alpine):
    """At places of steep land, under a sky that differs by azimuth and elevation: the mean, and each place."""
    import mitsuba as mi

    place, terrain = alpine
    rng, patches, count = np.random.default_rng(5), sky_patches("reinhart"), 400
    # Each face is on one of eight slopes of land by its height.
    up_m = place.terrain.vertices[place.terrain.faces][..., 2].mean(axis=1)
    slope = np.minimum((up_m - up_m.min()) / np.ptp(up_m) * 8, 7).astype(np.uint32)
    face_cluster = mi.UInt32(slope)
    points, _ = surface_at(terrain, place.terrain.vertices[rng.integers(0, len(place.terrain.vertices), count)])
    count = len(points.origin)
    sky = 1.0 + patches.directions @ [[0.8, 0.0], [0.0, 0.8], [0.2, -0.5]] + (patches.directions[:, 2:] > 0.0)
    patch, hit = gather_hemisphere(
        terrain,
        patches,
        points,
        rays=4096,
        first=np.zeros(count, np.uint32),
        scramble=np.arange(count, dtype=np.uint32),
        mi_face_cluster=face_cluster,
    )
    free = hit == ESCAPED
    traced = np.stack([np.where(free, column[patch], 0.0).mean(axis=1) for column in sky.T], axis=1)
    seen = trace_horizons(
        terrain,
        sky_above(patches, sky),
        points.reshape(-1, 1),
        np.ones((count, 1), np.float32),
        azimuths=128,
        land_rays=2,
        turn=rng.random(count, np.float32),
        key=np.arange(count, dtype=np.uint32),
        mi_face_cluster=face_cluster,
    )
    found, share = seen.coefficients, seen.sky_share
    assert free.mean() < 0.95, "the land must hide some of the sky"
    assert found.mean(axis=0) == pytest.approx(traced.mean(axis=0), rel=2e-3)
    assert share.mean() == pytest.approx(free.mean(), abs=2e-3)
    assert np.sqrt(np.mean((found - traced) ** 2)) < 0.01 * traced.mean()
    # The land below the horizon: how much of the hemisphere each slope fills.
    for cluster in range(8):
        filled = np.where(seen.hit == cluster, seen.ray_weight, 0.0).sum(axis=1)
        expected = (hit == cluster).mean(axis=1)
        assert filled.mean() == pytest.approx(expected.mean(), rel=0.03, abs=2e-4)
        assert np.sqrt(np.mean((filled - expected) ** 2)) < 0.01


def test_a_slope_under_an_open_sky_sees_half_of_one_plus_its_cosine(alpine):
    """Above the highest summit nothing hides the sky; of a sky that is black below the horizon a slope of s sees (1 + cos s) / 2."""
    import mitsuba as mi

    place, terrain = alpine
    slope = np.radians([0.0, 20.0, 45.0, 70.0])
    normal = np.stack([np.sin(slope), np.zeros(4), np.cos(slope)], axis=1).astype(np.float32)
    origin = np.tile(np.float32([0.0, 0.0, 9000.0]), (4, 1))
    points = SurfacePoints(origin, normal, normal, np.ones((4, 3), np.float32), np.zeros((4, 2), np.float32))
    patches = sky_patches("tregenza")
    upper = (patches.directions[:, 2:] > 0.0).astype(float)
    seen = trace_horizons(
        terrain,
        sky_above(patches, upper),
        points.reshape(-1, 1),
        np.ones((4, 1), np.float32),
        azimuths=64,
        land_rays=1,
        turn=np.linspace(0.1, 0.9, 4, dtype=np.float32),
        key=np.arange(4, dtype=np.uint32),
        mi_face_cluster=mi.UInt32(np.zeros(len(place.terrain.faces), np.uint32)),
    )
    assert seen.coefficients[:, 0] == pytest.approx(0.5 * (1.0 + np.cos(slope)), abs=2e-3)


def test_horizons_do_not_depend_on_the_order_of_receivers(alpine):
    """Receivers are traced along a curve over the ground; whose horizon another one's search begins at changes where it ends only
    where what is free is not free above, at the rim of the land and by rounding."""
    import mitsuba as mi

    place, terrain = alpine
    rng, patches, count = np.random.default_rng(11), sky_patches("reinhart"), 3000
    points, _ = surface_at(terrain, place.terrain.vertices[rng.integers(0, len(place.terrain.vertices), count)])
    count = len(points.origin)
    above = sky_above(patches, np.stack([patches.directions[:, 0], patches.directions[:, 2]], axis=1))
    turn, key = rng.random(count, np.float32), np.arange(count, dtype=np.uint32)
    face_cluster = mi.UInt32(np.arange(len(place.terrain.faces), dtype=np.uint32) % 4096)
    mixed = rng.permutation(count)

    def seen(chosen):
        return trace_horizons(
            terrain,
            above,
            points[chosen].reshape(-1, 1),
            np.ones((len(chosen), 1), np.float32),
            azimuths=16,
            land_rays=1,
            turn=turn[chosen],
            key=key[chosen],
            mi_face_cluster=face_cluster,
        )

    straight, other = seen(np.arange(count)), seen(mixed)
    equal = straight.sky_share[mixed] == other.sky_share
    assert equal.mean() > 0.99
    assert (straight.hit[mixed] == other.hit).all(axis=1)[equal].mean() > 0.99
    assert straight.sky_share.std() > 0.02
    assert seen(np.arange(0)).sky_share.shape == (0,)


def test_points_are_drawn_in_proportion_to_their_weights():
    weight = np.tile(np.float32([0.5, 0.0, 0.125, 0.375]), (50, 1))
    drawn = _drawn(weight, 16, np.arange(50, dtype=np.uint32))
    counts = np.stack([(drawn == sample).sum(axis=1) for sample in range(4)], axis=1)
    assert np.abs(counts - 16 * weight).max() <= 1
    assert not counts[:, 1].any()


def test_land_of_a_mesh_is_no_height_field(alpine):
    from dataclasses import replace

    place, terrain = alpine
    assert is_height_field(terrain)
    assert not is_height_field(ray_scene(mi_mesh(replace(place.terrain, surface=None), np.full(3, 0.3, np.float32))))
