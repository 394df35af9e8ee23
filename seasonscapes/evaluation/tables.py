"""Tables of scores: by surface class, by distance and over images, and the relative drop of an ablation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypedDict

import numpy as np

# Limits of the distance classes [m], from the valley over the opposite slope to the horizon.
DISTANCE_EDGES_M = (0.0, 1000.0, 2000.0, 4000.0, 8000.0, np.inf)


class ClassRow(TypedDict):
    """PSNR of one class of pixels.

    Parameters
    ----------
    name
        Name of the class.
    share
        Fraction of the pixels within the mask.
    psnr_db
        Peak signal-to-noise ratio [dB]; NaN if the class has no pixel.
    """

    name: str
    share: float
    psnr_db: float


def by_class(
    truth: np.ndarray, picture: np.ndarray, labels: np.ndarray, names: Mapping[int, str], mask: np.ndarray | None = None
) -> list[ClassRow]:
    """Compute the PSNR of each class of pixels.

    Parameters
    ----------
    truth, picture
        Images ``(H, W, 3)`` in [0, 1].
    labels
        Integer class ``(H, W)`` of each pixel.
    names
        Names of the classes to evaluate.
    mask
        ``(H, W)`` bool, True where pixels are evaluated; all pixels if omitted.

    Returns
    -------
    list of ClassRow
        One row per class in the order of ``names``.
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
) -> list[ClassRow]:
    """Compute the PSNR of each range of distances.

    Parameters
    ----------
    truth, picture, mask
        As in `by_class`.
    depth_m
        Distance ``(H, W)`` [m].
    edges_m
        Increasing limits of the ranges [m].

    Returns
    -------
    list of ClassRow
        One row per range.
    """
    names = {i + 1: _range_name(edges_m[i], edges_m[i + 1]) for i in range(len(edges_m) - 1)}
    return by_class(truth, picture, np.digitize(depth_m, edges_m), names, mask)


def _range_name(low_m: float, high_m: float) -> str:
    return f"{low_m / 1000:g}–{high_m / 1000:g} km" if np.isfinite(high_m) else f"beyond {low_m / 1000:g} km"


def _row(name: str, squared: np.ndarray, selected: np.ndarray, mask: np.ndarray) -> ClassRow:
    error = float(squared[selected].mean()) if selected.any() else float("nan")
    psnr = float("inf") if error == 0.0 else -10.0 * np.log10(error)
    return {"name": name, "share": float(selected.sum() / max(mask.sum(), 1)), "psnr_db": float(psnr)}


def summary(records: Sequence[Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Compute the mean, standard deviation and median of each metric over images.

    Parameters
    ----------
    records
        Metrics by name, one mapping per image; names may be missing.

    Returns
    -------
    dict
        By metric: ``n`` (number of values), ``mean``, ``std``, ``median`` and ``not_finite``, the number of infinite or
        NaN values, which are excluded from the statistics.
    """
    names = list(dict.fromkeys(name for record in records for name in record))
    result = {}
    for name in names:
        values = np.array([record[name] for record in records if name in record], np.float64)
        finite = values[np.isfinite(values)]
        statistics = (np.mean, np.std, np.median) if finite.size else (lambda _: float("nan"),) * 3
        mean, deviation, median = (float(statistic(finite)) for statistic in statistics)
        result[name] = {
            "n": len(values),
            "mean": mean,
            "std": deviation,
            "median": median,
            "not_finite": int(len(values) - finite.size),
        }
    return result


def drop(full: float, ablated: float) -> float:
    """Compute the relative increase ``(ablated - full) / full`` of an error by an ablation ("Drop" in the paper).

    Parameters
    ----------
    full, ablated
        Error (such as LPIPS) of the full and of the ablated system.

    Returns
    -------
    float
        Relative increase; positive if the ablated system is worse.

    Raises
    ------
    ValueError
        If the error of the full system is not positive.

    Examples
    --------
    >>> drop(0.25, 0.5)
    1.0
    """
    if not full > 0.0:
        raise ValueError(f"drop: got an error of the full system of {full}, expected more than 0")
    return (ablated - full) / full


def table_lines(rows: Sequence[Mapping[str, object]], *, digits: int = 3, markdown: bool = False) -> list[str]:
    """Format rows as lines of aligned columns or of a Markdown table.

    Parameters
    ----------
    rows
        Cells by column name; missing cells and ``None`` are shown as a dash.
    digits
        Digits after the decimal point of floats.
    markdown
        Whether to format a Markdown table.

    Returns
    -------
    list of str
        Lines, the first with the column names; empty without rows.
    """
    if not rows:
        return []
    columns = list(dict.fromkeys(key for row in rows for key in row))
    cells = [columns, *([_cell(row.get(name), digits) for name in columns] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    lines = [
        [
            text.ljust(width) if i == 0 else text.rjust(width)
            for i, (text, width) in enumerate(zip(line, widths, strict=True))
        ]
        for line in cells
    ]
    if not markdown:
        return ["  ".join(line).rstrip() for line in lines]
    separator = ["-" * width if i == 0 else "-" * (width - 1) + ":" for i, width in enumerate(widths)]
    return ["| " + " | ".join(line) + " |" for line in (lines[0], separator, *lines[1:])]


def _cell(value: object, digits: int) -> str:
    if value is None:
        return "–"
    return f"{value:.{digits}f}" if isinstance(value, float) else str(value)
