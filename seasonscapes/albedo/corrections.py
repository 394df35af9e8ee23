"""Topographic correction of remote sensing images: cosine, Minnaert, C and SCS+C corrections, as baselines.

All operate on a radiance texture and the cosine of incidence alone: no cast shadows, no sky, no interreflection. With
θ the sun's zenith angle, i the angle of incidence, α the slope:

* cosine: L cos θ / cos i (Teillet, Guindon & Goodenough 1982, doi:10.1080/07038992.1982.10855028)
* Minnaert: L (cos θ / cos i)^k, k by regression (Smith, Lin & Ranson 1980)
* C: L (cos θ + c) / (cos i + c), c = intercept / slope of L against cos i (Teillet et al. 1982)
* SCS+C: L (cos α cos θ + c) / (cos i + c) (Soenen, Peddle & Coburn 2005, doi:10.1109/TGRS.2005.852480)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Lower limit of the cosine of incidence: every correction diverges at grazing incidence and is applied with a limit.
_LEAST_COSINE = 0.1


@dataclass(frozen=True)
class Slopes:
    """Orientation of N surface points relative to the sun.

    Parameters
    ----------
    incidence
        ``(N,)`` cosine of the angle of incidence.
    slope
        ``(N,)`` cosine of the slope.
    zenith
        Cosine of the sun's zenith angle.
    """

    incidence: np.ndarray
    slope: np.ndarray
    zenith: float


def slopes_under(normal: np.ndarray, sun_direction: np.ndarray) -> Slopes:
    """Compute incidence and slope cosines of surface normals under a sun.

    Parameters
    ----------
    normal
        ``(N, 3)`` unit normals, ENU.
    sun_direction
        ``(3,)`` unit vector towards the sun, ENU.

    Returns
    -------
    Slopes
        Cosines of incidence, slope and zenith angle.
    """
    sun = np.asarray(sun_direction, float)
    return Slopes(normal @ sun, normal[:, 2].astype(float), float(sun[2]))


def cosine(radiance: np.ndarray, slopes: Slopes) -> np.ndarray:
    """Apply the cosine correction.

    Parameters
    ----------
    radiance
        ``(N, 3)``, any unit.
    slopes
        Orientation of the N points.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` radiance as on flat ground; NaN where the surface faces away from the sun.
    """
    return radiance * (slopes.zenith / _lit(slopes))[:, None]


def minnaert(radiance: np.ndarray, slopes: Slopes) -> np.ndarray:
    """Apply the Minnaert correction, with one exponent k per channel.

    Parameters
    ----------
    radiance
        ``(N, 3)``, any unit.
    slopes
        Orientation of the N points.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` radiance as on flat ground; NaN where the surface faces away from the sun.
    """
    ratio = slopes.zenith / _lit(slopes)
    corrected = np.full(radiance.shape, np.nan)
    for channel in range(radiance.shape[1]):
        values = radiance[:, channel]
        keep = np.isfinite(ratio) & np.isfinite(values) & (values > 0.0)
        k = -np.polyfit(np.log(ratio[keep]), np.log(values[keep]), 1)[0] if keep.sum() > 10 else 1.0
        corrected[:, channel] = values * ratio ** np.clip(k, 0.0, 1.0)
    return corrected


def c_correction(radiance: np.ndarray, slopes: Slopes) -> np.ndarray:
    """Apply the C correction.

    Parameters
    ----------
    radiance
        ``(N, 3)``, any unit.
    slopes
        Orientation of the N points.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` radiance as on flat ground; NaN where the surface faces away from the sun.
    """
    return _with_c(radiance, slopes, np.full(len(radiance), slopes.zenith))


def scs_c(radiance: np.ndarray, slopes: Slopes) -> np.ndarray:
    """Apply the SCS+C (sun-canopy-sensor) correction.

    Parameters
    ----------
    radiance
        ``(N, 3)``, any unit.
    slopes
        Orientation of the N points.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` radiance as on flat ground; NaN where the surface faces away from the sun.
    """
    return _with_c(radiance, slopes, slopes.slope * slopes.zenith)


CORRECTIONS: dict[str, Callable[[np.ndarray, Slopes], np.ndarray]] = {
    "cosine": cosine,
    "minnaert": minnaert,
    "c": c_correction,
    "scs_c": scs_c,
}


def _lit(slopes: Slopes) -> np.ndarray:
    """Limited cosine of incidence ``(N,)``; NaN where the surface faces away from the sun."""
    return np.where(slopes.incidence > 0.0, np.maximum(slopes.incidence, _LEAST_COSINE), np.nan)


def _with_c(radiance: np.ndarray, slopes: Slopes, reference: np.ndarray) -> np.ndarray:
    """L (reference + c) / (cos i + c), with c by regression for each channel."""
    corrected = np.full(radiance.shape, np.nan)
    lit = _lit(slopes)
    for channel in range(radiance.shape[1]):
        values = radiance[:, channel]
        keep = np.isfinite(lit) & np.isfinite(values)
        if keep.sum() <= 10:
            continue
        gradient, intercept = np.polyfit(slopes.incidence[keep], values[keep], 1)
        # A negative gradient has no physical meaning; a large c leaves the radiance unchanged.
        c = intercept / gradient if gradient > 1e-12 else 1e6
        corrected[:, channel] = values * (reference + c) / np.maximum(lit + c, 0.05)
    return corrected
