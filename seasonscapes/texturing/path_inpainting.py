"""Algorithm 1 of the SeasonScapes paper: along a path, an image model paints what no camera saw, view by view.

Each view shows the texture as it is by then; the model paints the holes of that picture; what it painted goes back to the
texels that the view truly sees and that still are holes. Painted texels are never touched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from seasonscapes.cameras.observation import Observation
from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.images import linear_from_srgb
from seasonscapes.rendering.gbuffer import GBuffer, trace_gbuffer
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.rendering.mitsuba_scene import RenderScene
from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.atlas_tiles import AtlasTiling, sees_tile, tile_surface, tiles_of
from seasonscapes.texturing.inputs import PaintingInput, prepare_input
from seasonscapes.texturing.painting import input_texels
from seasonscapes.texturing.path_steps import PathStep, levels_of, load_step, save_step
from seasonscapes.texturing.radiometric_fit import RadiometricFit
from seasonscapes.texturing.smooth_fill import push_pull
from seasonscapes.texturing.view_conditions import (
    MASKS,
    Conditions,
    decode,
    depth_picture,
    dilated,
    encode,
    look_up,
    plain_sky,
    red_pixels,
    white_radiance,
)

# An image model: paints the hole of a view, sRGB-encoded ``(H, W, 3)``. The second argument is told the share done.
Inpaint = Callable[[Conditions, Callable[[float], None]], np.ndarray]
# Shots are trusted less where they are clipped; a model's white is no clipping.
_HEADROOM = 0.85
# Views with a smaller share of holes than this are asked first whether they can give any texel a value.
_FEW_HOLES = 0.02
_RED = np.array([1.0, 0.0, 0.0], np.float32)


@dataclass(frozen=True)
class PathInpaintingInputs:
    """What to go over.

    Parameters
    ----------
    texture
        Painted radiance; ``weight`` 0 marks holes.
    cameras
        The path, in order.
    cut
        The atlas in tiles, with its terrain.
    terrain
        The same terrain for rays.
    base
        ``(R, S, 3)`` a completion that holes show instead of a guess (*hybrid*: the model only adds detail), or ``None``.
    """

    texture: Texture
    cameras: Sequence[Camera]
    cut: AtlasTiling
    terrain: RayScene
    base: np.ndarray | None = None


@dataclass(frozen=True)
class PathInpaintingOptions:
    """How to go.

    Parameters
    ----------
    mask
        ``coverage``, or ``hsv``: red pixels, as the reference implementation does.
    dilate_px
        The model repaints this much around a hole, so that it can join what it paints; none of that is kept.
    least_share
        Views with a smaller share of the land to paint are skipped.
    paint_sky
        Let the model paint the sky too (it never reaches the texture); off, it is shown a plain one.
    cloudiness
        Of the plain sky.
    seed
        Equal seeds give equal textures; each view draws its own from it.
    """

    mask: str = "coverage"
    dilate_px: int = 8
    least_share: float = 0.001
    paint_sky: bool = False
    cloudiness: float = 0.0
    seed: int = 0

    def __post_init__(self):
        if self.mask not in MASKS:
            raise ValueError(f"WalkOptions: mask {self.mask!r}, expected one of {', '.join(MASKS)}")
        if self.dilate_px < 0 or not 0.0 <= self.least_share <= 1.0:
            raise ValueError("WalkOptions: dilate_px must not be negative, and least_share between 0 and 1")


class InpaintingState:
    """The texture while it is being walked over: values, what is covered, and what the model gave."""

    def __init__(self, texture: Texture):
        self.painted = (texture.weight > 0.0) & np.isfinite(texture.values).all(axis=2)
        self.values = np.where(self.painted[..., None], texture.values, 0.0).astype(np.float32)
        self.covered = self.painted.copy()

    @property
    def imagined(self) -> np.ndarray:
        """Texels ``(R, S)`` bool that the model gave a value."""
        return self.covered & ~self.painted

    def texture(self) -> Texture:
        """All that has a value by now; weight 1 there."""
        return Texture(self.values.copy(), self.covered.astype(np.float32))

    def superpose(self, step: PathStep) -> None:
        """Add a view's texels; one that is covered already is a mistake, not a choice."""
        flat = self.covered.reshape(-1)
        if flat[step.texels].any():
            raise ValueError(f"view {step.index} would overwrite texels that have a value")
        self.values.reshape(-1, 3)[step.texels] = step.values
        flat[step.texels] = True


def inpaint_along_path(
    inputs: PathInpaintingInputs,
    state: InpaintingState,
    inpaint: Inpaint,
    options: PathInpaintingOptions,
    *,
    folder: Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> Iterator[PathStep]:
    """Go along the path and paint; yields each view when the canvas has it.

    Parameters
    ----------
    state
        Of ``walk.texture``; it is filled.
    inpaint
        The image model.
    folder
        Keeps finished views and their pictures (partial, mask, depth, result). A walk that was interrupted goes on from
        there with the same result; the folder belongs to these arguments alone, its name is the caller's to choose.
    progress
        Called with the share that is done.

    Raises
    ------
    ValueError
        No painted texel, or a model that returns a picture of another size or values that are not finite.
    """
    if not state.painted.any():
        raise ValueError("walk_path: no painted texel: there is nothing to go on")
    tell = progress or (lambda share: None)
    white = white_radiance(state.values, state.painted)
    count = len(inputs.cameras)
    for index in range(count):
        step = load_step(folder, index)
        if step is None:
            step, pictures = _paint_view(
                inputs, state, inpaint, options, index, white, lambda share, index=index: tell((index + share) / count)
            )
            if folder is not None:
                save_step(folder, step, pictures)
        state.superpose(step)
        tell((index + 1) / count)
        yield step


def _paint_view(
    inputs: PathInpaintingInputs,
    state: InpaintingState,
    inpaint: Inpaint,
    options: PathInpaintingOptions,
    index: int,
    white: float,
    tell: Callable[[float], None],
) -> tuple[PathStep, dict[str, np.ndarray]]:
    """One round of the loop; and the pictures that show it."""
    camera = inputs.cameras[index]
    gbuffer = trace_gbuffer(RenderScene(inputs.terrain.mi_scene, inputs.terrain.mi_terrain, None, 0.0), camera)  # type: ignore[arg-type]
    land = np.isfinite(gbuffer.depth)
    partial, hole = partial_view(inputs, state, gbuffer, options, white)
    share = float(hole.sum() / max(land.sum(), 1))
    sky = plain_sky(ray_directions(camera), cloudiness=options.cloudiness)
    shown = np.where(land[..., None], partial, sky)
    nothing = np.empty(0, np.int64), np.empty((0, 3), np.float32)
    if not hole.any() or share < options.least_share or _in_vain(inputs, state, camera, shown, share, white):
        return PathStep(index, share, *nothing, levels_of(shown), True), {}
    wanted = hole | ~land if options.paint_sky else hole
    guess = _guessed(inputs, gbuffer, shown, wanted, hole, white)
    mask = dilated(wanted, options.dilate_px)
    depth = depth_picture(gbuffer.depth)
    seed = int(np.random.SeedSequence((options.seed, index)).generate_state(1, np.uint64)[0] >> 1)
    result = np.asarray(inpaint(Conditions(guess, mask, depth, seed), tell), np.float32)
    if result.shape != shown.shape or not np.isfinite(result).all():
        raise ValueError(f"view {index}: the image model returned {result.shape}, or values that are not finite")
    composed = np.where(wanted[..., None], np.clip(result, 0.0, 1.0), shown)
    texels, values = back_project(inputs, state, camera, composed, white)
    hidden = np.where(hole[..., None], np.float32(0.0), shown)
    pictures = {"partial": hidden, "mask": mask.astype(np.float32), "depth": depth}
    return PathStep(index, share, texels, values, levels_of(composed), False), pictures


def _in_vain(
    inputs: PathInpaintingInputs, state: InpaintingState, camera: Camera, shown: np.ndarray, share: float, white: float
) -> bool:
    """Whether all that a view could paint lies beside silhouettes, where nothing is taken from it: hours for nothing."""
    return share < _FEW_HOLES and len(back_project(inputs, state, camera, shown, white)[0]) == 0


def partial_view(
    inputs: PathInpaintingInputs, state: InpaintingState, gbuffer: GBuffer, options: PathInpaintingOptions, white: float
) -> tuple[np.ndarray, np.ndarray]:
    """The land as far as it has values, sRGB-encoded ``(H, W, 3)``, and its holes ``(H, W)`` bool."""
    land = np.isfinite(gbuffer.depth)
    radiance, known = look_up(state.values, state.covered, gbuffer.uv)
    picture = encode(radiance, white)
    hole = land & ~known
    if options.mask == "hsv":
        hole = land & red_pixels(np.where(hole[..., None], _RED, picture))
    return picture, hole


def _guessed(
    inputs: PathInpaintingInputs,
    gbuffer: GBuffer,
    shown: np.ndarray,
    wanted: np.ndarray,
    hole: np.ndarray,
    white: float,
) -> np.ndarray:
    """The picture with something in its holes: a completion's colours, or those of the rims."""
    known = ~wanted
    picture = shown
    if inputs.base is not None:
        fill, _ = look_up(inputs.base, np.ones(inputs.base.shape[:2], bool), gbuffer.uv)
        picture = np.where(hole[..., None], encode(fill, white), picture)
        known = known | hole
    if not known.any():
        return np.full_like(picture, 0.5)
    return np.where(known[..., None], picture, push_pull(picture, known.astype(np.float32))).astype(np.float32)


def back_project(
    inputs: PathInpaintingInputs, state: InpaintingState, camera: Camera, picture: np.ndarray, white: float
) -> tuple[np.ndarray, np.ndarray]:
    """What a picture tells of the holes that its camera truly sees: flat texels ``(N,)`` and radiance ``(N, 3)``.

    By one ray a texel, sampled without aliasing and away from silhouettes, as painting does.
    """
    linear = decode(picture, 1.0) * _HEADROOM
    everywhere = np.ones(picture.shape[:2], bool)
    item = PaintingInput(Observation(linear, everywhere, camera, datetime(2000, 1, 1, tzinfo=UTC), "path"))
    ready = prepare_input(item, inputs.terrain, inputs.cut, near_m=0.0)
    same = np.full((1, 3), np.log(_HEADROOM / white))
    radiometry = RadiometricFit(same, same, np.ones(1))
    texels, values = [], []
    for tile in tiles_of(inputs.cut):
        rows, columns = tile.window
        open_ = ~state.covered[rows, columns].ravel()
        if not sees_tile(ready.blocks, tile) or not open_.any():
            continue
        surface = tile_surface(inputs.cut, tile)
        local, radiance, _ = input_texels(ready, 0, inputs.terrain, surface[open_[surface.texel]], tile, radiometry)
        row, column = tile.row + local // tile.width, tile.column + local % tile.width
        texels.append(row * inputs.cut.width_px + column)
        values.append(radiance)
    if not texels:
        return np.empty(0, np.int64), np.empty((0, 3), np.float32)
    return np.concatenate(texels), np.concatenate(values).astype(np.float32)


def frames_of(
    values: np.ndarray, cameras: Sequence[Camera], terrain: RayScene, white: float, *, cloudiness: float = 0.0
) -> Iterator[np.ndarray]:
    """Display-linear frames ``(H, W, 3)`` of a finished texture ``(R, S, 3)`` along a path, one at a time."""
    scene = RenderScene(terrain.mi_scene, terrain.mi_terrain, None, 0.0)  # type: ignore[arg-type]
    everywhere = np.ones(values.shape[:2], bool)
    for camera in cameras:
        gbuffer = trace_gbuffer(scene, camera)
        radiance, _ = look_up(values, everywhere, gbuffer.uv)
        sky = plain_sky(ray_directions(camera), cloudiness=cloudiness)
        land = np.isfinite(gbuffer.depth)[..., None]
        yield linear_from_srgb(np.where(land, encode(radiance, white), sky))
