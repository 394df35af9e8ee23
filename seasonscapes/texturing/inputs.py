"""Preparation of photographs for painting: usable pixels, confidence, resolution pyramid, horizon sky and sampling."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

import cv2
import numpy as np

from seasonscapes.cameras.observation import Observation
from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.rendering.mitsuba_scene import RenderScene
from seasonscapes.sky.illumination import AerialPerspective
from seasonscapes.texturing.atlas_tiles import AtlasTiling, TexelSurface, visible_blocks
from seasonscapes.texturing.silhouette import picture_mask, pose_sigma_px, silhouette_guard
from seasonscapes.texturing.texel_weights import BRIGHTEST, exposure_confidence
from seasonscapes.texturing.visibility import ProjectedTexels

# Objects nearer than this are likely to be roofs or trees that the terrain model lacks [m].
NEAR_M = 60.0
# Height of the bands of sky above the horizon from which the colour of the airlight is measured [deg].
_HORIZON_DEG = 6.0
# Least number of pixels in a band, and greatest fraction of clipped pixels.
_MIN_SKY_PX, _MAX_CLIPPED = 50, 0.05
# Least fraction of usable pixels in the footprint of a sample.
_MIN_COVERAGE = 0.75
# Pixels of the image that a list of sample positions is folded into.
_ROW = 1024
# Surface points per photograph that are compared between photographs.
PROBES, _PROBE_SEED = 4000, 20240918


@dataclass(frozen=True)
class PaintingInput:
    """An observation to paint, with the air between camera and terrain.

    Parameters
    ----------
    observation
        Photograph by a perspective camera. Its image is the decoded sRGB of the file in [0, 1], of unknown exposure and
        white balance. Near silhouettes its ``pose_sigma`` reduces the confidence of pixels.
    air
        Aerial perspective between camera and terrain at the time of the photograph; ``None`` for none.
    """

    observation: Observation
    air: AerialPerspective | None = None

    @property
    def camera(self) -> Camera:
        """The perspective camera of the observation."""
        camera = self.observation.camera
        assert isinstance(camera, Camera), "painting needs perspective views"
        return camera

    @property
    def key(self) -> tuple[str, datetime, bytes, float]:
        """Sort key that makes a painting independent of the order of its inputs."""
        camera = self.camera
        return self.observation.webcam, self.observation.time, camera.world_from_camera.tobytes(), camera.fx


@dataclass(frozen=True)
class PreparedInput:
    """A painting input prepared for sampling.

    Parameters
    ----------
    painting_input
        The input that it was made from.
    depth_m
        ``(H, W)`` float32 distance along the rays [m]; infinite is sky.
    confidence
        ``(H, W)`` float32 in [0, 1]: usable mask × silhouette confidence × exposure confidence.
    levels
        Resolution pyramid by factors of two, ``(h, w, 5)`` float32 each: colour × usable, usable, confidence.
    blocks
        Coarse viewshed, from `atlas_tiles.visible_blocks`.
    sky_value
        ``(3,)`` image value of the sky above the horizon; NaN where no sky is in view or a channel is clipped.
    sky_radiance
        ``(3,)`` radiance of the same sky by the sky model [cd/m²]; NaN likewise.
    median_value
        ``(3,)`` median image value of terrain pixels with high confidence.
    probes
        Up to `PROBES` surface points in view, in random order.
    probe_uv
        ``(N, 2)`` their texture coordinates.
    """

    painting_input: PaintingInput
    depth_m: np.ndarray
    confidence: np.ndarray
    levels: tuple[np.ndarray, ...]
    blocks: np.ndarray
    sky_value: np.ndarray
    sky_radiance: np.ndarray
    median_value: np.ndarray
    probes: TexelSurface
    probe_uv: np.ndarray


def prepare_input(
    painting_input: PaintingInput,
    terrain: RayScene,
    atlas_tiling: AtlasTiling,
    *,
    near_m: float = NEAR_M,
    reject: np.ndarray | None = None,
    guard: bool = True,
) -> PreparedInput:
    """Trace the terrain in an input's view and compute the confidence of its pixels.

    Parameters
    ----------
    painting_input
        The photograph.
    terrain
        Ray-tracing scene of the terrain.
    atlas_tiling
        The atlas in tiles, with the same terrain.
    near_m
        Pixels that show terrain nearer than this are excluded [m].
    reject
        ``(H, W)`` bool, further pixels to exclude (`foreground.foreground_mask`).
    guard
        Reduce the confidence near silhouettes.

    Returns
    -------
    PreparedInput
        Ready for `sample_input`.
    """
    observation, camera = painting_input.observation, painting_input.camera
    gbuffer = trace_gbuffer(unlit_scene(terrain), camera)
    depth = gbuffer.depth.astype(np.float32)
    usable = picture_mask(observation.image, observation.mask, depth, near_m=near_m)
    if reject is not None:
        usable &= ~reject
    image = np.where(usable[..., None], observation.image, 0.0).astype(np.float32)
    confidence = usable * exposure_confidence(image)
    if guard:
        confidence = confidence * silhouette_guard(depth, pose_sigma_px(camera, observation.pose_sigma, depth))
    pixel = np.flatnonzero(confidence > 0.5)
    pixel = np.random.default_rng(_PROBE_SEED).permutation(pixel)[:PROBES]
    side_m = _texel_side_m(atlas_tiling)
    probes = TexelSurface(
        pixel,
        np.full(len(pixel), -1, np.int32),
        gbuffer.position.reshape(-1, 3)[pixel].astype(float),
        gbuffer.normal.reshape(-1, 3)[pixel].astype(np.float32),
        np.full(len(pixel), side_m, np.float32),
    )
    median = np.median(image.reshape(-1, 3)[pixel], axis=0) if len(pixel) else np.full(3, np.nan)
    return PreparedInput(
        painting_input,
        depth,
        confidence.astype(np.float32),
        _pyramid(image, usable, confidence),
        visible_blocks(gbuffer.uv, atlas_tiling),
        *_horizon_sky(painting_input, depth),
        median,
        probes,
        gbuffer.uv.reshape(-1, 2)[pixel].astype(np.float32),
    )


def unlit_scene(terrain: RayScene) -> RenderScene:
    """Return a scene without light, which suffices for a G-buffer.

    Parameters
    ----------
    terrain
        Ray-tracing scene of the terrain.

    Returns
    -------
    RenderScene
        For `trace_gbuffer` alone.
    """
    return RenderScene(terrain.mi_scene, terrain.mi_terrain)


def _texel_side_m(atlas_tiling: AtlasTiling) -> float:
    """Side of a texel if the whole atlas were used [m]."""
    extent = np.ptp(atlas_tiling.terrain.vertices[:, :2], axis=0).astype(float)
    return float(np.sqrt(extent[0] * extent[1] / (atlas_tiling.width_px * atlas_tiling.height_px)))


def _pyramid(image: np.ndarray, usable: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, ...]:
    levels = [np.dstack([image, usable.astype(np.float32), confidence.astype(np.float32)]).astype(np.float32)]
    while min(levels[-1].shape[:2]) >= 16 and len(levels) < 7:
        height, width = levels[-1].shape[:2]
        # Even sizes, so that each level has exactly half the resolution of the one before.
        even = levels[-1][: height // 2 * 2, : width // 2 * 2]
        levels.append(even.reshape(height // 2, 2, width // 2, 2, 5).mean(axis=(1, 3)))
    return tuple(levels)


def _horizon_sky(painting_input: PaintingInput, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median image value of the lowest sky that is not clipped, and its radiance by the sky model, ``(3,)`` each."""
    observation, air, unknown = painting_input.observation, painting_input.air, np.full(3, np.nan)
    if air is None:
        return unknown, unknown
    direction = ray_directions(painting_input.camera)
    sky = ~np.isfinite(depth_m) & observation.mask & np.isfinite(observation.image).all(axis=2)
    # Pixels on the skyline mix sky and terrain.
    sky = cv2.erode(sky.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    if np.count_nonzero(sky) < _MIN_SKY_PX:
        return unknown, unknown
    pixel = np.flatnonzero(sky)
    elevation_deg = np.degrees(np.arcsin(np.clip(direction[..., 2].ravel()[pixel], -1.0, 1.0)))
    image_value = observation.image.reshape(-1, 3)[pixel].astype(float)
    value, radiance = unknown.copy(), unknown.copy()
    # Each channel takes the lowest band in which it is not clipped (the red of a blue sky clips last). The unclipped
    # pixels of a clipped band are its darkest ones and would bias the median.
    for low in np.arange(elevation_deg.min(), elevation_deg.max(), 0.5 * _HORIZON_DEG):
        band = np.flatnonzero((elevation_deg >= low) & (elevation_deg < low + _HORIZON_DEG))
        if len(band) < _MIN_SKY_PX:
            continue
        band = band[:: max(1, len(band) // 2000)]
        new = np.isnan(value) & ((image_value[band] > BRIGHTEST).mean(axis=0) <= _MAX_CLIPPED)
        if new.any():
            expected = air(np.full(len(band), np.inf), direction.reshape(-1, 3)[pixel[band]])[1]
            value[new] = np.median(image_value[band], axis=0)[new]
            radiance[new] = np.maximum(np.median(expected, axis=0), 1e-9)[new]
    return value, radiance


def horizon_radiance(painting_input: PaintingInput) -> float:
    """Return the mean radiance of the sky at the horizon by the sky model.

    Parameters
    ----------
    painting_input
        The photograph with its air.

    Returns
    -------
    float
        Mean over azimuths 2° above the horizon [cd/m²]; 0 without air.
    """
    air = painting_input.air
    if air is None:
        return 0.0
    azimuth = np.radians(np.arange(0.0, 360.0, 30.0))
    horizon = np.stack([np.sin(azimuth), np.cos(azimuth), np.full(azimuth.shape, np.sin(np.radians(2.0)))], axis=-1)
    return float(np.mean(air(np.full(len(horizon), np.inf), horizon)[1]))


def transmittance_and_airlight(prepared: PreparedInput, position_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return transmittance and airlight between an input's camera and points.

    Parameters
    ----------
    prepared
        The input.
    position_m
        ``(N, 3)`` points, ENU [m].

    Returns
    -------
    transmittance, airlight
        ``(N, 3)`` each, in [0, 1] and [cd/m²]; 1 and 0 without air.
    """
    air = prepared.painting_input.air
    if air is None:
        return np.ones(position_m.shape), np.zeros(position_m.shape)
    offset = position_m - prepared.painting_input.camera.position_m
    distance = np.linalg.norm(offset, axis=1)
    return air(distance, offset / np.maximum(distance, 1e-6)[:, None])


def texel_extent_px(camera: Camera, surface: TexelSurface, projected: ProjectedTexels) -> np.ndarray:
    """Return the side of the square in the image with the area of each texel's projection.

    Parameters
    ----------
    camera
        The view.
    surface
        N surface points.
    projected
        Their projection.

    Returns
    -------
    ndarray
        ``(N,)`` [px], foreshortening included.
    """
    normal_incidence = camera.fx * surface.texel_m / np.maximum(projected.distance_m, 1e-3)
    return normal_incidence * np.sqrt(np.clip(projected.cosine, 0.0, 1.0))


def sample_input(prepared: PreparedInput, pixel: np.ndarray, px_per_texel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sample an input's image at texels by trilinear look-up in its resolution pyramid.

    Parameters
    ----------
    prepared
        The input.
    pixel
        ``(N, 2)`` image coordinates (x, y).
    px_per_texel
        ``(N,)`` side of each texel's footprint [px]; up to 1 px the finest level is used.

    Returns
    -------
    value
        ``(N, 3)`` mean of the usable pixels in the footprint; NaN where less than three quarters of it are usable.
    confidence
        ``(N,)`` in [0, 1]; 0 where the value is NaN.
    """
    level = np.clip(np.log2(np.maximum(px_per_texel, 1.0)), 0.0, len(prepared.levels) - 1.0)
    finer = np.minimum(level.astype(int), len(prepared.levels) - 1)
    mixed = np.zeros((len(pixel), 5), np.float32)
    for number in np.unique(finer):
        index = np.flatnonzero(finer == number)
        fraction = (level[index] - number).astype(np.float32)[:, None]
        value = _look_up(prepared.levels[number], pixel[index], number)
        between = np.flatnonzero(fraction[:, 0] > 0.0)
        if len(between):
            coarser = prepared.levels[min(number + 1, len(prepared.levels) - 1)]
            coarse = _look_up(coarser, pixel[index[between]], number + 1)
            value[between] += fraction[between] * (coarse - value[between])
        mixed[index] = value
    coverage = mixed[:, 3]
    sufficient = coverage >= _MIN_COVERAGE
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.where(sufficient[:, None], mixed[:, :3] / coverage[:, None], np.nan)
    return np.maximum(value, 0.0), np.where(sufficient, np.clip(mixed[:, 4], 0.0, 1.0), 0.0)


def _look_up(level: np.ndarray, pixel: np.ndarray, number: int) -> np.ndarray:
    """Bilinear values ``(N, 5)``. OpenCV expects positions in the shape of an image, so the list is folded."""
    count = len(pixel)
    rows = -(-count // _ROW)
    position = np.zeros((rows * _ROW, 2), np.float32)
    position[:count] = pixel / 2.0**number - 0.5
    position = position.reshape(rows, _ROW, 2)
    # OpenCV samples at most four channels at once.
    parts = [
        cv2.remap(  # pyright: ignore[reportCallIssue]
            level[..., part],
            position,
            None,  # pyright: ignore[reportArgumentType]
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for part in (slice(0, 4), slice(4, 5))
    ]
    return np.concatenate([part.reshape(rows * _ROW, -1)[:count] for part in parts], axis=1)
