"""A picture from the place of a calibrated webcam: the same rays, through the command line as well."""

import json
from dataclasses import replace

import numpy as np
import pytest
from command_line import command
from PIL import Image
from places import MASSIF

import seasonscapes as ss
from seasonscapes.calibration.evidence import PARAMETERS
from seasonscapes.cameras.pinhole import ray_directions, view_in_frame
from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame, geodetic_from_enu
from seasonscapes.workflows.views import calibrated_viewpoint


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    path = tmp_path_factory.mktemp("massif") / "little.toml"
    path.write_text(MASSIF)
    return ss.load_place(path, options=ss.MeshOptions(texel_m=60.0))


@pytest.fixture
def record(place, tmp_path):
    """A turned and cropped camera whose pose is in a frame of its own, 20 km away, with its record."""
    view = ss.Viewpoint(latitude_deg=46.598, longitude_deg=7.914, height_m=4500.0, heading_deg=141.0, pitch_deg=-11.0)
    camera = ss.camera(place, view, size_px=(960, 640))
    own = LocalFrame(46.7, 8.1, 500.0)
    tilted = np.array(camera.world_from_camera)
    angle = np.radians(2.5)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    tilted[:3, :3] = tilted[:3, :3] @ turn
    camera = replace(camera, cx=400.0, cy=500.0, world_from_camera=tilted)
    moved = view_in_frame(camera, own)
    latitude, longitude, height = (float(v) for v in geodetic_from_enu(own, moved.position_m))
    facts = {
        "webcam": "kette",
        "projection": "perspective",
        "size_px": [960, 640],
        **{key: float(getattr(moved, key)) for key in ("fx", "fy", "cx", "cy")},
        "k1": 0.0,
        "world_from_camera": moved.world_from_camera.tolist(),
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "height_m": height,
        "sigma": dict.fromkeys(PARAMETERS, 0.0),
        "frame": {"latitude_deg": 46.7, "longitude_deg": 8.1, "height_m": 500.0, "refraction_k": own.refraction_k},
    }
    path = tmp_path / "kette.json"
    path.write_text(json.dumps(facts))
    return camera, path


def test_a_record_gives_the_rays_of_the_webcam(place, record):
    """Off-centre, rolled, in another frame: within a hundredth of a pixel over the picture."""
    camera, path = record
    view, size_px = calibrated_viewpoint(path)
    again = ss.camera(place, view, size_px=size_px)
    assert size_px == (960, 640)
    assert view.principal_point == pytest.approx((400.0 / 960.0, 500.0 / 640.0))
    apart = np.arccos(np.clip((ray_directions(again) * ray_directions(camera)).sum(axis=-1), -1.0, 1.0))
    assert np.degrees(apart).max() < 0.01 * np.degrees(1.0 / camera.fx) + 2e-6
    np.testing.assert_allclose(again.position_m, camera.position_m, atol=1e-3)


def test_render_from_a_calibrated_webcam(place, record, tmp_path):
    """By its file; half the size shows the same, another shape is refused."""
    _, path = record
    out = tmp_path / "view.png"
    common = {"time": "2024-07-20T13:30", "sky": "hosek", "texel_m": 60, "output": out}
    command("render", place.path, camera=path, size="48x32", **common)
    assert Image.open(out).size == (48, 32)
    with pytest.raises(InputError, match="48x32"):
        command("render", place.path, camera=path, size="48x48", **common)
    with pytest.raises(InputError, match=r"nowhere\.json"):
        command("render", place.path, camera=tmp_path / "nowhere.json", **common)
