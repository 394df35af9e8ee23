"""A camera knows its frame and a texture its atlas: in a place of another one they are converted or refused."""

from dataclasses import replace

import numpy as np
import pytest

import seasonscapes as ss
from seasonscapes.errors import AtlasMismatch, FrameMismatch
from seasonscapes.frames import LocalFrame, geodetic_from_enu

TIME = "2024-07-20T13:30"


@pytest.fixture(scope="module")
def place():
    return ss.load_place("alpine_small")


def moved(place, camera):
    """The same camera, its pose in a frame whose origin lies 4 km further north and 3 km further east."""
    from seasonscapes.cameras.pinhole import view_in_frame

    frame = LocalFrame(
        place.frame.latitude_deg + 0.036, place.frame.longitude_deg + 0.039, 500.0, place.frame.refraction_k
    )
    return view_in_frame(camera, frame)


def test_a_camera_of_another_frame_sees_the_same(place):
    camera = ss.camera(place, "aerial", size_px=(48, 32))
    other = moved(place, camera)
    assert np.linalg.norm(other.position_m - camera.position_m) > 4000.0
    np.testing.assert_allclose(
        geodetic_from_enu(other.frame, other.position_m), geodetic_from_enu(camera.frame, camera.position_m), atol=1e-6
    )
    depth, same = (ss.render(place, each, TIME, sky="hosek", spp=1).gbuffer.depth for each in (camera, other))
    both = np.isfinite(depth) & np.isfinite(same)
    assert both.mean() > 0.5
    np.testing.assert_allclose(same[both], depth[both], rtol=2e-3)


CAMERA_USES = {
    "render": lambda place, camera: ss.render(place, camera, TIME, sky="hosek"),
    "relight_session": lambda place, camera: ss.relight_session(place, camera, sky="hosek"),
    "differentiable_scene": lambda place, camera: ss.differentiable_scene(place, camera, TIME, sky="hosek"),
}
TEXTURE_USES = {
    "render": lambda place, camera, texture: ss.render(place, camera, TIME, sky="hosek", albedo=texture),
    "relight_session": lambda place, camera, texture: ss.relight_session(place, camera, sky="hosek", albedo=texture),
    "lit_texture": lambda place, camera, texture: ss.lit_texture(place, TIME, sky="hosek", albedo=texture),
    "complete": lambda place, camera, texture: ss.complete(place, texture, TIME),
}


@pytest.mark.parametrize("use", CAMERA_USES)
def test_a_camera_without_a_frame_is_refused(place, use):
    camera = replace(ss.camera(place, "aerial", size_px=(48, 32)), frame=None)
    with pytest.raises(FrameMismatch, match="frame"):
        CAMERA_USES[use](place, camera)


@pytest.mark.parametrize("use", TEXTURE_USES)
def test_a_texture_of_another_atlas_is_refused(place, use):
    values = np.full((*place.texture_shape, 3), 0.2, np.float32)
    foreign = ss.Texture(values, values[..., 0], atlas_id="another")
    with pytest.raises(AtlasMismatch, match="another atlas"):
        TEXTURE_USES[use](place, ss.camera(place, "aerial", size_px=(48, 32)), foreign)


def test_a_texture_of_another_size_is_refused(place):
    rows, columns = place.texture_shape
    with pytest.raises(AtlasMismatch):
        ss.lit_texture(place, TIME, sky="hosek", albedo=ss.Texture(np.full((rows, columns + 1, 3), 0.2, np.float32)))
