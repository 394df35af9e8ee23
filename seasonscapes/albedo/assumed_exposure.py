"""Exposure and white balance of photographs that show no sky, from which alone the albedo's scale and colour follow.

The radiance of a modelled sky over the values of its pixels is a photograph's gain (`closed_form`). Without sky in any
photograph nothing but the airlight before far terrain tells it: less than its own uncertainty, and nothing at all near the
camera. A camera's own exposure and white balance are the better witness. A grey card of 18 % on level ground comes out at 0.18 of
white by the convention of exposure meters, and without colour by that of white balance: pixel value and reflectance are then one
number.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from seasonscapes.albedo.equations import FEWEST_SKY, usable_pixels, usable_sky
from seasonscapes.albedo.photographs import EIGHT_BIT, AlbedoPhotograph, NoiseModel

log = logging.getLogger(__name__)

# Automatic exposures lie within a stop of a grey card's, white balances nearer to it.
_GAIN_SIGMA = 0.3
# Level ground has some 3 lx where civil twilight ends; in the night below, exposures end at the longest that a camera has.
_DARKEST_LX = 3.0


def with_assumed_exposure(
    photographs: Sequence[AlbedoPhotograph], noise_model: NoiseModel = EIGHT_BIT
) -> list[AlbedoPhotograph]:
    """Give a gain to one photograph of each day, where no photograph shows the sky that would tell one.

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
        UTC day under the strongest light has the gain of a camera that exposes and balances for level ground, by which
        those of the same ground find their own; days that have none but photographs of the night (level ground below 3 lx) are
        named and stay without.

    Examples
    --------
    >>> with_assumed_exposure([])
    []
    """
    if not photographs or any(_tells_gain(each, noise_model) for each in photographs):
        return list(photographs)

    def level_lx(photograph: AlbedoPhotograph) -> float:
        return float(np.min(photograph.light.global_horizontal_lx))

    strongest: dict = {}
    for number, each in enumerate(photographs):
        day = each.observation.time.date()
        if day not in strongest or level_lx(each) > level_lx(photographs[strongest[day]]):
            strongest[day] = number
    lit = [number for number in strongest.values() if level_lx(photographs[number]) >= _DARKEST_LX]
    dark = sorted(str(day) for day, number in strongest.items() if number not in lit)
    if lit:
        log.warning(
            "no photograph shows enough sky to tell its exposure and white balance: they are taken as set for level ground, so that "
            "brightness and colours of the albedo are the camera's own"
        )
    if dark:
        log.warning(
            "%s: no photograph shows enough sky to tell its exposure, and all were taken at night, where a camera's own is not known",
            ", ".join(dark),
        )
    result = list(photographs)
    for number in lit:
        level = photographs[number].light.global_horizontal_lx
        result[number] = replace(photographs[number], gain=np.pi / level, gain_sigma=_GAIN_SIGMA)
    return result


def _tells_gain(photograph: AlbedoPhotograph, noise_model: NoiseModel) -> bool:
    if photograph.gain is not None:
        return True
    usable = usable_pixels(photograph.observation, photograph.noise(noise_model))
    return int(usable_sky(photograph, usable).sum()) >= FEWEST_SKY
