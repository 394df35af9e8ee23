"""Predictors for the completion of a texture: terrain attributes, insolation and imagery at every texel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.errors import AtlasMismatch
from seasonscapes.terrain.atlas import Atlas
from seasonscapes.terrain.surface import Terrain, Texture
from seasonscapes.terrain.texels import texel_positions
from seasonscapes.texturing.terrain_features import terrain_features
from seasonscapes.texturing.top_down_grid import TopDownGrid, from_grid, grid_heights, top_down_grid


@dataclass(frozen=True)
class Predictors:
    """Predictor variables of every texel.

    Parameters
    ----------
    values
        ``(R, S, G)`` float32; NaN where unknown (outside a satellite image, off the surface).
    names
        Names of the G layers. Those that begin with ``satellite`` or ``relit`` are images of the terrain; satellite
        layers may be missing in places.
    surface
        ``(R, S)`` bool: texels on the terrain; the others lie between charts.
    grid
        Positions of the texels on a top-down grid, for spatial operations across chart borders; ``None`` where the
        texture is a single chart.

    Raises
    ------
    ValueError
        Shapes and names do not agree.
    """

    values: np.ndarray
    names: tuple[str, ...]
    surface: np.ndarray
    grid: TopDownGrid | None = None

    def __post_init__(self):
        if self.values.ndim != 3 or self.values.shape[2] != len(self.names):
            raise ValueError(f"Predictors: values {self.values.shape} and {len(self.names)} names")
        if self.values.shape[:2] != self.surface.shape:
            raise ValueError(f"Predictors: values {self.values.shape} and surface {self.surface.shape} differ in size")

    def at(self, texel: np.ndarray) -> np.ndarray:
        """Return the values ``(n, G)`` of flat indices ``(n,)`` of texels."""
        return self.values.reshape(-1, self.values.shape[2])[texel]


def stack_predictors(
    layers: Mapping[str, np.ndarray],
    satellite: Texture | None = None,
    *,
    grid: TopDownGrid | None = None,
    surface: np.ndarray | None = None,
) -> Predictors:
    """Stack layers and a satellite image in the same atlas.

    Parameters
    ----------
    layers
        ``(R, S)`` each, by name.
    satellite
        ``values`` ``(R, S, C)`` linear, of any scale; missing where ``weight`` is 0 or a value is not finite.
    grid
        As in `Predictors`.
    surface
        As in `Predictors`; ``None`` for the texels where every layer is finite.

    Returns
    -------
    Predictors
        Layers in the given order, then ``satellite_1`` and so on unless no texel has an image.

    Raises
    ------
    ValueError
        ``layers`` is empty, or shapes do not agree.
    """
    if not layers:
        raise ValueError("stack_predictors: no layers")
    columns = [np.asarray(layer, np.float32) for layer in layers.values()]
    names = list(layers)
    if surface is None:
        surface = np.asarray(np.isfinite(columns).all(axis=0))
    if satellite is not None:
        imaged = (satellite.weight > 0.0) & np.isfinite(satellite.values).all(axis=2)
        if imaged.any():
            for channel in range(satellite.values.shape[2]):
                columns.append(np.where(imaged, satellite.values[..., channel], np.nan).astype(np.float32))
                names.append(f"satellite_{channel + 1}")
    return Predictors(np.stack(columns, -1), tuple(names), surface, grid)


def relit_layers(relit: np.ndarray | None) -> dict[str, np.ndarray]:
    """The channels of predicted radiance ``(R, S, 3)`` as layers by name; none where there is no prediction."""
    return {} if relit is None else {f"relit_{n + 1}": relit[..., n] for n in range(3)}


def require_atlas_size(shape: tuple[int, int], satellite: Texture | None, layers: Mapping[str, np.ndarray]) -> None:
    """Check that a satellite image and layers are as large as an atlas.

    Parameters
    ----------
    shape
        Rows and columns of the atlas.
    satellite, layers
        As in `stack_predictors`.

    Raises
    ------
    AtlasMismatch
        One of another size.
    """
    sizes = {name: layer.shape for name, layer in layers.items()}
    if satellite is not None:
        sizes["satellite"] = satellite.values.shape[:2]
    for name, size in sizes.items():
        if size != shape:
            raise AtlasMismatch(f"predictors: {name} is {size}, the atlas {shape}")


def predictors_for(
    terrain: Terrain,
    atlas: Atlas,
    *,
    satellite: Texture | None = None,
    relit: np.ndarray | None = None,
    sun_direction: ArrayLike | None = None,
    day_suns: ArrayLike | None = None,
    extra: Mapping[str, np.ndarray] | None = None,
) -> Predictors:
    """Compute the predictors of every texel of a terrain's atlas.

    Parameters
    ----------
    terrain
        The surface with its texture coordinates.
    atlas
        Size and kind of the atlas.
    satellite
        An image baked into the atlas (`terrain.imagery.bake_imagery`), ``weight`` 0 outside its extent.
    relit
        ``(R, S, 3)`` radiance of an albedo in the light of the photographs.
    sun_direction, day_suns
        As in `terrain_features`.
    extra
        Further layers ``(R, S)`` by name, such as irradiance from a renderer.

    Returns
    -------
    Predictors
        Terrain attributes, then the extra and relit layers, then the satellite image.

    Raises
    ------
    AtlasMismatch
        A satellite image or a layer of another size than the atlas.
    """
    shape = (atlas.height_px, atlas.width_px)
    extra = {**(extra or {}), **relit_layers(relit)}
    require_atlas_size(shape, satellite, extra)
    positions, face_id = texel_positions(terrain, atlas.width_px, atlas.height_px)
    # A planar atlas is a top-down grid itself: with its own cell size the two coincide.
    planar_m = float((np.ptp(terrain.vertices[:, :2], axis=0) / [atlas.width_px, atlas.height_px]).max())
    cell_m = planar_m if atlas.kind == "planar" else atlas.texel_p50_m
    heights, spacing_m = grid_heights(terrain, cell_m)
    grid = top_down_grid(terrain, positions, heights.shape[1], heights.shape[0])
    coverage = from_grid(grid, np.isfinite(heights).astype(np.float32)[..., None])[..., 0]
    layers = {}
    for name, layer in terrain_features(heights, spacing_m, sun_direction=sun_direction, day_suns=day_suns).items():
        # At the border of the terrain, the mean is over cells with a height alone.
        sums = from_grid(grid, np.nan_to_num(layer)[..., None])[..., 0]
        layers[name] = np.where(coverage > 0.0, sums / np.maximum(coverage, 1e-6), np.nan).astype(np.float32)
    layers |= extra
    return stack_predictors(layers, satellite, grid=grid if atlas.charts > 1 else None, surface=face_id >= 0)
