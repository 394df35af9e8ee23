"""Classes of land whose response to direct light is not Lambertian: found in an image, and fitted one by one.

A forest or a field sends back direct light as cos^κ of the angle of incidence: κ is 1 for a Lambertian surface; less
under a high sun, as crowns stand upright on any slope; more under a low sun, as slopes that turn away from it show the
shadows between their plants. It is the law of Minnaert (1941, doi:10.1086/144279), applied to sunlight alone: shadows, skylight and light
from other slopes, which the topographic corrections leave in it, are taken as modelled.
"""

from __future__ import annotations

import numpy as np
from scipy.cluster.vq import kmeans2, vq

# Exponents of the cosine of incidence.
_LEAST, _MOST = 0.0, 2.0
# Fewer texels tell no response.
_LEAST_TEXELS = 500
# Below this share of a class's mean direct light the exponent means nothing.
_LEAST_RATIO = 0.05
# Deviations of the logarithm of albedo beyond which a texel is something else than its class, such as a cloud.
_OUTLIER_SIGMAS = 5.0
_SAMPLE = 20_000


def land_classes(albedo: np.ndarray, known: np.ndarray, count: int, *, seed: int = 0) -> np.ndarray:
    """Find classes of land by k-means of the logarithms of band ratios, which hardly depend on the relief.

    Parameters
    ----------
    albedo
        ``(R, S, C)`` albedo or radiance of C ≥ 2 bands.
    known
        ``(R, S)`` bool: texels to be used.
    count
        Number of classes.
    seed
        Equal seeds give equal classes.

    Returns
    -------
    numpy.ndarray
        ``(R, S)`` int32 class of each texel, −1 where it is unknown.

    Examples
    --------
    >>> import numpy as np
    >>> image = np.empty((40, 40, 3))
    >>> image[:, :20], image[:, 20:] = (0.1, 0.3, 0.1), (0.3, 0.2, 0.1)
    >>> found = land_classes(image, np.ones((40, 40), bool), 2)
    >>> len(np.unique(found[:, :20])), len(np.unique(found))
    (1, 2)
    """
    usable = known & np.isfinite(albedo).all(axis=2) & (albedo > 0.0).all(axis=2)
    result = np.full(usable.shape, -1, np.int32)
    if int(usable.sum()) < count:
        return result
    ratio = np.diff(np.log(albedo[usable].astype(float)), axis=1)
    ratio = (ratio - ratio.mean(axis=0)) / np.maximum(ratio.std(axis=0), 1e-9)
    rng = np.random.default_rng(seed)
    sample = ratio if len(ratio) <= _SAMPLE else ratio[rng.choice(len(ratio), _SAMPLE, replace=False)]
    centres, _ = kmeans2(sample, count, minit="++", rng=rng)
    result[usable] = vq(ratio, centres)[0]
    return result


def class_illuminance(
    radiance: np.ndarray,
    sun: np.ndarray,
    visibility: np.ndarray,
    ambient: np.ndarray,
    kind: np.ndarray,
    fit_where: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the illuminance under which each class's albedo does not depend on its angle to the sun.

    Parameters
    ----------
    radiance
        ``(R, S, 3)`` [cd/m²] that leaves the surface.
    sun
        ``(R, S, 3)`` illuminance by the sun as if nothing cast a shadow [lx].
    visibility
        ``(R, S)`` visibility of the sun.
    ambient
        ``(R, S, 3)`` illuminance by sky and other terrain [lx].
    kind
        ``(R, S)`` class of each texel, −1 for none; classes of few sunlit texels stay Lambertian.
    fit_where
        ``(R, S)`` bool: texels at which the exponents are fitted; all if ``None``.

    Returns
    -------
    tuple of numpy.ndarray
        Effective illuminance ``(R, S, 3)`` [lx], whose mean over a class is that of the Lambertian one; and exponents
        ``(K, 3)`` of the K classes and channels.
    """
    result = (visibility[..., None] * sun + ambient).astype(np.float32)
    exponents = np.ones((max(int(kind.max()) + 1, 0), 3))
    sunlit = (visibility > 0.95) & (sun.min(axis=2) > 0.0)
    if fit_where is not None:
        sunlit &= fit_where
    for number in range(len(exponents)):
        member = kind == number
        fitted = member & sunlit
        if int(fitted.sum()) < _LEAST_TEXELS:
            continue
        typical = _typical(np.log(np.maximum(radiance[fitted], 1e-6) / result[fitted]))
        for channel in range(3):
            reference = float(sun[..., channel][fitted].mean())
            values, direct, diffuse = (array[..., channel][fitted][typical] for array in (radiance, sun, ambient))
            exponent = _fitted_exponent(values.astype(float), direct / reference, diffuse / reference)
            exponents[number, channel] = exponent
            ratio = np.maximum(sun[..., channel][member] / reference, _LEAST_RATIO)
            # Slopes that turn away from the sun get none of it at any exponent.
            direct = np.where(sun[..., channel][member] > 0.0, reference * ratio**exponent, 0.0)
            effective = visibility[member] * direct + ambient[..., channel][member]
            lambertian = result[..., channel][member]
            result[..., channel][member] = effective * (lambertian.mean() / effective.mean())
    return result, exponents


def _typical(logarithm: np.ndarray) -> np.ndarray:
    """Which of N texels ``(N, C)`` lie near the median of all in every channel."""
    deviation = np.abs(logarithm - np.median(logarithm, axis=0))
    spread = 1.4826 * np.median(deviation, axis=0)
    return np.all(deviation <= _OUTLIER_SIGMAS * np.maximum(spread, 1e-3), axis=1)


def _fitted_exponent(radiance: np.ndarray, ratio: np.ndarray, diffuse: np.ndarray) -> float:
    """Exponent under which albedo is uncorrelated with direct light; illuminances ``(N,)`` are over the mean direct one."""
    ratio = np.maximum(ratio, _LEAST_RATIO)
    low, high = _LEAST, _MOST
    for _ in range(14):
        middle = 0.5 * (low + high)
        albedo = radiance / (ratio**middle + diffuse)
        least, most = np.percentile(albedo, [1.0, 99.0])
        keep = (albedo >= least) & (albedo <= most)
        # A larger exponent makes the albedo of slopes that face the sun smaller.
        dependence = np.mean((albedo[keep] - albedo[keep].mean()) * (ratio[keep] - ratio[keep].mean()))
        low, high = (middle, high) if dependence > 0.0 else (low, middle)
    return 0.5 * (low + high)
