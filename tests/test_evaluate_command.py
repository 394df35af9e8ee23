"""The verb that scores pictures: pairs, masks, leaks, tables and figures; and the figures themselves."""

import csv
import json

import numpy as np
import pytest
from command_line import command

from seasonscapes.errors import InputError
from seasonscapes.evaluation.figures import comparison_figure, error_colours, steepest_window
from seasonscapes.evaluation.masks import reference_mask
from seasonscapes.evaluation.metrics import psnr_db
from seasonscapes.evaluation.picture_pairs import matching_gain
from seasonscapes.images import read_image_linear, srgb_from_linear, write_exr, write_png8

HEIGHT, WIDTH = 48, 64


def levels(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(20, 236, (HEIGHT, WIDTH, 3), np.uint8)


@pytest.fixture
def folders(tmp_path, monkeypatch):
    monkeypatch.delenv("SEASONSCAPES_LPIPS", raising=False)
    for seed, name in enumerate(("a", "b")):
        image = levels(seed)
        write_png8(tmp_path / "truth" / f"{name}.png", image)
        write_png8(tmp_path / "made" / f"{name}.png", np.clip(image + 10 * (seed + 1), 0, 255).astype(np.uint8))
    return tmp_path


def record_of(capsys) -> dict:
    return json.loads(capsys.readouterr().out)


def test_scores_folders_and_writes_tables(folders, capsys):
    command(
        "evaluate",
        truth=folders / "truth",
        pictures=folders / "made",
        table=folders / "t.csv",
        figures=folders / "f",
        json=True,
    )
    record = record_of(capsys)
    expected = psnr_db(levels(0) / 255.0, (levels(0) + 10) / 255.0)
    assert [row["picture"] for row in record["pictures"]] == ["a", "b"]
    assert record["pictures"][0]["psnr_db"] == pytest.approx(expected, abs=1e-3)
    assert record["summary"]["psnr_db"]["n"] == 2
    assert "SEASONSCAPES_LPIPS" in record["lpips_skipped"]
    with open(folders / "t.csv") as file:
        assert float(next(csv.DictReader(file))["psnr_db"]) == pytest.approx(expected, abs=1e-3)
    assert read_image_linear(folders / "f" / "a_comparison.png").shape[1] > 3 * WIDTH
    command("evaluate", truth=folders / "truth", pictures=folders / "made", table=folders / "t.md")
    assert (folders / "t.md").read_text().startswith("| picture")
    assert "mean" in capsys.readouterr().out


def test_masks_and_modes(folders, capsys):
    half = np.zeros((HEIGHT, WIDTH), np.uint8)
    half[:, : WIDTH // 2] = 255
    write_png8(folders / "mask.png", half)
    scores = {}
    for mode in ("valid", "paper"):
        command(
            "evaluate",
            truth=folders / "truth" / "a.png",
            pictures=folders / "made" / "a.png",
            mask=folders / "mask.png",
            mode=mode,
            json=True,
        )
        scores[mode] = record_of(capsys)["pictures"][0]
    assert scores["valid"]["mask_share"] == 0.5
    assert scores["paper"]["psnr_db"] - scores["valid"]["psnr_db"] == pytest.approx(-10 * np.log10(0.5), abs=0.01)


def test_radiance_is_developed_alike_and_masked_by_depth(tmp_path, capsys):
    truth = np.random.default_rng(2).uniform(200.0, 4000.0, (HEIGHT, WIDTH, 3)).astype(np.float32)
    depth = np.full((HEIGHT, WIDTH), 500.0, np.float32)
    depth[:8], depth[8:16] = np.inf, 20.0
    spoilt = truth.copy()
    spoilt[:16] *= 3.0
    write_exr(tmp_path / "truth.exr", {"": truth, "depth": depth})
    write_exr(tmp_path / "made.exr", {"": 2.0 * spoilt})
    command("evaluate", truth=tmp_path / "truth.exr", pictures=tmp_path / "made.exr", json=True)
    plain = record_of(capsys)["pictures"][0]
    command("evaluate", truth=tmp_path / "truth.exr", pictures=tmp_path / "made.exr", match="gain", json=True)
    matched = record_of(capsys)["pictures"][0]
    command("evaluate", truth=tmp_path / "truth.exr", pictures=tmp_path / "made.exr", mode="paper", json=True)
    assert record_of(capsys)["pictures"][0]["mask_share"] == pytest.approx(reference_mask(depth).mean())
    command("evaluate", truth=tmp_path / "truth.exr", pictures=tmp_path / "made.exr", near_m=10.0, json=True)
    assert record_of(capsys)["pictures"][0]["mask_share"] == pytest.approx((HEIGHT - 8) / HEIGHT)
    assert plain["mask_share"] == pytest.approx((HEIGHT - 16) / HEIGHT)
    assert plain["psnr_db"] < 25.0 < 40.0 < matched["psnr_db"]
    encoded = srgb_from_linear(np.clip(truth.reshape(-1, 3) / 8000.0, 0.0, 1.0))
    assert matching_gain(encoded, 0.25 * truth.reshape(-1, 3) / 8000.0) == pytest.approx([4.0, 4.0, 4.0], rel=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_a_matched_picture_never_scores_worse(seed):
    """Truths of snow and shadow have medians that say nothing about their squared errors."""
    from seasonscapes.evaluation.metrics import psnr_db
    from seasonscapes.evaluation.picture_pairs import PicturePair, matched

    rng = np.random.default_rng(seed)
    truth = np.where(rng.random((40, 50, 1)) < 0.3, 0.9, 0.05) * rng.uniform(0.5, 1.0, (40, 50, 3))
    linear = rng.uniform(0.0, 1.5, (40, 50, 3)) * [1.0, 0.3, 3.0]
    mask = rng.random((40, 50)) < 0.6
    pair = PicturePair(srgb_from_linear(truth), srgb_from_linear(np.clip(linear, 0.0, 1.0)), None, linear)
    after = matched(pair, mask)
    assert psnr_db(after.truth, after.picture, mask) >= psnr_db(pair.truth, pair.picture, mask)


def test_what_was_used_is_refused(folders):
    write_png8(folders / "used" / "other_name.png", levels(1))
    with pytest.raises(InputError, match="not held out"):
        command("evaluate", truth=folders / "truth", pictures=folders / "made", used=(folders / "used",))
    with pytest.raises(InputError, match="--used"):
        command("evaluate", truth=folders / "truth", pictures=folders / "made", used=(folders / "nowhere",))


def test_errors_of_the_user(folders):
    truth, made = folders / "truth", folders / "made"
    (made / "b.png").unlink()
    cases = [
        ({"truth": truth, "pictures": made}, "no picture for 1 of 2"),
        ({"truth": folders / "no", "pictures": made}, "--truth"),
        ({"truth": truth, "pictures": made / "a.png"}, "a file and a folder"),
        ({"truth": truth, "pictures": made, "mode": "kind"}, "--mode"),
        ({"truth": truth, "pictures": made, "match": "all"}, "--match"),
        ({"truth": truth, "pictures": made, "far_m": 10.0}, "--far-m: not beyond"),
        (
            {"truth": truth / "a.png", "pictures": made / "a.png", "near_m": 10.0},
            "--near-m: does nothing without a truth",
        ),
        (
            {"truth": truth, "pictures": made, "mode": "paper", "far_m": 900.0},
            "--far-m: does nothing without --mode valid",
        ),
        ({"truth": truth, "pictures": made, "table": folders / "t.xls"}, "--table"),
        ({"truth": truth / "a.png", "pictures": made / "a.png", "lpips": folders}, "--lpips"),
        ({"truth": truth / "a.png", "pictures": made / "a.png", "mask": folders / "m.png"}, "--mask"),
    ]
    for arguments, message in cases:
        with pytest.raises(InputError, match=message):
            command("evaluate", **arguments)
    write_png8(folders / "small.png", levels(0)[:20])
    with pytest.raises(InputError, match="another size"):
        command("evaluate", truth=truth / "a.png", pictures=folders / "small.png")
    (folders / "broken.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match="not a readable picture"):
        command("evaluate", truth=truth / "a.png", pictures=folders / "broken.png")
    write_exr(folders / "linear.exr", {"": np.ones((HEIGHT, WIDTH, 3), np.float32)})
    with pytest.raises(InputError, match="cannot be compared"):
        command("evaluate", truth=truth / "a.png", pictures=folders / "linear.exr")


def test_comparison_sheet():
    a, b = levels(0) / 255.0, levels(1) / 255.0
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:24] = False
    sheet = comparison_figure({"truth": a, "ours": b, "other": a}, mask=mask, window=(10, 20, 20, 16))
    assert sheet.shape[1] == 4 * (WIDTH + 4)
    assert sheet.shape[0] > 2 * HEIGHT
    assert 0.0 <= sheet.min() <= sheet.max() <= 1.0
    plain = comparison_figure({"truth": a, "ours": b}, mask=mask)
    head = plain.shape[0] - HEIGHT - 4
    assert np.array_equal(plain[head + 24 : head + HEIGHT, :WIDTH], a[24:])
    difference = plain[head : head + HEIGHT, -WIDTH - 4 : -4]
    assert difference[:24] == pytest.approx(np.broadcast_to([0.0, 0.0, 0.02], (24, WIDTH, 3)))
    assert error_colours(np.array([[1.0]]))[0, 0] == pytest.approx([0.99, 0.99, 0.75])
    with pytest.raises(ValueError, match="at least one more"):
        comparison_figure({"truth": a})


def test_steepest_window_finds_the_cliff():
    normal = np.zeros((60, 90, 3))
    normal[..., 2] = 1.0
    normal[35:50, 60:80] = [0.0, 1.0, 0.05]
    left, top, width, height = steepest_window(normal, np.full((60, 90), 900.0))
    assert (width, height) == (30, 20)
    assert left <= 60 < 80 <= left + width
    assert top <= 35 < 50 <= top + height


def test_lpips_from_its_two_published_parts(folders, capsys, monkeypatch):
    """The verb `lpips` joins them, `evaluate` reads the file and says that these are not the published weights."""
    pytest.importorskip("torch")
    from tiny_diffusion import random_lpips, write_lpips_parts

    from seasonscapes.cli import main
    from seasonscapes.evaluation.lpips import lpips_of

    network, linear = random_lpips()
    alexnet, wheel, _ = write_lpips_parts(folders, network, linear)
    file = folders / "l.safetensors"
    assert main(["lpips", str(alexnet), str(wheel), "-o", str(file), "--json"]) == 0
    told = capsys.readouterr()
    assert not json.loads(told.out)["published"]
    assert f"not the published weights: {alexnet} and {wheel}" in told.err
    pictures = {"truth": folders / "truth", "pictures": folders / "made", "json": True}
    command("evaluate", **pictures, lpips=file)
    told = capsys.readouterr()
    record = json.loads(told.out)
    assert "by other weights than the published ones" in told.err
    assert record["lpips_weights"]["published"] is False
    images = levels(0) / 255.0, (levels(0) + 10) / 255.0
    assert record["pictures"][0]["lpips"] == pytest.approx(lpips_of(network, linear)(*images, None), rel=1e-4)
    monkeypatch.setenv("SEASONSCAPES_LPIPS", str(file))
    command("evaluate", **pictures)
    assert record_of(capsys)["pictures"] == record["pictures"]
    assert main(["lpips", str(wheel), str(wheel), "-o", str(folders / "other.safetensors")]) == 2
    assert "10 of 10 keys are missing" in capsys.readouterr().err
