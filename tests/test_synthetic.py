"""The embedded massif: seeded, shaped like mountains, and coloured by a calendar that can be trusted."""

import dataclasses
from functools import cache

import numpy as np
import pytest

import seasonscapes as ss
from seasonscapes.terrain import flow
from seasonscapes.terrain.noise import fractal_noise, spline_noise
from seasonscapes.terrain.synthetic import (
    SEASONS,
    Cover,
    alpine_albedo,
    alpine_albedos,
    alpine_massif,
    load_massif,
    save_massif,
    snow_fraction,
    snow_line_m,
)
from seasonscapes.terrain.synthetic_cover import FOREST
from seasonscapes.terrain.synthetic_ice import grow_ice, mass_balance_m
from seasonscapes.terrain.synthetic_layout import LAKE_LEVEL_M


@cache
def massif_of(spacing_m):
    return alpine_massif(spacing_m=spacing_m)


@pytest.fixture(scope="module")
def place():
    return massif_of(60.0)


@pytest.fixture(scope="module")
def fine():
    return massif_of(30.0)


@pytest.fixture(scope="module")
def small():
    return alpine_massif(size_m=6000.0, spacing_m=60.0)


def heights(place):
    return place.elevation.values[..., 0]


def test_same_seed_same_bytes_other_seed_other_mountains(place):
    again, other = alpine_massif(spacing_m=60.0), alpine_massif(seed=7, spacing_m=60.0)
    for field in dataclasses.fields(place):
        a, b = getattr(place, field.name), getattr(again, field.name)
        if isinstance(a, np.ndarray):
            assert a.tobytes() == b.tobytes(), field.name
    assert heights(place).tobytes() == heights(again).tobytes()
    assert np.abs(heights(place) - heights(other)).mean() > 30.0
    assert alpine_albedo(place, 200).tobytes() == alpine_albedo(again, 200).tobytes()


@pytest.mark.parametrize("seed", [1912, 3])
def test_looks_like_the_alps_in_numbers(seed, place):
    if seed != 1912:
        place = alpine_massif(seed=seed, spacing_m=60.0)
    z = heights(place)
    assert 530.0 < z.min() <= LAKE_LEVEL_M
    assert 3900.0 < z.max() < 4450.0
    assert 25.0 < np.median(place.slope_deg) < 38.0
    assert np.percentile(place.slope_deg, 99) < 75.0
    share = {kind: float((place.cover == kind).mean()) for kind in Cover}
    assert 0.015 < share[Cover.WATER] < 0.08
    assert 0.08 < share[Cover.MEADOW] + share[Cover.FIELD] < 0.35
    assert 0.12 < sum(share[kind] for kind in FOREST) < 0.40
    assert 0.08 < share[Cover.ROCK] < 0.30
    assert share[Cover.SCREE] > 0.005
    assert 0.12 < share[Cover.ICE] + share[Cover.FIRN] < 0.40


def test_summits_stand_in_the_south_above_a_lake_in_the_north(place):
    z = heights(place)
    rows = np.nonzero(place.shore_m < 0.0)[0]
    assert rows.max() < z.shape[0] / 2 < np.nonzero(z > 3800.0)[0].min()
    # The main wall: more than 1,200 m of rise facing north within a kilometre.
    rise = z[17:] - z[:-17]
    assert rise.max() > 1200.0


def test_lake_is_level_and_holds_no_grass(place, fine):
    for made in (place, fine):
        lake = made.shore_m < 0.0
        assert np.ptp(heights(made)[lake]) == 0.0
        assert heights(made)[lake][0] == LAKE_LEVEL_M
        assert (made.cover[lake] == Cover.WATER).all()
        area_km2 = lake.sum() * made.spacing_m**2 / 1e6
        assert 1.5 < area_km2 < 6.0


def test_erosion_leaves_few_pits(fine):
    z = heights(fine).astype(float)
    lattice = flow.jittered_lattice(6000.0, 30.0, 0.0, np.random.default_rng(0))
    dry = fine.shore_m > 0.0
    routes = flow.route_flow(np.where(dry, z, -1.0), flow.lattice_links(lattice), lattice.border | ~dry)
    assert routes.pits / z.size < 0.012
    rough = z + np.random.default_rng(0).normal(0.0, 30.0, z.shape)
    assert flow.route_flow(rough, flow.lattice_links(lattice), lattice.border).pits > 5 * routes.pits


def test_classes_keep_to_their_heights(fine):
    z = heights(fine)
    forest = np.isin(fine.cover, FOREST)
    assert np.percentile(z[forest], 99) < 2100.0
    assert z[forest].max() < 2500.0
    assert np.percentile(z[fine.cover == Cover.ICE], 1) > 1100.0
    assert z[fine.cover == Cover.FIRN].min() > 2400.0
    assert np.median(fine.slope_deg[fine.cover == Cover.ROCK]) > 40.0
    assert np.median(fine.slope_deg[fine.cover == Cover.FIELD]) < 6.0
    assert np.median(z[fine.cover == Cover.LARCH]) > np.median(z[fine.cover == Cover.BROADLEAF]) + 300.0


def test_coarse_and_fine_are_the_same_mountains(place, fine):
    a, b = heights(place), heights(fine)[::2, ::2]
    assert np.corrcoef(a.ravel(), b.ravel())[0, 1] > 0.99
    assert np.mean((place.shore_m < 0.0) == (fine.shore_m[::2, ::2] < 0.0)) > 0.995
    # Cell centres coincide: the same place has the same map coordinates.
    centre_coarse, centre_fine = place.elevation.transform * (0.5, 0.5), fine.elevation.transform * (0.5, 0.5)
    assert centre_coarse == pytest.approx(centre_fine)


def test_raster_lies_around_its_centre_on_the_map(place):
    from pyproj import Transformer

    rows, columns = place.cover.shape
    to_earth = Transformer.from_crs(place.elevation.crs, "EPSG:4326", always_xy=True)
    longitude, latitude = to_earth.transform(*(place.elevation.transform * (columns / 2.0, rows / 2.0)))
    assert (latitude, longitude) == pytest.approx((46.55, 7.98), abs=1e-9)
    assert place.elevation.transform.a == 60.0 == -place.elevation.transform.e
    assert place.elevation.values.shape == (201, 201, 1)


@pytest.mark.parametrize("day", SEASONS.values())
def test_albedo_is_physical(place, day):
    albedo = alpine_albedo(place, day)
    assert albedo.dtype == np.float32
    assert albedo.shape == (*place.cover.shape, 3)
    assert albedo.min() >= 0.01
    assert albedo.max() <= 0.95


def test_seasons_have_their_colours(fine):
    albedo = {name: alpine_albedo(fine, day) for name, day in SEASONS.items()}
    mean = {name: float(a.mean()) for name, a in albedo.items()}
    assert mean["winter"] > mean["spring"] > mean["summer"]
    z = heights(fine)
    meadow = (fine.cover == Cover.MEADOW) & (z > 1100) & (z < 1700)
    red, green, blue = albedo["summer"][meadow].mean(axis=0)
    assert green > 1.3 * red > 2.0 * blue
    red, green, _ = albedo["autumn"][meadow].mean(axis=0)
    assert red > green
    larch = (fine.cover == Cover.LARCH) & (z < 2000)
    red, green, blue = albedo["autumn"][larch].mean(axis=0)
    assert red > 1.3 * green > 4.0 * blue
    conifer = (fine.cover == Cover.CONIFER) & (z < 1000)
    assert np.abs(albedo["autumn"][conifer] - albedo["summer"][conifer]).max() < 0.02
    ice = fine.cover == Cover.ICE
    assert albedo["summer"][ice][:, 2].mean() > albedo["summer"][ice][:, 0].mean()
    # Forests are dark from above even in winter; open ground is not.
    open_ground = (fine.cover == Cover.MEADOW) & (z > 1500)
    assert albedo["winter"][open_ground].mean() > 0.7
    assert albedo["winter"][np.isin(fine.cover, FOREST) & (z > 1200)].mean() < 0.45


def test_snow_lies_longer_on_north_slopes_and_not_on_walls(fine):
    z, snow = heights(fine), snow_fraction(fine, SEASONS["spring"])
    band = (np.abs(z - snow_line_m(SEASONS["spring"])) < 250.0) & (fine.slope_deg > 15.0) & (fine.slope_deg < 40.0)
    north, south = band & (fine.northness > 0.3), band & (fine.northness < -0.3)
    assert min(north.sum(), south.sum()) > 200
    assert snow[north].mean() > snow[south].mean() + 0.2
    winter = snow_fraction(fine, SEASONS["winter"])
    high = z > 2000.0
    assert winter[high & (fine.slope_deg > 68.0)].mean() < 0.35
    assert winter[high & (fine.slope_deg < 35.0)].mean() > 0.95


def test_snow_line_is_periodic_and_highest_in_late_summer():
    days = np.arange(0.0, 366.0, 1.0)
    line = np.array([snow_line_m(d) for d in days])
    assert 210 < days[line.argmax()] < 250
    assert days[line.argmin()] < 60
    assert np.abs(np.diff(line)).max() < 45.0
    assert snow_line_m(10.0) == pytest.approx(snow_line_m(10.0 + 365.25), abs=1e-6)


def test_albedo_is_continuous_through_the_year(small):
    moment = 0.02
    for day in (0.0, 59.5, 95.0, 140.3, 172.0, 265.0, 300.0, 318.7, 365.2):
        step = np.abs(alpine_albedo(small, day + moment) - alpine_albedo(small, day)).max()
        assert step < 0.01, day
    coarse = [alpine_albedo(small, day) for day in (120.0, 121.0)]
    assert np.abs(coarse[1] - coarse[0]).max() < 0.35
    assert np.abs(coarse[1] - coarse[0]).mean() < 0.02
    assert alpine_albedo(small, 365.25) == pytest.approx(alpine_albedo(small, 0.0), abs=1e-5)


def test_finer_texels_keep_the_mean_and_add_detail(small):
    coarse, fine = alpine_albedo(small, 200), alpine_albedo(small, 200, upsample=4)
    assert fine.shape == (coarse.shape[0] * 4, coarse.shape[1] * 4, 3)
    pooled = fine.reshape(*(coarse.shape[0], 4, coarse.shape[1], 4, 3)).mean(axis=(1, 3))
    assert pooled.mean() == pytest.approx(coarse.mean(), rel=0.04)

    # Registered: no shift of the finer map matches the coarse one better than none.
    def match(rows, columns):
        moved = np.roll(pooled[..., 1], (rows, columns), (0, 1))[4:-4, 4:-4]
        return np.corrcoef(moved.ravel(), coarse[4:-4, 4:-4, 1].ravel())[0, 1]

    best = match(0, 0)
    assert best > 0.9
    assert all(match(r, c) < best for r, c in ((0, 1), (0, -1), (1, 0), (-1, 0)))
    within = fine[: 4 * 40, : 4 * 40, 1].reshape(40, 4, 40, 4).std(axis=(1, 3)).mean()
    assert within > 0.002


def test_strips_leave_no_seam(small, monkeypatch):
    from seasonscapes.terrain import synthetic_albedo

    whole = alpine_albedo(small, 130, upsample=2)
    monkeypatch.setattr(synthetic_albedo, "_STRIP_ROWS", 37)
    assert alpine_albedo(small, 130, upsample=2) == pytest.approx(whole, abs=2e-3)


def test_days_made_together_are_those_made_alone(small):
    days = (20.0, 160.0, 290.0)
    together = alpine_albedos(small, days, upsample=2)
    for number, day in enumerate(days):
        alone = alpine_albedo(small, day, upsample=2)
        assert together[..., 3 * number : 3 * number + 3].tobytes() == alone.tobytes()


def test_save_and_load(place, tmp_path):
    save_massif(place, tmp_path / "alpine.npz")
    back = load_massif(tmp_path / "alpine.npz")
    assert back.elevation.transform == place.elevation.transform
    assert (back.elevation.crs, back.seed, back.spacing_m) == ("EPSG:32632", 1912, 60.0)
    assert alpine_albedo(back, 77.0).tobytes() == alpine_albedo(place, 77.0).tobytes()
    assert [p.name for p in tmp_path.iterdir()] == ["alpine.npz"]


def test_callers_mistakes_are_named(place):
    with pytest.raises(ValueError, match="spacing_m: got 20"):
        alpine_massif(spacing_m=20.0)
    with pytest.raises(ValueError, match="size_m: got 30000"):
        alpine_massif(size_m=30000.0)
    with pytest.raises(ValueError, match="upsample: got 3"):
        alpine_albedo(place, 1, upsample=3)


def test_noise_hangs_on_the_world_not_on_the_grid():
    coarse, fine = np.arange(-600.0, 601.0, 40.0), np.arange(-600.0, 601.0, 10.0)
    a, b = spline_noise(5, 330.0, coarse, -coarse), spline_noise(5, 330.0, fine, -fine)
    assert a == pytest.approx(b[::4, ::4], abs=1e-5)
    wide = np.arange(-40000.0, 40000.0, 97.0)
    assert fractal_noise(9, 800.0, wide, wide, octaves=4).std() == pytest.approx(1.0, abs=0.05)
    assert np.abs(spline_noise(6, 330.0, coarse, coarse) - spline_noise(5, 330.0, coarse, coarse)).mean() > 0.3


def slow_flow(z, links, outlets):
    """Catchments by a queue over cells from high to low: the obvious twin, for surfaces without pits."""
    best, receiver = np.zeros(z.size), np.full(z.size, -1)
    index = np.arange(z.size).reshape(z.shape)
    for a, b, length in zip(links.first, links.second, links.length_m, strict=True):
        for here, there, d in zip(index[a].ravel(), index[b].ravel(), length.ravel(), strict=True):
            slope = (z.flat[here] - z.flat[there]) / d
            for source, target, fall in ((here, there, slope), (there, here, -slope)):
                if fall > best[source]:
                    best[source], receiver[source] = fall, target
    area = np.ones(z.size)
    for cell in np.argsort(-z.ravel(), kind="stable"):
        if receiver[cell] >= 0 and not outlets.flat[cell]:
            area[receiver[cell]] += area[cell]
    return area.reshape(z.shape)


def test_catchments_agree_with_the_slow_twin():
    rng = np.random.default_rng(4)
    lattice = flow.jittered_lattice(300.0, 25.0, 0.38, rng)
    z = np.hypot(lattice.east_m - 40.0, lattice.north_m) * -1.0 + 500.0 + 0.2 * rng.random(lattice.east_m.shape)
    links = flow.lattice_links(lattice)
    routes = flow.route_flow(z, links, lattice.border)
    assert routes.pits == 0
    area = flow.accumulate(routes, np.ones(z.shape))
    assert area == pytest.approx(slow_flow(z, links, lattice.border))
    assert area[lattice.border].sum() == z.size


def test_pits_spill_over_their_lowest_pass():
    lattice = flow.jittered_lattice(200.0, 20.0, 0.0, np.random.default_rng(0))
    z = 100.0 - 0.05 * np.hypot(lattice.east_m, lattice.north_m)
    z[10, 8:13] = 20.0  # a trough that nothing drains
    z[10, 13:] = np.linspace(60.0, 50.0, 8)  # its lowest rim leads east
    routes = flow.route_flow(z, flow.lattice_links(lattice), lattice.border)
    assert routes.pits >= 1
    area = flow.accumulate(routes, np.ones(z.shape))
    assert area[lattice.border].sum() == z.size
    assert area[10, -1] > 20.0


def test_incision_has_its_closed_form():
    """One channel of constant rate K and a fixed mouth: z_i (1 + c) = z0_i + c z_(i-1)."""
    n = 12
    receiver = np.append(np.append(n, np.arange(n - 1)), n)
    distance = np.append(0.0, np.full(n - 1, 50.0)).reshape(1, n)
    routes = flow.FlowRoutes(receiver, distance, 0)
    start = np.linspace(100.0, 320.0, n).reshape(1, n)
    cut = flow.incise(start, routes, np.full((1, n), 20.0))
    expected = [100.0]
    for z0 in start[0, 1:]:
        expected.append((z0 + 0.4 * expected[-1]) / 1.4)
    assert cut[0] == pytest.approx(expected, rel=1e-12)


def test_a_plane_comes_back_from_the_jittered_lattice():
    lattice = flow.jittered_lattice(500.0, 25.0, 0.38, np.random.default_rng(2))
    regular = flow.jittered_lattice(500.0, 25.0, 0.0, np.random.default_rng(2))
    plane = 3.0 + 0.4 * lattice.east_m - 0.7 * lattice.north_m
    expected = 3.0 + 0.4 * regular.east_m - 0.7 * regular.north_m
    inner = np.s_[1:-1, 1:-1]
    assert flow.resample_to_grid(plane, lattice)[inner] == pytest.approx(expected[inner], abs=1e-6)


def test_slumping_moves_but_neither_makes_nor_loses_rock():
    lattice = flow.jittered_lattice(400.0, 20.0, 0.3, np.random.default_rng(1))
    z = np.where(np.hypot(lattice.east_m, lattice.north_m) < 100.0, 200.0, 0.0)
    limit = np.full(z.shape, 0.7)
    links = flow.lattice_links(lattice)
    settled = flow.relax_slopes(z, links, limit, 400)
    assert settled.sum() == pytest.approx(z.sum(), rel=1e-9)
    steepest = max(
        np.abs((settled[a] - settled[b]) / d).max()
        for a, b, d in zip(links.first, links.second, links.length_m, strict=True)
    )
    assert steepest < 0.85


def test_ice_balances_snow_and_melt():
    """A valley glacier ends where its tongue has melted what its névé received, and stays there."""
    row, column = np.mgrid[0:60, 0:21]
    bed = 3400.0 - 25.0 * row + (column - 10.0) ** 2 + 30.0 * np.maximum(4 - row, 0)
    ice, longer = (grow_ice(bed, 100.0, np.full(bed.shape, 3150.0), rounds=n) for n in (1500, 3000))
    assert np.abs(ice - longer).max() < 0.5
    # Slopes below 33° hold all their snow, so that the budget is what grow_ice itself applies.
    assert np.hypot(*np.gradient(bed, 100.0)).max() < 0.65
    balance = mass_balance_m(bed + ice, 3150.0)
    covered = ice > 0.0
    covered[[0, -1]] = covered[:, [0, -1]] = False
    assert ice.max() > 50.0
    assert abs(balance[covered].sum()) < 0.12 * balance[covered & (balance > 0.0)].sum()
    assert (ice[bed < 2650.0] == 0.0).all()


@pytest.mark.parametrize("spacing_m", [15.0, 30.0, 60.0])
def test_the_shipped_massif_is_that_of_the_present_generator(spacing_m):
    """Heights within centimetres and 99 % of the classes: processors round differently, and rivers fork."""
    from seasonscapes.terrain.shipped_massif import _packed, _unpacked, shipped_massif

    shipped = shipped_massif(seed=1912, size_m=12000.0, spacing_m=spacing_m)
    fresh = massif_of(spacing_m)
    assert shipped is not None, "run make massif"
    assert shipped.elevation.transform == fresh.elevation.transform
    for name in ("slope_deg", "northness", "concavity_m", "debris", "shore_m"):
        difference = np.abs(getattr(shipped, name) - getattr(fresh, name))
        assert np.quantile(difference, 0.99) < 0.05, name
    assert np.quantile(np.abs(shipped.elevation.values - fresh.elevation.values), 0.99) < 0.05
    assert (shipped.cover == fresh.cover).mean() > 0.99
    assert shipped_massif(seed=1913, size_m=12000.0, spacing_m=spacing_m) is None
    values = np.random.default_rng(2).normal(size=(7, 5)).astype(np.float32)
    np.testing.assert_array_equal(_unpacked(_packed(values)), values)


def test_a_changed_massif_is_another_place(monkeypatch, tmp_path):
    """Its maps are in the key of the terrain: a mesh of former heights would lie below new ones."""
    workspace = ss.Workspace(tmp_path)
    place = ss.load_place("alpine_small", workspace)
    assert place.synthetic is not None
    elevation = place.synthetic.elevation
    raised = dataclasses.replace(
        place.synthetic, elevation=dataclasses.replace(elevation, values=elevation.values + np.float32(500.0))
    )
    monkeypatch.setattr("seasonscapes.workflows.place.scene_massif", lambda *_: raised)
    again = ss.load_place("alpine_small", workspace)
    assert again.key != place.key
    higher_m = np.median(again.terrain.vertices[:, 2]) - np.median(place.terrain.vertices[:, 2])
    assert higher_m == pytest.approx(500.0, abs=20.0)
