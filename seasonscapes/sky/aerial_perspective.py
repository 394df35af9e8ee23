"""Aerial perspective: what the air between an observer and a mountain takes away and adds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.frames import angles_from_direction
from seasonscapes.sky.along_rays import parts_along
from seasonscapes.sky.observer_radiance import (
    DISTANCE_EDGES_M,
    ObserverView,
    ScatteredRadiance,
    azimuths_filled,
    column_of,
    diffuse_at_observer,
    interpolated,
    row_of,
    sky_radiance,
    with_phases,
)
from seasonscapes.sky.scattering import AtmosphereTables
from seasonscapes.sky.spectrum import rgb_from_transfer

_CHUNK = 1 << 16


@dataclass(frozen=True)
class TabulatedAerialPerspective:
    """Aerial perspective for one viewer; see `seasonscapes.sky.illumination.AerialPerspective`.

    Parameters
    ----------
    horizon_rad
        As in `ObserverView`.
    depth_rgb
        ``(K, M, 3)`` minus the logarithm of the transmittance up to each of the fixed distances.
    lights
        Sky of every luminary, with its parts up to each distance ``(K, A, M, 10)``.
    """

    horizon_rad: float
    depth_rgb: np.ndarray
    lights: tuple[tuple[ScatteredRadiance, np.ndarray], ...]

    def __call__(self, depth_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Transmittance ``(..., 3)`` and airlight ``(..., 3)`` [cd/m²] up to a distance along a direction.

        Airlight at infinite depth is the sky itself, or the model's own ground seen through the air.

        The transmittance of an RGB channel is the mean over the bands, weighted by what a grey surface near the viewer
        sends: exact for grey surfaces, within a few per cent for strongly coloured ones far away.
        """
        direction = np.asarray(direction, float)
        depth = np.broadcast_to(np.asarray(depth_m, float), direction.shape[:-1])
        flat, flat_depth = direction.reshape(-1, 3), depth.ravel()
        transmittance, airlight = np.empty(flat.shape), np.empty(flat.shape)
        # Pieces that fit the processor's cache.
        for start in range(0, len(flat), _CHUNK):
            part = slice(start, start + _CHUNK)
            transmittance[part], airlight[part] = self._piece(flat_depth[part], flat[part])
        return transmittance.reshape(direction.shape), airlight.reshape(direction.shape)

    def _piece(self, depth_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        azimuth_deg, elevation_deg = angles_from_direction(direction)
        row, fr = row_of(np.radians(elevation_deg), self.horizon_rad)
        finite = np.minimum(depth_m, DISTANCE_EDGES_M[-1])
        cell = np.clip(np.searchsorted(DISTANCE_EDGES_M, finite, side="right") - 1, 0, len(DISTANCE_EDGES_M) - 2)
        fd = (finite - DISTANCE_EDGES_M[cell]) / (DISTANCE_EDGES_M[cell + 1] - DISTANCE_EDGES_M[cell])
        transmittance = np.exp(-interpolated(self.depth_rgb, ((row, fr), (cell, fd))))
        airlight, endless = np.zeros(direction.shape), np.isinf(depth_m)
        ending = ~endless
        for light, near in self.lights:
            airlight[endless] += sky_radiance(light, direction[endless])
            column, fa = column_of(azimuth_deg, light.luminary_direction)
            places = tuple((index[ending], share[ending]) for index, share in ((row, fr), (column, fa), (cell, fd)))
            airlight[ending] += with_phases(
                light, interpolated(near, places), direction[ending] @ light.luminary_direction
            )
        # Colours outside Rec.709 have a negative channel; no light of a picture may be negative.
        return transmittance, np.maximum(airlight, 0.0)


def tabulate_aerial_perspective(
    view: ObserverView, lights: tuple[tuple[ScatteredRadiance, np.ndarray], ...], illuminant: np.ndarray
) -> TabulatedAerialPerspective:
    """Aerial perspective of an observer under luminaries.

    Parameters
    ----------
    lights
        For each luminary its sky, and what `airlight` gives.
    illuminant
        Transfer ``(B,)`` of the light by which surfaces are seen; it weighs the bands' transmittances.
    """
    weights = rgb_from_transfer() * illuminant
    bands = np.exp(-view.near_depth)
    # Far away only red is left, which lies outside Rec.709: a mean with negative weights, kept within the bands' own.
    least, most = bands.min(axis=-1, keepdims=True), bands.max(axis=-1, keepdims=True)
    seen = np.clip(bands @ weights.T / weights.sum(axis=1), least, most)
    return TabulatedAerialPerspective(view.horizon_rad, -np.log(np.maximum(seen, 1e-30)).astype(np.float32), lights)


def airlight(
    tables: AtmosphereTables, view: ObserverView, true_elevation_rad: float, irradiance: np.ndarray
) -> np.ndarray:
    """Parts of a luminary's light up to each of the fixed distances ``(K, A, M, 10)``; arguments of `observed_sky`."""
    colours, diffuse = (
        rgb_from_transfer() * irradiance,
        diffuse_at_observer(tables, view, true_elevation_rad, near=True),
    )
    filled = azimuths_filled(parts_along(tables, view.near, true_elevation_rad, colours, diffuse, cumulative=True))
    return np.concatenate([np.zeros_like(filled[:, :, :1]), filled], axis=2)
