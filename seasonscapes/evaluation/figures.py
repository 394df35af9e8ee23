"""Comparison figures: images side by side with the ground truth, the FLIP error map and a magnified detail."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from seasonscapes.evaluation.metrics import flip_map

_GAP_PX, _LABEL_PX = 4, 18
_BACKGROUND = 0.97
# Colour map of the error from 0 to 1: black, violet, orange, pale yellow (perceptually uniform).
_ERROR_COLOURS = np.array(
    [[0.0, 0.0, 0.02], [0.32, 0.07, 0.48], [0.71, 0.21, 0.47], [0.98, 0.53, 0.38], [0.99, 0.99, 0.75]]
)


def comparison_figure(
    pictures: Mapping[str, np.ndarray],
    *,
    mask: np.ndarray | None = None,
    window: tuple[int, int, int, int] | None = None,
    magnify: int = 3,
) -> np.ndarray:
    """Compose a row of labelled images followed by the FLIP error map of the second image against the first.

    Parameters
    ----------
    pictures
        Images ``(H, W, 3)``, sRGB-encoded in [0, 1], by label; the first is the ground truth, the second is evaluated.
    mask
        ``(H, W)`` bool; outside the mask images are brightened and the error is zero. All pixels if omitted.
    window
        Left, top, width and height [px] of a detail that is magnified in a second row (`steepest_window`).
    magnify
        Maximum magnification; a magnified detail is at most as wide as its image.

    Returns
    -------
    ndarray
        Figure ``(h, w, 3)``, sRGB-encoded in [0, 1].

    Raises
    ------
    ValueError
        If there are fewer than two images, or their shapes differ.
    """
    if len(pictures) < 2:
        raise ValueError(
            f"comparison_figure: got {len(pictures)} images, expected the ground truth and at least one more"
        )
    names, images = list(pictures), [np.asarray(picture, np.float64) for picture in pictures.values()]
    if len({image.shape for image in images}) != 1:
        raise ValueError(f"comparison_figure: got shapes {[image.shape for image in images]}, expected equal shapes")
    mask = np.ones(images[0].shape[:2], bool) if mask is None else mask
    error = error_colours(np.where(mask, flip_map(images[0], np.where(mask[..., None], images[1], images[0])), 0.0))
    rows = [_row([_brighten_masked(image, mask) for image in images] + [error], [*names, f"difference of {names[1]}"])]
    if window is not None:
        left, top, width, height = window
        magnified_px = min(magnify * width, images[0].shape[1])
        rows.append(
            _row(
                [_magnify(image[top : top + height, left : left + width], magnified_px) for image in [*images, error]],
                [""] * (len(images) + 1),
                images[0].shape[1],
            )
        )
    return np.concatenate(rows)


def image_row(pictures: Mapping[str, np.ndarray]) -> np.ndarray:
    """Compose a row of labelled images.

    Parameters
    ----------
    pictures
        Images ``(H, W, 3)``, sRGB-encoded in [0, 1], by label.

    Returns
    -------
    ndarray
        Figure ``(h, w, 3)``, sRGB-encoded in [0, 1].

    Raises
    ------
    ValueError
        If the shapes differ.
    """
    images = [np.asarray(picture, np.float64) for picture in pictures.values()]
    if len({image.shape for image in images}) != 1:
        raise ValueError(f"image_row: got shapes {[image.shape for image in images]}, expected equal shapes")
    return _row(images, list(pictures))


def error_colours(values: np.ndarray) -> np.ndarray:
    """Map errors to colours.

    Parameters
    ----------
    values
        Errors ``(H, W)`` in [0, 1].

    Returns
    -------
    ndarray
        Colours ``(H, W, 3)``, sRGB-encoded in [0, 1].
    """
    knots = np.linspace(0.0, 1.0, len(_ERROR_COLOURS))
    return np.stack([np.interp(values, knots, channel) for channel in _ERROR_COLOURS.T], axis=-1)


def steepest_window(
    normal: np.ndarray, depth_m: np.ndarray, *, share: float = 1.0 / 3.0, nearest_m: float = 60.0
) -> tuple[int, int, int, int]:
    """Find the window of a view with the most steep terrain.

    Parameters
    ----------
    normal, depth_m
        Normals ``(H, W, 3)`` and distances ``(H, W)`` [m] of the view's G-buffer.
    share
        Size of the window as a fraction of the image size.
    nearest_m
        Terrain nearer than this distance is ignored [m].

    Returns
    -------
    left, top, width, height : int
        Window [px].
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


def _brighten_masked(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.where(mask[..., None], image, 0.5 * image + 0.5 * _BACKGROUND)


def _magnify(image: np.ndarray, width_px: int) -> np.ndarray:
    height_px = round(image.shape[0] * width_px / image.shape[1])
    return cv2.resize(image, (width_px, height_px), interpolation=cv2.INTER_NEAREST)


def _row(images: list[np.ndarray], labels: list[str], column_px: int | None = None) -> np.ndarray:
    """Images of equal size in columns, with labels above unless all are empty."""
    width = images[0].shape[1] if column_px is None else column_px
    head = _LABEL_PX if any(labels) else 0
    sheet = np.full((head + images[0].shape[0] + _GAP_PX, len(images) * (width + _GAP_PX), 3), _BACKGROUND)
    for number, (image, label) in enumerate(zip(images, labels, strict=True)):
        left = number * (width + _GAP_PX)
        sheet[head : head + image.shape[0], left : left + image.shape[1]] = image
        if label:
            sheet[:head, left : left + width] = _label_image(label, (head, width))
    return sheet


def _label_image(text: str, size: tuple[int, int]) -> np.ndarray:
    strip = np.full((*size, 3), round(255 * _BACKGROUND), np.uint8)
    cv2.putText(strip, text, (2, size[0] - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (25, 25, 25), 1, cv2.LINE_AA)
    return strip / 255.0
