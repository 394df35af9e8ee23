"""Relief below the data: means stay, detail is deterministic and seamless, light at the data's resolution stays."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from affine import Affine

from seasonscapes.terrain.amplification import amplified
from seasonscapes.terrain.lattice_noise import gradient_noise, lattice_hash
from seasonscapes.terrain.surface import Raster
from seasonscapes.terrain.synthetic import alpine_massif

SPACING_M = 30.0


@pytest.fixture(scope="module")
def mountain() -> Raster:
    """A part of the synthetic massif, 3.8 km wide."""
    massif = alpine_massif(seed=1912, size_m=12000.0, spacing_m=SPACING_M)
    whole = massif.elevation
    return replace(
        whole, values=whole.values[100:228, 120:248], transform=whole.transform * Affine.translation(120, 100)
    )


def means(fine: Raster, factor: int) -> np.ndarray:
    height, width = (size // factor for size in fine.values.shape[:2])
    return fine.values[..., 0].astype(float).reshape(height, factor, width, factor).mean(axis=(1, 3))


@pytest.mark.parametrize("factor", [2, 4, 8])
def test_means_stay_the_raster(mountain, factor):
    fine = amplified(mountain, factor, seed=3)
    assert fine.values.shape[:2] == tuple(factor * size for size in mountain.values.shape[:2])
    assert np.abs(means(fine, factor) - mountain.values[..., 0]).max() < 1e-3
    for corner in ((0, 0), (128, 128)):
        np.testing.assert_allclose(fine.transform * (factor * np.array(corner)), mountain.transform * corner)


def test_levels_agree(mountain):
    """Halved again, a finer level is the coarser one: what lies near and what lies far fit together."""
    np.testing.assert_allclose(means(amplified(mountain, 8), 2), amplified(mountain, 4).values[..., 0], atol=1e-3)


def test_detail_follows_place_and_seed(mountain):
    fine, again, other = (amplified(mountain, 4, seed=seed).values for seed in (5, 5, 6))
    np.testing.assert_array_equal(fine, again)
    assert np.abs(fine - other).mean() > 0.2
    # Known parts of a raster are amplified as the whole is, but for the surroundings of their rims.
    rows, columns = slice(0, 100), slice(14, 128)
    part = replace(
        mountain, values=mountain.values[rows, columns], transform=mountain.transform * Affine.translation(14, 0)
    )
    apart = amplified(part, 4, seed=5).values[40:200, 160:-40]
    whole = fine[40:200, 4 * 14 + 160 : 4 * 14 + 160 + apart.shape[1]]
    assert np.abs(apart - whole).mean() < 0.08 * np.abs(fine - other).mean()


def test_plains_stay_smooth_and_slopes_have_gullies(mountain):
    level = replace(mountain, values=np.full_like(mountain.values, 700.0))
    assert np.abs(amplified(level, 4).values - 700.0).max() < 1e-3
    fine = amplified(mountain, 4, seed=1).values[..., 0].astype(float)
    detail = fine - np.kron(mountain.values[..., 0], np.ones((4, 4)))
    down, across = np.gradient(mountain.values[..., 0].astype(float), SPACING_M)
    steep = np.hypot(down, across) > np.tan(np.radians(30.0))
    rough = detail.reshape(128, 4, 128, 4).std(axis=(1, 3))
    assert rough[steep].mean() > 2.0 * rough[np.hypot(down, across) < np.tan(np.radians(12.0))].mean()


@pytest.mark.parametrize("elevation_deg", [20.0, 35.0, 60.0])
def test_light_at_the_resolution_of_the_data_stays(mountain, elevation_deg):
    """The light of a sun in the south on cells of the map, with the shadows that slopes cast: within 2 % in the mean."""
    rise = np.tan(np.radians(elevation_deg))

    def lit(heights, spacing_m):
        """Illuminance per area of the map, over the normal illuminance: rays come up the columns of the grid."""
        above = heights.astype(float) - np.arange(len(heights))[:, None] * spacing_m * rise
        horizon = np.maximum.accumulate(above[::-1], axis=0)[::-1]
        # What rises above all that lies south of it catches the light between both.
        caught = np.maximum(above[:-1] - horizon[1:], 0.0)
        return caught / spacing_m * np.cos(np.radians(elevation_deg))

    fine = lit(amplified(mountain, 4, seed=2).values[..., 0], SPACING_M / 4)
    coarse = lit(amplified(mountain, 1).values[..., 0], SPACING_M)
    assert fine.mean() == pytest.approx(coarse.mean(), rel=0.02)
    # So it is in each ninth of the place.
    thirds = [
        np.array([[part.mean() for part in np.array_split(band, 3, axis=1)] for band in np.array_split(each, 3)])
        for each in (fine, coarse)
    ]
    assert np.abs(thirds[0] - thirds[1]).max() < 0.03 * thirds[1].max()


def test_noise_has_no_grid_and_no_bias():
    assert len(np.unique(lattice_hash(np.arange(1000), np.arange(1000)[:, None], 1))) > 999_500
    x, y = np.random.default_rng(1).uniform(0.0, 500.0, (2, 100_000))
    assert abs(gradient_noise(x, y, 7).mean()) < 0.01
    step = gradient_noise(x + 1e-5, y, 7) - gradient_noise(x, y, 7)
    assert np.abs(step).max() < 1e-4


def test_factors_are_powers_of_two(mountain):
    with pytest.raises(ValueError, match="got 3, expected a power of two"):
        amplified(mountain, 3)


@pytest.mark.parametrize("seed", [1, 28, 1234])
def test_a_measured_place_is_land_for_every_seed(monkeypatch, seed):
    """Seeds 28 and 1234 once gave valleys 800 m and 900 m below the sea, which are refused as heights."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    from detail import wide_relief

    heights = wide_relief(seed).values[..., 0]
    assert heights.shape == (250, 300)
    assert heights.min() >= 0.0
    assert np.ptp(heights) > 3000.0


def test_a_failed_picture_says_why(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    from detail import first_picture

    scene = tmp_path / "bad.toml"
    scene.write_text('name = "bad"\n[elevation]\nfile = "absent.tif"\n')
    with pytest.raises(SystemExit, match=r"exited with 2.*absent\.tif"):
        first_picture(scene, tmp_path, (96, 64))
