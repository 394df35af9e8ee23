"""Daylight coefficients light a view as path tracing does."""

import numpy as np
import pytest
from test_rendering import FRAME, heightfield, looking_down, sun_at

from seasonscapes.rendering.gather import occluder
from seasonscapes.rendering.radiance import path_trace
from seasonscapes.rendering.relit_view import ready_view, relight_view
from seasonscapes.rendering.scene import mi_mesh, relight
from seasonscapes.rendering.transport import Effort, trace_view
from seasonscapes.sky.illumination import Illumination, uniform_sky

assert FRAME.latitude_deg


def gradient_sky() -> np.ndarray:
    """Brighter towards the east and the zenith, dark below the horizon."""
    from seasonscapes.frames import equirectangular_directions

    direction = equirectangular_directions(64, 128)
    sky = np.where(direction[..., 2:] > 0, 3000.0 + 2000.0 * direction[..., :1] + 2000.0 * direction[..., 2:], 0.0)
    return (sky * [0.8, 1.0, 1.3]).astype(np.float32)


@pytest.fixture(scope="module")
def valley():
    terrain = heightfield(lambda e, n: 120.0 * np.cos(e / 90.0) + 60.0 * np.sin(n / 70.0), count=101)
    mesh = mi_mesh(terrain, np.array([0.55, 0.45, 0.35]))
    camera = looking_down(900.0, size=64, view_m=700.0)
    view = trace_view(occluder(mesh), camera, Effort(rays=512), seed=3)
    return mesh, camera, ready_view(occluder(mesh), view)


@pytest.mark.parametrize("light", [
    uniform_sky(4000.0),
    Illumination(gradient_sky()),
    Illumination(gradient_sky(), sun_at(110.0, 35.0).sun),
    Illumination(gradient_sky(), sun_at(250.0, 12.0).sun),
])  # fmt: skip
def test_relit_view_equals_path_tracing(valley, light):
    """In the mean within 1 %, and pixel by pixel within 4 % of the picture's mean (noise of both included)."""
    mesh, camera, ready = valley
    reference, _ = path_trace(relight(mesh, light, max_height_m=180.0), camera, spp=512, max_depth=6)
    relit = relight_view(ready, light).surface
    assert relit.mean() / reference.mean() == pytest.approx(1.0, abs=0.01)
    assert np.sqrt(np.mean((relit - reference) ** 2)) < 0.04 * reference.mean()
