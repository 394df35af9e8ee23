"""Photographs made ready for solving: each with its light, its footprints, and how far it is to be trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.albedo.footprints import Footprints, thinned_footprints, trace_footprints
from seasonscapes.albedo.forward_model import CameraAtmosphere, TexelTransport, camera_atmosphere
from seasonscapes.cameras.observation import Observation
from seasonscapes.rendering.receivers import luminaries
from seasonscapes.sky.illumination import Illumination

Progress = Callable[[float], None]


@dataclass(frozen=True)
class NoiseModel:
    """What pictures and model promise: standard deviations that weigh the residuals.

    Parameters
    ----------
    model
        Of the modelled radiance, relative: sampling of light, sub-texel relief.
    edge
        Of sunlight where a shadow's edge runs through the pixel, relative: penumbra and terrain are never exact.
    sky
        Of the sky's radiance, relative.
    levels
        Bits of the picture's encoding; ``None`` for linear floats. Rounding and JPEG blur about one level.
    level_noise
        Standard deviation in levels of the encoded picture.
    black, white
        Linear values at and beyond which a pixel says nothing, of 1 that clips; for encoded pictures only.
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
class AlbedoPhotograph:
    """One photograph, its light, and where its pixels lie in the footprints of its camera.

    Parameters
    ----------
    observation
        Picture and mask; values are linear in any unit, 1 clips for encoded pictures.
    light
        As seen from its camera.
    footprints, number
        Of its camera, and which of their lights this is.
    seen
        Of its camera.
    gain
        ``(3,)`` known picture value over radiance; ``None`` where exposure and white balance are to be found.
    """

    observation: Observation
    light: Illumination
    footprints: Footprints
    number: int
    seen: CameraAtmosphere
    gain: np.ndarray | None = None


def prepare_photographs(
    land: TexelTransport,
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
    gains
        Known picture value over radiance, ``(3,)`` each; left out, unknown.
    """
    tell = progress or (lambda share: None)
    if len(observations) != len(lights) or not observations:
        raise ValueError(
            f"make_shots: got {len(observations)} photographs and {len(lights)} lights, one of each expected"
        )
    groups: dict[bytes, list[int]] = {}
    for index, one in enumerate(observations):
        camera = one.camera
        size = np.array([camera.width_px, camera.height_px, camera.fx, camera.fy, camera.cx, camera.cy])
        groups.setdefault(size.tobytes() + camera.world_from_camera.tobytes(), []).append(index)
    photographs: dict[int, AlbedoPhotograph] = {}
    for done, members in enumerate(groups.values()):
        suns = [luminaries(lights[i]) for i in members]
        footprints = trace_footprints(
            land.ray_scene,
            observations[members[0]].camera,
            land.shape,
            suns,
            rays=rays,
            seed=seed,
            progress=lambda share, done=done: tell((done + share) / len(groups)),
        )
        seen = camera_atmosphere(footprints, seed=seed)
        for number, i in enumerate(members):
            gain = None if gains is None or gains[i] is None else np.broadcast_to(np.asarray(gains[i], float), (3,))
            photographs[i] = AlbedoPhotograph(observations[i], lights[i], footprints, number, seen, gain)
    return [photographs[i] for i in range(len(observations))]


def thinned_photographs(photographs: Sequence[AlbedoPhotograph], share: float, seed: int) -> list[AlbedoPhotograph]:
    """The same photographs with a share of their terrain pixels."""
    if share >= 1.0:
        return list(photographs)
    rng = np.random.default_rng(seed)
    made: dict[int, tuple[Footprints, object]] = {}
    result = []
    for photograph in photographs:
        if id(photograph.footprints) not in made:
            part = thinned_footprints(photograph.footprints, rng.random(len(photograph.footprints.pixel)) < share)
            made[id(photograph.footprints)] = part, replace(camera_atmosphere(part), sky=photograph.seen.sky)
        footprints, seen = made[id(photograph.footprints)]
        result.append(replace(photograph, footprints=footprints, seen=seen))
    return result
