"""White balance and airlight of photographs without sky, from the colours that land can have.

Without sky in any photograph, nothing tells a camera's white balance but itself, nor the colour of the air before far land, which
depends on clouds that nobody saw and on a colour matrix that cheap cameras exaggerate. Blue that is left over is then land's: far
mountains are recovered in deep blue, and whatever is completed in their likeness as well. But no extended land is bluer than
neutral. Soil, rock and plants reflect less blue than red (Bowker et al. 1985, NASA RP-1139), snow, gravel and water about as
much; nor is land black. Therefore

- the bluest of the brightest near ground, where it is bluer than the uncertainty of a white balance allows, is made neutral by it;
- the airlight is decreased, of all colours alike, as far as some far ground would otherwise reflect less than the darkest land (dark-object
  subtraction, Chavez 1988, doi:10.1016/0034-4257(88)90019-3), and increased in blue until the bluest of the bright far ground
  is neutral as well, or like the bluest near by. Its spectrum stays smooth: green changes with blue by a power of the wavelength.

Extended land is what covers some pixels each way: single pixels are bluer by noise and by the lens.

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
# White balances come from this share of the brightest near ground, and of that from the bluest share: snow, gravel, wet ground.
_BRIGHTEST_NEAR, _BLUEST_NEAR = 0.1, 0.1
# Airlight comes from more of the ground, since what is noise near by is noise over transmittance far off.
_BRIGHTEST_FAR, _BLUEST_FAR = 0.2, 0.25
# Snow, and shade that the sky lights, may be bluer than red by so much (of the logarithm).
_NEUTRAL = 0.1
# Of all, this share may be darker than the darkest land.
_DARKER, _DARKEST_LAND = 0.05, 0.01
# Far ground is looked at in so many layers of the air before it, of equally many pixels.
_LAYERS = 4
# White balances lie within a factor of two, also of blue against red in the shade; airlight within four of the model's.
_BALANCE, _AIRLIGHT = 2.0, 4.0
# Pixels are averaged over blocks of so many each way. Fewer blocks have no distribution.
_BLOCK_PX, _FEWEST_BLOCKS = 4, 32
# Where green lies between red and blue in the logarithm of the wavelength: 550 between 610 and 465 nm.
_GREEN = 0.38
# Land that reflects light onto other land; its colour is not known yet.
_REFLECTING = 0.2
_TINY = 1e-3


@dataclass(frozen=True)
class _Ground:
    """Usable terrain of an hour's views, by blocks of pixels: values over gain, light of white ground, transmittance, airlight, ``(n, 3)`` each."""

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
    gain, airlight, allowed = np.ones(3), np.ones(3), _NEUTRAL
    if is_near.sum() >= _FEWEST_BLOCKS:
        bright, excess = _blue_excess(ground.part(is_near).albedo(), _BRIGHTEST_NEAR)
        bluest = np.median(bright[excess >= np.quantile(excess, 1.0 - _BLUEST_NEAR)], axis=0)
        by = float(np.log(np.maximum(bluest[2], _TINY) / np.maximum(bluest[0], _TINY)))
        if by > ASSUMED_SIGMA:
            gain = np.clip(bluest / luminance(bluest), 1.0 / _BALANCE, _BALANCE)
        else:
            allowed = max(allowed, by)
    if (~is_near).sum() >= _FEWEST_BLOCKS:
        far = ground.part(~is_near)
        airlight = _airlight_factor(replace(far, radiance=far.radiance / gain), allowed)
    return gain, airlight


def _airlight_factor(far: _Ground, allowed: float) -> np.ndarray:
    """Factors of the airlight with which bright far ground is not bluer than allowed, nor any, which comes first, black.

    The amount of air is decreased as the darkest channel wants it, of all colours alike; then blue and green are increased.
    """
    # What holds on the whole need not hold for the farthest: each layer of air has its own distribution.
    edges = np.quantile(far.transmittance[:, 2], np.linspace(0.0, 1.0, _LAYERS + 1)[1:-1])
    layer = np.searchsorted(edges, far.transmittance[:, 2])
    layers = [far.part(layer == number) for number in range(_LAYERS)]
    layers = [each for each in layers if len(each.radiance) >= _FEWEST_BLOCKS]
    if not layers:
        return np.ones(3)

    def too_dark(factor: np.ndarray, channel: int) -> float:
        return _DARKEST_LAND - min(float(np.quantile(each.albedo(factor)[:, channel], _DARKER)) for each in layers)

    def too_blue(factor: np.ndarray) -> float:
        excess = (_blue_excess(each.albedo(factor), _BRIGHTEST_FAR)[1] for each in layers)
        return max(float(np.quantile(each, 1.0 - _BLUEST_FAR)) for each in excess) - allowed

    def not_dark(wanted: float, least: float, channel: int) -> float:
        """The factor nearest to a wanted one, but not below the least, at which this channel is not too dark."""
        return wanted - _least(lambda less: too_dark(np.full(3, wanted - less), channel), 0.0, wanted - least)

    least = min(not_dark(1.0, _TINY, channel) for channel in range(3))
    wanted = _spectrum(least, _least(lambda blue: too_blue(_spectrum(least, blue)), least, _AIRLIGHT))
    return np.array([not_dark(value, least, channel) for channel, value in enumerate(wanted)])


def _spectrum(red: float, blue: float) -> np.ndarray:
    """Red, green and blue factor of an airlight that changes by a power of the wavelength."""
    return np.array([red, red ** (1.0 - _GREEN) * blue**_GREEN, blue])


def _blue_excess(albedo: np.ndarray, brightest: float) -> tuple[np.ndarray, np.ndarray]:
    """The brightest share of some ground ``(n, 3)``, and by how much it is bluer than neutral: the logarithm of blue over red."""
    light = luminance(albedo)
    bright = albedo[light >= np.quantile(light, 1.0 - brightest)]
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
    """Usable terrain of a photograph with a gain, averaged over blocks of pixels that are at least half of it."""
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
    width = observation.image.shape[1]
    row, column = np.divmod(footprints.pixel[usable], width)
    _, block, count = np.unique(
        (row // _BLOCK_PX) * width + column // _BLOCK_PX, return_inverse=True, return_counts=True
    )
    whole = count >= _BLOCK_PX**2 // 2

    def averaged(each: np.ndarray) -> np.ndarray:
        sums = [np.bincount(block, each[usable, channel]) for channel in range(3)]
        return (np.stack(sums, axis=1) / count[:, None])[whole]

    return _Ground(*map(averaged, (values / photograph.gain, white, transmittance, airlight)))
