"""Image quality metrics against a ground truth: PSNR, SSIM, FLIP, LPIPS and colour angle, with two ways of masking.

Mode ``valid`` evaluates only pixels within the mask. Mode ``paper`` multiplies both images by the mask and evaluates the
whole image, as the reference evaluation does: masked pixels then count as perfect, which adds ``-10 log10(share)`` dB to
PSNR, with ``share`` the fraction of pixels within the mask. LPIPS sees the images in [0, 1] there, where its network was
trained for [-1, 1]. That mode serves to compare with published values; every score reports the fraction. Images are display values (sRGB-encoded) in [0, 1].
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import cv2
import numpy as np

from seasonscapes.errors import NoUsablePixels
from seasonscapes.evaluation.lpips import Lpips
from seasonscapes.images import XYZ_FROM_REC709, linear_from_srgb

MODES = ("valid", "paper")
# Wang, Bovik, Sheikh & Simoncelli 2004 (doi:10.1109/TIP.2003.819861): Gaussian window of 11 pixels, sigma 1.5.
_SSIM_WINDOW, _SSIM_SIGMA = 11, 1.5
# Linear colours with a smaller norm are excluded from the colour angle, because noise dominates them.
_MIN_NORM = 1e-3


@dataclass(frozen=True)
class Score:
    """Metrics of an image against the ground truth.

    Parameters
    ----------
    psnr_db
        Peak signal-to-noise ratio for a peak of 1 [dB]; infinite for equal images.
    ssim
        Mean structural similarity; in mode ``valid`` over windows that lie entirely within the mask, NaN without any.
    flip
        Mean FLIP error (Andersson et al. 2020, doi:10.1145/3406183) at 67 pixels per degree, 0 to 1.
    colour_angle_deg
        Mean angle between linear colours [deg], independent of exposure; NaN if all pixels are black.
    mask_share
        Fraction of the image within the mask, 0 to 1.
    lpips
        LPIPS, or ``None`` if it was not computed.
    delta_e2000
        Mean colour difference CIEDE2000 (ISO/CIE 11664-6); 1 is about what an eye can tell. ``None`` if it was not
        computed.
    """

    psnr_db: float
    ssim: float
    flip: float
    colour_angle_deg: float
    mask_share: float
    lpips: float | None = None
    delta_e2000: float | None = None

    def record(self) -> dict[str, float]:
        """Return the metrics by name, without those that were not computed."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def score(
    truth: np.ndarray,
    picture: np.ndarray,
    mask: np.ndarray | None = None,
    *,
    mode: str = "valid",
    lpips: Lpips | None = None,
    colour_difference: bool = False,
) -> Score:
    """Compute all metrics of an image against the ground truth.

    Parameters
    ----------
    truth, picture
        Ground truth and image ``(H, W, 3)``, sRGB-encoded in [0, 1].
    mask
        ``(H, W)`` bool, True where pixels are evaluated; all pixels if omitted.
    mode
        Masking, ``valid`` or ``paper`` (see the module).
    lpips
        LPIPS function (`lpips.load_lpips`), or ``None`` to omit that metric.
    colour_difference
        Compute CIEDE2000 too, with colour-science, whose import takes a second.

    Returns
    -------
    Score
        The metrics.

    Raises
    ------
    NoUsablePixels
        If the mask contains no pixel.
    ValueError
        If the shapes differ, values within the mask are not finite or outside [0, 1], or the mode is unknown.

    Examples
    --------
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> truth = np.random.default_rng(0).random((32, 48, 3))
    >>> result = ss.score(truth, np.clip(truth + 0.1, 0.0, 1.0))
    >>> bool(15.0 < result.psnr_db < 25.0)
    True
    """
    truth, picture, mask = _validated(truth, picture, mask, mode)
    filled = _fill_masked(truth, picture, mask, mode)
    if mode == "paper":
        # `Lpips` maps [0, 1] to [-1, 1]; the reference evaluation gives [0, 1] to the network as it is.
        filled = tuple(0.5 + 0.5 * image for image in filled)
    return Score(
        psnr_db(truth, picture, mask, mode=mode),
        ssim(truth, picture, mask, mode=mode),
        flip(truth, picture, mask, mode=mode),
        colour_angle_deg(truth, picture, mask),
        float(mask.mean()),
        None if lpips is None else float(lpips(filled[0], filled[1], mask if mode == "valid" else None)),
        delta_e2000(truth, picture, mask) if colour_difference else None,
    )


def psnr_db(truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None = None, *, mode: str = "valid") -> float:
    """Compute the peak signal-to-noise ratio ``-10 log10(mean squared error)`` for a peak of 1.

    In mode ``paper`` the values of the three channels [dB] are averaged, as in the reference code.

    Parameters
    ----------
    truth, picture, mask, mode
        As in `score`.

    Returns
    -------
    float
        PSNR [dB]; infinite for equal images.
    """
    truth, picture, mask = _validated(truth, picture, mask, mode)
    squared = (truth - picture) ** 2
    errors = np.array([squared[mask].mean()]) if mode == "valid" else (squared * mask[..., None]).mean(axis=(0, 1))
    return float("inf") if errors.min() == 0.0 else float(np.mean(-10.0 * np.log10(errors)))


def ssim_map(truth: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Compute the structural similarity of the window around each pixel, with zero padding.

    Parameters
    ----------
    truth, picture
        Images ``(H, W, 3)``, sRGB-encoded in [0, 1].

    Returns
    -------
    ndarray
        SSIM ``(H, W)``, mean over the channels.
    """
    from skimage.metrics import structural_similarity

    margin = _SSIM_WINDOW // 2
    padded = [np.pad(image, ((margin, margin), (margin, margin), (0, 0))) for image in (truth, picture)]
    full = structural_similarity(
        *padded,
        gaussian_weights=True,
        sigma=_SSIM_SIGMA,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
        full=True,
    )[1]
    return full[margin:-margin, margin:-margin].mean(axis=2)


def ssim(truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None = None, *, mode: str = "valid") -> float:
    """Compute the mean structural similarity.

    Parameters
    ----------
    truth, picture, mask, mode
        As in `score`.

    Returns
    -------
    float
        SSIM; in mode ``valid`` over windows that lie entirely within image and mask, NaN without any.
    """
    truth, picture, mask = _validated(truth, picture, mask, mode)
    if mode == "paper":
        return float(ssim_map(truth * mask[..., None], picture * mask[..., None]).mean())
    whole = whole_windows(mask)
    return float(ssim_map(truth, picture)[whole].mean()) if whole.any() else float("nan")


def whole_windows(mask: np.ndarray, window_px: int = _SSIM_WINDOW) -> np.ndarray:
    """Return the pixels whose square window lies entirely within the mask and the image.

    Parameters
    ----------
    mask
        ``(H, W)`` bool.
    window_px
        Side of the window [px].

    Returns
    -------
    ndarray
        ``(H, W)`` bool.
    """
    square = np.ones((window_px, window_px), np.uint8)
    return cv2.erode(mask.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0).astype(bool)


def flip_map(truth: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Compute the FLIP error of each pixel at a viewing resolution of 67 pixels per degree.

    Parameters
    ----------
    truth, picture
        Images ``(H, W, 3)``, sRGB-encoded in [0, 1].

    Returns
    -------
    ndarray
        FLIP error ``(H, W)``, 0 to 1.
    """
    import flip_evaluator

    reference, test = (np.ascontiguousarray(image, np.float32) for image in (truth, picture))
    error, _, _ = flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False, computeMeanError=False)
    return np.asarray(error, np.float64).reshape(truth.shape[:2])


def flip(truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None = None, *, mode: str = "valid") -> float:
    """Compute the mean FLIP error.

    In mode ``valid`` both images are made equal outside the mask, so that the filters of FLIP propagate no error from
    there.

    Parameters
    ----------
    truth, picture, mask, mode
        As in `score`.

    Returns
    -------
    float
        FLIP error, 0 to 1.
    """
    truth, picture, mask = _validated(truth, picture, mask, mode)
    error = flip_map(*_fill_masked(truth, picture, mask, mode))
    return float(error[mask].mean() if mode == "valid" else error.mean())


def colour_angle_deg(truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Compute the mean angle between the linear colours of two images.

    Parameters
    ----------
    truth, picture, mask
        As in `score`.

    Returns
    -------
    float
        Angle [deg]; NaN if all pixels are black.
    """
    truth, picture, mask = _validated(truth, picture, mask, "valid")
    return angle_deg(linear_from_srgb(truth[mask]), linear_from_srgb(picture[mask]))


def delta_e2000(truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Compute the mean colour difference CIEDE2000 of two images, as colour-science defines it.

    Parameters
    ----------
    truth, picture, mask
        As in `score`.

    Returns
    -------
    float
        Difference; 0 for equal images, 100 between black and white.
    """
    import colour

    truth, picture, mask = _validated(truth, picture, mask, "valid")
    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    lab = [colour.XYZ_to_Lab(linear_from_srgb(image[mask]) @ XYZ_FROM_REC709.T, white) for image in (truth, picture)]
    return float(np.mean(colour.delta_E(*lab, method="CIE 2000")))


def angle_deg(truth: np.ndarray, other: np.ndarray) -> float:
    """Compute the mean angle between linear colours, without pairs in which one colour is black.

    Parameters
    ----------
    truth, other
        Linear colours ``(N, 3)``.

    Returns
    -------
    float
        Angle [deg]; NaN if no pair remains.
    """
    truth, other = np.asarray(truth, np.float64), np.asarray(other, np.float64)
    norms = [np.linalg.norm(colours, axis=1) for colours in (truth, other)]
    kept = (norms[0] > _MIN_NORM) & (norms[1] > _MIN_NORM)
    if not kept.any():
        return float("nan")
    # Arctangent, because the arccosine of a small angle loses all significant digits.
    cross = np.linalg.norm(np.cross(truth[kept], other[kept]), axis=1)
    return float(np.degrees(np.arctan2(cross, (truth[kept] * other[kept]).sum(axis=1))).mean())


def _fill_masked(truth: np.ndarray, picture: np.ndarray, mask: np.ndarray, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """Images for metrics with wide windows: outside the mask black (``paper``), or equal to the truth (``valid``)."""
    inside = mask[..., None]
    if mode == "paper":
        return truth * inside, picture * inside
    return truth, np.where(inside, picture, truth)


def _validated(
    truth: np.ndarray, picture: np.ndarray, mask: np.ndarray | None, mode: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if mode not in MODES:
        raise ValueError(f"score: got mode {mode!r}, expected one of {', '.join(MODES)}")
    truth, picture = np.asarray(truth, np.float64), np.asarray(picture, np.float64)
    if truth.shape != picture.shape or truth.ndim != 3 or truth.shape[2] != 3:
        raise ValueError(f"score: got images of shapes {truth.shape} and {picture.shape}, expected equal (H, W, 3)")
    mask = np.ones(truth.shape[:2], bool) if mask is None else np.asarray(mask, bool)
    if mask.shape != truth.shape[:2]:
        raise ValueError(f"score: got a mask of shape {mask.shape}, expected {truth.shape[:2]} as the images")
    if not mask.any():
        raise NoUsablePixels("score: the mask contains no pixel")
    for name, values in (("truth", truth), ("picture", picture)):
        # NaN fails this comparison too.
        if not (values[mask].min() >= 0.0 and values[mask].max() <= 1.0):
            raise ValueError(f"score: values of the {name} are not finite or outside [0, 1]")
    # Values outside the mask are arbitrary and may be NaN.
    truth, picture = (np.clip(np.nan_to_num(values), 0.0, 1.0) for values in (truth, picture))
    return truth, picture, mask
