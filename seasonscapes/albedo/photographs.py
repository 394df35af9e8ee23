"""Photographs prepared for albedo estimation: each with its light, pixel footprints and noise model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime

import numpy as np

from seasonscapes.albedo.footprints import Footprints, thinned_footprints, trace_footprints
from seasonscapes.albedo.forward_model import CameraAtmosphere, TexelTransport, camera_atmosphere
from seasonscapes.cameras.observation import Observation
from seasonscapes.rendering.receivers import luminaries
from seasonscapes.sky.illumination import Illumination

Progress = Callable[[float], None]


@dataclass(frozen=True)
class NoiseModel:
    """Standard deviations of pictures and forward model, which weight the residuals.

    Parameters
    ----------
    model
        Relative standard deviation of the modelled radiance: Monte Carlo noise, relief below texel size.
    edge
        Relative standard deviation of sunlight where a shadow's edge crosses the pixel: penumbra and terrain are not
        exact.
    sky
        Relative standard deviation of the sky's radiance.
    levels
        Highest level of the picture's encoding (255 for 8 bits); ``None`` for linear floats.
    level_noise
        Standard deviation of rounding and JPEG compression, in levels of the encoded picture.
    black, white
        Linear values at and beyond which a pixel is unusable (1 clips); for encoded pictures only.
    """

    model: float = 0.02
    edge: float = 0.15
    sky: float = 0.03
    levels: int | None = None
    level_noise: float = 1.5
    black: float = 0.0015
    white: float = 0.97


LINEAR = NoiseModel()
EIGHT_BIT = NoiseModel(levels=255)


@dataclass(frozen=True)
class TextureObservation:
    """A painted texture in the place of a photograph; see `cameras.observation.Observation`, whose names it has.

    Parameters
    ----------
    image
        ``(R, S, 3)`` float32 radiance [cd/m²].
    mask
        ``(R, S)`` bool, True where it is painted.
    time
        Aware time.
    webcam
        Where it came from.
    camera, pose_sigma
        None, and nothing.
    """

    image: np.ndarray
    mask: np.ndarray
    time: datetime
    webcam: str
    camera: None = None
    pose_sigma: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class AlbedoPhotograph:
    """One photograph or painted texture, its light, and the footprints of its pixels.

    Parameters
    ----------
    observation
        Picture and mask; values are linear in any unit, 1 clips for encoded pictures.
    light
        Illumination at its camera.
    footprints, number
        Footprints of its camera, and the index of its light among their T lights.
    atmosphere
        Pixels of its camera at which aerial perspective and sky radiance are evaluated.
    gain
        ``(3,)`` known pixel value over radiance; ``None`` if exposure and white balance are unknown.
    gain_sigma
        Relative standard deviation of a known gain; 0 if it is exact.
    confidence
        ``(n,)`` factors of the inverse variance of its terrain pixels; ``None`` for 1.
    noise_model
        Its own standard deviations; ``None`` for those that all photographs share.
    """

    observation: Observation | TextureObservation
    light: Illumination
    footprints: Footprints
    number: int
    atmosphere: CameraAtmosphere
    gain: np.ndarray | None = None
    gain_sigma: float = 0.0
    confidence: np.ndarray | None = None
    noise_model: NoiseModel | None = None

    def noise(self, shared: NoiseModel) -> NoiseModel:
        """Its own noise model, or the one that all share."""
        return self.noise_model or shared


def prepare_photographs(
    transport: TexelTransport,
    observations: Sequence[Observation],
    lights: Sequence[Illumination],
    *,
    rays: int = 16,
    gains: Sequence[np.ndarray | None] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[AlbedoPhotograph]:
    """Trace the footprints of all cameras, each camera once for all its photographs.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    observations
        K pictures.
    lights
        Illumination of each picture.
    rays
        Rays in each pixel.
    gains
        Known pixel value over radiance, ``(3,)`` each, or ``None``; all are unknown if omitted.
    seed
        Seed of ray positions and sampled sky pixels.
    progress
        Called with the finished fraction.

    Returns
    -------
    list of AlbedoPhotograph
        Photographs in the order of the observations.

    Raises
    ------
    ValueError
        If there is no observation, or not one light for each.
    NoTerrainInView
        If a camera's view contains no terrain.
    """
    report = progress or (lambda fraction: None)
    if len(observations) != len(lights) or not observations:
        raise ValueError(
            f"prepare_photographs: got {len(observations)} photographs and {len(lights)} lights, "
            "expected one light per photograph"
        )
    groups: dict[bytes, list[int]] = {}
    for index, observation in enumerate(observations):
        camera = observation.camera
        size = np.array([camera.width_px, camera.height_px, camera.fx, camera.fy, camera.cx, camera.cy])
        groups.setdefault(size.tobytes() + camera.world_from_camera.tobytes(), []).append(index)
    photographs: dict[int, AlbedoPhotograph] = {}
    for done, members in enumerate(groups.values()):
        bodies = [luminaries(lights[i]) for i in members]
        footprints = trace_footprints(
            transport.ray_scene,
            observations[members[0]].camera,
            transport.shape,
            bodies,
            rays=rays,
            seed=seed,
            progress=lambda fraction, done=done: report((done + fraction) / len(groups)),
        )
        atmosphere = camera_atmosphere(footprints, seed=seed)
        for number, i in enumerate(members):
            gain = None if gains is None or gains[i] is None else np.broadcast_to(np.asarray(gains[i], float), (3,))
            photographs[i] = AlbedoPhotograph(observations[i], lights[i], footprints, number, atmosphere, gain)
    return [photographs[i] for i in range(len(observations))]


def thinned_photographs(photographs: Sequence[AlbedoPhotograph], fraction: float, seed: int) -> list[AlbedoPhotograph]:
    """Draw a random subset of the terrain pixels of photographs.

    Parameters
    ----------
    photographs
        Photographs of one camera share their footprints, and receive the same subset.
    fraction
        Fraction of the pixels to keep.
    seed
        Seed of the draw.

    Returns
    -------
    list of AlbedoPhotograph
        Photographs in the same order.
    """
    if fraction >= 1.0:
        return list(photographs)
    rng = np.random.default_rng(seed)
    return kept_pixels(photographs, lambda footprints: rng.random(len(footprints.pixel)) < fraction)


def kept_pixels(
    photographs: Sequence[AlbedoPhotograph], chosen: Callable[[Footprints], np.ndarray]
) -> list[AlbedoPhotograph]:
    """Photographs with some of their terrain pixels.

    Parameters
    ----------
    photographs
        Photographs of one camera share their footprints, and keep the same pixels.
    chosen
        Which terrain pixels to keep, ``(n,)`` bool, of the footprints of a camera.
    """
    thinned: dict[int, tuple[Footprints, CameraAtmosphere, np.ndarray]] = {}
    result = []
    for photograph in photographs:
        if id(photograph.footprints) not in thinned:
            keep = chosen(photograph.footprints)
            part = thinned_footprints(photograph.footprints, keep)
            atmosphere = replace(camera_atmosphere(part), sky=photograph.atmosphere.sky)
            thinned[id(photograph.footprints)] = (part, atmosphere, keep)
        footprints, atmosphere, keep = thinned[id(photograph.footprints)]
        confidence = None if photograph.confidence is None else photograph.confidence[keep]
        result.append(replace(photograph, footprints=footprints, atmosphere=atmosphere, confidence=confidence))
    return result
