"""The terrain of a place with relief and albedo below the resolution of its data, as fine as a camera sees them."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.frames import geodetic_from_enu
from seasonscapes.terrain.amplification import amplified, amplified_part
from seasonscapes.terrain.crs import raster_pixels
from seasonscapes.terrain.surface import SurfaceGrid, Terrain
from seasonscapes.terrain.surface_classes import AlbedoDetail
from seasonscapes.terrain.surface_grid import surface_grid
from seasonscapes.terrain.view_refinement import refined_for_view
from seasonscapes.workflows.terrain_building import sample_spacing_m
from seasonscapes.workspace import build_once

if TYPE_CHECKING:
    from seasonscapes.cameras.panorama import Panorama
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.workflows.place import Place

_CODE = ("terrain.amplification", "terrain.surface_grid")
# Nodes of the surface of the whole place, and of the part about a camera.
_MOST_NODES, _MOST_NEAR_NODES = 12_000_000, 5_000_000
# Finest spacing [m] of the whole and about a camera, and how far the finer part reaches [m].
_LEAST_M, _LEAST_NEAR_M, _NEAR_M = 1.0, 0.3, 500.0
_MOST_FACTOR = 8
# Invented relief need not be as exact as that of the data.
_TOLERANCE_PX, _REACH_M = 1.0, 2000.0
# Up to the first height above ground a camera stands on it, from the second one up it does not [m].
_STANDING_M, _FREE_M = 20.0, 100.0

log = logging.getLogger(__name__)


def amplified_view(place: Place, view: Camera | Panorama, *, seed: int = 0) -> tuple[Camera | Panorama, Terrain]:
    """Add detail below the resolution of the data to the ground of a view.

    Parameters
    ----------
    place
        The place.
    view
        The camera, in the place's frame.
    seed
        Another seed gives other detail.

    Returns
    -------
    view
        Raised or lowered by what detail adds to the ground below it, so that its height above ground stays; the same one
        where that is more than 100 m.
    terrain
        With the atlas of the place: its surface is finer everywhere, and finest about the camera, where the mesh follows it;
        its albedo has detail down to the pixels. Means over the data's cells stay.
    """
    terrain = place.terrain
    if terrain.surface is not None:
        fine = _surface(place, np.asarray(view.position_m, float), seed)
        view, terrain = _at_its_height(view, terrain.surface, fine), replace(terrain, surface=fine)
    eye_m, pixel_rad = view.position_m, 1.0 / float(view.fx)
    east, north, up = (float(value) for value in eye_m)
    detail = AlbedoDetail((east, north, up), pixel_rad, place.atlas.texel_p50_m, seed)
    terrain = refined_for_view(terrain, eye_m, pixel_rad, tolerance_px=_TOLERANCE_PX, reach_m=_REACH_M)
    return view, replace(terrain, detail=detail)


def _at_its_height(view: Camera | Panorama, plain: SurfaceGrid, fine: SurfaceGrid) -> Camera | Panorama:
    eye_m = np.asarray(view.position_m, float)
    ground_m, finer_m = (float(surface.up_at(eye_m[None])[0]) for surface in (plain, fine))
    share = np.clip((_FREE_M - (eye_m[2] - ground_m)) / (_FREE_M - _STANDING_M), 0.0, 1.0)
    if share == 0.0:
        return view
    pose = np.array(view.world_from_camera, float)
    pose[2, 3] += share * (finer_m - ground_m)
    log.info(
        "the camera keeps its height above ground: detail changes the ground below it by %+.2f m", finer_m - ground_m
    )
    return replace(view, world_from_camera=pose)


def _surface(place: Place, eye_m: np.ndarray, seed: int) -> SurfaceGrid:
    """Amplified surface of the place with a finer part about a camera."""
    assert place.terrain.surface is not None
    spacing_m, error_m = sample_spacing_m(place.elevation), place.terrain.surface.mesh_error_m
    factor = 1
    while (
        factor < _MOST_FACTOR
        and place.elevation.values.size * (2 * factor) ** 2 <= _MOST_NODES
        and spacing_m / (2 * factor) >= _LEAST_M
    ):
        factor *= 2
    whole = build_once(
        place.workspace,
        f"{place.scene.name}/amplified",
        {"place": place.key, "factor": factor, "seed": seed},
        code=_CODE,
        suffix=".npz",
        build=lambda: surface_grid(amplified(place.elevation, factor, seed=seed), place.frame, mesh_error_m=error_m),
        save=_save_surface,
        load=_load_surface,
    )
    latitude, longitude, _ = geodetic_from_enu(place.frame, eye_m)
    column, row = (int(value) for value in raster_pixels(place.elevation, latitude, longitude).ravel())
    rows, columns = place.elevation.values.shape[:2]
    reach = max(8, round(_NEAR_M / spacing_m))
    if not (-reach < row < rows + reach and -reach < column < columns + reach):
        return whole
    part = tuple(slice(max(at - reach, 0), min(at + reach, size)) for at, size in ((row, rows), (column, columns)))
    if min(each.stop - each.start for each in part) < 8:
        return whole
    near, cells = factor, math.prod(each.stop - each.start for each in part)
    while cells * (2 * near) ** 2 <= _MOST_NEAR_NODES and spacing_m / (2 * near) >= _LEAST_NEAR_M:
        near *= 2
    if near == factor:
        return whole
    fine = amplified_part(place.elevation, near, rows=part[0], columns=part[1], seed=seed)
    return replace(whole, inner=surface_grid(fine, place.frame, mesh_error_m=error_m))


def _save_surface(surface: SurfaceGrid, path: Path) -> None:
    np.savez(
        path, nodes=surface.nodes, to_node=surface.to_node, domain=surface.domain, mesh_error_m=surface.mesh_error_m
    )


def _load_surface(path: Path) -> SurfaceGrid:
    with np.load(path, allow_pickle=False) as stored:
        east, north, radius = (float(value) for value in stored["domain"])
        return SurfaceGrid(stored["nodes"], stored["to_node"], (east, north, radius), float(stored["mesh_error_m"]))
