"""What remote sensing does against relief: cosine, Minnaert, C and SCS+C corrections. Here as rivals to be measured.

All work on a radiance texture and the cosine of incidence alone: no cast shadows, no sky, no interreflection. With
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

# Faces that the sun grazes: every correction blows up there, and all of them are used with a limit.
_LEAST_COSINE = 0.1


@dataclass(frozen=True)
class Slopes:
    """How a surface stands to the sun, ``(N,)`` each: cosine of incidence, cosine of its slope; and cos θ of the sun."""

    incidence: np.ndarray
    slope: np.ndarray
    zenith: float


def slopes_under(normal: np.ndarray, sun_direction: np.ndarray) -> Slopes:
    """Slopes of unit normals ``(N, 3)`` ENU under a sun."""
    sun = np.asarray(sun_direction, float)
    return Slopes(normal @ sun, normal[:, 2].astype(float), float(sun[2]))


def cosine(radiance: np.ndarray, slopes: Slopes) -> np.ndarray:
    """Cosine correction of ``(N, 3)``; NaN where the surface turns away from the sun, as in all of these."""
    return radiance * (slopes.zenith / _lit(slopes))[:, None]


def minnaert(radiance: np.ndarray, slopes: Slopes) -> np.ndarray:
    """Minnaert correction of ``(N, 3)``, one k for each channel."""
    ratio = slopes.zenith / _lit(slopes)
    corrected = np.full(radiance.shape, np.nan)
    for channel in range(radiance.shape[1]):
        values = radiance[:, channel]
        keep = np.isfinite(ratio) & np.isfinite(values) & (values > 0.0)
        k = -np.polyfit(np.log(ratio[keep]), np.log(values[keep]), 1)[0] if keep.sum() > 10 else 1.0
        corrected[:, channel] = values * ratio ** np.clip(k, 0.0, 1.0)
    return corrected


def c_correction(radiance: np.ndarray, slopes: Slopes) -> np.ndarray:
    """C correction of ``(N, 3)``."""
    return _with_c(radiance, slopes, np.full(len(radiance), slopes.zenith))


def scs_c(radiance: np.ndarray, slopes: Slopes) -> np.ndarray:
    """SCS+C correction of ``(N, 3)``."""
    return _with_c(radiance, slopes, slopes.slope * slopes.zenith)


CORRECTIONS: dict[str, Callable[[np.ndarray, Slopes], np.ndarray]] = {
    "cosine": cosine,
    "minnaert": minnaert,
    "c": c_correction,
    "scs_c": scs_c,
}


def _lit(slopes: Slopes) -> np.ndarray:
    return np.where(slopes.incidence > 0.0, np.maximum(slopes.incidence, _LEAST_COSINE), np.nan)


def _with_c(radiance: np.ndarray, slopes: Slopes, level: np.ndarray) -> np.ndarray:
    corrected = np.full(radiance.shape, np.nan)
    lit = _lit(slopes)
    for channel in range(radiance.shape[1]):
        values = radiance[:, channel]
        keep = np.isfinite(lit) & np.isfinite(values)
        if keep.sum() <= 10:
            continue
        gradient, intercept = np.polyfit(slopes.incidence[keep], values[keep], 1)
        # A falling regression has no meaning; a large c then leaves the picture as it is.
        c = intercept / gradient if gradient > 1e-12 else 1e6
        corrected[:, channel] = values * (level + c) / np.maximum(lit + c, 0.05)
    return corrected
