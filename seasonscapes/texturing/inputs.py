"""Pictures made ready for painting: masked, guarded, and sampled at texels without aliasing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np

from seasonscapes.cameras.observation import Observation
from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.rendering.mitsuba_scene import RenderScene
from seasonscapes.sky.illumination import AerialPerspective
from seasonscapes.texturing.atlas_tiles import AtlasTiling, TexelSurface, seen_blocks
from seasonscapes.texturing.silhouette import picture_mask, pose_sigma_px, silhouette_guard
from seasonscapes.texturing.texel_weights import BRIGHTEST, exposure_confidence
from seasonscapes.texturing.visibility import ProjectedTexels

# What is nearer than this is rather a roof or a tree than the terrain model's ground.
NEAR_M = 60.0
# Sky this close above the horizon tells the colour of the airlight.
_HORIZON_DEG = 6.0
_FEWEST_SKY_PX, _MOST_CLIPPED = 50, 0.05
# Least share of usable pixels under a sample.
_LEAST_COVER = 0.75
_ROW = 1024
# Places of each shot that are compared with other shots.
PROBES, _PROBE_SEED = 4000, 20240918


@dataclass(frozen=True)
class PaintingInput:
    """An observation, with what painting knows of its pose and of the air before it.

    Parameters
    ----------
    observation
        Its image is decoded sRGB in [0, 1] as a file holds it, of unknown exposure and white balance.
    air
        Between this camera and the land, at that time; ``None`` for clear space.
    pose_sigma
        Standard deviations with the names of a calibration record; missing ones count as exact.
    """

    observation: Observation
    air: AerialPerspective | None = None
    pose_sigma: Mapping[str, float] = field(default_factory=dict)

    @property
    def key(self) -> tuple:
        """What orders shots, so that a painting does not depend on the order that they came in."""
        seen = self.observation
        return seen.webcam, seen.time, seen.camera.world_from_camera.tobytes(), seen.camera.fx


@dataclass(frozen=True)
class PreparedInput:
    """A shot laid out for sampling.

    Parameters
    ----------
    item
        As it came.
    depth_m
        ``(H, W)`` float32 distance along the rays; infinite is sky.
    confidence
        ``(H, W)`` float32: mask × guard × exposure.
    levels
        Pictures of half the size each, ``(h, w, 5)`` float32: colour × usable, usable, trust.
    blocks
        From `atlas_tiles.seen_blocks`.
    sky_value, sky_radiance
        ``(3,)`` of the sky above the horizon: as the picture shows it, and by the sky model [cd/m²]; NaN where there is
        no sky to see, or where a colour is clipped.
    median_value
        ``(3,)`` median picture value of the land that can be trusted.
    probes
        Some thousand places that the camera sees, in a random order.
    probe_uv
        ``(N, 2)`` their texture coordinates.
    """

    item: PaintingInput
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
    item: PaintingInput,
    terrain: RayScene,
    cut: AtlasTiling,
    *,
    near_m: float = NEAR_M,
    reject: np.ndarray | None = None,
    guard: bool = True,
) -> PreparedInput:
    """Look at the land from a shot's camera and mark what of the picture can be trusted.

    Parameters
    ----------
    near_m
        Pixels that show terrain nearer than this are left out [m].
    reject
        ``(H, W)`` bool, pixels to leave out too (`foreground.foreground_mask`).
    guard
        Keep away from silhouettes.
    """
    seen = item.observation
    # The bare terrain serves as the scene of a G-buffer: that looks at geometry alone.
    gbuffer = trace_gbuffer(RenderScene(terrain.mi_scene, terrain.mi_terrain, None, 0.0), seen.camera)  # type: ignore[arg-type]
    depth = gbuffer.depth.astype(np.float32)
    usable = picture_mask(seen.image, seen.mask, depth, near_m=near_m)
    if reject is not None:
        usable &= ~reject
    image = np.where(usable[..., None], seen.image, 0.0).astype(np.float32)
    confidence = usable * exposure_confidence(image)
    if guard:
        confidence = confidence * silhouette_guard(depth, pose_sigma_px(seen.camera, item.pose_sigma, depth))
    pixel = np.flatnonzero(confidence > 0.5)
    pixel = np.random.default_rng(_PROBE_SEED).permutation(pixel)[:PROBES]
    side_m = _texel_side_m(cut)
    probes = TexelSurface(
        pixel,
        np.full(len(pixel), -1, np.int32),
        gbuffer.position.reshape(-1, 3)[pixel].astype(float),
        gbuffer.normal.reshape(-1, 3)[pixel].astype(np.float32),
        np.full(len(pixel), side_m, np.float32),
    )
    median = np.median(image.reshape(-1, 3)[pixel], axis=0) if len(pixel) else np.full(3, np.nan)
    return PreparedInput(
        item,
        depth,
        confidence.astype(np.float32),
        _levels(image, usable, confidence),
        seen_blocks(gbuffer.uv, cut),
        *_horizon_sky(item, depth),
        median,
        probes,
        gbuffer.uv.reshape(-1, 2)[pixel].astype(np.float32),
    )


def _texel_side_m(cut: AtlasTiling) -> float:
    """Side of a texel were the atlas used throughout [m]."""
    extent = np.ptp(cut.terrain.vertices[:, :2], axis=0).astype(float)
    return float(np.sqrt(extent[0] * extent[1] / (cut.width_px * cut.height_px)))


def _levels(image: np.ndarray, usable: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, ...]:
    levels = [np.dstack([image, usable.astype(np.float32), confidence.astype(np.float32)]).astype(np.float32)]
    while min(levels[-1].shape[:2]) >= 16 and len(levels) < 7:
        height, width = levels[-1].shape[:2]
        # Even sizes, so that a level is exactly twice as coarse as the one before.
        even = levels[-1][: height // 2 * 2, : width // 2 * 2]
        levels.append(even.reshape(height // 2, 2, width // 2, 2, 5).mean(axis=(1, 3)))
    return tuple(levels)


def _horizon_sky(item: PaintingInput, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median colour of the lowest sky in the picture that is not clipped, and by the shot's air."""
    seen, unknown = item.observation, np.full(3, np.nan)
    if item.air is None:
        return unknown, unknown
    direction = ray_directions(seen.camera)
    sky = ~np.isfinite(depth_m) & seen.mask & np.isfinite(seen.image).all(axis=2)
    # A step away from the skyline, whose pixels show both.
    sky = cv2.erode(sky.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    if np.count_nonzero(sky) < _FEWEST_SKY_PX:
        return unknown, unknown
    pixel = np.flatnonzero(sky)
    elevation_deg = np.degrees(np.arcsin(np.clip(direction[..., 2].ravel()[pixel], -1.0, 1.0)))
    found = seen.image.reshape(-1, 3)[pixel].astype(float)
    value, radiance = unknown.copy(), unknown.copy()
    # The lowest band that is not clipped, colour by colour (a blue sky's red lasts longest): what is left of a clipped
    # one would be the darkest part of it.
    for low in np.arange(elevation_deg.min(), elevation_deg.max(), 0.5 * _HORIZON_DEG):
        band = np.flatnonzero((elevation_deg >= low) & (elevation_deg < low + _HORIZON_DEG))
        if len(band) < _FEWEST_SKY_PX:
            continue
        band = band[:: max(1, len(band) // 2000)]
        fresh = np.isnan(value) & ((found[band] > BRIGHTEST).mean(axis=0) <= _MOST_CLIPPED)
        if fresh.any():
            expected = item.air(np.full(len(band), np.inf), direction.reshape(-1, 3)[pixel[band]])[1]
            value[fresh] = np.median(found[band], axis=0)[fresh]
            radiance[fresh] = np.maximum(np.median(expected, axis=0), 1e-9)[fresh]
    return value, radiance


def horizon_radiance(item: PaintingInput) -> float:
    """Mean radiance of the sky at the horizon by a shot's air [cd/m²], 0 without any."""
    if item.air is None:
        return 0.0
    azimuth = np.radians(np.arange(0.0, 360.0, 30.0))
    level = np.stack([np.sin(azimuth), np.cos(azimuth), np.full(azimuth.shape, np.sin(np.radians(2.0)))], axis=-1)
    return float(np.mean(item.air(np.full(len(level), np.inf), level)[1]))


def air_to(ready: PreparedInput, position_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance and airlight ``(N, 3)`` of the shot's air up to places ``(N, 3)`` ENU."""
    if ready.item.air is None:
        return np.ones(position_m.shape), np.zeros(position_m.shape)
    offset = position_m - ready.item.observation.camera.position_m
    distance = np.linalg.norm(offset, axis=1)
    return ready.item.air(distance, offset / np.maximum(distance, 1e-6)[:, None])


def texel_extent_px(camera: Camera, surface: TexelSurface, sight: ProjectedTexels) -> np.ndarray:
    """Pixels along the side ``(N,)`` of a square as large as each texel shows in the picture, foreshortened."""
    straight_on = camera.fx * surface.texel_m / np.maximum(sight.distance_m, 1e-3)
    return straight_on * np.sqrt(np.clip(sight.cosine, 0.0, 1.0))


def sample_input(ready: PreparedInput, pixel: np.ndarray, px_per_texel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Picture values ``(N, 3)`` and trust ``(N,)`` at pixels ``(N, 2)``; a texel larger than a pixel gets the mean under it.

    Trust is 0, and the value NaN, where less than three quarters of what lies under the texel is usable.
    """
    level = np.clip(np.log2(np.maximum(px_per_texel, 1.0)), 0.0, len(ready.levels) - 1.0)
    below = np.minimum(level.astype(int), len(ready.levels) - 1)
    mixed = np.zeros((len(pixel), 5), np.float32)
    for number in np.unique(below):
        index = np.flatnonzero(below == number)
        share = (level[index] - number).astype(np.float32)[:, None]
        value = _look_up(ready.levels[number], pixel[index], number)
        blur = np.flatnonzero(share[:, 0] > 0.0)
        if len(blur):
            coarse = _look_up(ready.levels[min(number + 1, len(ready.levels) - 1)], pixel[index[blur]], number + 1)
            value[blur] += share[blur] * (coarse - value[blur])
        mixed[index] = value
    cover = mixed[:, 3]
    sound = cover >= _LEAST_COVER
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.where(sound[:, None], mixed[:, :3] / cover[:, None], np.nan)
    return np.maximum(value, 0.0), np.where(sound, np.clip(mixed[:, 4], 0.0, 1.0), 0.0)


def _look_up(level: np.ndarray, pixel: np.ndarray, number: int) -> np.ndarray:
    """Bilinear values ``(N, 5)``. OpenCV's maps are pictures, so the list is folded into one."""
    count = len(pixel)
    rows = -(-count // _ROW)
    place = np.zeros((rows * _ROW, 2), np.float32)
    place[:count] = pixel / 2.0**number - 0.5
    place = place.reshape(rows, _ROW, 2)
    # A picture of five channels is one of four and one of one.
    parts = [
        cv2.remap(level[..., part], place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for part in (slice(0, 4), slice(4, 5))
    ]
    return np.concatenate([part.reshape(rows * _ROW, -1)[:count] for part in parts], axis=1)
