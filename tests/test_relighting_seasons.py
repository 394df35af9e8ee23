"""Days between dated albedos: snow goes up and comes down the mountain and does not fade."""

import json
import logging
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np
import places
import pytest
from scipy.stats import spearmanr

from seasonscapes.albedo.seasons import (
    AlbedoSeries,
    DatedAlbedo,
    albedo_at,
    interpolate_albedo,
    neighbouring_dates,
    snow_share,
    snow_transition,
    snowline_fraction,
    warn_of_unseen_seasons,
)
from seasonscapes.cli import main
from seasonscapes.scene import read_scene
from seasonscapes.sky.models import read_sky_model
from seasonscapes.terrain.attributes import TerrainAttributes, texel_attributes
from seasonscapes.terrain.surface import Texture, load_texture, save_texture
from seasonscapes.workflows.albedo_sources import AlbedoFile, albedo_of_day, dated_albedos
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workflows.relight_session import RenderJob, open_session, view_of_day
from seasonscapes.workspace import Workspace

BARE, WHITE = np.array([0.12, 0.14, 0.05], np.float32), np.array([0.80, 0.80, 0.82], np.float32)
SNOWY, GREEN = date(2023, 4, 10), date(2023, 7, 19)
DAYS = [SNOWY + timedelta(days=10 * k) for k in range(11)]
BANDS_M = np.linspace(900.0, 2100.0, 7)


def slopes(count: int, *, seed: int = 0) -> TerrainAttributes:
    """Places of a mountain that face all ways, up to 2,000 m."""
    rng = np.random.default_rng(seed)
    turn, tilt = rng.uniform(0.0, 2.0 * np.pi, count), np.radians(rng.uniform(5.0, 35.0, count))
    normal = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=1)
    return TerrainAttributes(rng.uniform(0.0, 3000.0, count), normal, np.zeros(count))


def snow_above(ground: TerrainAttributes, line_m: float, *, by_north_m: float = 500.0) -> np.ndarray:
    white = ground.height_m > line_m - by_north_m * ground.normal[:, 1]
    return np.where(white[:, None], WHITE, BARE).astype(np.float32)


def half_done(values: np.ndarray) -> float:
    """Share of places that are neither white nor bare."""
    share = (values - BARE)[..., 1] / (WHITE - BARE)[1]
    return float(np.mean((share > 0.15) & (share < 0.85)))


@pytest.mark.parametrize(("first_m", "second_m"), [(1000.0, 2000.0), (2300.0, 900.0)])
def test_the_line_moves_up_and_down(first_m, second_m):
    ground = slopes(6000)
    pair = (snow_above(ground, first_m), snow_above(ground, second_m))
    turning = snow_transition(ground, *pair)
    changed = np.any(pair[0] != pair[1], axis=1)
    np.testing.assert_array_equal(turning[:, 0], changed)
    for way in (0.25, 0.5, 0.75):
        truth = snow_above(ground, first_m + way * (second_m - first_m))
        moved = interpolate_albedo(pair, turning, way, way)
        faded = (1.0 - way) * pair[0] + way * pair[1]
        assert np.mean((moved - truth) ** 2) < 0.12 * np.mean((faded - truth) ** 2)
        assert half_done(moved) < 0.15 * changed.mean()
    for way, end in enumerate(pair):
        np.testing.assert_array_equal(interpolate_albedo(pair, turning, float(way), float(way)), end)
    # A line that was seen elsewhere than time says is believed.
    late = interpolate_albedo(pair, turning, 0.5, 0.9)
    truth = snow_above(ground, first_m + 0.9 * (second_m - first_m))
    assert np.mean((late - truth) ** 2) < 0.2 * np.mean((interpolate_albedo(pair, turning, 0.5, 0.5) - truth) ** 2)
    with pytest.raises(ValueError, match="expected 0 to 1"):
        interpolate_albedo(pair, turning, 1.2, 1.0)


def test_what_no_snow_explains_follows_time():
    ground = slopes(50)
    summer, autumn = np.tile(BARE, (50, 1)), np.tile(BARE + np.float32(0.1), (50, 1))
    turning = snow_transition(ground, summer, autumn)
    assert not turning.any()
    np.testing.assert_allclose(interpolate_albedo((summer, autumn), turning, 0.3, 0.9), summer + 0.03, atol=1e-6)


def test_snow_that_ages_stays_snow():
    """Firn is darker than fresh snow, and no sign of a line above the summits."""
    ground = slopes(4000)
    high = ground.height_m[:, None] > 2200.0
    pair = (snow_above(ground, 1000.0), np.where(high, np.float32(0.62), snow_above(ground, 1900.0)))
    turning = snow_transition(ground, *pair)
    assert not turning[high[:, 0], 0].any()
    half = interpolate_albedo(pair, turning, 0.5, 0.5)
    np.testing.assert_allclose(half[high[:, 0]], 0.5 * (pair[0] + pair[1])[high[:, 0]], atol=1e-6)
    truth = snow_above(ground, 1450.0)
    assert np.mean((half - truth)[~high[:, 0]] ** 2) < 0.2 * np.mean(
        (0.5 * (pair[0] + pair[1]) - truth)[~high[:, 0]] ** 2
    )


def test_days_between_are_nearer_the_truth_than_a_cross_fade():
    """On the massif, whose snow knows aspect, hollows, walls, forests, patches and its own table of line heights."""
    from seasonscapes.frames import LocalFrame
    from seasonscapes.terrain.imagery import bake_imagery
    from seasonscapes.terrain.mesh import build_mesh
    from seasonscapes.terrain.surface import Raster
    from seasonscapes.terrain.synthetic import alpine_albedo, alpine_massif
    from seasonscapes.terrain.unwrap import unwrap

    place = alpine_massif(seed=23, size_m=6000.0, spacing_m=60.0)
    terrain, atlas = unwrap(build_mesh(place.elevation, LocalFrame(46.55, 7.98), mesher="grid"), texel_m=60.0)
    ground, texel = texel_attributes(terrain, (atlas.height_px, atlas.width_px))

    def worn(day: float) -> np.ndarray:
        image = Raster(alpine_albedo(place, day), place.elevation.transform, place.elevation.crs)
        return bake_imagery(terrain, atlas, image).values.reshape(-1, 3)[texel]

    def psnr(values: np.ndarray, truth: np.ndarray) -> float:
        return float(-10.0 * np.log10(np.mean((values - truth) ** 2)))

    gains = []
    for first, second, day in ((90.0, 197.0, 152.0), (213.0, 15.0, 288.0), (115.0, 145.0, 130.0)):
        dated, truth = np.stack([worn(first), worn(second)]), worn(day)
        _, _, way = neighbouring_dates([first, second], day)
        faded = (1.0 - way) * dated[0] + way * dated[1]
        gains.append(psnr(albedo_at(dated, (first, second), day, ground), truth) - psnr(faded, truth))
    assert min(gains) > 2.0, gains
    assert np.mean(gains) > 4.0, gains


def test_where_dates_say_nothing_heights_decide():
    """All white on one date and all bare on the other: valleys and south faces are free first."""
    ground = slopes(3000)
    pair = (np.tile(WHITE, (3000, 1)), np.tile(BARE, (3000, 1)))
    half = snow_share(interpolate_albedo(pair, snow_transition(ground, *pair), 0.5, 0.5))
    tenth = len(half) // 10
    order = np.argsort(ground.height_m)
    assert half[order[:tenth]].max() < 0.01, "the lowest tenth is bare"
    assert half[order[-tenth:]].min() > 0.99, "the highest tenth is white"
    for sign in (-1.0, 1.0):
        facing = sign * ground.normal[:, 1] > 0.2
        assert spearmanr(half[facing], ground.height_m[facing])[0] > 0.9
    middle = np.abs(ground.height_m - 1500.0) < 200.0
    north, south = (middle & (sign * ground.normal[:, 1] > 0.2) for sign in (1.0, -1.0))
    assert half[north].mean() > half[south].mean() + 0.15


def test_the_year_is_a_circle():
    assert neighbouring_dates([100.0, 200.0], 150.0) == (0, 1, 0.5)
    first, second, way = neighbouring_dates([100.0, 200.0], 20.0)
    assert (first, second) == (1, 0)
    assert way == pytest.approx(185.2422 / 265.2422)
    assert neighbouring_dates([100.0, 200.0], 200.0) == (1, 1, 0.0)
    assert neighbouring_dates([100.0], 10.0) == (0, 0, 0.0)


def test_the_line_keeps_the_climate():
    """From January to July snow stays low till April; the other way it waits for autumn; at the ends nothing jumps."""
    assert snowline_fraction(15.0, 197.0, 60.0) < 0.05
    assert 0.15 < snowline_fraction(15.0, 197.0, 106.0) < 0.4
    assert snowline_fraction(197.0, 15.0, 240.0) < 0.05
    # Dates of like climate tell no direction, and a month has no time for more than a straight line.
    assert snowline_fraction(130.0, 310.0, 220.0) == pytest.approx(0.5, abs=0.02)
    assert snowline_fraction(115.0, 145.0, 130.0) == pytest.approx(0.5, abs=0.02)
    for first, second in ((15.0, 197.0), (197.0, 15.0), (60.0, 213.0), (335.0, 74.0), (258.0, 345.0)):
        days = first + np.linspace(0.0, (second - first) % 365.2422, 40)
        shares = np.array([snowline_fraction(first, second, day) for day in days])
        assert shares[0] == 0.0
        assert shares[-1] == pytest.approx(1.0, abs=1e-6)
        assert np.diff(shares).min() > -0.03


def test_albedo_at_knows_its_dates():
    ground = slopes(4000)
    days, dated = (100.0, 140.0), np.stack([snow_above(ground, 1000.0), snow_above(ground, 2000.0)])
    between, truth = albedo_at(dated, days, 120.0, ground), snow_above(ground, 1500.0)
    assert np.abs(between - truth).mean() < 0.3 * np.abs(dated.mean(axis=0) - truth).mean()
    np.testing.assert_array_equal(albedo_at(dated, days, 140.0, ground), dated[1])
    np.testing.assert_array_equal(albedo_at(dated[:1], days[:1], 300.0, ground), dated[0])
    for wrong in ((dated[:0], (), 1.0), (dated, days, float("nan"))):
        with pytest.raises(ValueError, match="albedo_at"):
            albedo_at(*wrong, ground)


def test_a_series_is_sorted_and_checked():
    dated = tuple(
        DatedAlbedo(day, str(day), lambda: Texture(np.zeros((1, 1, 3))))
        for day in (date(2023, 8, 1), date(2022, 4, 10))
    )
    series = AlbedoSeries(dated)
    assert [each.day.month for each in series.dated] == [4, 8]
    assert series == AlbedoSeries(dated[::-1], "blended")
    with pytest.raises(ValueError, match="no dated albedo"):
        AlbedoSeries(())
    with pytest.raises(ValueError, match="'monsoon'"):
        AlbedoSeries(dated, "monsoon")


# --------------------------------------------------------------------------------------------------- films of a place


@pytest.fixture(scope="module")
def mountain(tmp_path_factory) -> RenderJob:
    """A cone of 900 m, white on the tenth of April and green in July but for its summit, seen from the south."""
    folder = tmp_path_factory.mktemp("mountain")
    seen = places.SCENE.replace("46.5405", "46.5385").replace("120.0", "500.0").replace("-8.0", "3.0")
    path = places.write_place(folder, seen)
    axis = (np.arange(61) - 30) * 50.0
    east, north = np.meshgrid(axis, -axis)
    places.write_raster(folder / "dem.tif", 1900.0 - 0.6 * np.hypot(east, north), spacing_m=50.0)
    place = load_place(path, Workspace(folder / "workspace"))
    shape = (place.atlas.height_px, place.atlas.width_px)
    ground, texel = texel_attributes(place.terrain, shape)
    pairs = []
    for day, line_m in ((SNOWY, 1150.0), (GREEN, 1800.0)):
        values = np.tile(BARE, (shape[0] * shape[1], 1))
        values[texel] = snow_above(ground, line_m, by_north_m=150.0)
        save_texture(Texture(values.reshape(*shape, 3)), folder / f"{day}.npz")
        pairs.append(AlbedoFile(day, folder / f"{day}.npz"))
    return RenderJob(
        path,
        folder / "workspace",
        MeshOptions(),
        read_scene(path).camera(None),
        (48, 32),
        read_sky_model("hosek"),
        albedo=tuple(pairs),
        season="snow-line",
        base_day=SNOWY,
    )


def by_height(height_m: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean share of snow of each band of height."""
    share, band = snow_share(values), np.digitize(height_m, BANDS_M)
    return np.array([share[band == k].mean() for k in range(1, len(BANDS_M)) if np.any(band == k)])


def test_textures_of_a_spring(mountain):
    place = load_place(Path(mountain.scene), Workspace(Path(mountain.workspace)))
    dated = dated_albedos(place, mountain.albedo)
    ground, texel = texel_attributes(place.terrain, (place.atlas.height_px, place.atlas.width_px))
    film = [
        albedo_of_day(place, AlbedoSeries(tuple(dated), "snow-line"), day).values.reshape(-1, 3)[texel] for day in DAYS
    ]
    faded = [albedo_of_day(place, AlbedoSeries(tuple(dated)), day).values.reshape(-1, 3)[texel] for day in DAYS]
    rows = np.array([by_height(ground.height_m, values) for values in film])
    assert np.diff(rows, axis=1).min() > -0.02, "more snow the higher"
    assert np.diff(rows, axis=0).max() <= 1e-6, "less snow the later"
    assert rows[0].mean() > rows[-1].mean() + 0.4
    changed = np.mean(np.any(film[0] != film[-1], axis=1))
    assert max(half_done(values) for values in film) < 0.25 * changed
    assert half_done(faded[5]) > 0.95 * changed
    for number in (0, -1):
        np.testing.assert_array_equal(
            film[number], load_texture(mountain.albedo[number].path).values.reshape(-1, 3)[texel]
        )
    # The lower edge of the snow climbs, as it does in truth, and does not thin out everywhere at once.
    lowest = [np.percentile(ground.height_m[snow_share(values) > 0.5], 5.0) for values in film]
    assert np.all(np.diff(lowest) >= 0.0)
    assert np.diff(lowest)[1:-1].min() > 0.5 * np.diff(lowest)[1:-1].max()


def test_a_film_of_a_spring(mountain):
    """In the view's own pixels, as frames are lit."""
    from dataclasses import replace

    session = open_session(mountain)
    land = session.coefficients.coverage == 1.0
    height_m = session.coefficients.sample_origin[land][:, 0, 2]
    film = [view_of_day(session, day).coefficients.albedo[land] for day in DAYS]
    rows = np.array([by_height(height_m, values) for values in film])
    assert np.diff(rows, axis=0).max() <= 1e-6
    assert np.diff(rows, axis=1).min() > -0.1
    assert rows[0].mean() > rows[5].mean() + 0.1 > rows[-1].mean() + 0.2
    faded = open_session(replace(mountain, season="blended"))
    middle = view_of_day(faded, DAYS[5]).coefficients.albedo[land]
    assert half_done(film[5]) < 0.5 * half_done(middle)
    # On the dates themselves both wear the very same.
    for number in (0, -1):
        np.testing.assert_array_equal(film[number], view_of_day(faded, DAYS[number]).coefficients.albedo[land])


def test_timelapse_moves_the_snow_line(mountain, tmp_path, capsys):
    common = [
        "timelapse",
        str(mountain.scene),
        "--workspace",
        str(mountain.workspace),
        "--sky",
        "hosek",
        "--size",
        "48x32",
        "--json",
    ]
    given = [part for each in mountain.albedo for part in ("--albedo", f"{each.day}={each.path}")]
    when = ["--times", f"{SNOWY}T11:00Z,2023-05-20T11:00Z,{GREEN}T11:00Z"]
    pictures = {}
    for season in ("snow-line", "blended"):
        output = tmp_path / season
        assert main([*common, *given, *when, "--season", season, "--exposure", "15", "-o", str(output)]) == 0
        assert json.loads(capsys.readouterr().out)["rendered"] == 3
        pictures[season] = [path.read_bytes() for path in sorted(output.glob("*.png"))]
    assert pictures["snow-line"][1] != pictures["blended"][1]
    assert main([*common, *given, *when, "--season", "snowy", "-o", str(tmp_path / "x")]) == 2
    assert "blended, nearest, snow-line" in capsys.readouterr().err


def test_frames_of_a_day_have_its_line(mountain):
    """The light moves through a day, the snow does not; another day has another line."""
    from seasonscapes.workflows.relight_session import view_at

    session = open_session(mountain)
    times = [datetime(2023, month, 20, hour, tzinfo=UTC) for month, hour in ((5, 8), (5, 15), (6, 15))]
    worn = []
    for time in times:
        view_at(session, time)
        worn.append(view_of_day(session, time.date()).coefficients.albedo)
    np.testing.assert_array_equal(worn[0], worn[1])
    assert snow_share(worn[2]).mean() < snow_share(worn[1]).mean()


def test_render_wears_dated_albedos(mountain, tmp_path, capsys):
    from seasonscapes.images import read_exr

    common = [
        "render",
        str(mountain.scene),
        "--workspace",
        str(mountain.workspace),
        "--sky",
        "hosek",
        "--size",
        "48x32",
        "--spp",
        "1",
        *[part for each in mountain.albedo for part in ("--albedo", f"{each.day}={each.path}")],
    ]
    worn = {}
    for season in ("snow-line", "blended", "nearest"):
        assert main([*common, "--time", "2023-05-25T12:00Z", "--season", season, "-o", str(tmp_path / "a.exr")]) == 0
        layers, header = read_exr(tmp_path / "a.exr")
        land = np.isfinite(layers["depth"]) & (layers["depth"] < 1e6)
        worn[season] = layers["albedo"][land]
    record = json.loads(header["seasonscapes:provenance"])
    assert [each["date"] for each in record["albedo"]] == [SNOWY.isoformat(), GREEN.isoformat()]
    assert half_done(worn["snow-line"]) < 0.5 * half_done(worn["blended"])
    assert snow_share(worn["nearest"]).mean() > snow_share(worn["snow-line"]).mean() > 0.02
    capsys.readouterr()
    assert main([*common, "--time", "2023-05-30T12:00Z", "--season", "snowy"]) == 2
    assert "--season" in capsys.readouterr().err


def test_distill_takes_dates_of_any_years(mountain):
    from seasonscapes.errors import InputError
    from seasonscapes.workflows.distillation import dated_textures

    place = load_place(Path(mountain.scene), Workspace(Path(mountain.workspace)))
    snowy, green = (each.path for each in mountain.albedo)

    def dated(*pairs):
        return dated_albedos(place, [AlbedoFile(date.fromisoformat(day), path) for day, path in pairs])

    found = dated_textures(place, dated(("2022-07-19", green), ("2023-04-10", snowy)), 4)
    assert [day for day, _ in found] == [100.0, 200.0]
    np.testing.assert_array_equal(found[0][1], load_texture(snowy).values)
    with pytest.raises(InputError, match="twice"):
        dated_textures(place, dated(("2022-07-19", green), ("2023-07-19", snowy)), 4)


def test_seasons_that_no_picture_shows_are_told(caplog):
    photographed = [date(2019, 12, 28), date(2021, 6, 20)]
    with caplog.at_level(logging.WARNING):
        warn_of_unseen_seasons([date(2024, 1, 30), date(2024, 7, 1)], photographed)
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        warn_of_unseen_seasons([date(2024, 9, 1), date(2024, 9, 1), date(2024, 7, 1)], photographed)
    assert [each.getMessage() for each in caplog.records] == [
        "2024-09-01 lies 74 days of the year from every picture: snow and leaves of that season were never seen"
    ]
