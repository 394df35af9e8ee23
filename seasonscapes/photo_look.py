"""The look of a photograph: white balance for the colour of the sun, metering that keeps highlights, a filmic curve.

Scene-linear radiance shown as it is looks flat and grey-blue beside a photograph. Cameras balance white for sunlight,
place the highlights near white, and apply a curve of higher contrast. All constants were chosen by eye on ten renders
beside photographs of mountains; nothing in the chain of measurements uses them.
"""

from __future__ import annotations

import numpy as np

from seasonscapes.images import REC709_LUMINANCE, XYZ_FROM_REC709, largest_channel, scaled_pixels

# CIE daylight of 5,500 K in linear Rec.709, the balance of daylight film.
DAYLIGHT_RGB = (1.1038901, 0.9870861, 0.8219280)
# The camera's balance follows the sun's colour this far only: a low sun stays warm in the picture.
_MOST_RED, _LEAST_BLUE = 1.14, 0.86
# Linear Rec.709 to the cone responses of Bradford's chromatic adaptation (Lindbloom; ICC.1:2022, annex E).
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_CONES = _BRADFORD @ XYZ_FROM_REC709
# Highlights: this percentile of the exposed luminance is moved towards this value, by at most these stops.
_HIGHLIGHT_PERCENTILE, _HIGHLIGHT, _STOPS = 97.0, 0.8, (-0.3, 0.9)
# Below this EV the picture is a night's, which stays dark.
_DIM_EV = 4.0
# Contrast of the curve in log-log about middle grey, and the share of its per-channel form, which saturates colours.
_CONTRAST, _PER_CHANNEL, _GREY = 1.6, 0.6, 0.18


def white_point(sun_lx: np.ndarray | None) -> tuple[float, float, float]:
    """Return the colour that a camera takes for white, linear Rec.709 of luminance 1.

    Parameters
    ----------
    sun_lx
        Normal illuminance ``(3,)`` of the sun; ``None`` without one (then the balance is neutral).
    """
    if sun_lx is None or not sun_lx[1] > 0.0:
        return (1.0, 1.0, 1.0)
    white = np.array([min(sun_lx[0] / sun_lx[1], _MOST_RED), 1.0, max(sun_lx[2] / sun_lx[1], _LEAST_BLUE)])
    red, green, blue = white / (white @ REC709_LUMINANCE)
    return float(red), float(green), float(blue)


def balanced(image: np.ndarray, white: tuple[float, float, float]) -> np.ndarray:
    """Adapt an image so that ``white`` becomes neutral (von Kries scaling of Bradford's cone responses).

    Parameters
    ----------
    image
        ``(..., 3)`` linear Rec.709.
    white
        Linear Rec.709.

    Returns
    -------
    numpy.ndarray
        ``(..., 3)``, not negative.
    """
    gains = (_CONES @ np.ones(3)) / (_CONES @ np.asarray(white, float))
    matrix = np.linalg.inv(_CONES) @ np.diag(gains) @ _CONES
    import cv2  # slow to load; as a matrix product it takes ten times as long

    values = np.ascontiguousarray(image)
    if values.dtype not in (np.float32, np.float64):
        values = values.astype(np.float32)
    if values.size == 0:
        return values
    adapted = np.asarray(cv2.transform(values.reshape(1, -1, 3), matrix.astype(np.float32))).reshape(values.shape)
    return np.maximum(adapted, 0.0, out=adapted)


def highlight_stops(exposed: np.ndarray, ev100: float) -> float:
    """Stops by which to brighten an image that is exposed for middle grey, so that its highlights come near white.

    Parameters
    ----------
    exposed
        ``(H, W, 3)`` exposed linear values, or their luminance ``(H, W)``.
    ev100
        Of that exposure; nights are brightened by at most 0.6 stops, whatever their highlights.
    """
    if ev100 < _DIM_EV:
        # The curve darkens shadows, and a night is all shadows.
        return float(np.clip((_DIM_EV - ev100) / 13.0, 0.0, 0.6))
    luminance = exposed if np.ndim(exposed) == 2 else np.asarray(exposed, np.float64) @ REC709_LUMINANCE
    highlight = max(float(np.percentile(luminance[np.isfinite(luminance)], _HIGHLIGHT_PERCENTILE)), 1e-6)
    return float(np.clip(np.log2(_HIGHLIGHT / highlight), *_STOPS))


def photo_curve(exposed: np.ndarray) -> np.ndarray:
    """Apply a filmic curve: a sigmoid of the logarithm (Naka & Rushton 1966) that maps middle grey to itself.

    Parameters
    ----------
    exposed
        ``(..., 3)`` exposed linear values, not negative.

    Returns
    -------
    numpy.ndarray
        ``(..., 3)`` float32 display-linear values in [0, 1).
    """
    import cv2  # slow to load; its power of an array takes a quarter of NumPy's time

    colour = np.maximum(np.asarray(exposed, np.float32), 0.0).reshape(-1, 3)
    half = np.float32(_GREY**_CONTRAST * (1.0 / _GREY - 1.0))

    def curve(values: np.ndarray) -> np.ndarray:
        power = np.asarray(cv2.pow(values, _CONTRAST)).reshape(values.shape)
        power /= power + half
        return power

    peak = largest_channel(colour)
    scale = curve(peak) / np.maximum(peak, np.float32(1e-12)) * np.float32(1.0 - _PER_CHANNEL)
    shown = curve(colour)
    shown *= np.float32(_PER_CHANNEL)
    shown += scaled_pixels(colour, scale[:, 0])
    return shown.reshape(np.shape(exposed))
