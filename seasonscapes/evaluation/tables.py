"""Scores brought together: by class of land, by distance, over pictures; and the paper's "Drop" of an ablation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

# Distances [m] at whose steps the paper's scenes change character: valley, opposite slope, horizon.
DISTANCE_EDGES_M = (0.0, 1000.0, 2000.0, 4000.0, 8000.0, np.inf)


def by_class(
    truth: np.ndarray, picture: np.ndarray, labels: np.ndarray, names: Mapping[int, str], mask: np.ndarray | None = None
) -> list[dict]:
    """PSNR of each class of pixels.

    Parameters
    ----------
    truth, picture
        ``(H, W, 3)`` in [0, 1].
    labels
        ``(H, W)`` integers.
    names
        What the integers mean; others are left out.

    Returns
    -------
    list of dict
        ``name``, ``share`` of the masked pixels, ``psnr_db`` (NaN where the class has no pixel).
    """
    mask = np.ones(labels.shape, bool) if mask is None else np.asarray(mask, bool)
    squared = ((np.asarray(truth, np.float64) - np.asarray(picture, np.float64)) ** 2).mean(axis=2)
    return [_row(name, squared, mask & (labels == label), mask) for label, name in names.items()]


def by_distance(
    truth: np.ndarray,
    picture: np.ndarray,
    depth_m: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    edges_m: Sequence[float] = DISTANCE_EDGES_M,
) -> list[dict]:
    """PSNR of the pixels between each two distances; rows as in `by_class`."""
    names = {i + 1: _between(edges_m[i], edges_m[i + 1]) for i in range(len(edges_m) - 1)}
    return by_class(truth, picture, np.digitize(depth_m, edges_m), names, mask)


def _between(low_m: float, high_m: float) -> str:
    return f"{low_m / 1000:g}–{high_m / 1000:g} km" if np.isfinite(high_m) else f"beyond {low_m / 1000:g} km"


def _row(name: str, squared: np.ndarray, chosen: np.ndarray, mask: np.ndarray) -> dict:
    error = float(squared[chosen].mean()) if chosen.any() else float("nan")
    psnr = float("inf") if error == 0.0 else -10.0 * np.log10(error)
    return {"name": name, "share": float(chosen.sum() / max(mask.sum(), 1)), "psnr_db": float(psnr)}


def summary(records: Sequence[Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Mean, standard deviation and median of each number over pictures.

    Values that are not finite (equal pictures, no whole window) are counted as ``not_finite``, and left out of the rest.
    """
    names = list(dict.fromkeys(name for record in records for name in record))
    result = {}
    for name in names:
        values = np.array([record[name] for record in records if name in record], np.float64)
        finite = values[np.isfinite(values)]
        told = (np.mean, np.std, np.median) if finite.size else (lambda _: float("nan"),) * 3
        mean, deviation, median = (float(each(finite)) for each in told)
        result[name] = {
            "n": len(values),
            "mean": mean,
            "std": deviation,
            "median": median,
            "not_finite": int(len(values) - finite.size),
        }
    return result


def drop(full: float, ablated: float) -> float:
    """The paper's "Drop" of an error that is better small (LPIPS): ``(ablated - full) / full``; positive is worse."""
    if not full > 0.0:
        raise ValueError(f"drop: the full system's error is {full}, expected more than 0")
    return (ablated - full) / full


def table_lines(rows: Sequence[Mapping[str, object]], *, digits: int = 3, markdown: bool = False) -> list[str]:
    """Rows of equal keys as lines of aligned columns, or of a Markdown table."""
    if not rows:
        return []
    heads = list(dict.fromkeys(key for row in rows for key in row))
    cells = [heads, *([_cell(row.get(head), digits) for head in heads] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(heads))]
    lines = [
        [
            text.ljust(width) if i == 0 else text.rjust(width)
            for i, (text, width) in enumerate(zip(line, widths, strict=True))
        ]
        for line in cells
    ]
    if not markdown:
        return ["  ".join(line).rstrip() for line in lines]
    rule = ["-" * width if i == 0 else "-" * (width - 1) + ":" for i, width in enumerate(widths)]
    return ["| " + " | ".join(line) + " |" for line in (lines[0], rule, *lines[1:])]


def _cell(value: object, digits: int) -> str:
    if value is None:
        return "–"
    return f"{value:.{digits}f}" if isinstance(value, float) else str(value)
