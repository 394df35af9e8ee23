"""Aerial perspective from the atmosphere model: tabulated transmittance and airlight along an observer's rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.frames import angles_from_direction
from seasonscapes.sky.observer_radiance import (
    DISTANCE_EDGES_M,
    ObserverView,
    ScatteredRadiance,
    apply_phase_functions,
    azimuth_index,
    components_at_observer,
    elevation_index,
    interpolate_azimuths,
    interpolate_multilinear,
    sky_radiance,
)
from seasonscapes.sky.scattering import AtmosphereTables
from seasonscapes.sky.spectrum import rgb_from_transfer

_CHUNK = 1 << 16  # rays whose intermediate arrays fit the processor's cache


@dataclass(frozen=True)
class TabulatedAerialPerspective:
    """Tabulated `seasonscapes.sky.illumination.AerialPerspective` of one observer.

    Parameters
    ----------
    horizon_rad
        As in `ObserverView`.
    depth_rgb
        Optical depth (negative logarithm of the transmittance) up to each of `DISTANCE_EDGES_M` ``(K, M, 3)``.
    lights
        For each luminary its sky radiance and its components up to each distance ``(K, A, M, 10)``.
    """

    horizon_rad: float
    depth_rgb: np.ndarray
    lights: tuple[tuple[ScatteredRadiance, np.ndarray], ...]

    def __call__(self, depth_m: np.ndarray | float, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate transmittance and airlight up to a distance along directions.

        The transmittance of an RGB channel is the mean over the bands, weighted by the radiance of a grey surface near
        the observer: exact for grey surfaces, within a few per cent for strongly coloured distant surfaces.

        Parameters
        ----------
        depth_m
            Distance from the observer along the ray ``(...)`` [m]; infinite for a ray without surface. One number for
            all directions, and D distances ``(D, 1, ..., 1)`` along each of them, are evaluated several times quicker.
        direction
            Unit viewing directions ``(..., 3)``.

        Returns
        -------
        transmittance
            ``(..., 3)``, or ``(D, ..., 3)``, in [0, 1].
        airlight
            Of that shape [cd/m²]; at infinite distance the sky radiance, or below the horizon the radiance of the
            model's ground through the air.
        """
        direction, depth = np.asarray(direction, float), np.asarray(depth_m, float)
        if depth.ndim == 0:
            transmittance, airlight = self._along(depth[None], direction)
            return transmittance[0], airlight[0]
        if depth.ndim == direction.ndim and depth.size == len(depth):
            return self._along(depth.ravel(), direction)
        depth = np.broadcast_to(depth, direction.shape[:-1])
        flat, flat_depth = direction.reshape(-1, 3), depth.ravel()
        transmittance, airlight = np.empty(flat.shape), np.empty(flat.shape)
        for start in range(0, len(flat), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            transmittance[chunk], airlight[chunk] = self._evaluate(flat_depth[chunk], flat[chunk])
        return transmittance.reshape(direction.shape), airlight.reshape(direction.shape)

    def _along(self, depth_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate up to each of D distances along the same directions ``(..., 3)``: ``(D, ..., 3)`` float32 each.

        The tables are interpolated in distance first: that is done once for all directions.
        """
        flat = direction.reshape(-1, 3)
        azimuth_deg, elevation_deg = angles_from_direction(flat)
        row, fr = elevation_index(np.radians(elevation_deg), self.horizon_rad)
        # A view's directions lie in few rows.
        first, rows = int(row.min()), slice(int(row.min()), int(row.max()) + 2)
        cell, fd = _distance_index(depth_m)
        fd = fd.astype(np.float32)[:, None]

        def at_distances(table: np.ndarray) -> np.ndarray:
            return table[..., cell, :] * (1.0 - fd) + table[..., cell + 1, :] * fd

        depth = interpolate_multilinear(at_distances(self.depth_rgb[rows]), ((row - first, fr),))
        airlight, to_infinity = np.zeros((len(flat), len(depth_m), 3), np.float32), np.isinf(depth_m)
        for light, near in self.lights:
            cosine = flat @ light.luminary_direction
            if to_infinity.any():
                airlight[:, to_infinity] += sky_radiance(light, flat)[:, None].astype(np.float32)
            if not to_infinity.all():
                column, fa = azimuth_index(azimuth_deg, light.luminary_direction)
                components = interpolate_multilinear(at_distances(near[rows]), ((row - first, fr), (column, fa)))
                to_surface = apply_phase_functions(light, components, cosine[:, None])
                airlight[:, ~to_infinity] += to_surface[:, ~to_infinity]
        shape = (len(depth_m), *direction.shape)
        # As below, a negative channel is clipped.
        parts = (np.exp(-depth), np.maximum(airlight, 0.0))
        transmittance, airlight = (part.swapaxes(0, 1).reshape(shape) for part in parts)
        return transmittance, airlight

    def _evaluate(self, depth_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        azimuth_deg, elevation_deg = angles_from_direction(direction)
        row, fr = elevation_index(np.radians(elevation_deg), self.horizon_rad)
        cell, fd = _distance_index(depth_m)
        transmittance = np.exp(-interpolate_multilinear(self.depth_rgb, ((row, fr), (cell, fd))))
        airlight, to_infinity = np.zeros(direction.shape), np.isinf(depth_m)
        to_surface = ~to_infinity
        for light, near in self.lights:
            airlight[to_infinity] += sky_radiance(light, direction[to_infinity])
            column, fa = azimuth_index(azimuth_deg, light.luminary_direction)
            coordinates = tuple(
                (index[to_surface], fraction[to_surface]) for index, fraction in ((row, fr), (column, fa), (cell, fd))
            )
            airlight[to_surface] += apply_phase_functions(
                light, interpolate_multilinear(near, coordinates), direction[to_surface] @ light.luminary_direction
            )
        # Colours outside the Rec.709 gamut have a negative channel; clip, as images must not be negative.
        return transmittance, np.maximum(airlight, 0.0)


def _distance_index(depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Interpolation index and fraction of distances ``(...)`` [m] among `DISTANCE_EDGES_M`; farther ones are its last."""
    finite = np.minimum(depth_m, DISTANCE_EDGES_M[-1])
    cell = np.clip(np.searchsorted(DISTANCE_EDGES_M, finite, side="right") - 1, 0, len(DISTANCE_EDGES_M) - 2)
    return cell, (finite - DISTANCE_EDGES_M[cell]) / (DISTANCE_EDGES_M[cell + 1] - DISTANCE_EDGES_M[cell])


def tabulate_aerial_perspective(
    view: ObserverView, lights: tuple[tuple[ScatteredRadiance, np.ndarray], ...], illuminant: np.ndarray
) -> TabulatedAerialPerspective:
    """Tabulate the aerial perspective of an observer.

    Parameters
    ----------
    view
        Rays of the observer.
    lights
        For each luminary its sky radiance, from `observed_sky`, and its components, from `airlight`.
    illuminant
        Spectrum of the light on surfaces as a transfer ``(B,)``; weights the transmittances of the bands.

    Returns
    -------
    TabulatedAerialPerspective
        Aerial perspective.
    """
    weights = rgb_from_transfer() * illuminant
    bands = np.exp(-view.near_depth)
    # At large distances only deep red remains, which lies outside the Rec.709 gamut, so that the weighted mean can
    # leave the range of the bands' transmittances; clip it to that range.
    low, high = bands.min(axis=-1, keepdims=True), bands.max(axis=-1, keepdims=True)
    rgb = np.clip(bands @ weights.T / weights.sum(axis=1), low, high)
    return TabulatedAerialPerspective(view.horizon_rad, -np.log(np.maximum(rgb, 1e-30)).astype(np.float32), lights)


def airlight(
    tables: AtmosphereTables,
    view: ObserverView,
    true_elevation_rad: float,
    irradiance: np.ndarray,
    diffuse: np.ndarray | None = None,
) -> np.ndarray:
    """Integrate the components of a luminary's airlight up to each of `DISTANCE_EDGES_M`.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    view
        Rays of the observer.
    true_elevation_rad
        True elevation of the luminary [rad].
    irradiance
        Extraterrestrial spectral irradiance over that of the sun at 1 au ``(B,)``.
    diffuse
        What `diffuse_at_observer` gives with ``near``, where it is known already.

    Returns
    -------
    ndarray
        Components ``(K, A, M, 10)`` as in `ScatteredRadiance`.
    """
    components = components_at_observer(tables, view, true_elevation_rad, irradiance, diffuse, near=True)
    components = interpolate_azimuths(components)
    return np.concatenate([np.zeros_like(components[:, :, :1]), components], axis=2)
