"""The finer heights that a scene file names: read, blended into the elevation raster, and kept in the workspace."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.frames import geodetic_from_enu
from seasonscapes.terrain.nested_heights import (
    HeightOffset,
    nested_heights,
    nested_window,
    reach_of_border_m,
    tell_offset,
)
from seasonscapes.terrain.placement import cell_sides_m
from seasonscapes.terrain.raster import bounds_geographic
from seasonscapes.terrain.raster_files import rasters_hash
from seasonscapes.terrain.surface import Raster, raster_arrays, raster_from_arrays
from seasonscapes.terrain.tile_files import (
    Bounds,
    bounds_about,
    covered_size_m,
    read_elevation_tiles,
    tile_spacing_m,
    tiles_reach_into,
)
from seasonscapes.terrain.water import levelled
from seasonscapes.workspace import Workspace, build_once

if TYPE_CHECKING:
    from seasonscapes.scene import SceneFile
    from seasonscapes.terrain.raster_tables import FinerHeights
    from seasonscapes.workflows.place import Place

_CODE = ("workflows.nested_heights", "workflows.scene_water")
# Samples of a part that are kept for the whole place; finer data are averaged to these, and read anew about a camera.
_MOST_SAMPLES = 12_000_000


def finer_heights(
    scene: SceneFile, elevation: Raster, water: Raster | None, workspace: Workspace, water_key: dict
) -> tuple[Raster, ...]:
    """The finer heights of a scene, each blended into what is coarser.

    Parameters
    ----------
    scene
        Its tables ``[[elevation.finer]]`` name them.
    elevation
        The scene's elevation raster, without holes.
    water
        Share of water at its cells; lakes keep the level that they have there.
    workspace
        Where they are kept.
    water_key
        Plain values that determine ``water``.

    Returns
    -------
    tuple of Raster
        Heights ``(H, W, 1)`` [m] without NaN, the coarsest first; averaged to at most twelve million samples each.

    Raises
    ------
    InputError
        As `terrain.nested_heights.nested_heights` and `terrain.raster.read_elevation`.
    """
    parts: list[Raster] = []
    assert scene.elevation is not None, "callers refuse scenes without elevation"
    bounds_deg = bounds_geographic(elevation)
    for declared in _coarse_first(scene):
        under = (*reversed(parts), elevation)

        def build(declared: FinerHeights = declared, under: tuple[Raster, ...] = under) -> _Built:
            fine = _read(scene, declared, bounds_deg, _finest_m(scene, declared, bounds_deg))
            heights, offset = nested_heights(fine, under, bounds_deg=bounds_deg, where=declared.label)
            return (heights if water is None else _with_lakes(heights, under, water)), offset

        heights, offset = build_once(
            workspace,
            f"{scene.name}/finer-heights",
            {
                "elevation": scene.elevation.without_folders(),
                "hash": rasters_hash(scene.elevation.all_paths, scene.confinement),
                "part": declared.without_folders(),
                # A caller may have read more or less than the scene's area; another machine, another last digit.
                "bounds": [round(each, 9) for each in bounds_deg],
                **water_key,
            },
            code=_CODE,
            suffix=".npz",
            build=build,
            save=_save,
            load=_load,
        )
        tell_offset(offset, declared.label)
        parts.append(heights)
    return tuple(parts)


def finest_near(place: Place, eye_m: np.ndarray, reach_m: float, *, most_samples: int) -> tuple[int, Raster] | None:
    """The finest heights about a position, as fine as their files are.

    Parameters
    ----------
    place
        The place.
    eye_m
        ``(3,)`` position [m].
    reach_m
        Distance to which they are wanted, to all sides [m].
    most_samples
        What is read of them at most; very fine heights then reach less far.

    Returns
    -------
    tuple or None
        Number among ``place.finer_heights``, and heights ``(H, W, 1)`` without NaN that reach at least so far, where the
        files do; ``None`` outside all of them.
    """
    surface = place.terrain.surface
    assert surface is not None
    within = [number for number, part in enumerate(surface.parts) if part.share_at(eye_m[None])[0] > 0.0]
    if not within:
        return None
    number, kept = within[-1], place.finer_heights[within[-1]]
    declared = _coarse_first(place.scene)[number]
    spacing_m = tile_spacing_m(declared.paths, place.scene.confinement)
    if spacing_m > 0.8 * float(np.mean(cell_sides_m(kept))):
        return number, kept
    under = (*reversed(place.finer_heights[:number]), place.elevation)
    latitude, longitude, _ = (float(value) for value in geodetic_from_enu(place.frame, eye_m))
    reach_m = min(reach_m + reach_of_border_m(kept, under), 0.5 * math.sqrt(most_samples) * spacing_m)
    bounds_deg = bounds_about(latitude, longitude, reach_m)
    if not tiles_reach_into(declared.paths, bounds_deg, place.scene.confinement):
        return number, kept
    # The whole part was accepted: a window of it may hold a hole, or ground that has changed.
    heights = nested_window(_read(place.scene, declared, bounds_deg, None), under, bounds_deg=bounds_deg)
    if place.scene.water is not None:
        heights = _with_level_ground(heights, kept)
    return number, heights


_Built = tuple[Raster, HeightOffset]


def _coarse_first(scene: SceneFile) -> list[FinerHeights]:
    assert scene.elevation is not None, "callers refuse scenes without elevation"
    return sorted(scene.elevation.finer, key=lambda each: -tile_spacing_m(each.paths, scene.confinement))


def _read(scene: SceneFile, declared: FinerHeights, bounds_deg: Bounds, finest_m: float | None) -> Raster:
    raster = read_elevation_tiles(
        declared.paths,
        bounds_deg=bounds_deg,
        band=declared.band,
        unit=declared.unit,
        nodata=declared.nodata,
        finest_m=finest_m,
        confinement=scene.confinement,
    )
    return replace(raster, values=raster.values + np.float32(declared.offset_m)) if declared.offset_m else raster


def _finest_m(scene: SceneFile, declared: FinerHeights, bounds_deg: Bounds) -> float:
    """Whole number of samples whose mean is kept, as a length [m]."""
    spacing_m = tile_spacing_m(declared.paths, scene.confinement)
    sides_m = covered_size_m(declared.paths, bounds_deg, scene.confinement)
    area_m2 = float(np.prod(np.maximum(sides_m, spacing_m)))
    return spacing_m * math.ceil(math.sqrt(area_m2 / _MOST_SAMPLES) / spacing_m - 1e-6)


def _with_lakes(heights: Raster, under: Sequence[Raster], water: Raster) -> Raster:
    """Lakes at the level that they have in the elevation raster."""
    from seasonscapes.terrain.water import sampled_on

    lake = np.nan_to_num(sampled_on(water, heights)) > 0.5
    if not lake.any():
        return heights
    coarse = sampled_on(under[-1], heights)
    lake &= np.isfinite(coarse)
    return levelled(replace(heights, values=np.where(lake, coarse, heights.values)), water)


def _with_level_ground(heights: Raster, kept: Raster) -> Raster:
    """Cells where a coarser version of the heights is exactly level take its height: lakes."""
    from scipy.ndimage import maximum_filter, minimum_filter

    from seasonscapes.terrain.water import sampled_on

    coarse = kept.values[..., 0]
    level = maximum_filter(coarse, 3) == minimum_filter(coarse, 3)
    if not level.any():
        return heights
    layers = np.stack([level.astype(np.float32), coarse], axis=-1)
    share, height = np.moveaxis(sampled_on(replace(kept, values=layers), heights), -1, 0)
    lake = np.nan_to_num(share) > 0.5
    return replace(heights, values=np.where(lake, height, heights.values[..., 0])[..., None].astype(np.float32))


def _save(built: _Built, path: Path) -> None:
    raster, offset = built
    np.savez(path, **raster_arrays(raster), offset=[offset.median_m, offset.spread_m])


def _load(path: Path) -> _Built:
    with np.load(path, allow_pickle=False) as stored:
        return raster_from_arrays(stored), HeightOffset(*(float(value) for value in stored["offset"]))
