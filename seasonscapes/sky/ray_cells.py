"""Rays cut into cells: how much of what scatters in each cell reaches the ray's start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.sky.atmosphere import Atmosphere, Optics, constituent_densities
from seasonscapes.sky.curved_rays import CurvedRays, resampled


@dataclass(frozen=True)
class CellSamples:
    """Cells of rays that start at one height: everything about them that does not know the sun.

    Parameters
    ----------
    height_m, turn_rad, elevation_rad
        Of the cells' middles ``(K, S)``.
    weight
        ``(K, S, B)``: ∫ transmittance ds over each cell, as seen from the start [m].
    aerosol_column
        ``(K, S)`` from the start to the cells' middles, in vertical columns.
    end_transmittance
        ``(K, B)`` to the end of the ray.
    paths
        The rays at the cells' edges.
    """

    height_m: np.ndarray
    turn_rad: np.ndarray
    elevation_rad: np.ndarray
    weight: np.ndarray
    aerosol_column: np.ndarray
    end_transmittance: np.ndarray
    paths: CurvedRays


def sample_cells(atmosphere: Atmosphere, scaled: Optics, paths: CurvedRays, edges_m: np.ndarray) -> CellSamples:
    """Cells between edges ``(K, S + 1)`` [m] along rays, with the transmittance-weighted length of each."""
    middles = resampled(paths, 0.5 * (edges_m[:, 1:] + edges_m[:, :-1]))
    ends = resampled(paths, edges_m)
    length = np.diff(ends.distance_m, axis=1)
    column = cell_columns(atmosphere, ends, middles)
    depth = np.einsum("cks,cb->ksb", column, scaled.extinction)
    total = np.concatenate([np.zeros_like(depth[:, :1]), np.cumsum(depth, axis=1)], axis=1)
    transmittance = np.exp(-total)
    length = np.diff(ends.distance_m, axis=1)[..., None]
    weight = transmittance[:, :-1] * -np.expm1(-depth) / np.maximum(depth, 1e-9) * length
    aerosol = np.cumsum(column[1], axis=1) - 0.5 * column[1]
    return CellSamples(
        middles.height_m, middles.turn_rad, middles.elevation_rad, weight, aerosol, transmittance[:, -1], ends
    )


def cell_columns(atmosphere: Atmosphere, ends: CurvedRays, middles: CurvedRays) -> np.ndarray:
    """Columns ``(3, K, S)`` of the constituents in each cell, by Simpson's rule."""
    density = constituent_densities(atmosphere, ends.height_m)
    mean = (density[..., 1:] + density[..., :-1] + 4.0 * constituent_densities(atmosphere, middles.height_m)) / 6.0
    return mean * np.diff(ends.distance_m, axis=1)


def local_sun(turn_rad, sun_elevation_rad, cos_azimuth) -> np.ndarray:
    """Sine of the sun's elevation at points a turn about the Earth's centre away, towards an azimuth from the sun.

    All arguments broadcast; the last is the cosine of the azimuth between ray and sun.
    """
    return np.cos(turn_rad) * np.sin(sun_elevation_rad) + np.sin(turn_rad) * np.cos(sun_elevation_rad) * cos_azimuth


def scattering_per_m(atmosphere: Atmosphere, scaled: Optics, height_m: np.ndarray) -> np.ndarray:
    """Scattering coefficients of gas and aerosol ``(2, ..., B)`` [1/m] at heights."""
    density = constituent_densities(atmosphere, height_m)[:2]
    return density[..., None] * scaled.scattering[:2].reshape(2, *(1,) * np.ndim(height_m), -1)
