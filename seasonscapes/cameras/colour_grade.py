"""A named, invertible colour grade, and the camera's own response undone.

A grade is a recipe of six numbers on scene-linear colour, the identity unless asked for more. Highlights, shadows and
contrast bend one monotone curve of luminance in stops about middle grey; white balance and exposure are gains. Each has
an exact inverse, so a graded picture can be taken back to what was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.images import REC709_LUMINANCE, linear_from_srgb, srgb_from_linear

# Knots of the tone curve in stops about middle grey. Outside them it goes on with the slope it has at the end.
_KNOTS = np.array([-8.0, -4.0, -2.0, 0.0, 2.0, 4.0, 8.0])
_SHADOWS = np.array([0.6, 1.0, 0.55, 0.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class Grade:
    """A colour grade; all zero is the identity.

    Parameters
    ----------
    exposure_ev
        Stops brighter.
    contrast
        Share by which the slope about middle grey is steeper, -0.5 to 1.
    highlights_ev, shadows_ev
        Stops by which tones four stops above and below middle grey move, each within ±2. Negative highlights and
        positive shadows win back detail, as the paper's grade does.
    warmth, tint
        Stops of red against blue, and of green against magenta; luminance of grey is kept.
    middle_grey
        Linear value about which the curve turns: 0.18 of the white for pictures in [0, 1].
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
            raise ValueError("Grade: contrast, highlights and shadows together would fold the tone curve over")


def apply_grade(image: np.ndarray, grade: Grade) -> np.ndarray:
    """Grade scene-linear colour ``(..., 3)``; exactly the identity for `Grade()`."""
    values = np.asarray(image)
    if grade == Grade(middle_grey=grade.middle_grey):
        return values.copy()
    return _bend(values * _gains(grade), grade, forward=True).astype(values.dtype, copy=False)


def undo_grade(image: np.ndarray, grade: Grade) -> np.ndarray:
    """Scene-linear colour ``(..., 3)`` before a grade; the inverse of `apply_grade`."""
    values = np.asarray(image)
    if grade == Grade(middle_grey=grade.middle_grey):
        return values.copy()
    return (_bend(values, grade, forward=False) / _gains(grade)).astype(values.dtype, copy=False)


def _gains(grade: Grade) -> np.ndarray:
    gains = 2.0 ** np.array(
        [grade.warmth / 2.0 - grade.tint / 2.0, grade.tint / 2.0, -grade.warmth / 2.0 - grade.tint / 2.0]
    )
    return 2.0**grade.exposure_ev * gains / (gains @ REC709_LUMINANCE)


def _heights(grade: Grade) -> np.ndarray:
    """Stops out at the knots."""
    # Contrast steepens the middle and eases off towards both ends, as a film's curve does.
    steep = grade.contrast * np.array([-2.0, -2.0, -1.6, 0.0, 1.6, 2.0, 2.0])
    return _KNOTS + steep + grade.shadows_ev * _SHADOWS + grade.highlights_ev * _SHADOWS[::-1]


def _slopes(grade: Grade) -> np.ndarray:
    return np.diff(_heights(grade)) / np.diff(_KNOTS)


# Named grades. "paper" is what the reference describes of its hand-made one: more contrast, highlights down,
# shadows up, warmer.
GRADES = {
    "identity": Grade(),
    "paper": Grade(contrast=0.15, highlights_ev=-0.6, shadows_ev=0.6, warmth=0.15),
    "warm": Grade(warmth=0.3),
    "soft": Grade(contrast=-0.15, highlights_ev=-0.4, shadows_ev=0.4),
}


def named_grade(name: str) -> Grade:
    """The grade of that name; `ValueError` lists those there are."""
    if name not in GRADES:
        raise ValueError(f"no grade is called {name!r}; expected one of {', '.join(GRADES)}")
    return GRADES[name]


def _bend(values: np.ndarray, grade: Grade, *, forward: bool) -> np.ndarray:
    """Scale each colour so that its luminance follows the curve: hues stay, and so does black."""
    from scipy.interpolate import PchipInterpolator

    curve = PchipInterpolator(_KNOTS, _heights(grade))
    luminance = np.maximum(values @ REC709_LUMINANCE, 1e-30) / grade.middle_grey
    stops = np.log2(luminance)
    moved = _evaluate(curve, stops) if forward else _invert(curve, stops)
    return values * 2.0 ** (moved - stops)[..., None]


def _evaluate(curve, stops: np.ndarray) -> np.ndarray:
    low, high = _KNOTS[0], _KNOTS[-1]
    inside = np.clip(stops, low, high)
    ends = np.where(stops < low, float(curve(low, 1)) * (stops - low), 0.0)
    ends += np.where(stops > high, float(curve(high, 1)) * (stops - high), 0.0)
    return curve(inside) + ends


def _invert(curve, stops: np.ndarray) -> np.ndarray:
    """Bisection between knots, then Newton: the curve is smooth and monotone."""
    table = np.linspace(_KNOTS[0] - 24.0, _KNOTS[-1] + 24.0, 4001)
    guess = np.interp(stops, _evaluate(curve, table), table)
    for _ in range(4):
        inside = np.clip(guess, _KNOTS[0], _KNOTS[-1])
        guess = guess - (_evaluate(curve, guess) - stops) / np.maximum(curve(inside, 1), 1e-3)
    return guess


@dataclass(frozen=True)
class Response:
    """How a camera turned light into numbers: a monotone curve per channel, over an sRGB-like base.

    Parameters
    ----------
    linear
        ``(3, N)`` relative light at ``N`` evenly spaced encoded values from 0 to 1; increasing, 0 to 1.
    """

    linear: np.ndarray

    def __post_init__(self):
        linear = np.asarray(self.linear, float)
        if linear.ndim != 2 or linear.shape[0] != 3 or np.any(np.diff(linear, axis=1) <= 0):
            raise ValueError("Response: expected (3, N) strictly increasing values")
        object.__setattr__(self, "linear", linear)


SRGB = Response(np.repeat(linear_from_srgb(np.linspace(0, 1, 1024))[None].astype(float), 3, axis=0))


def linear_from_encoded(encoded: np.ndarray, response: Response = SRGB) -> np.ndarray:
    """Relative scene-linear light ``(..., 3)`` from encoded values in [0, 1] (or bytes)."""
    values = np.asarray(encoded)
    values = values / 255.0 if values.dtype == np.uint8 else values.astype(float)
    if response is SRGB:
        return linear_from_srgb(values)
    at = np.linspace(0.0, 1.0, response.linear.shape[1])
    return np.stack([np.interp(values[..., c], at, response.linear[c]) for c in range(3)], -1).astype(np.float32)


def encoded_from_linear(linear: np.ndarray, response: Response = SRGB) -> np.ndarray:
    """Encoded values ``(..., 3)`` in [0, 1] of relative light: what the camera would have written."""
    if response is SRGB:
        return srgb_from_linear(linear)
    at = np.linspace(0.0, 1.0, response.linear.shape[1])
    return np.stack([np.interp(linear[..., c], response.linear[c], at) for c in range(3)], -1)


def fit_response_curve(
    encoded: np.ndarray, light: np.ndarray, *, knots: int = 12, smoothness: float = 0.003
) -> Response:
    """Fit a response from pairs of encoded values and known relative light (renders, exposures, a grey card).

    The curve is a monotone correction of sRGB in the logarithm of light: knots evenly spaced in the encoded value,
    second differences held small, robustly fitted since some pairs are always wrong.

    Parameters
    ----------
    encoded, light
        ``(M, 3)`` in [0, 1], and relative linear light up to one common factor. Clipped and black values are ignored.

    Raises
    ------
    ValueError
        Fewer than 20 usable pairs in a channel, or pairs that do not rise together.
    """
    from scipy.interpolate import CubicSpline
    from scipy.optimize import least_squares

    grid, out = np.linspace(0.0, 1.0, 1024), []
    at = np.linspace(0.02, 0.98, knots)
    for channel in range(3):
        x, y = np.asarray(encoded, float)[:, channel], np.asarray(light, float)[:, channel]
        use = (x > 0.02) & (x < 0.98) & (y > 0)
        if use.sum() < 20:
            raise ValueError(
                f"fit_response: {int(use.sum())} usable pairs in channel {channel}, at least 20 are needed"
            )
        target = np.log(y[use]) - np.log(np.maximum(linear_from_srgb(x[use]).astype(float), 1e-9))
        if np.corrcoef(np.log(y[use]), x[use])[0, 1] < 0.3:
            raise ValueError("fit_response: encoded values and light do not rise together; the pairs may be mismatched")
        basis = CubicSpline(at, np.eye(knots), bc_type="natural")(np.clip(x[use], at[0], at[-1]))
        # Errors are made in the encoded value; a step of it is worth its share of the logarithm (gamma about 2.2).
        weight = np.clip(x[use], at[0], at[-1]) / 2.2
        basis, target = basis * weight[:, None], target * weight
        bend = np.diff(np.eye(knots), 2, axis=0) * np.sqrt(use.sum()) * smoothness
        solved = least_squares(
            lambda c, b=basis, t=target, d=bend: np.concatenate([b @ c - t, d @ c]),
            np.full(knots, np.median(target / weight)),
            loss="soft_l1",
            f_scale=0.02,
        )
        correction = np.exp(CubicSpline(at, solved.x, bc_type="natural")(np.clip(grid, at[0], at[-1])))
        curve = linear_from_srgb(grid).astype(float) * correction
        out.append(np.maximum.accumulate(curve) + np.arange(1024) * 1e-9 * curve[-1])
    top = max(curve[-1] for curve in out)
    return Response(np.array(out) / top)
