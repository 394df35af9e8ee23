"""The whole way on a small synthetic massif: photographs, poses, texture, albedo, other hours, Gaussians."""

import json

import numpy as np
import pytest
from PIL import Image

from seasonscapes.cli import main

SCENE = """name = "little"
attribution = "made by a test"
vertical_datum = "local"

[origin]
latitude_deg = 46.55
longitude_deg = 7.98

[elevation.synthetic]
spacing_m = 60.0
detail_m = 60.0

[[camera]]
name = "aerial"
latitude_deg = 46.597988
longitude_deg = 7.91382
above_ground_m = 2000.0
heading_deg = 141.3
pitch_deg = -11.0
fov_deg = 52.0

[[camera]]
name = "meadow"
latitude_deg = 46.591238
longitude_deg = 7.962256
above_ground_m = 60.0
heading_deg = 164.3
pitch_deg = 7.0
fov_deg = 60.0
"""


@pytest.mark.slow
def test_photographs_to_gaussians(tmp_path, capsys):
    scene = tmp_path / "little.toml"
    scene.write_text(SCENE)
    common = ["run", str(scene), "--workspace", str(tmp_path / "work"), "--times", "2024-07-20T10:00,2024-07-20T15:00",
              "--at-hours", "2024-07-20T18:00", "--photo-size", "192x128", "--size", "96x64", "--texel-m", "60", "--discs", "24",
              "--suns", "3", "--steps", "40", "--picture-steps", "2", "--sky", "hosek", "-o", str(tmp_path / "run"), "--json"]  # fmt: skip
    assert main([*common, "--until", "calibrate"]) == 0
    assert list(json.loads(capsys.readouterr().out)["stages"]) == ["pictures", "calibrate"]
    assert main(common) == 0
    said = capsys.readouterr()
    assert "run: calibrate: fresh" in said.err
    stages = json.loads(said.out)["stages"]
    assert list(stages) == ["pictures", "calibrate", "paint", "inpaint", "albedo", "relight", "distil", "splat"]
    relit, splat = (
        np.asarray(Image.open(next((tmp_path / "run" / name).glob("*.png"))), float) for name in ("relight", "splat")
    )
    assert relit.shape == splat.shape == (64, 96, 3)
    assert relit.std() > 5.0
    # Two ways to the same hour from the same albedo: not the same picture, but one of the same thing.
    assert np.corrcoef(relit.mean(axis=2).ravel(), splat.mean(axis=2).ravel())[0, 1] > 0.6
    assert main(["info", str(tmp_path / "run")]) == 0
    capsys.readouterr()
    assert main([*common, "--from", "splat", "--until", "paint"]) == 2
    assert "--until" in capsys.readouterr().err
    assert main([*common, "--until", "everything"]) == 2
    assert "no such stage" in capsys.readouterr().err
