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


@dataclass(frozen=True)
class ImageLevel:
    """An image of a part of the ground on its own map grid.

    Parameters
    ----------
    values
        ``(R, S, 4)`` float16: linear colour, and its share in what the coarser levels show; row 0 first.
    to_node, domain
        From positions in the local frame to column and row; see `terrain.surface.monomials`.
    texel_m
        Side of its pixels [m].
    rim_nodes
        Width of the rim along which it fades into the coarser levels [pixels].
    """

    values: np.ndarray
    to_node: np.ndarray
    domain: tuple[float, float, float]
    texel_m: float
    rim_nodes: float


@dataclass(frozen=True)
class ImageDetail:
    """Detail of an image finer than the texels of the atlas, relative to its mean over them; see `rendering.image_detail`.

    Parameters
    ----------
    mean
        ``(R, S, 3)`` float16 mean of the image over the atlas's texels, row 0 at v = 1; 1 where it does not reach.
    levels
        The image, coarse and wide first; the shares of the first one are those of the whole image in what lies below it.
    """

    mean: np.ndarray
    levels: tuple[ImageLevel, ...]
