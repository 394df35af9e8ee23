"""Light of one luminary that rays gather on their way to an observer: scattered once, more than once, and the ground's.

What is scattered once follows the shadow of the Earth, cell by cell, and is worked out for every sun. The diffuse rest
is most of the work and smooth in the sun's elevation: for many suns it comes from a table (`elevation_table`).
"""

from __future__ import annotations

import numpy as np

from seasonscapes.images import REC709_LUMINANCE
from seasonscapes.sky.atmosphere import delta_scaled, optics
from seasonscapes.sky.curved_rays import sun_transfer, towards_sun
from seasonscapes.sky.ray_cells import CellSamples, local_sun, scattering_per_m
from seasonscapes.sky.scattering import AtmosphereTables
from seasonscapes.sky.sh_moments import HARMONIC_ORDER, diffuse_source, sun_geometry, sun_index
from seasonscapes.sky.spectrum import WAVELENGTHS_NM, rgb_from_transfer

# From the luminary's azimuth to the opposite one.
AZIMUTHS = 12
AZIMUTHS_RAD = (np.arange(AZIMUTHS) + 0.5) * np.pi / AZIMUTHS


def parts_along(
    tables: AtmosphereTables,
    samples: CellSamples,
    sun_rad: float,
    colours: np.ndarray,
    diffuse: np.ndarray,
    *,
    cumulative: bool = False,
) -> np.ndarray:
    """Light ``(K, A, M or 1, 10)`` of one luminary: once by gas, once by aerosol, all else, and the aerosol's column.

    Light scattered once is over its phase function. The last part is the mean column of aerosol along sun, scattering
    point and eye.

    Parameters
    ----------
    sun_rad
        True elevation of the luminary.
    colours
        ``(3, B)`` weights of the bands' transfers.
    diffuse
        Transfers of all else ``(K, A, M or 1, B)``.
    cumulative
        Up to the end of each of M cells, or of the whole ray.
    """
    atmosphere = tables.atmosphere
    plain = optics(atmosphere)
    scaled = delta_scaled(plain, HARMONIC_ORDER)
    sine = local_sun(samples.turn_rad[..., None], sun_rad, np.cos(AZIMUTHS_RAD))
    column, share = towards_sun(atmosphere, tables.sun_columns, samples.height_m[..., None], np.arcsin(sine))
    arriving = np.exp((column @ -scaled.extinction).astype(np.float32)) * share[..., None].astype(np.float32)
    # Scattering with the full coefficient, attenuation with the scaled one: TMS.
    gas, aerosol = scattering_per_m(atmosphere, plain, samples.height_m) * samples.weight
    # The column is weighed by the luminance that each cell scatters.
    luminance = aerosol * (REC709_LUMINANCE @ rgb_from_transfer())
    weights = [gas[..., None] * colours.T, aerosol[..., None] * colours.T, luminance[..., None]]
    once = arriving @ np.concatenate(weights, axis=-1).astype(np.float32)
    bright = once[..., 6:] + np.float32(1e-30)
    passed = bright * (column[..., 1] + samples.aerosol_column[..., None]).astype(np.float32)[..., None]
    terms = np.concatenate([once[..., :6], passed, bright], axis=-1).swapaxes(1, 2)
    terms = np.cumsum(terms, axis=2) if cumulative else terms.sum(axis=2, keepdims=True)
    return np.concatenate(
        [terms[..., :6], diffuse @ colours.T.astype(np.float32), terms[..., 6:7] / terms[..., 7:]], -1
    )


def diffuse_along(
    tables: AtmosphereTables,
    samples: CellSamples,
    elevation_rad: np.ndarray,
    suns_rad: np.ndarray,
    *,
    cumulative: bool = False,
) -> np.ndarray:
    """Transfers ``(N, K, A, M or 1, B)`` of diffuse light along rays of K elevations under N suns [rad].

    Diffuse is what was scattered, or sent back by the ground, before it was scattered towards the observer.
    """
    scaled = delta_scaled(optics(tables.atmosphere), HARMONIC_ORDER)
    suns, azimuths = (part.ravel() for part in np.meshgrid(suns_rad, AZIMUTHS_RAD, indexing="ij"))
    _, geometry = sun_geometry(samples, elevation_rad, suns, azimuths)
    source = diffuse_source(tables.atmosphere, scaled, tables.moments, samples, geometry)
    source *= samples.weight[:, :, None].astype(np.float32)
    source = np.cumsum(source, axis=1) if cumulative else source.sum(axis=1, keepdims=True)
    by_sun = source.reshape(*source.shape[:2], len(suns_rad), AZIMUTHS, source.shape[-1])
    return by_sun.transpose(2, 0, 3, 1, 4)


def ground_along(tables: AtmosphereTables, samples: CellSamples, sun_rad: float) -> np.ndarray:
    """Transfers ``(K, A, B)`` of what the ground sends along rays that end on it."""
    atmosphere = tables.atmosphere
    scaled = delta_scaled(optics(atmosphere), HARMONIC_ORDER)
    sine = local_sun(samples.paths.turn_rad[:, -1, None], sun_rad, np.cos(AZIMUTHS_RAD))
    index, share = sun_index(sine)
    share = share[..., None]
    table = tables.moments.ground_irradiance
    direct = (
        sun_transfer(
            atmosphere, tables.sun_columns, scaled, np.full(sine.shape, atmosphere.ground_height_m), np.arcsin(sine)
        )
        * np.maximum(sine, 0.0)[..., None]
    )
    irradiance = direct + table[index] * (1.0 - share) + table[index + 1] * share
    albedo = np.broadcast_to(np.asarray(atmosphere.ground_albedo, float), WAVELENGTHS_NM.shape)
    ends = np.where(samples.paths.ends_on_ground[:, None], samples.end_transmittance, 0.0)
    return irradiance * ends[:, None, :] * albedo / np.pi
