"""Scene files: what they may say, and the one line that each mistake earns."""

import numpy as np
import places
import pytest
import rasterio

from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame
from seasonscapes.scene import NamedCamera, Viewpoint, camera_from_named_view, read_scene
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import Workspace


def changed(old: str, new: str) -> str:
    assert old in places.SCENE
    return places.SCENE.replace(old, new)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (changed('name = "hill"\n', ""), r"hill\.toml: name: missing key"),
        (changed("vertical_datum", "vertical_datumm"), r"unknown key.*did you mean 'vertical_datum'"),
        (changed("heading_deg = 0.0", "headin_deg = 0.0"), r"camera\[0\]\.headin_deg.*did you mean 'heading_deg'"),
        (changed("heading_deg = 0.0", 'heading_deg = "north"'), r"camera\[0\]\.heading_deg: .*valid number.*'north'"),
        (changed("heading_deg = 0.0", "heading_deg = nan"), r"camera\[0\]\.heading_deg: .*finite"),
        (changed("above_ground_m = 120.0", ""), r"camera\[0\]: .*either 'height_m'.*or 'above_ground_m'"),
        (changed("above_ground_m = 120.0", "above_ground_m = 120.0\nheight_m = 900.0"), "give either"),
        (changed("latitude_deg = 46.5405", "latitude_deg = 5155750.0"), r"latitude_deg: .*less than or equal to 90"),
        (changed('vertical_datum = "local"', 'vertical_datum = "sea"'), r"vertical_datum: .*'ellipsoidal'.*'sea'"),
        (changed('name = "south"', 'name = ""'), r"camera\[0\]\.name"),
        (places.SCENE + places.SCENE[places.SCENE.index("[[camera]]") :], "two cameras are named 'south'"),
        (changed('file = "dem.tif"', ""), "either 'file' or a table 'synthetic'"),
        (changed('file = "dem.tif"', "synthetic = {seed = 1}"), "drop the table 'imagery'"),
        (
            changed('file = "dem.tif"', "synthetic = {size_m = 5015.0}"),
            "size_m: got 5015, expected an even number of cells of 15",
        ),
        (changed('file = "dem.tif"', 'file = "none.tif"'), r"elevation\.file: no such file"),
        (changed('file = "dem.tif"', 'file = "../dem.tif"'), r"elevation\.file: leads outside.*--allow-outside"),
        (changed('file = "dem.tif"', 'file = "/vsicurl/http://x/dem.tif"'), "leads outside"),
        (
            changed(
                "[elevation]", "[area]\nwest_deg = 8.0\neast_deg = 7.9\nsouth_deg = 46.5\nnorth_deg = 46.6\n[elevation]"
            ),
            r"area: expected west_deg < east_deg",
        ),
        (
            changed(
                "[elevation]", "[area]\nwest_deg = 1.0\neast_deg = 7.9\nsouth_deg = 46.5\nnorth_deg = 46.6\n[elevation]"
            ),
            r"area: spans more than 3°",
        ),
        ("name = [", "not valid TOML"),
    ],
)
def test_each_mistake_has_its_line(tmp_path, text, message):
    path = places.write_place(tmp_path, text)
    with pytest.raises(InputError, match=message) as error:
        read_scene(path)
    assert "\n" not in str(error.value)


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_scene(tmp_path / "none.toml")
    with pytest.raises(InputError, match="this is a folder"):
        read_scene(tmp_path)


def test_outside_is_allowed_on_request(tmp_path):
    path = places.write_place(tmp_path / "scene", changed('file = "dem.tif"', 'file = "../dem.tif"'))
    places.write_raster(tmp_path / "dem.tif", places.hill_heights(), spacing_m=50.0)
    assert read_scene(path, allow_outside=True).elevation.file == str(tmp_path / "dem.tif")


def test_a_link_does_not_lead_outside(tmp_path):
    path = places.write_place(tmp_path / "scene")
    (tmp_path / "scene" / "dem.tif").rename(tmp_path / "dem.tif")
    (tmp_path / "scene" / "dem.tif").symlink_to(tmp_path / "dem.tif")
    with pytest.raises(InputError, match="leads outside"):
        read_scene(path)


def spoil(path, change):
    """Rewrite a raster with changed values or profile."""
    with rasterio.open(path) as file:
        values, profile = file.read(), file.profile
    values, profile = change(values, profile)
    with rasterio.open(path, "w", **profile) as file:
        file.write(values)


def without_crs(values, profile):
    return values, {**profile, "crs": None}


def in_degrees(values, profile):
    from affine import Affine

    return values, {**profile, "transform": Affine(0.0005, 0, 7.96, 0, -0.0005, 46.57)}


def elsewhere(values, profile):
    from affine import Affine

    return values, {**profile, "transform": Affine(50.0, 0, 700_000.0, 0, -50.0, 5_300_000.0)}


def mostly_holes(values, profile):
    values[:, 5:] = -9999.0
    return values, {**profile, "nodata": -9999.0}


def in_feet_and_a_half(values, profile):
    return values * 10.0, profile


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("dem.tif", without_crs, "no CRS"),
        ("dem.tif", in_degrees, "coordinates in degrees in the projected CRS"),
        ("image.tif", elsewhere, r"image\.tif: the raster does not overlap the requested area"),
        ("dem.tif", mostly_holes, "too much of the area has no data"),
        ("dem.tif", in_feet_and_a_half, "heights outside the range of land elevations"),
    ],
)
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_each_bad_raster_has_its_line(tmp_path, name, change, message):
    from datetime import UTC, datetime

    from seasonscapes.workflows.albedo_sources import scene_albedo

    path = places.write_place(tmp_path)
    spoil(tmp_path / name, change)
    with pytest.raises(InputError, match=message) as error:
        scene_albedo(load_place(path, Workspace(tmp_path / "work")), datetime(2024, 9, 1, tzinfo=UTC))
    assert "\n" not in str(error.value)
    assert "tif" in str(error.value) or "hill.toml" in str(error.value)


def test_small_holes_are_filled_and_reported(tmp_path):
    def a_hole(values, profile):
        values[0, 20:23, 30:34] = -9999.0
        return values, {**profile, "nodata": -9999.0}

    path = places.write_place(tmp_path)
    spoil(tmp_path / "dem.tif", a_hole)
    place = load_place(path, Workspace(tmp_path / "work"))
    assert place.fill.filled_cells == 12
    assert np.isfinite(place.elevation.values).all()


def test_cameras_stand_on_the_ground(tmp_path):
    path = places.write_place(tmp_path)
    place = load_place(path, Workspace(tmp_path / "work"))
    view = place.scene.camera("south")
    camera = camera_for(place, view, size_px=(64, 48))
    assert 1100.0 < camera.position_m[2] < 1160.0
    buried = view.model_copy(update={"above_ground_m": None, "height_m": 900.0})
    with pytest.raises(InputError, match="stands below the ground"):
        camera_for(place, buried, size_px=(64, 48))
    away = view.model_copy(update={"latitude_deg": 47.9})
    with pytest.raises(InputError, match="outside the elevation raster"):
        camera_for(place, away, size_px=(64, 48))
    with pytest.raises(InputError, match=r"no such camera; got 'north'; expected one of south"):
        place.scene.camera("north")


def test_the_second_load_reads_what_the_first_built(tmp_path):
    path = places.write_place(tmp_path)
    workspace = Workspace(tmp_path / "work")
    first = load_place(path, workspace)
    files = {file: file.stat().st_mtime_ns for file in workspace.folder.rglob("*") if file.is_file()}
    second = load_place(path, workspace)
    assert files == {file: file.stat().st_mtime_ns for file in workspace.folder.rglob("*") if file.is_file()}
    np.testing.assert_array_equal(first.terrain.vertices, second.terrain.vertices)
    assert first.atlas == second.atlas
    # Another bound, another artefact; another raster, another too.
    load_place(path, workspace, options=MeshOptions(max_error_m=50.0))
    places.write_raster(tmp_path / "dem.tif", places.hill_heights() + 1.0, spacing_m=50.0)
    raised = load_place(path, workspace)
    assert raised.terrain.vertices[:, 2].max() == pytest.approx(first.terrain.vertices[:, 2].max() + 1.0, abs=0.05)
    assert len(list(workspace.folder.rglob("terrain-*.npz"))) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [({"mesher": "delaunay"}, "--mesher: unknown mesher"), ({"atlas": "globe"}, "--atlas: unknown atlas")],
)
def test_unknown_options_are_named(options, message):
    with pytest.raises(InputError, match=message):
        MeshOptions(**options)


def test_a_viewpoint_needs_no_name_and_one_height():
    numbers = {"latitude_deg": 46.54, "longitude_deg": 7.98, "heading_deg": 30.0, "above_ground_m": 50.0}
    free, named = Viewpoint(**numbers), NamedCamera(name="south", **numbers)
    cameras = [camera_from_named_view(LocalFrame(46.5, 7.9), view, 900.0, size_px=(30, 20)) for view in (free, named)]
    np.testing.assert_array_equal(cameras[0].world_from_camera, cameras[1].world_from_camera)
    with pytest.raises(ValueError, match="either 'height_m'"):
        Viewpoint(**numbers, height_m=1000.0)


def test_all_problems_of_a_file_are_told_at_once(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text('name = "x"\natribution = "y"\n[[camera]]\nname = "c"\nlatitude_deg = 46.0\nheading = 3\n')
    with pytest.raises(InputError) as told:
        read_scene(path)
    message = str(told.value)
    assert "3 problems" in message
    for part in (
        "atribution: unknown key",
        "did you mean 'attribution'",
        "camera[0].heading: unknown key",
        "longitude_deg: missing",
    ):
        assert part in message
    assert "\n" not in message


def test_attribution_and_datum_may_be_left_out_and_the_default_is_told(tmp_path, caplog):
    path = tmp_path / "scene.toml"
    path.write_text('name = "x"\n')
    with caplog.at_level("INFO", logger="seasonscapes"):
        scene = read_scene(path)
    assert (scene.attribution, scene.vertical_datum) == ("", "unknown")
    assert "metres above sea level" in caplog.text
