"""Discretisation of rays into cells, with the transmittance-weighted length of each cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.sky.atmosphere import Atmosphere, Optics, constituent_densities
from seasonscapes.sky.curved_rays import CurvedRays, resample_rays


@dataclass(frozen=True)
class CellSamples:
    """Cells of K rays with a common origin: all quantities that do not depend on the sun.

    Parameters
    ----------
    height_m, central_angle_rad, elevation_rad
        Height [m], angle about the Earth's centre from the origin [rad] and local elevation of the ray [rad] at the
        midpoints of the cells ``(K, S)``.
    weight
        ∫ transmittance ds over each cell, with the transmittance from the origin ``(K, S, B)`` [m].
    aerosol_column
        Aerosol column from the origin to the midpoints, in vertical columns ``(K, S)``.
    end_transmittance
        Transmittance of the whole ray ``(K, B)``.
    edges
        The rays at the edges of the cells.
    """

    height_m: np.ndarray
    central_angle_rad: np.ndarray
    elevation_rad: np.ndarray
    weight: np.ndarray
    aerosol_column: np.ndarray
    end_transmittance: np.ndarray
    edges: CurvedRays


def sample_cells(atmosphere: Atmosphere, scaled: Optics, rays: CurvedRays, edges_m: np.ndarray) -> CellSamples:
    """Divide rays into cells and integrate the transmittance over each cell.

    Parameters
    ----------
    atmosphere
        Atmosphere.
    scaled
        Optical depths that determine the transmittance.
    rays
        K rays.
    edges_m
        Arc lengths of the cell edges ``(K, S + 1)`` [m].

    Returns
    -------
    CellSamples
        S cells on each ray.
    """
    midpoints = resample_rays(rays, 0.5 * (edges_m[:, 1:] + edges_m[:, :-1]))
    edges = resample_rays(rays, edges_m)
    length = np.diff(edges.distance_m, axis=1)
    column = cell_columns(atmosphere, edges, midpoints)
    depth = np.einsum("cks,cb->ksb", column, scaled.extinction)
    total = np.concatenate([np.zeros_like(depth[:, :1]), np.cumsum(depth, axis=1)], axis=1)
    transmittance = np.exp(-total)
    length = np.diff(edges.distance_m, axis=1)[..., None]
    weight = transmittance[:, :-1] * -np.expm1(-depth) / np.maximum(depth, 1e-9) * length
    aerosol = np.cumsum(column[1], axis=1) - 0.5 * column[1]
    return CellSamples(
        midpoints.height_m,
        midpoints.central_angle_rad,
        midpoints.elevation_rad,
        weight,
        aerosol,
        transmittance[:, -1],
        edges,
    )


def cell_columns(atmosphere: Atmosphere, edges: CurvedRays, midpoints: CurvedRays) -> np.ndarray:
    """Integrate the column of each constituent over each cell by Simpson's rule.

    Parameters
    ----------
    atmosphere
        Atmosphere.
    edges, midpoints
        The rays at the edges ``(K, S + 1)`` and at the midpoints ``(K, S)`` of the cells.

    Returns
    -------
    ndarray
        Columns of gas, aerosol and ozone in vertical columns ``(3, K, S)``.
    """
    density = constituent_densities(atmosphere, edges.height_m)
    mean = (density[..., 1:] + density[..., :-1] + 4.0 * constituent_densities(atmosphere, midpoints.height_m)) / 6.0
    return mean * np.diff(edges.distance_m, axis=1)


def local_sun_sine(central_angle_rad: ArrayLike, sun_elevation_rad: ArrayLike, cos_azimuth: ArrayLike) -> np.ndarray:
    """Compute the sine of the true solar elevation at points along a ray, by spherical trigonometry.

    Parameters
    ----------
    central_angle_rad
        Angle about the Earth's centre between the origin of the ray and the point ``(...)`` [rad].
    sun_elevation_rad
        True solar elevation at the origin ``(...)`` [rad].
    cos_azimuth
        Cosine of the azimuth between ray and sun at the origin ``(...)``.

    Returns
    -------
    ndarray
        Sine of the elevation above the horizontal plane of the point ``(...)``.
    """
    return (
        np.cos(central_angle_rad) * np.sin(sun_elevation_rad)
        + np.sin(central_angle_rad) * np.cos(sun_elevation_rad) * cos_azimuth
    )


def scattering_per_m(atmosphere: Atmosphere, optics: Optics, height_m: np.ndarray) -> np.ndarray:
    """Compute the scattering coefficients of gas and aerosol.

    Parameters
    ----------
    atmosphere
        Atmosphere.
    optics
        Vertical optical depths, scaled or not.
    height_m
        Height ``(...)`` [m].

    Returns
    -------
    ndarray
        Scattering coefficients ``(2, ..., B)`` [1/m].
    """
    density = constituent_densities(atmosphere, height_m)[:2]
    return density[..., None] * optics.scattering[:2].reshape(2, *(1,) * np.ndim(height_m), -1)
