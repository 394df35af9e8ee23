"""Ground that is not Lambertian, in the pixels of photographs: snow and forest as factors, water left out.

Snow scatters forwards and forest has a hot spot, so that their radiance towards a camera is a factor times that of Lambertian
ground of the same albedo, as the renderer has it (`rendering.ground_optics`). The factor depends on the albedo itself, and is
computed anew in each round of the closed form. Water mirrors what no texel knows: its pixels tell no albedo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.photographs import AlbedoPhotograph, kept_pixels
from seasonscapes.errors import NoUsablePixels
from seasonscapes.rendering.ground_optics import GroundOptics
from seasonscapes.rendering.receivers import luminaries
from seasonscapes.rendering.terrain_material import ground_optics

# Pixels with a larger share of water tell no albedo.
MOST_WATER = 0.02


@dataclass(frozen=True)
class GroundFactors:
    """Radiance towards the camera relative to that of Lambertian ground, in n terrain pixels.

    Parameters
    ----------
    diffuse
        ``(n, 3)`` under sky and interreflection.
    luminaries
        ``(n, 3)`` for each of sun and moon.
    """

    diffuse: np.ndarray
    luminaries: list[np.ndarray]


@dataclass(frozen=True)
class GroundPixels:
    """Normals and viewing directions of the terrain pixels of one photograph.

    Parameters
    ----------
    optics
        How its ground reflects.
    photograph
        The photograph.
    normal, viewer
        ``(n, 3)`` unit vectors: mean normal, and direction to the camera.
    """

    optics: GroundOptics
    photograph: AlbedoPhotograph
    normal: np.ndarray
    viewer: np.ndarray

    def factors(self, albedo: np.ndarray) -> GroundFactors:
        """Factors under an albedo ``(R·S, 3)``."""
        footprints = self.photograph.footprints
        mean = footprints.matrix(footprints.share) @ albedo / np.maximum(footprints.coverage, 1e-3)[:, None]
        out = np.einsum("nk,nk->n", self.normal, self.viewer)
        direct = []
        for body in luminaries(self.photograph.light):
            light = np.asarray(body.direction, np.float32)
            cosines = (out, self.normal @ light, self.viewer @ light)
            direct.append(self.optics.relative_rows(mean, cosines))
        return GroundFactors(self.optics.relative_diffuse_rows(mean, out), direct)


def ground_pixels(transport: TexelTransport, photograph: AlbedoPhotograph) -> GroundPixels | None:
    """How the ground in a photograph's pixels is seen.

    Parameters
    ----------
    transport
        Its terrain says what is not Lambertian; positions and normals of the texels.
    photograph
        The photograph.

    Returns
    -------
    GroundPixels or None
        ``None`` where all ground is Lambertian, and for painted textures, which no camera sees.
    """
    optics, camera = ground_optics(transport.ray_scene.mi_terrain.bsdf()), photograph.footprints.camera
    if optics is None or camera is None:
        return None
    footprints = photograph.footprints
    size = transport.shape[0] * transport.shape[1]
    matrix = footprints.matrix(footprints.share)
    weight = np.zeros((size, 1), np.float32)
    weight[transport.texel] = 1.0
    known = np.maximum(matrix @ weight, 1e-6)
    vectors = []
    for values in (transport.normal, transport.position_m):
        of_texels = np.zeros((size, 3), np.float32)
        of_texels[transport.texel] = values
        vectors.append(matrix @ of_texels / known)
    normal, viewer = vectors[0], camera.position_m.astype(np.float32) - vectors[1]
    normal, viewer = (each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), 1e-6) for each in (normal, viewer))
    return GroundPixels(optics, photograph, normal, viewer)


def without_water(photographs: Sequence[AlbedoPhotograph], water: np.ndarray) -> tuple[list[AlbedoPhotograph], float]:
    """Leave out the terrain pixels of photographs that show water.

    Parameters
    ----------
    photographs
        The photographs.
    water
        ``(R, S)`` share of each texel that is water.

    Returns
    -------
    photographs
        In the same order, without those that show no other ground.
    share
        Of all terrain pixels, how many were left out, 0 to 1.

    Raises
    ------
    NoUsablePixels
        Where no photograph shows any other ground.
    """
    wet = water.ravel().astype(np.float32)
    kept = {
        id(each.footprints): each.footprints.matrix(each.footprints.share) @ wet <= MOST_WATER for each in photographs
    }
    left_out = 1.0 - float(np.mean(np.concatenate(list(kept.values()))))
    of_land = [each for each in photographs if kept[id(each.footprints)].any()]
    if not of_land:
        raise NoUsablePixels("albedo: all pixels on terrain show water, which tells no albedo")
    return kept_pixels(of_land, lambda footprints: kept[id(footprints)]), left_out
