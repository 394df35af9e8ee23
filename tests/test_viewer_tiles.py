"""Finer heights that the page loads near its viewer."""

import json
import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from places import hill_heights, write_place, write_raster

import seasonscapes as ss
from seasonscapes.export.viewer_files import load_scene, save_scene, single_file, viewer_files
from seasonscapes.sky.illumination import luminance
from seasonscapes.workflows import viewer_grid
from seasonscapes.workflows.viewer import first_view, write_folder
from seasonscapes.workflows.viewer_scene import ViewerDetail, viewer_scene

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from viewer_browser import chromium, open_page, prepare, radiance, served, shrunk, why_no_browser

sys.path.pop(0)
# The grid of at most 24 nodes has a step of some 130 m, which three levels of tiles bring to that of the surface.
DETAIL = ViewerDetail(24, 128, 128, 24, 12, 8, 256, 8, 32, tile_levels=3)
TIME = "2024-07-20T08:00Z"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A hill with waves of 230 m, which the grid is too coarse for."""
    folder = tmp_path_factory.mktemp("viewer_tiles")
    path = write_place(folder / "land")
    east, north = np.meshgrid(np.arange(61), np.arange(61))
    waves = 12.0 * np.sin(1.37 * east + 0.6 * north) * np.sin(1.37 * north - 0.6 * east)
    write_raster(folder / "land" / "dem.tif", hill_heights() + waves, spacing_m=50.0)
    return ss.load_place(path, ss.Workspace(folder / "workspace"))


@pytest.fixture(scope="module", autouse=True)
def small_tiles():
    """Many tiles on a small hill."""
    patch = pytest.MonkeyPatch()
    patch.setattr(viewer_grid, "TILE_CELLS", 64)
    yield
    patch.undo()


@pytest.fixture(scope="module")
def scene(place):
    return viewer_scene(place, sky=ss.sky_model("clear"), detail=DETAIL)


def test_tiles_hold_the_heights_of_the_rendered_surface(scene, place):
    tiles, grid = scene.tiles, scene.about["grid"]
    assert set(tiles.keys[:, 0]) == {1, 2, 3}
    for k, (level, column, row) in enumerate(tiles.keys):
        step = grid["step_m"] / 2.0**level
        inner = np.arange(3, tiles.cells - 2, 5)
        r, c = (each.ravel() for each in np.meshgrid(inner, inner, indexing="ij"))
        east = grid["west_m"] + (column * tiles.cells + c - 1) * step
        north = grid["south_m"] + (row * tiles.cells + r - 1) * step
        up = tiles.low_m[k] + tiles.heights[k, r, c] * tiles.scale_m[k]
        surface = place.terrain.surface
        position = np.column_stack([east, north, up])
        column_at, row_at = surface.nodes_at(position).T
        inside = (column_at > 1) & (row_at > 1)
        inside &= (column_at < surface.nodes.shape[1] - 2) & (row_at < surface.nodes.shape[0] - 2)
        if inside.any():
            assert np.abs(surface.up_at(position) - up)[inside].max() < 1.5


def test_they_are_files_beside_the_page_and_no_part_of_a_single_file(scene):
    files = viewer_files(scene)
    described = json.loads(files["scene.json"])["tiles"]
    names = [f"tile-{level}-{c}-{r}.bin" for level, c, r, _, _ in described["list"]]
    assert names == [name for name in files if name.startswith("tile-")]
    assert all(len(files[name]) == 2 * (described["cells"] + 3) ** 2 for name in names)
    assert b'"tiles"' not in single_file(scene)


def test_a_scene_is_kept_with_its_tiles(scene, tmp_path):
    save_scene(scene, tmp_path / "kept")
    kept = load_scene(tmp_path / "kept").tiles
    assert kept.cells == scene.tiles.cells
    for name in ("keys", "heights", "low_m", "scale_m"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(scene.tiles, name))


def test_a_grid_as_fine_as_the_raster_has_none(place):
    grid, _, _ = viewer_grid.grid_heights(place, 640)
    assert viewer_grid.height_tiles(place, grid, 3) is None


def test_what_too_many_tiles_leave_out_is_said(place, monkeypatch, caplog):
    monkeypatch.setattr(viewer_grid, "MOST_TILES", 4)
    grid, _, _ = viewer_grid.grid_heights(place, 24)
    tiles = viewer_grid.height_tiles(place, grid, 3)
    assert set(tiles.keys[:, 0]) == {1}
    assert "of the raster's" in caplog.text


@pytest.mark.browser
def test_the_page_draws_the_ground_near_its_viewer_from_tiles(scene, place, tmp_path):
    reason = why_no_browser()
    if reason is not None:
        pytest.skip(reason)
    camera = ss.camera(place, "south", size_px=(48, 36))
    truth = ss.render(place, camera, TIME, spp=32)
    ground = truth.coverage > 0.99
    when = datetime.fromisoformat(TIME).timestamp() * 1000.0
    errors = []
    for name, shown in (("fine", scene), ("coarse", replace(scene, tiles=None))):
        write_folder(shown, tmp_path / name, first_view(place, "south", TIME))
        with chromium() as browser, served(tmp_path / name) as address:
            # The page is ready when the tiles are there.
            open_page(browser, address + "?still&size=96x72")
            prepare(browser)
            image = shrunk(radiance(browser, camera=0, time=when, frames=4, size=[96, 72]), 2)
            if name == "fine":
                assert browser.execute_script("return seasonscapes.tiles.count()") > 0
                heights = "const t = seasonscapes.terrain; return [t.heightAt(0, 0), t.tiles().heightAt(-t.west / t.step, -t.south / t.step)]"
                assert len(set(browser.execute_script(heights))) == 1
            assert [entry["message"] for entry in browser.get_log("browser")] == []
        errors.append(np.mean(np.abs(luminance(image[ground]) / luminance(truth.radiance[ground]) - 1.0)))
    assert errors[0] < 0.8 * errors[1]
