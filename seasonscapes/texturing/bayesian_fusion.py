"""Bayesian fusion of a painted texture with a relit albedo: per-texel posterior mean by the variances of both.

A painting from the photographs of one instant observes most texels from one side, with errors of pose at shadow edges
and an estimated exposure. An albedo recovered from many photographs is more accurate for most texels, but lacks what is
specific to the instant (its snow, light that the model lacks). Unpainted texels take the relit albedo: nothing is
learned from the painting for other texels, since its blur would reduce their contrast.
"""

from __future__ import annotations

import numpy as np

from seasonscapes.errors import AtlasMismatch
from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.completion import CompletedTexture, painted_texels
from seasonscapes.texturing.predictors import Predictors
from seasonscapes.texturing.regression_fill import propagate_residual
from seasonscapes.texturing.texel_weights import fit_variance_by_weight

# Relative standard deviation of the modelled light, and of the best photographs (noise, JPEG, tone curve).
_LIGHT_SIGMA, _IMAGE_SIGMA = 0.05, 0.05


def fuse_with_albedo(
    texture: Texture, base: np.ndarray, base_sigma: np.ndarray, predictors: Predictors
) -> CompletedTexture:
    """Compute the posterior mean of painted texels and a relit albedo, in logarithms.

    Parameters
    ----------
    texture
        Radiance, painted where ``weight`` is positive. Only the order of weights matters.
    base
        ``(R, S, 3)`` radiance of every texel from the albedo under the light of the painting, in the same unit.
    base_sigma
        ``(R, S)`` relative standard error of that albedo.
    predictors
        Only the surface and the top-down grid are used.

    Returns
    -------
    CompletedTexture
        The posterior mean and its standard error; the base where nothing is painted.

    Raises
    ------
    AtlasMismatch
        Arrays of another size than the texture.

    Notes
    -----
    ln r = ln b + s (ln p − ln b) with s = σ_b² / (σ_b² + σ_p²). The painting's variance σ_p² by weight is the mean
    square of ln p − ln b less the mean of σ_b². The remaining difference is propagated a few texels into the holes.
    """
    if base.shape != texture.values.shape or base_sigma.shape != texture.weight.shape:
        raise AtlasMismatch(
            f"fuse_with_albedo: base {base.shape} and σ {base_sigma.shape} for a texture {texture.values.shape}"
        )
    known = painted_texels(texture) & predictors.surface & (base > 0.0).all(axis=2) & (texture.values > 0.0).all(axis=2)
    base_variance = np.minimum(base_sigma, 1.0).astype(np.float32) ** 2 + np.float32(_LIGHT_SIGMA**2)
    if not known.any():
        return CompletedTexture(base.astype(np.float32), base[..., 1] * np.sqrt(base_variance), known)
    log_ratio = np.zeros_like(base, dtype=np.float32)
    log_ratio[known] = np.log(texture.values[known] / base[known])
    weight = texture.weight[known]
    total_by_weight = fit_variance_by_weight(log_ratio[known], weight)
    base_by_weight = fit_variance_by_weight(np.sqrt(base_variance[known])[:, None], weight)
    painting_variance = np.maximum(total_by_weight(weight) - base_by_weight(weight), _IMAGE_SIGMA**2)
    share = np.zeros(known.shape, np.float32)
    share[known] = base_variance[known] / (base_variance[known] + painting_variance)
    residual = log_ratio * share[..., None]
    correction = np.where(known[..., None], residual, propagate_residual(residual, known, predictors))
    values = (base * np.exp(np.where(predictors.surface[..., None], correction, 0.0))).astype(np.float32)
    return CompletedTexture(values, values[..., 1] * np.sqrt(base_variance * (1.0 - share)), known)
