"""Photographs painted into the atlas: each texel from the cameras that see it, as radiance of the land [cd/m²]."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from seasonscapes.images import atomic_path
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.terrain.atlas import Atlas
from seasonscapes.terrain.surface import Terrain, Texture
from seasonscapes.texturing.atlas_tiles import (
    TILE_PX,
    AtlasTile,
    AtlasTiling,
    sees_tile,
    tile_blocks,
    tile_surface,
    tiles_of,
    tiling,
)
from seasonscapes.texturing.inputs import (
    NEAR_M,
    PaintingInput,
    PreparedInput,
    air_to,
    prepare_input,
    sample_input,
    texel_extent_px,
)
from seasonscapes.texturing.radiometric_fit import RadiometricFit, common_gain, fit_radiometry, radiance_at_surface
from seasonscapes.texturing.texel_weights import sharpened, texel_weight
from seasonscapes.texturing.visibility import by_ray, project_texels

MODES = ("weighted", "first")
Progress = Callable[[float], None]
# A texel that all cameras trust less than this is left to completion.
_LEAST_WEIGHT = 1e-4


@dataclass(frozen=True)
class Painting:
    """What cameras paint into an atlas.

    Parameters
    ----------
    texture
        Radiance ``(R, S, 3)`` [cd/m²] leaving the land, the air removed; relative where no sky gave a scale. ``weight``
        is the greatest of the cameras' weights, 0 where none painted.
    best
        ``(R, S)`` int16 index of the camera with the greatest weight (of the one that painted, in mode ``first``), −1
        where none did; it counts in the order of ``webcams``.
    coverage
        ``(R, S)`` uint8: how many cameras have a say.
    webcams
        Names of the shots that were used.
    radiometry
        Their gains and haze, in that order.
    skipped
        A line for each shot that has nothing to say, and why.
    """

    texture: Texture
    best: np.ndarray
    coverage: np.ndarray
    webcams: tuple[str, ...]
    radiometry: RadiometricFit
    skipped: tuple[str, ...]


@dataclass(frozen=True)
class PaintOptions:
    """How to paint.

    Parameters
    ----------
    mode
        ``weighted`` blends by sharpened weights; ``first`` lets the first camera in order that sees a texel have it, as
        the paper does.
    fit_gains, fit_haze
        Make cameras agree in exposure and white balance, and fit the haze before them.
    predicted_sigma
        As in `fit_radiometry`.
    guard
        Keep away from silhouettes.
    near_m
        Leave out pixels that show terrain nearer than this [m].
    tile_px
        Side of the tiles that are worked on one after the other.
    """

    mode: str = "weighted"
    fit_gains: bool = True
    fit_haze: bool = True
    predicted_sigma: float = 1.0
    guard: bool = True
    near_m: float = NEAR_M
    tile_px: int = TILE_PX

    def __post_init__(self):
        if self.mode not in MODES:
            raise ValueError(f"PaintOptions: mode {self.mode!r}, expected one of {', '.join(MODES)}")


def paint_atlas(
    inputs: Sequence[PaintingInput],
    terrain: Terrain,
    atlas: Atlas,
    ray_scene: RayScene,
    *,
    options: PaintOptions | None = None,
    predicted: np.ndarray | None = None,
    rejects: Sequence[np.ndarray | None] | None = None,
    radiance: float | None = None,
    resume: Path | None = None,
    progress: Progress | None = None,
) -> Painting:
    """Paint observations of one time into an atlas.

    Parameters
    ----------
    inputs
        In any order: in mode ``weighted`` it does not matter, in ``first`` it is the order of precedence.
    ray_scene
        The same terrain for rays (`gather_hemisphere.occluder`).
    predicted
        As in `fit_radiometry`.
    rejects
        For each shot a mask ``(H, W)`` bool of pixels to leave out, or ``None``; see `foreground.foreground_mask`.
    radiance
        As in `fit_radiometry`.
    resume
        A folder for finished tiles: a painting that was interrupted goes on from there. It belongs to these arguments
        alone; the caller names it by them.
    progress
        Called with the share that is done.

    Raises
    ------
    ValueError
        No shot at all, or none that sees any of the terrain; the message says why for each.
    """
    options, tell = options or PaintOptions(), progress or (lambda share: None)
    cut = tiling(terrain, atlas, tile_px=options.tile_px)
    ready, skipped = prepare_inputs(inputs, ray_scene, cut, options, rejects=rejects, progress=lambda s: tell(0.2 * s))
    if not ready:
        raise ValueError("paint: no picture has anything to paint: " + "; ".join(skipped or ["no pictures"]))
    if options.fit_gains:
        radiometry = fit_radiometry(
            ready,
            ray_scene,
            predicted=predicted,
            predicted_sigma=options.predicted_sigma,
            fit_haze=options.fit_haze,
            radiance=radiance,
        )
    else:
        radiometry = common_gain(ready, radiance=radiance)
    tell(0.3)
    painting = _blank(atlas, ready, radiometry, skipped)
    tiles = list(tiles_of(cut))
    for number, tile in enumerate(tiles):
        _place(
            painting,
            tile,
            _kept_tile(
                resume, tile, lambda tile=tile: paint_tile(ready, ray_scene, cut, tile, radiometry, options.mode)
            ),
        )
        tell(0.3 + 0.7 * (number + 1) / len(tiles))
    return painting


def prepare_inputs(
    inputs: Sequence[PaintingInput],
    ray_scene: RayScene,
    cut: AtlasTiling,
    options: PaintOptions,
    *,
    rejects: Sequence[np.ndarray | None] | None = None,
    progress: Progress | None = None,
) -> tuple[list[PreparedInput], list[str]]:
    """The shots that have something to paint, ready, and a line for each other one that says why it has not."""
    tell = progress or (lambda share: None)
    if rejects is not None and len(rejects) != len(inputs):
        raise ValueError(f"paint: {len(rejects)} masks for {len(inputs)} pictures")
    pairs = list(zip(inputs, rejects or [None] * len(inputs), strict=True))
    if options.mode == "weighted":
        # A sum in another order would differ in its last bits.
        pairs.sort(key=lambda pair: pair[0].key)
    ready, skipped = [], []
    for number, (item, reject) in enumerate(pairs):
        why = _unusable(item)
        if why is None:
            prepared = prepare_input(item, ray_scene, cut, near_m=options.near_m, reject=reject, guard=options.guard)
            if not np.isfinite(prepared.depth_m).any():
                why = "it sees none of the terrain"
            elif not prepared.confidence.any():
                why = "no usable pixel shows terrain"
            else:
                ready.append(prepared)
        if why is not None:
            skipped.append(f"{item.observation.webcam}: {why}")
        tell((number + 1) / len(pairs))
    return ready, skipped


def _unusable(item: PaintingInput) -> str | None:
    seen = item.observation
    if not seen.mask.any():
        return "its mask leaves no pixel"
    if not np.isfinite(seen.image[seen.mask]).all(axis=1).any():
        return "its picture holds no finite value"
    return None


@dataclass(frozen=True)
class _Painted:
    """What of a tile is painted; arrays as in `Painting`."""

    values: np.ndarray
    weight: np.ndarray
    best: np.ndarray
    coverage: np.ndarray


def paint_tile(
    ready: Sequence[PreparedInput],
    ray_scene: RayScene,
    cut: AtlasTiling,
    tile: AtlasTile,
    radiometry: RadiometricFit,
    mode: str = "weighted",
) -> _Painted:
    """One tile of a painting, from all shots that see any of it."""
    size = tile.height * tile.width
    total, most = np.zeros((size, 3)), np.zeros(size, np.float32)
    weights, best, coverage = np.zeros(size), np.full(size, -1, np.int16), np.zeros(size, np.uint8)
    those = [number for number, item in enumerate(ready) if sees_tile(item.blocks, tile)]
    surface = tile_surface(cut, tile) if those else None
    for number in those:
        texel, value, weight = input_texels(ready[number], number, ray_scene, surface, tile, radiometry)
        if mode == "first":
            free = best[texel] < 0
            texel, value, weight = texel[free], value[free], weight[free]
        share = sharpened(weight)
        total[texel] += share[:, None] * value
        weights[texel] += share
        better = weight > most[texel]
        best[texel[better]] = number
        most[texel[better]] = weight[better]
        coverage[texel] += 1
    painted = weights > 0.0
    values = np.zeros((size, 3), np.float32)
    values[painted] = total[painted] / weights[painted, None]
    shape = (tile.height, tile.width)
    return _Painted(values.reshape(*shape, 3), most.reshape(shape), best.reshape(shape), coverage.reshape(shape))


def input_texels(
    ready: PreparedInput, number: int, ray_scene: RayScene, surface, tile: AtlasTile, radiometry: RadiometricFit
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What one shot has to say about a tile: flat texels ``(N,)``, radiance ``(N, 3)`` [cd/m²] and weight ``(N,)``."""
    camera = ready.item.observation.camera
    surface = surface[tile_blocks(ready.blocks, tile, surface.texel)]
    sight = project_texels(camera, surface)
    index = np.flatnonzero(sight.inside)
    surface, sight = surface[index], sight[index]
    px_per_texel = camera.fx * surface.texel_m / np.maximum(sight.distance_m, 1e-3)
    value, confidence = sample_input(ready, sight.pixel, texel_extent_px(camera, surface, sight))
    weight = texel_weight(sight.cosine, px_per_texel) * confidence
    keep = np.flatnonzero(weight > _LEAST_WEIGHT)
    # Rays last: only for texels that something could be painted into.
    keep = keep[by_ray(ray_scene, camera, surface[keep], sight[keep])]
    radiance, share = radiance_at_surface(value[keep], number, air_to(ready, surface.position_m[keep]), radiometry)
    return surface.texel[keep], radiance, weight[keep] * share**2


def _blank(
    atlas: Atlas, ready: Sequence[PreparedInput], radiometry: RadiometricFit, skipped: Sequence[str]
) -> Painting:
    shape = (atlas.height_px, atlas.width_px)
    texture = Texture(np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32))
    names = tuple(item.item.observation.webcam for item in ready)
    return Painting(texture, np.full(shape, -1, np.int16), np.zeros(shape, np.uint8), names, radiometry, tuple(skipped))


def _place(painting: Painting, tile: AtlasTile, part: _Painted) -> None:
    rows, columns = tile.window
    painting.texture.values[rows, columns] = part.values
    painting.texture.weight[rows, columns] = part.weight
    painting.best[rows, columns] = part.best
    painting.coverage[rows, columns] = part.coverage


def _kept_tile(folder: Path | None, tile: AtlasTile, build: Callable[[], _Painted]) -> _Painted:
    """A tile from the folder of finished ones, or painted and put there."""
    if folder is None:
        return build()
    path = folder / f"{tile.name}.npz"
    if path.is_file():
        with np.load(path, allow_pickle=False) as stored:
            return _Painted(*(stored[name] for name in _Painted.__dataclass_fields__))
    part = build()
    with atomic_path(path) as temporary:
        np.savez(temporary, **{name: getattr(part, name) for name in _Painted.__dataclass_fields__})
    return part
