"""Light on the texels of a terrain's texture, in the parts that delighting needs.

Direct sunlight and its shadows are those of every texel. Skylight and interreflection vary as slowly as the heights do:
`coarse_irradiance` traces them for some texels and interpolates, the share of the open sky's light that arrives and not the
light itself, so that every texel keeps what its own slope receives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt, label
from scipy.special import ndtr

from seasonscapes.albedo.delighting import TexelIrradiance
from seasonscapes.albedo.forward_model import TexelTransport, ambient_on_texels, transport_of_points
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.irradiance import shadow_rays, surface_at
from seasonscapes.rendering.sun_visibility import SunRays, visible_cosine
from seasonscapes.sky.illumination import Illumination, global_horizontal_illuminance
from seasonscapes.terrain.surface import Terrain
from seasonscapes.terrain.texels import texel_positions

# Shadow rays per texel, to different points of the sun's disc.
_RAYS = 4
# From so many standard errors of the cosine of incidence up, ground surely faces the sun.
_SURELY_SUNLIT = 2.5
# Less than this share of a level surface's skylight reaches no slope of a terrain.
_LEAST_OPEN = 0.05


def texel_irradiance(
    transport: TexelTransport, light: Illumination, chart: np.ndarray | None = None, *, slope_error: float = 0.0
) -> TexelIrradiance:
    """Compute the light on the texels of a terrain's texture, split into its parts.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    light
        Sun and sky; the moon is left out.
    chart
        ``(R, S)`` integers of the texture's charts, −1 for none; by default each connected part of the texture is one.
    slope_error
        Standard error of the cosine of incidence, where heights are coarser than the image; see `_sunlight`.

    Returns
    -------
    TexelIrradiance
        Zero, and chart −1, for texels off the surface.
    """
    rows, columns = transport.shape
    on = _SunTexels(transport.device_points.rays, transport.normal, transport.texel, transport.shape)
    sun, visibility = _sunlight(on, light, slope_error)
    sky = ambient_on_texels(transport, light, None)

    def bounce(albedo: np.ndarray) -> np.ndarray:
        return np.maximum(ambient_on_texels(transport, light, albedo) - sky, 0.0).reshape(rows, columns, 3)

    level = np.asarray(global_horizontal_illuminance(light))
    charts = _charts(transport.texel, transport.shape, chart)
    return TexelIrradiance(sun, visibility, sky.reshape(rows, columns, 3), bounce, level, charts)


def coarse_irradiance(
    terrain: Terrain,
    shape: tuple[int, int],
    light: Illumination,
    *,
    every: int,
    sampling: SamplingOptions,
    slope_error: float = 0.0,
    progress: Callable[[float], None] | None = None,
) -> TexelIrradiance:
    """`texel_irradiance` of a texture whose neighbouring texels adjoin, with coarser skylight and interreflection.

    Parameters
    ----------
    terrain
        Mesh with texture coordinates.
    shape
        Rows and columns R, S of the texture.
    light
        Sun and sky; the moon is left out.
    every
        Trace skylight and interreflection for every so many-th row and column, an odd number.
    sampling
        Numbers of rays, light clusters and basis directions.
    slope_error
        See `texel_irradiance`.
    progress
        Called with the finished fraction.

    Returns
    -------
    TexelIrradiance
        Zero, and chart −1, for texels off the surface.

    Raises
    ------
    ValueError
        If ``every`` is even, or no texel lies on the terrain.
    """
    from seasonscapes.rendering.mitsuba_scene import mi_mesh

    if every % 2 == 0:
        raise ValueError(f"coarse_irradiance: every: got {every}, expected an odd number")
    surface = ray_scene(mi_mesh(terrain, np.full(3, 0.3, np.float32)))
    position, _ = texel_positions(terrain, shape[1], shape[0])
    points, texel = surface_at(surface, position.reshape(-1, 3))
    if len(texel) == 0:
        raise ValueError("coarse_irradiance: no texel lies on the terrain")
    row, column = np.divmod(texel, shape[1])
    # The middle texels of blocks of every × every.
    middle = (row % every == every // 2) & (column % every == every // 2)
    coarse_shape = (-(-shape[0] // every), -(-shape[1] // every))
    if not middle.any():
        middle, coarse_shape, every = np.ones(len(texel), bool), shape, 1
    coarse_texel = (row // every * coarse_shape[1] + column // every)[middle]
    chosen = points[np.flatnonzero(middle)]
    transport = transport_of_points(surface, coarse_shape, chosen, coarse_texel, sampling=sampling, progress=progress)
    on = _SunTexels(shadow_rays(surface, points, texel), points.normal, texel, shape)
    sun, visibility = _sunlight(on, light, slope_error)
    open_sky = _open_sky_illuminance(light)
    coarse_sky = ambient_on_texels(transport, light, None)
    share = np.zeros_like(coarse_sky)
    share[coarse_texel] = coarse_sky[coarse_texel] / open_sky(chosen.normal)
    sky = np.zeros((shape[0] * shape[1], 3), np.float32)
    sky[texel] = _finer(share, coarse_texel, coarse_shape, every, shape).reshape(-1, 3)[texel] * open_sky(points.normal)
    covered = np.zeros((*shape, 1), np.float32)
    covered.reshape(-1)[texel] = 1.0

    def bounce(albedo: np.ndarray) -> np.ndarray:
        reflected = np.maximum(ambient_on_texels(transport, light, albedo) - coarse_sky, 0.0)
        return _finer(reflected, coarse_texel, coarse_shape, every, shape) * covered

    level = np.asarray(global_horizontal_illuminance(light))
    return TexelIrradiance(sun, visibility, sky.reshape(*shape, 3), bounce, level, _charts(texel, shape, None))


@dataclass(frozen=True)
class _SunTexels:
    """N texels that the sun may light: shadow rays, normals ``(N, 3)``, flat index ``(N,)``, and shape of the texture."""

    rays: SunRays
    normal: np.ndarray
    texel: np.ndarray
    shape: tuple[int, int]


def _sunlight(on: _SunTexels, light: Illumination, slope_error: float) -> tuple[np.ndarray, np.ndarray]:
    """Illuminance by the sun without shadows ``(R, S, 3)``, and the visible share of its disc ``(R, S)``.

    With a standard error of the cosine of incidence, ground that turns away from the sun may yet face it: crowns of trees
    stand out of a steep slope, and heights smooth it. Where the cosine is small, the illuminance is that of the least
    cosine that is surely sunlit, and the visibility is such that their product has the mean over the error. It is a
    prediction that the image may overrule.
    """
    rows, columns = on.shape
    sun = np.zeros((rows * columns, 3), np.float32)
    visibility = np.zeros(rows * columns, np.float32)
    if light.sun is not None:
        signed = on.normal @ np.asarray(light.sun.direction, np.float32)
        cosine = np.maximum(signed, 0.0)
        seen = visible_cosine(on.rays, light.sun, rays_per_sample=_RAYS)[:, 0]
        share = np.clip(seen / np.maximum(cosine, 1e-6), 0.0, 1.0)
        if slope_error > 0.0:
            ratio = signed / slope_error
            density = np.exp(-0.5 * ratio**2) / np.sqrt(2.0 * np.pi)
            mean = signed * ndtr(ratio) + slope_error * density
            cosine = np.maximum(signed, _SURELY_SUNLIT * slope_error)
            # No shadow ray leaves ground that turns away: what hides the sun from it is not known.
            hidden = np.where(signed > 0.2 * slope_error, share, 1.0)
            share = np.clip(hidden * mean / cosine, 0.0, 1.0)
        sun[on.texel] = cosine[:, None] * np.asarray(light.sun.normal_illuminance_lx, np.float32)
        visibility[on.texel] = share
    return sun.reshape(rows, columns, 3), visibility.reshape(rows, columns)


def _charts(texel: np.ndarray, shape: tuple[int, int], chart: np.ndarray | None) -> np.ndarray:
    """Chart ``(R, S)`` int32 of each texel on the surface: the given one, or its connected part; −1 elsewhere."""
    if chart is None:
        covered = np.zeros(shape[0] * shape[1], bool)
        covered[texel] = True
        numbered, _ = cast(tuple[np.ndarray, int], label(covered.reshape(shape)))
        chart = numbered.astype(np.int32) - 1
    surface = np.full(shape[0] * shape[1], -1, np.int32)
    surface[texel] = chart.ravel()[texel]
    return surface.reshape(shape)


def _open_sky_illuminance(light: Illumination) -> Callable[[np.ndarray], np.ndarray]:
    """Illuminance ``(N, 3)`` [lx] of unobstructed surfaces by the sky, as a function of their normals ``(N, 3)``.

    A polynomial of the second degree, which leaves out 1 % of what any distant light sends to a Lambertian surface
    (Ramamoorthi & Hanrahan 2001, doi:10.1145/383259.383317).
    """
    map_ = np.asarray(light.sky_radiance, np.float32)[: light.sky_radiance.shape[0] // 2]
    height, width = min(32, map_.shape[0]), min(128, map_.shape[1])
    radiance = cv2.resize(map_, (width, height), interpolation=cv2.INTER_AREA).reshape(-1, 3)
    zenith = (np.arange(height) + 0.5) / height * (np.pi / 2.0)
    azimuth = (np.arange(width) + 0.5) / width * (2.0 * np.pi)
    z, a = (values.ravel() for values in np.meshgrid(zenith, azimuth, indexing="ij"))
    direction = np.stack([np.sin(z) * np.sin(a), np.sin(z) * np.cos(a), np.cos(z)], axis=1)
    solid_angle = np.sin(z) * (np.pi / 2.0 / height) * (2.0 * np.pi / width)
    # Normals of terrain: the upper hemisphere's directions themselves, evenly thinned.
    normal = direction[:: max(1, len(direction) // 1024)]
    illuminance = np.maximum(normal @ direction.T, 0.0) @ (radiance * solid_angle[:, None])
    coefficients = np.linalg.lstsq(_second_degree(normal), illuminance, rcond=None)[0]
    least = _LEAST_OPEN * _second_degree(np.array([[0.0, 0.0, 1.0]])) @ coefficients
    return lambda normals: np.maximum(_second_degree(normals) @ coefficients, least).astype(np.float32)


def _second_degree(normal: np.ndarray) -> np.ndarray:
    x, y, z = np.asarray(normal, np.float32).T
    return np.stack([np.ones_like(x), x, y, z, x * y, y * z, z * x, z * z, x * x - y * y], axis=1)


def _finer(
    values: np.ndarray, texel: np.ndarray, coarse: tuple[int, int], every: int, shape: tuple[int, int]
) -> np.ndarray:
    """Values ``(r·s, 3)`` of the middles of blocks interpolated to all texels ``(R, S, 3)``; off the surface, the nearest."""
    known = np.zeros(coarse[0] * coarse[1], bool)
    known[texel] = True
    grid = values.reshape(*coarse, 3).astype(np.float32)
    if not known.all():
        row, column = distance_transform_edt(~known.reshape(coarse), return_distances=False, return_indices=True)  # pyright: ignore[reportGeneralTypeIssues]
        grid = grid[row, column]
    size = (coarse[1] * every, coarse[0] * every)
    return cv2.resize(grid, size, interpolation=cv2.INTER_LINEAR)[: shape[0], : shape[1]]
