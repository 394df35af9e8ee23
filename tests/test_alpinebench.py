"""The whole way against the truth at the smallest size; what is asked for is a little less than what was measured.

Larger sizes are measured by the benchmark itself; their records stand in the documentation.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

BENCH = Path(__file__).parents[1] / "benchmarks" / "alpinebench.py"


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The tiny bench's numbers and its figures' folder."""
    folder = tmp_path_factory.mktemp("alpinebench")
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [
        sys.executable,
        str(BENCH),
        "--size",
        "tiny",
        "--seed",
        "21",
        "--json",
        str(folder / "numbers.json"),
        "--figures",
        str(folder),
    ]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads((folder / "numbers.json").read_text()), folder


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_whole_way(measured):
    numbers, _ = measured
    # Measured: 29.9 dB, 0.923; 33.9 dB, 0.957; 31.3 (few steps), 31.5, 35.1 and 38.4 dB.
    least = {
        "painted_view_psnr_db": 28.9,
        "painted_view_ssim": 0.91,
        "held_out_hour_psnr_db": 32.9,
        "held_out_hour_ssim": 0.945,
        "distilled_psnr_db": 30.3,
        "stage_inpaint_alone_psnr_db": 30.4,
        "stage_albedo_alone_clean_relight_psnr_db": 34.1,
        "stage_relight_true_albedo_psnr_db": 37.0,
    }
    short = {name: numbers[name] for name, bound in least.items() if not numbers[name] >= bound}
    assert not short
    # Hours that nobody photographed are no worse than those that were, by the same webcams' pictures.
    assert numbers["held_out_hour_psnr_db"] > numbers["painted_view_psnr_db"] - 2.0


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_what_is_left_out_is_missed(measured):
    numbers, _ = measured

    def lost(table: str, name: str) -> float:
        return numbers[f"ablation_{table}_full_psnr_db"] - numbers[f"ablation_{table}_{name}_psnr_db"]

    # As in the paper: without painting most is lost, without its parts less.
    assert lost("painting", "satellite_only_best_exposure") > 7.0
    for name, least in (
        ("no_gain_compensation", 1.5),
        ("no_inpainting_one_mean_colour", 4.5),
        ("no_occlusion_test", 4.5),
        ("no_guidance_telea_as_the_paper", 2.5),
    ):
        assert lost("painting", name) > least, name
    for name, least in (
        ("satellite_only_best_exposure", 12.0),
        ("no_albedo_painting_guided_completion", 4.0),
        ("painted_texels_as_they_are_the_relit_albedo_beyond", 1.8),
        ("no_webcams_july_s_image_as_it_is_relit", 6.0),
    ):
        assert lost("painted", name) > least, name
    for name, least in (
        ("no_relighting_nearest_painted_hour", 15.0),
        ("no_aerial_perspective", 8.0),
        ("no_webcams_july_s_image_as_it_is_relit", 8.0),
        ("no_tone_curve_searched", 2.2),
        ("satellite_a_guide_no_base_to_correct", 3.5),
    ):
        assert lost("held_out", name) > least, name


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_what_each_adds_to_the_albedo_is_told(measured):
    numbers, _ = measured
    # Measured: within ±0.3, +0.44 and +0.09 dB over the photographs alone, which are the whole's.
    assert numbers["albedo_photographs_alone_psnr_db"] == numbers["held_out_hour_psnr_db"]
    assert abs(numbers["with_painted_gain_db"]) < 0.3
    assert -0.6 < numbers["with_inpainted_gain_db"] < 0.8
    assert numbers["differentiable_gain_db"] > 0.0


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_figures(measured):
    _, folder = measured
    for name in ("alpinebench_painted.png", "alpinebench_held_out.png", "alpinebench_day.webp"):
        with Image.open(folder / name) as picture:
            levels = np.asarray(picture.convert("RGB"), float)
        assert min(levels.shape[:2]) > 60, name
        assert levels.std() > 10.0, f"{name} shows nothing"
    assert (folder / "alpinebench_day.mp4").stat().st_size > 10_000
