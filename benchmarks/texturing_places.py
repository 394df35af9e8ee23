"""Places whose hidden texels are known: the synthetic massif and a real raster in made-up seasons, Landsat, Finse."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np

from seasonscapes.images import linear_from_srgb, srgb_from_linear
from seasonscapes.sky.ephemeris import sun_position
from seasonscapes.sky.models import read_sky_model
from seasonscapes.terrain.imagery import bake_imagery, read_imagery
from seasonscapes.terrain.mesh import build_mesh
from seasonscapes.terrain.raster import centre_frame, read_elevation
from seasonscapes.terrain.surface import Raster, Terrain, Texture
from seasonscapes.terrain.synthetic import alpine_albedo, alpine_massif, snow_line_m
from seasonscapes.terrain.texels import texel_positions
from seasonscapes.terrain.unwrap import unwrap
from seasonscapes.texturing.predictors import Predictors, stack_predictors
from seasonscapes.texturing.terrain_features import terrain_features
from seasonscapes.workflows.illumination import illumination_at, sun_moon_position
from seasonscapes.workspace import default_workspace

# ETM+ gain and bias of bands 3, 2, 1 [W m⁻² sr⁻¹ µm⁻¹], as its README gives them.
_GAIN, _BIAS = np.array([0.61922, 0.79569, 0.77569]), np.array([-5.00, -6.40, -6.20])


@dataclass(frozen=True)
class Testbed:
    """One texture with its truth: ``(H, W, 3)`` linear, what was seen of it, guides, and how it is shown."""

    name: str
    truth: np.ndarray
    seen: np.ndarray
    predictors: Predictors
    satellite: np.ndarray
    shown: Callable[[np.ndarray], np.ndarray]
    heights: np.ndarray
    spacing_m: float
    sun: np.ndarray
    terrain: Terrain | None = None
    held_out: tuple | None = None


# ---------------------------------------------------------------------------------------------- who sees what


def viewshed(
    z: np.ndarray, spacing_m: float, stand: tuple[float, float, float], heading_deg: float, fov_deg: float
) -> np.ndarray:
    """Cells ``(H, W)`` that a camera at (column, row, height [m]) sees, by walking along every line of sight."""
    column, row = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in z.shape[::-1]))
    dx, dy, rise = column - stand[0], row - stand[1], z - np.float32(stand[2])
    away = np.hypot(dx, dy)
    visible = np.abs((np.degrees(np.arctan2(dx, -dy)) - heading_deg + 180.0) % 360.0 - 180.0) < fov_deg / 2.0
    for t in np.linspace(0.003, 0.995, max(z.shape)).astype(np.float32):
        ground = cv2.remap(z, stand[0] + t * dx, stand[1] + t * dy, cv2.INTER_LINEAR)
        visible &= ground <= stand[2] + t * rise + 0.05 * spacing_m * min(1.0, float(1.0 - t) * 20.0)
    down, right = np.gradient(z, spacing_m)
    facing = (right * dx * spacing_m + down * dy * spacing_m - rise) / np.maximum(away * spacing_m, 1.0)
    return visible & (facing / np.sqrt(1.0 + right**2 + down**2) > 0.05)


def stands(z: np.ndarray, rng: np.random.Generator, count: int, above_m: float = 60.0) -> Iterator[tuple]:
    """Places on local rises with headings, as webcams have them: (column, row, height), heading."""
    rise = z - cv2.GaussianBlur(z, (0, 0), 8.0)
    margin = max(4, min(z.shape) // 20)
    for _ in range(count):
        row, column = (rng.integers(margin, n - margin, 30) for n in z.shape)
        best = int(np.argmax(rise[row, column]))
        r, c = int(row[best]), int(column[best])
        # It looks across the land, not off its edge.
        to_middle = np.degrees(np.arctan2(z.shape[1] / 2.0 - c, r - z.shape[0] / 2.0))
        yield (float(c), float(r), float(z[r, c]) + above_m), float(to_middle + rng.uniform(-60.0, 60.0))


def seen_from(z: np.ndarray, spacing_m: float, rng: np.random.Generator, count: int) -> np.ndarray:
    masks = [viewshed(z, spacing_m, place, heading, 75.0) for place, heading in stands(z, rng, count)]
    return np.any(masks, axis=0)


# ---------------------------------------------------------------------------------------------- lit places


def lit_testbeds(
    place: str,
    albedo_of: Callable,
    elevation: Raster,
    seasons: dict,
    rng: np.random.Generator,
    *,
    cameras: int,
    satellite: np.ndarray | None = None,
) -> Iterator[Testbed]:
    """The same terrain under the true light of several dates, painted by the same cameras.

    Parameters
    ----------
    albedo_of
        Day of the year → reflectance ``(H, W, 3)`` on the raster's grid.
    seasons
        Name → (day of the year, hour UTC).
    satellite
        Image on the raster's grid; left out, the massif of 24 July lit at 10:30, misplaced by 0.7 cells, noisy.
    """
    frame = centre_frame(elevation)
    side = max(elevation.values.shape[:2]) - 1
    terrain, atlas = unwrap(build_mesh(elevation, frame, mesher="grid"), kind="planar", texel_m=None, max_side_px=side)
    positions, _ = texel_positions(terrain, atlas.width_px, atlas.height_px)
    z = positions[..., 2]
    z = np.where(np.isfinite(z), z, np.nanmedian(z)).astype(np.float32)
    spacing_m = float(np.ptp(terrain.vertices[:, 0]) / atlas.width_px)
    surface = np.isfinite(positions).all(axis=2)

    def on_texels(values):
        return bake_imagery(terrain, atlas, Raster(values, elevation.transform, elevation.crs)).values

    def lit(day, hour):
        when = datetime(2024, 1, 1, tzinfo=UTC) + timedelta(days=day - 1, hours=hour)
        albedo = on_texels(albedo_of(day))
        return albedo * irradiance_of(terrain, albedo, positions, when, frame) / np.pi, when

    image = lit(205, 10.5)[0] if satellite is None else on_texels(satellite)
    image = cv2.warpAffine(
        image, np.float32([[1, 0, 0.6], [0, 1, -0.4]]), image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE
    )
    image = image * np.exp(0.03 * rng.standard_normal(image.shape)) / np.percentile(image, 99.0)
    views = list(stands(z, rng, cameras + 1))
    seen = np.any([viewshed(z, spacing_m, at, heading, 75.0) for at, heading in views[:-1]], axis=0) & surface
    for season, (day, hour) in seasons.items():
        truth, when = lit(day, hour)
        white = float(np.percentile(truth[surface], 99.0))
        sun = np.asarray(sun_position(when, frame.latitude_deg, frame.longitude_deg).direction)
        hours = [when.replace(hour=0, minute=0) + timedelta(hours=h) for h in range(24)]
        day_suns = np.asarray(sun_position(hours, frame.latitude_deg, frame.longitude_deg).direction)
        layers = terrain_features(z, spacing_m, sun_direction=sun, day_suns=day_suns)
        predictors = stack_predictors(layers, Texture(image.astype(np.float32)), surface=surface)
        yield Testbed(
            f"{place}_{season}",
            truth.astype(np.float32),
            seen,
            predictors,
            image.astype(np.float32),
            lambda v, white=white: srgb_from_linear(v / white).astype(np.float32),
            z,
            spacing_m,
            sun,
            terrain,
            views[-1],
        )


def irradiance_of(terrain: Terrain, albedo: np.ndarray, positions: np.ndarray, when: datetime, frame) -> np.ndarray:
    """Traced illuminance ``(H, W, 3)`` [lx]: sun, sky and what the land sends; not the guides' own heightfield sun."""
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.irradiance import irradiance_blocks
    from seasonscapes.rendering.mitsuba_scene import build_scene

    height_m = float(np.nanmedian(positions[..., 2]))
    moment = sun_moon_position(when, frame.latitude_deg, frame.longitude_deg, height_m)
    light = illumination_at(read_sky_model("clear"), moment, height_m, workspace=default_workspace())
    stage = build_scene(terrain, albedo, light)
    result = np.zeros((positions.shape[0] * positions.shape[1], 3), np.float32)
    for index, _, (found,) in irradiance_blocks(ray_scene(stage.mi_terrain), positions.reshape(-1, 3), [light]):
        result[index] = found.total
    return result.reshape(positions.shape)


def massif(seed: int, seasons: dict, *, spacing_m: float = 30.0, cameras: int = 10) -> Iterator[Testbed]:
    """The embedded massif of a seed."""
    place = alpine_massif(seed=seed, spacing_m=spacing_m)
    return lit_testbeds(
        "massif",
        lambda day: alpine_albedo(place, day),
        place.elevation,
        seasons,
        np.random.default_rng(seed),
        cameras=cameras,
    )


def jungfrau_land(data: Path, rng: np.random.Generator) -> tuple[Raster, np.ndarray, Callable[[int], np.ndarray]]:
    """The real Bernese Oberland: heights, its real colours, and these with the snow of a day of the year laid over them."""
    elevation = read_elevation(data / "jungfrau" / "dem_surface_100m.tif")
    photo = read_imagery(data / "jungfrau" / "swissimage_on_dem_100m.tif").values
    photo = np.where(np.isfinite(photo), photo, np.nanmedian(photo, axis=(0, 1))).astype(np.float32)
    z = elevation.values[..., 0]
    noise = cv2.GaussianBlur(rng.standard_normal(z.shape), (0, 0), 4.0)
    down, right = np.gradient(cv2.GaussianBlur(z, (0, 0), 1.0), 100.0)

    def albedo_of(day):
        # Slopes to the south lose their snow some 300 m higher up, walls shed it.
        line = snow_line_m(day) + 250.0 * np.clip(-down, -1.0, 1.0) + 100.0 * noise / noise.std()
        snow = np.clip((z - line) / 250.0 + 0.5, 0.0, 1.0) * np.clip((1.6 - np.hypot(down, right)) / 0.6, 0.15, 1.0)
        autumn = np.clip(1.0 - abs(day - 290.0) / 60.0, 0.0, 1.0) * np.clip((1900.0 - z) / 600.0, 0.0, 1.0)
        ground = 0.5 * photo * (1.0 + autumn[..., None] * np.float32([0.7, 0.1, -0.4]))
        return (ground + snow[..., None] * (np.float32([0.8, 0.82, 0.84]) - ground)).astype(np.float32)

    return elevation, photo, albedo_of


def jungfrau(data: Path, seed: int, seasons: dict, *, cameras: int = 12) -> Iterator[Testbed]:
    """The real Bernese Oberland in the light of several seasons."""
    rng = np.random.default_rng(seed)
    elevation, photo, albedo_of = jungfrau_land(data, rng)
    return lit_testbeds("jungfrau", albedo_of, elevation, seasons, rng, cameras=cameras, satellite=photo)


# ---------------------------------------------------------------------------------------------- Landsat


def landsat(data: Path, seed: int) -> Iterator[Testbed]:
    """November from July: blocks hidden, and what cameras on the ridges would not see; two real pictures."""
    import rasterio

    def read(name):
        with rasterio.open(data / "landsat-pennsylvania" / name) as file:
            return file.read().transpose(1, 2, 0).astype(np.float32)

    z, july = read("dem_30m.tif")[..., 0], read("landsat7_2002-07-20.tif")
    z = np.where(np.isfinite(z), z, np.nanmedian(z)).astype(np.float32)
    november = read("landsat7_2002-11-25.tif")[..., [2, 1, 0]]
    truth = np.maximum(november * _GAIN + _BIAS, 0.0).astype(np.float32)
    low, high = np.percentile(truth, [0.5, 99.5], axis=(0, 1))
    elevation, azimuth = np.radians([26.2, 159.5])
    sun = np.array([np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)])
    # All six bands of July are the guide; red, green and blue come first.
    image = july[..., [2, 1, 0, 3, 4, 5]] / 255.0
    predictors = stack_predictors(terrain_features(z, 30.0, sun_direction=sun), Texture(image))
    rng = np.random.default_rng(seed)
    for name, seen in (("blocks", hidden_blocks(z.shape, rng)), ("views", seen_from(z, 30.0, rng, 8))):
        yield Testbed(
            f"landsat_{name}",
            truth,
            seen,
            predictors,
            image,
            lambda v: np.clip((v - low) / (high - low), 0.0, 1.0).astype(np.float32),
            z,
            30.0,
            sun,
        )


def hidden_blocks(shape: tuple[int, int], rng: np.random.Generator, share: float = 0.55, sizes=(12, 64)) -> np.ndarray:
    """What is left to see when rectangles hide that share."""
    seen = np.ones(shape, bool)
    while (~seen).mean() < share:
        height, width = rng.integers(*sizes, 2)
        row, column = (rng.integers(-8, n - 8) for n in shape)
        seen[max(row, 0) : row + height, max(column, 0) : column + width] = False
    return seen


# ---------------------------------------------------------------------------------------------- Finse


def finse(data: Path, seed: int, blocks_m=(64.0, 160.0, 360.0)) -> Iterator[Testbed]:
    """A real webcam on a 4 m surface model: blocks of really seen texels of the snowy May are hidden.

    The same webcam's green July, blurred to 16 m, stands for the satellite image; without one, see ``replace``.
    """
    folder = data / "finse-webcam"
    z, spacing, camera_cell, spring, summer = _finse_painted(folder)
    known = np.isfinite(z)
    filled = np.where(known, z, np.nanmedian(z)).astype(np.float32)
    sun = np.asarray(sun_position(datetime(2019, 5, 24, 10, 0, tzinfo=UTC), 60.6, 7.53).direction)
    layers = terrain_features(filled, spacing, sun_direction=sun)
    weight = np.isfinite(summer).all(axis=2).astype(np.float32)
    blurred = (
        cv2.GaussianBlur(np.nan_to_num(summer), (0, 0), 4.0)
        / np.maximum(cv2.GaussianBlur(weight, (0, 0), 4.0), 1e-3)[..., None]
    )
    surface = np.isfinite(spring).all(axis=2)
    satellite = Texture(np.where(weight[..., None] > 0.0, blurred, np.nan).astype(np.float32), weight)
    predictors = stack_predictors(layers, satellite, surface=surface)
    truth = np.nan_to_num(spring).astype(np.float32)
    rng = np.random.default_rng(seed)
    for block_m in blocks_m:
        cells = int(block_m / spacing)
        hidden = rng.random((z.shape[0] // cells + 2, z.shape[1] // cells + 2)) < 0.5
        shift = rng.integers(0, cells, 2)
        grid = np.kron(hidden, np.ones((cells, cells), bool))[shift[0] :, shift[1] :][: z.shape[0], : z.shape[1]]
        image = np.nan_to_num(np.where(weight[..., None] > 0.0, blurred, np.nanmedian(summer)))
        yield Testbed(
            f"finse_{block_m:.0f}m",
            truth,
            surface & ~grid,
            predictors,
            image.astype(np.float32),
            lambda v: srgb_from_linear(v).astype(np.float32),
            filled,
            spacing,
            sun,
            held_out=(camera_cell,),
        )


def without_image(bed: Testbed) -> Testbed:
    """The same with the relief alone."""
    keep = [i for i, name in enumerate(bed.predictors.names) if not name.startswith("satellite")]
    names = tuple(bed.predictors.names[i] for i in keep)
    return replace(bed, predictors=replace(bed.predictors, values=bed.predictors.values[..., keep], names=names))


def _finse_painted(folder: Path):
    """Heights, spacing, camera cell, and both photographs ``(H, W, 3)`` on the ground (linear, NaN where not seen)."""
    from seasonscapes.calibration.evidence import Correspondences, Priors
    from seasonscapes.calibration.pose_model import project_with_parameters
    from seasonscapes.calibration.resection import resect
    from seasonscapes.cameras.pinhole import camera_at
    from seasonscapes.frames import LocalFrame, enu_from_geodetic
    from seasonscapes.terrain.crs import geodetic_from_map

    rows = list(csv.DictReader((folder / "gcps.csv").read_text().splitlines()))
    column = {n: np.array([float(r[n]) for r in rows]) for n in ("x_world", "y_world", "z_world", "x_img", "y_img")}
    latitude, longitude = (float(v) for v in geodetic_from_map("EPSG:25832", 419169.2, 6718421.3))
    frame = LocalFrame(latitude, longitude, 0.0, 0.13)
    at = geodetic_from_map("EPSG:25832", column["x_world"], column["y_world"])
    points = Correspondences(
        np.stack([column["x_img"], column["y_img"]], -1), enu_from_geodetic(frame, *at, column["z_world"])
    )
    start = camera_at(frame, latitude, longitude, 1212.0, heading_deg=66.0, fov_deg=65.8, size_px=(1920, 1080))
    pose = resect(start, points, priors=Priors(k1=np.inf))
    raster = read_elevation(folder / "dsm_4m.tif")
    z = raster.values[..., 0]
    c, r = np.meshgrid(np.arange(z.shape[1]) + 0.5, np.arange(z.shape[0]) + 0.5)
    east, north = raster.transform * (c.ravel(), r.ravel())
    places = enu_from_geodetic(frame, *geodetic_from_map("EPSG:25832", east, north), np.nan_to_num(z).ravel())
    pixel, in_front = project_with_parameters(start, np.eye(3), pose.parameters, places)
    pixel = pixel.reshape(*z.shape, 2)
    away_m = np.linalg.norm(places - pose.parameters[3:6], axis=1).reshape(z.shape)
    stand = ((419169.2 - raster.transform.c) / 4.0 - 0.5, (raster.transform.f - 6718421.3) / 4.0 - 0.5, 1215.3)
    filled = np.where(np.isfinite(z), z, 1000.0).astype(np.float32)
    sees = viewshed(filled, 4.0, stand, 62.3, 70.0) & np.isfinite(z) & in_front.reshape(z.shape) & (away_m > 60.0)
    roof = np.zeros((1080, 1920), np.uint8)
    outline = [
        (0, 730),
        (480, 400),
        (480, 350),
        (720, 330),
        (750, 490),
        (1720, 930),
        (1920, 1040),
        (1920, 1080),
        (0, 1080),
    ]
    cv2.fillPoly(roof, [np.array(outline, np.int32)], 1)
    roof[:130] = 1
    painted = []
    for name in ("2019-05-24_12-00-01.jpg", "2022-07-08_14-00-00.jpg"):
        photo = linear_from_srgb(cv2.imread(str(folder / name))[..., ::-1].astype(np.float32) / 255.0)
        x, y = (np.nan_to_num(pixel[..., k] - 0.5, nan=-9.0).astype(np.float32) for k in (0, 1))
        colour = cv2.remap(photo, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        free = cv2.remap(1 - roof, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 0
        painted.append(np.where((sees & free)[..., None], colour, np.nan))
    return z, 4.0, stand, painted[0], painted[1]
