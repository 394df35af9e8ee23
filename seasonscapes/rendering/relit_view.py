"""A view under any light from its daylight coefficients: the same picture as path tracing, without its noise and time."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from seasonscapes.cameras.pinhole import ray_directions
from seasonscapes.rendering.gather import Occluder
from seasonscapes.rendering.gbuffer import GBuffer, trace_gbuffer
from seasonscapes.rendering.radiance import View
from seasonscapes.rendering.reception import (
    ReadyReception,
    ReadySenders,
    arriving,
    light_senders,
    luminaries,
    ready_reception,
    ready_senders,
)
from seasonscapes.rendering.scene import RenderScene, background
from seasonscapes.rendering.sun_visibility import SunRays, first_place_sees, incidence, sun_rays
from seasonscapes.rendering.transport import ViewCoefficients, view_neighbours
from seasonscapes.sky.illumination import AerialPerspective, Illumination, Luminary

# A pixel is rough where distances within it differ by more than this ratio: more than one surface shows in it.
_DEPTH_RATIO = 1.05
# Cosines of incidence below which samples of a pixel may face either way.
_GRAZING = 0.05
# Interreflected light is smooth: its noise is spread over neighbouring pixels of one surface.
_BOUNCE_STRIDES = (1,)


@dataclass(frozen=True)
class ReadyView:
    """A view's coefficients laid out for speed, with what no light changes. n pixels show terrain, S samples in each.

    Parameters
    ----------
    coefficients
        As they were made or read.
    rays
        Shadow rays of all samples, pixel by pixel.
    reception, senders
        On the device.
    rough
        ``(n,)`` bool: pixels with silhouettes inside.
    silhouette
        ``(k,)`` indices of those among the n whose air is averaged, and their samples' distances ``(k, S)`` [m].
    gbuffer
        First surfaces at pixel centres.
    direction
        ``(H W, 3)`` unit viewing directions.
    """

    coefficients: ViewCoefficients
    rays: SunRays
    reception: ReadyReception
    senders: ReadySenders
    rough: np.ndarray
    silhouette: tuple[np.ndarray, np.ndarray]
    gbuffer: GBuffer
    direction: np.ndarray


def ready_view(terrain: Occluder, coefficients: ViewCoefficients) -> ReadyView:
    """Load coefficients (perhaps memory-mapped) into the form that `relight_view` uses. Done once for many lights."""
    camera = coefficients.camera
    origin = np.asarray(coefficients.sample_origin)
    shown = np.asarray(coefficients.sample_weight) > 0.0
    distance = np.linalg.norm(origin - camera.position_m.astype(np.float32), axis=2)
    nearest = np.where(shown, distance, np.inf).min(axis=1)
    farthest = np.where(shown, distance, 0.0).max(axis=1)
    rough = (farthest > nearest * _DEPTH_RATIO) | (np.asarray(coefficients.coverage) < 1.0)
    # The bare terrain serves as the scene of a G-buffer: that looks at geometry alone.
    scene = RenderScene(terrain.mi_scene, terrain.mi_terrain, None, 0.0)  # type: ignore[arg-type]
    gbuffer = trace_gbuffer(scene, camera)
    centre_is_sky = ~np.isfinite(gbuffer.depth.reshape(-1)[coefficients.pixel])
    index = np.flatnonzero((farthest > nearest * 1.1) | centre_is_sky)
    passes = [view_neighbours(coefficients, stride=stride, sharpness=64.0) for stride in _BOUNCE_STRIDES]
    rays = sun_rays(
        terrain, origin, coefficients.sample_normal, coefficients.sample_outward, coefficients.sample_weight
    )
    return ReadyView(coefficients, rays, ready_reception(coefficients.reception, passes),
                     ready_senders(terrain, coefficients.senders), rough,
                     (index, np.where(shown, distance, np.inf)[index]), gbuffer,
                     ray_directions(camera).reshape(-1, 3))  # fmt: skip


def relight_view(ready: ReadyView, illumination: Illumination) -> View:
    """The view under a light; equals `radiance.render_view` in expectation, with the same number of bounces."""
    coefficients = ready.coefficients
    camera = coefficients.camera
    shape = (camera.height_px, camera.width_px)
    surface_of_shown = surface_radiance(ready, illumination)
    coverage, surface = np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float32)
    coverage.reshape(-1)[coefficients.pixel] = coefficients.coverage
    surface.reshape(-1, 3)[coefficients.pixel] = surface_of_shown
    radiance = _through_air(ready, illumination, surface_of_shown, coverage)
    return View(radiance, surface, coverage, ready.gbuffer)


def surface_radiance(ready: ReadyView, illumination: Illumination) -> np.ndarray:
    """Radiance ``(n, 3)`` [cd/m²] that leaves the terrain of each pixel that shows any, sky counting as black."""
    direct, bounced = arriving(ready.reception, light_senders(ready.senders, illumination))
    total = direct + bounced
    for body in luminaries(illumination):
        light = np.asarray(body.normal_illuminance_lx, np.float32) / np.float32(np.pi)
        total += sun_cosine(ready, body)[:, None] * light
    return total * ready.coefficients.albedo


def sun_cosine(ready: ReadyView, luminary: Luminary) -> np.ndarray:
    """Mean over each pixel ``(n,)`` of cos(angle of incidence) × share of the disc that is seen.

    One ray decides for a pixel whose neighbours agree with it; along shadow edges and silhouettes all samples do.
    """
    cosine = np.maximum(ready.coefficients.normal @ np.asarray(luminary.direction, np.float32), 0.0)
    seen = first_place_sees(ready.rays, luminary)
    mixed = np.flatnonzero(_disagree(ready, seen) | ready.rough | (seen & (cosine < _GRAZING)))
    result = np.where(seen, cosine, 0.0)
    light, possible = incidence(ready.rays, luminary, mixed)
    # The mean normal stems from many more samples than the rays do: only the share that is lit is taken from these.
    sound = (cosine[mixed] > _GRAZING) & (possible > _GRAZING)
    ratio = np.where(sound, cosine[mixed] / np.where(sound, possible, 1.0), 1.0)
    result[mixed] = light * np.clip(ratio, 0.5, 2.0)
    return result


def _disagree(ready: ReadyView, seen: np.ndarray) -> np.ndarray:
    """Pixels among the n of whose eight neighbours on terrain some see the luminary and some do not."""
    camera, pixel = ready.coefficients.camera, ready.coefficients.pixel
    image = np.full((camera.height_px, camera.width_px), 127, np.uint8)
    image.reshape(-1)[pixel] = np.where(seen, 255, 0)
    square = np.ones((3, 3), np.uint8)
    brightest = cv2.dilate(np.where(image == 127, 0, image).astype(np.uint8), square)
    darkest = cv2.erode(np.where(image == 127, 255, image).astype(np.uint8), square)
    return (brightest != darkest).reshape(-1)[pixel]


def _through_air(ready: ReadyView, illumination: Illumination, surface: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """Radiance ``(H, W, 3)`` at the camera; see `radiance.through_air`, whose distances are at hand here."""
    camera, pixel = ready.coefficients.camera, ready.coefficients.pixel
    share = coverage.reshape(-1)
    image = np.zeros((len(share), 3), np.float32)
    terrain = surface
    if illumination.aerial_perspective is not None:
        transmittance, airlight = _air(ready, illumination.aerial_perspective)
        terrain = surface * transmittance + airlight * ready.coefficients.coverage[:, None]
    image[pixel] = terrain
    open_sky = np.flatnonzero(share < 1.0)
    if open_sky.size:
        pixel_angle_deg = float(np.degrees(1.0 / camera.fx))
        sky = background(illumination, ready.direction[open_sky], pixel_angle_deg)
        image[open_sky] += (1.0 - share[open_sky])[:, None] * sky
    return image.reshape(*coverage.shape, 3)


def _air(ready: ReadyView, air: AerialPerspective) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance and airlight ``(n, 3)``: of the centre's distance, averaged over samples along silhouettes."""
    pixel = ready.coefficients.pixel
    depth = ready.gbuffer.depth.reshape(-1)[pixel]
    transmittance, airlight = air(np.where(np.isfinite(depth), depth, 0.0), ready.direction[pixel])
    transmittance, airlight = np.array(transmittance, np.float32), np.array(airlight, np.float32)
    index, distance = ready.silhouette
    if index.size:
        shown = np.isfinite(distance)
        along = np.broadcast_to(ready.direction[pixel[index]][:, None], (*distance.shape, 3))
        each = air(np.where(shown, distance, 0.0), along)
        weight = shown / shown.sum(axis=1, keepdims=True)
        for values, samples in zip((transmittance, airlight), each, strict=True):
            values[index] = np.einsum("ks,ksc->kc", weight, samples)
    return transmittance, airlight
