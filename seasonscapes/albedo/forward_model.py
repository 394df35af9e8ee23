"""Forward model of a photograph of a textured terrain under a given light, and its linear parts.

radiance at the camera = T · Σ texels share · albedo/π · (E_sun · cos · visibility + E_sky + E_bounce) + airlight
picture                = response(gain · radiance), clipped

with exact shadow rays in the photograph's pixels (`footprints`), skylight and interreflection per texel (daylight
coefficients of the atlas), transmittance T and airlight from the light's own aerial perspective, and one gain per
photograph and channel (exposure and white balance together).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from seasonscapes.albedo.footprints import Footprints
from seasonscapes.rendering.air_grid import AirGrid, SkyGrid, air_grid, interpolate_air, sky_grid, sky_pixel_radiance
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.hemisphere_rays import RayScene, SurfacePoints, ray_scene, texture_at
from seasonscapes.rendering.irradiance import DevicePoints, surface_at, upload_points
from seasonscapes.rendering.receivers import DeviceClusters, incident_light, light_clusters, luminaries
from seasonscapes.rendering.sun_visibility import visible_cosine
from seasonscapes.rendering.transport import trace_points
from seasonscapes.sky.illumination import Illumination
from seasonscapes.terrain.surface import Terrain
from seasonscapes.terrain.texels import texel_positions

Progress = Callable[[float], None]
# Texels need fewer rays than pixels: every footprint averages over neighbouring texels.
TEXEL_SAMPLING = SamplingOptions(shadow_samples=1, rays=512, clusters_per_receiver=64, clusters=8192, rank=32)


@dataclass(frozen=True)
class TexelTransport:
    """Daylight coefficients of each texel of a terrain texture.

    Parameters
    ----------
    ray_scene
        The terrain alone.
    shape
        Rows and columns R, S of the texture.
    texel
        ``(N,)`` flat index of texels that lie on the surface.
    position_m, normal
        ``(N, 3)`` of these texels.
    device_points
        Their coefficients on the rendering device, valid for any light.
    """

    ray_scene: RayScene
    shape: tuple[int, int]
    texel: np.ndarray
    position_m: np.ndarray
    normal: np.ndarray
    device_points: DevicePoints


def trace_texel_transport(
    terrain: Terrain,
    shape: tuple[int, int],
    *,
    sampling: SamplingOptions = TEXEL_SAMPLING,
    seed: int = 0,
    smooth: bool = True,
    progress: Progress | None = None,
) -> TexelTransport:
    """Trace the daylight coefficients of every texel of a texture. They do not depend on the texture's albedo.

    Parameters
    ----------
    terrain
        Mesh with texture coordinates.
    shape
        Rows and columns R, S of the texture.
    sampling
        Numbers of rays, light clusters and basis directions.
    seed
        Seed of the random numbers.
    smooth
        Interpolate vertex normals, as `rendering.mitsuba_scene.mi_mesh`; recommended for photographs.
    progress
        Called with the finished fraction.

    Returns
    -------
    TexelTransport
        Coefficients of all texels that lie on the terrain.

    Raises
    ------
    ValueError
        If no texel lies on the terrain.
    """
    from seasonscapes.rendering.mitsuba_scene import mi_mesh

    # A medium grey decides which parts of the terrain are listed as light clusters; their albedo is set later.
    grey = ray_scene(mi_mesh(terrain, np.full(3, 0.3, np.float32), smooth=smooth))
    position, _ = texel_positions(terrain, shape[1], shape[0])
    points, texel = surface_at(grey, position.reshape(-1, 3))
    if len(texel) == 0:
        raise ValueError("trace_texel_transport: no texel lies on the terrain")
    return transport_of_points(grey, shape, points, texel, sampling=sampling, seed=seed, progress=progress)


def transport_of_points(
    surface: RayScene,
    shape: tuple[int, int],
    points: SurfacePoints,
    texel: np.ndarray,
    *,
    sampling: SamplingOptions = TEXEL_SAMPLING,
    seed: int = 0,
    progress: Progress | None = None,
) -> TexelTransport:
    """Trace the daylight coefficients of texels whose surface points are known.

    Parameters
    ----------
    surface
        The surface, in a medium grey.
    shape
        Rows and columns R, S of the texture.
    points
        N surface points of texels.
    texel
        ``(N,)`` flat indices of these texels.
    sampling, seed, progress
        See `trace_texel_transport`.

    Returns
    -------
    TexelTransport
        Coefficients of these texels.
    """
    coefficients = trace_points(surface, points, sampling, seed=seed, number=texel, progress=progress)
    return TexelTransport(surface, shape, texel, points.origin, points.normal, upload_points(surface, coefficients))


def clusters_with_albedo(clusters: DeviceClusters, albedo: np.ndarray) -> DeviceClusters:
    """Replace the albedo of light clusters, so that interreflection follows a given texture.

    Parameters
    ----------
    clusters
        Light clusters on the device.
    albedo
        ``(R, S, 3)`` texture.

    Returns
    -------
    DeviceClusters
        The same clusters with the texture's albedo at their points.
    """
    points = clusters.clusters.points
    uv = points.uv.reshape(-1, 2)
    values = texture_at(albedo, uv).astype(np.float32).reshape(points.albedo.shape)
    return replace(clusters, clusters=replace(clusters.clusters, points=replace(points, albedo=values)))


def ambient_on_texels(transport: TexelTransport, light: Illumination, albedo: np.ndarray | None) -> np.ndarray:
    """Illuminance of the texels from sky and interreflection.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    light
        Sun, moon and sky.
    albedo
        ``(R, S, 3)`` of the reflecting terrain; ``None`` leaves interreflection out.

    Returns
    -------
    numpy.ndarray
        ``(R·S, 3)`` float32 [lx]; zero for texels off the surface.
    """
    clusters = transport.device_points.clusters
    clusters = (
        clusters_with_albedo(clusters, np.zeros((2, 2, 3), np.float32))
        if albedo is None
        else clusters_with_albedo(clusters, albedo)
    )
    sky, bounce = incident_light(transport.device_points.receivers, light_clusters(clusters, light))
    ambient = np.zeros((transport.shape[0] * transport.shape[1], 3), np.float32)
    ambient[transport.texel] = np.float32(np.pi) * (sky + bounce)
    return ambient


def sun_on_texels(transport: TexelTransport, light: Illumination) -> np.ndarray:
    """Direct illuminance of the texels from sun and moon.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    light
        Sun, moon and sky.

    Returns
    -------
    numpy.ndarray
        ``(R·S, 3)`` float32 [lx]; zero for texels off the surface.
    """
    sun = np.zeros((transport.shape[0] * transport.shape[1], 3), np.float32)
    for body in luminaries(light):
        cosine = visible_cosine(transport.device_points.rays, body, rays_per_sample=4)
        sun[transport.texel] += cosine * np.asarray(body.normal_illuminance_lx, np.float32)
    return sun


@dataclass(frozen=True)
class CameraAtmosphere:
    """Pixels of a camera at which aerial perspective and sky radiance are evaluated, for any light.

    Parameters
    ----------
    air
        Terrain pixels and their distances; ``None`` for a painted texture, which has no air in front.
    sky
        A sample of the open pixels.
    pixel_angle_deg
        Angle of a pixel at the image centre [°].
    """

    air: AirGrid | None
    sky: SkyGrid
    pixel_angle_deg: float


def camera_atmosphere(footprints: Footprints, *, sky_pixels: int = 4000, seed: int = 0) -> CameraAtmosphere:
    """Select the pixels at which aerial perspective and sky radiance are evaluated.

    Parameters
    ----------
    footprints
        Footprints of the camera.
    sky_pixels
        Number of open pixels drawn; their mean fixes three gains, for which thousands of pixels suffice.
    seed
        Seed of the draw.

    Returns
    -------
    CameraAtmosphere
        All terrain pixels, and the drawn open pixels.
    """
    camera = footprints.camera
    assert camera is not None, "a painted texture has no open pixels"
    covered = np.zeros(camera.width_px * camera.height_px, bool)
    covered[footprints.pixel] = True
    # Lens and JPEG blur terrain into the open pixels next to the skyline.
    terrain = covered.reshape(camera.height_px, camera.width_px).astype(np.uint8)
    open_pixels = np.flatnonzero(~cv2.dilate(terrain, np.ones((5, 5), np.uint8)).astype(bool).ravel())
    if len(open_pixels) > sky_pixels:
        open_pixels = np.sort(np.random.default_rng(seed).choice(open_pixels, sky_pixels, replace=False))
    no_mixed_pixels = (np.empty(0, np.int64), np.empty((0, 1), np.float32))
    return CameraAtmosphere(
        air_grid(camera, footprints.pixel, footprints.distance_m, *no_mixed_pixels),
        sky_grid(camera, open_pixels),
        float(np.degrees(1.0 / camera.fx)),
    )


def aerial_perspective_of(
    atmosphere: CameraAtmosphere, light: Illumination, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance and airlight between a camera and its terrain pixels.

    Parameters
    ----------
    atmosphere
        Pixels of the camera.
    light
        Illumination with or without aerial perspective.
    count
        Number n of terrain pixels.

    Returns
    -------
    tuple of numpy.ndarray
        Transmittance ``(n, 3)`` and airlight ``(n, 3)`` [cd/m²], float32; 1 and 0 without aerial perspective.
    """
    if light.aerial_perspective is None or atmosphere.air is None:
        return np.ones((count, 3), np.float32), np.zeros((count, 3), np.float32)
    transmittance, airlight = interpolate_air(atmosphere.air, light.aerial_perspective)
    return np.ascontiguousarray(transmittance, np.float32), np.ascontiguousarray(airlight, np.float32)


def sky_radiance_of(atmosphere: CameraAtmosphere, light: Illumination) -> np.ndarray:
    """Sky radiance of a camera's sampled open pixels, without the discs of sun and moon.

    Parameters
    ----------
    atmosphere
        Pixels of the camera.
    light
        Illumination of the photograph.

    Returns
    -------
    numpy.ndarray
        ``(K, 3)`` [cd/m²] at the pixels ``atmosphere.sky.pixel``.
    """
    return sky_pixel_radiance(atmosphere.sky, replace(light, sun=None, moon=None), atmosphere.pixel_angle_deg)


def predicted_surface_radiance(
    footprints: Footprints, number: int, light: Illumination, ambient: np.ndarray, albedo: np.ndarray
) -> np.ndarray:
    """Radiance that leaves the terrain in each pixel, before aerial perspective.

    Parameters
    ----------
    footprints
        Footprints of the camera, under T lights.
    number
        Index of the light among these T.
    light
        The light itself.
    ambient
        ``(R·S, 3)`` illuminance of the texels from sky and interreflection [lx], from `ambient_on_texels`.
    albedo
        ``(R·S, 3)``.

    Returns
    -------
    numpy.ndarray
        ``(n, 3)`` [cd/m²].
    """
    total = footprints.matrix(footprints.share) @ (ambient * albedo)
    for body, values in zip(luminaries(light), footprints.sunlit[number], strict=True):
        total += (footprints.matrix(values) @ albedo) * np.asarray(body.normal_illuminance_lx, np.float32)
    return total / np.float32(np.pi)
