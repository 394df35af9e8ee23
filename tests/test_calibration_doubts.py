"""A calibration that contradicts the stated position, or points in another vertical datum, are doubted."""

import numpy as np
import pytest
from terrain_cases import hill_lv95

from seasonscapes.calibration.evidence import Correspondences
from seasonscapes.cameras.webcam import Webcam, webcam_model
from seasonscapes.frames import LocalFrame, enu_from_geodetic, local_axes
from seasonscapes.terrain.crs import geodetic_from_map, map_from_geodetic
from seasonscapes.terrain.raster import sample_raster
from seasonscapes.workflows.webcam_calibration import WebcamStation, calibrate

STANDS = (46.525, 7.98)


def solved(points_up_m=0.0, camera_east_m=0.0, sigma_m=10.0):
    """Calibrate a camera south of the hill by exact points, of which all heights, or the stated place, are off."""
    raster = hill_lv95()
    ground = float(sample_raster(raster, *map_from_geodetic(raster.crs, *STANDS))[0])
    frame = LocalFrame(*STANDS, 0.0, 0.13)
    facts = {"projection": "perspective", "width_px": 960, "height_px": 640, "horizontal_fov_deg": 60.0}
    webcam = Webcam(
        id="w", latitude_deg=STANDS[0], longitude_deg=STANDS[1], height_m=ground + 20.0, heading_deg=0.0, tilt_deg=8.0,
        position_sigma_m=sigma_m, time_zone="UTC", **facts,
    )  # fmt: skip
    view = webcam_model(webcam, frame)
    row, column = (axis.ravel() for axis in np.mgrid[10:90:9, 30:110:9])
    x, y = raster.transform * (column + 0.5, row + 0.5)
    latitude, longitude = geodetic_from_map(raster.crs, x, y)
    height = raster.values[row, column, 0].astype(float)
    camera = view.position_m + np.array([camera_east_m, 0.0, 0.0])
    seen = (enu_from_geodetic(frame, latitude, longitude, height) - camera) @ view.world_from_camera[:3, :3]
    pixel = np.stack([view.fx * seen[:, 0], view.fy * seen[:, 1]], 1) / seen[:, 2:] + (view.cx, view.cy)
    kept = (seen[:, 2] > 0) & (np.abs(pixel / (480, 320) - 1.0) < 0.98).all(axis=1)
    stated = enu_from_geodetic(frame, latitude, longitude, height + points_up_m)
    station = WebcamStation(webcam, view, frame, local_axes(frame, *STANDS), [raster])
    return calibrate(
        station, np.zeros((640, 960, 3), np.uint8), points=Correspondences(pixel[kept], stated[kept])
    ).doubts


def test_a_calibration_that_agrees_with_what_is_stated_is_not_doubted():
    assert solved() == ()
    assert solved(camera_east_m=25.0) == ()
    assert solved(points_up_m=10.0) == ()


def test_ellipsoidal_heights_are_doubted_and_named():
    doubts = solved(points_up_m=52.0)
    assert len(doubts) == 2
    assert "52 m above its stated position, 5.2 times its standard deviation of 10 m" in doubts[0]
    assert "the points' heights lie 52 m above the terrain" in doubts[1]
    assert "ellipsoidal heights of GNSS" in doubts[1]
    # The datum is another one also where the stated position is too vague to tell.
    assert len(solved(points_up_m=-52.0, sigma_m=100.0)) == 1


@pytest.mark.parametrize(("east_m", "side"), [(40.0, "east"), (-40.0, "west")])
def test_a_camera_elsewhere_than_stated_is_doubted_with_its_direction(east_m, side):
    (doubt,) = solved(camera_east_m=east_m)
    assert f"40 m {side} of its stated position, 4.0 times" in doubt
