"""Small real places on disk, made on the spot for the tests: a GeoTIFF of a hill, an image, a scene file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

# A square of 3 km around 46.551° N, 7.98° E in UTM 32 N.
EAST_M, NORTH_M = 421_790.0, 5_155_750.0

SCENE = """name = "hill"
attribution = "made by a test"
vertical_datum = "local"

[elevation]
file = "dem.tif"

[imagery]
file = "image.tif"
encoding = "linear"
full_scale = 1.0
reflectance_scale = 1.0

[[camera]]
name = "south"
latitude_deg = 46.5405
longitude_deg = 7.98
above_ground_m = 120.0
heading_deg = 0.0
pitch_deg = -8.0
"""

# A synthetic one with two cameras.
MASSIF = """name = "little"
attribution = "made by a test"
vertical_datum = "local"

[origin]
latitude_deg = 46.55
longitude_deg = 7.98

[elevation.synthetic]
spacing_m = 60.0
detail_m = 60.0

[[camera]]
name = "aerial"
latitude_deg = 46.597988
longitude_deg = 7.91382
above_ground_m = 2000.0
heading_deg = 141.3
pitch_deg = -11.0
fov_deg = 52.0

[[camera]]
name = "meadow"
latitude_deg = 46.591238
longitude_deg = 7.962256
above_ground_m = 60.0
heading_deg = 164.3
pitch_deg = 7.0
fov_deg = 60.0
"""


def write_raster(
    path: Path,
    values: np.ndarray,
    *,
    spacing_m: float,
    crs: str | None = "EPSG:32632",
    nodata: float | None = None,
    origin: tuple[float, float] | None = None,
) -> Path:
    """A north-up float GeoTIFF ``(H, W)`` or ``(H, W, C)`` centred on the test place."""
    values = np.asarray(values, np.float32)
    values = values[..., None] if values.ndim == 2 else values
    height, width, count = values.shape
    west, north = origin or (EAST_M - width * spacing_m / 2, NORTH_M + height * spacing_m / 2)
    profile = {
        "driver": "GTiff",
        "height": height,
        "width": width,
        "count": count,
        "dtype": "float32",
        "crs": crs,
        "transform": Affine(spacing_m, 0, west, 0, -spacing_m, north),
        "nodata": nodata,
    }
    with rasterio.open(path, "w", **profile) as file:
        file.write(values.transpose(2, 0, 1))
    return path


def hill_heights(count: int = 61, spacing_m: float = 50.0) -> np.ndarray:
    axis = (np.arange(count) - count // 2) * spacing_m
    east, north = np.meshgrid(axis, -axis)
    return 1000.0 + 500.0 * np.exp(-(east**2 + (north - 200.0) ** 2) / 600.0**2)


def write_place(folder: Path, text: str = SCENE) -> Path:
    """A hill with a scene file; returns the scene file's path."""
    folder.mkdir(parents=True, exist_ok=True)
    write_raster(folder / "dem.tif", hill_heights(), spacing_m=50.0)
    image = np.full((61, 61, 3), 0.2)
    image[:, :30] = [0.4, 0.2, 0.1]
    write_raster(folder / "image.tif", image, spacing_m=50.0)
    path = folder / "hill.toml"
    path.write_text(text)
    return path
