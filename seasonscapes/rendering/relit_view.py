"""Relighting of a view from its daylight coefficients.

Equals path tracing in expectation; per illumination it costs some shadow rays and small matrix products.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from seasonscapes.images import scaled_pixels
from seasonscapes.rendering.air_grid import AirGrid, SkyGrid, air_grid, sky_grid, sky_pixel_radiance, start_air
from seasonscapes.rendering.coefficients import ViewCoefficients
from seasonscapes.rendering.gbuffer import GBuffer, trace_gbuffer
from seasonscapes.rendering.ground_optics import GroundOptics
from seasonscapes.rendering.hemisphere_rays import RayScene, albedo_at
from seasonscapes.rendering.mirrored_light import DeviceMirror, mirrored_radiance, upload_mirror
from seasonscapes.rendering.mitsuba_scene import RenderScene
from seasonscapes.rendering.radiance import RenderedView
from seasonscapes.rendering.receivers import (
    ClusterLight,
    DeviceClusters,
    DeviceReceivers,
    luminaries,
    start_clusters,
    start_incident_light,
    upload_clusters,
    upload_receivers,
)
from seasonscapes.rendering.sun_visibility import (
    SunRays,
    bayer_disc_offset,
    start_first_samples,
    start_sum_facing,
    start_sum_incidence,
    sun_rays,
)
from seasonscapes.rendering.terrain_material import ground_optics
from seasonscapes.rendering.transport import view_neighbours
from seasonscapes.sky.illumination import Illumination, Luminary

# Ratio of distances within a pixel above which it contains more than one surface,
_DEPTH_RATIO = 1.05
# and above which its aerial perspective is averaged over its samples.
_AIR_RATIO = 1.1
# Below this cosine of incidence the samples of a pixel may face the sun or not.
_GRAZING = 0.25
# Interreflected light varies slowly; its noise is averaged over neighbouring pixels of one surface, at these strides,
_BOUNCE_STRIDES, _BOUNCE_SHARPNESS = (1,), 64.0
# and over wider surroundings in pictures with fewer rays than these, where noise is what errs most.
_MANY_RAYS, _WIDE_STRIDES = 256, (1, 2)
# Mean length of runs of terrain pixels above which they are copied run by run [px], chosen.
_LEAST_RUN = 32
# Pixels per block of the distance computation; bounds the memory.
_BLOCK = 1 << 17


@dataclass(frozen=True)
class RelightableView:
    """A view's coefficients on the Dr.Jit device, with all quantities that do not depend on the illumination.

    n pixels show terrain, with S samples each.

    Parameters
    ----------
    coefficients
        Coefficients of the view, in host memory.
    rays
        Shadow rays from all samples.
    receivers, clusters
        Light transport coefficients of the pixels, and the clusters of faces, on the device.
    silhouette
        ``(n,)`` bool: pixels that contain a depth discontinuity or the border of the terrain.
    gbuffer
        First surfaces at pixel centres.
    coverage
        ``(H, W)`` float32 fraction of each pixel that terrain covers.
    air
        Grid at which aerial perspective is evaluated.
    sky
        Grid at which sky radiance is evaluated.
    mirror
        What the water in the view mirrors; ``None`` without water.
    optics
        How snow and forest scatter; ``None``: they are Lambertian.
    """

    coefficients: ViewCoefficients
    rays: SunRays
    receivers: DeviceReceivers
    clusters: DeviceClusters
    silhouette: np.ndarray
    gbuffer: GBuffer
    coverage: np.ndarray
    air: AirGrid
    sky: SkyGrid
    mirror: DeviceMirror | None = None
    optics: GroundOptics | None = None


def relightable_view(terrain: RayScene, coefficients: ViewCoefficients) -> RelightableView:
    """Copy the coefficients of a view to the device, once for many illuminations.

    Parameters
    ----------
    terrain
        The terrain that occludes shadow rays.
    coefficients
        Coefficients of the view, possibly memory-mapped.

    Returns
    -------
    RelightableView
        For `relight_view`.
    """
    camera, pixel = coefficients.camera, coefficients.pixel
    nearest, farthest, distance = _distances(coefficients)
    coverage = np.zeros((camera.height_px, camera.width_px), np.float32)
    coverage.reshape(-1)[pixel] = coefficients.coverage
    silhouette = (farthest > nearest * _DEPTH_RATIO) | (coefficients.coverage < 1.0)
    # A G-buffer depends on geometry alone, so that the scene needs no illumination.
    scene = RenderScene(terrain.mi_scene, terrain.mi_terrain)
    gbuffer = trace_gbuffer(scene, camera)
    centre_m = gbuffer.depth.reshape(-1)[pixel]
    mixed = np.flatnonzero((farthest > nearest * _AIR_RATIO) | ~np.isfinite(centre_m))
    air = air_grid(camera, pixel, np.where(np.isfinite(centre_m), centre_m, nearest), mixed, distance[mixed])
    strides = _BOUNCE_STRIDES if coefficients.sampling.rays >= _MANY_RAYS else _WIDE_STRIDES
    passes = [view_neighbours(coefficients, stride=stride, sharpness=_BOUNCE_SHARPNESS) for stride in strides]
    rays = sun_rays(
        terrain,
        coefficients.sample_origin,
        coefficients.sample_normal,
        coefficients.sample_outward,
        coefficients.sample_weight,
        bayer_disc_offset(pixel, camera.width_px, coefficients.sampling.shadow_samples),
    )
    return RelightableView(
        coefficients,
        rays,
        upload_receivers(coefficients.receivers, passes),
        upload_clusters(terrain, coefficients.clusters),
        silhouette,
        gbuffer,
        coverage,
        air,
        sky_grid(camera, np.flatnonzero(coverage.reshape(-1) < 1.0)),
        upload_mirror(terrain, coefficients),
        ground_optics(terrain.mi_terrain.bsdf()),
    )


def _distances(coefficients: ViewCoefficients) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest and farthest distance per pixel ``(n,)`` and distance per sample ``(n, S)`` [m], infinite in the sky."""
    position = coefficients.camera.position_m.astype(np.float32)
    on_terrain = np.asarray(coefficients.sample_weight) > 0.0
    distance = np.empty(on_terrain.shape, np.float32)
    for start in range(0, len(on_terrain), _BLOCK):
        part = slice(start, start + _BLOCK)
        distance[part] = np.linalg.norm(coefficients.sample_origin[part] - position, axis=2)
    farthest = np.where(on_terrain, distance, 0.0).max(axis=1)
    distance[~on_terrain] = np.inf
    return distance.min(axis=1), farthest, distance


def with_albedo(
    view: RelightableView, albedo: np.ndarray, cluster_albedo: np.ndarray, mirrored_albedo: np.ndarray | None = None
) -> RelightableView:
    """Return the view with another albedo of the same terrain (such as another season's).

    Parameters
    ----------
    view
        The view.
    albedo
        ``(n, 3)`` mean albedo of the pixels, from `transport.view_albedo`.
    cluster_albedo
        ``(M, POINTS_PER_CLUSTER, 3)`` albedo of the points of the clusters, from the function `cluster_albedo`.
    mirrored_albedo
        ``(m, 3)`` of the ground that water mirrors, from the function `mirrored_albedo`; ``None`` leaves it.

    Returns
    -------
    RelightableView
        The view with the albedo replaced.
    """
    points = replace(view.clusters.clusters.points, albedo=np.asarray(cluster_albedo, np.float32))
    clusters = replace(view.clusters.clusters, points=points)
    coefficients = replace(view.coefficients, albedo=np.asarray(albedo, np.float32), clusters=clusters)
    mirror = view.mirror
    if mirror is not None and mirrored_albedo is not None:
        mirror = replace(mirror, albedo=np.asarray(mirrored_albedo, np.float32))
    clusters = replace(view.clusters, clusters=clusters)
    return replace(view, coefficients=coefficients, clusters=clusters, mirror=mirror)


def cluster_albedo(terrain: RayScene, coefficients: ViewCoefficients) -> np.ndarray:
    """Look up the current albedo of the terrain at the points of a view's clusters.

    Parameters
    ----------
    terrain
        The terrain with the albedo, see `mitsuba_scene.set_albedo`.
    coefficients
        Coefficients of a view.

    Returns
    -------
    numpy.ndarray
        ``(M, POINTS_PER_CLUSTER, 3)`` float32.
    """
    points = coefficients.clusters.points
    # An albedo of zero marks surfaces that were hit from their back, which stay black for every texture.
    front = np.asarray(points.albedo).max(axis=-1, keepdims=True) > 0.0
    return np.where(front, albedo_at(terrain, np.asarray(points.uv), np.asarray(points.origin)), 0.0).astype(np.float32)


def mirrored_albedo(terrain: RayScene, coefficients: ViewCoefficients) -> np.ndarray | None:
    """Average the current albedo of the terrain over the ground that the water in a view mirrors.

    Parameters
    ----------
    terrain
        The terrain with the albedo, see `mitsuba_scene.set_albedo`.
    coefficients
        Coefficients of a view.

    Returns
    -------
    numpy.ndarray or None
        ``(m, 3)`` float32 as in `MirrorCoefficients`; ``None`` without water.
    """
    mirror = coefficients.mirror
    if mirror is None:
        return None
    share = np.asarray(mirror.sample_share, np.float32)
    return np.einsum(
        "ms,msc->mc", share, albedo_at(terrain, np.asarray(mirror.sample_uv), np.asarray(mirror.sample_origin))
    )


def relight_view(view: RelightableView, illumination: Illumination) -> RenderedView:
    """Render the view under an illumination; equals `radiance.render_view` in expectation, for equally many bounces.

    Parameters
    ----------
    view
        From `relightable_view`.
    illumination
        Sky, sun, moon and aerial perspective.

    Returns
    -------
    RenderedView
        Radiance at the camera, radiance of the surface, coverage and G-buffer.
    """
    # Rays are traced by other threads while air and sky are evaluated here.
    surface_radiance = _start_surface_radiance(view, illumination)
    air = illumination.aerial_perspective
    read_air = None if air is None else start_air(view.air, air)
    sky = None
    if len(view.sky.pixel):
        pixel_angle_deg = float(np.degrees(1.0 / view.coefficients.camera.fx))
        sky = sky_pixel_radiance(view.sky, illumination, pixel_angle_deg)
    pixel_radiance = surface_radiance()
    image = _at_camera(view, pixel_radiance, None if read_air is None else read_air(), sky)
    return RenderedView(image, terrain_image(view, pixel_radiance), view.coverage, view.gbuffer)


def terrain_image(view: RelightableView, values: np.ndarray) -> np.ndarray:
    """Return an image ``(H, W, 3)`` of the values ``(n, 3)`` of a view's terrain pixels, zero elsewhere."""
    image = np.zeros((*view.coverage.shape, 3), np.float32)
    rows, pixel = image.reshape(-1, 3), view.coefficients.pixel
    ends = np.append(np.flatnonzero(np.diff(pixel) != 1) + 1, len(pixel))
    if len(ends) * _LEAST_RUN > len(pixel):
        rows[pixel] = values
        return image
    # Terrain pixels are long runs, and copying each is several times quicker than picking every pixel.
    start = 0
    for end in ends.tolist():
        first = int(pixel[start])
        rows[first : first + end - start] = values[start:end]
        start = end
    return image


def _start_surface_radiance(view: RelightableView, illumination: Illumination) -> Callable[[], np.ndarray]:
    """Start the shadow rays, and return the function that gives the radiance that leaves the terrain in each of the n pixels.

    ``(n, 3)`` float32 [cd/m²], averaged over the pixel with the sky counted as black. Other threads trace while the caller
    computes something else.
    """
    bodies = luminaries(illumination)
    clusters = start_clusters(view.clusters, illumination, bodies)
    sunlight = [(body, _start_sun_cosine(view, body)) for body in bodies]
    return lambda: _lit_surface(view, illumination, clusters(), sunlight)


def _lit_surface(
    view: RelightableView,
    illumination: Illumination,
    clusters: ClusterLight,
    sunlight: list[tuple[Luminary, Callable[[], Callable[[], np.ndarray]]]],
) -> np.ndarray:
    """Radiance ``(n, 3)`` by the light of the clusters and the begun cosines of sun and moon."""
    incident = start_incident_light(view.receivers, clusters)
    cosines = [(body, trace_borders()) for body, trace_borders in sunlight]
    total = incident()
    ground = None if view.optics is None else _GroundPixels(view, view.optics)
    if ground is not None:
        total *= ground.of_diffuse_light()
    for body, read_cosine in cosines:
        light = np.asarray(body.normal_illuminance_lx, np.float32) / np.float32(np.pi)
        cosine = read_cosine()
        lit = np.stack([cosine * channel for channel in light], axis=-1)
        total += lit if ground is None else lit * ground.of_luminary(body, cosine)
    radiance = total * view.coefficients.albedo
    if view.mirror is not None:
        radiance[view.mirror.coefficients.pixel] += mirrored_radiance(view.mirror, illumination, clusters)
    return radiance


class _GroundPixels:
    """Reflection of the n terrain pixels towards the camera relative to Lambertian ground, each ``(n, 3)``."""

    def __init__(self, view: RelightableView, optics: GroundOptics) -> None:
        coefficients = view.coefficients
        self._optics = optics
        self._albedo = coefficients.albedo / np.maximum(coefficients.coverage[:, None], 1e-3)
        normal = coefficients.normal
        self._normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
        # Samples on terrain come first.
        viewer = coefficients.camera.position_m.astype(np.float32) - coefficients.sample_origin[:, 0]
        self._viewer = viewer / np.linalg.norm(viewer, axis=1, keepdims=True)
        self._cosine = np.einsum("nk,nk->n", self._normal, self._viewer)

    def of_diffuse_light(self) -> np.ndarray:
        return self._optics.relative_diffuse_rows(self._albedo, self._cosine)

    def of_luminary(self, body: Luminary, lit_cosine: np.ndarray) -> np.ndarray:
        light = np.asarray(body.direction, np.float32)
        # On rims the mean normal may face away from a light that some samples face: it would be as bright as grazing snow.
        incident = np.maximum(self._normal @ light, lit_cosine)
        return self._optics.relative_rows(self._albedo, (self._cosine, incident, self._viewer @ light))


def sun_cosine(view: RelightableView, luminary: Luminary) -> np.ndarray:
    """Average cos(angle of incidence) × visible fraction of the luminary's disc over each terrain pixel.

    One shadow ray per pixel is traced first. All samples of a pixel are traced where neighbouring pixels differ and on
    silhouettes. At grazing incidence elsewhere, the samples that face the luminary are lit.

    Parameters
    ----------
    view
        From `relightable_view`.
    luminary
        Sun or moon.

    Returns
    -------
    numpy.ndarray
        ``(n,)``.
    """
    return _start_sun_cosine(view, luminary)()()


def _start_sun_cosine(view: RelightableView, luminary: Luminary) -> Callable[[], Callable[[], np.ndarray]]:
    """Start the first rays of `sun_cosine`; what is returned starts those at borders, and returns what gives the result.

    Other threads trace each of them while the caller computes something else.
    """
    read_first = start_first_samples(view.rays, luminary)
    cosine = np.maximum(view.coefficients.normal @ np.asarray(luminary.direction, np.float32), 0.0)

    def trace_borders() -> Callable[[], np.ndarray]:
        visible = read_first()
        traced = (_nearby(view, visible) & _nearby(view, ~visible)) | view.silhouette
        mixed = np.flatnonzero(traced)
        of_mixed = start_sum_incidence(view.rays, luminary, mixed)
        # The light reaches all nine pixels around: what matters on slopes that it grazes is which samples face it.
        grazed = np.flatnonzero(visible & (cosine < _GRAZING) & ~traced)
        of_grazed = start_sum_facing(view.rays, luminary, grazed)

        def read() -> np.ndarray:
            result = np.where(visible, cosine, 0.0)
            sunlit, unoccluded = of_mixed()
            result[grazed] = of_grazed()
            # The mean normal averages many more samples than the shadow rays: these only determine the sunlit fraction.
            reliable = (cosine[mixed] > _GRAZING) & (unoccluded > _GRAZING)
            ratio = np.where(reliable, cosine[mixed] / np.where(reliable, unoccluded, 1.0), 1.0)
            result[mixed] = sunlit * np.clip(ratio, 0.5, 2.0)
            return result

        return read

    return trace_borders


def _nearby(view: RelightableView, chosen: np.ndarray) -> np.ndarray:
    """Pixels ``(n,)`` within whose 3 × 3 neighbourhood on terrain at least one is chosen."""
    camera, pixel = view.coefficients.camera, view.coefficients.pixel
    image = np.zeros((camera.height_px, camera.width_px), np.uint8)
    image.reshape(-1)[pixel] = chosen
    return cv2.dilate(image, np.ones((3, 3), np.uint8)).reshape(-1)[pixel] > 0


def _at_camera(
    view: RelightableView, surface: np.ndarray, air: tuple[np.ndarray, np.ndarray] | None, sky: np.ndarray | None
) -> np.ndarray:
    """Radiance ``(H, W, 3)`` at the camera from that of surface, air and sky; see `radiance.apply_aerial_perspective`."""
    if air is not None:
        transmittance, airlight = air
        surface = surface * transmittance
        surface += scaled_pixels(airlight, view.coefficients.coverage)
    image = terrain_image(view, surface)
    if sky is not None:
        share = 1.0 - view.coverage.reshape(-1)[view.sky.pixel]
        image.reshape(-1, 3)[view.sky.pixel] += scaled_pixels(sky, share)
    return image
