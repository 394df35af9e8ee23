"""Guides of a completion: for each texel what is known of it without any camera having seen it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from seasonscapes.terrain.atlas import Atlas
from seasonscapes.terrain.surface import Terrain, Texture
from seasonscapes.terrain.texels import texel_positions
from seasonscapes.texturing.terrain_features import terrain_features
from seasonscapes.texturing.top_down_grid import TopDownGrid, from_grid, grid_heights, top_down_grid


@dataclass(frozen=True)
class Predictors:
    """What the land itself tells about each texel.

    Parameters
    ----------
    values
        ``(R, S, G)`` float32; NaN where unknown (beyond a satellite image, off the surface).
    names
        Of the G layers. Those that begin with ``satellite`` come from an image and may be missing in places.
    surface
        ``(R, S)`` bool: the texel lies on the land, not in the space between charts.
    plan
        Where the atlas has several charts: the texels' places on a top-down grid, so that what is propagated crosses
        from chart to chart as the land does. ``None`` where the texture itself is one connected picture of the land.
    """

    values: np.ndarray
    names: tuple[str, ...]
    surface: np.ndarray
    plan: TopDownGrid | None = None

    def __post_init__(self):
        if self.values.ndim != 3 or self.values.shape[2] != len(self.names):
            raise ValueError(f"Guides: values {self.values.shape} and {len(self.names)} names")
        if self.values.shape[:2] != self.surface.shape:
            raise ValueError(f"Guides: values {self.values.shape} and surface {self.surface.shape} differ in size")


def stack_predictors(
    layers: Mapping[str, np.ndarray],
    satellite: Texture | None = None,
    *,
    plan: TopDownGrid | None = None,
    surface: np.ndarray | None = None,
) -> Predictors:
    """Guides from layers ``(R, S)`` and a satellite image in the same atlas.

    Parameters
    ----------
    satellite
        ``values`` ``(R, S, C)`` linear, of any scale; missing where ``weight`` is 0 or a value is not finite.
    surface
        Left out: where every layer is finite.
    """
    if not layers:
        raise ValueError("stack_guides: no layers")
    columns = [np.asarray(layer, np.float32) for layer in layers.values()]
    names = list(layers)
    if surface is None:
        surface = np.isfinite(columns).all(axis=0)
    if satellite is not None:
        seen = (satellite.weight > 0.0) & np.isfinite(satellite.values).all(axis=2)
        if seen.any():
            for channel in range(satellite.values.shape[2]):
                columns.append(np.where(seen, satellite.values[..., channel], np.nan).astype(np.float32))
                names.append(f"satellite_{channel + 1}")
    return Predictors(np.stack(columns, -1), tuple(names), surface, plan)


def predictors_for(
    terrain: Terrain,
    atlas: Atlas,
    *,
    satellite: Texture | None = None,
    relit: np.ndarray | None = None,
    sun_direction=None,
    day_suns=None,
    extra: Mapping[str, np.ndarray] | None = None,
) -> Predictors:
    """Guides for every texel of a terrain's atlas.

    Parameters
    ----------
    satellite
        An image baked into the atlas (`terrain.imagery.bake_imagery`), ``weight`` 0 where it does not reach.
    relit
        ``(R, S, 3)`` radiance of an albedo in the light of the hour.
    sun_direction, day_suns
        See `terrain_features`.
    extra
        More layers ``(R, S)``, such as irradiance that a renderer has found.

    Raises
    ------
    ValueError
        A satellite image or an extra layer of another size than the atlas.
    """
    shape = (atlas.height_px, atlas.width_px)
    extra = dict(extra or {})
    if relit is not None:
        extra |= {f"relit_{n + 1}": relit[..., n] for n in range(3)}
    for name, size in [
        ("satellite", satellite.values.shape[:2] if satellite is not None else shape),
        *((name, layer.shape) for name, layer in extra.items()),
    ]:
        if size != shape:
            raise ValueError(f"guides_for: {name} is {size}, the atlas {shape}")
    positions, face_id = texel_positions(terrain, atlas.width_px, atlas.height_px)
    # A planar atlas is itself the plan: with its own cell size the two coincide.
    planar_m = float((np.ptp(terrain.vertices[:, :2], axis=0) / [atlas.width_px, atlas.height_px]).max())
    cell_m = planar_m if atlas.kind == "planar" else atlas.texel_p50_m
    heights, spacing_m = grid_heights(terrain, cell_m)
    plan = top_down_grid(terrain, positions, heights.shape[1], heights.shape[0])
    share = from_grid(plan, np.isfinite(heights).astype(np.float32)[..., None])[..., 0]
    layers = {}
    for name, layer in terrain_features(heights, spacing_m, sun_direction=sun_direction, day_suns=day_suns).items():
        # At the rim of the land only cells with a height have a say.
        sums = from_grid(plan, np.nan_to_num(layer)[..., None])[..., 0]
        layers[name] = np.where(share > 0.0, sums / np.maximum(share, 1e-6), np.nan).astype(np.float32)
    layers |= extra
    return stack_predictors(layers, satellite, plan=plan if atlas.charts > 1 else None, surface=face_id >= 0)
