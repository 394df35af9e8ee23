"""Invertible colour grades of scene-linear images, and radiometric calibration of camera response curves.

A grade has six parameters; the default is the identity. Highlights, shadows and contrast define one monotone curve of
luminance in stops about middle grey; white balance and exposure are gains. Every grade has an inverse, so that the
scene-linear values can be restored from a graded image.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.errors import NotEnoughEvidence
from seasonscapes.images import REC709_LUMINANCE, linear_from_srgb, srgb_from_linear

if TYPE_CHECKING:
    from scipy.interpolate import PchipInterpolator

# Knots of the tone curve in stops about middle grey; the curve is extrapolated linearly.
_KNOTS = np.array([-8.0, -4.0, -2.0, 0.0, 2.0, 4.0, 8.0])
_SHADOWS = np.array([0.6, 1.0, 0.55, 0.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Grade:
    """Parameters of a colour grade; the defaults are the identity.

    Parameters
    ----------
    exposure_ev
        Exposure change [stops].
    contrast
        Relative increase of the slope about middle grey, -0.5 to 1.
    highlights_ev, shadows_ev
        Shift of tones four stops above and below middle grey, each within ±2 [stops]. Negative highlights and positive
        shadows compress the dynamic range, as in the paper's grade.
    warmth, tint
        Ratio of red to blue and of green to magenta gains [stops]; the luminance of grey is preserved.
    middle_grey
        Linear value at the centre of the curve: 0.18 for images in [0, 1].
    """

    exposure_ev: float = 0.0
    contrast: float = 0.0
    highlights_ev: float = 0.0
    shadows_ev: float = 0.0
    warmth: float = 0.0
    tint: float = 0.0
    middle_grey: float = 0.18

    def __post_init__(self):
        limits = {"exposure_ev": 10.0, "highlights_ev": 2.0, "shadows_ev": 2.0, "warmth": 3.0, "tint": 3.0}
        for name, limit in limits.items():
            if not abs(getattr(self, name)) <= limit:
                raise ValueError(f"Grade: {name} = {getattr(self, name)}, expected within ± {limit:g}")
        if not -0.5 <= self.contrast <= 1.0:
            raise ValueError(f"Grade: contrast = {self.contrast}, expected -0.5 to 1")
        if not self.middle_grey > 0.0:
            raise ValueError(f"Grade: middle_grey = {self.middle_grey}, expected a positive value")
        if np.any(_slopes(self) < 0.05):
            raise ValueError(
                "Grade: contrast, highlights and shadows together would fold the tone curve; reduce one of them"
            )


def apply_grade(image: np.ndarray, grade: Grade) -> np.ndarray:
    """Apply a grade to scene-linear colour.

    Parameters
    ----------
    image
        Scene-linear Rec.709 ``(..., 3)``.
    grade
        The grade.

    Returns
    -------
    numpy.ndarray
        Graded colour ``(..., 3)`` of the same dtype; an unchanged copy for the identity.
    """
    values = np.asarray(image)
    if grade == Grade(middle_grey=grade.middle_grey):
        return values.copy()
    return _apply_tone_curve(values * _gains(grade), grade, forward=True).astype(values.dtype, copy=False)


def undo_grade(image: np.ndarray, grade: Grade) -> np.ndarray:
    """Invert `apply_grade`.

    Parameters
    ----------
    image
        Graded colour ``(..., 3)``.
    grade
        The grade that was applied.

    Returns
    -------
    numpy.ndarray
        Scene-linear Rec.709 ``(..., 3)`` of the same dtype.

    Examples
    --------
    >>> import numpy as np
    >>> from seasonscapes.cameras.colour_grade import apply_grade, named_grade, undo_grade
    >>> colour, grade = np.array([[0.2, 0.3, 0.1]]), named_grade("paper")
    >>> bool(np.allclose(undo_grade(apply_grade(colour, grade), grade), colour))
    True
    """
    values = np.asarray(image)
    if grade == Grade(middle_grey=grade.middle_grey):
        return values.copy()
    return (_apply_tone_curve(values, grade, forward=False) / _gains(grade)).astype(values.dtype, copy=False)


def _gains(grade: Grade) -> np.ndarray:
    """Exposure and white balance gains ``(3,)``."""
    gains = 2.0 ** np.array(
        [grade.warmth / 2.0 - grade.tint / 2.0, grade.tint / 2.0, -grade.warmth / 2.0 - grade.tint / 2.0]
    )
    return 2.0**grade.exposure_ev * gains / (gains @ REC709_LUMINANCE)


def _curve_values(grade: Grade) -> np.ndarray:
    """Values of the tone curve at the knots [stops]."""
    # Contrast increases the slope at the centre and decreases it towards both ends, as in a film's characteristic curve.
    steep = grade.contrast * np.array([-2.0, -2.0, -1.6, 0.0, 1.6, 2.0, 2.0])
    return _KNOTS + steep + grade.shadows_ev * _SHADOWS + grade.highlights_ev * _SHADOWS[::-1]


def _slopes(grade: Grade) -> np.ndarray:
    return np.diff(_curve_values(grade)) / np.diff(_KNOTS)


# Named grades. "paper" follows the reference's description of its manual grade: more contrast, lower highlights, lifted
# shadows, warmer white balance.
GRADES = {
    "identity": Grade(),
    "paper": Grade(contrast=0.15, highlights_ev=-0.6, shadows_ev=0.6, warmth=0.15),
    "warm": Grade(warmth=0.3),
    "soft": Grade(contrast=-0.15, highlights_ev=-0.4, shadows_ev=0.4),
}


def named_grade(name: str) -> Grade:
    """Look up a grade by its name in `GRADES`.

    Parameters
    ----------
    name
        Such as ``"paper"``.

    Returns
    -------
    Grade
        The grade.

    Raises
    ------
    ValueError
        Unknown name.
    """
    if name not in GRADES:
        raise ValueError(f"grade: unknown name {name!r}; expected one of {', '.join(GRADES)}")
    return GRADES[name]


def _apply_tone_curve(values: np.ndarray, grade: Grade, *, forward: bool) -> np.ndarray:
    """Scale each colour so that its luminance follows the curve or its inverse; hue and black are preserved."""
    from scipy.interpolate import PchipInterpolator

    curve = PchipInterpolator(_KNOTS, _curve_values(grade))
    luminance = np.maximum(values @ REC709_LUMINANCE, 1e-30) / grade.middle_grey
    stops = np.log2(luminance)
    mapped = _evaluate(curve, stops) if forward else _invert(curve, stops)
    return values * 2.0 ** (mapped - stops)[..., None]


def _evaluate(curve: PchipInterpolator, stops: np.ndarray) -> np.ndarray:
    """Tone curve with linear extrapolation."""
    low, high = _KNOTS[0], _KNOTS[-1]
    inside = np.clip(stops, low, high)
    ends = np.where(stops < low, float(curve(low, 1)) * (stops - low), 0.0)
    ends += np.where(stops > high, float(curve(high, 1)) * (stops - high), 0.0)
    return curve(inside) + ends


def _invert(curve: PchipInterpolator, stops: np.ndarray) -> np.ndarray:
    """Inverse of `_evaluate`: table look-up, refined by Newton's method."""
    table = np.linspace(_KNOTS[0] - 24.0, _KNOTS[-1] + 24.0, 4001)
    guess = np.interp(stops, _evaluate(curve, table), table)
    for _ in range(4):
        inside = np.clip(guess, _KNOTS[0], _KNOTS[-1])
        guess = guess - (_evaluate(curve, guess) - stops) / np.maximum(curve(inside, 1), 1e-3)
    return guess


@dataclass(frozen=True)
class Response:
    """Inverse camera response: relative linear light as a monotone function of the encoded value, per channel.

    Parameters
    ----------
    linear
        ``(3, N)`` relative light at ``N`` evenly spaced encoded values from 0 to 1; strictly increasing from 0 to 1.
    """

    linear: np.ndarray

    def __post_init__(self):
        linear = np.asarray(self.linear, float)
        if linear.ndim != 2 or linear.shape[0] != 3 or np.any(np.diff(linear, axis=1) <= 0):
            raise ValueError("Response: expected (3, N) strictly increasing values")
        object.__setattr__(self, "linear", linear)


SRGB = Response(np.repeat(linear_from_srgb(np.linspace(0, 1, 1024))[None].astype(float), 3, axis=0))


def linear_from_encoded(encoded: np.ndarray, response: Response = SRGB) -> np.ndarray:
    """Convert encoded values to relative scene-linear light.

    Parameters
    ----------
    encoded
        ``(..., 3)`` in [0, 1], or uint8.
    response
        Camera response; sRGB by default.

    Returns
    -------
    numpy.ndarray
        Relative light ``(..., 3)`` float32.
    """
    values = np.asarray(encoded)
    values = values / 255.0 if values.dtype == np.uint8 else values.astype(float)
    if response is SRGB:
        return linear_from_srgb(values)
    levels = np.linspace(0.0, 1.0, response.linear.shape[1])
    return np.stack([np.interp(values[..., c], levels, response.linear[c]) for c in range(3)], -1).astype(np.float32)


def encoded_from_linear(linear: np.ndarray, response: Response = SRGB) -> np.ndarray:
    """Convert relative scene-linear light to encoded values; the inverse of `linear_from_encoded`.

    Parameters
    ----------
    linear
        Relative light ``(..., 3)``.
    response
        Camera response; sRGB by default.

    Returns
    -------
    numpy.ndarray
        Encoded values ``(..., 3)`` in [0, 1].
    """
    if response is SRGB:
        return srgb_from_linear(linear)
    levels = np.linspace(0.0, 1.0, response.linear.shape[1])
    return np.stack([np.interp(linear[..., c], response.linear[c], levels) for c in range(3)], -1)


def fit_response_curve(
    encoded: np.ndarray, light: np.ndarray, *, knots: int = 12, smoothness: float = 0.003
) -> Response:
    """Fit a camera response to pairs of encoded values and known relative light (renders, exposures, a grey card).

    The response is sRGB times a smooth factor: a natural cubic spline in the logarithm of light over the encoded value,
    with a penalty on second differences and a robust loss (soft L1) against outliers.

    Parameters
    ----------
    encoded
        Encoded values ``(M, 3)`` in [0, 1]. Values below 0.02 and above 0.98 are ignored.
    light
        Relative linear light ``(M, 3)``, up to one common factor.
    knots
        Number of spline knots.
    smoothness
        Weight of the penalty.

    Returns
    -------
    Response
        The fitted response, normalised to a maximum of 1.

    Raises
    ------
    NotEnoughEvidence
        Fewer than 20 usable pairs in a channel, or pairs without positive correlation.
    """
    from scipy.interpolate import CubicSpline
    from scipy.optimize import least_squares

    grid, curves = np.linspace(0.0, 1.0, 1024), []
    positions = np.linspace(0.02, 0.98, knots)
    for channel in range(3):
        x, y = np.asarray(encoded, float)[:, channel], np.asarray(light, float)[:, channel]
        use = (x > 0.02) & (x < 0.98) & (y > 0)
        if use.sum() < 20:
            raise NotEnoughEvidence(
                f"fit_response_curve: {int(use.sum())} usable pairs in channel {channel}, at least 20 are needed"
            )
        target = np.log(y[use]) - np.log(np.maximum(linear_from_srgb(x[use]).astype(float), 1e-9))
        if np.corrcoef(np.log(y[use]), x[use])[0, 1] < 0.3:
            raise NotEnoughEvidence(
                "fit_response_curve: encoded values and light do not rise together; the pairs may be mismatched"
            )
        basis = CubicSpline(positions, np.eye(knots), bc_type="natural")(np.clip(x[use], positions[0], positions[-1]))
        # Errors are assumed uniform in the encoded value x: the weight is dx / d log(light) for a gamma of about 2.2.
        weight = np.clip(x[use], positions[0], positions[-1]) / 2.2
        basis, target = basis * weight[:, None], target * weight
        penalty = np.diff(np.eye(knots), 2, axis=0) * np.sqrt(use.sum()) * smoothness
        solved = least_squares(
            lambda c, b=basis, t=target, d=penalty: np.concatenate([b @ c - t, d @ c]),
            np.full(knots, np.median(target / weight)),
            loss="soft_l1",
            f_scale=0.02,
        )
        correction = np.exp(
            CubicSpline(positions, solved.x, bc_type="natural")(np.clip(grid, positions[0], positions[-1]))
        )
        curve = linear_from_srgb(grid).astype(float) * correction
        curves.append(np.maximum.accumulate(curve) + np.arange(1024) * 1e-9 * curve[-1])
    maximum = max(curve[-1] for curve in curves)
    return Response(np.array(curves) / maximum)
