"""Pictures beside the truth: truth | ours | another | difference, with the steepest part magnified below."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from seasonscapes.evaluation.metrics import flip_map

_GAP_PX, _HEAD_PX = 4, 18
_PAPER = 0.97
# Anchors of the difference's colours: black, violet, orange, pale yellow; even steps of error look even.
_HEAT = np.array([[0.0, 0.0, 0.02], [0.32, 0.07, 0.48], [0.71, 0.21, 0.47], [0.98, 0.53, 0.38], [0.99, 0.99, 0.75]])


def comparison(
    pictures: Mapping[str, np.ndarray],
    *,
    mask: np.ndarray | None = None,
    window: tuple[int, int, int, int] | None = None,
    magnify: int = 3,
) -> np.ndarray:
    """One row of pictures with their names, then the FLIP error of the second against the first.

    Parameters
    ----------
    pictures
        Name to ``(H, W, 3)`` sRGB-encoded in [0, 1]; the first is the truth, the second is what is judged.
    mask
        ``(H, W)`` bool; beyond it pictures are paled and no difference is shown.
    window
        Left, top, width and height [px] of a part to magnify below (`steepest_window`).
    magnify
        How many times at most; a magnified part is as wide as its picture.

    Returns
    -------
    ndarray
        ``(h, w, 3)`` in [0, 1], sRGB-encoded.
    """
    if len(pictures) < 2:
        raise ValueError(f"comparison: {len(pictures)} pictures, expected the truth and at least one more")
    names, shown = list(pictures), [np.asarray(picture, np.float64) for picture in pictures.values()]
    if len({picture.shape for picture in shown}) != 1:
        raise ValueError(f"comparison: pictures of shapes {[picture.shape for picture in shown]}")
    mask = np.ones(shown[0].shape[:2], bool) if mask is None else mask
    error = error_colours(np.where(mask, flip_map(shown[0], np.where(mask[..., None], shown[1], shown[0])), 0.0))
    rows = [_row([_paled(picture, mask) for picture in shown] + [error], [*names, f"difference of {names[1]}"])]
    if window is not None:
        left, top, width, height = window
        size = min(magnify * width, shown[0].shape[1])
        rows.append(
            _row(
                [_grown(picture[top : top + height, left : left + width], size) for picture in [*shown, error]],
                [""] * (len(shown) + 1),
                shown[0].shape[1],
            )
        )
    return np.concatenate(rows)


def side_by_side(pictures: Mapping[str, np.ndarray]) -> np.ndarray:
    """Pictures ``(H, W, 3)`` in [0, 1] in one row, with their names above; `ValueError` where sizes differ."""
    shown = [np.asarray(picture, np.float64) for picture in pictures.values()]
    if len({picture.shape for picture in shown}) != 1:
        raise ValueError(f"side_by_side: pictures of shapes {[picture.shape for picture in shown]}")
    return _row(shown, list(pictures))


def error_colours(values: np.ndarray) -> np.ndarray:
    """Colours ``(H, W, 3)`` of errors ``(H, W)`` in [0, 1]."""
    place = np.linspace(0.0, 1.0, len(_HEAT))
    return np.stack([np.interp(values, place, channel) for channel in _HEAT.T], axis=-1)


def steepest_window(
    normal: np.ndarray, depth_m: np.ndarray, *, share: float = 1.0 / 3.0, nearest_m: float = 60.0
) -> tuple[int, int, int, int]:
    """The part of a view that shows most steep land: left, top, width, height [px].

    Parameters
    ----------
    normal, depth_m
        ``(H, W, 3)`` and ``(H, W)`` of the view's G-buffer.
    share
        Of the picture's width and height.
    """
    height, width = depth_m.shape
    steep = np.where(np.isfinite(depth_m) & (depth_m > nearest_m), 1.0 - np.nan_to_num(normal[..., 2], nan=1.0), 0.0)
    size = (max(8, round(share * height)), max(8, round(share * width)))
    total = np.pad(np.cumsum(np.cumsum(steep, axis=0), axis=1), ((1, 0), (1, 0)))
    sums = (
        total[size[0] :, size[1] :]
        - total[: -size[0], size[1] :]
        - total[size[0] :, : -size[1]]
        + total[: -size[0], : -size[1]]
    )
    top, left = np.unravel_index(int(np.argmax(sums)), sums.shape)
    return int(left), int(top), size[1], size[0]


def _paled(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.where(mask[..., None], picture, 0.5 * picture + 0.5 * _PAPER)


def _grown(picture: np.ndarray, width_px: int) -> np.ndarray:
    height_px = round(picture.shape[0] * width_px / picture.shape[1])
    return cv2.resize(picture, (width_px, height_px), interpolation=cv2.INTER_NEAREST)


def _row(pictures: list[np.ndarray], names: list[str], column_px: int | None = None) -> np.ndarray:
    column_px = column_px or pictures[0].shape[1]
    head = _HEAD_PX if any(names) else 0
    sheet = np.full((head + pictures[0].shape[0] + _GAP_PX, len(pictures) * (column_px + _GAP_PX), 3), _PAPER)
    for number, (picture, name) in enumerate(zip(pictures, names, strict=True)):
        left = number * (column_px + _GAP_PX)
        sheet[head : head + picture.shape[0], left : left + picture.shape[1]] = picture
        if name:
            sheet[:head, left : left + column_px] = _written(name, (head, column_px))
    return sheet


def _written(text: str, size: tuple[int, int]) -> np.ndarray:
    strip = np.full((*size, 3), round(255 * _PAPER), np.uint8)
    cv2.putText(strip, text, (2, size[0] - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (25, 25, 25), 1, cv2.LINE_AA)
    return strip / 255.0
