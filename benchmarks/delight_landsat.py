"""Landsat rows of the delighting benchmark: ridges in Pennsylvania on two dates with known suns.

Clouds, their shadows, water and all within 270 m of them belong to no class of land and are left out, of fits and of
judgement, for all methods: in July they stand over slopes that turn away from the sun. (Over forest the blue band sinks
to its level at about that distance.) All methods get the images moved onto the heights, by the shift of the November
image, whose relief is the clearest, and the same air.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from albedo_landsat import (
    CENTRE_UM,
    DATES,
    NAMES,
    SOLAR,
    THIN_HAZE,
    correlation,
    depths,
    light_of,
    path_radiance,
    scene,
)

from seasonscapes.albedo.adjacency import Surroundings, scattered_upwards, without_surroundings
from seasonscapes.albedo.corrections import CORRECTIONS, slopes_under
from seasonscapes.albedo.delighting import Air, DelightOptions, delight_image
from seasonscapes.albedo.forward_model import TexelTransport, trace_texel_transport
from seasonscapes.albedo.land_response import land_classes
from seasonscapes.albedo.registration import shifted_back, texture_shift
from seasonscapes.albedo.texel_light import texel_irradiance
from seasonscapes.frames import direction_from_angles
from seasonscapes.rendering.coefficients import SamplingOptions

# Land classes of the July scene by its band ratios; those with fewer texels are left out.
CLASSES, LEAST_TEXELS = 4, 1500
STEEP_DEG, TEXEL_M = 8.0, 30.0
# Reflectance in blue less half of that in red above which air is cloudy: 0.08 at the satellite, less July's path radiance.
HAZY = 0.0215
# Texels beside clouds, shadows and water that are not judged.
MARGIN_TEXELS = 9
# Responses are fitted in blocks of so many texels, each in the blocks of the other colour of a chequerboard.
BLOCK_TEXELS = 15
TRIPLES = ([2, 1, 0], [3, 4, 5])


@dataclass(frozen=True)
class Scene:
    """What all methods get.

    Parameters
    ----------
    land
        Daylight coefficients of the N texels.
    shape
        Of the texture.
    bands
        Radiance ``(N, 6)`` of each date, as the satellite measured it.
    label
        ``(N,)`` land class of each texel.
    clear
        ``(N,)`` texels of land that no cloud disturbs on either date.
    """

    land: TexelTransport
    shape: tuple[int, int]
    bands: dict[str, np.ndarray]
    label: np.ndarray
    clear: np.ndarray

    def textured(self, values: np.ndarray, fill: float = np.nan) -> np.ndarray:
        """``(R, S, ...)`` from values of the texels ``(N, ...)``."""
        texture = np.full((self.shape[0] * self.shape[1], *values.shape[1:]), fill, np.float32)
        texture[self.land.texel] = values
        return texture.reshape(*self.shape, *values.shape[1:])

    def of_texels(self, texture: np.ndarray) -> np.ndarray:
        """``(N, ...)`` from a texture."""
        return texture.reshape(-1, *texture.shape[2:])[self.land.texel]


def landsat_numbers(data: Path, seed: int) -> dict[str, Any]:
    """Correlations of reflectance with the cosine of incidence within land classes, and agreement of the dates."""
    folder = data / "landsat-pennsylvania"
    if not folder.is_dir():
        reason = f"no such folder: {folder}; give --data"
        print(f"Landsat: not measured ({reason})")
        return {"landsat_abs_r_max": None, "landsat_reason": reason}
    view = landsat_scene(folder, seed)
    suns = {date: direction_from_angles(azimuth, elevation) for date, (elevation, azimuth) in DATES.items()}
    cosines = {date: view.land.normal @ sun for date, sun in suns.items()}
    results: dict[str, dict[str, np.ndarray]] = {}
    numbers: dict[str, Any] = {"landsat_clear_share": float(view.clear.mean())}
    for date, sun in suns.items():
        haze = vegetation_haze(view, date, sun)
        numbers[f"landsat_haze_depth_{date}"] = haze
        results[date] = methods(view, date, sun, haze)
    print(
        f"{'Landsat: |r| with cos i within classes':40s}{'max':>7s}{'mean':>7s}{'steep max':>11s}{'dates r':>9s}{'σ':>7s}"
    )
    for name in results[next(iter(DATES))]:
        values = {date: results[date][name] for date in DATES}
        key = "landsat" if name == "ours" else f"landsat_{name}"
        numbers |= {f"{key}_{what}": value for what, value in judged(view, values, cosines, name).items()}
    best = min(numbers[f"landsat_{name}_dates_spread"] for name in (*CORRECTIONS, "c_by_class"))
    numbers["landsat_dates_spread_over_best_correction"] = numbers["landsat_dates_spread"] / best
    return numbers


def landsat_scene(folder: Path, seed: int) -> Scene:
    """Terrain, images, land classes and clouds."""
    terrain, shape, bands = scene(folder)
    sampling = SamplingOptions(shadow_samples=1, rays=128, clusters_per_receiver=64, clusters=4096, rank=24)
    land = trace_texel_transport(terrain, shape, sampling=sampling, seed=seed)
    july, november = DATES
    shift = _shift(land, bands[november], direction_from_angles(*DATES[november][::-1]))
    clear = np.zeros(shape[0] * shape[1], bool)
    clear[land.texel] = True
    for date, (elevation, azimuth) in DATES.items():
        bands[date] = shifted_back(bands[date], shift)
        clear &= ~disturbed(bands[date], elevation, azimuth).reshape(-1)
    label = land_classes(bands[july], clear.reshape(shape), CLASSES, seed=seed).reshape(-1)
    print(
        f"Landsat: images moved by {-shift[0]:+.2f} rows, {-shift[1]:+.2f} columns; {clear.sum() / len(land.texel):.0%} clear"
    )
    values = {date: image.reshape(-1, 6)[land.texel] for date, image in bands.items()}
    return Scene(land, shape, values, label[land.texel], clear[land.texel])


def _shift(land: TexelTransport, image: np.ndarray, sun: np.ndarray) -> tuple[float, float]:
    """Rows and columns by which an image lies off the heights."""
    light = texel_irradiance(land, light_of(sun, CENTRE_UM[TRIPLES[1]]))
    bright = image.mean(axis=2)
    known = np.isfinite(bright) & (light.chart >= 0)
    predicted = (light.visibility[..., None] * light.sun + light.sky).mean(axis=2)
    found = texture_shift(np.nan_to_num(bright, nan=1.0), predicted, known)
    if found is None:
        raise SystemExit("Landsat: the November image shows no relief")
    return found


def disturbed(bands: np.ndarray, elevation_deg: float, azimuth_deg: float) -> np.ndarray:
    """Texels ``(R, S)`` of clouds (bright, and white or saturated), their shadows and water, widened by the margin."""
    from scipy.ndimage import binary_dilation, binary_opening, shift

    sun = direction_from_angles(azimuth_deg, elevation_deg)
    inside = np.isfinite(bands).any(axis=2)
    saturated = inside & ~np.isfinite(bands).all(axis=2)
    blue, green, red, infrared, shortwave, _ = np.moveaxis(
        np.nan_to_num(np.pi * (bands - path_radiance(sun)) / (SOLAR * sun[2])), 2, 0
    )
    # Cloud and thin haze, and neither bare soil nor rock (Zhu & Woodcock 2012).
    hazy = (blue - 0.5 * red > HAZY) & (infrared > 0.75 * shortwave)
    # Whatever is narrower than 90 m is a roof.
    cloud = saturated | np.asarray(binary_opening(hazy, np.ones((3, 3))), bool)
    # Clouds up to 4 km above the land throw shadows on a line away from the sun; rows of the texture run south.
    below = np.zeros_like(cloud)
    for texels in range(2, int(4000.0 / np.tan(np.radians(elevation_deg)) / TEXEL_M) if cloud.any() else 0):
        offset = texels * np.cos(np.radians(azimuth_deg)), -texels * np.sin(np.radians(azimuth_deg))
        below |= shift(cloud.astype(np.float32), offset, order=0) > 0.5
    dark = inside & (infrared < 0.13) & (shortwave < 0.09)
    shadow = dark & binary_dilation(below, iterations=2)
    water = inside & (infrared < green)
    return binary_dilation(cloud | shadow | water, iterations=MARGIN_TEXELS)


def vegetation_haze(view: Scene, date: str, sun: np.ndarray) -> float:
    """Optical depth of haze at 0.55 µm under which dense dark vegetation is as dark in blue and red as it must be.

    Its reflectance is a quarter in blue, and half in red, of that at 2.2 µm, within 30 % (Kaufman et al. 1997,
    doi:10.1109/36.628795). A date without such vegetation keeps thin haze.
    """
    level = view.clear & (view.land.normal[:, 2] > np.cos(np.radians(5.0)))
    depth = np.arange(0.05, 0.8, 0.05)
    excess = []
    for haze in depth:
        reflectance = np.pi * at_surface(view, view.bands[date] - path_radiance(sun, haze), haze) / (SOLAR * sun[2])
        molecules, particles = depths(CENTRE_UM, haze)
        reflectance = reflectance / np.exp(-(0.5 * molecules + 0.25 * particles) / sun[2])
        _, _, red, infrared, _, shortwave = reflectance.T
        dense = level & (shortwave > 0.01) & (shortwave < 0.05) & (infrared - red > 0.6 * (infrared + red))
        if int(dense.sum()) < LEAST_TEXELS:
            return THIN_HAZE
        blue, _, red, _, _, shortwave = np.median(reflectance[dense], axis=0)
        excess.append([blue - 0.25 * shortwave, red - 0.5 * shortwave, 0.3 * 0.25 * shortwave, 0.3 * 0.5 * shortwave])
    table = np.array(excess)
    cost = (table[:, 0] / table[:, 2]) ** 2 + (table[:, 1] / table[:, 3]) ** 2
    best = int(np.clip(np.argmin(cost), 1, len(depth) - 2))
    curve = np.polyfit(depth[best - 1 : best + 2], cost[best - 1 : best + 2], 2)
    return float(-0.5 * curve[1] / curve[0])


def air_of(haze: float, channels: list[int]) -> Air:
    """Air below a satellite, without its path radiance."""
    molecules, particles = depths(CENTRE_UM[channels], haze)
    around = Surroundings(*scattered_upwards(molecules, particles), TEXEL_M)
    return Air(np.exp(-(molecules + particles)), np.zeros(3), around)


def at_surface(view: Scene, radiance: np.ndarray, haze: float) -> np.ndarray:
    """Radiance ``(N, 6)`` at the surface from that above the air, less its path radiance; saturated texels are bright."""
    result = np.empty_like(radiance)
    known = view.textured(np.ones(len(radiance)), fill=0.0) > 0.0
    bright = np.where(np.isfinite(radiance), radiance, np.nanmax(radiance, axis=0))
    for triple in TRIPLES:
        air = air_of(haze, triple)
        assert air.surroundings is not None
        texture = view.textured(bright[:, triple], fill=0.0)
        result[:, triple] = view.of_texels(without_surroundings(texture, air.transmittance, air.surroundings, known))
    return np.where(np.isfinite(radiance), result, np.nan)


def methods(view: Scene, date: str, sun: np.ndarray, haze: float) -> dict[str, np.ndarray]:
    """Reflectance ``(N, 6)`` by every method, up to a factor; all get the same air, but for ``without_air``."""
    above = view.bands[date]
    above = above - np.minimum(path_radiance(sun, haze), np.nanpercentile(above, 0.1, axis=0))
    radiance = at_surface(view, above, haze)
    block = np.add.outer(*(np.arange(size) // BLOCK_TEXELS for size in view.shape)) % 2 == 0
    kind = view.textured(view.label, fill=-1).astype(int)
    ours = {name: np.empty_like(radiance) for name in ("ours", "without_air", "classes_by_three_bands", "lambertian")}
    for triple in TRIPLES:
        light = texel_irradiance(view.land, light_of(sun, CENTRE_UM[triple], haze))
        # Radiance in units where the sun's normal irradiance is that of the light.
        image = view.textured(above[:, triple] / SOLAR[triple])
        options = DelightOptions(radiance_per_unit=1.0e5, quantum=0.0, air=air_of(haze, triple), register=False)
        chosen = {
            "ours": replace(options, land_class=kind),
            "without_air": replace(options, land_class=kind, air=None),
            "classes_by_three_bands": replace(options, land_class=CLASSES),
            "lambertian": options,
        }
        for name, option in chosen.items():
            halves = [
                delight_image(
                    image, np.zeros(image.shape, bool), light, options=replace(option, fit_where=where)
                ).albedo
                for where in (block, ~block)
            ]
            # Each texel by the response that was fitted elsewhere.
            delit = np.where(block[..., None], halves[1], halves[0])
            ours[name][:, triple] = view.of_texels(delit)
    slopes = slopes_under(view.land.normal, sun)
    radiance = np.where(view.clear[:, None], radiance, np.nan)
    by_class = np.full_like(radiance, np.nan)
    for number in range(CLASSES):
        member = view.label == number
        by_class[member] = CORRECTIONS["c"](radiance[member], slopes_under(view.land.normal[member], sun))
    corrected = {name: correct(radiance, slopes) for name, correct in CORRECTIONS.items()}
    return {"as_it_is": above, **ours, **corrected, "c_by_class": by_class}


def judged(view: Scene, values: dict[str, np.ndarray], cosines: dict[str, np.ndarray], name: str) -> dict[str, float]:
    """Correlations with the cosine of incidence within classes, and agreement of the dates; printed."""
    steep = view.clear & (view.land.normal[:, 2] < np.cos(np.radians(STEEP_DEG)))
    kinds = [k for k in range(CLASSES) if int((view.clear & (view.label == k)).sum()) >= LEAST_TEXELS]

    def table(part: np.ndarray) -> dict[tuple[str, int, str], float]:
        return {
            (date, kind, NAMES[band]): abs(
                correlation(values[date][:, band], cosines[date], part & (view.label == kind))
            )
            for date in DATES
            for kind in kinds
            for band in range(6)
        }

    r, on_steep = table(view.clear), table(steep)
    first, second = (values[date] for date in DATES)
    agreement = float(np.mean([correlation(first[:, band], second[:, band], steep) for band in range(6)]))
    spread = ratio_spread(first, second, steep, view.label, kinds)
    worst, mean, worst_steep = max(r.values()), float(np.mean(list(r.values()))), max(on_steep.values())
    print(
        f"  {name:38s}{worst:7.3f}{mean:7.3f}{worst_steep:11.3f}{agreement:9.3f}{spread:7.3f}  {max(r, key=r.__getitem__)}"
    )
    by_date = {f"abs_r_max_{date}": max(value for at, value in r.items() if at[0] == date) for date in DATES}
    return {
        "abs_r_max": worst,
        "abs_r_mean": mean,
        "steep_abs_r_max": worst_steep,
        **by_date,
        "agreement": agreement,
        "dates_spread": spread,
    }


def ratio_spread(first: np.ndarray, second: np.ndarray, part: np.ndarray, label: np.ndarray, kinds: list[int]) -> float:
    """Standard deviation of the logarithm of the ratio of two dates' reflectance within classes, robust; mean of bands.

    Where only the season changed, and alike within a class, it is 0. (The correlation of two dates, printed beside it,
    also rises with relief that is left in both.)
    """
    total, count = 0.0, 0
    for kind in kinds:
        for band in range(first.shape[1]):
            one, other = (values[part & (label == kind), band] for values in (first, second))
            with np.errstate(invalid="ignore", divide="ignore"):
                ratio = np.log(one) - np.log(other)
            ratio = ratio[np.isfinite(ratio)]
            total += len(ratio) * 1.4826 * float(np.median(np.abs(ratio - np.median(ratio))))
            count += len(ratio)
    return total / count
