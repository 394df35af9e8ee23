"""``seasonscapes evaluate``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_choice, check_range
from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.outputs import check_output, check_output_folder
from seasonscapes.commands.refusals import refuse_without
from seasonscapes.errors import InputError


def evaluate_command(
    *,
    truth: Path,
    pictures: Path,
    mask: Path | None = None,
    mode: str = "valid",
    near_m: float | None = None,
    far_m: float | None = None,
    match: str = "none",
    used: Annotated[tuple[Path, ...], Parameter(consume_multiple=True)] = (),
    lpips: Path | None = None,
    table: Path | None = None,
    figures: Path | None = None,
    json: bool = False,
) -> None:
    """Score pictures against the truth: PSNR, SSIM, FLIP, colour angle, CIEDE2000 and, given its weights, LPIPS.

    Parameters
    ----------
    truth
        A picture (.png, .jpg, .exr), or a folder of them.
    pictures
        What is to be scored: a picture, or a folder whose files have the names of the truth's (endings may differ).
    mask
        A .png that is white where pixels count, or a folder of them. Truths in .exr that hold depth need none: sky and
        what is nearer than --near-m are left out.
    mode
        valid (pixels of the mask alone) or paper (multiplied by the mask and scored over the frame, which flatters; of
        truths that hold depth by the paper's own mask: no sky, not the nearer 45 % of the land).
    near_m
        Least distance in metres, of truths that hold depth; default 60.
    far_m
        Greatest distance in metres, of truths that hold depth; default without end.
    match
        none, or gain: fit one factor for each colour first, for pictures of unknown exposure and white balance.
    used
        Folders or files that were used for painting, guidance or training: if a truth is among them, nothing is scored.
    lpips
        File of LPIPS's weights, made by `seasonscapes lpips`; left out, what SEASONSCAPES_LPIPS names.
    table
        Also write all scores to this .csv or .md.
    figures
        Also write a comparison picture of each pair into this folder.
    json
        Print one machine-readable record.
    """
    from seasonscapes.evaluation import picture_pairs as pairs
    from seasonscapes.evaluation.masks import NEAR_M
    from seasonscapes.evaluation.metrics import MODES
    from seasonscapes.evaluation.tables import summary, table_lines

    check_choice("--mode", mode, tuple(MODES))
    check_choice("--match", match, pairs.MATCHES)
    refuse_without("--mode valid", mode == "valid", near_m=near_m, far_m=far_m)
    near, far = NEAR_M if near_m is None else near_m, float("inf") if far_m is None else far_m
    check_range("--near-m", near, 0.0, 1e6)
    if not far > near:
        raise InputError("--far-m", "not beyond --near-m", got=far, expected=f"more than {near:g}")
    if table is not None:
        check_output(table, (".csv", ".md"), flag="--table")
    if figures is not None:
        check_output_folder(figures, flag="--figures")
    found = pairs.paired(truth, pictures)
    depths = any(true_path.suffix.lower() == ".exr" for true_path, _ in found.values())
    refuse_without("a truth in .exr, which may hold depth", depths, near_m=near_m, far_m=far_m)
    pairs.check_files_held_out([true_path for true_path, _ in found.values()], used)
    measure, why, sources = _lpips(lpips)
    options = pairs.ScoreOptions(pairs.MaskOptions(mask, near, far), mode, match, measure)
    rows = []
    with progress_bars() as progress:
        for number, (name, (true_path, path)) in enumerate(found.items()):
            figure = None if figures is None else figures / f"{name}_comparison.png"
            score = pairs.score_pair(true_path, path, name, options=options, figure=figure)
            rows.append({"picture": name} | score.record())
            progress(f"scoring {len(found)} pictures", (number + 1) / len(found))
    totals = summary([{key: value for key, value in row.items() if key != "picture"} for row in rows])
    if table is not None:
        pairs.write_table(table, rows)
    if why is not None:
        message(f"LPIPS is left out: {why}")
    elif not sources["published"]:
        message("LPIPS is by other weights than the published ones, and not comparable with that of other works")
    mean = {"picture": "mean"} | {name: value["mean"] for name, value in totals.items()}
    record = {"mode": mode, "match": match, "pictures": rows, "summary": totals, "lpips_skipped": why}
    record["lpips_weights"] = sources
    print_result(record, [f"mode {mode}, {len(rows)} pictures", *table_lines([*rows, mean])], as_json=json)


def _lpips(file: Path | None) -> tuple[Callable | None, str | None, dict]:
    """The function that measures LPIPS and what it was made from, or why there is none; `InputError` where a named file
    is missing, or PyTorch, which it needs."""
    from importlib.util import find_spec

    from seasonscapes.evaluation.lpips import load_lpips, lpips_sources, missing_lpips

    why = missing_lpips(file)
    if why is None and (find_spec("torch") is None or find_spec("safetensors") is None):
        why = "PyTorch and safetensors are missing (pip install 'seasonscapes[gaussians]')"
    if why is None:
        return load_lpips(file), None, lpips_sources(file)
    if file is not None:
        raise InputError("--lpips", why)
    return None, why, {}
