"""Painted texels and what an albedo, relit, says of the hour, each as far as it is known.

One picture knows less of most places than all pictures of many hours together: it shows them from one side, smeared at
shadows' edges where its pose is a little off, at an exposure that is guessed. What it alone knows (the hour's own snow,
light that no model has) remains where it is seen well. Nothing is learned from such pictures about places that they do not
show: their smear would be learned as a lack of contrast.
"""

from __future__ import annotations

import numpy as np

from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.completion import Completed, painted_texels
from seasonscapes.texturing.predictors import Predictors
from seasonscapes.texturing.regression_fill import propagate_residual
from seasonscapes.texturing.texel_weights import fit_variance_by_weight

# Of the modelled light, and of the best pictures (noise, JPEG, tone curve) [log].
_LIGHT_SIGMA, _PICTURE_SIGMA = 0.05, 0.05


def fuse_with_albedo(texture: Texture, base: np.ndarray, base_sigma: np.ndarray, predictors: Predictors) -> Completed:
    """The posterior mean of painted texels and a base, in logarithms; beyond them the base.

    Parameters
    ----------
    texture
        Radiance, painted where ``weight`` is positive; of the weights only the order counts.
    base
        ``(R, S, 3)`` radiance of every texel by an albedo under the hour's light, in the same unit.
    base_sigma
        ``(R, S)`` relative standard error of that albedo.
    predictors
        Only their surface and charts are used.

    Raises
    ------
    ValueError
        Arrays of another size than the texture.

    Notes
    -----
    ln r = ln b + s (ln p − ln b) with s = σ_b² / (σ_b² + σ_p²). The painting's variance σ_p² by weight is the mean square
    of ln p − ln b less the mean of σ_b²; what is left of the difference is carried a few texels further.
    """
    if base.shape != texture.values.shape or base_sigma.shape != texture.weight.shape:
        raise ValueError(f"fuse: base {base.shape} and σ {base_sigma.shape} for a texture {texture.values.shape}")
    known = painted_texels(texture) & predictors.surface & (base > 0.0).all(axis=2) & (texture.values > 0.0).all(axis=2)
    variance = np.minimum(base_sigma, 1.0).astype(np.float32) ** 2 + np.float32(_LIGHT_SIGMA**2)
    if not known.any():
        return Completed(base.astype(np.float32), base[..., 1] * np.sqrt(variance), known)
    apart = np.zeros_like(base, dtype=np.float32)
    apart[known] = np.log(texture.values[known] / base[known])
    weight = texture.weight[known]
    both, own = (
        fit_variance_by_weight(apart[known], weight),
        fit_variance_by_weight(np.sqrt(variance[known])[:, None], weight),
    )
    noise = np.maximum(both(weight) - own(weight), _PICTURE_SIGMA**2)
    share = np.zeros(known.shape, np.float32)
    share[known] = variance[known] / (variance[known] + noise)
    residual = apart * share[..., None]
    moved = np.where(known[..., None], residual, propagate_residual(residual, known, predictors))
    values = (base * np.exp(np.where(predictors.surface[..., None], moved, 0.0))).astype(np.float32)
    return Completed(values, values[..., 1] * np.sqrt(variance * (1.0 - share)), known)
