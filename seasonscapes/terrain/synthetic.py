"""Procedural alpine terrain with exactly known geometry and albedo, for tests, benchmarks and the bundled scene.

`alpine_massif` generates elevation and ground cover (drainage network, stream-power incision, glaciers, talus, lake);
`alpine_albedo` gives the diffuse albedo on any day of the year.
"""

from __future__ import annotations

import numpy as np

from seasonscapes.terrain.synthetic_albedo import SEASONS, alpine_albedo, alpine_albedos, snow_fraction, snow_line_m
from seasonscapes.terrain.synthetic_cover import Cover, ground_cover
from seasonscapes.terrain.synthetic_massif import (
    CENTRE_LATITUDE_DEG,
    CENTRE_LONGITUDE_DEG,
    CRS,
    SyntheticMassif,
    load_massif,
    massif_of,
    save_massif,
)
from seasonscapes.terrain.synthetic_relief import relief


def alpine_massif(*, seed: int = 1912, size_m: float = 12000.0, spacing_m: float = 15.0) -> SyntheticMassif:
    """Generate the massif at 46.55° N, 7.98° E; deterministic for a given seed.

    Parameters
    ----------
    seed
        Seed of the layout's displacement and of all noise fields.
    size_m
        Side of the square between the outermost cell centres [m].
    spacing_m
        Cell size [m]: 15, 30 or 60. Coarser grids show the same massif with less detail.

    Returns
    -------
    SyntheticMassif
        Elevation on EPSG:32632, ground cover and terrain attributes.

    Raises
    ------
    ValueError
        Another spacing, or a size outside 2000 to 12000 m or not an even multiple of the spacing.
    """
    if spacing_m not in (15.0, 30.0, 60.0):
        raise ValueError(f"spacing_m: got {spacing_m}, expected 15, 30 or 60")
    if not 2000.0 <= size_m <= 12000.0 or size_m % (2.0 * spacing_m):
        raise ValueError(f"size_m: got {size_m}, expected 2000 to 12000 and an even number of cells of {spacing_m} m")
    landform = relief(size_m / 2.0, spacing_m, seed)
    axis = (np.arange(landform.elevation.shape[0]) - (landform.elevation.shape[0] - 1) / 2.0) * spacing_m
    cover = ground_cover(landform, spacing_m, seed, axis, -axis)
    return massif_of(
        landform.elevation.astype(np.float32),
        cover,
        landform.debris.astype(np.float32),
        landform.floor.shore_m.astype(np.float32),
        seed=seed,
        spacing_m=spacing_m,
    )


__all__ = [
    "CENTRE_LATITUDE_DEG",
    "CENTRE_LONGITUDE_DEG",
    "CRS",
    "SEASONS",
    "Cover",
    "SyntheticMassif",
    "alpine_albedo",
    "alpine_albedos",
    "alpine_massif",
    "load_massif",
    "massif_of",
    "save_massif",
    "snow_fraction",
    "snow_line_m",
]
