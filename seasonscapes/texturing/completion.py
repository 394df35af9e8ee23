"""Complete a painted texture: every texel that no camera saw gets a value and an honest σ."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.completion_error import sigma_by_distance
from seasonscapes.texturing.detail import add_detail
from seasonscapes.texturing.predictors import Predictors
from seasonscapes.texturing.regression_fill import regression_fill
from seasonscapes.texturing.residual_correction import corrected_fill
from seasonscapes.texturing.smooth_fill import membrane_fill, push_pull, telea_fill
from seasonscapes.texturing.top_down_grid import from_grid, to_grid

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Completed:
    """A texture without holes.

    Parameters
    ----------
    values
        ``(R, S, 3)`` float32, finite everywhere; painted texels are the given ones to the bit, unless there was a base.
    sigma
        Standard error ``(R, S)`` of the filled texels in the unit of ``values``, RMS over the channels; 0 where
        painted (what painting itself gets wrong is not known here), and with a base that of the prediction everywhere.
    painted
        ``(R, S)`` bool: seen by a camera.
    """

    values: np.ndarray
    sigma: np.ndarray
    painted: np.ndarray


def membrane(
    values, painted, predictors: Predictors, *, fast: bool = False, seed: int = 0, progress: Progress | None = None
):
    """Laplace's equation between the painted texels; knows nothing of the land."""
    return _unguided(membrane_fill, values, painted, predictors, seed)


def telea(
    values, painted, predictors: Predictors, *, fast: bool = False, seed: int = 0, progress: Progress | None = None
):
    """`cv2.inpaint` after Telea, the reference implementation's completion."""
    return _unguided(partial(telea_fill, radius_px=1.0 if fast else 3.0), values, painted, predictors, seed)


def _unguided(fill: Callable, values: np.ndarray, painted: np.ndarray, predictors: Predictors, seed: int):
    """A method that knows pictures only, on the plan where the atlas has several charts."""
    if predictors.plan is None:
        return fill(values, painted), sigma_by_distance(fill, values, painted, seed=seed)
    mean, count = to_grid(predictors.plan, values, painted)
    picture = fill(mean, count > 0)
    sigma = sigma_by_distance(fill, mean, count > 0, seed=seed)
    taken = np.nan_to_num(from_grid(predictors.plan, np.concatenate([picture, sigma[..., None]], -1)))
    return taken[..., :-1], taken[..., -1]


# A new method is one line: a function (values, painted, guides, *, fast, seed, progress) → (values, sigma) in
# encoded colours (cube roots); only what it says of surface texels that are not painted is used.
INPAINTERS: dict[str, Callable] = {"guided": regression_fill, "membrane": membrane, "telea": telea}


def complete(
    texture: Texture,
    predictors: Predictors,
    *,
    base: np.ndarray | None = None,
    method: str = "guided",
    detail: float = 0.0,
    fast: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> Completed:
    """Fill every texel that no camera saw.

    Parameters
    ----------
    texture
        Radiance or albedo; painted where ``weight`` is positive and the values are finite.
    predictors
        From `predictors.predictors_for`, of the same size. Methods that do not look at the land use only its charts.
    base
        ``(R, S, 3)`` what another source says that every texel is, in the texture's unit (for an albedo: an image from
        above with its light taken out); NaN where it says nothing. It is corrected by what was painted, and painted
        texels give way to it as far as their ``weight`` tells that they scatter: see `corrected`.
    method
        A name of `INPAINTERS`; with a base ``guided`` alone.
    detail
        Strength of synthesised grain in [0, 1]: 0 for albedo recovery, about 0.6 for pictures.
    fast
        Trade a little accuracy for time.
    seed
        Equal seeds give equal textures.
    progress
        Called with the share that is done.

    Raises
    ------
    ValueError
        An unknown method, guides or a base of another size, a base with another method than ``guided``, a negative value
        among the painted ones, or no painted texel on the surface.
    """
    if method not in INPAINTERS:
        raise ValueError(f"method: got {method!r}, expected one of {', '.join(INPAINTERS)}")
    if predictors.surface.shape != texture.weight.shape:
        raise ValueError(f"predictors are {predictors.surface.shape}, the texture {texture.weight.shape}")
    if base is not None and (base.shape != texture.values.shape or method != "guided"):
        raise ValueError(
            f"base: {base.shape} for a texture {texture.values.shape} and method {method!r}, expected guided"
        )
    if not 0.0 <= detail <= 1.0:
        raise ValueError(f"detail: got {detail}, expected 0 to 1")
    tell = progress or (lambda share: None)
    painted = painted_texels(texture)
    seen = painted & predictors.surface
    if not seen.any():
        raise ValueError("complete: no painted texel on the surface: there is nothing to learn from")
    if texture.values[painted].min() < 0.0:
        raise ValueError("complete: negative values among the painted texels")
    # Painted texels, too, give way to a base.
    changed = predictors.surface & ~painted if base is None else predictors.surface
    values = np.where(painted[..., None], texture.values, 0.0).astype(np.float32)
    sigma = np.zeros(painted.shape, np.float32)
    if changed.any():
        scale = max(float(np.median(values[seen])), 1e-6 * float(values[seen].max()), 1e-12)
        encoded = np.cbrt(values / np.float32(scale))
        how: dict = {"fast": fast, "seed": seed, "progress": lambda s: tell(0.9 * s)}
        if base is None:
            made, spread = INPAINTERS[method](encoded, seen, predictors, **how)
            brightest = float(encoded[seen].max())
        else:
            like = np.cbrt(np.maximum(base, 0.0) / scale).astype(np.float32)
            made, spread = corrected_fill(encoded, np.where(seen, texture.weight, 0.0), like, predictors, **how)
            brightest = max(float(encoded[seen].max()), float(np.nanmax(like[predictors.surface])))
        if detail > 0.0:
            made = add_detail(made, seen, predictors, strength=detail, seed=seed)
        # Nothing is brighter than all that is known: cubes must not make suns of small errors.
        values[changed] = scale * np.clip(made[changed], 0.0, brightest) ** 3
        sigma[changed] = scale * spread[changed]
    beside = ~predictors.surface & ~painted
    if beside.any():
        # Between charts nothing lies; a look-up at a chart's rim must still find its colour.
        grown = push_pull(np.concatenate([values, sigma[..., None]], -1), (~beside).astype(np.float32))
        values[beside], sigma[beside] = grown[beside][:, :3], grown[beside][:, 3]
    tell(1.0)
    return Completed(values, sigma, painted)


def painted_texels(texture: Texture) -> np.ndarray:
    """Where a camera's finite colour lies, ``(R, S)`` bool."""
    return (texture.weight > 0.0) & np.isfinite(texture.values).all(axis=2)
