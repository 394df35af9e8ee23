"""Correlated colour temperature by Ohno's method (Ohno 2014, doi:10.1080/15502724.2014.839020).

The Planckian locus is tabulated once by colour-science (CIE 1931 2° observer) and shipped as a file, so that a report
on the sky does not import that package, which takes a second. ``python -m seasonscapes.sky.colour_temperature``
rewrites it.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from seasonscapes.images import XYZ_FROM_REC709

_FILE = Path(__file__).with_name("planckian_locus.npz")
_LOWEST_K, _HIGHEST_K, _STEP = 1000.0, 100_000.0, 1.0025
# Beyond this distance from the locus in (u, v) the triangular solution is less accurate than the parabolic one.
_TRIANGULAR_DUV = 0.002
_MAX_DUV = 0.05


def planckian_locus() -> tuple[np.ndarray, np.ndarray]:
    """Compute the Planckian locus with colour-science.

    Returns
    -------
    kelvin, uv : numpy.ndarray
        Temperatures ``(N,)`` [K], and CIE 1960 UCS chromaticities ``(N, 2)``.
    """
    import colour
    from colour.temperature import CCT_to_uv_Ohno2013

    count = int(np.ceil(np.log(_HIGHEST_K / _LOWEST_K) / np.log(_STEP))) + 1
    kelvin = _LOWEST_K * _STEP ** np.arange(count)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    uv = CCT_to_uv_Ohno2013(np.stack([kelvin, np.zeros(count)], axis=-1), cmfs=observer)
    return kelvin, np.asarray(uv, float)


@lru_cache(maxsize=1)
def _table() -> tuple[np.ndarray, np.ndarray]:
    with np.load(_FILE, allow_pickle=False) as stored:
        return stored["kelvin"], stored["uv"]


def correlated_colour_temperature_k(rgb: np.ndarray) -> float | None:
    """Correlated colour temperature of light.

    It is undefined for light farther than 0.05 from the Planckian locus in CIE 1960 (u, v), or bluer than a black body
    of 99,000 K, such as the zenith in twilight.

    Parameters
    ----------
    rgb
        Linear Rec.709 ``(3,)``, of any scale.

    Returns
    -------
    float or None
        Correlated colour temperature [K], or ``None`` if undefined.

    Examples
    --------
    >>> from seasonscapes.sky.colour_temperature import correlated_colour_temperature_k
    >>> round(correlated_colour_temperature_k([1.0, 1.0, 1.0]))
    6503
    """
    xyz = XYZ_FROM_REC709 @ np.asarray(rgb, float)
    if not np.all(np.isfinite(xyz)) or xyz.sum() <= 0.0 or np.any(xyz < 0.0):
        return None
    denominator = xyz[0] + 15.0 * xyz[1] + 3.0 * xyz[2]
    kelvin, distance = _nearest(np.array([4.0 * xyz[0], 6.0 * xyz[1]]) / denominator)
    if not (_LOWEST_K < kelvin < 99_000.0) or abs(distance) > _MAX_DUV:
        return None
    return kelvin


def _nearest(uv: np.ndarray) -> tuple[float, float]:
    """Temperature [K] and signed distance D_uv of the nearest point of the locus (Ohno 2014)."""
    kelvin, locus = _table()
    distance = np.hypot(*(locus - uv).T)
    middle = int(np.clip(np.argmin(distance), 1, len(kelvin) - 2))
    near = slice(middle - 1, middle + 2)
    (t0, t1, t2), (d0, d1, d2) = kelvin[near], distance[near]
    base = locus[middle + 1] - locus[middle - 1]
    length = float(np.hypot(*base))
    along = (d0**2 - d2**2 + length**2) / (2.0 * length)
    triangular = t0 + (t2 - t0) * along / length
    foot = locus[middle - 1] + base * along / length
    sign = 1.0 if uv[1] >= foot[1] else -1.0
    duv = sign * float(np.sqrt(max(d0**2 - along**2, 0.0)))
    if abs(duv) < _TRIANGULAR_DUV:
        return float(triangular), duv
    x = (t2 - t1) * (t0 - t2) * (t1 - t0)
    a = (t0 * (d2 - d1) + t1 * (d0 - d2) + t2 * (d1 - d0)) / x
    b = -(t0**2 * (d2 - d1) + t1**2 * (d0 - d2) + t2**2 * (d1 - d0)) / x
    c = -(d0 * (t2 - t1) * t1 * t2 + d1 * (t0 - t2) * t0 * t2 + d2 * (t1 - t0) * t0 * t1) / x
    parabolic = -b / (2.0 * a)
    return float(parabolic), sign * float(a * parabolic**2 + b * parabolic + c)


if __name__ == "__main__":
    temperatures, chromaticities = planckian_locus()
    np.savez_compressed(_FILE, kelvin=temperatures, uv=chromaticities)
