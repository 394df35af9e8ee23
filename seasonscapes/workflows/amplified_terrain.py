"""The terrain of a place as fine as a camera sees it: its finest data, and relief and albedo below their resolution."""

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
from seasonscapes.terrain.surface import Raster, SurfaceGrid, Terrain, surface_arrays, surface_from_arrays
from seasonscapes.terrain.surface_classes import AlbedoDetail
from seasonscapes.terrain.surface_grid import surface_grid
from seasonscapes.terrain.view_refinement import moved_to, refined_for_view
from seasonscapes.workflows.nested_heights import finest_near
from seasonscapes.workflows.nested_images import image_details
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
# Width of the rim along which that part is blended with what is around it, as a share of its side.
_RIM_SHARE = 0.12
# Invented relief need not be as exact as that of the data.
_TOLERANCE_PX, _REACH_M = 1.0, 2000.0
# Up to the first height above ground a camera stands on it, from the second one up it does not [m].
_STANDING_M, _FREE_M = 20.0, 100.0

log = logging.getLogger(__name__)


def detailed_view(
    place: Place, view: Camera | Panorama, *, amplify: bool = False, seed: int = 0
) -> tuple[Camera | Panorama, Terrain]:
    """The ground of a view as fine about its camera as the data are, or finer.

    Parameters
    ----------
    place
        The place.
    view
        The camera, in the place's frame.
    amplify
        Add detail below the resolution of the data.
    seed
        Another seed gives other detail.

    Returns
    -------
    view
        Raised or lowered by what finer ground adds below it, so that its height above ground stays; the same one where that is
        more than 100 m.
    terrain
        With the atlas of the place. Its surface has a part about the camera as fine as the files there, and its mesh follows
        it; images finer than the atlas lie over its albedo. With ``amplify`` it is finer everywhere and finest about the camera,
        and its albedo has detail down to the pixels; means over the data's cells stay.
    """
    terrain = place.terrain
    if terrain.surface is not None:
        fine = _surface(place, np.asarray(view.position_m, float), seed, amplify=amplify)
        if fine is not terrain.surface:
            view, terrain = _at_its_height(view, terrain.surface, fine), moved_to(terrain, fine)
    eye_m, pixel_rad = np.asarray(view.position_m, float), 1.0 / float(view.fx)
    terrain = replace(terrain, images=image_details(place, eye_m))
    if not amplify:
        return view, refined_for_view(terrain, eye_m, pixel_rad)
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


def _surface(place: Place, eye_m: np.ndarray, seed: int, *, amplify: bool) -> SurfaceGrid:
    """Surface of the place, amplified or not, with a finer part about a camera."""
    surface = place.terrain.surface
    assert surface is not None
    whole, factor = _amplified_whole(place, seed) if amplify else (surface, 1)
    found = finest_near(place, eye_m, _NEAR_M, most_samples=_MOST_NEAR_NODES) if surface.parts else None
    if found is None and not amplify:
        return surface
    if found is None:
        # Parts of finer data that do not hold the camera take the place of what is invented.
        near = _near_part(place, place.elevation, eye_m, seed, least_factor=factor)
        parts = surface.parts if near is None else (near, *surface.parts)
        return replace(whole, parts=parts)
    number, heights = found
    kept = heights is place.finer_heights[number]
    if kept and not amplify:
        return surface
    near = _near_part(place, heights, eye_m, seed, least_factor=1 if kept else 0, amplify=amplify)
    before, after = surface.parts[: number + 1], surface.parts[number + 1 :]
    return replace(whole, parts=(*before, *(() if near is None else (near,)), *after))


def _amplified_whole(place: Place, seed: int) -> tuple[SurfaceGrid, int]:
    """The amplified surface of the elevation raster, and how many times finer than it."""
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
    return whole, factor


def _near_part(
    place: Place, elevation: Raster, eye_m: np.ndarray, seed: int, *, least_factor: int, amplify: bool = True
) -> SurfaceGrid | None:
    """A finer surface about a camera, of a raster that lies there.

    ``None`` where the raster does not reach it, and where it would be no more than ``least_factor`` times finer.
    """
    assert place.terrain.surface is not None
    spacing_m = sample_spacing_m(elevation)
    latitude, longitude, _ = geodetic_from_enu(place.frame, eye_m)
    column, row = (int(value) for value in raster_pixels(elevation, latitude, longitude).ravel())
    rows, columns = elevation.values.shape[:2]
    reach = min(max(8, round(_NEAR_M / spacing_m)), math.isqrt(_MOST_NEAR_NODES) // 2)
    if not (-reach < row < rows + reach and -reach < column < columns + reach):
        return None
    part = tuple(slice(max(at - reach, 0), min(at + reach, size)) for at, size in ((row, rows), (column, columns)))
    if min(each.stop - each.start for each in part) < 8:
        return None
    factor, cells = 1, math.prod(each.stop - each.start for each in part)
    while amplify and cells * (2 * factor) ** 2 <= _MOST_NEAR_NODES and spacing_m / (2 * factor) >= _LEAST_NEAR_M:
        factor *= 2
    if factor <= least_factor:
        return None
    fine = amplified_part(elevation, factor, rows=part[0], columns=part[1], seed=seed)
    error_m = float(place.terrain.surface.error_at(eye_m[None])[0])
    rim_nodes = _RIM_SHARE * min(fine.values.shape[:2])
    return surface_grid(fine, place.frame, mesh_error_m=error_m, rim_nodes=rim_nodes)


def _save_surface(surface: SurfaceGrid, path: Path) -> None:
    np.savez(path, **surface_arrays(surface))


def _load_surface(path: Path) -> SurfaceGrid:
    with np.load(path, allow_pickle=False) as stored:
        return surface_from_arrays(stored)
