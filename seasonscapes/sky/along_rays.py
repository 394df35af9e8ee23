"""Radiance of one luminary integrated along rays: single scattering, multiple scattering and ground reflection.

Single scattering depends on the Earth's shadow in each cell and is computed for every solar position. Multiple
scattering takes most of the time and is smooth in solar elevation; for many solar positions it is interpolated in a
table (`elevation_table`).
"""

from __future__ import annotations

import numpy as np

from seasonscapes.images import REC709_LUMINANCE
from seasonscapes.sky.atmosphere import delta_scaled, optics
from seasonscapes.sky.curved_rays import MANY_LIT, slant_columns_to_sun, sun_transfer
from seasonscapes.sky.ray_cells import CellSamples, local_sun_sine, scattering_per_m
from seasonscapes.sky.scattering import AtmosphereTables
from seasonscapes.sky.sh_moments import HARMONIC_ORDER, diffuse_source, sun_geometry, sun_index
from seasonscapes.sky.spectrum import WAVELENGTHS_NM, rgb_from_transfer

# Azimuths between the luminary's (0) and the opposite one (π).
AZIMUTHS = 12
AZIMUTHS_RAD = (np.arange(AZIMUTHS) + 0.5) * np.pi / AZIMUTHS


def radiance_components(
    tables: AtmosphereTables,
    samples: CellSamples,
    sun_elevation_rad: float,
    rgb_matrix: np.ndarray,
    diffuse: np.ndarray,
    *,
    cumulative: bool = False,
) -> np.ndarray:
    """Integrate the components of one luminary's scattered radiance along rays.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    samples
        M cells on each of K rays.
    sun_elevation_rad
        True elevation of the luminary [rad].
    rgb_matrix
        Matrix from band transfers to RGB ``(3, B)``.
    diffuse
        Transfers of all other light ``(K, A, M or 1, B)``, from `diffuse_along`.
    cumulative
        Integrate up to the end of each of the M cells in place of the whole ray.

    Returns
    -------
    ndarray
        ``(K, A, M or 1, 10)`` for A azimuths, float32: RGB scattered once by gas and RGB scattered once by aerosol,
        both divided by their phase functions; RGB of all other light; and the mean aerosol column along the path
        luminary - scattering point - observer, in vertical columns.
    """
    atmosphere = tables.atmosphere
    unscaled = optics(atmosphere)
    scaled = delta_scaled(unscaled, HARMONIC_ORDER)
    sine = local_sun_sine(samples.central_angle_rad[..., None], sun_elevation_rad, np.cos(AZIMUTHS_RAD))
    column, visible = slant_columns_to_sun(atmosphere, tables.sun_columns, samples.height_m[..., None], np.arcsin(sine))
    # By night most of the air is in the Earth's shadow.
    lit = visible > 0.0
    arriving = np.zeros((*lit.shape, len(WAVELENGTHS_NM)), np.float32)
    at_lit = ... if np.count_nonzero(lit) > MANY_LIT * lit.size else lit
    direct = np.exp((column[at_lit] @ -scaled.extinction).astype(np.float32))
    arriving[at_lit] = direct * visible[at_lit][..., None].astype(np.float32)
    # TMS method: scattering with the unscaled coefficient, attenuation with the scaled one.
    gas, aerosol = scattering_per_m(atmosphere, unscaled, samples.height_m) * samples.weight
    # The mean aerosol column is weighted by the luminance scattered in each cell.
    luminance = aerosol * (REC709_LUMINANCE @ rgb_from_transfer())
    weights = [gas[..., None] * rgb_matrix.T, aerosol[..., None] * rgb_matrix.T, luminance[..., None]]
    once = arriving @ np.concatenate(weights, axis=-1).astype(np.float32)
    scattered = once[..., 6:] + np.float32(1e-30)
    weighted_column = scattered * (column[..., 1] + samples.aerosol_column[..., None]).astype(np.float32)[..., None]
    terms = np.concatenate([once[..., :6], weighted_column, scattered], axis=-1).swapaxes(1, 2)
    terms = np.cumsum(terms, axis=2) if cumulative else terms.sum(axis=2, keepdims=True)
    return np.concatenate(
        [terms[..., :6], diffuse @ rgb_matrix.T.astype(np.float32), terms[..., 6:7] / terms[..., 7:]], -1
    )


def diffuse_along(
    tables: AtmosphereTables,
    samples: CellSamples,
    elevation_rad: np.ndarray,
    sun_elevations_rad: np.ndarray,
    *,
    cumulative: bool = False,
) -> np.ndarray:
    """Integrate diffuse light scattered towards the observer along rays.

    Diffuse light was scattered, or reflected by the ground, at least once before it is scattered into the ray.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    samples
        M cells on each of K rays.
    elevation_rad
        Elevation of the rays at the observer ``(K,)`` [rad].
    sun_elevations_rad
        True elevations of the luminary ``(N,)`` [rad].
    cumulative
        Integrate up to the end of each of the M cells in place of the whole ray.

    Returns
    -------
    ndarray
        Transfers ``(N, K, A, M or 1, B)`` [1/sr] for A azimuths, float32.
    """
    scaled = delta_scaled(optics(tables.atmosphere), HARMONIC_ORDER)
    suns, azimuths = (grid.ravel() for grid in np.meshgrid(sun_elevations_rad, AZIMUTHS_RAD, indexing="ij"))
    geometry = sun_geometry(samples, elevation_rad, suns, azimuths)
    source = diffuse_source(tables.atmosphere, scaled, tables.moments, samples, geometry)
    source *= samples.weight[:, :, None].astype(np.float32)
    source = np.cumsum(source, axis=1) if cumulative else source.sum(axis=1, keepdims=True)
    by_sun = source.reshape(*source.shape[:2], len(sun_elevations_rad), AZIMUTHS, source.shape[-1])
    return by_sun.transpose(2, 0, 3, 1, 4)


def ground_along(tables: AtmosphereTables, samples: CellSamples, sun_elevation_rad: float) -> np.ndarray:
    """Compute the attenuated radiance of the ground along rays that end on it.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    samples
        Cells on each of K rays.
    sun_elevation_rad
        True elevation of the luminary [rad].

    Returns
    -------
    ndarray
        Transfers ``(K, A, B)`` [1/sr] for A azimuths; zero for rays that do not end on the ground.
    """
    atmosphere = tables.atmosphere
    scaled = delta_scaled(optics(atmosphere), HARMONIC_ORDER)
    sine = local_sun_sine(samples.edges.central_angle_rad[:, -1, None], sun_elevation_rad, np.cos(AZIMUTHS_RAD))
    index, fraction = sun_index(sine)
    fraction = fraction[..., None]
    table = tables.moments.ground_irradiance
    direct = (
        sun_transfer(
            atmosphere, tables.sun_columns, scaled, np.full(sine.shape, atmosphere.ground_height_m), np.arcsin(sine)
        )
        * np.maximum(sine, 0.0)[..., None]
    )
    irradiance = direct + table[index] * (1.0 - fraction) + table[index + 1] * fraction
    albedo = np.broadcast_to(np.asarray(atmosphere.ground_albedo, float), WAVELENGTHS_NM.shape)
    transmittance = np.where(samples.edges.ends_on_ground[:, None], samples.end_transmittance, 0.0)
    return irradiance * transmittance[:, None, :] * albedo / np.pi
