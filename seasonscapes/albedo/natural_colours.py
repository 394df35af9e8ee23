"""White balance and airlight of photographs without sky, from the colours that land can have.

Without sky in any photograph, nothing tells a camera's white balance but itself, nor the colour of the air before far land, which
depends on clouds that nobody saw and on a colour matrix that cheap cameras exaggerate. Blue that is left over is then land's: far
mountains are recovered in deep blue, and whatever is completed in their likeness as well. But no extended land is bluer than
neutral. Soil, rock and plants reflect less blue than red (Bowker et al. 1985, NASA RP-1139), snow, gravel and water about as
much; nor is land black. Therefore

- the bluest of the near ground, where it is bluer than the uncertainty of a white balance allows, is made neutral by it;
- the airlight is increased in blue until the bluest of the far ground is neutral as well, or like the bluest near by, and
  decreased in each channel as far as some far ground would otherwise reflect less than the darkest land (dark-object
  subtraction, Chavez 1988, doi:10.1016/0034-4257(88)90019-3).

What already has possible colours stays as it is.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from datetime import date, datetime

import numpy as np

from seasonscapes.albedo.assumed_exposure import ASSUMED_SIGMA, with_assumed_exposure
from seasonscapes.albedo.equations import usable_pixels
from seasonscapes.albedo.forward_model import (
    TexelTransport,
    aerial_perspective_of,
    ambient_on_texels,
    predicted_surface_radiance,
)
from seasonscapes.albedo.photographs import EIGHT_BIT, AlbedoPhotograph, NoiseModel
from seasonscapes.cameras.observation import webcam_of
from seasonscapes.sky.illumination import ScaledAir, luminance

log = logging.getLogger(__name__)

# Where the air lets through more of the blue than this, ground is near: its colours are the camera's.
_NEAR = 0.85
# Of the brighter half, this share is the bluest ground. Of all, this share may be darker than the darkest land.
_BLUEST, _DARKER = 0.1, 0.05
_DARKEST_LAND = 0.01
# Far ground is looked at in so many layers of the air before it, of equally many pixels.
_LAYERS = 4
# White balances lie within a factor of two, also of blue against red in the shade; airlight within four of the model's.
_BALANCE, _AIRLIGHT = 2.0, 4.0
# Fewer pixels have no distribution.
_FEWEST_PX = 500
# Land that reflects light onto other land; its colour is not known yet.
_REFLECTING = 0.2
_TINY = 1e-3


@dataclass(frozen=True)
class _Ground:
    """Usable terrain pixels of an hour's views: values over gain, light of white ground, transmittance, airlight, ``(n, 3)`` each."""

    radiance: np.ndarray
    white: np.ndarray
    transmittance: np.ndarray
    airlight: np.ndarray

    def albedo(self, factor: np.ndarray | float = 1.0) -> np.ndarray:
        return (self.radiance - factor * self.airlight) / (self.transmittance * self.white)

    def part(self, chosen: np.ndarray) -> _Ground:
        return _Ground(*(getattr(self, field.name)[chosen] for field in fields(self)))


def with_assumed_colours(transport: TexelTransport, photographs: Sequence[AlbedoPhotograph]) -> list[AlbedoPhotograph]:
    """Assume exposures where no photograph tells one, and correct their colours as far as land cannot have them.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    photographs
        Of one or of several days, with their lights.

    Returns
    -------
    list of AlbedoPhotograph
        In the same order; the same photographs where one of them shows sky or has a known gain. See
        `assumed_exposure.with_assumed_exposure` and `with_natural_colours`.

    Examples
    --------
    >>> with_assumed_colours(None, [])
    []
    """
    exposed = with_assumed_exposure(photographs)
    if all(after is before for after, before in zip(exposed, photographs, strict=True)):
        return exposed
    return with_natural_colours(transport, exposed)


def with_natural_colours(
    transport: TexelTransport, photographs: Sequence[AlbedoPhotograph], noise_model: NoiseModel = EIGHT_BIT
) -> list[AlbedoPhotograph]:
    """Correct white balance and airlight of photographs with an assumed gain, as far as land would have impossible colours.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    photographs
        With their lights; those with an assumed gain (`assumed_exposure.with_assumed_exposure`) are looked at.
    noise_model
        Its clipping limits tell which pixels can be used.

    Returns
    -------
    list of AlbedoPhotograph
        In the same order. Views of a panorama have one correction; all hours of the camera and UTC day have its airlight.

    Examples
    --------
    >>> with_natural_colours(None, [])
    []
    """
    hours: dict[tuple[str, datetime], list[AlbedoPhotograph]] = {}
    for each in photographs:
        if each.gain is not None and each.gain_sigma > 0.0:
            hours.setdefault((webcam_of(each.observation.webcam), each.observation.time), []).append(each)
    balance: dict[tuple[str, datetime], np.ndarray] = {}
    airlight: dict[tuple[str, date], np.ndarray] = {}
    for (webcam, time), views in sorted(hours.items()):
        found = _correction(transport, views, noise_model)
        balance[webcam, time], airlight[webcam, time.date()] = found
        if not np.allclose(np.concatenate(found), 1.0, atol=0.02):
            log.info(
                "%s %s UTC: land would be bluer or darker than land is: white balance × %s, airlight × %s (red, green, blue)",
                webcam,
                f"{time:%Y-%m-%d %H:%M}",
                *(" ".join(f"{value:.2f}" for value in each) for each in found),
            )
    result = []
    for each in photographs:
        webcam, time = webcam_of(each.observation.webcam), each.observation.time
        air, factor = each.light.aerial_perspective, airlight.get((webcam, time.date()))
        if air is not None and factor is not None:
            each = replace(each, light=replace(each.light, aerial_perspective=ScaledAir(air, factor)))
        if each.gain is not None and (webcam, time) in balance:
            each = replace(each, gain=each.gain * balance[webcam, time])
        result.append(each)
    return result


def _correction(
    transport: TexelTransport, views: list[AlbedoPhotograph], noise_model: NoiseModel
) -> tuple[np.ndarray, np.ndarray]:
    """Factors ``(3,)`` of the gain and of the airlight, of the views of one hour."""
    pieces = [_ground(transport, each, noise_model) for each in views]
    ground = _Ground(*(np.concatenate([getattr(each, field.name) for each in pieces]) for field in fields(_Ground)))
    is_near = ground.transmittance[:, 2] >= _NEAR
    gain, airlight, allowed = np.ones(3), np.ones(3), 0.0
    if is_near.sum() >= _FEWEST_PX:
        near = ground.part(is_near).albedo()
        bright, excess = _blue_excess(near)
        bluest = np.median(bright[excess >= np.quantile(excess, 1.0 - _BLUEST)], axis=0)
        by = float(np.log(np.maximum(bluest[2], _TINY) / np.maximum(bluest[0], _TINY)))
        if by > ASSUMED_SIGMA:
            gain = np.clip(bluest / luminance(bluest), 1.0 / _BALANCE, _BALANCE)
        else:
            allowed = max(0.0, by)
    if (~is_near).sum() >= _FEWEST_PX:
        far = ground.part(~is_near)
        airlight = _airlight_factor(replace(far, radiance=far.radiance / gain), allowed)
    return gain, airlight


def _airlight_factor(far: _Ground, allowed: float) -> np.ndarray:
    """Factors of the airlight, nearest to 1, with which far ground is not bluer than ``allowed``, nor, which comes first, black."""
    # What holds on the whole need not hold for the farthest: each layer of air has its own distribution.
    edges = np.quantile(far.transmittance[:, 2], np.linspace(0.0, 1.0, _LAYERS + 1)[1:-1])
    layer = np.searchsorted(edges, far.transmittance[:, 2])
    layers = [far.part(layer == number) for number in range(_LAYERS)]
    layers = [each for each in layers if len(each.radiance) >= _FEWEST_PX]
    factor = np.ones(3)

    def too_dark(value: float, channel: int) -> float:
        tried = np.where(np.arange(3) == channel, value, factor)
        return max(_DARKEST_LAND - float(np.quantile(each.albedo(tried)[:, channel], _DARKER)) for each in layers)

    def too_blue(value: float) -> float:
        tried = np.array([factor[0], factor[1], value])
        return max(float(np.quantile(_blue_excess(each.albedo(tried))[1], 1.0 - _BLUEST)) for each in layers) - allowed

    if not layers:
        return factor
    for channel in (0, 1):
        factor[channel] = 1.0 - _least(lambda less, channel=channel: too_dark(1.0 - less, channel), 0.0, 1.0)
    bluest = _least(too_blue, 0.0, _AIRLIGHT)
    wanted = max(1.0, bluest)
    factor[2] = wanted - _least(lambda less: too_dark(wanted - less, 2), 0.0, wanted)
    return factor


def _blue_excess(albedo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The brighter half of some ground ``(n, 3)``, and by how much it is bluer than neutral: the logarithm of blue over red."""
    light = luminance(albedo)
    bright = albedo[light >= np.median(light)]
    return bright, np.log(np.maximum(bright[:, 2], _TINY) / np.maximum(bright[:, 0], _TINY))


def _least(excess: Callable[[float], float], low: float, high: float) -> float:
    """The least value between two at which a decreasing function is not positive; the higher one where it is everywhere."""
    if excess(low) <= 0.0:
        return low
    for _ in range(12):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
    return high


def _ground(transport: TexelTransport, photograph: AlbedoPhotograph, noise_model: NoiseModel) -> _Ground:
    """Usable terrain pixels of a photograph with a gain."""
    observation, footprints = photograph.observation, photograph.footprints
    assert photograph.gain is not None
    reflecting = np.full((*transport.shape, 3), _REFLECTING, np.float32)
    ambient = ambient_on_texels(transport, photograph.light, reflecting)
    white = predicted_surface_radiance(
        footprints, photograph.number, photograph.light, ambient, np.ones_like(ambient, np.float32)
    )
    transmittance, airlight = aerial_perspective_of(photograph.atmosphere, photograph.light, len(footprints.pixel))
    usable = usable_pixels(observation, photograph.noise(noise_model)).ravel()[footprints.pixel]
    usable &= (white > 0.0).all(axis=1)
    values = observation.image.reshape(-1, 3)[footprints.pixel]
    return _Ground(values / photograph.gain, white, transmittance, airlight).part(usable)
