"""Arrays of a Gaussian model for the page in a browser, which lights and draws it there.

The page evaluates `appearance.Appearance` in its own program; what does not depend on the light is prepared here.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.gaussians.disc_transport import AZIMUTHS, HORIZON_RANGE_RAD, neighbourhood_mean
from seasonscapes.gaussians.model import GaussianModel
from seasonscapes.gaussians.rasterise import ALPHA_CUT, ALPHA_MOST, PIXEL_VARIANCE
from seasonscapes.gaussians.splat_view import FULL_COVERAGE
from seasonscapes.gaussians.surfels import axes_from_quaternions
from seasonscapes.images import srgb8_from_linear

# What the page's program evaluates, and the factor of the network's shift there (`Appearance.forward`).
_SHIFTS = {"physical": 0.0, "full": 0.1, "sun": 1.0}
# Discs that a page sorts and blends at interactive rates.
MOST_DISCS = 400_000


def viewer_layer(model: GaussianModel) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Describe a model for the page.

    Parameters
    ----------
    model
        Relightable model of N Gaussians.

    Returns
    -------
    about : dict
        Plain values: kind, days of the year of the dated albedos, ranges of the quantised values, limits of rasterisation.
    arrays : dict of numpy.ndarray
        uint8, float16 and float32 arrays, some 230 bytes for each Gaussian.

    Raises
    ------
    InputError
        For an appearance that the page's program does not evaluate, and for more than `MOST_DISCS` Gaussians.
    """
    count = len(model.means)
    if model.kind not in _SHIFTS:
        raise InputError(
            "--gaussians", "the page cannot light it", got=f"kind {model.kind}", expected=", ".join(_SHIFTS)
        )
    if count > MOST_DISCS:
        cure = "distil with fewer --discs, or larger ones: --disc-px"
        raise InputError(
            "--gaussians", "more than a page draws", got=count, expected=f"at most {MOST_DISCS}", cure=cure
        )
    learned = model.appearance
    # The learned gains of colour belong to all that the albedo is multiplied with, but not to the surroundings' mean.
    surroundings = [neighbourhood_mean(model.means, values, model.spacing_m) for values in model.albedo]
    transport = model.transport
    arrays: dict[str, np.ndarray] = {
        "means": model.means.astype(np.float32),
        "axes": _half(axes_from_quaternions(model.quaternions) * np.exp(model.log_scales)[:, None, :]),
        "opacity": _half(1.0 / (1.0 + np.exp(-model.opacity_logits))),
        "normals": _half(transport.normals),
        "albedo": srgb8_from_linear(model.albedo),
        "surroundings": srgb8_from_linear(np.stack(surroundings)),
        "horizon": transport.horizon,
        "sky": (transport.sky.astype(np.int16) + 128).astype(np.uint8),
        "sky_scale": transport.sky_scale.astype(np.float32),
        "from_sky": transport.from_sky.astype(np.float32),
        "bounce": (transport.bounce.astype(np.int16) + 128).astype(np.uint8),
        "bounce_scale": transport.bounce_scale.astype(np.float32),
        "open_sky": _half(transport.open_sky),
        "log_colour": _half(learned["log_colour"]),
        "log_gain": _half(learned["log_gain"]),
        "shift": _half(learned["shift"]),
        "log_softness": _half(learned["log_softness"]),
    }
    if model.kind != "physical":
        arrays["features"] = _half(model.features)
        for layer in (0, 2, 4):
            for part in ("weight", "bias"):
                arrays[f"{part}{layer // 2}"] = learned[f"mlp.{layer}.{part}"].astype(np.float32)
    low, high = HORIZON_RANGE_RAD
    about = {
        "count": count,
        "kind": model.kind,
        "shift_of_network": _SHIFTS[model.kind],
        "days": [float(day) for day in model.days],
        "horizon_low_rad": low,
        "horizon_step_rad": (high - low) / 255.0,
        "azimuths": AZIMUTHS,
        "alpha_cut": ALPHA_CUT,
        "alpha_most": ALPHA_MOST,
        "pixel_variance": PIXEL_VARIANCE,
        "full_coverage": FULL_COVERAGE,
    }
    return about, arrays


def _half(values: np.ndarray) -> np.ndarray:
    return np.asarray(values).astype(np.float16)
