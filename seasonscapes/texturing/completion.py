"""Completion of a painted texture: a value and a standard error for every unpainted texel, by a choice of methods."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from seasonscapes.errors import AtlasMismatch, NotEnoughEvidence
from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.completion_error import Fill, sigma_by_distance
from seasonscapes.texturing.detail import add_detail
from seasonscapes.texturing.predictors import Predictors
from seasonscapes.texturing.regression_fill import regression_fill
from seasonscapes.texturing.residual_correction import corrected_fill
from seasonscapes.texturing.smooth_fill import membrane_fill, push_pull, telea_fill
from seasonscapes.texturing.tiled_completion import complete_tiles
from seasonscapes.texturing.tiled_predictors import TiledPredictors
from seasonscapes.texturing.top_down_grid import from_grid, to_grid

log = logging.getLogger(__name__)
Progress = Callable[[float], None]


@dataclass(frozen=True)
class CompletedTexture:
    """A texture without holes.

    Parameters
    ----------
    values
        ``(R, S, 3)`` float32, finite everywhere; without a base, painted texels equal the given ones bit for bit.
    sigma
        Standard error ``(R, S)`` of the filled texels in the unit of ``values``, RMS over the channels. 0 where painted
        (errors of the painting are not known here); with a base, that of the prediction everywhere.
    painted
        ``(R, S)`` bool: painted from a photograph.
    """

    values: np.ndarray
    sigma: np.ndarray
    painted: np.ndarray


class Inpainter(Protocol):
    """A completion method."""

    def __call__(
        self,
        values: np.ndarray,
        painted: np.ndarray,
        predictors: Predictors,
        *,
        fast: bool = False,
        seed: int = 0,
        progress: Progress | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return filled colours and their standard error; only unpainted texels on the surface are used.

        Parameters
        ----------
        values
            ``(R, S, 3)`` encoded colours (cube roots); ignored where not painted.
        painted
            ``(R, S)`` bool.
        predictors
            Of the same size.
        fast
            Trade some accuracy for time.
        seed
            Equal seeds give equal results.
        progress
            Called with the finished fraction.

        Returns
        -------
        filled
            ``(R, S, 3)`` encoded colours.
        sigma
            ``(R, S)`` standard error of the decoded colours.
        """
        ...


def membrane(
    values: np.ndarray,
    painted: np.ndarray,
    predictors: Predictors,
    *,
    fast: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill by the Laplace equation, without predictors; an `Inpainter`.

    Parameters
    ----------
    values, painted, predictors, fast, seed, progress
        As in `Inpainter`; of the predictors only the top-down grid is used.

    Returns
    -------
    filled, sigma
        As in `Inpainter`.
    """
    return _smooth_fill(membrane_fill, values, painted, predictors, seed)


def telea(
    values: np.ndarray,
    painted: np.ndarray,
    predictors: Predictors,
    *,
    fast: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill by Telea inpainting as the reference implementation does, without predictors; an `Inpainter`.

    Parameters
    ----------
    values, painted, predictors, fast, seed, progress
        As in `Inpainter`; of the predictors only the top-down grid is used.

    Returns
    -------
    filled, sigma
        As in `Inpainter`.
    """
    return _smooth_fill(partial(telea_fill, radius_px=1.0 if fast else 3.0), values, painted, predictors, seed)


def _smooth_fill(
    fill: Fill, values: np.ndarray, painted: np.ndarray, predictors: Predictors, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Apply an image filling method in the atlas or, with several charts, on the top-down grid."""
    if predictors.grid is None:
        return fill(values, painted), sigma_by_distance(fill, values, painted, seed=seed)
    mean, count = to_grid(predictors.grid, values, painted)
    picture = fill(mean, count > 0)
    sigma = sigma_by_distance(fill, mean, count > 0, seed=seed)
    sampled = np.nan_to_num(from_grid(predictors.grid, np.concatenate([picture, sigma[..., None]], -1)))
    return sampled[..., :-1], sampled[..., -1]


INPAINTERS: dict[str, Inpainter] = {"guided": regression_fill, "membrane": membrane, "telea": telea}


@dataclass(frozen=True)
class CompletionOptions:
    """Method and effort of `complete`.

    Parameters
    ----------
    method
        A name of `INPAINTERS`; ``guided`` if there is a base.
    detail
        Strength of synthesised grain in [0, 1]: 0 for albedo recovery, about 0.6 for visualisation.
    fast
        Trade some accuracy for time.
    seed
        Equal seeds give equal textures.

    Raises
    ------
    ValueError
        Unknown method, or ``detail`` out of range.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> ss.CompletionOptions("membrane").detail
    0.0
    """

    method: str = "guided"
    detail: float = 0.0
    fast: bool = False
    seed: int = 0

    def __post_init__(self):
        if self.method not in INPAINTERS:
            raise ValueError(f"method: got {self.method!r}, expected one of {', '.join(INPAINTERS)}")
        if not 0.0 <= self.detail <= 1.0:
            raise ValueError(f"detail: got {self.detail}, expected 0 to 1")


def complete(
    texture: Texture,
    predictors: Predictors | TiledPredictors,
    *,
    base: np.ndarray | None = None,
    options: CompletionOptions | None = None,
    progress: Progress | None = None,
) -> CompletedTexture:
    """Fill every unpainted texel of a texture.

    Parameters
    ----------
    texture
        Radiance or albedo; painted where ``weight`` is positive and the values are finite.
    predictors
        From `predictors.predictors_for`, of the same size. The methods ``membrane`` and ``telea`` use only its surface
        and top-down grid. With those of `tiled_predictors.tiled_predictors`, the method ``guided`` without base and grain
        works tile by tile, without the predictors of all texels in memory; ``membrane`` and ``telea`` without grain compute
        none. Grain or a base take them all, and a warning tells how much memory that is.
    base
        ``(R, S, 3)`` estimate of every texel from another source, in the texture's unit (for an albedo: an orthophoto
        without its illumination), NaN where unknown. It is corrected by the painted texels, which in turn are shrunk
        towards it according to their ``weight``; see `residual_correction`.
    options
        Method and effort; defaults to `CompletionOptions()`.
    progress
        Called with the finished fraction.

    Returns
    -------
    CompletedTexture
        The complete texture with its standard error.

    Raises
    ------
    NotEnoughEvidence
        No texel on the surface is painted.
    AtlasMismatch
        ``predictors`` belong to a texture of another size.
    ValueError
        A base of another size or with another method than ``guided``, or a negative painted value.
    """
    options = options or CompletionOptions()
    method, fast, seed = options.method, options.fast, options.seed
    if predictors.surface.shape != texture.weight.shape:
        raise AtlasMismatch(f"complete: predictors are {predictors.surface.shape}, the texture {texture.weight.shape}")
    if base is not None and (base.shape != texture.values.shape or method != "guided"):
        raise ValueError(
            f"base: {base.shape} for a texture {texture.values.shape} and method {method!r}, expected guided"
        )
    report = progress or (lambda fraction: None)
    painted = painted_texels(texture)
    if isinstance(predictors, TiledPredictors):
        if method == "guided" and base is None and options.detail == 0.0:
            tiled = complete_tiles(texture, painted, predictors, fast=fast, seed=seed, progress=progress)
            return CompletedTexture(*tiled, painted)
        if method != "guided" and options.detail == 0.0:
            # These look at the surface alone.
            predictors = Predictors(np.empty((*painted.shape, 0), np.float32), (), predictors.surface)
        else:
            log.warning(
                "complete: with grain or a base, the predictors of all %.1f million texels are held in memory: %.2f GB",
                painted.size / 1e6,
                painted.size * len(predictors.names) * 4 / 1e9,
            )
            predictors = predictors.whole()
    known = painted & predictors.surface
    if not known.any():
        raise NotEnoughEvidence("complete: no painted texel on the surface: there is nothing to learn from")
    if texture.values[painted].min() < 0.0:
        raise ValueError("complete: negative values among the painted texels")
    # With a base, painted texels change too.
    changed = predictors.surface & ~painted if base is None else predictors.surface
    values = np.where(painted[..., None], texture.values, 0.0).astype(np.float32)
    sigma = np.zeros(painted.shape, np.float32)
    if changed.any():
        scale = max(float(np.median(values[known])), 1e-6 * float(values[known].max()), 1e-12)
        encoded = np.cbrt(values / np.float32(scale))

        def report_filling(fraction: float) -> None:
            report(0.9 * fraction)

        if base is None:
            filled, error = INPAINTERS[method](
                encoded, known, predictors, fast=fast, seed=seed, progress=report_filling
            )
            brightest = float(encoded[known].max())
        else:
            encoded_base = np.cbrt(np.maximum(base, 0.0) / scale).astype(np.float32)
            known_weight = np.where(known, texture.weight, 0.0)
            filled, error = corrected_fill(
                encoded, known_weight, encoded_base, predictors, fast=fast, seed=seed, progress=report_filling
            )
            brightest = max(float(encoded[known].max()), float(np.nanmax(encoded_base[predictors.surface])))
        if options.detail > 0.0:
            filled = add_detail(filled, known, predictors, strength=options.detail, seed=seed)
        # Cubing amplifies small errors of bright texels; no filled texel may be brighter than all known ones.
        values[changed] = scale * np.clip(filled[changed], 0.0, brightest) ** 3
        sigma[changed] = scale * error[changed]
    off_surface = ~predictors.surface & ~painted
    if off_surface.any():
        # Texels between charts are filled for bilinear look-ups at chart borders.
        extended = push_pull(np.concatenate([values, sigma[..., None]], -1), (~off_surface).astype(np.float32))
        values[off_surface], sigma[off_surface] = extended[off_surface][:, :3], extended[off_surface][:, 3]
    report(1.0)
    return CompletedTexture(values, sigma, painted)


def painted_texels(texture: Texture) -> np.ndarray:
    """Return the texels with a positive weight and finite values.

    Parameters
    ----------
    texture
        Any texture.

    Returns
    -------
    ndarray
        ``(R, S)`` bool.
    """
    return (texture.weight > 0.0) & np.isfinite(texture.values).all(axis=2)
