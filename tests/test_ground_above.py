"""Snow, forest and water in images from above, against the path tracer's radiance of the same ground."""

from dataclasses import replace

import numpy as np
import pytest
from test_rendering import FRAME, heightfield, looking_down, sun_at

from seasonscapes.albedo.delighting import DelightOptions, TexelIrradiance, delight_image
from seasonscapes.albedo.ground_above import GroundAbove
from seasonscapes.rendering.ground_optics import optics_of
from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight
from seasonscapes.rendering.radiance import path_trace
from seasonscapes.sky.illumination import Illumination, uniform_sky
from seasonscapes.terrain.surface_classes import Snow, Water

SLOPE = 0.35
SKY = 2000.0


def seen_from_above(terrain, albedo, light):
    """Radiance ``(3,)`` of even ground towards the zenith, by path tracing; single bounces, so that no other ground lights it."""
    image, _ = path_trace(
        relight(mi_mesh(terrain, np.array(albedo)), light), looking_down(size=8, view_m=20.0), spp=4096, max_depth=2
    )
    return image.reshape(-1, 3).mean(axis=0)


def delit(radiance, ground, light, normal):
    """Albedo ``(3,)`` of 8 × 8 equal texels."""
    shape = (8, 8)
    assert light.sun is not None
    sun = np.broadcast_to(light.sun.normal_illuminance_lx * max(normal @ light.sun.direction, 0.0), (*shape, 3))
    # Of the hemisphere above a tilted plane that is not cut off by any other ground, the lower part is below the horizon.
    sky = np.full((*shape, 3), np.pi * light.sky_radiance.max() * 0.5 * (1.0 + normal[2]), np.float32)
    irradiance = TexelIrradiance(
        sun.astype(np.float32),
        np.ones(shape, np.float32),
        sky,
        np.zeros_like,
        np.full(3, 1e5),
        np.zeros(shape, np.int32),
    )
    image = np.broadcast_to(radiance, (*shape, 3)).astype(np.float32)
    options = DelightOptions(radiance_per_unit=1.0, register=False, borders=None, fit_sky=False, ground=ground)
    return delight_image(image, np.zeros(image.shape, bool), irradiance, options=options).albedo[4, 4]


@pytest.mark.parametrize("elevation_deg", [15.0, 35.0, 60.0])
def test_snow_and_forest_have_the_albedo_that_they_were_rendered_with(elevation_deg):
    normal = np.array([-SLOPE, 0.0, 1.0]) / np.hypot(SLOPE, 1.0)
    plane = heightfield(lambda e, n: SLOPE * e, count=3)
    light = sun_at(240.0, elevation_deg)
    assert light.sun is not None
    worst_plain = 0.0
    for terrain, albedo in (
        (replace(plane, snow=Snow()), (0.84, 0.85, 0.88)),
        (replace(plane, forest=True), (0.03, 0.05, 0.02)),
    ):
        radiance = seen_from_above(terrain, albedo, light)
        normals = np.broadcast_to(normal, (8, 8, 3))
        ground = GroundAbove(optics_of(terrain), normals, np.array(light.sun.direction), None, np.zeros(3))
        np.testing.assert_allclose(delit(radiance, ground, light, normal), albedo, rtol=0.03)
        worst_plain = max(worst_plain, np.abs(delit(radiance, None, light, normal) / np.array(albedo) - 1.0).max())
    assert worst_plain > 0.033, "as Lambertian ground one of the two would be off"


def test_water_has_the_albedo_of_its_body():
    plane = heightfield(lambda e, n: 0.0 * e, count=3)
    albedo, up = (0.02, 0.04, 0.05), np.array([0.0, 0.0, 1.0])
    sun = sun_at(180.0, 35.0).sun
    assert sun is not None
    light = Illumination(uniform_sky(SKY).sky_radiance, sun)
    terrain = replace(plane, frame=FRAME, water=Water(np.ones((4, 4), np.float32), 0.0))
    radiance = seen_from_above(terrain, albedo, light)
    normals = np.broadcast_to(up, (8, 8, 3))
    ground = GroundAbove(None, normals, np.array(sun.direction), np.ones((8, 8), np.float32), np.full(3, SKY))
    found, plain = delit(radiance, ground, light, up), delit(radiance, None, light, up)
    np.testing.assert_allclose(found, albedo, rtol=0.08)
    assert np.abs(found - albedo).max() < 0.5 * np.abs(plain - albedo).max()
