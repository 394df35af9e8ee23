"""Cast shadows of sun and moon at discs, traced on the land's mesh.

The horizon that a disc stores has 128 azimuths, which suits a browser; between them the edges of cast shadows are lost. Where the
land is at hand, its shadows are traced instead, over the whole cell of each disc and the whole disc of the sun.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.gaussians.disc_cells import cell_centres_m
from seasonscapes.gaussians.disc_transport import BODIES, LightState
from seasonscapes.gaussians.model import GaussianModel
from seasonscapes.gaussians.surfels import SUBCELLS, SurfelGrid, Surfels
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.rendering.irradiance import surface_at
from seasonscapes.rendering.sun_visibility import SunRays, hashed_disc_offset, sum_incidence, sun_rays
from seasonscapes.sky.illumination import Luminary

# Mean angular radius of the sun; that of the moon, 0.259°, blurs shadows as much.
_RADIUS_DEG = 0.2666
# Cells of one search for points on the mesh; bounds its memory.
_CELLS = 1 << 17
_MARGIN_M = 10.0


@dataclass(frozen=True)
class DiscShadows:
    """Shadow rays of N discs, for any position of sun and moon.

    Parameters
    ----------
    rays
        16 sample points for each disc, on the mesh within its cell.
    """

    rays: SunRays

    def visible_share(self, state: LightState) -> np.ndarray:
        """Trace how much of the light of sun and moon reaches the discs past the land.

        Parameters
        ----------
        state
            Light of one instant.

        Returns
        -------
        numpy.ndarray
            ``(2, N)`` float32 in [0, 1] in the order of ``state.bodies``; of facets that face away, nothing. 1 for a missing body.
        """
        everyone = np.arange(self.rays.receivers)
        share = np.ones((BODIES, len(everyone)), np.float32)
        for body, direction in enumerate(np.asarray(state.bodies[0], np.float64)[:BODIES]):
            luminary = Luminary(direction / np.linalg.norm(direction), np.ones(3), _RADIUS_DEG)
            visible, unoccluded = sum_incidence(self.rays, luminary, everyone)
            share[body] = visible / np.maximum(unoccluded, 1e-6)
        return np.clip(share, 0.0, 1.0)


def disc_shadows(land: RayScene, discs: Surfels | GaussianModel) -> DiscShadows:
    """Place sample points in the cells of discs, for shadow rays.

    Parameters
    ----------
    land
        Mesh that casts the shadows and that the discs were made on.
    discs
        N discs, or a model of them.

    Returns
    -------
    DiscShadows
        Shadow rays of the discs.

    Raises
    ------
    ValueError
        If a cell has no land, or half of the discs lie farther from it than from their neighbours: they were made on another
        mesh.
    """
    grid, level, cell = discs.grid, discs.level, discs.cell
    count, samples = len(cell), SUBCELLS**2
    low_m, high_m = (float(z) for z in (land.mi_terrain.bbox().min.z, land.mi_terrain.bbox().max.z))
    origin = np.zeros((count, samples, 3), np.float32)
    normal, weight = np.zeros((count, samples, 3), np.float16), np.zeros((count, samples), np.float16)
    for start in range(0, count, _CELLS):
        block = slice(start, min(start + _CELLS, count))
        across_m = _sample_places_m(grid, level[block], cell[block])
        position_m = np.concatenate([across_m, np.full((*across_m.shape[:2], 1), 0.5 * (low_m + high_m))], axis=2)
        points, found = surface_at(land, position_m.reshape(-1, 3), search_m=0.5 * (high_m - low_m) + _MARGIN_M)
        for values, seen in ((origin, points.origin), (normal, points.geometric_normal)):
            values[block].reshape(-1, 3)[found] = seen
        weight[block].reshape(-1)[found] = 1.0
    if not weight.any(axis=1).all():
        raise ValueError(
            f"{int((~weight.any(axis=1)).sum())} discs have no land below them; use the terrain that they were made from"
        )
    apart_m = np.abs((origin[..., 2] * weight).sum(axis=1) / weight.sum(axis=1, dtype=np.float32) - discs.means[:, 2])
    if np.median(apart_m / grid.spacings_m(level)) > 1.0:
        raise ValueError(
            f"half of the discs lie {np.median(apart_m):.3g} m or more above or below the land; use the terrain that they were made from"
        )
    # The cosine is that of the mesh: it weighs the samples, and shading normals need not agree with what is in shadow.
    return DiscShadows(sun_rays(land, origin, normal, normal, weight, hashed_disc_offset(np.arange(count))))


def _sample_places_m(grid: SurfelGrid, level: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """East and north ``(N, 16, 2)`` of the sample points of cells [m]."""
    centre = np.stack(cell_centres_m(grid, level, cell), axis=-1)
    step = np.ldexp(np.array([grid.east_step_m, grid.north_step_m]), -level.astype(np.int32)[:, None])
    part = (np.arange(SUBCELLS) + 0.5) / SUBCELLS - 0.5
    within = np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2)
    return centre[:, None] + step[:, None] * within
