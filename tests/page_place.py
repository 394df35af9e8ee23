"""The place that the how-to pages speak of: ``my-valley.toml`` as the page of scene files prints it, and what lies beside it.

Heights are a made-up valley of 14 km at 100 m that covers the page's coordinates, the image a picture of grass, rock and snow
under the light of the hour that the scene file states, the mesh two boxes with a texture each.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

HOWTO = Path(__file__).parents[1] / "docs" / "howto"
SPACING_M, COUNT = 100.0, 140
WEST_M, NORTH_M = 415_000.0, 5_168_500.0  # UTM 32 N; its middle is 46.602° N, 7.980° E


def page_scene(page: str = "scene-file.md") -> str:
    """The scene file of a page, its first block of TOML; the panorama an eighth as wide, for photographs of a test."""
    text = re.search(r"```toml\n(.*?)```", (HOWTO / page).read_text(encoding="utf-8"), re.DOTALL)
    assert text is not None
    scene = text[1]
    for long, short in (("width_px = 8192", "width_px = 1024"), ("height_px = 1024", "height_px = 128")):
        assert long in scene
        scene = scene.replace(long, short)
    return scene.replace("north_column_px = 1024.0", "north_column_px = 128.0")


def valley_heights() -> np.ndarray:
    """Heights ``(140, 140)`` [m]: a valley between two ranges with side valleys, steeper than snow lies."""
    x, y = np.meshgrid(np.linspace(-1, 1, COUNT), np.linspace(1, -1, COUNT))
    ranges = 1500.0 * np.abs(np.sin(1.6 * (x - 0.25 * y))) ** 1.5
    spurs = 350.0 * np.sin(9.0 * y + 2.0 * x) * np.abs(x) + 120.0 * np.sin(17.0 * x) * np.sin(15.0 * y + 1.0)
    return (900.0 + ranges + spurs).astype(np.float32)


def valley_colours(heights: np.ndarray) -> np.ndarray:
    """sRGB ``(140, 140, 3)`` of meadow, rock and snow by height and slope, shaded as at a forenoon."""
    north, east = np.gradient(heights, -SPACING_M, SPACING_M)
    slope = np.hypot(north, east)
    colours = np.full((*heights.shape, 3), (88, 104, 62), float)
    colours[slope > 0.6] = (128, 122, 115)
    colours[heights > 2100.0] = (222, 224, 228)
    cosine = (np.sin(0.65) + np.cos(0.65) * (-east * np.sin(2.6) - north * np.cos(2.6))) / np.sqrt(1.0 + slope**2)
    grain = np.random.default_rng(3).normal(0.0, 2.0, heights.shape)
    return np.clip(colours * (0.45 + 0.75 * np.clip(cosine, 0.0, 1.0))[..., None] + grain[..., None], 1, 255)


def _write(path: Path, values: np.ndarray, dtype: str) -> None:
    bands = values[None] if values.ndim == 2 else values.transpose(2, 0, 1)
    profile = {
        "driver": "GTiff", "height": COUNT, "width": COUNT, "count": len(bands), "dtype": dtype, "crs": "EPSG:32632",
        "transform": Affine(SPACING_M, 0, WEST_M, 0, -SPACING_M, NORTH_M),
    }  # fmt: skip
    with rasterio.open(path, "w", **profile) as file:
        file.write(bands.astype(dtype))


def write_page_place(folder: Path) -> Path:
    """Write everything that the pages' commands read but photographs; returns the scene file."""
    from test_meshes import write_glb

    heights = valley_heights()
    colours = valley_colours(heights)
    _write(folder / "dem.tif", heights, "float32")
    _write(folder / "ortho.tif", colours, "uint8")
    _write(folder / "autumn.tif", colours * (0.95, 0.85, 0.7), "uint8")
    write_glb(folder).rename(folder / "castle.glb")
    around = [[7.951, 46.601], [7.957, 46.601], [7.957, 46.605], [7.951, 46.605], [7.951, 46.601]]
    lake = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [around]}}
    (folder / "lakes.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [lake]}))
    scene = folder / "my-valley.toml"
    scene.write_text(page_scene(), encoding="utf-8")
    return scene


def write_photographs(folder: Path, scene: Path) -> None:
    """Pictures of the webcam ``hut`` at the hours that the page of webcams names: rendered and developed, JPEG."""
    import cv2

    import seasonscapes as ss
    from seasonscapes.cameras.webcam import read_webcams, webcam_model
    from seasonscapes.workflows.place import ground_height_m

    place = ss.load_place(str(scene))
    (webcam,) = read_webcams(scene)
    ground = ground_height_m(place, webcam.latitude_deg, webcam.longitude_deg, where=webcam.id)
    view = webcam_model(webcam, place.frame, ground_m=ground)
    pictures = folder / "webcams" / webcam.id
    pictures.mkdir(parents=True)
    for hour in ("09-00", "12-00", "16-00"):
        seen = ss.render(place, view, f"2024-09-18T{hour.replace('-', ':')}")
        encoded = np.round(255.0 * ss.srgb_from_linear(ss.develop(seen, look="neutral"))).astype(np.uint8)
        cv2.imwrite(str(pictures / f"2024-09-18T{hour}.jpg"), encoded[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
