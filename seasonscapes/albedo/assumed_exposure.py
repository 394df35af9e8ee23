"""Exposure and white balance of photographs that show no sky, from which alone the albedo's scale and colour follow.

The radiance of a modelled sky over the values of its pixels is a photograph's gain (`closed_form`). Without sky in any
photograph nothing but the airlight before far terrain tells it: less than its own uncertainty, and nothing at all near the
camera. A camera's own exposure and white balance are the better witness. A grey card of 18 % on level ground comes out at 0.18 of
white by the convention of exposure meters, and without colour by that of white balance: pixel value and reflectance are then one
number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import date

import numpy as np

from seasonscapes.albedo.equations import FEWEST_SKY, usable_pixels, usable_sky
from seasonscapes.albedo.photographs import EIGHT_BIT, AlbedoPhotograph, NoiseModel
from seasonscapes.cameras.observation import webcam_of

# Automatic exposures lie within a stop of a grey card's, white balances nearer to it.
ASSUMED_SIGMA = 0.3
# Level ground has some 3 lx where civil twilight ends; in the night below, exposures end at the longest that a camera has.
_DIMMEST_LX = 3.0


def with_assumed_exposure(
    photographs: Sequence[AlbedoPhotograph], noise_model: NoiseModel = EIGHT_BIT
) -> list[AlbedoPhotograph]:
    """Give a gain to one hour of each camera and day, where no photograph shows the sky that would tell one.

    Parameters
    ----------
    photographs
        Of one or of several days, with their lights.
    noise_model
        Its clipping limits tell which pixels of the sky can be used.

    Returns
    -------
    list of AlbedoPhotograph
        In the same order; the same photographs where one of them shows sky or has a known gain. Otherwise the photograph of each
        camera and UTC day under the strongest light, or all views of a panorama then, has the gain of a camera that exposes and
        balances for level ground, by which those of the same ground find their own; photographs of the night (`too_dark`) stay
        without.

    Examples
    --------
    >>> with_assumed_exposure([])
    []
    """
    if not photographs or any(tells_gain(each, noise_model) for each in photographs):
        return list(photographs)

    def hour(photograph: AlbedoPhotograph) -> tuple[str, date]:
        # The views of a panorama share its name, and one exposure.
        return webcam_of(photograph.observation.webcam), photograph.observation.time.date()

    strongest: dict[tuple[str, date], AlbedoPhotograph] = {}
    for each in sorted(photographs, key=lambda each: each.observation.time):
        before = strongest.get(hour(each))
        if before is None or _level_lx(each) > _level_lx(before):
            strongest[hour(each)] = each
    return [
        replace(each, gain=np.pi / each.light.global_horizontal_lx, gain_sigma=ASSUMED_SIGMA)
        if each.observation.time == strongest[hour(each)].observation.time and not too_dark(each)
        else each
        for each in photographs
    ]


def too_dark(photograph: AlbedoPhotograph) -> bool:
    """Whether level ground has less light than at the end of civil twilight, where cameras cannot expose for it."""
    return _level_lx(photograph) < _DIMMEST_LX


def _level_lx(photograph: AlbedoPhotograph) -> float:
    return float(np.min(photograph.light.global_horizontal_lx))


def tells_gain(photograph: AlbedoPhotograph, noise_model: NoiseModel = EIGHT_BIT) -> bool:
    """Whether a photograph's gain is known, or told by the sky that it shows."""
    if photograph.gain is not None:
        return True
    usable = usable_pixels(photograph.observation, photograph.noise(noise_model))
    return int(usable_sky(photograph, usable).sum()) >= FEWEST_SKY
