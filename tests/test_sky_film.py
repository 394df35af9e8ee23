"""The sky of thousands of instants: what is looked up agrees with what is worked out, and quick sums with slow twins."""

from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest
from atmosphere_cases import tables_of

from seasonscapes.frames import direction_from_angles
from seasonscapes.rendering.mitsuba_scene import sky_radiance_towards
from seasonscapes.sky import observer_radiance
from seasonscapes.sky.atmosphere import delta_scaled, gas_moments, optics
from seasonscapes.sky.clear_sky import LuminarySource, illumination_from_atmosphere, sky_radiance_map
from seasonscapes.sky.elevation_table import (
    KNOTS_DEG,
    PART_KNOTS,
    PARTS,
    PartedTable,
    interpolate_at_elevation,
    load_table,
    save_table,
    tabulate_by_elevation,
)
from seasonscapes.sky.ephemeris import LunarPosition
from seasonscapes.sky.illumination import luminance
from seasonscapes.sky.models import atmosphere_from_model, read_sky_model
from seasonscapes.sky.night import moon_to_sun_ratio, night_sky_radiance
from seasonscapes.sky.observer_radiance import observed_sky, observer_view, sky_radiance, sky_radiance_grid
from seasonscapes.sky.ray_cells import scattering_per_m
from seasonscapes.sky.sh_moments import HARMONIC_ORDER, diffuse_source, height_index, sun_geometry, zonal
from seasonscapes.sky.spectrum import WAVELENGTHS_NM
from seasonscapes.sky.tables_by_elevation import day_by_elevation, diffuse_by_elevation, moon_by_elevation
from seasonscapes.workflows import illumination as illumination_module
from seasonscapes.workspace import Workspace

HEIGHT_M = 2800.0


@pytest.fixture(scope="module")
def looked_up():
    """Tables that come with diffuse light, and all light of the day and of the moon, for an observer at `HEIGHT_M`."""
    tables = tables_of()

    def looked_up_in(tabulate):
        by_distance = {near: tabulate(tables, HEIGHT_M, near) for near in (False, True)}
        assert sum(table.nbytes for table in by_distance.values()) < 120e6

        def table_of(height_m: float, near: bool) -> np.ndarray:
            assert height_m == HEIGHT_M
            return by_distance[near]

        return table_of

    return replace(
        tables,
        diffuse_of=looked_up_in(diffuse_by_elevation),
        day_of=looked_up_in(day_by_elevation),
        moon_of=looked_up_in(moon_by_elevation),
    )


def worst(table_light: np.ndarray, exact_light: np.ndarray) -> float:
    """Largest relative deviation in luminance."""
    exact = luminance(exact_light)
    return float((np.abs(luminance(table_light) - exact) / exact).max())


@pytest.mark.parametrize(
    ("low_deg", "high_deg", "bound"),
    [
        *((-18.0, -12.0, 1e-2), (-12.0, -6.0, 3e-3), (-6.0, -2.0, 3e-3), (-2.0, 0.0, 3e-3)),
        *((0.0, 1.0, 3e-3), (1.0, 3.0, 3e-3), (3.0, 65.0, 3e-3)),
    ],
)
def test_a_film_s_sky_is_the_picture_s(looked_up, low_deg, high_deg, bound):
    """Random suns between the knots, random lines of sight: sky and airlight within 0.3 % through civil twilight."""
    rng = np.random.default_rng(int(100 + low_deg))
    direction = rng.normal(size=(4000, 3)) * [1.0, 1.0, 0.4]
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    depth_m = 10.0 ** rng.uniform(1.0, 5.3, 4000)
    for _ in range(4):
        sun = direction_from_angles(rng.uniform(0.0, 360.0), rng.uniform(low_deg, high_deg))
        exact, quick = (
            illumination_from_atmosphere(tables, sun, HEIGHT_M, shape=(32, 64)) for tables in (tables_of(), looked_up)
        )
        assert worst(quick.sky_radiance, exact.sky_radiance) < bound
        for depth in (depth_m, np.full(4000, np.inf)):
            (through, air), (exact_through, exact_air) = (
                light.aerial_perspective(depth, direction) for light in (quick, exact)
            )
            assert worst(air, exact_air) < bound
            np.testing.assert_array_equal(through, exact_through)
        if exact.sun is not None:
            np.testing.assert_array_equal(quick.sun.normal_illuminance_lx, exact.sun.normal_illuminance_lx)


@pytest.mark.parametrize("sun_deg", [-8.0, 0.2, 35.0])
def test_distances_along_the_same_rays_are_the_same_air(looked_up, sun_deg):
    """Aerial perspective on a grid of distances × directions, and at one distance for all, against one ray after another."""
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(9, 11, 3)) * [1.0, 1.0, 0.3]
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    moon = LuminarySource(direction_from_angles(120.0, 17.3), 1e-6, 0.26)
    sun = direction_from_angles(210.0, sun_deg)
    air = illumination_from_atmosphere(looked_up, sun, HEIGHT_M, moon=moon, shape=(8, 16)).aerial_perspective
    distances_m = np.array([0.0, 35.0, 1.7e4, 2.9e5, 1.3e6, 5e6, np.inf])
    grid = air(distances_m[:, None, None], direction)
    for number, distance_m in enumerate(distances_m):
        each = air(np.full((9, 11), distance_m), direction)
        alone = air(float(distance_m), direction)
        for on_grid, single, expected in zip(grid, alone, each, strict=True):
            assert on_grid.shape == (7, 9, 11, 3)
            np.testing.assert_allclose(on_grid[number], expected, rtol=2e-6, atol=1e-9 * expected.max())
            np.testing.assert_array_equal(single, on_grid[number])


def test_a_sun_deep_below_the_horizon_lights_no_air(looked_up):
    """What is left out is less than 0.1 % of the natural night sky's radiance in every direction."""
    shape = (16, 32)
    for azimuth_deg in (0.0, 130.0):
        direction = direction_from_angles(azimuth_deg, -25.0)
        left_out = sky_radiance_map(looked_up, direction, HEIGHT_M, shape=shape)[:8]
        night = night_sky_radiance(*shape, height_m=HEIGHT_M)[:8]
        assert luminance(left_out).max() > 0.0
        assert (luminance(left_out) < 1e-3 * luminance(night)).all()
    dark, dim = (
        illumination_from_atmosphere(looked_up, direction_from_angles(130.0, deg), HEIGHT_M, shape=shape)
        for deg in (-25.1, -24.9)
    )
    assert dark.sky_radiance.max() == 0.0 < dim.sky_radiance.max()
    np.testing.assert_array_equal(dark.aerial_perspective(5e3, direction_from_angles(0.0, 1.0))[1], 0.0)


@pytest.mark.parametrize("moon_deg", [0.4, 2.3, 31.0])
def test_a_moonlit_film_s_sky_is_the_picture_s(looked_up, moon_deg, monkeypatch):
    """Each channel of sky and airlight within 0.3 % of the brightest, at two phases, without integrals along rays."""
    rng = np.random.default_rng(int(10 * moon_deg))
    direction = rng.normal(size=(2000, 3)) * [1.0, 1.0, 0.4]
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    depth_m = 10.0 ** rng.uniform(1.0, 5.3, 2000)
    sun = direction_from_angles(rng.uniform(0.0, 360.0), -40.0)
    for phase_deg in (3.0, 95.0):
        seen = LunarPosition(rng.uniform(0.0, 360.0), moon_deg, moon_deg, 385_000.0, 1.0, phase_deg, 0.5, True)
        moon = LuminarySource(seen.direction, moon_to_sun_ratio(seen, WAVELENGTHS_NM), 0.26)
        exact = illumination_from_atmosphere(tables_of(), sun, HEIGHT_M, moon=moon, shape=(32, 64))
        with monkeypatch.context() as patched:
            patched.setattr(observer_radiance, "radiance_components", None)
            quick = illumination_from_atmosphere(looked_up, sun, HEIGHT_M, moon=moon, shape=(32, 64))
        pairs = [(quick.sky_radiance, exact.sky_radiance)]
        pairs += [
            (quick.aerial_perspective(depth, direction)[1], exact.aerial_perspective(depth, direction)[1])
            for depth in (depth_m, np.full(2000, np.inf))
        ]
        for found, expected in pairs:
            assert 0.0 < (np.abs(found - expected) / expected.max(axis=-1, keepdims=True)).max() < 3e-3


def test_the_moon_s_colour_is_kept(looked_up):
    """Moonlight has another spectrum than sunlight: each channel within 0.3 % of the brightest, not luminance alone."""
    sun, spectrum = direction_from_angles(300.0, -25.0), 2e-6 * np.linspace(0.7, 1.3, 9)
    moon = LuminarySource(direction_from_angles(120.0, 17.3), spectrum, 0.26)
    exact, quick = (
        illumination_from_atmosphere(tables, sun, HEIGHT_M, moon=moon, shape=(32, 64))
        for tables in (tables_of(), looked_up)
    )
    unlike = illumination_from_atmosphere(
        looked_up, sun, HEIGHT_M, moon=replace(moon, irradiance=spectrum[::-1]), shape=(32, 64)
    )
    scale = exact.sky_radiance.max(axis=-1, keepdims=True)
    assert (np.abs(quick.sky_radiance - exact.sky_radiance) / scale).max() < 3e-3
    assert (np.abs(unlike.sky_radiance - exact.sky_radiance) / scale).max() > 0.05
    direction = direction_from_angles(np.arange(0.0, 360.0, 10.0), 1.0)
    air, exact_air = (light.aerial_perspective(np.full(36, 3e4), direction)[1] for light in (quick, exact))
    assert (np.abs(air - exact_air) / exact_air.max(axis=-1, keepdims=True)).max() < 3e-3


def test_a_table_by_elevation_is_cubic_and_fine_enough(tmp_path):
    def values_of(suns_rad: np.ndarray) -> np.ndarray:
        # Three per degree, as twilight; and a line.
        return (
            np.stack([np.exp(1.1 * np.minimum(np.degrees(suns_rad), 5.0)), 100.0 + np.degrees(suns_rad)], axis=1)[
                :, None
            ]
            + 1e-20
        )

    told: list[float] = []
    table = tabulate_by_elevation(values_of, progress=told.append)
    assert told[-1] == 1.0 and sorted(told) == told  # noqa: PT018 (one statement of what progress is)
    assert len(table) == len(KNOTS_DEG)
    save_table(table, tmp_path / "t.npy")
    kept = load_table(tmp_path / "t.npy")
    for elevation_deg in (*np.random.default_rng(4).uniform(-12.0, 3.0, 40), -12.0, 0.0, -29.99, 90.0):
        rad = np.radians(elevation_deg)
        expected = values_of(np.array([rad]))[0]
        found = interpolate_at_elevation(kept, rad)
        assert found.shape == (1, 2)
        rows = slice(None) if elevation_deg >= -12.0 else slice(1, 2)
        np.testing.assert_allclose(found[0, rows], expected[0, rows], rtol=1e-3)
        np.testing.assert_array_equal(found, interpolate_at_elevation(table, rad))
    np.testing.assert_array_equal(
        interpolate_at_elevation(kept, np.radians(-80.0)), interpolate_at_elevation(kept, np.radians(KNOTS_DEG[0]))
    )


def test_diffuse_source_is_the_plain_sum_over_harmonics():
    """``J = Σ_a β_a Σ_lm χ_al Φ_lm Y_lm`` of one cell after the other, with Φ interpolated linearly."""
    tables = tables_of()
    view = observer_view(tables, HEIGHT_M)
    scaled = delta_scaled(optics(tables.atmosphere), HARMONIC_ORDER)
    suns, azimuths = np.radians([-7.3, 1.2, 33.0]), np.radians([10.0, 80.0, 170.0])
    geometry = sun_geometry(view.sky, view.elevation_rad, suns, azimuths)
    found = diffuse_source(tables.atmosphere, scaled, tables.moments, view.sky, geometry)
    index, share, cosines = geometry.knot_index, geometry.knot_fraction, geometry.azimuthal
    row, share_of_row = height_index(tables.atmosphere, view.sky.height_m)
    sigma = scattering_per_m(tables.atmosphere, scaled, view.sky.height_m)
    chi = np.stack([gas_moments(HARMONIC_ORDER), scaled.aerosol_moments[: HARMONIC_ORDER + 1]])
    rng = np.random.default_rng(8)
    for k, s, q in zip(
        rng.integers(0, len(found), 60), rng.integers(0, found.shape[1], 60), rng.integers(0, 3, 60), strict=True
    ):

        def at(table, k=k, s=s, q=q):
            low, high = (
                table[row[k, s] + up, index[k, s, q]] * (1.0 - share[k, s, q])
                + table[row[k, s] + up, index[k, s, q] + 1] * share[k, s, q]
                for up in (0, 1)
            )
            return low * (1.0 - share_of_row[k, s]) + high * share_of_row[k, s]

        harmonics = zonal(np.sin(view.sky.elevation_rad[k, s]), HARMONIC_ORDER) * cosines[k, s, q]
        phase = np.einsum("ab,al->lb", sigma[:, k, s], chi)
        total = np.einsum("lb,lmb,lm->b", phase, at(tables.moments.ratio.astype(float)), harmonics)
        expected = np.maximum(total, 0.0) * np.exp(at(tables.moments.log_mean.astype(float)))
        np.testing.assert_allclose(found[k, s, q], expected, rtol=2e-5)


def test_a_grid_of_directions_is_the_same_sky():
    tables, sun = tables_of(), direction_from_angles(200.0, 4.0)
    light = observed_sky(tables, observer_view(tables, HEIGHT_M), sun, np.radians(4.0), np.ones(9))
    elevation_deg, azimuth_deg = np.linspace(-89.0, 89.0, 41), np.linspace(0.0, 359.0, 30)
    directions = direction_from_angles(azimuth_deg[None, :], elevation_deg[:, None])
    np.testing.assert_allclose(
        sky_radiance_grid(light, elevation_deg, azimuth_deg), sky_radiance(light, directions), rtol=1e-4
    )


def test_film_tables_are_built_once_and_whole(tmp_path):
    """A table that has no manifest, as an interrupted run leaves it, is built anew; a finished one is read."""
    workspace, built = Workspace(tmp_path), []
    sun_rad = np.radians(KNOTS_DEG[PART_KNOTS + 4])  # whose neighbours are of the same part

    def build(tables, height_m, near, *, part):
        built.append((height_m, near))
        return tabulate_by_elevation(lambda suns: np.full((len(suns), 2), 1.0 + near), part=part)

    tables = tables_of()

    def table_of():
        return illumination_module._parted_in(workspace, tables, "sky/some", build)

    for _ in range(2):
        diffuse_of = table_of()
        for _ in range(2):
            assert interpolate_at_elevation(diffuse_of(900.0, True), sun_rad) == pytest.approx(2.0, rel=1e-3)
    assert built == [(900.0, True)]
    (manifest,) = tmp_path.rglob("*.npy.json")
    manifest.unlink()
    assert interpolate_at_elevation(table_of()(900.0, True), sun_rad) == pytest.approx(2.0, rel=1e-3)
    other = table_of()(901.0, True)
    assert len(built) == 2, "a table is built where it is needed"
    assert interpolate_at_elevation(other, sun_rad) == pytest.approx(2.0, rel=1e-3)
    assert built == [(900.0, True), (900.0, True), (901.0, True)]


def test_parts_of_a_table_are_the_whole_table():
    def values_of(suns_rad: np.ndarray) -> np.ndarray:
        return np.exp(np.degrees(suns_rad) / 30.0)[:, None]

    whole, asked = tabulate_by_elevation(values_of), []

    def part_of(number: int) -> np.ndarray:
        asked.append(number)
        return tabulate_by_elevation(values_of, part=number)

    table = PartedTable(part_of)
    for elevation_deg in (-40.0, -17.9, 0.01, 4.4, 33.0, 90.0):
        rad = np.radians(elevation_deg)
        np.testing.assert_array_equal(interpolate_at_elevation(table, rad), interpolate_at_elevation(whole, rad))
    assert len(asked) == len(set(asked)) < PARTS


def test_light_for_a_film_takes_its_tables_from_the_workspace(tmp_path, looked_up, monkeypatch):
    """Once they lie there, a second process sees the same sky to the digit; the sky behind the land is the picture's."""
    import places

    from seasonscapes.workflows.place import load_place
    from seasonscapes.workflows.views import camera_for

    asked, by_day = [], []

    def builder_of(table_of, asked):
        def build(tables, height_m, near, *, part):
            asked.append((height_m, near, part))
            # The land's own sky is not compared here, so the camera's table will do for its height too.
            return table_of(HEIGHT_M, near)[part * PART_KNOTS : (part + 1) * PART_KNOTS]

        return build

    assert atmosphere_from_model(read_sky_model("clear")) == tables_of().atmosphere
    monkeypatch.setattr(illumination_module, "atmosphere_tables", lambda _: tables_of())
    moons: list[tuple] = []
    for kind, of_kind in (("diffuse", asked), ("day", by_day), ("moon", moons)):
        build = builder_of(getattr(looked_up, f"{kind}_of"), of_kind)
        monkeypatch.setattr(illumination_module, f"{kind}_by_elevation", build)
    place = load_place(places.write_place(tmp_path), Workspace(tmp_path / "work"))
    view = place.scene.camera(None).model_copy(update={"above_ground_m": None, "height_m": HEIGHT_M})
    camera, model = camera_for(place, view, size_px=(32, 24)), read_sky_model("clear")
    when, told = datetime(2024, 9, 1, 18, 3, tzinfo=UTC), []
    illumination_module.tabulate_illumination(place, camera, model, [])
    assert not asked
    illumination_module.tabulate_illumination(place, camera, model, [when], progress=told.append)
    assert told[-1] == 1.0
    tables = list(dict.fromkeys((height_m, near) for height_m, near, _ in asked))
    assert [near for _, near in tables] == [False, False, True]
    heights = [place.median_height_m, HEIGHT_M, HEIGHT_M]
    np.testing.assert_allclose([height_m for height_m, _ in tables], heights, atol=1e-3)
    assert len(asked) <= 2 * len(tables), "the sun's neighbourhood alone; the moon has set"
    # A moon as ever, and one in the Earth's shadow, whose colour is in no table of the moon.
    for moonlit, eclipsed in (
        (datetime(2024, 9, 18, 23, tzinfo=UTC), False),
        (datetime(2025, 9, 7, 18, 30, tzinfo=UTC), True),
    ):
        before = len(moons)
        illumination_module.tabulate_illumination(place, camera, model, [moonlit])
        built = len(asked), len(moons)
        assert eclipsed == (len(moons) == before)
        _, in_film = illumination_module.illumination_for_camera(
            place, camera, model, moonlit, map_height=4, by_elevation=True
        )
        alone = illumination_module.position_at(place, moonlit)
        for body in ("sun", "moon"):
            np.testing.assert_allclose(
                getattr(in_film, body).direction, getattr(alone, body).direction, rtol=0.0, atol=1e-12
            )
        assert (len(asked), len(moons)) == built, "those of the sun and of the moon"
    built = len(asked)
    exact, moment = illumination_module.illumination_for_camera(place, camera, model, when, map_height=16)
    assert -3.0 < moment.sun.elevation_deg < 3.0
    quick, _ = illumination_module.illumination_for_camera(place, camera, model, when, map_height=16, by_elevation=True)
    illumination_module.atmosphere_tables_in.cache_clear()
    again, _ = illumination_module.illumination_for_camera(place, camera, model, when, map_height=16, by_elevation=True)
    assert len(asked) == built
    assert 0.0 < worst(quick.visible_sky, exact.visible_sky) < 3e-3
    np.testing.assert_array_equal(again.visible_sky, quick.visible_sky)
    np.testing.assert_array_equal(again.sky_radiance, quick.sky_radiance)
    assert not by_day, "the sun is on the horizon"
    noon = datetime(2024, 9, 1, 11, 20, tzinfo=UTC)
    illumination_module.tabulate_illumination(place, camera, model, [noon])
    built_by_day = len(by_day)
    exact, quick = (
        illumination_module.illumination_for_camera(place, camera, model, noon, map_height=64, by_elevation=film)[0]
        for film in (False, True)
    )
    assert quick.visible_sky.size == 0, "the airlight is all of the sky"
    direction = np.random.default_rng(11).normal(size=(2000, 3))
    direction[:, 2] = np.abs(direction[:, 2])
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    seen = sky_radiance_towards(replace(quick, sun=None), direction, 0.1)
    assert 0.0 < worst(seen, exact.aerial_perspective(np.inf, direction)[1]) < 3e-3
    # The picture's map is coarse here, and blurs the sky around the sun.
    far = direction @ exact.sun.direction < np.cos(np.radians(25.0))
    assert worst(seen[far], sky_radiance_towards(replace(exact, sun=None), direction[far], 0.1)) < 1e-2
    assert 0 < built_by_day == len(by_day)
    assert len(asked) == built, "by day all light comes from the tables of the day"


def test_median_height_is_computed_once(tmp_path, monkeypatch):
    import places

    from seasonscapes.workflows.place import load_place

    place = load_place(places.write_place(tmp_path), Workspace(tmp_path / "work"))
    median = float(np.median(place.elevation.values))
    assert place.median_height_m == median
    monkeypatch.setattr(np, "median", lambda values: pytest.fail("computed again"))
    assert place.median_height_m == median


def test_a_cluster_waits_for_the_light_of_missing_frames_alone(tmp_path, monkeypatch):
    from seasonscapes import cluster
    from seasonscapes.workflows import timelapse

    asked, handed, times = [], [], [datetime(2024, 9, 1, hour, tzinfo=UTC) for hour in (9, 12, 15)]
    session = SimpleNamespace(place=None, camera=None, sky=None, coefficients=SimpleNamespace(pixel=[]))
    monkeypatch.setattr(timelapse, "cached_session", lambda *_, **__: session)
    monkeypatch.setattr(timelapse, "frames_folder", lambda _: tmp_path)

    def run(_, task, items):
        handed.append([time.hour for time in items])
        return [{"rendered": True} for _ in items]

    monkeypatch.setattr(cluster, "run_on_cluster", run)
    monkeypatch.setattr(
        illumination_module, "tabulate_illumination", lambda *of, progress: asked.append([time.hour for time in of[3]])
    )
    for kept, exr_folder in ((times[:2], None), (times[2:], None), ([], tmp_path / "exr")):
        for time in kept:
            (tmp_path / timelapse.frame_name(time)).touch()
        timelapse.render_frames(None, times, cluster="local:2", exr_folder=exr_folder)
    assert asked == [[15], [], [9, 12, 15]]
    # Missing frames first: what is there is only checked.
    assert handed == [[15, 9, 12], [9, 12, 15], [9, 12, 15]]
