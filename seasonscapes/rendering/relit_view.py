"""A view under any light from its daylight coefficients: the same picture as path tracing, without its noise and time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from seasonscapes.rendering.air_grid import AirPlaces, SkyGrid, air_at, air_places, open_sky, sky_grid
from seasonscapes.rendering.gbuffer import GBuffer, trace_gbuffer
from seasonscapes.rendering.hemisphere_rays import RayScene, texture_at
from seasonscapes.rendering.mitsuba_scene import RenderScene
from seasonscapes.rendering.radiance import RenderedView
from seasonscapes.rendering.receivers import (
    DeviceClusters,
    DeviceReceivers,
    arriving,
    light_clusters,
    luminaries,
    upload_clusters,
    upload_receivers,
)
from seasonscapes.rendering.sun_visibility import SunRays, first_place_sees, incidence, pixel_turn, sun_rays
from seasonscapes.rendering.transport import ViewCoefficients, view_neighbours
from seasonscapes.sky.illumination import Illumination, Luminary

# A pixel is rough where distances within it differ by more than this ratio: more than one surface shows in it.
_DEPTH_RATIO = 1.05
# ... and by more than this one its air is averaged over its samples.
_AIR_RATIO = 1.1
# Cosines of incidence below which samples of a pixel may face either way, or bumps between them cast shadows.
_GRAZING = 0.25
# Interreflected light is smooth: its noise is spread over neighbouring pixels of one surface.
_BOUNCE_STRIDES, _BOUNCE_SHARPNESS = (1,), 64.0
# Pixels in work at a time where temporaries are wide.
_BLOCK = 1 << 17


@dataclass(frozen=True)
class RelightableView:
    """A view's coefficients laid out for speed, with what no light changes. n pixels show terrain, S samples in each.

    Parameters
    ----------
    coefficients
        As they were made or read.
    rays
        Shadow rays of all samples, pixel by pixel.
    receivers, senders
        On the device.
    rough
        ``(n,)`` bool: pixels with silhouettes inside.
    gbuffer
        First surfaces at pixel centres.
    coverage
        ``(H, W)`` share of each pixel that is terrain.
    air
        Distances at which the air is asked.
    sky
        Directions in which the open sky is asked.
    """

    coefficients: ViewCoefficients
    rays: SunRays
    receivers: DeviceReceivers
    clusters: DeviceClusters
    rough: np.ndarray
    gbuffer: GBuffer
    coverage: np.ndarray
    air: AirPlaces
    sky: SkyGrid


def relightable_view(terrain: RayScene, coefficients: ViewCoefficients) -> RelightableView:
    """Load coefficients (perhaps memory-mapped) into the form that `relight_view` uses. Done once for many lights."""
    camera, pixel = coefficients.camera, coefficients.pixel
    nearest, farthest, distance = _distances(coefficients)
    coverage = np.zeros((camera.height_px, camera.width_px), np.float32)
    coverage.reshape(-1)[pixel] = coefficients.coverage
    rough = (farthest > nearest * _DEPTH_RATIO) | (coefficients.coverage < 1.0)
    # The bare terrain serves as the scene of a G-buffer: that looks at geometry alone.
    scene = RenderScene(terrain.mi_scene, terrain.mi_terrain, None, 0.0)  # type: ignore[arg-type]
    gbuffer = trace_gbuffer(scene, camera)
    centre_m = gbuffer.depth.reshape(-1)[pixel]
    several = np.flatnonzero((farthest > nearest * _AIR_RATIO) | ~np.isfinite(centre_m))
    air = air_places(camera, pixel, np.where(np.isfinite(centre_m), centre_m, nearest), (several, distance[several]))
    passes = [view_neighbours(coefficients, stride=stride, sharpness=_BOUNCE_SHARPNESS) for stride in _BOUNCE_STRIDES]
    places = (coefficients.sample_origin, coefficients.sample_normal, coefficients.sample_outward)
    rays = sun_rays(
        terrain, places, coefficients.sample_weight, pixel_turn(pixel, camera.width_px, coefficients.sampling.subpixels)
    )
    return RelightableView(
        coefficients,
        rays,
        upload_receivers(coefficients.receivers, passes),
        upload_clusters(terrain, coefficients.clusters),
        rough,
        gbuffer,
        coverage,
        air,
        sky_grid(camera, np.flatnonzero(coverage.reshape(-1) < 1.0)),
    )


def _distances(coefficients: ViewCoefficients) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest and farthest terrain in each pixel ``(n,)``, and of each sample ``(n, S)``, infinite in the sky [m]."""
    position = coefficients.camera.position_m.astype(np.float32)
    shown = np.asarray(coefficients.sample_weight) > 0.0
    distance = np.empty(shown.shape, np.float32)
    for start in range(0, len(shown), _BLOCK):
        part = slice(start, start + _BLOCK)
        distance[part] = np.linalg.norm(coefficients.sample_origin[part] - position, axis=2)
    farthest = np.where(shown, distance, 0.0).max(axis=1)
    distance[~shown] = np.inf
    return distance.min(axis=1), farthest, distance


def with_albedo(ready: RelightableView, albedo: np.ndarray, cluster_albedo: np.ndarray) -> RelightableView:
    """The view with other colours on the same land (another season's).

    Parameters
    ----------
    albedo
        ``(n, 3)`` mean albedo of the pixels, as from `transport.view_albedo`.
    senders_albedo
        ``(M, PLACES, 3)`` of the places that pass light on, as from `cluster_albedo`.
    """
    points = replace(ready.clusters.clusters.points, albedo=np.asarray(cluster_albedo, np.float32))
    clusters = replace(ready.clusters.clusters, points=points)
    coefficients = replace(ready.coefficients, albedo=np.asarray(albedo, np.float32), clusters=clusters)
    return replace(ready, coefficients=coefficients, clusters=replace(ready.clusters, clusters=clusters))


def cluster_albedo(coefficients: ViewCoefficients, texture: np.ndarray) -> np.ndarray:
    """Albedo ``(M, PLACES, 3)`` of the places that pass light on, for a texture ``(R, S, 3)``."""
    points = coefficients.clusters.points
    # Zero marks a surface that was met from its back: that stays black in every season.
    front = np.asarray(points.albedo).max(axis=-1, keepdims=True) > 0.0
    values = texture_at(texture, np.asarray(points.uv).reshape(-1, 2)).reshape(points.albedo.shape)
    return np.where(front, values, 0.0).astype(np.float32)


def relight_view(ready: RelightableView, illumination: Illumination) -> RenderedView:
    """The view under a light; equals `radiance.render_view` in expectation, with the same number of bounces."""
    coefficients = ready.coefficients
    shown = relit_surface_radiance(ready, illumination)
    surface = np.zeros((*ready.coverage.shape, 3), np.float32)
    surface.reshape(-1, 3)[coefficients.pixel] = shown
    return RenderedView(_through_air(ready, illumination, shown), surface, ready.coverage, ready.gbuffer)


def relit_surface_radiance(ready: RelightableView, illumination: Illumination) -> np.ndarray:
    """Radiance ``(n, 3)`` [cd/m²] that leaves the terrain of each pixel that shows any, sky counting as black."""
    direct, bounced = arriving(ready.receivers, light_clusters(ready.clusters, illumination))
    total = direct + bounced
    for body in luminaries(illumination):
        light = np.asarray(body.normal_illuminance_lx, np.float32) / np.float32(np.pi)
        total += sun_cosine(ready, body)[:, None] * light
    return total * ready.coefficients.albedo


def sun_cosine(ready: RelightableView, luminary: Luminary) -> np.ndarray:
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


def _disagree(ready: RelightableView, seen: np.ndarray) -> np.ndarray:
    """Pixels among the n of whose eight neighbours on terrain some see the luminary and some do not."""
    camera, pixel = ready.coefficients.camera, ready.coefficients.pixel
    image = np.full((camera.height_px, camera.width_px), 127, np.uint8)
    image.reshape(-1)[pixel] = np.where(seen, 255, 0)
    square = np.ones((3, 3), np.uint8)
    brightest = cv2.dilate(np.where(image == 127, 0, image).astype(np.uint8), square)
    darkest = cv2.erode(np.where(image == 127, 255, image).astype(np.uint8), square)
    return (brightest != darkest).reshape(-1)[pixel]


def _through_air(ready: RelightableView, illumination: Illumination, surface: np.ndarray) -> np.ndarray:
    """Radiance ``(H, W, 3)`` at the camera; see `radiance.apply_aerial_perspective`, whose distances are at hand here."""
    camera, pixel = ready.coefficients.camera, ready.coefficients.pixel
    if illumination.aerial_perspective is not None:
        transmittance, airlight = air_at(ready.air, illumination.aerial_perspective)
        surface = surface * transmittance + airlight * ready.coefficients.coverage[:, None]
    image = np.zeros((camera.height_px * camera.width_px, 3), np.float32)
    image[pixel] = surface
    if len(ready.sky.pixel):
        sky = open_sky(ready.sky, illumination, float(np.degrees(1.0 / camera.fx)))
        image[ready.sky.pixel] += (1.0 - ready.coverage.reshape(-1)[ready.sky.pixel])[:, None] * sky
    return image.reshape(*ready.coverage.shape, 3)
