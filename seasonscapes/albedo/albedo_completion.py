"""Completion of a recovered albedo: an orthoimage corrected by the measured texels, both weighted by their variances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from seasonscapes.albedo.closed_form import HIGHEST, LOWEST, AlbedoFit
from seasonscapes.albedo.standard_error import AlbedoEstimate, observed_sigma
from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.completion import CompletionOptions, complete
from seasonscapes.texturing.predictors import Predictors


def complete_albedo(
    fit: AlbedoFit,
    base: np.ndarray | None,
    predictors: Predictors,
    *,
    measured: np.ndarray | None = None,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the albedo of every texel of the surface, and its standard error.

    Parameters
    ----------
    fit
        Albedo measured by photographs.
    base
        ``(R, S, 3)`` albedo from another source, of any scale, NaN where unknown. If ``None``, gaps are predicted from
        relief alone, and measured texels do not change.
    predictors
        Relief predictors, without those of the sun's position, since albedo does not depend on it.
    measured
        ``(R, S)`` bool: texels that count without a ``base``, in which case nothing draws a poorly determined one to what is
        likely; by default all that were observed.
    seed
        Seed of the regression.
    progress
        Called with the finished fraction.

    Returns
    -------
    albedo : numpy.ndarray
        ``(R, S, 3)``, clipped to physical limits.
    sigma : numpy.ndarray
        Standard error ``(R, S)`` float32.
    """
    sigma = observed_sigma(fit)
    if base is None and measured is not None:
        sigma = np.where(measured, sigma, np.float32(np.inf))
    # Relative precision: the completion compares cube roots, in which equal relative errors are about equally large.
    weight = np.square(fit.albedo[..., 1] / np.maximum(sigma, 1e-4)).astype(np.float32)
    completed = complete(
        Texture(fit.albedo, weight),
        predictors,
        base=base,
        options=CompletionOptions(fast=True, seed=seed),
        progress=progress,
    )
    values = np.clip(completed.values, LOWEST, HIGHEST)
    if base is None:
        return values, np.where(weight > 0.0, sigma, completed.sigma).astype(np.float32)
    combined = 1.0 / np.sqrt(1.0 / np.square(np.maximum(completed.sigma, 1e-6)) + 1.0 / np.square(sigma))
    return values, combined.astype(np.float32)


def completed_estimate(
    estimate: AlbedoEstimate,
    fit: AlbedoFit,
    base: np.ndarray | None,
    predictors: Predictors,
    *,
    progress: Callable[[float], None] | None = None,
) -> AlbedoEstimate:
    """Fill the texels of the surface that no photograph measured; they are marked as completed (source 2).

    Parameters
    ----------
    estimate, fit
        The measured albedo and the fit that it comes from.
    base, predictors, progress
        See `complete_albedo`.

    Returns
    -------
    AlbedoEstimate
        With a finite σ on the whole surface.
    """
    measured = estimate.source == 1
    albedo, sigma = complete_albedo(fit, base, predictors, measured=measured, progress=progress)
    source = np.where(predictors.surface & (estimate.source != 1), np.uint8(2), estimate.source)
    return replace(
        estimate, albedo=albedo, sigma=np.where(predictors.surface, sigma, np.float32(np.inf)), source=source
    )
