"""A small world of open data on disk: items shaped as the real catalogues', pixels of known heights and colours."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from pyproj import Transformer

from seasonscapes.images import srgb_from_linear
from seasonscapes.workspace import file_hash

Field = Callable[[np.ndarray, np.ndarray], np.ndarray]


def height_m(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    """Smooth mountains anywhere on Earth, slopes up to about 30°."""
    north, east = latitude * 111.2, np.asarray(longitude) % 360.0 * 75.0
    return 1500.0 + 500.0 * np.sin(north * 1.1) * np.sin(east * 0.9) + 120.0 * np.sin(2.3 * east + 1.7 * north)


def reflectance(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    """Smooth colours ``(..., 3)``, with shadows as dark as 0.01."""
    north, east = latitude * 111.2, (np.asarray(longitude) % 360.0) * 70.0
    a, b = 0.5 + 0.5 * np.sin(1.3 * north), 0.5 + 0.5 * np.sin(0.9 * east)
    return np.stack([0.01 + 0.25 * a, 0.01 + 0.2 * b, 0.01 + 0.15 * a * b], axis=-1)


class World:
    """A folder that `stac_server.py` serves."""

    def __init__(self, folder: Path):
        self.folder = folder
        (folder / "files").mkdir(parents=True)
        self.process: subprocess.Popen | None = None

    def start(self) -> str:
        """Start the server; returns the catalogue's address."""
        server = Path(__file__).with_name("stac_server.py")
        self.process = subprocess.Popen([sys.executable, str(server), str(self.folder)])
        for _ in range(200):
            if (self.folder / "port").exists():
                return f"http://127.0.0.1:{(self.folder / 'port').read_text()}/"
            time.sleep(0.05)
        raise AssertionError("the server did not start")

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None

    def faults(self, *faults: tuple[str, str | int, int]) -> None:
        """(part of the path, status or ``cut``, times)."""
        (self.folder / "faults.json").write_text(json.dumps(faults))

    def requests(self) -> list[str]:
        """The requests since the last call."""
        log = self.folder / "requests.log"
        lines = log.read_text().splitlines() if log.exists() else []
        log.unlink(missing_ok=True)
        return lines

    def item(self, collection: str, name: str, bbox: list[float], properties: dict, assets: dict[str, dict]) -> None:
        folder = self.folder / "items" / collection
        folder.mkdir(parents=True, exist_ok=True)
        west, south, east, north = bbox
        ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
        item = {
            "type": "Feature",
            "stac_version": "1.0.0",
            "id": name,
            "collection": collection,
            "bbox": bbox,
            "geometry": {"type": "Polygon", "coordinates": [ring]},
            "properties": properties,
            "links": [],
            "assets": assets,
        }
        (folder / f"{name}.json").write_text(json.dumps(item))

    def dem_tile(
        self,
        west: float,
        south: float,
        *,
        size_deg: float = 0.15,
        samples_per_deg: int = 3600,
        heights: Field = height_m,
        collection: str = "cop-dem-glo-30",
        void: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
        name: str | None = None,
    ) -> Path:
        """A tile as Copernicus DEM has them: pixel is point, so that its corner lies half a sample off."""
        count = round(size_deg * samples_per_deg)
        step = 1.0 / samples_per_deg
        longitude = west + np.arange(count) * step
        latitude = south + size_deg - np.arange(count) * step
        x, y = np.meshgrid(longitude, latitude)
        values = np.asarray(heights(y, x), np.float32)
        if void is not None:
            values[void(y, x)] = -9999.0
        arc_seconds = "10" if samples_per_deg > 2000 else "30"
        name = name or f"Copernicus_DSM_COG_{arc_seconds}_{south:+.2f}_{west:+.2f}_DEM"
        transform = Affine(step, 0.0, west - step / 2.0, 0.0, -step, south + size_deg + step / 2.0)
        path = self.folder / "files" / collection / f"{name}.tif"
        self.raster(path, values[None], "EPSG:4326", transform, nodata=-9999.0, point=True)
        bbox = [west - step / 2.0, south + step / 2.0, west + size_deg - step / 2.0, south + size_deg + step / 2.0]
        href = f"{{base}}/files/{collection}/{name}.tif"
        asset = {"href": href, "type": "image/tiff; application=geotiff; profile=cloud-optimized", "roles": ["data"]}
        properties = {"datetime": "2021-04-22T00:00:00Z", "gsd": 30, "proj:epsg": 4326}
        self.item(collection, name, bbox, properties, {"data": asset})
        return path

    def sentinel_tile(
        self,
        when: str,
        crs: str,
        latitude: float,
        longitude: float,
        *,
        size_m: float = 8000.0,
        colours: Field = reflectance,
        classes: Field | None = None,
        baseline: str = "05.09",
        declared: bool = True,
        stored_offset: bool | None = None,
        cloud_percent: float = 3.0,
        name: str | None = None,
    ) -> str:
        """An image as Sentinel-2 collection 1 has them; what ``classes`` calls 9 is painted as a cloud.

        Numbers are shifted by 1000 from baseline 04.00 on, or as ``stored_offset`` says; ``declared`` writes scale and
        offset into the item.
        """
        x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(longitude, latitude)
        west, north = round((x - size_m / 2.0) / 20.0) * 20.0, round((y + size_m / 2.0) / 20.0) * 20.0
        stamp = when.replace("-", "").replace(":", "").rstrip("Z")
        name = name or f"S2B_T{crs[-2:]}XXX_{stamp}_{len(list(self.items()))}_L2A"
        folder = self.folder / "files" / "s2" / name
        kind10, lat, lon = self._classes(crs, west, north, size_m, 10.0, classes)
        shifted = tuple(map(int, baseline.split("."))) >= (4, 0)
        shift = 0.1 if (shifted if stored_offset is None else stored_offset) else 0.0
        values = np.asarray(colours(lat, lon))
        values = np.where((kind10 == 9)[..., None], 0.8, values)
        values = np.where((kind10 == 0)[..., None], -shift, values)
        stored = np.rint((values + shift) * 10000.0).clip(0, 65535).astype(np.uint16)
        assets = {}
        bands = [{"nodata": 0, "data_type": "uint16", "scale": 0.0001, "offset": -0.1 if shifted else 0}]
        for key, file, band in (("red", "B04", 0), ("green", "B03", 1), ("blue", "B02", 2)):
            transform = Affine(10.0, 0.0, west, 0.0, -10.0, north)
            self.raster(folder / f"{file}.tif", stored[None, ..., band], crs, transform, nodata=0)
            assets[key] = {"href": f"{{base}}/files/s2/{name}/{file}.tif", "roles": ["data", "reflectance"]}
            if declared:
                assets[key]["raster:bands"] = bands
        kind20 = self._classes(crs, west, north, size_m, 20.0, classes)[0]
        self.raster(
            folder / "SCL.tif", kind20[None].astype(np.uint8), crs, Affine(20.0, 0.0, west, 0.0, -20.0, north), nodata=0
        )
        assets["scl"] = {"href": f"{{base}}/files/s2/{name}/SCL.tif", "roles": ["data"]}
        bbox = [float(lon.min()), float(lat.min()), float(lon.max()), float(lat.max())]
        if bbox[2] - bbox[0] > 180.0:
            bbox[0], bbox[2] = float(lon[lon > 0].min()), float(lon[lon < 0].max())
        properties = {
            "datetime": when,
            "platform": "sentinel-2b",
            "eo:cloud_cover": cloud_percent,
            "s2:processing_baseline": baseline,
            "proj:epsg": int(crs[5:]),
            "view:sun_azimuth": 160.0,
            "view:sun_elevation": 55.0,
        }
        self.item("sentinel-2-c1-l2a", name, bbox, properties, assets)
        return name

    def items(self) -> list[Path]:
        return sorted((self.folder / "items").rglob("*.json"))

    def _classes(
        self, crs: str, west: float, north: float, size_m: float, spacing_m: float, classes: Field | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        count = round(size_m / spacing_m)
        x = west + (np.arange(count) + 0.5) * spacing_m
        y = north - (np.arange(count) + 0.5) * spacing_m
        lon, lat = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(*np.meshgrid(x, y))
        kind = np.full(lat.shape, 4) if classes is None else np.asarray(classes(lat, lon))
        return kind, lat, lon

    def raster(
        self,
        path: Path,
        bands: np.ndarray,
        crs: str,
        transform: Affine,
        *,
        nodata: float | None = None,
        point: bool = False,
    ) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        profile = {
            "driver": "GTiff",
            "count": len(bands),
            "height": bands.shape[1],
            "width": bands.shape[2],
            "dtype": bands.dtype.name,
            "crs": crs,
            "transform": transform,
            "nodata": nodata,
            "tiled": True,
            "blockxsize": 256,
            "blockysize": 256,
            "compress": "deflate",
        }
        with rasterio.open(path, "w", **profile) as file:
            if point:
                file.update_tags(AREA_OR_POINT="Point")
            file.write(bands)


def swisstopo_tiles(world: World, *, east_km: int, north_km: int) -> None:
    """3 × 3 tiles of swissALTI3D and SWISSIMAGE about a kilometre of the Swiss grid, as data.geo.admin.ch states them.

    One tile is also there from 2019, 50 m too high; only spacings of 2 m have files.
    """
    to_map = Transformer.from_crs("EPSG:2056", "EPSG:4326", always_xy=True)
    for east in range(east_km - 1, east_km + 2):
        for north in range(north_km - 1, north_km + 2):
            transform = Affine(2.0, 0.0, east * 1000.0, 0.0, -2.0, (north + 1) * 1000.0)
            axis = (np.arange(500) + 0.5) * 2.0
            x, y = np.meshgrid(east * 1000.0 + axis, (north + 1) * 1000.0 - axis)
            longitude, latitude = to_map.transform(x, y)
            lon, lat = to_map.transform(
                [east * 1000.0, east * 1000.0 + 1000.0], [north * 1000.0, north * 1000.0 + 1000.0]
            )
            bbox = [lon[0], lat[0], lon[1], lat[1]]
            for year in (2019, 2023) if (east, north) == (east_km, north_km) else (2023,):
                heights = height_m(latitude, longitude) + (50.0 if year == 2019 else 0.0)
                name = f"swissalti3d_{year}_{east}-{north}"
                _swisstopo(world, "ch.swisstopo.swissalti3d", name, "_2056_5728", year, bbox, transform, heights[None])
            colours = srgb_from_linear(2.0 * reflectance(latitude, longitude))
            stored = np.rint(255.0 * colours).astype(np.uint8).transpose(2, 0, 1)
            name = f"swissimage-dop10_2023_{east}-{north}"
            _swisstopo(world, "ch.swisstopo.swissimage-dop10", name, "_2056", 2023, bbox, transform, stored)


def _swisstopo(
    world: World,
    collection: str,
    name: str,
    ending: str,
    year: int,
    bbox: list[float],
    transform: Affine,
    bands: np.ndarray,
) -> None:
    file = f"{name}_2{ending}.tif"
    if bands.dtype != np.uint8:
        bands = bands.astype(np.float32)
    nodata = -9999.0 if bands.dtype == np.float32 else None
    world.raster(world.folder / "files" / collection / file, bands, "EPSG:2056", transform, nodata=nodata)
    fine = f"{name}_{0.5 if 'alti' in name else 0.1}{ending}.tif"
    assets: dict[str, dict] = {
        key: {"href": f"{{base}}/files/{collection}/{key}", "type": "image/tiff; application=geotiff", "gsd": gsd}
        for key, gsd in ((fine, 0.5 if "alti" in name else 0.1), (file, 2.0))
    }
    assets[file]["file:checksum"] = "1220" + file_hash(world.folder / "files" / collection / file)
    world.item(collection, name, bbox, {"datetime": f"{year}-01-01T00:00:00Z"}, assets)
