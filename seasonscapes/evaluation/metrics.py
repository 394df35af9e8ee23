"""How far a picture is from the truth: PSNR, SSIM, FLIP, colour angle. Masked honestly, or as the paper does.

Mode ``valid`` looks at pixels within the mask alone. Mode ``paper`` multiplies both pictures by the mask and scores the
whole frame, as the reference evaluation does: masked pixels then count as perfect, which adds ``-10 log10(share)`` dB to
PSNR. It is there to compare with published numbers, and the share that the mask leaves always goes with a score.
Pictures are display values (sRGB-encoded) in [0, 1].
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import cv2
import numpy as np

from seasonscapes.images import linear_from_srgb

MODES = ("valid", "paper")
# Wang, Bovik, Sheikh & Simoncelli 2004 (doi:10.1109/TIP.2003.819861): Gaussian window of 11 pixels, sigma 1.5.
_SSIM_WINDOW, _SSIM_SIGMA = 11, 1.5
# Darker than this (linear, of 1) a pixel's colour is noise.
_DARKEST = 1e-3


@dataclass(frozen=True)
class Score:
    """A picture against the truth.

    Parameters
    ----------
    psnr_db
        Peak signal to noise, 1 being the peak; infinite for equal pictures.
    ssim
        Mean structural similarity; in mode ``valid`` of windows wholly within the mask, NaN where there is none.
    flip
        Mean FLIP error (Andersson et al. 2020, doi:10.1145/3406183) at 67 pixels per degree, 0 to 1.
    colour_angle_deg
        Mean angle between linear colours, which no exposure changes; NaN where all is black.
    mask_share
        Of the frame that the mask leaves, 0 to 1.
    lpips
        LPIPS, where its weights are at hand.
    """

    psnr_db: float
    ssim: float
    flip: float
    colour_angle_deg: float
    mask_share: float
    lpips: float | None = None

    def record(self) -> dict[str, float]:
        """Plain numbers by name; without LPIPS where it was not measured."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def score(
    truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None = None, *, mode: str = "valid", lpips=None
) -> Score:
    """All metrics of a picture against the truth.

    Parameters
    ----------
    truth, picture
        ``(H, W, 3)`` sRGB-encoded, in [0, 1].
    mask
        ``(H, W)`` bool, True where it counts; left out, everywhere.
    mode
        ``valid`` or ``paper``.
    lpips
        A function of two pictures ``(H, W, 3)`` and of a mask, or ``None`` (`lpips.load_lpips`).

    Raises
    ------
    ValueError
        Shapes differ, values are outside [0, 1] or not finite, the mask leaves nothing, or the mode is unknown.
    """
    truth, picture, mask = _checked(truth, picture, mask, mode)
    return Score(
        psnr_db(truth, picture, mask, mode=mode),
        ssim(truth, picture, mask, mode=mode),
        flip(truth, picture, mask, mode=mode),
        colour_angle_deg(truth, picture, mask),
        float(mask.mean()),
        None
        if lpips is None
        else float(lpips(*_framed(truth, picture, mask, mode), mask if mode == "valid" else None)),
    )


def psnr_db(truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None = None, *, mode: str = "valid") -> float:
    """Peak signal-to-noise ratio [dB] of values whose peak is 1, ``-10 log10(mean squared error)``; see `score`.

    In mode ``paper`` it is the mean of the three channels' decibels, as the reference code has it.
    """
    truth, picture, mask = _checked(truth, picture, mask, mode)
    squared = (truth - picture) ** 2
    errors = np.array([squared[mask].mean()]) if mode == "valid" else (squared * mask[..., None]).mean(axis=(0, 1))
    return float("inf") if errors.min() == 0.0 else float(np.mean(-10.0 * np.log10(errors)))


def ssim_map(truth: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Structural similarity ``(H, W)`` of each pixel's window, mean over channels; zeros beyond the frame."""
    from skimage.metrics import structural_similarity

    rim = _SSIM_WINDOW // 2
    padded = [np.pad(image, ((rim, rim), (rim, rim), (0, 0))) for image in (truth, picture)]
    _, full = structural_similarity(
        *padded,
        gaussian_weights=True,
        sigma=_SSIM_SIGMA,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
        full=True,
    )
    return full[rim:-rim, rim:-rim].mean(axis=2)


def ssim(truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None = None, *, mode: str = "valid") -> float:
    """Mean structural similarity; see `score`. In mode ``valid``, of windows wholly within frame and mask; NaN if none."""
    truth, picture, mask = _checked(truth, picture, mask, mode)
    if mode == "paper":
        return float(ssim_map(truth * mask[..., None], picture * mask[..., None]).mean())
    whole = whole_windows(mask)
    return float(ssim_map(truth, picture)[whole].mean()) if whole.any() else float("nan")


def whole_windows(mask: np.ndarray, window_px: int = _SSIM_WINDOW) -> np.ndarray:
    """Pixels ``(H, W)`` bool whose square window lies wholly within the mask and the frame."""
    square = np.ones((window_px, window_px), np.uint8)
    return cv2.erode(mask.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0).astype(bool)


def flip_map(truth: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """FLIP error ``(H, W)``, 0 to 1, of two sRGB-encoded pictures seen at 67 pixels per degree."""
    import flip_evaluator

    pair = [np.ascontiguousarray(image, np.float32) for image in (truth, picture)]
    error, _, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False, computeMeanError=False)
    return np.asarray(error, np.float64).reshape(truth.shape[:2])


def flip(truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None = None, *, mode: str = "valid") -> float:
    """Mean FLIP error; see `score`. What lies beyond the mask cannot bleed in: there both pictures are made equal."""
    truth, picture, mask = _checked(truth, picture, mask, mode)
    error = flip_map(*_framed(truth, picture, mask, mode))
    return float(error[mask].mean() if mode == "valid" else error.mean())


def colour_angle_deg(truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Mean angle [deg] between the linear colours of pixels within the mask; NaN where all are black."""
    truth, picture, mask = _checked(truth, picture, mask, "valid")
    return angle_deg(linear_from_srgb(truth[mask]), linear_from_srgb(picture[mask]))


def angle_deg(truth: np.ndarray, other: np.ndarray) -> float:
    """Mean angle [deg] between linear colours ``(N, 3)`` of which neither is black; NaN where none is left."""
    truth, other = np.asarray(truth, np.float64), np.asarray(other, np.float64)
    norms = [np.linalg.norm(each, axis=1) for each in (truth, other)]
    kept = (norms[0] > _DARKEST) & (norms[1] > _DARKEST)
    if not kept.any():
        return float("nan")
    # By the tangent: the cosine of a small angle has no digits left.
    cross = np.linalg.norm(np.cross(truth[kept], other[kept]), axis=1)
    return float(np.degrees(np.arctan2(cross, (truth[kept] * other[kept]).sum(axis=1))).mean())


def _framed(truth: np.ndarray, picture: np.ndarray, mask: np.ndarray, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Pictures for metrics with wide windows: black beyond the mask (``paper``), or the truth there (``valid``)."""
    inside = mask[..., None]
    if mode == "paper":
        return truth * inside, picture * inside
    return truth, np.where(inside, picture, truth)


def _checked(
    truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None, mode: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if mode not in MODES:
        raise ValueError(f"score: mode {mode!r}, expected one of {', '.join(MODES)}")
    truth, picture = np.asarray(truth, np.float64), np.asarray(picture, np.float64)
    if truth.shape != picture.shape or truth.ndim != 3 or truth.shape[2] != 3:
        raise ValueError(f"score: pictures of shapes {truth.shape} and {picture.shape}, expected (H, W, 3) twice")
    mask = np.ones(truth.shape[:2], bool) if mask is None else np.asarray(mask, bool)
    if mask.shape != truth.shape[:2]:
        raise ValueError(f"score: a mask of shape {mask.shape} for pictures of {truth.shape[:2]}")
    if not mask.any():
        raise ValueError("score: the mask leaves no pixel")
    for name, values in (("truth", truth), ("picture", picture)):
        # Written so that NaN fails too.
        if not (values[mask].min() >= 0.0 and values[mask].max() <= 1.0):
            raise ValueError(f"score: values of the {name} are outside [0, 1]")
    # What lies beyond the mask may be anything, even NaN, and says nothing.
    return (*(np.clip(np.nan_to_num(values), 0.0, 1.0) for values in (truth, picture)), mask)
