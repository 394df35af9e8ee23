"""Projection of photographs into a texture atlas: per-texel radiance of the terrain [cd/m²], blended over cameras."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from seasonscapes.array_files import read_arrays
from seasonscapes.errors import InputError, NoUsablePixels
from seasonscapes.images import atomic_path
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.terrain.atlas import Atlas
from seasonscapes.terrain.surface import Terrain, Texture
from seasonscapes.texturing.atlas_tiles import (
    TILE_PX,
    AtlasTile,
    AtlasTiling,
    TexelSurface,
    is_tile_visible,
    tile_blocks,
    tile_surface,
    tiles_of,
    tiling,
)
from seasonscapes.texturing.inputs import (
    NEAR_M,
    PaintingInput,
    PreparedInput,
    prepare_input,
    sample_input,
    texel_extent_px,
    transmittance_and_airlight,
)
from seasonscapes.texturing.radiometric_fit import (
    RadiometricFit,
    RadiometricReference,
    common_gain,
    fit_radiometry,
    radiance_at_surface,
)
from seasonscapes.texturing.texel_weights import sharpened, texel_weight
from seasonscapes.texturing.visibility import project_texels, visible_by_ray

log = logging.getLogger(__name__)

PAINT_MODES = ("weighted", "first")
Progress = Callable[[float], None]
# A camera with a smaller weight does not paint a texel.
_MIN_WEIGHT = 1e-4


@dataclass(frozen=True)
class Painting:
    """A texture painted from photographs.

    Parameters
    ----------
    texture
        Radiance ``(R, S, 3)`` [cd/m²] at the surface, without the air; relative where no sky fixes the scale.
        ``weight`` is the greatest of the cameras' weights, 0 where none painted.
    best
        ``(R, S)`` int16 index into ``webcams`` of the camera with the greatest weight (in mode ``first``, of the camera
        that painted the texel); −1 where none did.
    coverage
        ``(R, S)`` uint16 number of contributing cameras.
    webcams
        Names of the cameras used.
    radiometry
        Their gains, contrasts and common haze, in the same order.
    skipped
        One line for each input that was not used: name and reason.
    """

    texture: Texture
    best: np.ndarray
    coverage: np.ndarray
    webcams: tuple[str, ...]
    radiometry: RadiometricFit
    skipped: tuple[str, ...]


@dataclass(frozen=True)
class PaintOptions:
    """Options of `paint_atlas`.

    Parameters
    ----------
    mode
        ``weighted`` blends cameras by sharpened weights; ``first`` takes the first camera in order that the texel is
        visible from, as the paper does.
    fit_gains, fit_haze
        Fit each camera's exposure and white balance, and the common haze.
    guard
        Reduce the confidence of pixels near silhouettes.
    near_m
        Exclude pixels that show terrain nearer than this [m].
    tile_px
        Side of the tiles that are processed one after the other [texels].
    foreground
        Look for houses and masts, which the terrain lacks, and leave them out. `seasonscapes.paint` does; here the masks
        are given as ``rejects``.

    Raises
    ------
    ValueError
        Unknown mode.
    """

    mode: str = "weighted"
    fit_gains: bool = True
    fit_haze: bool = True
    guard: bool = True
    near_m: float = NEAR_M
    tile_px: int = TILE_PX
    foreground: bool = False

    def __post_init__(self):
        if self.mode not in PAINT_MODES:
            raise ValueError(f"PaintOptions: mode {self.mode!r}, expected one of {', '.join(PAINT_MODES)}")


@dataclass(frozen=True)
class PaintTarget:
    """The surface and atlas that photographs are projected to.

    Parameters
    ----------
    terrain
        The surface with its texture coordinates.
    atlas
        Size of the atlas.
    ray_scene
        Ray-tracing scene of the same terrain (`hemisphere_rays.ray_scene`).
    """

    terrain: Terrain
    atlas: Atlas
    ray_scene: RayScene


def paint_atlas(
    inputs: Sequence[PaintingInput],
    target: PaintTarget,
    *,
    options: PaintOptions | None = None,
    reference: RadiometricReference | None = None,
    rejects: Sequence[np.ndarray | None] | None = None,
    resume: Path | None = None,
    progress: Progress | None = None,
) -> Painting:
    """Paint photographs of one time into an atlas.

    Parameters
    ----------
    inputs
        Photographs. Their order is irrelevant in mode ``weighted`` and the order of precedence in mode ``first``.
    target
        Terrain and atlas to paint.
    options
        Defaults to `PaintOptions()`.
    reference
        Predicted radiance and scale for `fit_radiometry`; defaults to `RadiometricReference()`.
    rejects
        For each input a mask ``(H, W)`` bool of pixels to exclude, or ``None``; see `foreground.foreground_mask`.
    resume
        Folder for finished tiles, from which an interrupted call continues. It must be specific to these arguments;
        the caller chooses its name.
    progress
        Called with the finished fraction.

    Returns
    -------
    Painting
        Radiance, weights and the fitted radiometry.

    Raises
    ------
    NoUsablePixels
        No input, or none with a usable pixel of terrain; the message gives the reason for each.
    ValueError
        ``rejects`` and ``inputs`` differ in number, or ``options.foreground`` without them.
    """
    options, report = options or PaintOptions(), progress or (lambda fraction: None)
    if options.foreground and rejects is None:
        raise ValueError("paint_atlas: options.foreground: give the masks as rejects, or use seasonscapes.paint")
    reference, ray_scene = reference or RadiometricReference(), target.ray_scene
    atlas_tiling = tiling(target.terrain, target.atlas, tile_px=options.tile_px)
    prepared, skipped = prepare_inputs(
        inputs, ray_scene, atlas_tiling, options, rejects=rejects, progress=lambda fraction: report(0.2 * fraction)
    )
    if not prepared:
        raise NoUsablePixels(
            "paint: no photograph has usable pixels: " + "; ".join(skipped or ["no photographs given"])
        )
    if options.fit_gains:
        radiometry = fit_radiometry(prepared, ray_scene, reference=reference, fit_haze=options.fit_haze)
    else:
        radiometry = common_gain(prepared, radiance=reference.radiance)
    report(0.3)
    painting = _empty_painting(target.atlas, prepared, radiometry, skipped)
    tiles = list(tiles_of(atlas_tiling))
    for number, tile in enumerate(tiles):
        painted_tile = _load_or_paint(
            resume,
            tile,
            lambda tile=tile: paint_tile(prepared, ray_scene, atlas_tiling, tile, radiometry, options.mode),
        )
        _write_tile(painting, tile, painted_tile)
        report(0.3 + 0.7 * (number + 1) / len(tiles))
    return painting


def prepare_inputs(
    inputs: Sequence[PaintingInput],
    ray_scene: RayScene,
    atlas_tiling: AtlasTiling,
    options: PaintOptions,
    *,
    rejects: Sequence[np.ndarray | None] | None = None,
    progress: Progress | None = None,
) -> tuple[list[PreparedInput], list[str]]:
    """Prepare the inputs that show usable terrain, and give the reason for each other one.

    Parameters
    ----------
    inputs
        Photographs.
    ray_scene
        Ray-tracing scene of the terrain.
    atlas_tiling
        The atlas in tiles, with the same terrain.
    options
        Options of `paint_atlas`.
    rejects
        As in `paint_atlas`.
    progress
        Called with the finished fraction.

    Returns
    -------
    prepared
        The usable inputs; sorted in mode ``weighted``, else in the given order.
    skipped
        One line for each other input: name and reason.

    Raises
    ------
    ValueError
        ``rejects`` and ``inputs`` differ in number.
    """
    report = progress or (lambda fraction: None)
    if rejects is not None and len(rejects) != len(inputs):
        raise ValueError(f"paint: got {len(rejects)} reject masks for {len(inputs)} photographs")
    pairs = list(zip(inputs, rejects or [None] * len(inputs), strict=True))
    if options.mode == "weighted":
        # Floating-point sums depend on the order of their terms.
        pairs.sort(key=lambda pair: pair[0].key)
    prepared_inputs, skipped = [], []
    for number, (painting_input, reject) in enumerate(pairs):
        reason = _unusable(painting_input)
        if reason is None:
            prepared = prepare_input(
                painting_input, ray_scene, atlas_tiling, near_m=options.near_m, reject=reject, guard=options.guard
            )
            if not np.isfinite(prepared.depth_m).any():
                reason = "no terrain in view"
            elif not prepared.confidence.any():
                reason = "no usable pixel shows terrain"
            else:
                prepared_inputs.append(prepared)
        if reason is not None:
            skipped.append(f"{painting_input.observation.webcam}: {reason}")
        report((number + 1) / len(pairs))
    return prepared_inputs, skipped


def _unusable(painting_input: PaintingInput) -> str | None:
    """Reason why an input has no usable pixel, whatever it shows, or ``None``."""
    observation = painting_input.observation
    if not observation.mask.any():
        return "its mask excludes every pixel"
    if not np.isfinite(observation.image[observation.mask]).all(axis=1).any():
        return "its image has no finite pixel"
    return None


@dataclass(frozen=True)
class _PaintedTile:
    """Painted texels of one tile; arrays as in `Painting`."""

    values: np.ndarray
    weight: np.ndarray
    best: np.ndarray
    coverage: np.ndarray


def paint_tile(
    prepared: Sequence[PreparedInput],
    ray_scene: RayScene,
    atlas_tiling: AtlasTiling,
    tile: AtlasTile,
    radiometry: RadiometricFit,
    mode: str = "weighted",
) -> _PaintedTile:
    """Paint one tile from all inputs that any of it is visible in.

    Parameters
    ----------
    prepared
        All inputs.
    ray_scene
        Ray-tracing scene of the terrain.
    atlas_tiling
        The atlas in tiles.
    tile
        The tile to paint.
    radiometry
        Gains, contrasts and haze of the inputs.
    mode
        As in `PaintOptions`.

    Returns
    -------
    _PaintedTile
        Arrays ``(height, width)`` as in `Painting`.
    """
    size = tile.height * tile.width
    weighted_sum, greatest = np.zeros((size, 3)), np.zeros(size, np.float32)
    weights, best, coverage = np.zeros(size), np.full(size, -1, np.int16), np.zeros(size, np.uint16)
    visible = [number for number, candidate in enumerate(prepared) if is_tile_visible(candidate.blocks, tile)]
    surface = tile_surface(atlas_tiling, tile) if visible else None
    for number in visible:
        assert surface is not None
        texel, value, weight = input_texels(prepared[number], number, ray_scene, surface, tile, radiometry)
        if mode == "first":
            free = best[texel] < 0
            texel, value, weight = texel[free], value[free], weight[free]
        blending = sharpened(weight)
        weighted_sum[texel] += blending[:, None] * value
        weights[texel] += blending
        better = weight > greatest[texel]
        best[texel[better]] = number
        greatest[texel[better]] = weight[better]
        coverage[texel] += 1
    painted = weights > 0.0
    values = np.zeros((size, 3), np.float32)
    values[painted] = weighted_sum[painted] / weights[painted, None]
    shape = (tile.height, tile.width)
    return _PaintedTile(
        values.reshape(*shape, 3), greatest.reshape(shape), best.reshape(shape), coverage.reshape(shape)
    )


def input_texels(
    prepared: PreparedInput,
    number: int,
    ray_scene: RayScene,
    surface: TexelSurface,
    tile: AtlasTile,
    radiometry: RadiometricFit,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute radiance and weight of a tile's texels from one input.

    Parameters
    ----------
    prepared
        The input.
    number
        Its index in ``radiometry``.
    ray_scene
        Ray-tracing scene of the terrain.
    surface
        Surface points of the tile's texels, or of some of them.
    tile
        The tile.
    radiometry
        Gains, contrasts and haze.

    Returns
    -------
    texel
        ``(N,)`` flat indices in the tile of the texels that the input paints.
    radiance
        ``(N, 3)`` [cd/m²].
    weight
        ``(N,)`` in (0, 1].
    """
    camera = prepared.painting_input.camera
    surface = surface[tile_blocks(prepared.blocks, tile, surface.texel)]
    projected = project_texels(camera, surface)
    index = np.flatnonzero(projected.inside)
    surface, projected = surface[index], projected[index]
    px_per_texel = camera.fx * surface.texel_m / np.maximum(projected.distance_m, 1e-3)
    value, confidence = sample_input(prepared, projected.pixel, texel_extent_px(camera, surface, projected))
    weight = texel_weight(projected.cosine, px_per_texel) * confidence
    keep = np.flatnonzero(weight > _MIN_WEIGHT)
    # Shadow rays are the costliest test and come last.
    keep = keep[visible_by_ray(ray_scene, camera, surface[keep], projected[keep])]
    air = transmittance_and_airlight(prepared, surface.position_m[keep])
    radiance, surface_share = radiance_at_surface(value[keep], number, air, radiometry)
    return surface.texel[keep], radiance, weight[keep] * surface_share**2


def _empty_painting(
    atlas: Atlas, prepared: Sequence[PreparedInput], radiometry: RadiometricFit, skipped: Sequence[str]
) -> Painting:
    shape = (atlas.height_px, atlas.width_px)
    texture = Texture(np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32))
    names = tuple(used.painting_input.observation.webcam for used in prepared)
    best, coverage = np.full(shape, -1, np.int16), np.zeros(shape, np.uint16)
    return Painting(texture, best, coverage, names, radiometry, tuple(skipped))


def _write_tile(painting: Painting, tile: AtlasTile, painted_tile: _PaintedTile) -> None:
    rows, columns = tile.window
    painting.texture.values[rows, columns] = painted_tile.values
    painting.texture.weight[rows, columns] = painted_tile.weight
    painting.best[rows, columns] = painted_tile.best
    painting.coverage[rows, columns] = painted_tile.coverage


def _load_or_paint(folder: Path | None, tile: AtlasTile, paint: Callable[[], _PaintedTile]) -> _PaintedTile:
    """Load a finished tile from the folder, or paint and store it."""
    if folder is None:
        return paint()
    path = folder / f"{tile.name}.npz"
    if path.is_file():
        try:
            stored = read_arrays(path, _PaintedTile.__dataclass_fields__, what="a painted tile")
            return _PaintedTile(*(stored[name] for name in _PaintedTile.__dataclass_fields__))
        except InputError as error:
            log.info("%s; it is painted again", error)
    painted_tile = paint()
    with atomic_path(path) as temporary:
        np.savez(temporary, **{name: getattr(painted_tile, name) for name in _PaintedTile.__dataclass_fields__})
    return painted_tile
