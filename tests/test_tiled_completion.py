"""Completion by tiles: as the whole texture's where both can be had, whatever the tiles, and in bounded memory."""

import numpy as np
import places
import pytest

from seasonscapes.errors import AtlasMismatch, NotEnoughEvidence
from seasonscapes.frames import LocalFrame
from seasonscapes.terrain.mesh import build_mesh
from seasonscapes.terrain.surface import Raster, Texture
from seasonscapes.terrain.unwrap import unwrap
from seasonscapes.texturing import tiled_completion
from seasonscapes.texturing import tiled_predictors as tiled_predictors_module
from seasonscapes.texturing.completion import CompletionOptions, complete
from seasonscapes.texturing.predictors import predictors_for
from seasonscapes.texturing.tiled_completion import complete_tiles
from seasonscapes.texturing.tiled_predictors import TiledPredictors, tiled_predictors

SUN = np.array([0.5, -0.6, 0.624])


@pytest.fixture(scope="module")
def hill():
    """A planar atlas of some 400 × 400 texels with its predictors, a truth that follows from them, and a mask with holes."""
    heights = places.hill_heights(count=61)
    raster = Raster(
        heights[..., None].astype(np.float32), places.Affine(50, 0, 421_000, 0, -50, 5_156_000), "EPSG:32632"
    )
    terrain = build_mesh(raster, LocalFrame(46.55, 7.98, 0.0, 0.13), mesher="grid")
    terrain, atlas = unwrap(terrain, kind="planar", texel_m=7.5, max_side_px=1024)
    rng = np.random.default_rng(4)
    rows, columns = atlas.height_px, atlas.width_px
    image = rng.uniform(0.05, 0.6, (rows // 8 + 1, columns // 8 + 1, 3)).repeat(8, 0).repeat(8, 1)[:rows, :columns]
    satellite = Texture(image.astype(np.float32), np.ones((rows, columns), np.float32))
    satellite.weight[:, : columns // 4] = 0.0
    whole = predictors_for(terrain, atlas, satellite=satellite, sun_direction=SUN)
    sun = np.nan_to_num(whole.values[..., whole.names.index("sun")])
    truth = (1000.0 + image * (8_000.0 + 30_000.0 * sun[..., None])).astype(np.float32)
    row, column = np.mgrid[0:rows, 0:columns]
    seen = (np.hypot(row % 100 - 50, column % 90 - 45) > 25.0) & (row < 0.8 * rows)
    return terrain, atlas, satellite, whole, Texture(truth, (seen & whole.surface).astype(np.float32))


def test_windows_of_predictors_are_those_of_the_whole_atlas(hill):
    terrain, atlas, satellite, whole, _ = hill
    tiled = tiled_predictors(terrain, atlas, satellite=satellite, sun_direction=SUN)
    assert tiled.names == whole.names
    np.testing.assert_array_equal(tiled.surface, whole.surface)
    window = np.s_[130:260, 70:300]
    part = tiled.window(window)
    np.testing.assert_array_equal(part.surface, whole.surface[window])
    inner = whole.surface[window]
    spread = np.nanstd(whole.values, axis=(0, 1))
    error = (part.values - whole.values[window])[inner] / spread
    # Positions of texels are float32 metres there and exact here.
    assert np.nanmax(np.abs(error)) < 1e-4
    np.testing.assert_array_equal(np.isnan(part.values), np.isnan(whole.values[window]) | ~inner[..., None])


def test_predictors_of_a_texel_do_not_depend_on_what_else_is_asked_for(hill, monkeypatch):
    terrain, atlas, satellite, whole, _ = hill
    layers = {"light": np.random.default_rng(5).uniform(size=whole.surface.shape).astype(np.float32)}
    # Cells of a size that no binary number has, so that positions on them are rounded.
    tiled = tiled_predictors(terrain, atlas, satellite=satellite, layers=layers, sun_direction=SUN, most_cells=30_000)
    monkeypatch.setattr(tiled_predictors_module, "_BLOCK", 5000)
    together = tiled.window((slice(0, whole.surface.shape[0]), slice(0, whole.surface.shape[1]))).values
    row, column = np.random.default_rng(6).integers(0, whole.surface.shape, (300, 2)).T
    np.testing.assert_array_equal(tiled.at(row, column), together[row, column])
    for one in range(0, 300, 30):
        alone = tiled.at(row[one : one + 1], column[one : one + 1])[0]
        np.testing.assert_array_equal(alone, together[row[one], column[one]])
    np.testing.assert_array_equal(together[..., tiled.names.index("light")], layers["light"])
    assert np.isnan(together[:, : satellite.weight.shape[1] // 8, -1]).all()
    assert np.isfinite(together[..., tiled.names.index("slope")][whole.surface]).all()
    assert tiled.at(row[:0], column[:0]).shape == (0, len(tiled.names))


def test_coarser_attributes_stay_close_to_the_fine_ones(hill):
    terrain, atlas, _, whole, _ = hill
    tiled = tiled_predictors(terrain, atlas, sun_direction=SUN, most_cells=whole.surface.size // 9)
    inner = np.zeros(whole.surface.shape, bool)
    inner[20:-20, 20:-20] = True
    inner &= whole.surface
    names = [name for name in whole.names if not name.startswith("satellite")]
    for name in ("elevation", "slope", "sky_view"):
        fine = whole.values[..., whole.names.index(name)][inner]
        coarse = tiled.whole().values[..., names.index(name)][inner]
        assert np.corrcoef(fine, coarse)[0, 1] > 0.99, name


def test_tiles_fill_as_the_whole_texture_does(hill, monkeypatch):
    terrain, atlas, satellite, whole, texture = hill
    tiled = tiled_predictors(terrain, atlas, satellite=satellite, sun_direction=SUN)
    painted, hole = texture.weight > 0.0, whole.surface & (texture.weight == 0.0)
    reference = complete(texture, whole, options=CompletionOptions(fast=True))
    flat = np.broadcast_to(np.median(texture.values[painted], axis=0), texture.values.shape)

    def error(values):
        return float(np.sqrt(np.mean((np.cbrt(values) - np.cbrt(texture.values))[hole] ** 2)))

    results = {}
    for tile_px in (4096, 150):
        values, sigma = complete_tiles(texture, painted, tiled, fast=True, tile_px=tile_px)
        np.testing.assert_array_equal(values[painted], texture.values[painted])
        assert np.isfinite(values).all()
        assert (sigma[hole] > 0.0).all()
        assert not sigma[painted].any()
        assert error(values) < 1.05 * error(reference.values)
        results[tile_px] = values
    monkeypatch.setattr(tiled_completion, "HALO_PX", 0)
    monkeypatch.setattr(tiled_completion, "_PHASE_PX", 1)
    results[0], _ = complete_tiles(texture, painted, tiled, fast=True, tile_px=150)
    assert error(reference.values) < 0.55 * error(flat)
    # The regression is the same; residuals of painted texels beyond a tile's border have decayed.
    apart = {px: np.sqrt(np.mean((np.cbrt(results[px]) - np.cbrt(results[4096]))[hole] ** 2)) for px in (150, 0)}
    assert apart[150] < 0.01 * error(results[4096])
    assert apart[0] > 0.01 * error(results[4096])  # without a border


def test_complete_takes_tiles_where_they_do(hill):
    terrain, atlas, satellite, _, texture = hill
    tiled = tiled_predictors(terrain, atlas, satellite=satellite, sun_direction=SUN)
    options = CompletionOptions(fast=True, seed=3)
    done = complete(texture, tiled, options=options)
    values, _ = complete_tiles(texture, texture.weight > 0.0, tiled, fast=True, seed=3)
    np.testing.assert_array_equal(done.values, values)
    smooth = complete(texture, tiled, options=CompletionOptions("membrane"))
    assert np.isfinite(smooth.values).all()
    assert not np.array_equal(smooth.values, values)


def test_a_texture_without_holes_is_not_fitted(hill, monkeypatch):
    terrain, atlas, _, whole, texture = hill
    monkeypatch.setattr(tiled_completion, "fit_completion", lambda *_, **__: pytest.fail("fitted"))
    full = Texture(texture.values, whole.surface.astype(np.float32))
    done = complete(full, tiled_predictors(terrain, atlas))
    np.testing.assert_array_equal(done.values[whole.surface], full.values[whole.surface])
    assert not done.sigma[whole.surface].any()
    assert np.isfinite(done.values).all()


def test_smooth_fills_take_the_surface_alone_and_grain_tells_its_memory(hill, monkeypatch, caplog):
    terrain, atlas, satellite, whole, texture = hill
    tiled = tiled_predictors(terrain, atlas, satellite=satellite, sun_direction=SUN)
    with monkeypatch.context() as patch:
        patch.setattr(TiledPredictors, "window", lambda *_: pytest.fail("predictors computed"))
        for method in ("membrane", "telea"):
            options = CompletionOptions(method)
            done = complete(texture, tiled, options=options)
            np.testing.assert_array_equal(done.values, complete(texture, whole, options=options).values)
    assert not caplog.records
    monkeypatch.setattr(tiled_predictors_module, "_BLOCK_PX", 150)
    values = tiled.whole().values
    rows, columns = tiled.surface.shape
    np.testing.assert_allclose(values, tiled.window((slice(0, rows), slice(0, columns))).values, rtol=1e-4, atol=1e-4)
    complete(texture, tiled, options=CompletionOptions("membrane", detail=0.5))
    assert "held in memory" in caplog.text


def test_images_and_layers_of_another_size_are_refused(hill):
    terrain, atlas, satellite, _, _ = hill
    larger = Texture(np.pad(satellite.values, ((0, 50), (0, 50), (0, 0))), np.pad(satellite.weight, ((0, 50), (0, 50))))
    with pytest.raises(AtlasMismatch, match="satellite is"):
        tiled_predictors(terrain, atlas, satellite=larger)
    with pytest.raises(AtlasMismatch, match="relit_1 is"):
        tiled_predictors(terrain, atlas, layers={"relit_1": larger.weight})


def test_nothing_painted_and_negative_values_are_refused(hill):
    terrain, atlas, _, whole, texture = hill
    tiled = tiled_predictors(terrain, atlas)
    with pytest.raises(NotEnoughEvidence, match="no painted texel"):
        complete(Texture(texture.values, np.zeros_like(texture.weight)), tiled)
    negative = np.where(whole.surface[..., None], -1.0, texture.values).astype(np.float32)
    with pytest.raises(ValueError, match="negative"):
        complete(Texture(negative, texture.weight), tiled)
