"""From absolute radiance to a picture: what a camera's program, or an eye that has adapted, makes of a scene.

* ``auto`` is a camera: average metering, with the under-exposure that keeps a night a night.
* ``eye`` is a person who has adapted: dim scenes look dim, and colour drains towards rod vision below about 3 cd/m².
* A number is EV100, for comparing pictures with each other.
"""

from __future__ import annotations

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.images import METER_CONSTANT, REC709_LUMINANCE, auto_exposure_ev100, expose, tone_curve

# Below this metered EV a camera's program, like a photographer, stops lifting all the way: a quarter stop for each
# stop that is missing, three at most.
_DIM_EV, _DIM_SLOPE, _DIM_MOST = 4.0, 0.25, 3.0
# Rods take over between these luminances [cd/m²] (mesopic range, CIE 191:2010).
_MESOPIC = (0.005, 5.0)
# Scotopic luminance from linear Rec.709, for the spectra of a typical display's primaries (Larson, Rushmeier & Piatko
# 1997, doi:10.1109/2945.646233, eq. 9 through XYZ), and the bluish grey that rod vision is matched to in pictures.
_SCOTOPIC = np.array([0.0627, 0.6072, 0.3301])
_NIGHT_TINT = np.array([0.62, 0.80, 1.35])

MODES = ("auto", "eye")


def parse_exposure(text: str) -> str | float:
    """``auto``, ``eye`` or an EV100; `InputError` otherwise."""
    if text in MODES:
        return text
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not -20.0 <= value <= 40.0:
        raise InputError(
            "--exposure", "not an exposure", got=text, expected="auto, eye, or an EV100 between -20 and 40"
        )
    return value


def exposure_ev100(image: np.ndarray, exposure: str | float = "auto") -> float:
    """The EV100 to develop a scene-linear image ``(H, W, 3)`` [cd/m²] with."""
    if not isinstance(exposure, str):
        return float(exposure)
    if exposure not in MODES:
        raise ValueError(f"exposure: got {exposure!r}, expected one of {', '.join(MODES)} or a number")
    metered = auto_exposure_ev100(image)
    if exposure == "auto":
        return metered + float(np.clip(_DIM_SLOPE * (_DIM_EV - metered), 0.0, _DIM_MOST))
    return metered + _dimness_stops(METER_CONSTANT * 2.0**metered)


def _dimness_stops(luminance: float) -> float:
    """By how many stops darker than a sunlit scene an adapted eye sees a luminance [cd/m²].

    The key value of Krawczyk, Myszkowski & Seidel 2005 (doi:10.1145/1090122.1090154, eq. 11), relative to 1,000 cd/m².
    """

    def key(value: float) -> float:
        return 1.03 - 2.0 / (2.0 + np.log10(value + 1.0))

    return float(max(np.log2(key(1000.0) / key(luminance)), 0.0))


def develop(image: np.ndarray, ev100: float, *, eye: bool = False) -> np.ndarray:
    """Display-linear picture ``(H, W, 3)`` in [0, 1] of a scene-linear image [cd/m²].

    Parameters
    ----------
    ev100
        From `exposure_ev100`.
    eye
        See dim pixels with the rods: colour drains and turns bluish (the Purkinje shift).
    """
    if eye:
        image = _through_rods(np.asarray(image, np.float64))
    return tone_curve(expose(image, ev100))


def _through_rods(image: np.ndarray) -> np.ndarray:
    luminance = np.maximum(image @ REC709_LUMINANCE, 1e-9)
    low, high = np.log10(_MESOPIC)
    rods = np.clip((high - np.log10(luminance)) / (high - low), 0.0, 1.0)[..., None]
    tint = _NIGHT_TINT / (_NIGHT_TINT @ REC709_LUMINANCE)
    grey = np.maximum(image @ _SCOTOPIC, 0.0)[..., None] * tint
    return (1.0 - rods) * image + rods * grey
