"""The finer images that a scene file names, as detail over the albedo of a view: read window by window about its camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.frames import geodetic_from_enu
from seasonscapes.terrain.imagery import bake_imagery, read_imagery
from seasonscapes.terrain.placement import cell_sides_m
from seasonscapes.terrain.raster import bounds_geographic
from seasonscapes.terrain.raster_files import rasters_hash
from seasonscapes.terrain.surface import Raster, Texture, raster_arrays, raster_from_arrays
from seasonscapes.terrain.surface_classes import ImageDetail, ImageLevel
from seasonscapes.terrain.surface_grid import grid_polynomials
from seasonscapes.terrain.tile_files import Bounds, bounds_about, covered_size_m, tile_spacing_m, tiles_reach_into
from seasonscapes.workspace import build_once

if TYPE_CHECKING:
    from seasonscapes.terrain.raster_tables import FinerImage
    from seasonscapes.workflows.place import Place

_CODE = ("workflows.nested_images",)
# Pixels along a side of each level: the nearest one holds the image's own pixels.
_MOST_SIDE = 4096
# Texels of the atlas, from the border of an image on, in which it does not count, and in which its share grows to 1.
_RIM_TEXELS, _BLEND_TEXELS = 2.0, 4.0
# Rim of the finer levels [pixels], and pixels about those without data that are left to the coarser ones.
_LEVEL_RIM_PX, _UNSURE_PX = 64.0, 2


@dataclass(frozen=True)
class WholeImage:
    """All of a finer image, at most `_MOST_SIDE` pixels wide, and its mean over the texels of the atlas.

    Parameters
    ----------
    raster
        ``(H, W, 3)`` float32 linear colour, NaN where there is none.
    mean
        ``weight`` is the share of the texel that the image covers.
    """

    raster: Raster
    mean: Texture


def image_details(place: Place, eye_m: np.ndarray) -> tuple[ImageDetail, ...]:
    """The finer images of a place for a view: in their own pixels about its camera, coarser farther away.

    Parameters
    ----------
    place
        The place.
    eye_m
        ``(3,)`` position of the camera [m].

    Returns
    -------
    tuple of ImageDetail
        The coarsest image first; empty for scenes that name none.
    """
    return tuple(_detail(place, declared, eye_m) for declared in finer_images(place))


def finer_images(place: Place) -> list[FinerImage]:
    """The tables of finer images of a place, the coarsest first."""
    declared = place.scene.imagery.finer if place.scene.imagery is not None else []
    return sorted(declared, key=lambda each: -tile_spacing_m(each.paths, place.scene.confinement))


def whole_image(place: Place, declared: FinerImage) -> WholeImage:
    """A finer image as a whole, from the workspace or read and kept there.

    Raises
    ------
    InputError
        Where it is no image, or covers none of the terrain.
    """

    def build() -> WholeImage:
        bounds_deg = bounds_geographic(place.elevation)
        spacing_m = tile_spacing_m(declared.paths, place.scene.confinement)
        raster = _read(place, declared, bounds_deg, spacing_m * _whole_step(place, declared))
        # As it is kept: the first run and later ones see the same.
        raster = replace(raster, values=raster.values.astype(np.float16).astype(np.float32))
        return WholeImage(raster, bake_imagery(place.terrain, place.atlas, raster))

    return build_once(
        place.workspace,
        f"{place.scene.name}/finer-image",
        {
            "terrain": place.key,
            "image": declared.without_folders(),
            "hash": rasters_hash(declared.paths, place.scene.confinement),
        },
        code=_CODE,
        suffix=".npz",
        build=build,
        save=_save,
        load=_load,
    )


def _detail(place: Place, declared: FinerImage, eye_m: np.ndarray) -> ImageDetail:
    whole = whole_image(place, declared)
    known = np.isfinite(whole.raster.values[..., 0])
    levels = [_level(place, whole.raster, _border_share(place, whole.raster, known), rim_nodes=1.0)]
    spacing_m = tile_spacing_m(declared.paths, place.scene.confinement)
    step = _whole_step(place, declared)
    latitude, longitude, _ = (float(value) for value in geodetic_from_enu(place.frame, eye_m))
    while step > 1:
        step = -(-step // 2)
        bounds_deg = bounds_about(latitude, longitude, 0.5 * _MOST_SIDE * step * spacing_m)
        reached = tiles_reach_into(declared.paths, bounds_deg, place.scene.confinement)
        if reached and _overlaps(bounds_geographic(whole.raster), bounds_deg):
            window = _read(place, declared, bounds_deg, step * spacing_m, window=True)
            levels.append(_level(place, window, _sure(np.isfinite(window.values[..., 0])), rim_nodes=_LEVEL_RIM_PX))
    mean = np.where(whole.mean.weight[..., None] > 0.0, whole.mean.values, 1.0)
    return ImageDetail(mean.astype(np.float16), tuple(levels))


def _whole_step(place: Place, declared: FinerImage) -> int:
    """Pixels of the image along a pixel of its widest level."""
    bounds_deg = bounds_geographic(place.elevation)
    side_m = float(covered_size_m(declared.paths, bounds_deg, place.scene.confinement).max())
    return max(1, math.ceil(side_m / (_MOST_SIDE * tile_spacing_m(declared.paths, place.scene.confinement)) - 1e-2))


def _read(place: Place, declared: FinerImage, bounds_deg: Bounds, finest_m: float, *, window: bool = False) -> Raster:
    return read_imagery(
        declared.paths,
        bounds_deg=bounds_deg,
        bands=tuple(declared.bands) if declared.bands else None,
        finest_m=finest_m,
        encoding=declared.encoding,
        full_scale=declared.full_scale,
        confinement=place.scene.confinement,
        window=window,
    )


def _overlaps(image_deg: Bounds, window_deg: Bounds) -> bool:
    """Whether a window reaches into an image by a tenth of its own side."""
    across, down = 0.1 * (window_deg[2] - window_deg[0]), 0.1 * (window_deg[3] - window_deg[1])
    return (
        image_deg[0] + across < window_deg[2]
        and image_deg[2] - across > window_deg[0]
        and image_deg[1] + down < window_deg[3]
        and image_deg[3] - down > window_deg[1]
    )


def _border_share(place: Place, raster: Raster, known: np.ndarray) -> np.ndarray:
    """Share ``(H, W)`` of a whole image: 0 at its border and in holes, 1 some texels of the atlas inside."""
    from scipy.ndimage import distance_transform_edt

    padded = np.pad(known, 1)
    distance_m = np.asarray(distance_transform_edt(padded, sampling=cell_sides_m(raster)[::-1]), np.float32)
    texels = distance_m[1:-1, 1:-1] / np.float32(place.atlas.texel_p50_m)
    return np.clip((texels - _RIM_TEXELS) / _BLEND_TEXELS, 0.0, 1.0)


def _sure(known: np.ndarray) -> np.ndarray:
    """1 where all pixels around have data, 0 elsewhere."""
    from scipy.ndimage import binary_erosion

    if known.all():
        return np.ones(known.shape, np.float32)
    return np.asarray(binary_erosion(known, np.ones((3, 3)), iterations=_UNSURE_PX, border_value=1), np.float32)


def _level(place: Place, raster: Raster, share: np.ndarray, *, rim_nodes: float) -> ImageLevel:
    heights = place.elevation.values
    to_node, domain = grid_polynomials(raster, place.frame, (float(heights.min()), float(heights.max())))
    values = np.concatenate([np.nan_to_num(raster.values), share[..., None]], axis=2, dtype=np.float16)
    return ImageLevel(values, to_node, domain, float(np.mean(cell_sides_m(raster))), rim_nodes)


def _save(image: WholeImage, path: Path) -> None:
    raster = replace(image.raster, values=image.raster.values.astype(np.float16))
    mean = {"mean": image.mean.values, "weight": image.mean.weight, "atlas_id": str(image.mean.atlas_id)}
    np.savez(path, **raster_arrays(raster), **mean)


def _load(path: Path) -> WholeImage:
    with np.load(path, allow_pickle=False) as stored:
        return WholeImage(
            raster_from_arrays(stored), Texture(stored["mean"], stored["weight"], str(stored["atlas_id"]))
        )
