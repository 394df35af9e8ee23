"""Light taken out of single images: a massif photographed from above, suns of unknown hours, and real Landsat scenes.

    python benchmarks/delight.py [--quick] [--seed N] [--json FILE] [--data FOLDER]

* Synthetic: a massif (seed drawn at run time) photographed from above at a known hour: path traced, 8-bit sRGB, a
  hundredth clipped, 0.3 texels off; the heights that we are given have half the image's resolution. Scored: albedo (PSNR,
  peak 1), pictures from above relit at four other hours on the true terrain against the same with the true albedo,
  developed alike (PSNR), and the step of albedo error across borders of cast shadows. Beside it: the lit image itself,
  and the cosine, Minnaert, C and SCS+C corrections, which get the true shift and exposure and their best common scale.
  Controls: the clock an hour off, the light mirrored from east to west, and flat relief.
* Suns: 30 such scenes of unknown season and hour; the share whose sun is found within 5° of azimuth and 4° of elevation,
  and how many wrong ones were trusted. Controls: mirrored images, and mosaics of two hours.
* Landsat (where the data folder is present): |r| of reflectance with the cosine of incidence within land classes (by band
  ratios), on all slopes and on those over 8°, two dates with known suns; correlation of the dates, and the standard
  deviation σ of the logarithm of their ratio within classes. Clouds, their shadows and water are left out. All methods
  get the same air, moved images and classes; the response of each class to direct light is fitted crosswise, never where
  it is judged. Rows beside ours: ``without_air``, ``classes_by_three_bands`` (classes found in each image by itself, as
  the command does), ``lambertian``, and ``c_by_class``, the C correction fitted in the same classes (and judged there).
* Ararat (likewise): the sun of a winter image, and the step of brightness across the borders of its large cast shadows.
* Mesh: rocks and a hut on a patch of ground with three textures, y up, shifted origin; textures path traced by Mitsuba's own
  integrator at one hour (8-bit sRGB), delit, written, read and relit at two others: PSNR over texels. Control: the clock an
  hour off.
"""

from __future__ import annotations

import argparse
import os
import secrets
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from delight_ararat import ararat_numbers  # noqa: E402
from delight_landsat import landsat_numbers  # noqa: E402
from delight_scene import (  # noqa: E402
    LATITUDE_DEG,
    Truth,
    eight_bit,
    light_at,
    lit_from_above,
    make_truth,
    orthophoto,
    possible_sun,
    relief_of,
    transport_of,
    unit_of,
)
from mesh_scene import mesh_relit, mesh_suns  # noqa: E402
from record import write_record  # noqa: E402

from seasonscapes.albedo.corrections import CORRECTIONS, slopes_under  # noqa: E402
from seasonscapes.albedo.delighting import SLOPE_ERROR, DelightOptions, TexelIrradiance, delight_image  # noqa: E402
from seasonscapes.albedo.forward_model import TexelTransport, sun_on_texels  # noqa: E402
from seasonscapes.albedo.registration import shifted_back  # noqa: E402
from seasonscapes.albedo.sun_search import find_sun  # noqa: E402
from seasonscapes.albedo.texel_light import texel_irradiance  # noqa: E402
from seasonscapes.exposure import develop, exposure_ev100  # noqa: E402
from seasonscapes.images import srgb_from_linear  # noqa: E402
from seasonscapes.rendering.backend import use_backend  # noqa: E402
from seasonscapes.sky.illumination import Illumination  # noqa: E402

# Sun of the photograph, of the hours that are relit, and of a clock that is an hour off [deg].
PHOTOGRAPH = (150.0, 38.0)
RELIT = ((95.0, 18.0), (130.0, 45.0), (215.0, 42.0), (262.0, 14.0))
AN_HOUR_LATER = (168.0, 42.5)
SHIFT_TEXELS = (0.22, -0.2)
BARS = {
    "albedo_psnr_db": (27.0, "at least"),
    "relit_psnr_db": (29.0, "at least"),
    "margin_over_best_correction_db": (6.0, "at least"),
    "shadow_border_step": (0.05, "at most"),
    "sun_found_rate": (0.9, "at least"),
    "sun_wrong_trusted": (0.0, "at most"),
    "landsat_abs_r_max": (0.1, "at most"),
    "landsat_dates_spread_over_best_correction": (1.0, "at most"),
    "mesh_relit_psnr_db": (28.0, "at least"),
    "mesh_sun_found_rate": (0.9, "at least"),
    "mesh_sun_wrong_trusted": (0.0, "at most"),
    "mesh_overcast_trusted": (0.0, "at most"),
}


@dataclass(frozen=True)
class Size:
    """How large the benchmark is."""

    size_m: float
    spacing_m: float
    scenes: int


QUICK = Size(7920.0, 30.0, 30)
FULL = Size(12000.0, 30.0, 60)


def psnr(error: np.ndarray) -> float:
    """Of errors, peak 1 [dB]."""
    return float(-10.0 * np.log10(np.mean(np.square(error, dtype=float))))


@dataclass(frozen=True)
class Photograph:
    """A truth-known photograph from above, and what is needed to judge albedos of it."""

    truth: Truth
    light: Illumination
    image: np.ndarray
    clipped: np.ndarray
    unit: np.ndarray
    coarse: TexelTransport
    fine: TexelTransport

    @property
    def known(self) -> np.ndarray:
        """``(R, S)`` texels that both terrains and the image cover, three texels inside the rim."""
        known = np.isfinite(self.image).all(axis=2)
        for transport in (self.coarse, self.fine):
            covered = np.zeros(known.size, bool)
            covered[transport.texel] = True
            known = known & covered.reshape(known.shape)
        inside = np.zeros(known.shape, bool)
        inside[3:-3, 3:-3] = True
        return known & inside


def photographed(seed: int, size: Size) -> Photograph:
    """The massif of a seed and its photograph."""
    truth, light = make_truth(seed, size_m=size.size_m, spacing_m=size.spacing_m), light_at(*PHOTOGRAPH)
    radiance = orthophoto(truth, light, shift_texels=SHIFT_TEXELS, seed=seed)
    unit = unit_of(radiance, light)
    image, clipped = eight_bit(radiance, unit)
    coarse = transport_of(truth.coarse, truth.shape, seed + 1)
    fine = transport_of(truth.terrain, truth.shape, seed + 2)
    return Photograph(truth, light, image, clipped, unit, coarse, fine)


class Judge:
    """Scores albedos of a photograph against the truth."""

    def __init__(self, photograph: Photograph):
        self.photograph, self.known = photograph, photograph.known
        self.lights = [light_at(*sun) for sun in RELIT]
        self.reference = [self._lit(photograph.truth.albedo, light) for light in self.lights]
        self.ev = [exposure_ev100(np.where(self.known[..., None], image, 0.0)) for image in self.reference]
        self.borders = shadow_borders(photograph)

    def _lit(self, albedo: np.ndarray, light: Illumination) -> np.ndarray:
        return lit_from_above(self.photograph.fine, light, albedo)

    def scores(self, albedo: np.ndarray) -> dict[str, float]:
        """PSNR of albedo and of relit pictures [dB], and the step across shadow borders."""
        true = self.photograph.truth.albedo
        guess = np.where(np.isfinite(albedo), albedo, 0.2).astype(np.float32)
        errors = []
        for light, reference, ev in zip(self.lights, self.reference, self.ev, strict=True):
            pictures = [srgb_from_linear(develop(image, ev)) for image in (self._lit(guess, light), reference)]
            errors.append((pictures[0] - pictures[1])[self.known])
        return {
            "albedo_psnr_db": psnr((guess - true)[self.known]),
            "relit_psnr_db": psnr(np.concatenate(errors)),
            "shadow_border_step": border_step(guess, true, self.borders),
        }


def shadow_borders(photograph: Photograph) -> np.ndarray:
    """Flat indices ``(E, 2)`` of texels two apart across true borders of cast shadows, the sunlit one first."""
    fine, light = photograph.fine, photograph.light
    assert light.sun is not None
    sun = sun_on_texels(fine, light)[:, 1].reshape(photograph.truth.shape)
    facing = np.zeros(sun.size, np.float32)
    facing[fine.texel] = np.maximum(fine.normal @ np.asarray(light.sun.direction, np.float32), 0.0)
    full = facing.reshape(sun.shape) * float(light.sun.normal_illuminance_lx[1])
    # Slopes that turn away from the sun have no border of a cast shadow.
    bright = full > 0.2 * float(light.sun.normal_illuminance_lx[1])
    lit, dark = bright & (sun > 0.9 * full), bright & (sun < 0.1 * full)
    index = np.arange(sun.size).reshape(sun.shape)
    found = []
    for one, other in (
        ((slice(None), slice(None, -2)), (slice(None), slice(2, None))),
        ((slice(None, -2),), (slice(2, None),)),
    ):
        both = photograph.known[one] & photograph.known[other]
        for first, second in ((one, other), (other, one)):
            keep = both & lit[first] & dark[second]
            found.append(np.stack([index[first][keep], index[second][keep]], axis=1))
    return np.concatenate(found)


def border_step(guess: np.ndarray, true: np.ndarray, borders: np.ndarray) -> float:
    """Median over borders of the step in recovered over true albedo from sun to shade; 0 where no ghost is left."""
    ratio = np.clip(guess, 1e-3, None).mean(axis=2).ravel() / np.maximum(true.mean(axis=2).ravel(), 1e-3)
    lit, dark = ratio[borders[:, 0]], ratio[borders[:, 1]]
    return float(abs(np.median((lit - dark) / (0.5 * (lit + dark)))))


def corrected(photograph: Photograph) -> dict[str, np.ndarray]:
    """Albedo by each correction and of the lit image itself, each with the scale that fits the truth best."""
    truth, light = photograph.truth, photograph.light
    assert light.sun is not None
    normal = np.tile([0.0, 0.0, 1.0], (photograph.image.shape[0] * photograph.image.shape[1], 1))
    normal[photograph.coarse.texel] = photograph.coarse.normal
    radiance = shifted_back(photograph.image, SHIFT_TEXELS).reshape(-1, 3) * photograph.unit
    slopes = slopes_under(normal, light.sun.direction)
    result = {"as_it_is": radiance, **{name: correct(radiance, slopes) for name, correct in CORRECTIONS.items()}}
    true, known = truth.albedo.reshape(-1, 3), photograph.known.ravel()
    scaled = {}
    for name, values in result.items():
        # Where a correction is blind (the sun behind the slope) the plain image stands in.
        values = np.where(np.isfinite(values), values, radiance)
        use = known & np.isfinite(values).all(axis=1)
        scale = (values[use] * true[use]).sum(axis=0) / (values[use] ** 2).sum(axis=0)
        scaled[name] = np.clip(values * scale, 0.0, 1.0).reshape(truth.albedo.shape)
    return scaled


def mirrored(light: TexelIrradiance) -> TexelIrradiance:
    """The light of a terrain that is mirrored from east to west, for the image of the terrain as it is."""
    return replace(
        light,
        sun=light.sun[:, ::-1].copy(),
        visibility=light.visibility[:, ::-1].copy(),
        sky=light.sky[:, ::-1].copy(),
        bounce=lambda albedo: light.bounce(albedo[:, ::-1].copy())[:, ::-1].copy(),
    )


def flat(light: TexelIrradiance, sun_share: Illumination) -> TexelIrradiance:
    """The light of level ground."""
    assert sun_share.sun is not None
    sun = np.asarray(sun_share.sun.normal_illuminance_lx) * sun_share.sun.direction[2]
    return replace(
        light,
        sun=np.broadcast_to(sun, light.sun.shape).astype(np.float32),
        visibility=np.ones_like(light.visibility),
        sky=np.broadcast_to(light.level_lx - sun, light.sky.shape).astype(np.float32),
        bounce=lambda albedo: np.zeros_like(albedo),
    )


def synthetic(seed: int, size: Size, numbers: dict[str, Any], pictures: Path | None) -> None:
    """The photograph of a known hour: ours, stages swapped for the truth, corrections, controls."""
    photograph = photographed(seed, size)
    judge = Judge(photograph)
    known_scale = DelightOptions(radiance_per_unit=photograph.unit)
    ours = texel_irradiance(photograph.coarse, photograph.light, slope_error=SLOPE_ERROR)
    image, clipped = photograph.image, photograph.clipped

    def run(light: TexelIrradiance, options: DelightOptions = known_scale) -> np.ndarray:
        return delight_image(image, clipped, light, options=options).albedo

    start = time.perf_counter()
    delit = delight_image(image, clipped, ours, options=known_scale)
    numbers["seconds_delighting"] = time.perf_counter() - start
    numbers |= {f"fit_{name}": value for name, value in delit.facts.items()}
    error = np.abs(delit.albedo - photograph.truth.albedo).mean(axis=2) / delit.sigma
    numbers["error_over_sigma_median"] = float(np.nanmedian(error[photograph.known]))
    rows = {"ours": delit.albedo}
    rows["predicted_shadows"] = run(ours, replace(known_scale, borders=None))
    rows["unregistered"] = run(ours, replace(known_scale, register=False))
    rows["sky_as_modelled"] = run(ours, replace(known_scale, fit_sky=False))
    rows["true_relief"] = run(texel_irradiance(photograph.fine, photograph.light))
    rows["hazier_sky_assumed"] = run(texel_irradiance(photograph.coarse, light_at(*PHOTOGRAPH, turbidity=5.0)))
    rows |= {f"correction_{name}": values for name, values in corrected(photograph).items()}
    rows["control_hour_off"] = run(texel_irradiance(photograph.coarse, light_at(*AN_HOUR_LATER)))
    rows["control_mirrored"] = run(mirrored(ours))
    rows["control_flat"] = run(flat(ours, photograph.light))
    table = {name: judge.scores(values) for name, values in rows.items()}
    print(f"{'albedo of a photograph from above':36s}{'albedo dB':>11s}{'relit dB':>10s}{'step':>8s}")
    for name, scores in table.items():
        print(
            f"{name:36s}{scores['albedo_psnr_db']:11.2f}{scores['relit_psnr_db']:10.2f}{scores['shadow_border_step']:8.3f}"
        )
        numbers |= {(key if name == "ours" else f"{name}_{key}"): value for key, value in scores.items()}
    best = max(table[f"correction_{name}"]["albedo_psnr_db"] for name in CORRECTIONS)
    numbers["margin_over_best_correction_db"] = numbers["albedo_psnr_db"] - best
    if pictures is not None:
        save_pictures(pictures, photograph, rows)


def save_pictures(folder: Path, photograph: Photograph, rows: dict[str, np.ndarray]) -> None:
    """The image, the truth and each albedo, side by side in one file each."""
    from seasonscapes.images import write_png

    folder.mkdir(parents=True, exist_ok=True)
    shown = {"image": photograph.image, "truth": photograph.truth.albedo, **rows}
    for name, values in shown.items():
        write_png(folder / f"{name}.png", np.clip(np.nan_to_num(values), 0.0, 1.0))


def suns(seed: int, size: Size, numbers: dict[str, Any]) -> None:
    """Suns of images of unknown hour, of mirrored ones, and of mosaics."""
    rng = np.random.default_rng(seed)
    found = trusted = wrong = mirrored_trusted = mosaics_trusted = mosaics = 0
    azimuth_errors, elevation_errors = [], []
    for number in range(size.scenes):
        truth = make_truth(
            int(rng.integers(1, 100_000)), size_m=7920.0, spacing_m=60.0, day_of_year=int(rng.integers(1, 366))
        )
        (azimuth, elevation), other = possible_sun(rng), possible_sun(rng)
        shift = tuple(rng.uniform(-0.3, 0.3, 2))
        image = _stored(truth, azimuth, elevation, float(rng.uniform(2.0, 5.0)), shift)
        relief = relief_of(truth.coarse, truth.shape)
        relief = replace(relief, known=relief.known & np.isfinite(image))
        result = find_sun(np.nan_to_num(image), relief, latitude_deg=LATITUDE_DEG)
        off = abs((result.azimuth_deg - azimuth + 180.0) % 360.0 - 180.0)
        good = off <= 5.0 and abs(result.elevation_deg - elevation) <= 4.0
        azimuth_errors.append(off)
        elevation_errors.append(abs(result.elevation_deg - elevation))
        found, trusted, wrong = found + good, trusted + result.trusted, wrong + (result.trusted and not good)
        if number % 5 == 0:
            # An image mirrored from east to west has no sun on this relief.
            turned = np.nan_to_num(image[:, ::-1])
            usable = replace(relief, known=relief.known & relief.known[:, ::-1])
            mirrored_trusted += find_sun(turned, usable, latitude_deg=LATITUDE_DEG).trusted
            if abs((other[0] - azimuth + 180.0) % 360.0 - 180.0) > 40.0:
                mosaics += 1
                half = image.shape[1] // 2
                mixed = image.copy()
                mixed[:, half:] = _stored(truth, *other, 3.0, shift)[:, half:]
                mosaics_trusted += find_sun(np.nan_to_num(mixed), relief, latitude_deg=LATITUDE_DEG).trusted
    numbers |= {
        "sun_scenes": size.scenes,
        "sun_found_rate": found / size.scenes,
        "sun_trusted_rate": trusted / size.scenes,
        "sun_wrong_trusted": wrong,
        "sun_mirrored_trusted": int(mirrored_trusted),
        "sun_mosaics": mosaics,
        "sun_mosaics_trusted": int(mosaics_trusted),
        "sun_azimuth_error_median_deg": float(np.median(azimuth_errors)),
        "sun_elevation_error_median_deg": float(np.median(elevation_errors)),
    }
    print(
        f"sun unknown: {found} of {size.scenes} within 5° / 4°, {trusted} trusted, {wrong} of them wrong; "
        f"{mirrored_trusted} mirrored and {mosaics_trusted} of {mosaics} mosaics trusted"
    )


def _stored(truth: Truth, azimuth: float, elevation: float, turbidity: float, shift: tuple[float, ...]) -> np.ndarray:
    """Brightness ``(R, S)`` of an 8-bit photograph."""
    light = light_at(azimuth, elevation, turbidity=turbidity)
    radiance = orthophoto(truth, light, samples=2, spp=8, seed=truth.seed, shift_texels=(shift[0], shift[1]))
    return eight_bit(radiance, unit_of(radiance, light))[0].mean(axis=2)


def meshes(seed: int, quick: bool, numbers: dict[str, Any]) -> None:
    """A textured mesh with three textures, y up, shifted origin: lit, delit, relit; and suns of meshes of unknown hour."""
    with tempfile.TemporaryDirectory() as folder:
        scores = mesh_relit(seed, Path(folder), texels=128 if quick else 256, spp=128 if quick else 256, rays=128)
        scores |= mesh_suns(seed, Path(folder), scenes=9 if quick else 30)
    print("mesh: " + ", ".join(f"{name} {value:.2f}" for name, value in scores.items()), flush=True)
    numbers.update(scores)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="smaller scenes")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--pictures", type=Path, default=None, help="folder for pictures of the albedos")
    parser.add_argument(
        "--only", nargs="+", choices=("synthetic", "suns", "landsat", "ararat", "mesh"), help="parts to run; all"
    )
    data = Path(os.environ.get("SEASONSCAPES_DATA") or HERE.parents[1] / "shared" / "data")
    parser.add_argument("--data", type=Path, default=data, help="default: $SEASONSCAPES_DATA or ../shared/data")
    args = parser.parse_args()
    seed = secrets.randbelow(100_000) if args.seed is None else args.seed
    size = QUICK if args.quick else FULL
    use_backend()
    numbers: dict[str, Any] = {"seed": seed}
    parts = {
        "synthetic": lambda: synthetic(seed, size, numbers, args.pictures),
        "suns": lambda: suns(seed, size, numbers),
        "landsat": lambda: numbers.update(landsat_numbers(args.data, seed)),
        "ararat": lambda: numbers.update(ararat_numbers(args.data)),
        "mesh": lambda: meshes(seed, args.quick, numbers),
    }
    for name in args.only or parts:
        start = time.perf_counter()
        parts[name]()
        print(f"  ({time.perf_counter() - start:.0f} s)", flush=True)
    for name, (bar, sense) in BARS.items():
        value = numbers.get(name)
        if value is None:
            verdict = "not measured"
        else:
            verdict = "holds" if (value >= bar if sense == "at least" else value <= bar) else "MISSED"
        print(f"{name:34s}{'-' if value is None else f'{value:.3f}':>9s}  {sense} {bar:g}: {verdict}")
    write_record(args.json, numbers, seed=seed)


if __name__ == "__main__":
    main()
