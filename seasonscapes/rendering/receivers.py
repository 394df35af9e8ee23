"""What arrives at receivers under a given light: coefficients times sky, and the senders' radiance looked up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.rendering.light_clusters import LightClusters, ReceiverCoefficients
from seasonscapes.rendering.sky_patches import patch_radiance, sky_patches
from seasonscapes.rendering.smoothing import Neighbours, mi_neighbours, mi_smoothed
from seasonscapes.rendering.sun_visibility import SunRays, cosine_seen, numbered_turn, sun_rays
from seasonscapes.sky.illumination import Illumination, Luminary, luminance

# A moon (or a setting sun) that is this much fainter than the rest of the light casts no shadow that could be seen.
FAINT = 1e-4


@dataclass(frozen=True)
class DeviceReceivers:
    """A `ReceiverCoefficients` on the device, column by column: every lane reads its own receiver in one sweep.

    ``mi_smoothing`` are passes over neighbours for what senders send, see `smoothing`; none for loose points.
    """

    mi_direct: list[Any]
    mi_cluster_pairs: list[Any]
    mi_share: Any
    mi_smoothing: list[tuple[list[Any], list[Any]]]


@dataclass(frozen=True)
class DeviceClusters:
    """`LightClusters` on the device, and shadow rays from their places."""

    clusters: LightClusters
    receivers: DeviceReceivers
    rays: SunRays


@dataclass(frozen=True)
class ClusterLight:
    """One light, as receivers meet it.

    ``mi_sky`` is ``from_sky.T @ patch radiances``, r rows of three; ``mi_sent`` the radiance of M senders, rows of four.
    """

    mi_sky: Any
    mi_sent: Any


def upload_receivers(receivers: ReceiverCoefficients, smoothing: list[Neighbours] | None = None) -> DeviceReceivers:
    """Copy to the device; half precision stays half."""
    import drjit as dr
    import mitsuba as mi

    listed = np.asarray(receivers.cluster).astype(np.uint32)
    direct = [mi.Float16(np.ascontiguousarray(column)) for column in np.asarray(receivers.direct).T]
    pairs = [mi.UInt32(listed[:, k] | (listed[:, k + 1] << np.uint32(16))) for k in range(0, listed.shape[1], 2)]
    share = mi.Float(np.asarray(receivers.share, np.float32) / listed.shape[1])
    dr.eval(direct, pairs, share)
    return DeviceReceivers(direct, pairs, share, [mi_neighbours(around) for around in smoothing or []])


def upload_clusters(terrain: RayScene, clusters: LightClusters) -> DeviceClusters:
    """Senders ready for any light."""
    points = clusters.points
    shape = points.origin.shape[:2]
    rays = sun_rays(
        terrain, (points.origin, points.normal, points.outward), np.ones(shape), numbered_turn(np.arange(shape[0]))
    )
    return DeviceClusters(clusters, upload_receivers(clusters.receivers), rays)


def arriving(ready: DeviceReceivers, light: ClusterLight) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance / π from the sky and from senders, ``(N, 3)`` float32 each."""
    import drjit as dr

    direct, bounced = mi_direct(ready, light.mi_sky), mi_bounced(ready, light.mi_sent)
    dr.eval(direct, bounced)
    first, second = (np.stack([np.array(channel) for channel in part], axis=-1) for part in (direct, bounced))
    return first, second


def mi_direct(ready: DeviceReceivers, mi_sky: Any) -> list[Any]:
    """Irradiance / π from the sky: three lanes of N."""
    import drjit as dr
    import mitsuba as mi

    total = [mi.Float(0.0)] * 3
    for k, column in enumerate(ready.mi_direct):
        wide = mi.Float(column)
        total = [dr.fma(wide, dr.gather(mi.Float, mi_sky, 3 * k + c), total[c]) for c in range(3)]
    # A basis of few directions may dip below zero where almost nothing arrives.
    return [dr.fmax(channel, 0.0) for channel in total]


def mi_bounced(ready: DeviceReceivers, mi_sent: Any) -> list[Any]:
    """Irradiance / π from senders: three lanes of N."""
    import drjit as dr
    import mitsuba as mi

    total = mi.Vector4f(0.0)
    for pair in ready.mi_cluster_pairs:
        total += dr.gather(mi.Vector4f, mi_sent, pair & 0xFFFF) + dr.gather(mi.Vector4f, mi_sent, pair >> 16)
    bounced = [total[c] * ready.mi_share for c in range(3)]
    for around in ready.mi_smoothing:
        bounced = mi_smoothed(bounced, around)
    return bounced


def luminaries(illumination: Illumination) -> list[Luminary]:
    """Sun and moon where they are bright enough to matter beside the sky."""
    patches = sky_patches("tregenza")
    sky = patch_radiance(patches, illumination.sky_radiance)
    faint = FAINT * float(luminance((sky * patches.solid_angle_sr[:, None]).sum(axis=0)))
    both = (illumination.sun, illumination.moon)
    return [body for body in both if body is not None and luminance(body.normal_illuminance_lx) > faint]


def light_clusters(ready: DeviceClusters, illumination: Illumination) -> ClusterLight:
    """What sky and senders send under a light; further bounces by letting senders look at each other."""
    import drjit as dr
    import mitsuba as mi

    clusters = ready.clusters
    sky = patch_radiance(sky_patches(clusters.patches), illumination.sky_radiance)
    mi_sky = mi.Float((clusters.from_sky.T @ sky).astype(np.float32).ravel())
    if clusters.bounces == 0:
        return ClusterLight(mi_sky, mi.Float(np.zeros(4, np.float32)))
    albedo = clusters.points.albedo
    sunlit = np.zeros((len(albedo), 3), np.float32)
    for body in luminaries(illumination):
        cosine = cosine_seen(ready.rays, body)[..., None]
        sunlit += (cosine * albedo).mean(axis=1) * (np.asarray(body.normal_illuminance_lx, np.float32) / np.pi)
    mean_albedo = [mi.Float(np.ascontiguousarray(column)) for column in albedo.mean(axis=1).T]
    first = [mi.Float(np.ascontiguousarray(column)) for column in sunlit.T]
    first = [
        sun + shade * sky_
        for sun, shade, sky_ in zip(first, mean_albedo, mi_direct(ready.receivers, mi_sky), strict=True)
    ]
    mi_sent = _mi_rows(first)
    for _ in range(clusters.bounces - 1):
        again = mi_bounced(ready.receivers, mi_sent)
        mi_sent = _mi_rows([sent + a * b for sent, a, b in zip(first, mean_albedo, again, strict=True)])
    dr.eval(mi_sent)
    return ClusterLight(mi_sky, mi_sent)


def _mi_rows(channels: list[Any]) -> Any:
    """Four floats a row, which one aligned load fetches."""
    import drjit as dr
    import mitsuba as mi

    rows = dr.ravel(mi.Vector4f(*channels, 0.0))
    dr.eval(rows)
    return rows
