"""Albedo from a truth-known day of webcam pictures: our closed form beside the corrections of remote sensing, and controls.

    python benchmarks/albedo.py [--quick] [--seed N] [--json FILE] [--pictures FOLDER] [--workspace FOLDER]

A synthetic massif (seed drawn at run time) with its albedo of a September day, low cameras, hours of one day to fit; path
traced, seen through air under the Bruneton sky. Cases: clean (linear, known exposure), webcam (8-bit sRGB, JPEG 88, noise,
unknown exposure and white balance), and those of `albedo_cases`, where the closed form's assumptions are wrong and the joint
recovery stands beside it. Scored over all texels that fill at least one pixel of some camera:

* PSNR of albedo (peak 1), relative error Σ|Δ| / Σ albedo, of all texels and of those never sunlit in any picture;
* relit PSNR: pictures of held-out hours (two of the day, two of a December day's light), path traced at 32 samples with the
  recovered albedo against the same with the true albedo and other random numbers, developed alike, over terrain. The
  ceiling is the true albedo itself, rendered once more;
* shadow ghost: median step of albedo error across edges of cast shadows, relative to albedo.

The corrections get more than they could know: exposure, white balance and air are taken out for them by our fit.
"""

from __future__ import annotations

import argparse
import secrets
import sys
import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from albedo_cases import CASES, assumed_haze, case_scene, solve_case  # noqa: E402
from albedo_scene import Truth, hours, lights_for, make_truth, path_traced  # noqa: E402
from record import write_record  # noqa: E402

from seasonscapes.albedo.closed_form import AlbedoFit, SearchOptions, solve_albedo  # noqa: E402
from seasonscapes.albedo.corrections import CORRECTIONS, slopes_under  # noqa: E402
from seasonscapes.albedo.forward_model import sun_on_texels, trace_texel_transport  # noqa: E402
from seasonscapes.albedo.haze import fit_visibility  # noqa: E402
from seasonscapes.albedo.photographs import EIGHT_BIT, LINEAR, prepare_photographs  # noqa: E402
from seasonscapes.albedo.resampled_radiance import resampled_radiance  # noqa: E402
from seasonscapes.albedo.tone_curve import fit_tone_curve, with_tone_curve  # noqa: E402
from seasonscapes.cameras.observation import Observation  # noqa: E402
from seasonscapes.evaluation.webcam_faults import WebcamFaults, degrade  # noqa: E402
from seasonscapes.exposure import develop, exposure_ev100  # noqa: E402
from seasonscapes.images import linear_from_srgb, srgb_from_linear  # noqa: E402
from seasonscapes.sky.illumination import global_horizontal_illuminance  # noqa: E402
from seasonscapes.sky.models import read_sky_model, with_overrides  # noqa: E402
from seasonscapes.workspace import Workspace, default_workspace  # noqa: E402

FIT_DATE, WINTER_DATE = "2024-09-10", "2024-12-05"


@dataclass(frozen=True)
class Size:
    """How large the benchmark is."""

    size_m: float
    spacing_m: float
    texel_m: float
    cameras: int
    size_px: tuple[int, int]
    clock: tuple[float, ...]
    spp: int


QUICK = Size(7920.0, 60.0, 60.0, 4, (192, 128), (6.0, 8.0, 9.5, 11.0, 13.0, 15.5), 64)
FULL = Size(7920.0, 30.0, 40.0, 6, (384, 256), (6.0, 7.5, 9.0, 10.5, 12.0, 13.5, 15.0, 16.5), 64)


# ---------------------------------------------------------------------------------------------- observations


def observations(truth: Truth, times, pictures, faults: WebcamFaults | None, seed: int):
    """Observations in the order time, camera, and the true gain of each."""
    rng = np.random.default_rng(seed)
    found, gains = [], []
    for t, moment in enumerate(times):
        for c, camera in enumerate(truth.cameras):
            image = pictures[t][c]
            gain = np.ones(3)
            if faults is not None:
                levels, done = degrade(image, faults, rng)
                image, gain = linear_from_srgb(levels / 255.0), done.gains
            found.append(Observation(image, np.ones(image.shape[:2], bool), camera, moment, f"camera{c}"))
            gains.append(gain)
    return found, gains


def flat(lights) -> list:
    """Lights in the order of `observations`."""
    return [light for row in lights for light in row]


# ---------------------------------------------------------------------------------------------- scores


def psnr(error: np.ndarray) -> float:
    """Of errors, peak 1 [dB]."""
    return float(-10.0 * np.log10(np.mean(np.square(error, dtype=float))))


class Judge:
    """Scores albedos against the truth."""

    def __init__(self, truth: Truth, seen: np.ndarray, sunlit: np.ndarray, lights, winter, size: Size):
        self.truth, self.lights = truth, [*lights, *winter]
        self.mask = (seen >= 1.0).ravel()
        self.never = self.mask & ~sunlit.any(axis=0)
        self.edges = shadow_edges(sunlit, truth.shape, self.mask)
        self.spp = size.spp // 2
        self.terrain_pixels = terrain_pixels(truth)
        self.ev: list[list[float]] | None = None
        self.reference = self._developed(truth.albedo, 1001)
        self.ceiling_db = self.relit_db(truth.albedo)

    def _developed(self, albedo: np.ndarray, seed: int) -> list[np.ndarray]:
        pictures = path_traced(self.truth, albedo, self.lights, spp=self.spp, seed=seed)
        if self.ev is None:
            self.ev = [[exposure_ev100(image) for image in row] for row in pictures]
        return [
            srgb_from_linear(develop(image, ev))
            for row, evs in zip(pictures, self.ev, strict=True)
            for image, ev in zip(row, evs, strict=True)
        ]

    def relit_db(self, albedo: np.ndarray) -> float:
        """PSNR of relit pictures over all their terrain."""
        mine = self._developed(albedo, 2002)
        masks = self.terrain_pixels * len(self.lights)
        return psnr(np.concatenate([(a - b)[m] for a, b, m in zip(mine, self.reference, masks, strict=True)]))

    def scores(self, albedo: np.ndarray, *, relit: bool = True) -> dict[str, float]:
        """All numbers of one albedo ``(R, S, 3)``."""
        true, guess = self.truth.albedo.reshape(-1, 3), np.nan_to_num(albedo.reshape(-1, 3), nan=0.2)
        error = guess - true

        def relative(mask):
            return float(np.abs(error[mask]).sum() / true[mask].sum()) if mask.any() else float("nan")

        result = {
            "psnr_db": psnr(error[self.mask]),
            "rel_error": relative(self.mask),
            "rel_error_shaded": relative(self.never),
            "median_rel_error": float(np.median(np.abs(error[self.mask]) / true[self.mask])),
            "ghost": ghost(guess, true, self.edges),
        }
        if relit:
            result["relit_psnr_db"] = self.relit_db(guess.reshape(albedo.shape).astype(np.float32))
        return result


def terrain_pixels(truth: Truth) -> list[np.ndarray]:
    """Which pixels ``(H, W)`` of each camera show terrain."""
    from seasonscapes.rendering.gbuffer import trace_gbuffer
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh

    bare = ray_scene(mi_mesh(truth.terrain, np.full(3, 0.3)))
    scene = RenderScene(bare.mi_scene, bare.mi_terrain)
    return [np.isfinite(trace_gbuffer(scene, camera).depth) for camera in truth.cameras]


def shadow_edges(sunlit: np.ndarray, shape, mask: np.ndarray) -> np.ndarray:
    """Pairs ``(E, 2)`` of neighbouring observed texels, the first in sunlight and the second in shade at some time."""
    grid = np.arange(shape[0] * shape[1]).reshape(shape)
    pairs = np.concatenate(
        [np.stack([grid[:, :-1].ravel(), grid[:, 1:].ravel()], 1), np.stack([grid[:-1].ravel(), grid[1:].ravel()], 1)]
    )
    pairs = pairs[mask[pairs].all(axis=1)]
    found = []
    for lit in sunlit:
        for first, second in ((0, 1), (1, 0)):
            found.append(pairs[lit[pairs[:, first]] & ~lit[pairs[:, second]]][:, [first, second]])
    return np.concatenate(found)


def ghost(guess: np.ndarray, true: np.ndarray, edges: np.ndarray) -> float:
    """Mean step of recovered over true albedo from shade to sun across shadow edges: 0 where no shadow is left."""
    ratio = np.clip(guess, 1e-3, None).mean(axis=1) / true.mean(axis=1)
    step = (ratio[edges[:, 0]] - ratio[edges[:, 1]]) / (0.5 * (ratio[edges[:, 0]] + ratio[edges[:, 1]]))
    return float(abs(np.mean(step)))


# ---------------------------------------------------------------------------------------------- rivals


def rivals(truth: Truth, land, photographs, gains: np.ndarray, times, lights) -> dict[str, np.ndarray]:
    """Albedo ``(R, S, 3)`` by each correction: best single time and median of all times, by name."""
    painted = resampled_radiance(photographs, gains)
    normal = np.tile([0.0, 0.0, 1.0], (truth.shape[0] * truth.shape[1], 1))
    normal[land.texel] = land.normal
    methods = {"as_it_is": lambda radiance, slopes: radiance, **CORRECTIONS}
    result = {}
    for name, correct in methods.items():
        single = []
        for t, moment in enumerate(times):
            light = lights[t][0]
            ground = np.asarray(global_horizontal_illuminance(light))
            radiance = painted[moment]
            corrected = correct(radiance, slopes_under(normal, light.sun.direction)) * np.pi / ground
            # Where a correction is blind (the sun behind the slope) the plain texture stands in.
            corrected = np.where(np.isfinite(corrected), corrected, radiance * np.pi / ground)
            single.append(np.clip(corrected, 0.0, 1.0))
        stack = np.stack(single)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # texels that no picture shows
            median = np.nanmedian(stack, axis=0)
        result[f"{name}_median"] = median.reshape(*truth.shape, 3)
        mask = np.isfinite(median).all(axis=1)
        filled = np.where(np.isfinite(stack), stack, median)
        best = min(
            range(len(times)), key=lambda t: np.nanmean((filled[t][mask] - truth.albedo.reshape(-1, 3)[mask]) ** 2)
        )
        result[f"{name}_best_time"] = filled[best].reshape(*truth.shape, 3)
    return result


# ---------------------------------------------------------------------------------------------- the run


def size_of(args) -> Size:
    """What ``--quick`` chooses."""
    return QUICK if args.quick else FULL


def run(args) -> dict[str, float]:
    """All cases; a flat dictionary of numbers."""
    size = size_of(args)
    workspace = default_workspace() if args.workspace is None else Workspace(args.workspace)
    numbers: dict[str, float] = {"seed": float(args.seed)}
    clock = Clock()
    truth = make_truth(
        args.seed,
        size_m=size.size_m,
        spacing_m=size.spacing_m,
        texel_m=size.texel_m,
        cameras=size.cameras,
        size_px=size.size_px,
    )
    model = read_sky_model("clear")
    times = hours(FIT_DATE, *size.clock)
    lights = lights_for(times, truth.cameras, model, workspace)
    held = lights_for(hours(FIT_DATE, 10.1, 14.4), truth.cameras, model, workspace)
    winter = lights_for(hours(WINTER_DATE, 10.0, 13.0), truth.cameras, model, workspace)
    pictures = path_traced(truth, truth.albedo, lights, spp=size.spp, seed=args.seed)
    clock.tell("truth rendered")
    land = trace_texel_transport(truth.terrain, truth.shape)
    numbers["seconds_land"] = clock.tell("daylight coefficients of texels")
    seen, gains = observations(truth, times, pictures, None, args.seed)
    photographs = prepare_photographs(land, seen, flat(lights), gains=gains)
    numbers["seconds_footprints"] = clock.tell("footprints")
    clean = solve_albedo(land, photographs, noise_model=LINEAR)
    numbers["seconds_closed_form"] = clock.tell("closed form")
    sunlit = np.stack(
        [sun_on_texels(land, row[0]).sum(axis=1) > 0.02 * row[0].sun.normal_illuminance_lx.sum() for row in lights]
    )
    judge = Judge(truth, clean.pixel_count, sunlit, held, winter, size)
    numbers.update(
        texels=float(judge.mask.sum()), texels_never_sunlit=float(judge.never.sum()), relit_ceiling_db=judge.ceiling_db
    )
    table: list[tuple[str, dict[str, float]]] = []
    score(table, numbers, "clean", judge.scores(clean.albedo), judge)
    clock.tell("judged")
    best = best_rival(table, judge, rivals(truth, land, photographs, np.stack(gains), times, lights))
    margins = [numbers["clean_psnr_db"] - best]
    show_pictures(args.pictures, truth, clean, judge)
    webcam_seen, true_gains = observations(truth, times, pictures, WebcamFaults(tone_strength=0.0), args.seed + 1)
    webcam_shots = [
        replace(photograph, observation=one, gain=None)
        for photograph, one in zip(photographs, webcam_seen, strict=True)
    ]
    webcam = solve_albedo(land, webcam_shots, noise_model=EIGHT_BIT)
    score(table, numbers, "webcam", judge.scores(webcam.albedo), judge)
    numbers["webcam_gain_error"] = float(np.median(np.abs(webcam.gains / np.array(true_gains) - 1.0)))
    best = best_rival(table, judge, rivals(truth, land, webcam_shots, webcam.gains, times, lights), prefix="webcam ")
    margins.append(numbers["webcam_psnr_db"] - best)
    numbers["margin_over_best_correction_db"] = min(margins)
    clock.tell("webcam")
    cases(args, truth, land, times, pictures, model, workspace, lights, numbers, clock)
    controls(truth, land, photographs, times, model, workspace, judge, table, numbers, clock)
    print_table(table, judge)
    return numbers


def cases(args, truth, land, times, pictures, model, workspace, lights, numbers, clock) -> None:
    """Where the closed form's assumptions are wrong: both methods on the same pictures; see `albedo_cases`."""
    gains = []
    haze = assumed_haze(times, truth.cameras, model, workspace)
    for name in CASES:
        case = case_scene(name, truth, land, times, pictures, model, workspace, size_of(args), args.seed)
        told, air = flat(lights), haze
        if case.truth is not truth:
            told = flat(lights_for(times, case.truth.cameras, model, workspace))
            air = assumed_haze(times, case.truth.cameras, model, workspace)
        found = solve_case(case, told, air)
        gains.append(found.gain_db)
        numbers[f"case_{name}_closed_psnr_db"], numbers[f"case_{name}_joint_psnr_db"] = found.closed_db, found.joint_db
        numbers[f"case_{name}_gain_db"] = found.gain_db
        numbers[f"case_{name}_held_out_start"] = found.joint.held_out_start
        numbers[f"case_{name}_held_out_end"] = found.joint.held_out_end
        print(
            f"case {name:8s} closed {found.closed_db:6.2f} dB  joint {found.joint_db:6.2f} dB  {found.gain_db:+.2f} dB  "
            f"held-out loss {found.joint.held_out_start:.3f} → {found.joint.held_out_end:.3f}"
        )
        if not args.quick and name in ("haze", "curve"):
            numbers[f"case_{name}_searched_psnr_db"] = searched_db(name, case, told, times, model, workspace)
        clock.tell(f"case {name}")
    numbers["differentiable_gain_db"], numbers["differentiable_worst_db"] = float(np.mean(gains)), min(gains)
    numbers["differentiable_held_out_ratio"] = max(
        numbers[f"case_{name}_held_out_end"] / numbers[f"case_{name}_held_out_start"] for name in CASES
    )


def searched_db(name: str, case, told, times, model, workspace) -> float:
    """The closed form after its own search over one unknown, which is told which one is wrong."""

    def lights_of(visibility_km: float):
        return flat(
            lights_for(times, case.truth.cameras, with_overrides(model, visibility_km=visibility_km), workspace)
        )

    photographs = prepare_photographs(case.land, case.observations, told)
    if name == "curve":
        found = fit_tone_curve(case.land, photographs, search=SearchOptions(fraction=0.1))
        photographs = with_tone_curve(photographs, found.strength)
    else:
        found = fit_visibility(case.land, photographs, lights_of, noise_model=EIGHT_BIT)
        lights = lights_of(found.visibility_km)
        photographs = [replace(each, light=light) for each, light in zip(photographs, lights, strict=True)]
    fit = solve_albedo(case.land, photographs, noise_model=EIGHT_BIT)
    seen = fit.pixel_count >= 1.0
    return psnr((fit.albedo - case.truth.albedo)[seen])


def controls(truth, land, photographs, times, model, workspace, judge, table, numbers, clock) -> None:
    """What must fail: clocks an hour wrong, a world mirrored east–west, half the terrain's resolution."""
    from datetime import timedelta

    wrong = lights_for([t + timedelta(hours=1) for t in times], truth.cameras, model, workspace)
    observed = [photograph.observation for photograph in photographs]
    gains = [photograph.gain for photograph in photographs]
    late = solve_albedo(land, prepare_photographs(land, observed, flat(wrong), gains=gains))
    score(table, numbers, "control_hour_wrong", judge.scores(late.albedo), judge)
    mirrored = [mirror(photograph.light) for photograph in photographs]
    east_west = solve_albedo(land, prepare_photographs(land, observed, mirrored, gains=gains))
    score(table, numbers, "control_mirrored", judge.scores(east_west.albedo), judge)
    clock.tell("controls")


def mirror(light):
    """The same light with east and west exchanged."""
    flip = np.array([-1.0, 1.0, 1.0])
    sun = None if light.sun is None else replace(light.sun, direction=light.sun.direction * flip)
    return replace(light, sun=sun, sky_radiance=np.ascontiguousarray(light.sky_radiance[:, ::-1]))


def score(table, numbers, name: str, values: dict[str, float], judge: Judge) -> None:
    """Add a row to the table and its numbers to the record."""
    table.append((name, values))
    numbers.update({f"{name}_{key}": value for key, value in values.items()})
    if "relit_psnr_db" in values and name == "clean":
        numbers["relit_gap_to_ceiling_db"] = judge.ceiling_db - values["relit_psnr_db"]


def best_rival(table, judge: Judge, albedos: dict[str, np.ndarray], prefix: str = "") -> float:
    """Albedo PSNR of the best correction; all of them go into the table."""
    scored = {name: judge.scores(albedo, relit=False) for name, albedo in albedos.items()}
    best = max(scored, key=lambda name: scored[name]["psnr_db"])
    scored[best]["relit_psnr_db"] = judge.relit_db(np.nan_to_num(albedos[best], nan=0.2).astype(np.float32))
    table.extend((prefix + name, values) for name, values in scored.items())
    return scored[best]["psnr_db"]


class Clock:
    """Processor and wall seconds between stages."""

    def __init__(self):
        self.cpu, self.wall = time.process_time(), time.perf_counter()

    def tell(self, what: str) -> float:
        """Print and return the processor seconds since the last call."""
        cpu, wall = time.process_time(), time.perf_counter()
        used = cpu - self.cpu
        print(f"  {what}: {used:.1f} CPU-s, {wall - self.wall:.1f} s", file=sys.stderr, flush=True)
        self.cpu, self.wall = cpu, wall
        return used


def print_table(table, judge: Judge) -> None:
    """Rows of scores."""
    print(
        f"{judge.mask.sum()} texels observed, {judge.never.sum()} of them never sunlit; "
        f"relit ceiling (true albedo): {judge.ceiling_db:.2f} dB"
    )
    print(f"{'':28s}{'PSNR':>8s}{'rel.':>8s}{'shaded':>8s}{'median':>8s}{'ghost':>8s}{'relit':>8s}")
    for name, v in table:
        relit = f"{v['relit_psnr_db']:8.2f}" if "relit_psnr_db" in v else f"{'':8s}"
        print(
            f"{name:28s}{v['psnr_db']:8.2f}{v['rel_error']:8.3f}{v['rel_error_shaded']:8.3f}{v['median_rel_error']:8.3f}"
            f"{v['ghost']:8.3f}{relit}"
        )


def show_pictures(folder: Path | None, truth: Truth, fit: AlbedoFit, judge: Judge) -> None:
    """Truth, recovery and error as PNG."""
    if folder is None:
        return
    from seasonscapes.images import write_png

    error = np.abs(fit.albedo - truth.albedo) * 5.0
    write_png(folder / "albedo_truth_fit_error5.png", np.concatenate([truth.albedo, fit.albedo, error], axis=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--pictures", type=Path, default=None)
    parser.add_argument("--workspace", type=Path, default=None)
    args = parser.parse_args()
    if args.seed is None:
        args.seed = secrets.randbelow(100_000)
    print(f"seed {args.seed}", file=sys.stderr)
    numbers = run(args)
    write_record(args.json, numbers, seed=args.seed)


if __name__ == "__main__":
    main()
