"""Places that two cameras see: what each of them shows there, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.texturing.atlas_tiles import TexelSurface
from seasonscapes.texturing.inputs import PreparedInput, air_to, sample_input, texel_extent_px
from seasonscapes.texturing.visibility import by_ray, project_texels

# Compared places are means over this many texels' sides, so that cameras of unlike resolution see alike.
_FOOTPRINT_TEXELS = 4.0
# Flatter than this a pixel covers so much land that two cameras do not see the same.
_LEAST_COSINE = 0.25
# Hardly a silhouette under the footprint.
_LEAST_TRUST = 0.95
# More than these tell no more.
_MOST_PAIRS = 60_000


@dataclass(frozen=True)
class CameraSamples:
    """What cameras show of N places.

    Parameters
    ----------
    camera
        ``(N,)`` index of the shot.
    value
        ``(N, 3)`` picture value, decoded.
    transmittance, airlight
        ``(N, 3)`` of the sky model's air up to the place.
    """

    camera: np.ndarray
    value: np.ndarray
    transmittance: np.ndarray
    airlight: np.ndarray

    def __getitem__(self, key) -> CameraSamples:
        return CameraSamples(*(getattr(self, name)[key] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class OverlapPairs:
    """N pairs: ``own`` and ``other`` show one place, whose texture coordinates are ``uv`` ``(N, 2)``.

    ``alone`` and ``alone_uv`` are each shot's places whether another sees them or not.
    """

    own: CameraSamples
    other: CameraSamples
    uv: np.ndarray
    alone: CameraSamples
    alone_uv: np.ndarray


def find_overlaps(inputs: Sequence[PreparedInput], terrain: RayScene) -> OverlapPairs:
    """Each shot's probes beside every other shot that sees them too."""
    mine, theirs, alone = [_nothing()], [_nothing()], [_nothing()]
    uv, alone_uv = [np.zeros((0, 2), np.float32)], [np.zeros((0, 2), np.float32)]
    for first, ready in enumerate(inputs):
        own, known = _samples(ready, first, ready.probes)
        sound = np.flatnonzero(known)
        alone.append(own[sound])
        alone_uv.append(ready.probe_uv[sound])
        for second, partner in enumerate(inputs):
            if second == first or not len(sound):
                continue
            camera = partner.item.observation.camera
            index = sound[by_ray(terrain, camera, ready.probes[sound], project_texels(camera, ready.probes[sound]))]
            beside, known = _samples(partner, second, ready.probes[index])
            mine.append(own[index[known]])
            theirs.append(beside[known])
            uv.append(ready.probe_uv[index[known]])
    own, other, place = _joined(mine), _joined(theirs), np.concatenate(uv)
    if len(place) > _MOST_PAIRS:
        some = np.sort(np.random.default_rng(0).permutation(len(place))[:_MOST_PAIRS])
        own, other, place = own[some], other[some], place[some]
    return OverlapPairs(own, other, place, _joined(alone), np.concatenate(alone_uv))


def _samples(ready: PreparedInput, number: int, places: TexelSurface) -> tuple[CameraSamples, np.ndarray]:
    """What a shot shows of places, and where that is sound ``(N,)`` bool."""
    camera = ready.item.observation.camera
    sight = project_texels(camera, places)
    footprint = _FOOTPRINT_TEXELS * texel_extent_px(camera, places, sight)
    value, confidence = sample_input(ready, np.where(sight.inside[:, None], sight.pixel, 0.0), footprint)
    sound = sight.inside & (sight.cosine > _LEAST_COSINE) & (confidence > _LEAST_TRUST) & (value > 1e-4).all(axis=1)
    return CameraSamples(np.full(len(value), number), value, *air_to(ready, places.position_m)), sound


def _nothing() -> CameraSamples:
    return CameraSamples(np.zeros(0, int), *(np.zeros((0, 3)) for _ in range(3)))


def _joined(parts: list[CameraSamples]) -> CameraSamples:
    return CameraSamples(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in CameraSamples.__dataclass_fields__)
    )
