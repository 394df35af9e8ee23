"""The water that a scene file declares: read, drawn or found, and laid into the place's atlas."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.terrain.raster_files import rasters_hash
from seasonscapes.terrain.surface import Raster, Terrain
from seasonscapes.terrain.surface_classes import Water
from seasonscapes.workspace import file_hash

if TYPE_CHECKING:
    from seasonscapes.scene import SceneFile
    from seasonscapes.terrain.synthetic_massif import SyntheticMassif
    from seasonscapes.terrain.unwrap import Atlas

log = logging.getLogger(__name__)


def water_key(scene: SceneFile) -> dict[str, Any]:
    """Plain values that determine the water of a scene; empty for scenes without the table."""
    declared = scene.water
    if declared is None:
        return {}
    if declared.file is None:
        content: Any = [each for _, each in scene.image_keys[:1]]
    else:
        content = (
            file_hash(Path(declared.file))
            if _is_geojson(declared.file)
            else rasters_hash(declared.paths, scene.confinement)
        )
    name = None if declared.file is None else Path(declared.file).name
    return {"water": declared.model_copy(update={"file": name}), "water_hash": content}


def scene_water(scene: SceneFile, elevation: Raster, massif: SyntheticMassif | None) -> Raster | None:
    """The share of water ``(H, W, 1)`` at the cells of a scene's elevation raster.

    Returns
    -------
    Raster or None
        ``None`` for scenes without the table ``[water]``, and where no water was found.

    Raises
    ------
    InputError
        Where the file is none, or shows no water on the raster.
    """
    from seasonscapes.terrain.imagery import read_imagery
    from seasonscapes.terrain.placement import cell_sides_m
    from seasonscapes.terrain.raster import bounds_geographic
    from seasonscapes.terrain.water import find_water, polygon_water, raster_water

    declared = scene.water
    if declared is None:
        return None
    if declared.file is not None:
        if _is_geojson(declared.file):
            return polygon_water(declared.file, elevation)
        return raster_water(declared.file, elevation, scene.confinement)
    if massif is not None:
        # The contour of one half is the shore, to a fraction of a cell.
        shares = np.clip(0.5 - massif.shore_m / massif.spacing_m, 0.0, 1.0)
        return replace(elevation, values=shares[..., None].astype(np.float32))
    image = None
    if scene.images:
        imagery = scene.images[0]
        image = read_imagery(
            imagery.paths,
            bounds_deg=bounds_geographic(elevation),
            bands=tuple(imagery.bands) if imagery.bands else None,
            finest_m=float(np.mean(cell_sides_m(elevation))),
            encoding=imagery.encoding,
            full_scale=imagery.full_scale,
            confinement=scene.confinement,
        )
        image = replace(image, values=image.values * np.float32(imagery.reflectance_scale))
    water = find_water(elevation, image, least_area_m2=declared.least_area_m2)
    share = float(water.values.mean())
    if share == 0.0:
        log.warning("water: no lake was found; draw it, and name the polygons in [water] file")
        return None
    how = "relief and image" if image is not None else "relief alone"
    log.info("water: found on %.3g %% of the land, from %s", 100.0 * share, how)
    return water


def with_water(terrain: Terrain, atlas: Atlas, water: Raster, wind_m_s: float) -> Terrain:
    """The terrain with its water in the atlas."""
    from seasonscapes.terrain.imagery import bake_imagery

    baked = bake_imagery(terrain, atlas, replace(water, values=np.repeat(water.values, 3, axis=2)))
    return replace(terrain, water=Water(baked.values[..., 0] * (baked.weight > 0.0), wind_m_s))


def _is_geojson(file: str) -> bool:
    return Path(file).suffix.lower() in (".geojson", ".json")
