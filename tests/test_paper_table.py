"""The paper's ablation table runs whole on weights of its own, says so in every row, and every ablation acts."""

import json
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import paper_table

# Not imported here: that takes seconds in each process that collects this file.
pytestmark = pytest.mark.skipif(find_spec("diffusers") is None, reason="the extra 'diffusion' is not installed")

LEAST = ["--quick", "--views", "2", "--held-out", "1"]


@pytest.mark.slow
def test_the_table_runs_whole_and_says_what_its_weights_are(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("SEASONSCAPES_WORKSPACE", str(tmp_path / "work"))
    rows = paper_table.main([*LEAST, "--json", str(tmp_path / "table.json"), "--figures", str(tmp_path / "figures")])
    assert [row["row"] for row in rows] == list(paper_table.ROWS)
    assert {(row["weights"], row["lpips_weights"]) for row in rows} == {("tiny, random", "random")}
    full, *ablated = rows
    assert full["drop"] == 0.0
    for row in ablated:
        assert row["psnr_db"] != full["psnr_db"], row["row"]
        assert row["lpips"] != full["lpips"], row["row"]
        assert row["drop"] == pytest.approx(row["lpips"] / full["lpips"] - 1.0)
    # Whatever the model paints, photographs of the place are nearer to a photograph of it.
    assert rows[-1]["valid_psnr_db"] < full["valid_psnr_db"] - 3.0
    assert rows[-1]["drop"] > 0.5
    assert all(row["valid_psnr_db"] < row["psnr_db"] for row in rows)
    assert {row["unpainted"] for row in ablated[:-1]} == {full["unpainted"]}
    assert 0.05 < full["unpainted"] < 0.95
    assert rows[-1]["unpainted"] == 1.0
    assert len(list((tmp_path / "figures").glob("*.png"))) == sum(row["pictures"] for row in rows)
    kept = json.loads((tmp_path / "table.json").read_text())
    assert kept["rows"] == rows
    assert kept["record"]["seed"] == 0
    assert "tiny, random" in capsys.readouterr().out.splitlines()[-1]


def test_weights_are_named_in_every_row(tmp_path):
    lpips = paper_table.write_tiny_lpips(tmp_path)
    chosen = paper_table.parsed(["--weights", "hub", "--lpips", str(lpips)])
    assert paper_table.about_weights(chosen, tmp_path) == {"weights": "the hub's cache", "lpips_weights": "others"}
    # With real weights the paper's own size and effort are the default.
    assert (chosen.size, chosen.steps) == ((1536, 1024), 50)
    assert paper_table.parsed(["--weights", "w", "--size", "96x64"]).size == (96, 64)
