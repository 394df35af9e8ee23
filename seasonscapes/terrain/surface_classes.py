"""Ground that is not Lambertian, as a terrain carries it: where it lies in the atlas, and what it is like."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Water:
    """Open water of a terrain.

    Parameters
    ----------
    mask
        ``(R, S)`` float32 share of each texel that is water, row 0 at v = 1; its shore is the contour of one half.
    wind_m_s
        Speed of the wind over it [m/s]; 0 is a mirror.
    """

    mask: np.ndarray
    wind_m_s: float


@dataclass(frozen=True)
class Snow:
    """Snow of a terrain, which lies where its albedo is bright and nearly white.

    Parameters
    ----------
    grain_mm
        Optical diameter of the grains of clean snow [mm], whose albedo then takes the place of the texture's; ``None``: the
        texture's albedo says how much its grains and dirt absorb.
    """

    grain_mm: float | None = None


@dataclass(frozen=True)
class AlbedoDetail:
    """Detail of the albedo below its texels, as fine as a camera sees it; see `rendering.albedo_detail`.

    Parameters
    ----------
    eye_m
        ``(3,)`` position of the camera, east-north-up [m].
    pixel_angle_rad
        Angular size of its pixels [rad].
    texel_m
        Side of the texels [m].
    seed
        Another seed gives other detail.
    """

    eye_m: tuple[float, float, float]
    pixel_angle_rad: float
    texel_m: float
    seed: int = 0
