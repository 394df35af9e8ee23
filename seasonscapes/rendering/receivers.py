"""Irradiance of receivers under a given illumination, from their daylight coefficients and the radiance of clusters.

The sky contributes the product of daylight coefficients and sky radiance; interreflection is the mean radiance of the
clusters that the receiver's rays hit. Computed on the Dr.Jit device.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.rendering.backend import aligned, to_numpy
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.rendering.light_clusters import LightClusters, ReceiverCoefficients
from seasonscapes.rendering.sky_patches import patch_radiance, sky_patches
from seasonscapes.rendering.smoothing import DeviceNeighbours, Neighbours, mi_smoothed, upload_neighbours
from seasonscapes.rendering.sun_visibility import SunRays, hashed_disc_offset, start_visible_cosine, sun_rays
from seasonscapes.sky.illumination import Illumination, Luminary, luminance

# A moon (or setting sun) whose illuminance is less than this fraction of the sky's casts no visible shadow.
NEGLIGIBLE_FRACTION = 1e-4


@dataclass(frozen=True)
class DeviceReceivers:
    """`ReceiverCoefficients` of N receivers on the Dr.Jit device, one array per column for coalesced reads.

    Parameters
    ----------
    mi_direct
        r ``mi.Float16`` arrays of N daylight coefficients.
    mi_cluster_pairs
        K / 2 ``mi.UInt32`` arrays, each with two 16-bit cluster indices per receiver.
    mi_share
        ``mi.Float`` weight of each listed cluster.
    smoothing
        Passes of edge-aware smoothing for interreflected light; empty for points that are no pixels.
    """

    mi_direct: list[Any]
    mi_cluster_pairs: list[Any]
    mi_share: Any
    smoothing: list[DeviceNeighbours]


@dataclass(frozen=True)
class DeviceClusters:
    """`LightClusters` on the Dr.Jit device.

    Parameters
    ----------
    clusters
        The clusters, in host memory.
    receivers
        Their coefficients on the device.
    rays
        Shadow rays from their surface points.
    """

    clusters: LightClusters
    receivers: DeviceReceivers
    rays: SunRays


@dataclass(frozen=True)
class ClusterLight:
    """One illumination in the form that receivers use.

    Parameters
    ----------
    mi_sky
        ``mi.Float``: ``from_sky.T @ patch radiances``, r rows of three channels.
    mi_cluster_radiance
        ``mi.Float``: reflected radiance of the M clusters, rows of four channels of which the last is padding.
    """

    mi_sky: Any
    mi_cluster_radiance: Any


def upload_receivers(receivers: ReceiverCoefficients, smoothing: list[Neighbours] | None = None) -> DeviceReceivers:
    """Copy receiver coefficients to the device, keeping half precision.

    Parameters
    ----------
    receivers
        Coefficients, possibly memory-mapped.
    smoothing
        Passes of edge-aware smoothing for interreflected light.

    Returns
    -------
    DeviceReceivers
        The device copy.
    """
    import drjit as dr
    import mitsuba as mi

    cluster = np.asarray(receivers.cluster).astype(np.uint32)
    direct = [mi.Float16(aligned(column, np.float16)) for column in np.asarray(receivers.direct).T]
    pairs = [
        mi.UInt32(aligned(cluster[:, k] | (cluster[:, k + 1] << np.uint32(16)), np.uint32))
        for k in range(0, cluster.shape[1], 2)
    ]
    share = mi.Float(aligned(np.asarray(receivers.share, np.float32) / cluster.shape[1]))
    dr.eval(direct, pairs, share)
    return DeviceReceivers(direct, pairs, share, [upload_neighbours(neighbours) for neighbours in smoothing or []])


def upload_clusters(terrain: RayScene, clusters: LightClusters) -> DeviceClusters:
    """Copy clusters to the device.

    Parameters
    ----------
    terrain
        The terrain that occludes their shadow rays.
    clusters
        The clusters, possibly memory-mapped.

    Returns
    -------
    DeviceClusters
        The device copy, with shadow rays from the points of the clusters.
    """
    points = clusters.points
    shape = points.origin.shape[:2]
    rays = sun_rays(
        terrain,
        points.origin,
        points.normal,
        points.geometric_normal,
        np.ones(shape),
        hashed_disc_offset(np.arange(shape[0])),
    )
    return DeviceClusters(clusters, upload_receivers(clusters.receivers), rays)


def incident_light(device: DeviceReceivers, light: ClusterLight) -> tuple[np.ndarray, np.ndarray]:
    """Compute the irradiance of receivers from the sky and from clusters.

    Parameters
    ----------
    device
        N receivers.
    light
        From `light_clusters`.

    Returns
    -------
    sky, reflected
        ``(N, 3)`` float32 each, irradiance / π [cd/m²].
    """
    import drjit as dr

    direct, reflected = _sky_irradiance(device, light.mi_sky), _reflected_irradiance(device, light.mi_cluster_radiance)
    dr.eval(direct, reflected)
    first, second = (np.stack([np.array(channel) for channel in part], axis=-1) for part in (direct, reflected))
    return first, second


def total_incident_light(device: DeviceReceivers, light: ClusterLight) -> np.ndarray:
    """Both parts of `incident_light` together, ``(N, 3)`` float32: they are added before they leave the device."""
    return start_incident_light(device, light)()


def start_incident_light(device: DeviceReceivers, light: ClusterLight) -> Callable[[], np.ndarray]:
    """Start `total_incident_light`, and return the function that gives its result: other threads compute it meanwhile."""
    import drjit as dr
    import mitsuba as mi

    sky, reflected = _sky_irradiance(device, light.mi_sky), _reflected_irradiance(device, light.mi_cluster_radiance)
    total = mi.Vector3f(*(first + second for first, second in zip(sky, reflected, strict=True)))
    dr.eval(total)
    return lambda: to_numpy(total)


def _sky_irradiance(device: DeviceReceivers, mi_sky: Any) -> list[Any]:
    """Irradiance / π from the sky: three ``mi.Float`` of N lanes; ``mi_sky`` as in `ClusterLight`."""
    import drjit as dr
    import mitsuba as mi

    total = [mi.Float(0.0)] * 3
    for k, column in enumerate(device.mi_direct):
        coefficient = mi.Float(column)
        total = [dr.fma(coefficient, dr.gather(mi.Float, mi_sky, 3 * k + c), total[c]) for c in range(3)]
    # The truncated basis may give slightly negative values where the irradiance is close to zero.
    return [dr.fmax(channel, 0.0) for channel in total]


def _reflected_irradiance(device: DeviceReceivers, mi_cluster_radiance: Any) -> list[Any]:
    """Irradiance / π from clusters: three ``mi.Float`` of N lanes; ``mi_cluster_radiance`` as in `ClusterLight`."""
    import drjit as dr
    import mitsuba as mi

    total = mi.Vector4f(0.0)
    for pair in device.mi_cluster_pairs:
        total += dr.gather(mi.Vector4f, mi_cluster_radiance, pair & 0xFFFF) + dr.gather(
            mi.Vector4f, mi_cluster_radiance, pair >> 16
        )
    reflected = [total[c] * device.mi_share for c in range(3)]
    for neighbours in device.smoothing:
        reflected = mi_smoothed(reflected, neighbours)
    return reflected


def luminaries(illumination: Illumination) -> list[Luminary]:
    """Return sun and moon of an illumination, without those that are negligible compared to the sky.

    Parameters
    ----------
    illumination
        Sky, sun and moon.

    Returns
    -------
    list of Luminary
        The bodies brighter than `NEGLIGIBLE_FRACTION` of the sky.
    """
    patches = sky_patches("tregenza")
    sky = patch_radiance(patches, illumination.sky_radiance)
    threshold_lx = NEGLIGIBLE_FRACTION * float(luminance((sky * patches.solid_angle_sr[:, None]).sum(axis=0)))
    bodies = (illumination.sun, illumination.moon)
    return [body for body in bodies if body is not None and luminance(body.normal_illuminance_lx) > threshold_lx]


def light_clusters(device: DeviceClusters, illumination: Illumination) -> ClusterLight:
    """Compute the reflected radiance of all clusters under an illumination.

    Direct light from the sky, sun and moon is reflected first; further bounces are exchanged between the clusters.

    Parameters
    ----------
    device
        The clusters.
    illumination
        Sky, sun and moon.

    Returns
    -------
    ClusterLight
        Sky in the directional basis and radiance of the clusters, for `incident_light`.
    """
    return start_clusters(device, illumination, luminaries(illumination))()


def start_clusters(
    device: DeviceClusters, illumination: Illumination, bodies: Sequence[Luminary]
) -> Callable[[], ClusterLight]:
    """Start the shadow rays of `light_clusters` to its `luminaries`, and return the function that gives its result.

    Other threads trace while the caller computes something else.
    """
    # The points of a cluster lie on faces here and there.
    begun = [
        (body, start_visible_cosine(device.rays, body, coherent=False)) for body in bodies if device.clusters.bounces
    ]

    def sunlit() -> np.ndarray:
        albedo = device.clusters.points.albedo
        total = np.zeros((len(albedo), 3), np.float32)
        for body, cosine in begun:
            mean = (cosine()[..., None] * albedo).mean(axis=1)
            total += mean * (np.asarray(body.normal_illuminance_lx, np.float32) / np.pi)
        return total

    return lambda: _exchanged(device, illumination, sunlit)


def _exchanged(device: DeviceClusters, illumination: Illumination, sunlit: Callable[[], np.ndarray]) -> ClusterLight:
    """`light_clusters` by what the clusters reflect of sun and moon, ``(M, 3)``."""
    import drjit as dr
    import mitsuba as mi

    clusters = device.clusters
    sky = patch_radiance(sky_patches(clusters.patches), illumination.sky_radiance)
    mi_sky = mi.Float(aligned((clusters.from_sky.T @ sky).ravel()))
    if clusters.bounces == 0:
        return ClusterLight(mi_sky, mi.Float(aligned(np.zeros(4))))
    albedo = clusters.points.albedo
    mean_albedo = [mi.Float(aligned(column)) for column in albedo.mean(axis=1).T]
    from_sun = [mi.Float(aligned(column)) for column in sunlit().T]
    first_bounce = [
        sun + reflectance * incident
        for sun, reflectance, incident in zip(
            from_sun, mean_albedo, _sky_irradiance(device.receivers, mi_sky), strict=True
        )
    ]
    mi_radiance = _mi_rows(first_bounce)
    for _ in range(clusters.bounces - 1):
        reflected = _reflected_irradiance(device.receivers, mi_radiance)
        mi_radiance = _mi_rows(
            [
                first + reflectance * incident
                for first, reflectance, incident in zip(first_bounce, mean_albedo, reflected, strict=True)
            ]
        )
    dr.eval(mi_radiance)
    return ClusterLight(mi_sky, mi_radiance)


def _mi_rows(channels: list[Any]) -> Any:
    """Interleave three channels to rows of four floats, which a single aligned load reads."""
    import drjit as dr
    import mitsuba as mi

    rows = dr.ravel(mi.Vector4f(*channels, 0.0))
    dr.eval(rows)
    return rows
