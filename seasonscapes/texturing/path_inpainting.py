"""Inpainting of a texture along a camera path by an image model, view by view (algorithm 1 of the SeasonScapes paper).

Each view is rendered from the texture in its present state. The image model inpaints the holes of the picture, and the
result is projected back to those texels that are visible from the camera and still have no value. Texels painted from
photographs never change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from seasonscapes.cameras.observation import Observation
from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.errors import NotEnoughEvidence
from seasonscapes.images import linear_from_srgb
from seasonscapes.rendering.gbuffer import GBuffer, trace_gbuffer
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.atlas_tiles import AtlasTiling, is_tile_visible, tile_surface, tiles_of
from seasonscapes.texturing.inputs import PaintingInput, prepare_input, unlit_scene
from seasonscapes.texturing.painting import input_texels
from seasonscapes.texturing.path_steps import PathStep, load_step, save_step, to_uint8
from seasonscapes.texturing.radiometric_fit import RadiometricFit
from seasonscapes.texturing.smooth_fill import push_pull
from seasonscapes.texturing.view_conditions import (
    MASKS,
    ViewConditions,
    decode,
    depth_picture,
    dilated,
    encode,
    plain_sky,
    red_pixels,
    sample_covered,
    white_radiance,
)

# An image model: returns a view with its hole inpainted, sRGB-encoded ``(H, W, 3)``. The second argument is called with
# the finished fraction.
ImageModel = Callable[[ViewConditions, Callable[[float], None]], np.ndarray]
# Factor that keeps white of the image model below the exposure limit above which photographs count as clipped.
_HEADROOM = 0.85
# Where a smaller fraction of the terrain is a hole, a view is first tested for texels that it can give a value.
_FEW_HOLES = 0.02
_RED = np.array([1.0, 0.0, 0.0], np.float32)


@dataclass(frozen=True)
class PathInpaintingInputs:
    """Texture, path and terrain of `inpaint_along_path`.

    Parameters
    ----------
    texture
        Painted radiance [cd/m²]; ``weight`` 0 marks holes.
    cameras
        Views of the path, in order.
    tiling
        The atlas in tiles, with its terrain.
    terrain
        Ray-tracing scene of the same terrain.
    base
        ``(R, S, 3)`` completed radiance [cd/m²] as the initial estimate in holes (*hybrid*: the model only adds
        detail), or ``None``.
    white
        Radiance that pictures show as white [cd/m²]; ``None`` takes it from the painted texels.
    """

    texture: Texture
    cameras: Sequence[Camera]
    tiling: AtlasTiling
    terrain: RayScene
    base: np.ndarray | None = None
    white: float | None = None


@dataclass(frozen=True)
class PathInpaintingOptions:
    """Options of `inpaint_along_path`.

    Parameters
    ----------
    mask
        ``coverage``, or ``hsv``: red pixels, as in the reference implementation.
    dilate_px
        Dilation of the hole that the model repaints for a smooth transition [px]; nothing of it is kept.
    least_share
        Views in which a smaller fraction of the terrain is a hole are skipped.
    paint_sky
        Let the model paint the sky too, which never enters the texture; otherwise it is given a plain sky.
    cloudiness
        Of the plain sky, in [0, 1].
    seed
        Base seed; each view derives its own.

    Raises
    ------
    ValueError
        Unknown mask, negative dilation, or a fraction outside [0, 1].
    """

    mask: str = "coverage"
    dilate_px: int = 8
    least_share: float = 0.001
    paint_sky: bool = False
    cloudiness: float = 0.0
    seed: int = 0

    def __post_init__(self):
        if self.mask not in MASKS:
            raise ValueError(f"PathInpaintingOptions: mask {self.mask!r}, expected one of {', '.join(MASKS)}")
        if self.dilate_px < 0 or not 0.0 <= self.least_share <= 1.0:
            raise ValueError(
                "PathInpaintingOptions: dilate_px must not be negative, and least_share must lie between 0 and 1"
            )


class InpaintingState:
    """State of a texture during path inpainting.

    Parameters
    ----------
    texture
        Painted radiance; ``weight`` 0 marks holes.

    Attributes
    ----------
    painted
        ``(R, S)`` bool: texels painted from photographs.
    values
        ``(R, S, 3)`` float32 radiance [cd/m²]; 0 where there is none yet.
    covered
        ``(R, S)`` bool: texels with a value.
    """

    def __init__(self, texture: Texture):
        self.painted: np.ndarray = (texture.weight > 0.0) & np.isfinite(texture.values).all(axis=2)
        self.values = np.where(self.painted[..., None], texture.values, 0.0).astype(np.float32)
        self.covered = self.painted.copy()

    @property
    def generated(self) -> np.ndarray:
        """Texels ``(R, S)`` bool with a value from the image model."""
        return self.covered & ~self.painted

    def texture(self) -> Texture:
        """Return the present texture, with weight 1 where it has a value."""
        return Texture(self.values.copy(), self.covered.astype(np.float32))

    def superpose(self, step: PathStep) -> None:
        """Add the texels of one view.

        Parameters
        ----------
        step
            Result of the view.

        Raises
        ------
        ValueError
            A texel of the view has a value already.
        """
        flat = self.covered.reshape(-1)
        if flat[step.texels].any():
            raise ValueError(f"view {step.index} would overwrite texels that have a value")
        self.values.reshape(-1, 3)[step.texels] = step.values
        flat[step.texels] = True


def inpaint_along_path(
    inputs: PathInpaintingInputs,
    state: InpaintingState,
    image_model: ImageModel,
    options: PathInpaintingOptions,
    *,
    folder: Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> Iterator[PathStep]:
    """Inpaint the views of a path one after the other, yielding each step once the state contains it.

    Parameters
    ----------
    inputs
        Texture, path and terrain.
    state
        State of ``inputs.texture``; it is updated in place.
    image_model
        Inpaints the holes of each view.
    options
        Mask, thresholds and seed.
    folder
        Folder for finished steps and their pictures (partial, mask, depth, result). An interrupted call continues from
        there with the same result. The folder must be specific to these arguments; the caller chooses its name.
    progress
        Called with the finished fraction.

    Yields
    ------
    PathStep
        One per view.

    Raises
    ------
    NotEnoughEvidence
        The texture has no painted texel, and no radiance of white is given.
    ValueError
        The model returns a picture of another size or values that are not finite.
    """
    if inputs.white is None and not state.painted.any():
        raise NotEnoughEvidence("inpaint_along_path: no painted texel: there is nothing to continue from")
    report = progress or (lambda fraction: None)
    white = white_radiance(state.values, state.painted) if inputs.white is None else inputs.white
    count = len(inputs.cameras)
    for index in range(count):
        step = load_step(folder, index)
        if step is None:

            def report_view(fraction: float, index: int = index) -> None:
                report((index + fraction) / count)

            step, pictures = _inpaint_view(inputs, state, image_model, options, index, white, report_view)
            if folder is not None:
                save_step(folder, step, pictures)
        state.superpose(step)
        report((index + 1) / count)
        yield step


def _inpaint_view(
    inputs: PathInpaintingInputs,
    state: InpaintingState,
    image_model: ImageModel,
    options: PathInpaintingOptions,
    index: int,
    white: float,
    report: Callable[[float], None],
) -> tuple[PathStep, dict[str, np.ndarray]]:
    """Result of one view, and its pictures by name."""
    camera = inputs.cameras[index]
    gbuffer = trace_gbuffer(unlit_scene(inputs.terrain), camera)
    terrain = np.isfinite(gbuffer.depth)
    partial, hole = partial_view(state, gbuffer, options, white)
    hole_share = float(hole.sum() / max(terrain.sum(), 1))
    sky = plain_sky(ray_directions(camera), cloudiness=options.cloudiness)
    shown = np.where(terrain[..., None], partial, sky)
    if (
        not hole.any()
        or hole_share < options.least_share
        or (hole_share < _FEW_HOLES and len(back_project(inputs, state, camera, shown, white)[0]) == 0)
    ):
        # The last condition: all holes lie near silhouettes, where nothing would be projected back.
        no_texels, no_values = np.empty(0, np.int64), np.empty((0, 3), np.float32)
        return PathStep(index, hole_share, no_texels, no_values, to_uint8(shown), True), {}
    target = hole | ~terrain if options.paint_sky else hole
    initial = _initial_picture(inputs, gbuffer, shown, target, hole, white)
    mask = dilated(target, options.dilate_px)
    depth = depth_picture(gbuffer.depth)
    seed = int(np.random.SeedSequence((options.seed, index)).generate_state(1, np.uint64)[0] >> 1)
    result = np.asarray(image_model(ViewConditions(initial, mask, depth, seed), report), np.float32)
    if result.shape != shown.shape or not np.isfinite(result).all():
        raise ValueError(f"view {index}: the image model returned {result.shape}, or values that are not finite")
    composed = np.where(target[..., None], np.clip(result, 0.0, 1.0), shown)
    texels, values = back_project(inputs, state, camera, composed, white)
    visible = np.where(hole[..., None], np.float32(0.0), shown)
    pictures = {"partial": visible, "mask": mask.astype(np.float32), "depth": depth}
    return PathStep(index, hole_share, texels, values, to_uint8(composed), False), pictures


def partial_view(
    state: InpaintingState, gbuffer: GBuffer, options: PathInpaintingOptions, white: float
) -> tuple[np.ndarray, np.ndarray]:
    """Render the terrain from the texels that have a value.

    Parameters
    ----------
    state
        Present texture.
    gbuffer
        Of the view.
    options
        Which mask to use.
    white
        Radiance of white [cd/m²].

    Returns
    -------
    picture
        ``(H, W, 3)`` float32, sRGB-encoded.
    hole
        ``(H, W)`` bool: terrain pixels without a value.
    """
    terrain = np.isfinite(gbuffer.depth)
    radiance, known = sample_covered(state.values, state.covered, gbuffer.uv)
    picture = encode(radiance, white)
    hole = terrain & ~known
    if options.mask == "hsv":
        hole = terrain & red_pixels(np.where(hole[..., None], _RED, picture))
    return picture, hole


def _initial_picture(
    inputs: PathInpaintingInputs,
    gbuffer: GBuffer,
    shown: np.ndarray,
    target: np.ndarray,
    hole: np.ndarray,
    white: float,
) -> np.ndarray:
    """The picture with its holes filled by the base texture, or else smoothly from their rims."""
    known = ~target
    picture = shown
    if inputs.base is not None:
        fill, _ = sample_covered(inputs.base, np.ones(inputs.base.shape[:2], bool), gbuffer.uv)
        picture = np.where(hole[..., None], encode(fill, white), picture)
        known = known | hole
    if not known.any():
        return np.full_like(picture, 0.5)
    return np.where(known[..., None], picture, push_pull(picture, known.astype(np.float32))).astype(np.float32)


def back_project(
    inputs: PathInpaintingInputs, state: InpaintingState, camera: Camera, picture: np.ndarray, white: float
) -> tuple[np.ndarray, np.ndarray]:
    """Project a picture to the texels that are visible from its camera and have no value yet.

    The same as in painting: one shadow ray per texel, antialiased sampling, and no pixels near silhouettes.

    Parameters
    ----------
    inputs
        Terrain and tiling.
    state
        Present texture.
    camera
        The view.
    picture
        ``(H, W, 3)`` sRGB-encoded.
    white
        Radiance of white [cd/m²].

    Returns
    -------
    texels
        ``(N,)`` int64 flat indices in the atlas.
    values
        ``(N, 3)`` float32 radiance [cd/m²].
    """
    linear = decode(picture, 1.0) * _HEADROOM
    everywhere = np.ones(picture.shape[:2], bool)
    # The time is not used.
    observation = Observation(linear, everywhere, camera, datetime(2000, 1, 1, tzinfo=UTC), "path")
    prepared = prepare_input(PaintingInput(observation), inputs.terrain, inputs.tiling, near_m=0.0)
    log_gain = np.full((1, 3), np.log(_HEADROOM / white))
    radiometry = RadiometricFit(log_gain, log_gain, np.ones(1))
    texels, values = [], []
    for tile in tiles_of(inputs.tiling):
        rows, columns = tile.window
        empty = ~state.covered[rows, columns].ravel()
        if not is_tile_visible(prepared.blocks, tile) or not empty.any():
            continue
        surface = tile_surface(inputs.tiling, tile)
        local, radiance, _ = input_texels(prepared, 0, inputs.terrain, surface[empty[surface.texel]], tile, radiometry)
        row, column = tile.row + local // tile.width, tile.column + local % tile.width
        texels.append(row * inputs.tiling.width_px + column)
        values.append(radiance)
    if not texels:
        return np.empty(0, np.int64), np.empty((0, 3), np.float32)
    return np.concatenate(texels), np.concatenate(values).astype(np.float32)


def textured_frames(
    values: np.ndarray, cameras: Sequence[Camera], terrain: RayScene, white: float, *, cloudiness: float = 0.0
) -> Iterator[np.ndarray]:
    """Render a complete texture along a path, one frame at a time.

    Parameters
    ----------
    values
        ``(R, S, 3)`` radiance [cd/m²].
    cameras
        Views of the path.
    terrain
        Ray-tracing scene of the terrain.
    white
        Radiance of white [cd/m²].
    cloudiness
        Of the plain sky, in [0, 1].

    Yields
    ------
    ndarray
        ``(H, W, 3)`` display-linear frame in [0, 1].
    """
    scene = unlit_scene(terrain)
    everywhere = np.ones(values.shape[:2], bool)
    for camera in cameras:
        gbuffer = trace_gbuffer(scene, camera)
        radiance, _ = sample_covered(values, everywhere, gbuffer.uv)
        sky = plain_sky(ray_directions(camera), cloudiness=cloudiness)
        covered = np.isfinite(gbuffer.depth)[..., None]
        yield linear_from_srgb(np.where(covered, encode(radiance, white), sky))
