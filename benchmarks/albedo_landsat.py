"""Albedo from two real Landsat dates with known sun: is the relief gone?

    python benchmarks/albedo_landsat.py [--quick] [--seed N] [--json FILE] [--data FOLDER]

Ridges in Pennsylvania, 30 m. What is measured is the correlation of each band with the cosine of incidence, before and
after, on slopes steeper than 8°; ours beside the corrections. The air's own radiance is that of single scattering by
molecules and thin haze, for all methods, at most the band's darkest thousandth. (A dark object alone takes too much from
the infrared, whose darkest thousandth is shaded land.) ``--seed`` decides the rays.
"""

from __future__ import annotations

import argparse
import secrets
import sys
from pathlib import Path

import numpy as np
from record import write_record

# Sun's elevation and azimuth [deg] of each date, from the scenes' headers.
DATES = {"2002-07-20": (61.4, 125.8), "2002-11-25": (26.2, 159.5)}
# Radiance = gain · DN + bias [W m⁻² sr⁻¹ µm⁻¹]; band centres [µm]; bands 1, 2, 3, 4, 5, 7 in the files' order.
GAIN = np.array([0.77569, 0.79569, 0.61922, 0.63725, 0.12573, 0.04373])
BIAS = np.array([-6.20, -6.40, -5.00, -5.10, -1.00, -0.35])
SOLAR = np.array([1969.0, 1840.0, 1551.0, 1044.0, 225.7, 82.07])
CENTRE_UM = np.array([0.483, 0.560, 0.662, 0.835, 1.648, 2.206])
NAMES = ("1", "2", "3", "4", "5", "7")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="it is quick anyway")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    args = parser.parse_args()
    folder = args.data / "landsat-pennsylvania"
    if not folder.is_dir():
        sys.exit(f"no such folder: {folder}; give --data")
    seed = secrets.randbelow(100_000) if args.seed is None else args.seed
    write_record(args.json, measure(folder, seed), seed=seed)


def measure(folder: Path, seed: int) -> dict[str, float]:
    """Correlations by date, band and method; printed as a table."""
    from seasonscapes.albedo.corrections import CORRECTIONS, slopes_under
    from seasonscapes.albedo.forward_model import trace_texel_transport
    from seasonscapes.albedo.texture_delighting import delight_textures
    from seasonscapes.frames import direction_from_angles
    from seasonscapes.rendering.backend import use_backend

    use_backend()
    terrain, shape, bands = scene(folder)
    land = trace_texel_transport(terrain, shape, seed=seed)
    normal = land.normal
    steep = np.degrees(np.arccos(normal[:, 2])) > 8.0
    numbers: dict[str, float] = {}
    kept: dict[str, dict[str, np.ndarray]] = {}
    for date, (elevation, azimuth) in DATES.items():
        sun = direction_from_angles(azimuth, elevation)
        slopes = slopes_under(normal, sun)
        radiance = bands[date].reshape(-1, 6)[land.texel]
        radiance = radiance - np.minimum(path_radiance(sun), np.nanpercentile(radiance, 0.1, axis=0))
        ours = np.empty_like(radiance)
        for triple in ([2, 1, 0], [3, 4, 5]):
            light = light_of(sun, CENTRE_UM[triple])
            texture = np.full((shape[0] * shape[1], 3), np.nan, np.float32)
            # Radiance in units where the sun's normal irradiance is that of `light`.
            texture[land.texel] = radiance[:, triple] / SOLAR[triple] * 1.0e5
            ours[:, triple] = delight_textures(land, [texture.reshape(*shape, 3)], [light])[0].reshape(-1, 3)[
                land.texel
            ]
        methods = {"as it is": radiance, "ours": ours}
        methods |= {name: correct(radiance, slopes) for name, correct in CORRECTIONS.items()}
        kept[date] = methods
        print(f"{date}: correlation with the cosine of incidence on slopes over 8° ({steep.sum()} texels)")
        print(f"  {'':10s}" + "".join(f"{'band ' + name:>9s}" for name in NAMES))
        for name, values in methods.items():
            r = [correlation(values[:, b], slopes.incidence, steep) for b in range(6)]
            numbers |= {f"{date[5:7]}_{name.replace(' ', '_')}_band{b}": v for b, v in zip(NAMES, r, strict=True)}
            print(f"  {name:10s}" + "".join(f"{v:9.2f}" for v in r))
    first, second = DATES
    print("correlation of the two dates with each other")
    for name in kept[first]:
        r = [correlation(kept[first][name][:, b], kept[second][name][:, b], steep) for b in range(6)]
        numbers |= {f"agreement_{name.replace(' ', '_')}_band{b}": v for b, v in zip(NAMES, r, strict=True)}
        print(f"  {name:10s}" + "".join(f"{v:9.2f}" for v in r))
    return numbers


def correlation(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    """Pearson's r between its 1st and 99th percentiles of ``a``, over finite values in a mask."""
    keep = mask & np.isfinite(a) & np.isfinite(b)
    low, high = np.percentile(a[keep], [1.0, 99.0])
    keep &= (a >= low) & (a <= high)
    return float(np.corrcoef(a[keep], b[keep])[0, 1])


def scene(folder: Path):
    """Terrain, texture shape, and radiance ``(R, S, 6)`` of each date in its atlas."""
    import cv2

    from seasonscapes.terrain.imagery import bake_imagery
    from seasonscapes.terrain.mesh import build_mesh
    from seasonscapes.terrain.raster import centre_frame, fill_nodata, read_elevation, read_raster
    from seasonscapes.terrain.surface import Raster
    from seasonscapes.terrain.unwrap import unwrap

    elevation, _ = fill_nodata(read_elevation(folder / "dem_30m.tif"))
    # The model has noise on flats and seams between quads.
    smooth = cv2.GaussianBlur(elevation.values[..., 0], (0, 0), 1.0)[..., None]
    terrain, atlas = unwrap(
        build_mesh(Raster(smooth, elevation.transform, elevation.crs), centre_frame(elevation), mesher="grid"),
        texel_m=30.0,
    )
    bands = {}
    for date in DATES:
        raster = read_raster(folder / f"landsat7_{date}.tif")
        values = np.where(raster.values >= 255.0, np.nan, raster.values * GAIN + BIAS).astype(np.float32)
        halves = [
            bake_imagery(terrain, atlas, Raster(values[..., k : k + 3], raster.transform, raster.crs)) for k in (0, 3)
        ]
        bands[date] = np.concatenate([np.where(h.weight[..., None] > 0.0, h.values, np.nan) for h in halves], axis=2)
    return terrain, (atlas.height_px, atlas.width_px), bands


THIN_HAZE = 0.12


def depths(centre_um: np.ndarray, haze_depth: float = THIN_HAZE) -> tuple[np.ndarray, np.ndarray]:
    """Optical depths of molecules and of haze, whose depth at 0.55 µm is given."""
    return 0.0088 * centre_um**-4.05, haze_depth * (centre_um / 0.55) ** -1.3


def path_radiance(sun: np.ndarray, haze_depth: float = THIN_HAZE) -> np.ndarray:
    """Radiance ``(6,)`` [W m⁻² sr⁻¹ µm⁻¹] that the air sends straight up under a sun, scattered once."""
    rayleigh, haze = depths(CENTRE_UM, haze_depth)
    cosine, g = -float(sun[2]), 0.65
    molecules = 0.75 * (1.0 + cosine**2)
    particles = 0.93 * (1.0 - g * g) / (1.0 + g * g - 2.0 * g * cosine) ** 1.5
    return SOLAR / np.pi * (rayleigh * molecules + haze * particles) / 4.0


def light_of(sun: np.ndarray, centre_um: np.ndarray, haze_depth: float = THIN_HAZE):
    """Hosek's sun and sky at three bands: the sky's share falls with wavelength as that of thin air and haze does.

    The sun's normal irradiance outside the air is 1e5 in every band.
    """
    from dataclasses import replace

    from seasonscapes.rendering.hosek import hosek_illumination

    light = hosek_illumination(sun, turbidity=3.0)
    airmass = 1.0 / sun[2]
    rayleigh, haze = depths(centre_um, haze_depth)
    direct = 1.0e5 * np.exp(-(rayleigh + haze) * airmass)
    # Half of what molecules scatter and most of what haze does comes down; the map gives its shape alone.
    diffuse = 1.0e5 * sun[2] * (1.0 - np.exp(-(0.5 * rayleigh + 0.75 * haze) * airmass))
    from seasonscapes.sky.illumination import diffuse_horizontal_illuminance

    grey = light.sky_radiance.mean(axis=2, keepdims=True)
    shape = grey / diffuse_horizontal_illuminance(np.repeat(grey, 3, axis=2))[0]
    return replace(
        light, sky_radiance=(shape * diffuse).astype(np.float32), sun=replace(light.sun, normal_illuminance_lx=direct)
    )


if __name__ == "__main__":
    main()
