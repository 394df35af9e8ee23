"""Data types of daylight coefficients: of views and of surface points, with the sampling that they were traced with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.hemisphere_rays import SurfacePoints
from seasonscapes.rendering.light_clusters import LightClusters, ReceiverCoefficients


@dataclass(frozen=True)
class SamplingOptions:
    """Sampling options of daylight coefficients.

    Parameters
    ----------
    shadow_samples
        Number S of samples per pixel from which shadow rays start, a square.
    albedo_samples
        Samples per pixel for its mean albedo and normal, a square.
    rays
        Hemisphere rays per receiver, a power of two. On height fields horizons and rays below them replace these, with as
        little noise; see `horizon_azimuths`.
    bounces
        Number of surfaces between light and receiver; 4 equals ``max_depth=6`` of the path tracer.
    clusters
        Number M of clusters of faces, a power of two up to 65,536.
    clusters_per_receiver
        Number K of clusters stored per receiver, even; on height fields at most as many as azimuths.
    rank
        Number r of daylight coefficients stored per receiver.
    patches
        Subdivision of the sky, a name in `sky_patches.SUBDIVISIONS`.

    Raises
    ------
    ValueError
        If a number violates these conditions.
    """

    shadow_samples: int = 16
    albedo_samples: int = 64
    rays: int = 512
    bounces: int = 4
    clusters: int = 16384
    clusters_per_receiver: int = 64
    rank: int = 32
    patches: str = "reinhart"

    @property
    def horizon_azimuths(self) -> int:
        """Azimuths at which the horizon of a receiver on a height field is searched, a power of two."""
        return max(self.rays // 16, 8)

    def __post_init__(self):
        if (
            round(self.shadow_samples**0.5) ** 2 != self.shadow_samples
            or self.rays & (self.rays - 1)
            or self.bounces < 0
        ):
            raise ValueError(
                "SamplingOptions: shadow_samples must be a square, rays a power of two, bounces not negative"
            )
        if self.rays % self.shadow_samples:
            raise ValueError(
                f"SamplingOptions: got {self.rays} rays, expected a multiple of the {self.shadow_samples} shadow_samples"
            )
        if self.clusters_per_receiver % 2 or not 0 < self.clusters <= 65536:
            raise ValueError("SamplingOptions: clusters_per_receiver must be even and clusters at most 65536")


@dataclass(frozen=True)
class MirrorCoefficients:
    """What water mirrors in a view: m of its n terrain pixels show water, with S samples each.

    Parameters
    ----------
    pixel
        ``(m,)`` int32 numbers of these pixels among the n.
    albedo
        ``(m, 3)`` float32 mean over the pixel's samples of reflectance of the water × albedo of the mirrored ground; samples
        of the sky and of other ground count as black.
    sample_uv
        ``(m, S, 2)`` float32 texture coordinates of the mirrored ground, v upwards.
    sample_share
        ``(m, S)`` float16 reflectance of the water divided by S; 0 for samples that mirror no ground.
    sample_origin, sample_normal, sample_outward, sample_weight
        Of the mirrored ground, as in `ViewCoefficients`.
    receivers
        Coefficients of the mirrored ground.
    sky_direction
        ``(m, S, 3)`` float32 unit directions in which the samples mirror the sky, ENU.
    sky_share
        ``(m, S)`` float16 reflectance of the water divided by S; 0 for samples that mirror no sky.
    water_weight
        ``(m, S)`` float16: 1 / S for the pixel's samples on water, 0 for others.
    """

    pixel: np.ndarray
    albedo: np.ndarray
    sample_uv: np.ndarray
    sample_share: np.ndarray
    sample_origin: np.ndarray
    sample_normal: np.ndarray
    sample_outward: np.ndarray
    sample_weight: np.ndarray
    receivers: ReceiverCoefficients
    sky_direction: np.ndarray
    sky_share: np.ndarray
    water_weight: np.ndarray


@dataclass(frozen=True)
class ViewCoefficients:
    """Daylight coefficients of a view, for relighting it. n of its pixels show terrain, with S samples each.

    Parameters
    ----------
    camera
        The view.
    pixel
        ``(n,)`` int32 flat indices of the pixels that show terrain.
    coverage
        ``(n,)`` float32 fraction of the pixel that terrain covers.
    albedo
        ``(n, 3)`` float32 mean albedo over the pixel; the sky counts as black.
    normal
        ``(n, 3)`` float32 mean shading normal, weighted by luminous albedo.
    sample_origin
        ``(n, S, 3)`` float32 origins of shadow rays, ENU [m]; samples on terrain come first.
    sample_normal, sample_outward
        ``(n, S, 3)`` float16 shading and geometric normals.
    sample_weight
        ``(n, S)`` float16 weight of each sample in the pixel's reflected light, sum 1; 0 in the sky.
    receivers
        Coefficients of the pixels.
    clusters
        Clusters of faces that reflect light to the pixels.
    seed, sampling
        Seed and options they were computed with.
    mirror
        What the water in the view mirrors; ``None`` for views without water.
    """

    camera: Camera | Panorama
    pixel: np.ndarray
    coverage: np.ndarray
    albedo: np.ndarray
    normal: np.ndarray
    sample_origin: np.ndarray
    sample_normal: np.ndarray
    sample_outward: np.ndarray
    sample_weight: np.ndarray
    receivers: ReceiverCoefficients
    clusters: LightClusters
    seed: int
    sampling: SamplingOptions
    mirror: MirrorCoefficients | None = None


@dataclass(frozen=True)
class PointCoefficients:
    """Daylight coefficients of surface points (such as texels), for computing their irradiance.

    Parameters
    ----------
    points
        N surface points.
    receivers
        Coefficients of the points.
    clusters
        Clusters of faces that reflect light to the points.
    """

    points: SurfacePoints
    receivers: ReceiverCoefficients
    clusters: LightClusters
