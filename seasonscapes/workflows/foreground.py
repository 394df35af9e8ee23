"""Houses, masts and trees that the terrain model lacks, found in photographs so that they are not painted on the land."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.progress import Progress, each_reported
from seasonscapes.workflows.completion import predictors_at
from seasonscapes.workflows.place import Place

if TYPE_CHECKING:
    from seasonscapes.texturing.inputs import PaintingInput
    from seasonscapes.texturing.painting import Painting, PaintOptions, PaintTarget

# What the first pass found no longer teaches the second.
_PASSES = 2


def foreground_masks(
    place: Place,
    inputs: Sequence[PaintingInput],
    target: PaintTarget,
    options: PaintOptions,
    paint: Callable[[Sequence[np.ndarray | None] | None], Painting],
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[np.ndarray | None]:
    """Find what stands before the landscape in photographs of one time.

    Parameters
    ----------
    place
        The place.
    inputs
        Photographs.
    target, options
        Of the painting.
    paint
        Paints the photographs without masked pixels (``None`` leaves out none).
    seed
        Of the regression.
    progress
        Called with a task and its finished share.

    Returns
    -------
    list
        For each photograph a mask ``(H, W)`` bool, True on the foreground; ``None`` for one that paints nothing.

    Notes
    -----
    A regression on relief, sun and image, taught by the painting of other blocks of land, predicts every texel; coherent
    patches of pixels far from it are foreground (`texturing.foreground`).
    """
    from seasonscapes.rendering.gbuffer import trace_gbuffer
    from seasonscapes.texturing.atlas_tiles import tiling
    from seasonscapes.texturing.colour_regression import fit_regression, predict
    from seasonscapes.texturing.foreground import cross_validated_prediction, foreground_mask
    from seasonscapes.texturing.inputs import prepare_input, unlit_scene

    def fit(predictors: np.ndarray, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        regression = fit_regression(predictors, values, fast=True, seed=seed)
        return lambda other: predict(regression, other)[0]

    predictors = predictors_at(place, inputs[0].observation.time)
    cut, scene = tiling(target.terrain, target.atlas, tile_px=options.tile_px), unlit_scene(target.ray_scene)
    traced: dict[int, tuple] = {}
    masks: list[np.ndarray | None] = [None] * len(inputs)
    for _ in each_reported(range(_PASSES), _PASSES, progress, "finding the foreground"):
        painting = paint(masks)
        expected = cross_validated_prediction(painting.texture, predictors.values, fit, seed=seed)
        number_of = {name: number for number, name in enumerate(painting.webcams)}
        for index, item in enumerate(inputs):
            number = number_of.get(item.observation.webcam)
            if number is None:
                continue
            if index not in traced:
                ready = prepare_input(item, target.ray_scene, cut, near_m=options.near_m, guard=options.guard)
                traced[index] = ready, trace_gbuffer(scene, item.camera).uv
            masks[index] = foreground_mask(traced[index][0], number, painting.radiometry, expected, traced[index][1])
    return masks
