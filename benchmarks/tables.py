"""Tables of documents from the records of the benchmarks: ``make tables``, or ``python benchmarks/tables.py [--check]``.

A document holds a table between ``<!-- table: NAME -->`` and ``<!-- end -->``. What stands there is made of
``benchmarks/results/*.json`` (and the table of sky models of their files) and is overwritten; ``--check`` writes nothing
and fails where a document differs. A figure without a record is not printed: a line below its table says so. Times that were measured
beside other work are marked as such.
"""

from __future__ import annotations

import argparse
import operator
import re
import string
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from record import read_record

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
DOCUMENTS = ("README.md", "docs/measured.md", "sun_models/README.md")
_COMPARISONS = {"<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt, "==": operator.eq}
# Figures that a busy machine makes larger, by the ends of their names; processor time is among them, since processors
# share caches and memory. Ratios of contestants that took turns are not.
_TIME = re.compile(r"(^|_)(s|ms|us|seconds|minutes|core_hours|days)(_per_\w+|_3000km2|_on_\d+_workers)?$")
# A benchmark with a thread for each core has a load of about their number by itself.
_OWN_LOAD_SPARE = 0.5
_REGION = re.compile(r"(<!-- table: ([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Parameters
    ----------
    label
        What was measured.
    value
        Format with the names of figures, such as ``{heading_median_deg:.3f}°``.
    aim
        What was aimed at, as a text; empty without an aim.
    bounds
        The aim as conditions on figures, such as ``seconds <= 60, peak_gb <= 4``; a row that misses one is marked.
    record
        Record of the row's figures, where it is not the table's.
    """

    label: str
    value: str
    aim: str = ""
    bounds: str = ""
    record: str = ""


@dataclass(frozen=True)
class Table:
    """A table of the figures of one record, or of several.

    Parameters
    ----------
    record
        Name of the record, the file without suffix.
    rows
        Its rows.
    note
        What flatters the figures, or what they mean; printed below the table.
    """

    record: str
    rows: tuple[Row, ...]
    note: str = ""


_SAME_RENDERER = "Truth and estimate are made by the same renderer, which flatters every row."

TABLES = {
    "terrain": Table(
        "terrain-quick",
        (
            Row("60 × 50 km at 30 m → adaptive mesh with a bound of 5 m: time", "{seconds_3000km2:.1f} s", "≤ 60 s", "seconds_3000km2 <= 60"),
            Row("… memory", "{peak_gb:.2f} GB", "≤ 4 GB", "peak_gb <= 4"),
            Row("… samples; triangles", "{samples_3000km2:,}; {triangles_3000km2:,}"),
            Row("… vertical error: RMSE; largest", "{vertical_rmse_m:.2f} m; {vertical_max_m:.2f} m", "≤ 5 m", "vertical_max_m <= 5"),
            Row("triangles saved against the full grid", "{triangles_saved_ratio:.0%}"),
            Row("the full grid: time; memory", "{grid_seconds_3000km2:.1f} s; {grid_peak_gb:.2f} GB"),
        ),
    ),
    "surface": Table(
        "surface-quick",
        (
            Row("direct sunlight on a level plain before a wall of 300 m, largest error", "{plain_error_max:.2%}", "≤ 1 %", "plain_error_max <= 0.01"),
            Row("triangles that the adaptive mesh saves against the full grid", "{triangles_saved_ratio:.0%}", "≥ 60 %", "triangles_saved_ratio >= 0.6"),
            Row("direct irradiance of cells against the full grid: RMSE over DNI", "{irradiance_rmse_of_dni:.1%}", "≤ 2 %", "irradiance_rmse_of_dni <= 0.02"),
            Row("… cells within 5 % of DNI", "{irradiance_within_5_percent:.1%}", "≥ 99 %", "irradiance_within_5_percent >= 0.99"),
            Row("black terrain pixels over all cameras at four hours, morning to moonlight", "{black_pixels:.0f}", "0", "black_pixels == 0"),
            Row("processor time of a still, after the first of a view", "{still_processor_s:.1f} s", "≤ 20 s", "still_processor_s <= 20"),
        ),
        "The truth of the views is the bilinear surface through the samples.",
    ),
    "viewer": Table(
        "viewer-quick",
        (
            Row("page against path tracing, 3 cameras × 6 hours of the sun from −4° to noon: PSNR on terrain, mean; worst", "{mean_psnr_db:.1f} dB; {worst_psnr_db:.1f} dB", "≥ 34 dB; ≥ 30 dB", "mean_psnr_db >= 34, worst_psnr_db >= 30"),
            Row("… loss without cast shadows; without reflected light; without air; with the clock an hour off", "{no_shadows_loss_db:.1f}; {no_bounce_loss_db:.1f}; {no_air_loss_db:.1f}; {clock_one_hour_off_loss_db:.1f} dB"),
            Row("shadows: intersection over union", "{shadow_iou:.3f}", "≥ 0.96", "shadow_iou >= 0.96"),
            Row("radiance of the sky, error: median; 95 % of pixels", "{sky_error_median:.2%}; {sky_error_95:.2%}", "≤ 1 %", "sky_error_median <= 0.01"),
            Row("when the sun comes and goes behind ridges at 20 places: largest error beyond the times of the clicked cell", "{sun_times_error_min:.1f} min", "≤ 2 min", "sun_times_error_min <= 2"),
            Row("… at the very point: median; within 2 min; largest", "{sun_times_strict_median_min:.1f} min; {sun_times_strict_share_within_2_min:.0%}; {sun_times_strict_max_min:.0f} min"),
            Row("the bundled massif, all files", "{scene_mb:.1f} MB", "≤ 20 MB", "scene_mb <= 20"),
            Row("first picture of 512 × 512, software rendering: processor time; wall-clock", "{first_picture_processor_s:.1f} s; {first_picture_s:.1f} s", "≤ 3 s", "first_picture_s <= 3"),
            Row("a step of the hour with 1,024² texels of visibility: the same", "{hour_step_processor_s:.2f} s; {hour_step_s:.2f} s", "≤ 1 s", "hour_step_s <= 1"),
            Row("visibility passes while the camera turns; faults in the console", "{orbit_visibility_passes}; {console_faults}", "0; 0", "orbit_visibility_passes == 0, console_faults == 0"),
        ),
        "Page and truth share heights, albedo and the atmosphere's tables. Within a cell a grazing sun may come and go half an hour apart.",
    ),
    "render": Table(
        "render-quick",
        (
            Row("time of a bare Mitsuba script to equal noise, over ours", "{equal_noise_speedup_vs_bare_mitsuba:.1f} ×"),
            Row("time of Blender Cycles to equal noise, over ours", "{equal_noise_speedup_vs_cycles:.1f} ×"),
            Row("samples per second, over the bare script's", "{throughput_vs_bare_mitsuba:.2f} ×"),
            Row("shadow rays per second, over a bare `ray_test` of the same rays", "{shadow_rays_vs_ray_test:.2f} ×", "≥ 0.85 ×", "shadow_rays_vs_ray_test >= 0.85"),
        ),
        "One mesh, camera, texture, sun, sky and number of bounces; noise is the deviation between seeds.",
    ),
    "sky": Table(
        "sky",
        (
            Row("direct normal illuminance against SPECTRL2 × V(λ), largest error", "{direct_error_max:.1%}", "≤ 5 %", "direct_error_max <= 0.05"),
            Row("diffuse horizontal illuminance, the same", "{diffuse_error_max:.1%}", "≤ 15 %", "diffuse_error_max <= 0.15"),
            Row("ratio of 3,500 m to 500 m, direct beam", "{altitude_direct_error_max:.1%}", "≤ 5 %", "altitude_direct_error_max <= 0.05"),
            Row("sky radiance against a brute-force spectral path tracer, largest error", "{oracle_error_max:.1%}", "≤ 5 %", "oracle_error_max <= 0.05"),
            Row("… whose own noise is", "{oracle_noise_max:.1%}"),
            Row("energy balance of a conservative atmosphere", "{energy_error_max:.1%}"),
            Row("aerial perspective against direct integration, largest error", "{aerial_error_max:.1%}", "≤ 2 %", "aerial_error_max <= 0.02"),
            Row("horizontal ray to infinity against the horizon's sky", "{aerial_horizon_gap_max:.1%}", "≤ 2 %", "aerial_horizon_gap_max <= 0.02"),
            Row("Koschmieder's law in homogeneous air", "{koschmieder_error_max:.1e}"),
            Row("a new instant: sky map and aerial-perspective table", "{seconds_per_illumination:.2f} s", "≤ 0.5 s", "seconds_per_illumination <= 0.5"),
            Row("jump beyond the trend between neighbouring 0.1° of sun elevation", "{step_max:.1%}", "≤ 5 %", "step_max <= 0.05"),
        ),
        "Light through sunset falls by more than 5 % per 0.1° in any true sky: what is bounded is that nothing jumps out of that course.",
    ),
    "light-series": Table(
        "light_series-quick",
        (
            Row("direct sunlight of two measured clear days, minute by minute, RMS over mean, worse day", "{direct_rms:.1%}", "≤ 3 %", "direct_rms <= 0.03"),
            Row("… diffuse light", "{diffuse_rms:.1%}", "≤ 12 %", "diffuse_rms <= 0.12"),
            Row("… global light", "{global_rms:.1%}", "≤ 3 %", "global_rms <= 0.03"),
            Row("water above Alamosa: fitted; from humidity at the ground, under a winter inversion", "{surfrad_water_cm:.2f} cm; {surfrad_humidity_water_cm:.2f} cm"),
            Row("diffuse light, Alamosa; Tucson: ours", "{surfrad_ours_diffuse_rms:.0%}; {midc_ours_diffuse_rms:.0%}"),
            Row("… ours, water from humidity at the ground", "{surfrad_humidity_diffuse_rms:.0%}; {midc_humidity_diffuse_rms:.0%}"),
            Row("… Ineichen & Perez", "{surfrad_ineichen_diffuse_rms:.0%}; {midc_ineichen_diffuse_rms:.0%}"),
            Row("… Bird & Hulstrom", "{surfrad_bird_diffuse_rms:.0%}; {midc_bird_diffuse_rms:.0%}"),
        ),
        "Real measurements (SURFRAD, MIDC). The air of a day (optical depth of aerosol and water; one turbidity for Ineichen & Perez) is fitted to direct light at every tenth minute; all other minutes are judged, and diffuse and global light are not fitted. The water takes up what calibration the pyrheliometer lacks.",
    ),
    "realbench": Table(
        "realbench-quick",
        (
            Row("each of 20 pictures left out, half of its ground seen, the other half predicted: PSNR", "{mean_psnr_db:.1f} dB", "≥ 25 dB", "mean_psnr_db >= 25"),
            Row("… SSIM", "{mean_ssim:.2f}", "≥ 0.75", "mean_ssim >= 0.75"),
            Row("… over the best rival that sees the same half", "{margin_over_best_rival_db:+.1f} dB", "≥ +2 dB", "margin_over_best_rival_db >= 2"),
            Row("… better than every such rival", "{share_better:.0%} of the pictures", "≥ 75 %", "share_better >= 0.75"),
            Row("… over a blend of the other pictures whose weights vary over the ground", "{margin_over_layered_blend_db:+.1f} dB"),
            Row("of the picture left out only the hour, the weather and the colour of its sky are known: ours", "{psnr_db_ours_known:.1f} dB"),
            Row("… over the best of nearest picture, mean, and blend by the same knowledge", "{known_margin_over_best_rival_db:+.1f} dB", "≥ +2 dB", "known_margin_over_best_rival_db >= 2"),
            Row("… better than each of them", "{known_share_better:.0%} of the pictures", "≥ 75 %", "known_share_better >= 0.75"),
            Row("only its hour is known: ours, as `hours` predicts it", "{psnr_db_ours_blind:.1f} dB"),
            Row("… over the better of the nearest picture and the mean; better than both", "{time_margin_over_best_rival_db:+.1f} dB; {time_share_better:.0%} of the pictures"),
            Row("light, haze, exposure and response alone from the seen half", "{psnr_db_ours_conditions:.1f} dB"),
            Row("… one grey albedo under our light, the same", "{psnr_db_grey:.1f} dB"),
            Row("best blend of the other pictures from the seen half; from all of it", "{psnr_db_half_blend:.1f}; {psnr_db_oracle_blend:.1f} dB"),
            Row("four numbers of appearance from the seen half", "{psnr_db_half_embedding:.1f} dB"),
            Row("nearest picture by the sun; mean of the pictures; blend", "{psnr_db_nearest:.1f}; {psnr_db_mean:.1f}; {psnr_db_blend:.1f} dB"),
            Row("sunlit and shaded ground against polygons drawn by hand in {shadow_pictures:.0f} pictures, heights of 93 m: smaller IoU", "{shadow_iou:.2f}", "≥ 0.75", "shadow_iou >= 0.75"),
            Row("sun visible or hidden, found and seen by eye", "{sun_visible_accuracy:.0%} agree", "≥ 95 %", "sun_visible_accuracy >= 0.95"),
            Row("camera KR1 at Kronebreen, four overcast hours, half of the ground seen: ours; four numbers of appearance; blend of varying weights", "{cameras[1][mean_psnr_db]:.1f}; {cameras[1][psnr_db_half_embedding]:.1f}; {cameras[1][psnr_db_half_layers]:.1f} dB"),
        ),
        "Real pictures of the webcam of Chamonix, May to September 2013, dawn to dusk, 352 px wide; scores with one exposure for each colour. The layers of the completion and its ridge were chosen on seven of the twenty pictures, the widths of sun and day by which `hours` weighs pictures on all of them.",
    ),
    "realbench-losses": Table(
        "realbench_losses-quick",
        (
            Row("the program, over {cases:.0f} of the pictures", "{program_db:.1f} dB"),
            Row("pose that the data folder states, in place of the fitted one", "{pose_of_data_folder_db:.1f} dB"),
            Row("slopes of the heights, in place of those learnt for each pixel", "{slopes_of_heights_db:.1f} dB"),
            Row("the whole picture seen, in place of half of it", "{whole_picture_seen_db:.1f} dB"),
            Row("light, haze, exposure and response alone", "{conditions_alone_db:.1f} dB"),
            Row("… found on the whole picture", "{conditions_of_whole_picture_db:.1f} dB"),
            Row("… with the direct light and clouds that are usual in the other pictures", "{weather_of_others_db:.1f} dB"),
            Row("… with their usual haze", "{haze_of_others_db:.1f} dB"),
            Row("… with their usual contrast and flare", "{response_of_others_db:.1f} dB"),
        ),
        "One stage after another is exchanged. Better heights than those of 93 m are not at hand.",
    ),
    "night": Table(
        "sky_night",
        (
            Row("sun from +20° to −18° and moon, factor from the nearer of two published fits, largest", "{twilight_factor_max:.2f}", "≤ 1.5", "twilight_factor_max <= 1.5"),
            Row("… factor outside the range between the two fits, largest", "{twilight_factor_outside_max:.2f}", "≤ 1.5", "twilight_factor_outside_max <= 1.5"),
            Row("full and half moon from 10° to 60°, factor from the nearer fit, largest", "{moon_factor_max:.2f}", "≤ 1.5", "moon_factor_max <= 1.5"),
        ),
        "The fits are those of the U.S. Naval Observatory {cite:p}`seidelmann1992,janiczek1987`; at −14° and −15° they are a factor of 3 apart.",
    ),
    "relight": Table(
        "relight",
        (
            Row("error of a frame, RMS over mean: lit pixels", "{rel_rmse_lit:.1%}", "≤ 2 %", "rel_rmse_lit <= 0.02"),
            Row("… shadowed pixels", "{rel_rmse_shadow:.1%}", "≤ 4 %", "rel_rmse_shadow <= 0.04"),
            Row("noise of the reference itself", "{reference_noise:.1%}"),
            Row("a frame", "{frame_s:.2f} s"),
            Row("precomputation", "{precompute_s:.0f} s"),
            Row("bare Mitsuba path tracing to the same error, over ours", "{speedup_vs_path:,.0f} ×", "≥ 100 ×", "speedup_vs_path >= 100"),
            Row("Blender Cycles to the same error, over ours", "{speedup_vs_cycles:,.0f} ×", "≥ 100 ×", "speedup_vs_cycles >= 100"),
            Row("this package's own path tracer to the same error, over ours", "{speedup_vs_own_path:,.0f} ×"),
            Row("all {year_frames:,} hours of a year with the sun above −12°, extrapolated from measured frames", "{year_minutes:.0f} min", "≤ 30 min", "year_minutes <= 30"),
            Row("shadow rays over bare `ray_test` of the same rays", "{sun_ray_throughput_vs_bare:.0%}", "≥ 70 %", "sun_ray_throughput_vs_bare >= 0.7"),
            Row("sun visibility against a march over the raster, away from shadow edges", "{visibility_agreement:.2%}", "≥ 99.5 %", "visibility_agreement >= 0.995"),
            Row("memory of a view of 1536 × 1024: scene, precomputation and a frame", "{memory_peak_gb:.2f} GB", "< 4 GB", "memory_peak_gb <= 4"),
        ),
        "The reference is path tracing of the same light and bounces: what the light model lacks is in neither.",
    ),
    "texturing": Table(
        "texturing-quick",
        (
            Row("painted view in its own camera, mean; worst", "{reprojection_db:.1f}; {reprojection_worst_db:.1f} dB", "> 35 dB", "reprojection_worst_db > 35"),
            Row("two ridges: hidden texels that were painted", "{two_ridge_leaks:.0f} of {two_ridge_hidden:,.0f}", "0", "two_ridge_leaks == 0"),
            Row("harmonised over raw pictures under one gain, painted texels", "+{harmonising_gain_db:.1f} dB", "≥ +1.2 dB", "harmonising_gain_db >= 1.2"),
            Row("houses and masts: recall", "{foreground_recall:.2f}", "≥ 0.85", "foreground_recall >= 0.85"),
            Row("… false rejects", "{foreground_false_rejects:.1%}", "≤ 5 %", "foreground_false_rejects <= 0.05"),
            Row("hidden texels over Telea's inpainting", "+{hidden_gain_over_telea_db:.1f} dB", "≥ +6 dB", "hidden_gain_over_telea_db >= 6"),
            Row("… SSIM over Telea's", "{hidden_ssim_over_telea:.1f} ×", "≥ 1.7 ×", "hidden_ssim_over_telea >= 1.7"),
            Row("the real Landsat pair July → November, over Telea", "+{landsat_gain_over_telea_db:.1f} dB", "≥ +2 dB", "landsat_gain_over_telea_db >= 2"),
            Row("a held-out camera's unseen pixels over Telea", "+{held_out_view_gain_over_telea_db:.1f} dB", "≥ +2.5 dB", "held_out_view_gain_over_telea_db >= 2.5"),
            Row("processor seconds per hidden Mtexel: full; fast", "{cost_cpu_s_per_mtexel:.1f}; {cost_fast_cpu_s_per_mtexel:.1f}", "≤ 15; ≤ 5", "cost_cpu_s_per_mtexel <= 15, cost_fast_cpu_s_per_mtexel <= 5"),
        ),
        _SAME_RENDERER + " The Landsat row is of real pictures.",
    ),
    "albedo": Table(
        "albedo-quick",
        (
            Row("clean linear pictures: albedo", "{clean_psnr_db:.1f} dB", "≥ 27 dB", "clean_psnr_db >= 27"),
            Row("… relative error", "{clean_rel_error:.1%}", "≤ 4 %", "clean_rel_error <= 0.04"),
            Row("… of texels that the sun never reached", "{clean_rel_error_shaded:.1%}", "≤ 4 %", "clean_rel_error_shaded <= 0.04"),
            Row("… relit at held-out hours", "{clean_relit_psnr_db:.1f} dB"),
            Row("8-bit JPEG, unknown exposure and white balance: albedo", "{webcam_psnr_db:.1f} dB", "≥ 24 dB", "webcam_psnr_db >= 24"),
            Row("… relit at held-out hours", "{webcam_relit_psnr_db:.1f} dB", "≥ 27 dB", "webcam_relit_psnr_db >= 27"),
            Row("… and unknown haze: closed form; joint recovery", "{case_haze_closed_psnr_db:.1f} dB; {case_haze_joint_psnr_db:.1f} dB", "≥ 21 dB", "case_haze_joint_psnr_db >= 21"),
            Row("… and an unknown S-curve of each camera", "{case_curve_closed_psnr_db:.1f} dB; {case_curve_joint_psnr_db:.1f} dB"),
            Row("… and cameras turned by 0.1 to 0.3°", "{case_pose_closed_psnr_db:.1f} dB; {case_pose_joint_psnr_db:.1f} dB"),
            Row("… steep slopes of saturated colours in snow", "{case_bounce_closed_psnr_db:.1f} dB; {case_bounce_joint_psnr_db:.1f} dB"),
            Row("… and half of the hours half cloudy", "{case_clouds_closed_psnr_db:.1f} dB; {case_clouds_joint_psnr_db:.1f} dB"),
            Row("joint recovery over closed form: mean of these five; least", "{differentiable_gain_db:+.1f} dB; {differentiable_worst_db:+.1f} dB", "≥ +2 dB; ≥ −0.1 dB", "differentiable_gain_db >= 2, differentiable_worst_db >= -0.1"),
            Row("… loss of held-out photographs, after over before, largest", "{differentiable_held_out_ratio:.2f}", "< 1", "differentiable_held_out_ratio < 1"),
            Row("heights averaged to 120 m, hours never photographed, by the recovery's own model (not rendered): with normals below the heights; without", "{held_out_psnr_db:.1f} dB; {without_normals_psnr_db:.1f} dB", record="subgrid_normals"),
            Row("over the best of cosine, Minnaert, C and SCS+C corrections", "+{margin_over_best_correction_db:.1f} dB"),
            Row("ceiling: the true albedo through the same renderer, relit", "{relit_ceiling_db:.1f} dB"),
        ),
        _SAME_RENDERER,
    ),
    "delight": Table(
        "delight-quick",
        (
            Row("light taken out of one 8-bit image: albedo", "{albedo_psnr_db:.1f} dB", "≥ 27 dB", "albedo_psnr_db >= 27"),
            Row("… relit at other hours", "{relit_psnr_db:.1f} dB", "≥ 29 dB", "relit_psnr_db >= 29"),
            Row("… over the best of cosine, Minnaert, C and SCS+C corrections", "+{margin_over_best_correction_db:.1f} dB", "≥ +6 dB", "margin_over_best_correction_db >= 6"),
            Row("… step that is left at shadow borders", "{shadow_border_step:.1%}", "≤ 5 %", "shadow_border_step <= 0.05"),
            Row("suns of images without an hour, found within 5° and 4°", "{sun_found_rate:.0%}", "≥ 90 %", "sun_found_rate >= 0.9"),
            Row("… wrong and yet trusted", "{sun_wrong_trusted:.0f}", "0", "sun_wrong_trusted <= 0"),
            Row("real Landsat images of July and November, 4 classes, 6 bands: largest correlation of albedo with the cosine of incidence", "{landsat_abs_r_max:.2f}", "≤ 0.1", "landsat_abs_r_max <= 0.1"),
            Row("… of the C correction in the same classes; of the best other correction", "{landsat_c_by_class_abs_r_max:.2f}; {landsat_minnaert_abs_r_max:.2f}"),
            Row("… of ours with classes found in three bands of each image by itself, as the command finds them", "{landsat_classes_by_three_bands_abs_r_max:.2f}"),
            Row("… without classes; without the light of surrounding land taken out", "{landsat_lambertian_abs_r_max:.2f}; {landsat_without_air_abs_r_max:.2f}"),
            Row("… scatter of the ratio of the two dates, over that of the best correction", "{landsat_dates_spread_over_best_correction:.2f}", "≤ 1", "landsat_dates_spread_over_best_correction <= 1"),
            Row("… correlation of the two dates; by the cosine correction, which leaves relief in both", "{landsat_agreement:.2f}; {landsat_cosine_agreement:.2f}"),
            Row("Ararat in winter: step across shadow borders; as it is; best correction", "{ararat_border_step:.2f}; {ararat_as_it_is_border_step:.2f}; {ararat_cosine_border_step:.2f}"),
            Row("a textured mesh, delit and relit", "{mesh_relit_psnr_db:.1f} dB", "≥ 28 dB", "mesh_relit_psnr_db >= 28"),
            Row("suns of meshes without an hour, found within 5° and 4°; wrong and yet trusted", "{mesh_sun_found_rate:.0%}; {mesh_sun_wrong_trusted:.0f}", "≥ 90 %", "mesh_sun_found_rate >= 0.9"),
        ),
        _SAME_RENDERER + " The Landsat rows are of real images, without truth, outside clouds and water; all methods get the same air and classes.",
    ),
    "gaussians": Table(
        "gaussians-quick",
        (
            Row("distilled, hours never seen: training cameras; unseen camera", "{full_psnr_db:.1f}; {full_unseen_camera_psnr_db:.1f} dB"),
            Row("its physics alone, untrained", "{physical_untrained_psnr_db:.1f}; {physical_untrained_unseen_camera_psnr_db:.1f} dB"),
            Row("what training brings on hours never seen", "{training_gain_db:+.1f} dB", "≥ +2 dB", "training_gain_db >= 2"),
            Row("a date between two dated albedos, below the worse of these", "{between_dates_gap_db:.1f} dB", "≤ 2 dB", "between_dates_gap_db <= 2"),
            Row("blend of the three nearest training suns", "{blend_psnr_db:.1f} dB"),
            Row("nearest training sun", "{nearest_sun_psnr_db:.1f} dB"),
            Row("WildGaussians' conditioning, a free code for each picture", "{code_psnr_db:.1f}; {code_unseen_camera_psnr_db:.1f} dB"),
            Row("a network fed with the sun's direction alone", "{sun_psnr_db:.1f}; {sun_unseen_camera_psnr_db:.1f} dB"),
            Row("cast shadows by horizons, as in a browser: intersection over union", "{shadow_iou:.2f}"),
            Row("bytes a Gaussian on disk", "{bytes_per_gaussian:.0f}"),
            Row("samples a pixel with which path tracing has the error of a frame", "{path_spp_of_equal_error:.1f}"),
            Row("a frame over path tracing to the same error: moving camera; still camera", "{moving_camera_speedup:.1f} ×; {speedup_vs_path_still_camera:.0f} ×", "≥ 20 ×", "moving_camera_speedup >= 20"),
        ),
        "PSNR in sRGB on terrain. " + _SAME_RENDERER + " Frames have twice the resolution of the pictures that were learned from: discs are 1.5 pixels apart, "
        "which limits them (see [Gaussians](concepts/gaussians.md)). Path tracing here takes few samples to the same error, and each of them no longer than a frame.",
    ),
    "alpinebench": Table(
        "alpinebench-quick",
        (
            Row("painted hours, views that no webcam saw", "{painted_view_psnr_db:.1f} dB, SSIM {painted_view_ssim:.3f}"),
            Row("hours that nobody photographed, the same views", "{held_out_hour_psnr_db:.1f} dB, SSIM {held_out_hour_ssim:.3f}"),
            Row("… distilled into Gaussians", "{distilled_psnr_db:.1f} dB"),
            Row("ablation: no webcams (July's image, delit, relit), held-out hours", "{ablation_held_out_no_webcams_july_s_image_delit_relit_psnr_db:.1f} dB"),
            Row("ablation: satellite only, best exposure, held-out hours", "{ablation_held_out_satellite_only_best_exposure_psnr_db:.1f} dB"),
            Row("into the albedo, {places:.0f} tiny places, gain in hours that nobody photographed (least to greatest): paintings", "{with_painted_gain_db:+.2f} dB ({least_with_painted_gain_db:+.2f} to {greatest_with_painted_gain_db:+.2f})", record="alpinebench-contributions"),
            Row("… completed paintings, where no webcam looked", "{with_inpainted_gain_db:+.2f} dB ({least_with_inpainted_gain_db:+.2f} to {greatest_with_inpainted_gain_db:+.2f})", record="alpinebench-contributions"),
            Row("… the joint recovery in place of the closed form", "{differentiable_gain_db:+.2f} dB ({least_differentiable_gain_db:+.2f} to {greatest_differentiable_gain_db:+.2f})", record="alpinebench-contributions"),
            Row("painted hours as the paper scores, masked pixels counted as perfect", "{painted_view_paper_mode_psnr_db:.1f} dB"),
            Row("heading of calibrated webcams, largest error", "{heading_error_deg_max:.3f}°"),
        ),
        "PSNR over valid pixels with the truth's exposure. Light, air and terrain are the model's own in truth and estimate, which flatters every row but the satellite's.",
    ),
    "calibration": Table(
        "calibration-quick",
        (
            Row("12 points, 1 px noise, 20 % wrong: heading error, median: panoramas", "{points_panorama_heading_median_deg:.3f}°", "< 0.02°", "points_panorama_heading_median_deg < 0.02"),
            Row("… within two stated σ", "{points_panorama_two_sigma_coverage:.1%}", "95 %"),
            Row("skyline alone, haze and masked foreground, start within ±10°: within 0.1°", "{skyline_success_rate:.0%}", "≥ 95 %", "skyline_success_rate >= 0.95"),
            Row("… failures that were trusted", "{skyline_failures_not_flagged:.0f}", "0", "skyline_failures_not_flagged == 0"),
            Row("thick fog: failures that were trusted", "{fog_failures_not_flagged:.0f} of {fog_trials:.0f}", "0", "fog_failures_not_flagged == 0"),
            Row("Finse photograph, one radial term: RMS", "{finse_rms_px:.2f} px", "≤ 5.5 px", "finse_rms_px <= 5.5"),
            Row("… leave-one-out", "{finse_leave_one_out_px:.2f} px", "≤ 7 px", "finse_leave_one_out_px <= 7"),
            Row("… skyline against points", "{finse_skyline_minus_points_deg:.2f}°", "≤ 0.3°", "finse_skyline_minus_points_deg <= 0.3"),
        ),
        "The Finse rows are of a real photograph; all others are of rendered pictures.",
    ),
    "detail": Table(
        "detail-quick",
        (
            Row("rasters averaged over 4 × 4 cells and amplified, {rasters} real ones: slopes nearer the withheld raster's than bicubic ones; the worst raster", "{slope_distance_gain:.2f}; {worst_slope_distance_gain:.2f}", "≥ 0.3", "slope_distance_gain >= 0.3"),
            Row("… spectrum of the roughness", "{spectrum_gain:.2f}; {worst_spectrum_gain:.2f}", "≥ 0.3", "spectrum_gain >= 0.3"),
            Row("… lengths of shadows", "{shadow_length_gain:.2f}; {worst_shadow_length_gain:.2f}", "≥ 0.3", "shadow_length_gain >= 0.3"),
            Row("60 × 50 km, camera 2 m above the ground: first picture (wall clock); memory", "{first_picture_s:.0f} s; {peak_gb:.1f} GB", "≤ 180 s; ≤ 6 GB", "first_picture_s <= 180, peak_gb <= 6"),
            Row("… size of an albedo element in the lowest rows, with invented detail; without", "{near_texel_px:.2f}; {near_texel_plain_px:.0f} px", "≤ 1 px", "near_texel_px <= 1"),
            Row("the same with data of 3.1 and 1.6 m in a square of 6 km about the camera: first picture (wall clock); memory", "{nested_first_picture_s:.0f} s; {nested_peak_gb:.1f} GB", "≤ 180 s; ≤ 6 GB", "nested_first_picture_s <= 180, nested_peak_gb <= 6"),
            Row("… size of an albedo element in the lowest rows, with invented detail; without", "{nested_near_texel_px:.2f}; {nested_near_texel_plain_px:.0f} px", "≤ 1 px", "nested_near_texel_px <= 1"),
            Row("… spacing of the surface below the camera, without invented detail; largest step across the border of the data, 1.5 m above the others", "{nested_node_m:.2f} m; {nested_border_step_m:.3f} m"),
            Row("pictures beside {photographs} sunny photographs of a webcam: falloff of detail towards the pixel, distance from the photographs' without and with invented detail", "{photograph_distance_plain_octaves:.2f}; {photograph_distance_amplified_octaves:.2f} octaves"),
            Row("… nearer by; nearer in", "{photograph_gain:.2f}; {photograph_share_nearer:.0%} of the pictures"),
            Row("albedo of snow against published values, largest error", "{snow_albedo_error:.3f}", "≤ 0.03", "snow_albedo_error <= 0.03"),
            Row("water's reflectance against Fresnel's equations, largest error", "{fresnel_error:.1e}", "≤ 0.005", "fresnel_error <= 0.005"),
        ),
        "A gain of 1 is as the truth, 0 no nearer than bicubic interpolation. The amplitude was fitted on three of these rasters. Near elements are invented and no finer data.",
    ),
    "everyday": Table(
        "everyday-quick",
        (
            Row("`sky`, one instant: first on a machine; then", "{sky_cold_s:.1f}; {sky_warm_s:.1f} s", "then ≤ 1 s", "sky_warm_s <= 1"),
            Row("… atmosphere tables of its first call, of a bundled model; of a haze of one's own", "{tables_cold_s:z.1f}; {own_tables_cold_s:.1f} s", "≤ 5 s", "tables_cold_s <= 5, own_tables_cold_s <= 5"),
            Row("`render alpine`, 768 × 512: first; another hour", "{render_cold_s:.1f}; {render_warm_s:.1f} s", "≤ 25; ≤ 8 s", "render_cold_s <= 25, render_warm_s <= 8"),
            Row("`timelapse`: ready to film", "{film_ready_s:.0f} s", "≤ 60 s", "film_ready_s <= 60"),
            Row("… a frame of it, with its files and its share of the film", "{frame_s:.2f} s", "≤ 0.25 s", "frame_s <= 0.25"),
            Row("… by the wall clock: in one process, all of whose threads work on it; of two workers", "{frame_wall_s:.2f}; {frame_two_workers_wall_s:.2f} s"),
            Row("… all {year_frames:,.0f} hours of a year with two dated albedos, files and film, on two workers (wall clock; {year_frames_measured:,.0f} of them measured)", "{year_minutes:.0f} min", "≤ 30 min", "year_minutes <= 30", record="everyday"),
            Row("`demo`: first picture; whole (wall clock)", "{demo_first_picture_s:.0f}; {demo_total_s:.0f} s", "≤ 60; ≤ 180 s", "demo_first_picture_s <= 60, demo_total_s <= 180"),
            Row("`irradiance` of 12 × 12 km at 30 m, one instant: first; another hour", "{irradiance_cold_s:.1f}; {irradiance_s:.1f} s", "another ≤ 10 s", "irradiance_s <= 10"),
        ),
        "Processor time of all threads, whole commands with their start. When these were first measured, on two quiet cores: `sky` 26 s first on a machine and 4.5 s (wall clock) then, `render` 58 and 23 s, a first film of 25 frames 332 s, an instant of `irradiance` 72 s on busy cores, `demo` 16 minutes of processor time, 5,362 hours of a year 89 minutes. A year was estimated at 87 minutes before frames cost less and two workers kept their memory, which doubled their time. Before tables were shipped, means of pixels traced their rays once, and maps kept their light transport: `sky` first 7.5 s, `render` first 48.0 s, `irradiance` first 39.4 s, another hour 16.9 s (load 1.7). A frame's own share, without developing it, of 14 hours of four days (parent and change in turn, three times each, beside other work): 347 ms of processor time in place of 382, since shadow rays start ahead of air and sky and moonlight is interpolated. Estimated and not built: heights of shadows, swept along the sun's azimuth over a grid of 24 m with upper and lower bounds of the land, would decide 16 to 46 % of first shadow rays, 33 to 57 % of those of clusters and 2 % of those at borders: some 30 ms, less than the sweep and its proof are worth. Pixels where slopes turn away from the sun and no shadow falls nearby, lit without rays: 8 % less of the sun's time for 5 % more error on lit pixels, and dropped. The machine was unsteady when the quick run was made: first renders of one and the same state took 26 to 34 s within minutes, path tracing 15 to 20 s, and those of the state before 27 to 35 s.",
    ),
    "scale": Table(
        "scale",
        (
            Row("terrain from heights, adaptive mesh, per triangle", "{terrain_us_per_triangle:.1f} µs; {terrain_bytes_per_triangle:.0f} bytes"),
            Row("albedo texture, per texel", "{albedo_us_per_texel:.2f} µs; {albedo_bytes_per_texel:.1f} bytes"),
            Row("coefficients of a view, per pixel that shows terrain", "{view_us_per_pixel:.0f} µs; {view_bytes_per_pixel:.0f} bytes"),
            Row("a frame from them, per pixel", "{frame_us_per_pixel:.2f} µs"),
            Row("coefficients of a map, per receiver", "{map_us_per_receiver:.0f} µs; {map_bytes_per_receiver:.0f} bytes"),
            Row("… one more hour of the map, per receiver", "{map_us_per_receiver_and_hour:.1f} µs"),
            Row("a worker that makes all of these: largest memory", "{peak_gb:.1f} GB"),
            Row("a worker of Dask: start; while it stands by, with its share of the scheduler", "{worker_start_processor_s:.1f} s; {idle_share_of_core_per_worker:.1%} of a core", record="scale-scheduling"),
            Row("{frames:,} tiny frames through Dask on 8 workers: processor time per frame beyond writing it in a loop", "{overhead_ms_per_frame:.1f} ms", "≤ 5 ms", "overhead_ms_per_frame <= 5", record="scale-scheduling"),
            Row("… wall clock per frame; processor time of scheduler and client; of writing a frame", "{wall_ms_per_frame:.1f}; {scheduler_ms_per_frame:.1f}; {tiny_frame_ms:.1f} ms", record="scale-scheduling"),
            Row("… lost, with {workers_killed} workers killed", "{frames_lost}", "0", "frames_lost == 0", record="scale-scheduling"),
            Row("an arc of 200,000 km² at 30 m, by these costs: terrain, albedo, coefficients, once", "{arc_once_core_hours:.0f} core hours"),
            Row("… maps of 4,400 hours of daylight", "{arc_year_core_hours:.0f} core hours; {arc_year_tb:.0f} TB"),
            Row("… on 100 workers of one core", "{arc_days_on_100_workers:.1f} days"),
        ),
        "Processor time of all threads. The arc is a calculation, not a run: 1,389 tiles of 144 km², each as the embedded massif.",
    ),
    "large": Table(
        "large-quick",
        (
            Row("`irradiance` of 12 × 12 km at 30 m, {irradiance_day_instants} instants of a day: time; memory", "{irradiance_day_s:.0f} s; {irradiance_day_peak_gb:.1f} GB", "≤ 60 s", "irradiance_day_s <= 60"),
            Row("60 × 50 km at 30 m, adaptive mesh: coefficients of a view of 768 × 512; memory, the place's making included", "{view_3000km2_s:.0f} s; {view_3000km2_peak_gb:.1f} GB", "≤ 60 s; ≤ 4 GB", "view_3000km2_s <= 60, view_3000km2_peak_gb <= 4"),
            Row("a texture of {completion_mtexel:.0f} Mtexel completed in tiles: memory", "{completion_peak_gb:.1f} GB", "≤ 8 GB for 120", "completion_peak_gb <= 8"),
            Row("… per hidden Mtexel, fast", "{completion_fast_s_per_hidden_mtexel:.1f} s", "≤ 5 s", "completion_fast_s_per_hidden_mtexel <= 5"),
            Row("… squared error over that of the best constant, fast", "{completion_fast_error_share:.1%}"),
            Row("`albedo` from two photographs of 20.7 megapixels: time; memory", "{albedo_s:.0f} s; {albedo_peak_gb:.1f} GB", "≤ 180 s; ≤ 4 GB", "albedo_s <= 180, albedo_peak_gb <= 4"),
        ),
        "Processor time of all threads. The photographs are real (Bolternosa, May and September), heights and the large texture synthetic.",
    ),
    "headline": Table(
        "",
        (
            Row("Frame of a film; path tracing by bare Mitsuba to the same error takes", "{frame_s:.2f} s; {speedup_vs_path:,.0f} × as long", record="relight"),
            Row("Path-traced picture; a bare Mitsuba script to the same noise takes", "{equal_noise_speedup_vs_bare_mitsuba:.1f} × as long", record="render-quick"),
            Row("Sky radiance against a brute-force path tracer, largest error", "{oracle_error_max:.1%}", record="sky"),
            Row("Albedo from webcam pictures; over the best topographic correction", "{webcam_psnr_db:.1f} dB; +{margin_over_best_correction_db:.1f} dB", record="albedo-quick"),
            Row("Hidden texels over Telea's inpainting; real Landsat pair", "+{hidden_gain_over_telea_db:.1f} dB; +{landsat_gain_over_telea_db:.1f} dB", record="texturing-quick"),
            Row("Hours nobody photographed; satellite image alone", "{held_out_hour_psnr_db:.1f} dB; {ablation_held_out_satellite_only_best_exposure_psnr_db:.1f} dB", record="alpinebench-quick"),
            Row("Page in a browser against path tracing: terrain; shadows", "{mean_psnr_db:.1f} dB; IoU {shadow_iou:.3f}", "≥ 34 dB; ≥ 0.96", "mean_psnr_db >= 34, shadow_iou >= 0.96", record="viewer-quick"),
            Row("Two measured clear days, air fitted by two numbers a day to direct light, RMS, the worse day: direct; diffuse light; diffuse light by Bird & Hulstrom (two numbers too), by Ineichen & Perez (one)", "{direct_rms:.1%}; {diffuse_rms:.1%}; {surfrad_bird_diffuse_rms:.0%} to {midc_bird_diffuse_rms:.0%}, {midc_ineichen_diffuse_rms:.0%} to {surfrad_ineichen_diffuse_rms:.0%}", "≤ 3 %; ≤ 12 %", "direct_rms <= 0.03, diffuse_rms <= 0.12", record="light_series-quick"),
            Row("Heading of a webcam by its skyline alone: within 0.1°; failures that were trusted", "{skyline_success_rate:.0%}; {skyline_failures_not_flagged:.0f}", "≥ 95 %; 0", "skyline_success_rate >= 0.95, skyline_failures_not_flagged == 0", record="calibration-quick"),
            Row("60 × 50 km at 30 m → adaptive mesh within 5 m; triangles saved against the full grid", "{seconds_3000km2:.0f} s, {peak_gb:.2f} GB; {triangles_saved_ratio:.0%}", "≤ 60 s, ≤ 4 GB", "seconds_3000km2 <= 60, peak_gb <= 4", record="terrain-quick"),
            Row("Twilight and moonlight against the U.S. Naval Observatory's fits, largest factor", "{twilight_factor_max:.2f}", "≤ 1.5", "twilight_factor_max <= 1.5", record="sky_night"),
        ),
    ),
}  # fmt: skip


def load_record(name: str) -> dict[str, Any] | None:
    """Return the circumstances of a record with its ``figures``, or ``None`` where it was not measured yet."""
    path = RESULTS / f"{name}.json"
    if not path.is_file():
        return None
    figures, circumstances = read_record(path)
    return {**circumstances, "figures": figures}


def record_table(name: str) -> str:
    """Return a table in Markdown, and below it what its records lack and where its numbers come from."""
    table = TABLES[name]
    records = {each: load_record(each) for each in dict.fromkeys(row.record or table.record for row in table.rows)}
    header = ["| | measured | aim |", "|---|---|---|"]
    lines, absent, used = [], [], []
    for row in table.rows:
        name_of_record = row.record or table.record
        record = records[name_of_record]
        if record is None:
            continue
        text = _row_text(row, record["figures"], busy=_busy(record))
        if text is None:
            absent.append(re.sub("{[^}]*}", "…", row.label).removeprefix("… "))
        else:
            lines.append(text)
            used.append(name_of_record)
    lines = header + lines if lines else []
    if absent:
        lines += ["", f"*Not in this record: {'; '.join(absent)}.*"]
    missing = [f"`benchmarks/results/{each}.json`" for each, record in records.items() if record is None]
    if missing:
        lines += ["", f"*Not measured by the present program: {', '.join(missing)}.*"]
    sources = [_source(record) for each, record in records.items() if record is not None and each in used]
    if sources:
        lines += ["", *([table.note, ""] if table.note else []), f"<sub>{'<br>'.join(sources)}</sub>"]
    return "\n".join(lines).strip() + "\n"


def _row_text(row: Row, figures: dict[str, Any], *, busy: bool) -> str | None:
    """A row; ``None`` where the record lacks one of its figures."""
    try:
        label, value = row.label.format(**figures), row.value.format(**figures)
    except KeyError:
        return None
    names = [name for _, name, _, _ in string.Formatter().parse(row.value) if name]
    beside = " (beside other work)" if busy and any(_TIME.search(name) for name in names) else ""
    missed = any(not _holds(bound.strip(), figures) for bound in row.bounds.split(",") if bound.strip())
    return f"| {label} | {_spaced(value)}{beside}{' **(missed)**' if missed else ''} | {row.aim or '–'} |"


def _busy(record: dict[str, Any]) -> bool:
    machine = record["machine"]
    return machine.get("load_5min", 0.0) > machine["cores"] + _OWN_LOAD_SPARE


def _holds(bound: str, figures: dict[str, Any]) -> bool:
    figure, comparison, limit = bound.split()
    return _COMPARISONS[comparison](figures[figure], float(limit))


def _source(record: dict[str, Any]) -> str:
    machine, versions = record["machine"], record["versions"]
    load = f", load {machine['load_5min']}" if "load_5min" in machine else ""
    load += " (other work ran beside: times are too long)" if _busy(record) else ""
    return (
        f"`{record['command']}`, commit {record['commit']}, {record['date'][:10]}; {machine['cores']} cores of "
        f"{machine['processor']}{load}; Python {versions['python']}, Mitsuba {versions['mitsuba']}."
    )


def _spaced(text: str) -> str:
    return re.sub(r"(\d)%", r"\1 %", text)


def sky_model_table() -> str:
    """Return the table of the bundled sky models, from their files."""
    from seasonscapes.sky.models import read_sky_model, visibility_km

    lines = ["| model | kind | what it is | visibility at sea level |", "|---|---|---|---|"]
    for path in sorted((ROOT / "sun_models").glob("*.toml")):
        model = read_sky_model(path)
        visibility = visibility_km(model)
        below = " (below the cloud)" if model.kind == "overcast" else ""  # type: ignore[attr-defined]
        shown = "unlimited" if visibility is None else f"{visibility:.0f} km{below}"
        lines.append(f"| `{path.stem}` | {model.kind} | {model.description} | {shown} |")  # type: ignore[attr-defined]
    return "\n".join(lines) + "\n"


def table_text(name: str) -> str:
    """Return what stands between the markers of a table."""
    maker: Callable[[], str] = sky_model_table if name == "sky-models" else lambda: record_table(name)
    return maker()


def filled(document: str) -> str:
    """Return a document with all its tables made anew."""
    return _REGION.sub(lambda match: match[1] + table_text(match[2]) + match[3], document)


def main() -> int:
    """Write all documents, or name those that differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; fail where a document differs")
    check = parser.parse_args().check
    differing = []
    for name in DOCUMENTS:
        path = ROOT / name
        text = path.read_text(encoding="utf-8")
        made = filled(text)
        if made != text:
            differing.append(name)
            if not check:
                path.write_text(made, encoding="utf-8")
    print("\n".join(differing) if differing else "no difference")
    return int(check and bool(differing))


if __name__ == "__main__":
    sys.exit(main())
