"""Light on real ground: plains before walls, black pixels, silhouettes, shadow borders, and the cost of a still.

    python benchmarks/surface.py [--quick] [--seed N] [--dem FILE] [--json FILE]

The ground is the synthetic massif at 30 m, or a raster of one's own. The adaptive mesh is compared with the
full grid of the interpolated heights, which is what it approximates; both shade with the normals of the heights. The
plain before a wall is compared with the direct normal irradiance times the sine of the sun's elevation. ``--quick`` takes
6 km instead of 12 km and 12 cameras instead of 50.
"""

from __future__ import annotations

import argparse
import secrets
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from record import write_record

import seasonscapes as ss
from seasonscapes.frames import geodetic_from_enu
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.hemisphere_rays import RayScene, ray_scene
from seasonscapes.rendering.irradiance import surface_at
from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh, relight
from seasonscapes.rendering.radiance import render_view
from seasonscapes.rendering.sun_visibility import hashed_disc_offset, sun_rays, visible_cosine
from seasonscapes.rendering.view_samples import view_samples
from seasonscapes.sky.illumination import Luminary
from seasonscapes.terrain.mesh import sample_positions
from seasonscapes.terrain.surface import mesh_up_m
from seasonscapes.terrain.synthetic import alpine_massif
from seasonscapes.terrain.view_refinement import refined_for_view
from seasonscapes.workflows.views import view_with_terrain

SUNS_DEG = ((135.0, 10.0), (180.0, 20.0), (150.0, 60.0))
HOURS = {
    "morning": "2024-09-21T07:40",
    "noon": "2024-09-21T13:00",
    "dusk": "2024-09-21T19:25",
    "moon": "2024-09-18T23:30",
}
GREY = np.full(3, 0.3)


@dataclass(frozen=True)
class Pair:
    """The adaptive mesh and the full grid of one place, and their scenes for rays."""

    adaptive: ss.Place
    grid: ss.Place
    adaptive_rays: RayScene
    grid_rays: RayScene


def scene_file(folder: Path, name: str, dem: Path) -> Path:
    """A scene file that names an elevation raster."""
    path = folder / f"{name}.toml"
    path.write_text(f'name = "{name}"\nvertical_datum = "local"\n[elevation]\nfile = "{dem.resolve()}"\n')
    return path


def write_heights(path: Path, heights: np.ndarray, crs: str, transform: Affine) -> None:
    rows, columns = heights.shape
    profile = {"driver": "GTiff", "count": 1, "height": rows, "width": columns, "dtype": "float32"}
    with rasterio.open(path, "w", **profile, crs=crs, transform=transform) as file:
        file.write(heights.astype(np.float32), 1)


def load(path: Path, workspace: ss.Workspace, **options) -> ss.Place:
    return ss.load_place(path, workspace, options=ss.MeshOptions(**options), allow_outside=True)


def luminary(azimuth_deg: float, elevation_deg: float) -> Luminary:
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    direction = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    return Luminary(direction, np.ones(3), 0.265)


# ---------------------------------------------------------------------------------------------- the plain


def plain_error(folder: Path, workspace: ss.Workspace) -> float:
    """Largest relative error of direct irradiance on the sunlit part of a level plain before a wall of 300 m."""
    heights = np.full((81, 81), 500.0, np.float32)
    heights[52:55] = 800.0
    write_heights(folder / "plain.tif", heights, "EPSG:32632", Affine(30, 0, 500000 - 30 * 40.5, 0, -30, 5160000))
    place = load(scene_file(folder, "plain", folder / "plain.tif"), workspace)
    time_utc = "2024-12-21T11:22:17Z"
    received = ss.irradiance_map(place, time_utc, rays=16).bands["direct W/m2"]
    level = np.zeros(heights.shape, bool)
    level[3:20, 3:-3] = level[58:78, 3:-3] = True
    right = float(np.median(received[level]))
    sun = ss.illumination(place, time_utc).sun
    on_level = float(sun.normal_illuminance_lx[1] * np.sin(np.radians(sun.elevation_deg)))
    lit = ss.lit_texture(place, time_utc, rays=16).sun[..., 1]
    # The median of the lit texture is that of level texels as well, in lux: both kinds of output are held to one value.
    return max(float(np.abs(received[level] / right - 1.0).max()), abs(float(np.nanmedian(lit)) / on_level - 1.0))


# ---------------------------------------------------------------------------------------------- the two meshes


def cosines(scene: RayScene, positions: np.ndarray, sun: Luminary) -> np.ndarray:
    """Cosine of incidence × visible share of the sun at positions; NaN off the mesh."""
    points, index = surface_at(scene, positions, search_m=300.0)
    rays = sun_rays(
        scene,
        points.origin[:, None],
        points.normal[:, None],
        points.geometric_normal[:, None],
        np.ones((len(index), 1)),
        hashed_disc_offset(index),
    )
    result = np.full(len(positions), np.nan)
    result[index] = visible_cosine(rays, sun, rays_per_sample=16)[:, 0]
    return result


def irradiance_errors(pair: Pair, rng: np.random.Generator) -> tuple[float, float]:
    """RMSE of direct irradiance relative to DNI over three suns, and the share of cells within 5 % of DNI."""
    raster = pair.adaptive.elevation
    rows, columns = (rng.integers(3, size - 3, 20_000) for size in raster.values.shape[:2])
    positions = sample_positions(raster, pair.adaptive.frame, rows, columns, raster.values[rows, columns, 0])
    errors = []
    for angles in SUNS_DEG:
        sun = luminary(*angles)
        errors.append(cosines(pair.adaptive_rays, positions, sun) - cosines(pair.grid_rays, positions, sun))
    error = np.concatenate(errors)
    error = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(error**2))), float(np.mean(np.abs(error) < 0.05))


def cameras(pair: Pair, count: int, rng: np.random.Generator) -> list[tuple[ss.Camera, bool]]:
    """Cameras 20 to 200 m above random ground and, every other one, 2 m above a crest."""
    place, heights = pair.adaptive, pair.adaptive.elevation.values[..., 0]
    result = []
    for number in range(count):
        row, column = (int(rng.integers(20, size - 20)) for size in heights.shape)
        above, crest = rng.uniform(20.0, 200.0), number % 2 == 1
        if crest:
            window = heights[row - 15 : row + 16, column - 15 : column + 16]
            down, across = np.unravel_index(window.argmax(), window.shape)
            row, column, above = row - 15 + int(down), column - 15 + int(across), 2.0
        position = sample_positions(place.elevation, place.frame, row, column, heights[row, column])
        up = max(mesh_up_m(each.terrain, position) for each in (pair.adaptive, pair.grid))
        latitude, longitude, height = geodetic_from_enu(place.frame, np.array([*position[:2], up]))
        view = ss.Viewpoint(
            latitude_deg=float(latitude),
            longitude_deg=float(longitude),
            height_m=float(height) + above,
            heading_deg=float(rng.uniform(0.0, 360.0)),
            pitch_deg=-3.0,
        )
        result.append((ss.camera(place, view, size_px=(768, 512)), crest))
    return result


def rays_of_view(place: ss.Place, camera: ss.Camera) -> RayScene:
    """The adaptive mesh as it is rendered: refined near the camera."""
    return ray_scene(mi_mesh(view_with_terrain(place, camera)[1], GREY))


def rays_of_truth(place: ss.Place, camera: ss.Camera) -> RayScene:
    """The full grid, divided until it is within a twentieth of a pixel of the bilinear surface through its samples."""
    fine = refined_for_view(place.terrain, camera.position_m, 1.0 / camera.fx, tolerance_px=0.05, reach_m=1e5)
    return ray_scene(mi_mesh(fine, GREY))


def skyline_rows(scene: RayScene, camera: ss.Camera) -> np.ndarray:
    """Row of the uppermost terrain in each column, in eighths of a pixel; -1 without terrain."""
    tall = replace(camera, height_px=camera.height_px * 8, fy=camera.fy * 8.0, cy=camera.cy * 8.0)
    land = np.isfinite(trace_gbuffer(RenderScene(scene.mi_scene, scene.mi_terrain), tall).depth)
    return np.where(land.any(axis=0), land.argmax(axis=0), -1)


def sunlit(scene: RayScene, camera: ss.Camera, sun: Luminary) -> tuple[np.ndarray, np.ndarray]:
    """Pixels whose first sample shows terrain, and those of them where more than half of the sun is visible."""
    points, hit, pixel = view_samples(scene, camera, range(camera.height_px), 1, 0)
    rays = sun_rays(scene, points.origin, points.normal, points.geometric_normal, hit, np.zeros(len(pixel)))
    land, lit = (np.zeros(camera.height_px * camera.width_px, bool) for _ in range(2))
    land[pixel] = True
    lit[pixel] = visible_cosine(rays, sun, rays_per_sample=16)[:, 0] > 0.5 * points.normal[:, 0] @ sun.direction
    return land.reshape(camera.height_px, -1), lit.reshape(camera.height_px, -1)


def view_errors(pair: Pair, views: list[tuple[ss.Camera, bool]]) -> dict[str, float]:
    """95th percentiles of the distances of skylines, above ground and 2 m above crests, and of shadow borders [px]."""
    from scipy.ndimage import binary_dilation, distance_transform_edt

    sun = luminary(*SUNS_DEG[0])
    found: dict[str, list[np.ndarray]] = {"silhouette": [], "crest_silhouette": [], "shadow_border": []}
    for camera, crest in views:
        ours, truth = rays_of_view(pair.adaptive, camera), rays_of_truth(pair.grid, camera)
        rows = [skyline_rows(scene, camera) for scene in (ours, truth)]
        seen = (rows[0] > 0) & (rows[1] > 0)
        found["crest_silhouette" if crest else "silhouette"].append(np.abs(rows[0] - rows[1])[seen] / 8.0)
        (land, lit), (true_land, true_lit) = (sunlit(scene, camera, sun) for scene in (ours, truth))
        land &= true_land
        edge, true_edge = (binary_dilation(mask & land) & ~mask & land for mask in (lit, true_lit))
        # At silhouettes a border of the picture is no border of a shadow.
        edge &= ~binary_dilation(~land, iterations=3)
        if edge.any() and true_edge.any():
            found["shadow_border"].append(distance_transform_edt(~true_edge)[edge])
    return {f"{name}_error_px": float(np.percentile(np.concatenate(parts), 95.0)) for name, parts in found.items()}


def black_pixels(pair: Pair, views: list[tuple[ss.Camera, bool]]) -> int:
    """Terrain pixels darker than a thousandth of their picture's median, over all cameras and four hours."""
    black, lights = 0, [ss.illumination(pair.adaptive, hour) for hour in HOURS.values()]
    for camera, _ in views:
        mesh = rays_of_view(pair.adaptive, camera).mi_terrain
        for light in lights:
            scene = relight(mesh, light)
            small = replace(
                camera,
                width_px=96,
                height_px=64,
                **{name: getattr(camera, name) / 8.0 for name in ("fx", "fy", "cx", "cy")},
            )
            view = render_view(scene, small, spp=16)
            land = view.coverage > 0.99
            if land.any():
                luminance = view.surface[land][:, 1]
                black += int((luminance < 1e-3 * np.median(luminance)).sum())
    return black


# ---------------------------------------------------------------------------------------------- the still


def still_costs(pair: Pair, views: list[tuple[ss.Camera, bool]]) -> dict[str, float]:
    """Processor seconds of the first and the second still of a view, and errors against many path-traced samples."""
    camera = views[0][0]
    costs = {}
    for number, hour in (("first", "2024-09-21T16:30"), ("second", "2024-09-21T10:30")):
        start = time.process_time()
        still = ss.render(pair.adaptive, camera, hour)
        costs[f"still_{number}_processor_s"] = time.process_time() - start
    # Two independent halves of the paths give the reference and its own noise.
    halves = [ss.render(pair.adaptive, camera, hour, spp=1024, seed=seed).radiance for seed in (1, 2)]
    land = still.coverage > 0.99
    half = [each[land].astype(np.float64) for each in halves]
    noise = np.sqrt(np.mean((half[0] - half[1]) ** 2) / 2.0) / half[0].mean()
    error = np.sqrt(max(np.mean((still.radiance[land] - 0.5 * (half[0] + half[1])) ** 2), 0.0)) / half[0].mean()
    return costs | {"still_relative_rmse": float(error), "paths_1024_relative_rmse": float(noise)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="6 km and 12 cameras instead of 12 km and 50")
    parser.add_argument("--seed", type=int, default=None, help="of ground and cameras; default a fresh one")
    parser.add_argument("--dem", type=Path, help="a raster of heights instead of the massif")
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    arguments = parser.parse_args()
    seed = secrets.randbits(31) if arguments.seed is None else arguments.seed
    side_m, count = (6000.0, 12) if arguments.quick else (12000.0, 50)
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name:
        folder, workspace = Path(name), ss.Workspace(Path(name) / "workspace")
        numbers: dict[str, float] = {"seed": seed, "plain_error_max": plain_error(folder, workspace)}
        dem = arguments.dem
        if dem is None:
            dem = folder / "massif.tif"
            massif = alpine_massif(seed=seed, size_m=side_m, spacing_m=30.0).elevation
            write_heights(dem, massif.values[..., 0], massif.crs, massif.transform)
        path = scene_file(folder, "ground", dem)
        adaptive, grid = load(path, workspace), load(path, workspace, mesher="grid")
        pair = Pair(adaptive, grid, ray_scene(mi_mesh(adaptive.terrain, GREY)), ray_scene(mi_mesh(grid.terrain, GREY)))
        numbers["triangles"] = len(adaptive.terrain.faces)
        numbers["triangles_saved_ratio"] = 1.0 - len(adaptive.terrain.faces) / len(grid.terrain.faces)
        numbers["irradiance_rmse_of_dni"], numbers["irradiance_within_5_percent"] = irradiance_errors(pair, rng)
        views = cameras(pair, count, rng)
        numbers |= view_errors(pair, views)
        numbers["black_pixels"] = black_pixels(pair, views)
        numbers |= still_costs(pair, views)
        numbers["still_processor_s"] = numbers["still_second_processor_s"]
    for key, value in numbers.items():
        print(f"{key:<32} {value:.5g}", flush=True)
    write_record(arguments.json, numbers, seed=seed)


if __name__ == "__main__":
    main()
