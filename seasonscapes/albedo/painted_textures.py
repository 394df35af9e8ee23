"""Painted textures as observations of albedo: radiance of the surface, texel by texel, at one instant.

A painting (`texturing.painting`) is what photographs of one instant show, resampled into the texture, with the air removed
and exposures harmonised. To the recoveries it is a photograph whose every pixel is one texel, seen through no air.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime

import numpy as np

from seasonscapes.albedo.footprints import Footprints
from seasonscapes.albedo.forward_model import CameraAtmosphere, TexelTransport
from seasonscapes.albedo.photographs import AlbedoPhotograph, NoiseModel, TextureObservation
from seasonscapes.errors import NoUsablePixels
from seasonscapes.rendering.air_grid import SkyGrid
from seasonscapes.rendering.receivers import luminaries
from seasonscapes.rendering.sun_visibility import visible_cosine
from seasonscapes.sky.illumination import Illumination
from seasonscapes.terrain.surface import Texture

# Resampling blurs, and a texel that several photographs show is a blend of them.
PAINTED_NOISE = NoiseModel(model=0.05)
# Confidence of a painting beside the photographs that it was painted from, whose errors it repeats.
REPEATED = 0.1
# Standard deviation of the common scale of a painting, whose exposure the skies of its photographs gave.
_SCALE_SIGMA = 0.1
_FEWEST_FACING = 1e-3


def painted_photograph(
    transport: TexelTransport, painted: Texture, light: Illumination, time: datetime, name: str = "painted"
) -> AlbedoPhotograph:
    """Make an observation of a painted texture.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    painted
        Radiance ``(R, S, 3)`` [cd/m²] with weights ``(R, S)``, 0 where nothing is painted.
    light
        Illumination of the instant; its aerial perspective is left out.
    time
        The instant, aware.
    name
        Where it came from, for messages.

    Returns
    -------
    AlbedoPhotograph
        For `closed_form.solve_albedo` and `joint_recovery.recover_jointly`, beside photographs or alone. The weights,
        relative to their median and at most 1, are its confidence.

    Raises
    ------
    ValueError
        If the texture has another shape than the transport.
    NoUsablePixels
        If nothing is painted on the surface.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> from seasonscapes.albedo.forward_model import trace_texel_transport
    >>> place = ss.load_place("alpine_small", options=ss.MeshOptions(texel_m=120.0))
    >>> transport = trace_texel_transport(place.terrain, place.texture_shape)
    >>> light = ss.illumination(place, "2024-07-20T13:30", sky="hosek")
    >>> lit = ss.Texture(np.full((*place.texture_shape, 3), 2e3, np.float32), np.ones(place.texture_shape, np.float32))
    >>> painted_photograph(transport, lit, light, light.time).gain.tolist()
    [1.0, 1.0, 1.0]
    """
    if painted.values.shape[:2] != transport.shape:
        raise ValueError(f"painted_photograph: got a texture {painted.values.shape[:2]}, expected {transport.shape}")
    known = (painted.weight > 0.0) & np.isfinite(painted.values).all(axis=2)
    chosen = known.ravel()[transport.texel]
    if not chosen.any():
        raise NoUsablePixels(f"{name}: nothing is painted on the terrain")
    texel, ones = transport.texel[chosen].astype(np.int32), np.ones(int(chosen.sum()), np.float32)
    bodies = luminaries(light)
    cosines = [visible_cosine(transport.device_points.rays, body, rays_per_sample=4)[chosen, 0] for body in bodies]
    lit = np.full((1, len(texel)), np.nan, np.float32)
    if bodies:
        facing = transport.normal[chosen] @ np.asarray(bodies[0].direction, np.float32)
        share = np.clip(cosines[0] / np.maximum(facing, _FEWEST_FACING), 0.0, 1.0)
        lit[0] = np.where(facing > _FEWEST_FACING, share, np.nan)
    footprints = Footprints(
        None,
        transport.shape,
        texel,
        ones,
        np.arange(len(texel) + 1, dtype=np.int32),
        texel,
        ones,
        [[cosine.astype(np.float32) for cosine in cosines]],
        lit,
        ones,
        ones,
    )
    none = np.zeros((0, 3), np.float32)
    sky = SkyGrid(np.zeros(0, np.int64), none, np.zeros(0, bool), np.zeros((4, 0)), np.zeros((4, 0)), none)
    weight = painted.weight.ravel()[texel]
    return AlbedoPhotograph(
        TextureObservation(np.where(known[..., None], painted.values, 0.0).astype(np.float32), known, time, name),
        replace(light, aerial_perspective=None),
        footprints,
        0,
        CameraAtmosphere(None, sky, 0.0),
        np.ones(3),
        _SCALE_SIGMA,
        np.minimum(weight / np.median(weight), 1.0).astype(np.float32),
        PAINTED_NOISE,
    )
