"""The forward model: what a photograph of a texture would be, given the light. And its parts, which are linear.

radiance at the camera = T · Σ texels share · albedo/π · (E_sun · cos · visibility + E_sky + E_bounce) + airlight
picture                = response(gain · radiance), clipped

with exact shadow rays in the photograph's pixels (`footprints`), skylight and interreflection per texel (daylight
coefficients of the atlas), transmittance T and airlight from the light's own aerial perspective, one gain for each
photograph and channel (exposure and white balance together).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from seasonscapes.albedo.footprints import Footprints
from seasonscapes.rendering.air_grid import AirPlaces, SkyGrid, air_at, air_places, open_sky, sky_grid
from seasonscapes.rendering.hemisphere_rays import RayScene, ray_scene, texture_at
from seasonscapes.rendering.irradiance import DevicePoints, surface_at, upload_points
from seasonscapes.rendering.receivers import DeviceClusters, arriving, light_clusters, luminaries
from seasonscapes.rendering.sun_visibility import cosine_seen
from seasonscapes.rendering.transport import SamplingOptions, trace_points
from seasonscapes.sky.illumination import Illumination
from seasonscapes.terrain.surface import Terrain
from seasonscapes.terrain.texels import texel_positions

Progress = Callable[[float], None]
# Texels need fewer rays than pixels do: their neighbours are averaged by every footprint.
TEXEL_EFFORT = SamplingOptions(subpixels=1, rays=512, listed=64, clusters=8192, rank=32)


@dataclass(frozen=True)
class TexelTransport:
    """A terrain whose albedo is to be found: its daylight coefficients, texel by texel.

    Parameters
    ----------
    ray_scene
        The terrain alone.
    shape
        Rows and columns R, S of the texture.
    texel
        ``(N,)`` flat index of texels that lie on the surface.
    position_m, normal
        ``(N, 3)`` of these.
    ready
        Their coefficients, for any number of lights.
    """

    ray_scene: RayScene
    shape: tuple[int, int]
    texel: np.ndarray
    position_m: np.ndarray
    normal: np.ndarray
    ready: DevicePoints


def trace_texel_transport(
    terrain: Terrain,
    shape: tuple[int, int],
    *,
    sampling: SamplingOptions = TEXEL_EFFORT,
    seed: int = 0,
    smooth: bool = True,
    progress: Progress | None = None,
) -> TexelTransport:
    """Trace the daylight coefficients of every texel of a texture of this shape. Knows nothing of any albedo.

    Parameters
    ----------
    smooth
        Interpolated vertex normals, as `rendering.mitsuba_scene.mi_mesh`; photographs' own terrain is best lit smoothly.
    """
    from seasonscapes.rendering.mitsuba_scene import mi_mesh

    # A middling grey decides which parts of the terrain are worth listing as senders; their true shade comes later.
    bare = ray_scene(mi_mesh(terrain, np.full(3, 0.3, np.float32), smooth=smooth))
    position, _ = texel_positions(terrain, shape[1], shape[0])
    points, texel = surface_at(bare, position.reshape(-1, 3))
    if len(texel) == 0:
        raise ValueError("trace_land: no texel lies on the terrain")
    coefficients = trace_points(bare, points, sampling, seed=seed, number=texel, progress=progress)
    return TexelTransport(bare, shape, texel, points.origin, points.normal, upload_points(bare, coefficients))


def clusters_with_albedo(clusters: DeviceClusters, albedo: np.ndarray) -> DeviceClusters:
    """Senders that reflect by a texture ``(R, S, 3)``: interreflection then is that of this albedo."""
    points = clusters.clusters.points
    uv = points.uv.reshape(-1, 2)
    values = texture_at(albedo, uv).astype(np.float32).reshape(points.albedo.shape)
    return replace(clusters, clusters=replace(clusters.clusters, points=replace(points, albedo=values)))


def ambient_on_texels(land: TexelTransport, light: Illumination, albedo: np.ndarray | None) -> np.ndarray:
    """Illuminance ``(R·S, 3)`` float32 [lx] on texels from sky and interreflection; zero where there is no surface.

    Parameters
    ----------
    albedo
        ``(R, S, 3)`` of the terrain that reflects; ``None`` leaves interreflection out.
    """
    clusters = land.ready.clusters
    clusters = (
        clusters_with_albedo(clusters, np.zeros((2, 2, 3), np.float32))
        if albedo is None
        else clusters_with_albedo(clusters, albedo)
    )
    sky, bounce = arriving(land.ready.receivers, light_clusters(clusters, light))
    ambient = np.zeros((land.shape[0] * land.shape[1], 3), np.float32)
    ambient[land.texel] = np.float32(np.pi) * (sky + bounce)
    return ambient


def sun_on_texels(land: TexelTransport, light: Illumination) -> np.ndarray:
    """Illuminance ``(R·S, 3)`` float32 [lx] on texels directly from sun and moon."""
    sun = np.zeros((land.shape[0] * land.shape[1], 3), np.float32)
    for body in luminaries(light):
        cosine = cosine_seen(land.ready.rays, body, each=4)
        sun[land.texel] += cosine * np.asarray(body.normal_illuminance_lx, np.float32)
    return sun


@dataclass(frozen=True)
class CameraAtmosphere:
    """A camera's directions at which air and open sky are asked, for any number of lights."""

    air: AirPlaces
    sky: SkyGrid
    pixel_angle_deg: float


def camera_atmosphere(footprints: Footprints, *, sky_pixels: int = 4000, seed: int = 0) -> CameraAtmosphere:
    """Where to ask the air before the terrain, and the sky at some of the open pixels.

    ``sky_pixels`` of the open ones are drawn: their mean fixes three gains, which thousands do as well as all.
    """
    camera = footprints.camera
    covered = np.zeros(camera.width_px * camera.height_px, bool)
    covered[footprints.pixel] = True
    # A pixel beside the skyline is blurred with it by lens and JPEG.
    picture = covered.reshape(camera.height_px, camera.width_px)
    open_pixels = np.flatnonzero(~cv2.dilate(picture.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool).ravel())
    if len(open_pixels) > sky_pixels:
        open_pixels = np.sort(np.random.default_rng(seed).choice(open_pixels, sky_pixels, replace=False))
    nothing = (np.empty(0, np.int64), np.empty((0, 1), np.float32))
    return CameraAtmosphere(
        air_places(camera, footprints.pixel, footprints.distance_m, nothing),
        sky_grid(camera, open_pixels),
        float(np.degrees(1.0 / camera.fx)),
    )


def aerial_perspective_of(seen: CameraAtmosphere, light: Illumination, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance and airlight ``(n, 3)`` float32 between a camera and its n terrain pixels; 1 and 0 without air."""
    if light.aerial_perspective is None:
        return np.ones((count, 3), np.float32), np.zeros((count, 3), np.float32)
    transmittance, airlight = air_at(seen.air, light.aerial_perspective)
    return np.ascontiguousarray(transmittance, np.float32), np.ascontiguousarray(airlight, np.float32)


def sky_radiance_of(seen: CameraAtmosphere, light: Illumination) -> np.ndarray:
    """Radiance ``(K, 3)`` [cd/m²] of the chosen open pixels ``seen.sky.pixel``, without the discs of sun and moon."""
    return open_sky(seen.sky, replace(light, sun=None, moon=None), seen.pixel_angle_deg)


def predicted_surface_radiance(
    footprints: Footprints, number: int, light: tuple[Illumination, np.ndarray], albedo: np.ndarray
) -> np.ndarray:
    """Radiance ``(n, 3)`` that leaves the terrain of each pixel, before the air [cd/m²].

    Parameters
    ----------
    number
        Which of the footprints' T lights.
    light
        That light, and the ambient illuminance ``(R·S, 3)`` on texels [lx] that goes with it.
    albedo
        ``(R·S, 3)``.
    """
    illumination, ambient = light
    total = footprints.matrix(footprints.share) @ (ambient * albedo)
    for body, values in zip(luminaries(illumination), footprints.sunlit[number], strict=True):
        total += (footprints.matrix(values) @ albedo) * np.asarray(body.normal_illuminance_lx, np.float32)
    return total / np.float32(np.pi)
