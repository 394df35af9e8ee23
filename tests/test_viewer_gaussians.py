"""The page's Gaussians: lit and drawn by its own program as the renderer lights and draws them."""

import json
import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from command_line import command
from places import write_place

pytest.importorskip("torch")

import seasonscapes as ss
from seasonscapes.export.viewer_files import GAUSSIANS, load_scene, save_scene, single_file, viewer_files
from seasonscapes.gaussians.model import save_model
from seasonscapes.gaussians.splat_view import RasterOptions, render_model
from seasonscapes.gaussians.viewer_layer import MOST_DISCS, viewer_layer
from seasonscapes.sky.illumination import luminance
from seasonscapes.workflows.gaussian_views import day_of_year
from seasonscapes.workflows.illumination import illumination_for_camera
from seasonscapes.workflows.viewer import first_view, with_gaussians, write_folder
from seasonscapes.workflows.viewer_scene import ViewerDetail, viewer_scene

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from viewer_browser import chromium, open_page, prepare, radiance, served, shrunk, why_no_browser

sys.path.pop(0)
LOW_SUN, DUSK = "2024-07-20T05:00Z", "2024-07-20T19:30Z"
DETAIL = ViewerDetail(160, 128, 128, 48, 24, 8, 256, 8, 32)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewer_gaussians")
    return ss.load_place(write_place(folder / "land"), ss.Workspace(folder / "workspace"))


@pytest.fixture(scope="module")
def model(place):
    """Quickly trained, then given a network that changes colours by some ten per cent everywhere."""
    options = ss.DistilOptions(discs=80, suns=3, dates=1, views=0, steps=20, picture_steps=0)
    trained = ss.distil(place, options=options)
    rng = np.random.default_rng(3)
    learned = dict(trained.appearance)
    learned["mlp.4.weight"] = rng.normal(0.0, 0.03, learned["mlp.4.weight"].shape).astype(np.float32)
    learned["log_colour"] = rng.normal(0.0, 0.1, learned["log_colour"].shape).astype(np.float32)
    learned["shift"] = rng.normal(0.0, 0.01, learned["shift"].shape).astype(np.float32)
    return replace(trained, appearance=learned)


@pytest.fixture(scope="module")
def scene(place, model):
    return with_gaussians(viewer_scene(place, sky=ss.sky_model("clear"), detail=DETAIL), model, place)


@pytest.fixture(scope="module")
def page(scene, place, tmp_path_factory):
    reason = why_no_browser()
    if reason is not None:
        pytest.skip(reason)
    folder = tmp_path_factory.mktemp("page") / "page"
    write_folder(scene, folder, first_view(place, "south", LOW_SUN))
    with chromium() as browser, served(folder) as address:
        open_page(browser, address + "?still&size=96x72")
        prepare(browser)
        yield browser


def test_the_layer_is_a_file_of_its_own_and_part_of_a_single_file(scene):
    files = viewer_files(scene)
    described = json.loads(files["scene.json"])["gaussians"]
    assert described["file"] == GAUSSIANS
    ends = [entry["offset"] for entry in described["arrays"].values()]
    assert max(ends) < len(files[GAUSSIANS])
    assert f'id="{GAUSSIANS}"'.encode() in single_file(scene)
    assert "gaussians" not in json.loads(viewer_files(replace(scene, gaussians=None))["scene.json"])


def test_a_scene_is_kept_without_its_layer(scene, tmp_path):
    save_scene(scene, tmp_path / "kept")
    assert load_scene(tmp_path / "kept").gaussians is None


@pytest.mark.parametrize(
    ("change", "match"), [({"kind": "code"}, "cannot light"), ({"note": {"scene": "elsewhere"}}, "another scene")]
)
def test_models_that_the_page_cannot_show_are_refused(scene, place, model, change, match):
    with pytest.raises(ss.InputError, match=match) as told:
        with_gaussians(scene, replace(model, **change), place)
    assert "\n" not in str(told.value)


def test_more_gaussians_than_a_page_draws_are_refused(model):
    class Many:
        kind, means = "full", np.zeros((MOST_DISCS + 1, 3), np.float32)

    with pytest.raises(ss.InputError, match="more than a page draws"):
        viewer_layer(Many())


def test_the_command_writes_them(place, model, tmp_path, coarse_viewer):
    save_model(model, tmp_path / "model.safetensors")
    common = {"gaussians": tmp_path / "model.safetensors", "workspace": place.workspace.folder}
    command("view", place.path, output=tmp_path / "page", **common)
    assert (tmp_path / "page" / GAUSSIANS).stat().st_size > 100 * len(model.means)


def by_horizons(model, place, time):
    """The renderer's picture with shadows by the discs' horizons, as browsers have them."""
    camera, utc = ss.camera(place, "south", size_px=(48, 36)), datetime.fromisoformat(time)
    light, _ = illumination_for_camera(place, camera, ss.sky_model("clear"), utc)
    return render_model(model, camera, light, day_of_year(utc), raster=RasterOptions(4))


@pytest.mark.browser
class TestBrowser:
    @pytest.mark.parametrize("time", [LOW_SUN, DUSK])
    def test_its_gaussians_are_those_of_the_renderer(self, page, place, model, time):
        truth = by_horizons(model, place, time)
        when = datetime.fromisoformat(time).timestamp() * 1000.0
        image = shrunk(radiance(page, camera=0, time=when, frames=8, size=[96, 72], divider=0), 2)
        ground = truth.coverage > 0.99
        ratio = luminance(image[ground]) / luminance(truth.radiance[ground])
        assert np.median(ratio) == pytest.approx(1.0, abs=0.02)
        assert np.mean(np.abs(ratio - 1.0) < 0.05) > 0.9
        colour = (image / luminance(image)[..., None])[ground]
        np.testing.assert_allclose(
            np.median(colour / (truth.radiance / luminance(truth.radiance)[..., None])[ground], axis=0), 1.0, atol=0.01
        )

    def test_the_network_and_the_physics_both_count(self, page, place, model):
        """The same comparison fails without what was learned: it proves something."""
        truth = by_horizons(model, place, LOW_SUN)
        when = datetime.fromisoformat(LOW_SUN).timestamp() * 1000.0
        radiance(page, camera=0, time=when, frames=1, size=[96, 72], divider=0)
        plain = by_horizons(replace(model, kind="physical"), place, LOW_SUN)
        ground = truth.coverage > 0.99
        assert np.mean(np.abs(luminance(plain.radiance[ground]) / luminance(truth.radiance[ground]) - 1.0) > 0.05) > 0.3

    def test_the_divider_shows_the_mesh_left_of_it(self, page):
        when = datetime.fromisoformat(LOW_SUN).timestamp() * 1000.0
        seen = {"camera": 0, "time": when, "frames": 4, "size": [96, 72]}
        mesh, discs, both = (radiance(page, **seen, divider=divider) for divider in (1, 0, 0.5))
        np.testing.assert_allclose(both[:, :47], mesh[:, :47], rtol=1e-3)
        np.testing.assert_allclose(both[:, 49:], discs[:, 49:], rtol=1e-3)
        assert np.mean(np.abs(mesh / discs - 1.0) > 0.02) > 0.1
        address = page.execute_script(
            "return seasonscapes.command() && (seasonscapes.setDivider(0.25), document.getElementById('divider').getAttribute('aria-valuetext'))"
        )
        assert "25 %" in address

    def test_nothing_was_logged(self, page):
        assert [entry["message"] for entry in page.get_log("browser")] == []
