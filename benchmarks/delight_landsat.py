"""Landsat rows of the delighting benchmark: ridges in Pennsylvania on two dates with known suns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from albedo_landsat import CENTRE_UM, DATES, NAMES, SOLAR, correlation, light_of, path_radiance, scene

# Land classes by k-means of band ratios of the July scene, which hardly depend on relief; those with fewer steep texels are
# left out.
CLASSES, LEAST_TEXELS = 4, 1500
STEEP_DEG = 8.0


def landsat_numbers(data: Path, seed: int) -> dict[str, Any]:
    """Correlations of reflectance with the cosine of incidence within land classes, and agreement of the dates."""
    folder = data / "landsat-pennsylvania"
    if not folder.is_dir():
        reason = f"no such folder: {folder}; give --data"
        print(f"Landsat: not measured ({reason})")
        return {"landsat_abs_r_max": None, "landsat_reason": reason}
    from seasonscapes.albedo.corrections import CORRECTIONS, slopes_under
    from seasonscapes.albedo.delighting import DelightOptions, delight_image
    from seasonscapes.albedo.forward_model import trace_texel_transport
    from seasonscapes.albedo.texel_light import texel_irradiance
    from seasonscapes.frames import direction_from_angles
    from seasonscapes.rendering.coefficients import SamplingOptions

    terrain, shape, bands = scene(folder)
    sampling = SamplingOptions(shadow_samples=1, rays=128, clusters_per_receiver=64, clusters=4096, rank=24)
    land = trace_texel_transport(terrain, shape, sampling=sampling, seed=seed)
    steep = np.degrees(np.arccos(np.clip(land.normal[:, 2], -1.0, 1.0))) > STEEP_DEG
    label = land_classes(bands[next(iter(DATES))].reshape(-1, 6)[land.texel], seed)
    kind = np.full(shape[0] * shape[1], -1)
    kind[land.texel] = label
    results: dict[str, dict[str, np.ndarray]] = {}
    cosines = {}
    for date, (elevation, azimuth) in DATES.items():
        sun = direction_from_angles(azimuth, elevation)
        slopes = slopes_under(land.normal, sun)
        cosines[date] = slopes.incidence
        radiance = bands[date].reshape(-1, 6)[land.texel]
        radiance = radiance - np.minimum(path_radiance(sun), np.nanpercentile(radiance, 0.1, axis=0))
        ours, lambertian = np.empty_like(radiance), np.empty_like(radiance)
        for triple in ([2, 1, 0], [3, 4, 5]):
            light = texel_irradiance(land, light_of(sun, CENTRE_UM[triple]))
            texture = np.full((shape[0] * shape[1], 3), np.nan, np.float32)
            texture[land.texel] = radiance[:, triple] / SOLAR[triple]
            clipped = np.zeros((*shape, 3), bool)
            # Radiance in units where the sun's normal irradiance is that of the light.
            options = DelightOptions(radiance_per_unit=1.0e5, quantum=0.0)
            for result, classes in ((lambertian, None), (ours, kind.reshape(shape))):
                chosen = replace(options, land_class=classes)
                delit = delight_image(texture.reshape(*shape, 3), clipped, light, options=chosen)
                result[:, triple] = delit.albedo.reshape(-1, 3)[land.texel]
        results[date] = {"as_it_is": radiance, "ours": ours, "lambertian": lambertian}
        results[date] |= {name: correct(radiance, slopes) for name, correct in CORRECTIONS.items()}
        by_class = np.full_like(radiance, np.nan)
        for number in range(CLASSES):
            member = label == number
            by_class[member] = CORRECTIONS["c"](radiance[member], slopes_under(land.normal[member], sun))
        results[date]["c_by_class"] = by_class
    numbers: dict[str, Any] = {}
    names = list(results[next(iter(DATES))])
    kinds = [number for number in range(CLASSES) if int((label == number).sum()) >= LEAST_TEXELS]
    print(
        f"{'Landsat: |r| with cos i within classes':40s}{'max':>7s}{'mean':>7s}{'steep max':>11s}{'mean':>7s}{'dates r':>9s}"
    )
    for name in names:
        r, on_steep = (
            {
                (date, kind, NAMES[band]): abs(
                    correlation(results[date][name][:, band], cosines[date], part & (label == kind))
                )
                for date in DATES
                for kind in kinds
                for band in range(6)
            }
            for part in (np.ones(len(label), bool), steep)
        )
        first, second = (results[date][name] for date in DATES)
        agreement = float(np.mean([correlation(first[:, band], second[:, band], steep) for band in range(6)]))
        worst, worst_steep = max(r.values()), max(on_steep.values())
        means = [float(np.mean(list(values.values()))) for values in (r, on_steep)]
        print(f"  {name:38s}{worst:7.2f}{means[0]:7.2f}{worst_steep:11.2f}{means[1]:7.2f}{agreement:9.2f}")
        if name == "ours":
            by_date = ", ".join(f"{date} {max(v for at, v in r.items() if at[0] == date):.2f}" for date in DATES)
            print(f"    largest by date: {by_date}; worst: {max(r, key=r.__getitem__)}")
        key = "landsat" if name == "ours" else f"landsat_{name}"
        numbers |= {
            f"{key}_abs_r_max": worst,
            f"{key}_abs_r_mean": means[0],
            f"{key}_steep_abs_r_max": worst_steep,
            **{f"{key}_abs_r_max_{date}": max(value for at, value in r.items() if at[0] == date) for date in DATES},
            f"{key}_agreement": agreement,
        }
    return numbers


def land_classes(values: np.ndarray, seed: int) -> np.ndarray:
    """Class ``(N,)`` of each texel by k-means of the logarithms of band ratios; −1 where they are unknown."""
    from scipy.cluster.vq import kmeans2

    known = np.isfinite(values).all(axis=1) & (values > 0.0).all(axis=1)
    logarithm = np.diff(np.log(values[known]), axis=1)
    logarithm = (logarithm - logarithm.mean(axis=0)) / logarithm.std(axis=0)
    label = np.full(len(values), -1)
    label[known] = kmeans2(logarithm, CLASSES, minit="++", rng=np.random.default_rng(seed))[1]
    return label
