"""Irradiance of places on the terrain under any light: what texels of an atlas receive, sun, sky and bounce apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from seasonscapes.rendering.backend import point3
from seasonscapes.rendering.hemisphere_rays import RayScene, SurfacePoints, surface_points
from seasonscapes.rendering.receivers import (
    ClusterLight,
    DeviceClusters,
    DeviceReceivers,
    arriving,
    light_clusters,
    luminaries,
    upload_clusters,
    upload_receivers,
)
from seasonscapes.rendering.sun_visibility import SunRays, cosine_seen, numbered_turn, sun_rays
from seasonscapes.rendering.transport import PointCoefficients, SamplingOptions, prepare_transport, trace_points
from seasonscapes.sky.illumination import Illumination

# Texels in work at a time: their coefficients take about 300 bytes each.
BLOCK = 1 << 19
_ASIDE_M = np.array([0.05, 0.03, 0.0])
Progress = Callable[[float], None]


@dataclass(frozen=True)
class Irradiance:
    """Illuminance on N places [lx], photometric linear Rec.709, ``(N, 3)`` float32 each.

    Parameters
    ----------
    sun
        Directly from sun and moon.
    sky
        Directly from the sky.
    bounce
        By way of other terrain.
    """

    sun: np.ndarray
    sky: np.ndarray
    bounce: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """All of it ``(N, 3)``."""
        return self.sun + self.sky + self.bounce


@dataclass(frozen=True)
class DevicePoints:
    """Coefficients of places laid out for speed, for any number of lights."""

    rays: SunRays
    receivers: DeviceReceivers
    clusters: DeviceClusters


def surface_at(terrain: RayScene, position_m: np.ndarray, *, search_m: float = 2.0) -> tuple[SurfacePoints, np.ndarray]:
    """The surface at places ``(N, 3)`` ENU on it [m], such as `terrain.texels.texel_positions` gives.

    A vertical ray from ``search_m`` above finds the face within as much below, so that normals and albedo are the
    renderer's own.

    Returns
    -------
    points
        K of them, where a surface was found.
    index
        ``(K,)`` their numbers among the N. NaN places, and walls of overhangs, have none.
    """
    sound = np.isfinite(position_m).all(axis=1)
    start = np.where(sound[:, None], position_m, 0.0) + np.array([0.0, 0.0, search_m])
    points, found = _below(terrain, start, search_m)
    found &= sound
    # A ray through a vertex of the mesh may slip between its faces: those look again a hand's breadth beside it.
    missed = np.flatnonzero(sound & ~found)
    if len(missed):
        again, hit = _below(terrain, start[missed] + _ASIDE_M, search_m)
        for name in SurfacePoints.__dataclass_fields__:
            getattr(points, name)[missed[hit]] = getattr(again, name)[hit]
        found[missed[hit]] = True
    index = np.flatnonzero(found)
    return points[index], index


def _below(terrain: RayScene, start_m: np.ndarray, search_m: float) -> tuple[SurfacePoints, np.ndarray]:
    import mitsuba as mi

    ray = mi.Ray3f(point3(start_m.astype(np.float32)), mi.Vector3f(0.0, 0.0, -1.0))
    interaction = terrain.mi_scene.ray_intersect(ray)
    found = interaction.is_valid() & (interaction.t < 2.0 * search_m)
    return surface_points(interaction, found), np.array(found)


def upload_points(terrain: RayScene, coefficients: PointCoefficients) -> DevicePoints:
    """Load coefficients (perhaps memory-mapped) into the form that `irradiance` uses."""
    clusters = upload_clusters(terrain, coefficients.clusters)
    return DevicePoints(
        _rays(terrain, coefficients.points, np.arange(len(coefficients.points.origin))),
        upload_receivers(coefficients.receivers),
        clusters,
    )


def _rays(terrain: RayScene, points: SurfacePoints, number: np.ndarray) -> SunRays:
    each = points.reshape(-1, 1)
    weight = np.ones(each.origin.shape[:2], np.float32)
    return sun_rays(terrain, (each.origin, each.normal, each.outward), weight, numbered_turn(number))


def irradiance(
    ready: DevicePoints, illumination: Illumination, light: ClusterLight | None = None, *, sun_rays_each: int = 4
) -> Irradiance:
    """Illuminance on the places under a light.

    Parameters
    ----------
    light
        From `receivers.light_clusters`, where one light serves many blocks of places of one terrain.
    sun_rays_each
        Shadow rays from each place to different points of the disc.
    """
    sky, bounce = arriving(ready.receivers, light or light_clusters(ready.clusters, illumination))
    sun = np.zeros_like(sky)
    for body in luminaries(illumination):
        sun += cosine_seen(ready.rays, body, each=sun_rays_each) * np.asarray(body.normal_illuminance_lx, np.float32)
    return Irradiance(sun, np.float32(np.pi) * sky, np.float32(np.pi) * bounce)


def irradiance_blocks(
    terrain: RayScene,
    position_m: np.ndarray,
    lights: Sequence[Illumination],
    sampling: SamplingOptions | None = None,
    *,
    seed: int = 0,
    search_m: float = 2.0,
    progress: Progress | None = None,
) -> Iterator[tuple[np.ndarray, SurfacePoints, Iterator[Irradiance]]]:
    """Irradiance of many places under many lights, block by block: nothing is kept, so memory stays bounded.

    Parameters
    ----------
    position_m
        ``(N, 3)`` ENU; NaN where there is no surface.
    lights
        Held at once, without their air if there are many.
    search_m
        See `surface_at`.

    Yields
    ------
    index, points, irradiances
        Which of the N ``(K,)``, their surfaces, and one `Irradiance` for each light, worked out as they are asked for.
        Places without a surface never come.

    Raises
    ------
    ValueError
        Where no place at all lies on the terrain.
    """
    sampling = sampling or SamplingOptions()
    tell = progress or (lambda share: None)
    sound = np.flatnonzero(np.isfinite(position_m).all(axis=1))
    some = np.random.default_rng(seed).permutation(sound)[: 1 << 18]
    pilot, found = surface_at(terrain, position_m[some], search_m=search_m)
    if len(found) == 0:
        raise ValueError("irradiance: no place lies on the terrain")
    prepared = prepare_transport(terrain, pilot, sampling, seed=seed)
    clusters = upload_clusters(terrain, prepared.clusters)
    sent = [light_clusters(clusters, light) for light in lights]
    for start in range(0, len(sound), BLOCK):
        part = sound[start : start + BLOCK]
        points, found = surface_at(terrain, position_m[part], search_m=search_m)
        if len(found):
            traced = trace_points(terrain, points, sampling, prepared=prepared, seed=seed, number=part[found])
            ready = DevicePoints(_rays(terrain, points, part[found]), upload_receivers(traced.receivers), clusters)
            yield part[found], points, map(partial(irradiance, ready), lights, sent)
        tell(min(1.0, (start + BLOCK) / len(sound)))
