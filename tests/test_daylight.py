"""The light of a place: both daylight models agree by day, and the sun lights the land from where it stands."""

from datetime import UTC, datetime

import numpy as np
import places
import pytest

from seasonscapes.sky.illumination import global_horizontal_illuminance, luminance
from seasonscapes.sky.models import read_sky_model, with_overrides
from seasonscapes.workflows.illumination import illumination_at, illumination_for_camera, sun_moon_position
from seasonscapes.workflows.place import load_place
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import Workspace

PLACE = (46.55, 7.98)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory) -> Workspace:
    return Workspace(tmp_path_factory.mktemp("work"))


@pytest.mark.parametrize("time", ["2024-06-20T07:30", "2024-06-20T08:40", "2024-06-20T11:20"])
def test_hosek_and_atmosphere_agree_by_day(workspace, time):
    """Global illuminance at turbidity 3 with the sun at 30° to 67°: within 10 %.

    The Hosek-Wilkie fit is one of a path tracer with another haze, so single directions differ by up to a factor of
    1.6; what falls on the ground is what both must agree on.
    """
    moment = sun_moon_position(datetime.fromisoformat(time).replace(tzinfo=UTC), *PLACE)
    assert moment.sun.elevation_deg > 29.0
    lux = [
        luminance(
            global_horizontal_illuminance(
                illumination_at(with_overrides(read_sky_model(name), turbidity=3.0), moment, 0.0, workspace=workspace)
            )
        )
        for name in ("hosek", "clear")
    ]
    assert lux[0] / lux[1] == pytest.approx(1.0, abs=0.10)


def test_tables_are_kept_in_the_workspace(workspace):
    moment = sun_moon_position(datetime(2024, 6, 20, 11, 0, tzinfo=UTC), *PLACE)
    model = with_overrides(read_sky_model("clear"), turbidity=3.0)
    first = illumination_at(model, moment, 500.0, workspace=workspace)
    files = {path: path.stat().st_mtime_ns for path in workspace.folder.rglob("tables-*.npz")}
    assert files
    again = illumination_at(model, moment, 500.0, workspace=workspace)
    np.testing.assert_array_equal(first.sky_radiance, again.sky_radiance)
    assert files == {path: path.stat().st_mtime_ns for path in workspace.folder.rglob("tables-*.npz")}


def test_light_of_a_place_is_lit_below_and_seen_from_the_camera(tmp_path, workspace):
    place = load_place(places.write_place(tmp_path), workspace)
    view = place.scene.camera(None).model_copy(update={"above_ground_m": None, "height_m": 4500.0})
    camera = camera_for(place, view, size_px=(32, 24))
    model = with_overrides(read_sky_model("clear"), turbidity=3.0)
    light, moment = illumination_for_camera(place, camera, model, datetime(2024, 9, 1, 10, 0, tzinfo=UTC))
    np.testing.assert_allclose(light.sun.direction, moment.sun.direction, atol=1e-12)
    zenith = luminance(light.sky_radiance[0].mean(axis=0)), luminance(light.visible_sky[0].mean(axis=0))
    assert zenith[1] < 0.8 * zenith[0], "the zenith over a high camera is darker than over the land"


def test_another_cameras_light_on_the_terrain_is_this_ones(tmp_path, workspace):
    """Given what another camera found, a camera has the light it would have found alone, to the bit; air and sky are its own."""
    place = load_place(places.write_place(tmp_path), workspace)
    view = place.scene.camera(None).model_copy(update={"above_ground_m": None, "height_m": 4500.0})
    high, low = (
        camera_for(place, view.model_copy(update={"height_m": height_m}), size_px=(32, 24))
        for height_m in (4500.0, 3000.0)
    )
    model, time = with_overrides(read_sky_model("clear"), turbidity=3.0), datetime(2024, 9, 1, 10, 0, tzinfo=UTC)
    other, _ = illumination_for_camera(place, low, model, time)
    alone, _ = illumination_for_camera(place, high, model, time)
    given, _ = illumination_for_camera(place, high, model, time, of_another_camera=other)
    with pytest.raises(ValueError, match="expected that of 2024-09-01 11:00"):
        illumination_for_camera(place, high, model, time.replace(hour=11), of_another_camera=other)
    np.testing.assert_array_equal(given.sky_radiance, alone.sky_radiance)
    np.testing.assert_array_equal(given.visible_sky, alone.visible_sky)
    assert not np.array_equal(given.visible_sky, other.visible_sky)
    depth_m, direction = np.array([4000.0]), np.array([[0.0, 1.0, 0.0]])
    air = [each.aerial_perspective(depth_m, direction)[0] for each in (given, alone, other)]
    np.testing.assert_array_equal(air[0], air[1])
    assert not np.array_equal(air[0], air[2])
