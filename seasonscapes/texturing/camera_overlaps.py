"""Overlaps of cameras: image values of the same surface points in every pair of photographs that both show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.texturing.atlas_tiles import TexelSurface
from seasonscapes.texturing.inputs import PreparedInput, sample_input, texel_extent_px, transmittance_and_airlight
from seasonscapes.texturing.visibility import project_texels, visible_by_ray

# Compared values are means over footprints of this many texel sides, so that cameras of different resolution agree.
_FOOTPRINT_TEXELS = 4.0
# At flatter incidence a pixel covers so much terrain that two cameras do not average over the same part of it.
_MIN_COSINE = 0.25
# Excludes footprints near silhouettes.
_MIN_CONFIDENCE = 0.95
# Upper limit of the number of pairs; more do not improve the fit.
_MAX_PAIRS = 60_000


@dataclass(frozen=True)
class CameraSamples:
    """Image values of N surface points, each in one camera.

    Parameters
    ----------
    camera
        ``(N,)`` index of the input.
    value
        ``(N, 3)`` image value, decoded.
    transmittance, airlight
        ``(N, 3)`` of the sky model's air between camera and point; airlight in [cd/m²].
    """

    camera: np.ndarray
    value: np.ndarray
    transmittance: np.ndarray
    airlight: np.ndarray

    def __getitem__(self, key: np.ndarray | slice) -> CameraSamples:
        """Return the samples selected by an index array, mask or slice."""
        return CameraSamples(*(getattr(self, name)[key] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class OverlapPairs:
    """N pairs of samples of the same surface point in two cameras, and M samples of single cameras.

    Parameters
    ----------
    own, other
        N samples each; elements of equal index belong to one surface point.
    uv
        ``(N, 2)`` texture coordinates of the pairs.
    single
        M samples of each input's own probes, whether visible from another camera or not.
    single_uv
        ``(M, 2)`` their texture coordinates.
    """

    own: CameraSamples
    other: CameraSamples
    uv: np.ndarray
    single: CameraSamples
    single_uv: np.ndarray


def find_overlaps(inputs: Sequence[PreparedInput], terrain: RayScene) -> OverlapPairs:
    """Sample each input's probes in its own image and in every other image that they are visible in.

    Parameters
    ----------
    inputs
        Prepared photographs.
    terrain
        Ray-tracing scene of the terrain.

    Returns
    -------
    OverlapPairs
        Empty pairs where no two views overlap.
    """
    own_parts, other_parts, single_parts = [_no_samples()], [_no_samples()], [_no_samples()]
    uv, single_uv = [np.zeros((0, 2), np.float32)], [np.zeros((0, 2), np.float32)]
    for first, prepared in enumerate(inputs):
        samples, valid = _sample_points(prepared, first, prepared.probes)
        usable = np.flatnonzero(valid)
        single_parts.append(samples[usable])
        single_uv.append(prepared.probe_uv[usable])
        for second, partner in enumerate(inputs):
            if second == first or not len(usable):
                continue
            camera, points = partner.painting_input.camera, prepared.probes[usable]
            index = usable[visible_by_ray(terrain, camera, points, project_texels(camera, points))]
            partner_samples, valid = _sample_points(partner, second, prepared.probes[index])
            own_parts.append(samples[index[valid]])
            other_parts.append(partner_samples[valid])
            uv.append(prepared.probe_uv[index[valid]])
    own, other, pair_uv = _concatenate(own_parts), _concatenate(other_parts), np.concatenate(uv)
    if len(pair_uv) > _MAX_PAIRS:
        subset = np.sort(np.random.default_rng(0).permutation(len(pair_uv))[:_MAX_PAIRS])
        own, other, pair_uv = own[subset], other[subset], pair_uv[subset]
    return OverlapPairs(own, other, pair_uv, _concatenate(single_parts), np.concatenate(single_uv))


def _sample_points(prepared: PreparedInput, number: int, points: TexelSurface) -> tuple[CameraSamples, np.ndarray]:
    """Samples of N surface points in one image, and which of them are valid ``(N,)`` bool."""
    camera = prepared.painting_input.camera
    projected = project_texels(camera, points)
    footprint = _FOOTPRINT_TEXELS * texel_extent_px(camera, points, projected)
    value, confidence = sample_input(prepared, np.where(projected.inside[:, None], projected.pixel, 0.0), footprint)
    valid = (
        projected.inside
        & (projected.cosine > _MIN_COSINE)
        & (confidence > _MIN_CONFIDENCE)
        & (value > 1e-4).all(axis=1)
    )
    return CameraSamples(
        np.full(len(value), number), value, *transmittance_and_airlight(prepared, points.position_m)
    ), valid


def _no_samples() -> CameraSamples:
    return CameraSamples(np.zeros(0, int), *(np.zeros((0, 3)) for _ in range(3)))


def _concatenate(parts: list[CameraSamples]) -> CameraSamples:
    return CameraSamples(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in CameraSamples.__dataclass_fields__)
    )
