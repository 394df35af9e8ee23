"""Detail near the eye: invented relief against withheld truth, near texels over 60 km, snow and water against theory.

    python benchmarks/detail.py [--quick] [--seed N] [--data FOLDER] [--json FILE]

Each elevation raster is averaged over 4 × 4 cells and amplified four times; slopes, the spectrum of the roughness and the
lengths of shadows are compared with the withheld raster. A gain of 1 means as the truth, 0 no nearer than bicubic
interpolation. The rasters are four of 2.5 to 10 m below ``--data`` (default: the environment's ``SEASONSCAPES_DATA``, or
``../shared/data``); those that are not there are told and left out. The synthetic massif, whose own relief ends at its
lattice of 60 m, is no truth about finer relief: its gains (``massif_…``) are printed beside, and stand for the others only
where there are none.

Beside sunny photographs of a webcam, plain and amplified pictures of the same instants are compared by how their detail falls off
towards the pixel (`detail_photograph`): ``photograph_gain`` is 1 where the amplified ones are like photographs.

A place of 60 × 50 km is made on the spot, and a picture by a camera 2 m above its ground taken in a fresh process and
workspace with ``--amplify``: ``first_picture_s`` is its wall time, ``peak_gb`` its largest memory, ``near_texel_px`` the
largest size of an element of the albedo in the lowest rows of the picture. ``--quick`` renders it at 768 × 512 instead of
1536 × 1024 pixels and takes the massif at 30 m.

The same place with finer data of a square of 6 km about the camera (heights of 1.6 m, 1.5 m above the coarse ones, an image of
0.8 m; ``--quick``: 3.1 and 1.6 m) gives ``nested_first_picture_s``, ``nested_peak_gb`` and ``nested_near_texel_px``, and
``nested_near_texel_plain_px`` without ``--amplify``; ``nested_node_m`` is the spacing of the surface below the camera, and
``nested_border_step_m`` the largest step of the surface between points 0.25 m apart across the border of the data, less that
of the slopes there.
"""

from __future__ import annotations

import argparse
import itertools
import os
import secrets
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from affine import Affine
from detail_photograph import photograph_gains
from record import ROOT, write_record

from seasonscapes.rendering.albedo_detail import finest_detail_m
from seasonscapes.rendering.snow_scattering import ICE_ABSORPTION, reflectance, snow_albedo
from seasonscapes.rendering.water_surface import REFRACTIVE_INDEX, DeviceWater
from seasonscapes.scene import read_scene
from seasonscapes.terrain.amplification import amplified, amplified_part
from seasonscapes.terrain.crs import raster_pixels
from seasonscapes.terrain.surface import Raster
from seasonscapes.terrain.surface_classes import AlbedoDetail, Water
from seasonscapes.terrain.synthetic import alpine_massif
from seasonscapes.workflows.amplified_terrain import detailed_view
from seasonscapes.workflows.place import load_place
from seasonscapes.workflows.views import camera
from seasonscapes.workspace import Workspace

sys.path.insert(0, str(ROOT / "tests"))
from oracles_snow import wiscombe_warren_albedo

# Spacings of 5, 10, 10 and 2.5 m.
RASTERS = (
    "sertig-10m/sertig_5m.tif",
    "sertig-10m/sertig_valley.tif",
    "davosdorf-10m/davosdorf.tif",
    "bolternosa-timelapse/dem_2_5m.tif",
)
FACTOR = 4
SUNS_DEG = (10.0, 20.0, 30.0)
CAMERA_ABOVE_M = 2.0
# Of a wide place: its lowest and highest ground.
LOWEST_M, HIGHEST_M = 0.0, 4200.0
# Of the finer data of a wide place: side in cells of 25 m, and how much higher they lie.
NESTED_CELLS, NESTED_OFFSET_M = 240, 1.5


@dataclass(frozen=True)
class Relief:
    """A raster of heights ``(H, W)`` [m] whose sides are multiples of 8, and its spacing [m]."""

    name: str
    heights: np.ndarray
    transform: Affine
    crs: str
    spacing_m: float


def read_relief(path: Path) -> Relief:
    with rasterio.open(path) as file:
        heights, transform, crs = file.read(1).astype(float), file.transform, file.crs.to_wkt()
    height, width = (size // 8 * 8 for size in heights.shape)
    return Relief(path.stem, heights[:height, :width], transform, crs, abs(transform.a))


def massif_relief(seed: int, spacing_m: float) -> Relief:
    elevation = alpine_massif(seed=seed, size_m=12000.0, spacing_m=spacing_m).elevation
    height, width = (size // 8 * 8 for size in elevation.values.shape[:2])
    heights = elevation.values[:height, :width, 0].astype(float)
    return Relief(f"massif {spacing_m:g} m", heights, elevation.transform, elevation.crs, spacing_m)


def slopes_deg(heights: np.ndarray, spacing_m: float) -> np.ndarray:
    down, across = np.gradient(heights, spacing_m)
    return np.degrees(np.arctan(np.hypot(down, across)))


def distribution_distance(first: np.ndarray, second: np.ndarray) -> float:
    """Wasserstein distance of two samples, from their quantiles."""
    share = np.linspace(0.0, 1.0, 501)
    return float(np.abs(np.quantile(first, share) - np.quantile(second, share)).mean())


def roughness_spectrum(heights: np.ndarray) -> np.ndarray:
    """Logarithm of the power in eight bands between the Nyquist frequency of the coarse raster and that of the fine one."""
    side = min(heights.shape)
    square = heights[:side, :side]
    row, column = np.mgrid[0:side, 0:side]
    plane = np.stack([column.ravel(), row.ravel(), np.ones(side * side)], axis=1)
    square = square - (plane @ np.linalg.lstsq(plane, square.ravel(), rcond=None)[0]).reshape(side, side)
    window = np.hanning(side)
    power = np.abs(np.fft.fft2(square * window[:, None] * window)) ** 2
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side)))
    edges = np.geomspace(0.5 / FACTOR, 0.5, 9)
    return np.log10([power[(frequency >= a) & (frequency < b)].mean() for a, b in itertools.pairwise(edges)])


def shadow_counts(heights: np.ndarray, spacing_m: float) -> np.ndarray:
    """Numbers of shadows by length, for suns of three elevations in four directions."""
    edges = np.geomspace(0.9 * spacing_m, 2000.0 * spacing_m, 20)
    counts = []
    for elevation_deg in SUNS_DEG:
        lengths = []
        for grid in (heights, heights[::-1], heights.T, heights.T[::-1]):
            ray = grid + np.arange(len(grid))[:, None] * spacing_m * np.tan(np.radians(elevation_deg))
            shadowed = np.pad(ray < np.maximum.accumulate(ray, axis=0) - 1e-6, ((1, 1), (0, 0))).T
            change = np.diff(shadowed.astype(np.int8), axis=1)
            lengths.append((np.nonzero(change == -1)[1] - np.nonzero(change == 1)[1]) * spacing_m)
        counts.append(np.histogram(np.concatenate(lengths), edges)[0])
    return np.concatenate(counts).astype(float)


def relief_gains(relief: Relief, seed: int) -> dict[str, float]:
    """How much nearer amplified heights are to the withheld ones than bicubic interpolation."""
    truth, spacing_m = relief.heights, relief.spacing_m
    height, width = (size // FACTOR for size in truth.shape)
    coarse = truth.reshape(height, FACTOR, width, FACTOR).mean(axis=(1, 3))
    raster = Raster(coarse[..., None].astype(np.float32), relief.transform * Affine.scale(FACTOR), relief.crs)
    fine = amplified(raster, FACTOR, seed=seed).values[..., 0].astype(float)
    bicubic = cv2.resize(coarse.astype(np.float32), truth.shape[::-1], interpolation=cv2.INTER_CUBIC).astype(float)
    slope = [slopes_deg(each, spacing_m) for each in (truth, fine, bicubic)]
    spectrum = [roughness_spectrum(each) for each in (truth, fine, bicubic)]
    shadows = [shadow_counts(each, spacing_m) for each in (truth, fine, bicubic)]
    return {
        "slope_distance_gain": 1.0
        - distribution_distance(slope[0], slope[1]) / distribution_distance(slope[0], slope[2]),
        "spectrum_gain": 1.0
        - float(np.linalg.norm(spectrum[1] - spectrum[0]) / np.linalg.norm(spectrum[2] - spectrum[0])),
        "shadow_length_gain": 1.0
        - float(np.abs(shadows[1] - shadows[0]).sum() / np.abs(shadows[2] - shadows[0]).sum()),
    }


def snow_error() -> float:
    """Largest difference of our snow's albedo, integrated over viewers, from that of Wiscombe & Warren's model."""
    node, weight = np.polynomial.legendre.leggauss(40)
    cosine, weight = 0.5 * (node + 1.0), 0.25 * weight * (node + 1.0) * 2.0
    azimuth = (np.arange(360) + 0.5) * np.pi / 360
    worst = 0.0
    for radius_um in (50.0, 100.0, 200.0, 500.0, 1000.0):
        for wavelength, index in ICE_ABSORPTION.items():
            spherical = snow_albedo(2e-3 * radius_um, None, (wavelength,))[0]
            for sun in (0.3, 0.5, 0.8):
                sines = np.sqrt(1.0 - cosine**2) * np.sqrt(1.0 - sun**2)
                between = cosine[:, None] * sun + sines[:, None] * np.cos(azimuth)
                plane = weight @ reflectance(cosine[:, None], sun, between, spherical).mean(axis=1)
                worst = max(worst, abs(plane - wiscombe_warren_albedo(radius_um * 1e-6, wavelength, index, sun)))
    return worst


def fresnel_error() -> float:
    """Largest difference of the renderer's reflectance of smooth water from Fresnel's sines and tangents."""
    import mitsuba as mi

    from seasonscapes.frames import LocalFrame

    water = DeviceWater(Water(np.ones((2, 2), np.float32), 0.0), LocalFrame(46.5, 8.0))
    angle = np.radians(np.linspace(0.5, 89.5, 179))
    inside = np.arcsin(np.sin(angle) / REFRACTIVE_INDEX)
    across = np.sin(angle - inside) / np.sin(angle + inside)
    along = np.tan(angle - inside) / np.tan(angle + inside)
    viewer = mi.Vector3f(mi.Float(np.sin(angle)), 0.0, mi.Float(np.cos(angle)))
    _, found = water.mirrored(mi.Normal3f(0.0, 0.0, 1.0), viewer, mi.Point2f(0.5, 0.5))
    return float(np.abs(np.array(found) - 0.5 * (across**2 + along**2)).max())


def wide_relief(seed: int) -> Raster:
    """Heights of 60 × 50 km at 200 m, from 0 to 4,200 m for every seed: noise that is not scaled ends below any land for some."""
    rng = np.random.default_rng(seed)
    relief = np.zeros((250, 300))
    for weight, nodes in ((1.0, (13, 15)), (0.45, (50, 60)), (0.2, (125, 150))):
        noise = rng.normal(0.0, 1.0, nodes).astype(np.float32)
        relief += weight * cv2.resize(noise, (300, 250), interpolation=cv2.INTER_CUBIC)
    heights = LOWEST_M + (HIGHEST_M - LOWEST_M) * (relief - relief.min()) / np.ptp(relief)
    transform = Affine(200.0, 0.0, 390_000.0, 0.0, -200.0, 5_180_000.0)
    return Raster(heights.astype(np.float32)[..., None], transform, "EPSG:32632")


def write_wide_place(folder: Path, seed: int) -> Path:
    """Mountains of 60 × 50 km: heights and an image of 25 m, and a scene file with a camera 2 m above the ground."""
    raster = amplified(wide_relief(seed), 8, seed=seed)
    heights = raster.values[..., 0]
    slope = slopes_deg(heights.astype(float), 25.0)
    meadow, rock, snow = np.array([60, 80, 45]), np.array([120, 115, 110]), np.array([235, 240, 245])
    steep = np.clip((slope - 25.0) / 12.0, 0.0, 1.0)[..., None]
    high = np.clip((heights - 2500.0) / 300.0, 0.0, 1.0)[..., None] * (1.0 - 0.7 * steep)
    image = (meadow * (1.0 - steep) + rock * steep) * (1.0 - high) + snow * high
    profile = {"driver": "GTiff", "height": 2000, "width": 2400, "crs": raster.crs, "transform": raster.transform}
    with rasterio.open(folder / "heights.tif", "w", count=1, dtype="float32", **profile) as file:
        file.write(heights, 1)
    with rasterio.open(folder / "image.tif", "w", count=3, dtype="uint8", **profile) as file:
        file.write(np.moveaxis(np.clip(image, 0, 255).astype(np.uint8), -1, 0))
    (folder / "wide.toml").write_text(
        'name = "wide"\nattribution = "made by a benchmark"\nvertical_datum = "local"\n\n[elevation]\nfile = "heights.tif"\n\n'
        '[imagery]\nfile = "image.tif"\ndelit = true\n\n[snow]\n\n[[camera]]\nname = "eye"\nlatitude_deg = 46.54\n'
        f"longitude_deg = 7.96\nabove_ground_m = {CAMERA_ABOVE_M}\nheading_deg = 150.0\npitch_deg = 0.0\nfov_deg = 60.0\n"
    )
    return folder / "wide.toml"


def write_nested_place(folder: Path, seed: int, factor: int) -> Path:
    """The wide place, and data of a square of 6 km about its camera that are ``factor`` times finer."""
    scene = write_wide_place(folder, seed)
    with rasterio.open(folder / "heights.tif") as file:
        wide = Raster(file.read(1)[..., None], file.transform, file.crs.to_string())
    camera = read_scene(scene).cameras[0]
    column, row = (int(each) for each in raster_pixels(wide, camera.latitude_deg, camera.longitude_deg).ravel())
    rows, columns = (slice(at - NESTED_CELLS // 2, at + NESTED_CELLS // 2) for at in (row, column))
    fine = amplified_part(wide, factor, rows=rows, columns=columns, seed=seed + 1)
    heights = fine.values[..., 0]
    rng = np.random.default_rng(seed)
    height, width = heights.shape
    profile = {"driver": "GTiff", "crs": wide.crs, "tiled": True, "compress": "deflate", "zlevel": 1}
    with rasterio.open(
        folder / "fine.tif",
        "w",
        count=1,
        dtype="float32",
        height=height,
        width=width,
        transform=fine.transform,
        **profile,
    ) as file:
        file.write(heights + np.float32(NESTED_OFFSET_M), 1)
    # Bare ground where it is steep, meadow elsewhere, each with grain of the size of a pixel.
    steep = np.clip((slopes_deg(heights, 25.0 / factor) - 30.0) / 10.0, 0.0, 1.0).astype(np.float32)
    steep = cv2.resize(steep, (2 * width, 2 * height))
    with rasterio.open(
        folder / "fine_image.tif",
        "w",
        count=3,
        dtype="uint8",
        height=2 * height,
        width=2 * width,
        transform=fine.transform * Affine.scale(0.5),
        **profile,
    ) as file:
        grain = rng.normal(1.0, 0.12, steep.shape).astype(np.float32)
        for band, (meadow, rock) in enumerate(((60, 120), (80, 115), (45, 110)), 1):
            file.write(np.clip((meadow + (rock - meadow) * steep) * grain, 1, 255).astype(np.uint8), band)
    text = scene.read_text()
    text = text.replace('file = "heights.tif"\n', 'file = "heights.tif"\n\n[[elevation.finer]]\nfile = "fine.tif"\n')
    text = text.replace("delit = true\n", 'delit = true\n\n[[imagery.finer]]\nfile = "fine_image.tif"\n')
    scene.write_text(text)
    return scene


def nested_figures(scene: Path, folder: Path, size_px: tuple[int, int]) -> dict[str, float]:
    """What the renderer gets of the nested data about the camera: texels, nodes, and the surface across the border."""
    place = load_place(scene, Workspace(folder / "workspace"))
    view = camera(place, "eye", size_px=size_px)
    focal, distance = float(view.fx), lowest_rows_m(size_px)
    view, terrain = detailed_view(place, view)
    assert terrain.surface is not None
    texel_m = terrain.images[-1].levels[-1].texel_m
    eye_m = np.asarray(view.position_m, float)
    detail = AlbedoDetail((0.0, 0.0, 0.0), 1.0 / focal, texel_m)
    sizes = [finest_detail_m(each, texel_m, distance) / (distance / focal) for each in (detail, None)]
    # From the camera across the eastern border of the fine data, at ten northings.
    east = np.arange(0.0, 0.6 * NESTED_CELLS * 25.0, 0.25)
    steps = []
    for north in np.linspace(-2000.0, 2000.0, 10):
        line = eye_m + np.stack([east, np.full_like(east, north), np.zeros_like(east)], axis=1)
        up, normal = terrain.surface.sample(line)
        rise = -normal[:, 0] / normal[:, 2]
        steps.append(np.abs(np.diff(up) - 0.25 * 0.5 * (rise[1:] + rise[:-1]))[east[1:] > 0.46 * NESTED_CELLS * 25.0])
    return {
        "nested_near_texel_px": float(sizes[0].max()),
        "nested_near_texel_plain_px": float(sizes[1].max()),
        "nested_node_m": float(terrain.surface.spacing_at(eye_m[None])[0]),
        "nested_border_step_m": float(np.max(steps)),
        "nested_faces": len(terrain.faces),
    }


def lowest_rows_m(size_px: tuple[int, int]) -> np.ndarray:
    """Distances [m] at which the rows of a level picture of 60° see level ground, up to 100 m; farther ground has larger pixels."""
    focal = 0.5 * size_px[0] / np.tan(np.radians(30.0))
    below = np.arctan((np.arange(1, size_px[1] // 2) + 0.5) / focal)
    distance = CAMERA_ABOVE_M / np.sin(below)
    return distance[distance < 100.0]


def first_picture(scene: Path, folder: Path, size_px: tuple[int, int]) -> tuple[float, float]:
    """Wall time [s] and memory [GB] of the first picture of a place."""
    command = [sys.executable, "-m", "seasonscapes", "render", str(scene), "--time", "2024-07-20T15:30", "--amplify"]
    command += ["--size", f"{size_px[0]}x{size_px[1]}", "-o", str(folder / "picture.png")]
    environment = {**os.environ, "SEASONSCAPES_WORKSPACE": str(folder / "workspace"), "PYTHONPATH": str(ROOT)}
    start = time.perf_counter()
    said = ""
    with subprocess.Popen(command, env=environment, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            print(line, end="", file=sys.stderr, flush=True)
            said = line.strip() or said
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{scene}: seasonscapes render exited with {process.returncode}; it said: {said}")
    return time.perf_counter() - start, used.ru_maxrss * 1024 / 1e9


def wide_figures(folder: Path, seed: int, size_px: tuple[int, int]) -> dict[str, float]:
    """Wall time and memory of the first picture of the wide place, and the size of its near texels."""
    seconds, peak_gb = first_picture(write_wide_place(folder, seed), folder, size_px)
    focal, distance = 0.5 * size_px[0] / np.tan(np.radians(30.0)), lowest_rows_m(size_px)
    texel_m = 60_000.0 / 4096
    detail = AlbedoDetail((0.0, 0.0, 0.0), float(1.0 / focal), texel_m)
    sizes = [finest_detail_m(each, texel_m, distance) / (distance / focal) for each in (detail, None)]
    return {
        "first_picture_s": seconds,
        "peak_gb": peak_gb,
        "near_texel_px": float(sizes[0].max()),
        "near_texel_plain_px": float(sizes[1].max()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int)
    parser.add_argument(
        "--data", type=Path, default=Path(os.environ.get("SEASONSCAPES_DATA") or ROOT.parent / "shared" / "data")
    )
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    seed = secrets.randbelow(10_000) if options.seed is None else options.seed
    reliefs = [massif_relief(1912, 30.0 if options.quick else 15.0)]
    for path in (options.data / name for name in RASTERS):
        if path.is_file():
            reliefs.append(read_relief(path))
        else:
            print(f"{path}: not at hand, left out")
    gains = {relief.name: relief_gains(relief, seed) for relief in reliefs}
    for name, each in gains.items():
        print(f"{name:24}" + "  ".join(f"{key} {value:.2f}" for key, value in each.items()))
    massif, *real = gains.values()
    judged = real or [massif]
    figures = {key: float(np.mean([each[key] for each in judged])) for key in massif}
    figures |= {f"worst_{key}": min(each[key] for each in judged) for key in massif}
    figures |= {f"massif_{key}": value for key, value in massif.items()}
    figures |= {"rasters": len(real), "snow_albedo_error": snow_error(), "fresnel_error": fresnel_error()}
    size_px, factor = ((768, 512), 8) if options.quick else ((1536, 1024), 16)
    with tempfile.TemporaryDirectory() as folder:
        figures |= photograph_gains(options.data, Path(folder), 352 if options.quick else 704)
        figures |= wide_figures(Path(folder), seed, size_px)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = write_nested_place(folder, seed, factor)
        seconds, peak_gb = first_picture(scene, folder, size_px)
        figures |= {"nested_first_picture_s": seconds, "nested_peak_gb": peak_gb}
        figures |= nested_figures(scene, folder, size_px)
    for key, value in figures.items():
        print(f"{key:28} {value:.4g}")
    write_record(options.json, figures, seed=seed)


if __name__ == "__main__":
    main()
