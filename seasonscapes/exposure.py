"""Exposure and tone mapping from absolute radiance to a display-linear picture.

* ``auto``: average metering as in a camera, with reduced exposure of dim scenes so that nights stay dark.
* ``eye``: a visual adaptation model; dim scenes stay dim, and colours desaturate towards rod vision below about
  3 cd/m².
* A number: a fixed EV100, for pictures that are compared with each other.
"""

from __future__ import annotations

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.images import (
    EXPOSURE_GAIN,
    METER_CONSTANT,
    REC709_LUMINANCE,
    auto_exposure_ev100,
    expose,
    image_luminance,
    scaled_pixels,
    tone_curve,
)
from seasonscapes.photo_look import balanced, highlight_stops, photo_curve

# Below this metered EV the scene is under-exposed by a quarter stop for each stop below it, by at most three stops.
_DIM_EV, _DIM_SLOPE, _MAX_UNDEREXPOSURE = 4.0, 0.25, 3.0
# Mesopic range [cd/m²], within which vision changes from rods to cones (CIE 191:2010).
_MESOPIC = (0.005, 5.0)
# The same range for pictures by a camera [cd/m²]: below moonlight.
_MOONLESS = (0.0004, 0.02)
# Scotopic luminance from linear Rec.709, for the spectra of a typical display's primaries, close to the (0.062, 0.608,
# 0.330) of Ward Larson, Rushmeier & Piatko 1997, doi:10.1109/2945.646233, and the bluish grey that rod vision is matched to in pictures.
_SCOTOPIC = np.array([0.0627, 0.6072, 0.3301])
_NIGHT_TINT = np.array([0.62, 0.80, 1.35])

MODES = ("auto", "eye")
LOOKS = ("neutral", "photo")


def parse_exposure(text: str) -> str | float:
    """Parse the exposure given on the command line.

    Parameters
    ----------
    text
        ``auto``, ``eye`` or an EV100.

    Returns
    -------
    str or float
        The mode, or the EV100.

    Raises
    ------
    InputError
        If the text is neither a mode nor a number between -20 and 40.
    """
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


def exposure_ev100(image: np.ndarray, exposure: str | float = "auto", *, look: str = "neutral") -> float:
    """Compute the EV100 of an image under an exposure mode.

    Parameters
    ----------
    image
        Scene-linear image ``(H, W, 3)`` [cd/m²].
    exposure
        One of `MODES`, or an EV100, which is returned unchanged.
    look
        One of `LOOKS`; ``photo`` brings the highlights near white.

    Returns
    -------
    float
        EV100.

    Raises
    ------
    ValueError
        If ``exposure`` is an unknown mode.
    NoUsablePixels
        If the exposure is metered and the image has no positive luminance.
    """
    if not isinstance(exposure, str):
        return float(exposure)
    if exposure not in MODES:
        raise ValueError(f"exposure: got {exposure!r}, expected one of {', '.join(MODES)} or a number")
    metered = auto_exposure_ev100(image)
    if exposure == "auto":
        metered += float(np.clip(_DIM_SLOPE * (_DIM_EV - metered), 0.0, _MAX_UNDEREXPOSURE))
        return photo_ev100(image, metered) if look == "photo" else metered
    return metered + _adaptation_stops(METER_CONSTANT * 2.0**metered)


def photo_ev100(image: np.ndarray, neutral_ev100: float) -> float:
    """The EV100 of the look ``photo``, from that of the mode ``auto``: it brings the highlights near white."""
    exposed = expose(image_luminance(image), neutral_ev100)
    exposed *= EXPOSURE_GAIN
    return neutral_ev100 - highlight_stops(exposed, neutral_ev100)


def _adaptation_stops(luminance: float) -> float:
    """Perceived darkening [stops], relative to a sunlit scene, of a luminance [cd/m²] to which the eye has adapted.

    The key value of Krawczyk, Myszkowski & Seidel 2005 (doi:10.1145/1090122.1090154, eq. 11), relative to 1,000 cd/m².
    """

    def key(value: float) -> float:
        return 1.03 - 2.0 / (2.0 + np.log10(value + 1.0))

    return float(max(np.log2(key(1000.0) / key(luminance)), 0.0))


def develop(
    image: np.ndarray,
    ev100: float,
    *,
    eye: bool = False,
    look: str = "neutral",
    white: tuple[float, float, float] | None = None,
) -> np.ndarray:
    """Convert a scene-linear image to a display-linear picture.

    Parameters
    ----------
    image
        Scene-linear image ``(..., 3)`` [cd/m²].
    ev100
        Exposure, from `exposure_ev100`.
    eye
        Model rod vision: dim pixels are desaturated and shifted towards blue (the Purkinje shift).
    look
        ``neutral``, linear up to a shoulder, or ``photo``, see `photo_look`.
    white
        Of the look ``photo``: the colour that becomes neutral, linear Rec.709.

    Returns
    -------
    ndarray
        Display-linear picture ``(..., 3)`` in [0, 1].

    Raises
    ------
    InputError
        For an unknown look.
    """
    if look not in LOOKS:
        raise InputError("--look", "unknown look", got=look, expected=", ".join(LOOKS))
    if eye:
        image = _blend_rod_vision(np.asarray(image))
    if look == "photo":
        # A moonless sky is green of airglow; cameras' night modes, like the eye, show it grey-blue.
        image = image if eye else _blend_rod_vision(np.asarray(image), _MOONLESS)
        image = image if white is None else balanced(image, white)
        exposed = expose(image, ev100)
        exposed *= EXPOSURE_GAIN
        return photo_curve(exposed)
    return tone_curve(expose(image, ev100))


def _blend_rod_vision(image: np.ndarray, mesopic: tuple[float, float] = _MESOPIC) -> np.ndarray:
    """Blend an image with its scotopic grey by the position of each pixel's luminance in the mesopic range."""
    if not np.issubdtype(image.dtype, np.floating):
        image = image.astype(np.float64)
    luminance = np.maximum(image_luminance(image), 1e-9)
    low, high = np.log10(mesopic).tolist()
    # By day no pixel is so dim that rods see it; by night most are, and all are as quickly done.
    dim = luminance < mesopic[1]
    if not dim.any():
        return image
    chosen = dim if dim.mean() < 0.2 else np.s_[...]
    cones = image[chosen]
    rod_weight = np.clip((high - np.log10(luminance[chosen])) / (high - low), 0.0, 1.0)
    tint = _NIGHT_TINT / (_NIGHT_TINT @ REC709_LUMINANCE)
    rods = rod_weight * np.maximum(cones @ _SCOTOPIC.astype(image.dtype), 0.0)
    blended = scaled_pixels(cones, 1.0 - rod_weight)
    for channel, share in enumerate(tint.tolist()):
        blended[..., channel] += share * rods
    result = image.copy()
    result[chosen] = blended
    return result
