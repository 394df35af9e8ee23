"""Tables of an observer's light by elevation of the luminary, for films: diffuse light, and all light of sun and moon when up."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from seasonscapes.sky.along_rays import diffuse_along
from seasonscapes.sky.elevation_table import tabulate_by_elevation
from seasonscapes.sky.night import moonlight_spectrum
from seasonscapes.sky.observer_radiance import components_at_observer, observer_view
from seasonscapes.sky.scattering import AtmosphereTables
from seasonscapes.sky.spectrum import WAVELENGTHS_NM


def diffuse_by_elevation(
    tables: AtmosphereTables,
    height_m: float,
    near: bool,
    *,
    part: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> np.ndarray:
    """Tabulate `observer_radiance.diffuse_at_observer` by solar elevation; takes some seconds, a part a fraction of one.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    height_m
        Height of the observer [m].
    near
        As in `observer_radiance.diffuse_at_observer`.
    part
        A part of the table, see `elevation_table.PartedTable`.
    progress
        Called with the completed fraction.

    Returns
    -------
    ndarray
        Table of `elevation_table.tabulate_by_elevation`.
    """
    view = observer_view(tables, height_m)
    samples = view.near if near else view.sky
    return tabulate_by_elevation(
        lambda suns: diffuse_along(tables, samples, view.elevation_rad, suns, cumulative=near),
        part=part,
        progress=progress,
    )


def day_by_elevation(tables: AtmosphereTables, height_m: float, near: bool, *, part: int | None = None) -> np.ndarray:
    """Tabulate `observer_radiance.components_at_observer` of the sun at 1 au by solar elevation.

    Parameters
    ----------
    tables, height_m, near, part
        As in `diffuse_by_elevation`.

    Returns
    -------
    ndarray
        Table of `elevation_table.tabulate_by_elevation`, for true elevations from `observer_radiance.LOWEST_DAY_DEG` on.
    """
    return _all_by_elevation(tables, height_m, near, np.ones(len(WAVELENGTHS_NM)), part)


def moon_by_elevation(tables: AtmosphereTables, height_m: float, near: bool, *, part: int | None = None) -> np.ndarray:
    """Tabulate `observer_radiance.components_at_observer` of light that has `night.moonlight_spectrum`, by the moon's elevation.

    Parameters
    ----------
    tables, height_m, near, part
        As in `diffuse_by_elevation`.

    Returns
    -------
    ndarray
        As of `day_by_elevation`.
    """
    return _all_by_elevation(tables, height_m, near, moonlight_spectrum(WAVELENGTHS_NM), part)


def _all_by_elevation(
    tables: AtmosphereTables, height_m: float, near: bool, irradiance: np.ndarray, part: int | None
) -> np.ndarray:
    """Table of all light of a luminary of this spectral irradiance over that of the sun at 1 au ``(B,)``."""
    view = observer_view(tables, height_m)
    samples = view.near if near else view.sky

    def components_of(suns_rad: np.ndarray) -> np.ndarray:
        diffuse = diffuse_along(tables, samples, view.elevation_rad, suns_rad, cumulative=near)
        each = [
            components_at_observer(tables, view, float(sun), irradiance, light, near=near)
            for sun, light in zip(suns_rad, diffuse, strict=True)
        ]
        return np.stack(each)

    return tabulate_by_elevation(components_of, part=part)
