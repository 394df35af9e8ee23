"""Rivals of guided completion, and how pictures are scored: all on what one sees, sRGB-encoded values in [0, 1]."""

from __future__ import annotations

import cv2
import numpy as np
from skimage.metrics import structural_similarity

from seasonscapes.texturing.smooth_fill import membrane_fill, push_pull

MEMBRANES = ("push_pull", "laplace")
TRANSFERS = ("histogram", "affine", "class_affine")


def fills(shown: np.ndarray, seen: np.ndarray, image: np.ndarray) -> dict[str, np.ndarray]:
    """Every rival's picture ``(H, W, 3)``; painted texels stay.

    Parameters
    ----------
    shown, seen
        The picture, known where ``seen``.
    image
        The satellite image ``(H, W, C)``, finite, encoded alike.
    """
    known = np.where(seen[..., None], shown, 0.0).astype(np.float32)
    bytes_, hole = np.round(known * 255.0).astype(np.uint8), (~seen).astype(np.uint8)
    made = {
        "constant": np.broadcast_to(shown[seen].mean(axis=0), shown.shape),
        "telea": cv2.inpaint(bytes_, hole, 3.0, cv2.INPAINT_TELEA) / 255.0,
        "navier_stokes": cv2.inpaint(bytes_, hole, 3.0, cv2.INPAINT_NS) / 255.0,
        "nearest": nearest(known, seen),
        "push_pull": push_pull(known, seen),
        "laplace": membrane_fill(known, seen),
        "histogram": histogram_transfer(image[..., :3], known, seen),
        "affine": class_affine(image, known, seen, classes=1),
        "class_affine": class_affine(image, known, seen, classes=6),
    }
    return {name: np.where(seen[..., None], shown, np.clip(picture, 0.0, 1.0)) for name, picture in made.items()}


def nearest(known: np.ndarray, seen: np.ndarray) -> np.ndarray:
    from scipy.ndimage import distance_transform_edt

    row, column = distance_transform_edt(~seen, return_distances=False, return_indices=True)
    return known[row, column]


def histogram_transfer(image: np.ndarray, known: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Each channel of the image through the monotone curve that gives it the painted texels' histogram."""
    rank = np.linspace(0.0, 1.0, 256)
    curves = [
        np.interp(image[..., c], np.quantile(image[..., c][seen], rank), np.quantile(known[..., c][seen], rank))
        for c in range(3)
    ]
    return np.stack(curves, -1)


def class_affine(image: np.ndarray, known: np.ndarray, seen: np.ndarray, *, classes: int) -> np.ndarray:
    """An affine map of colours for each of the image's k-means classes."""
    from sklearn.cluster import KMeans

    flat = image.reshape(-1, image.shape[2])
    label = np.zeros(len(flat), int)
    if classes > 1:
        some = flat[:: max(1, len(flat) // 20_000)]
        label = KMeans(classes, n_init=3, random_state=0).fit(some).predict(flat)
    basis = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
    result, known_flat, seen_flat = np.empty((len(flat), 3)), known.reshape(-1, 3), seen.ravel()
    for number in range(classes):
        here = label == number
        # A class that no camera saw takes what all classes have in common.
        use = here & seen_flat if (here & seen_flat).sum() > 20 else seen_flat
        result[here] = basis[here] @ np.linalg.lstsq(basis[use], known_flat[use], rcond=None)[0]
    return result.reshape(*seen.shape, 3)


# ---------------------------------------------------------------------------------------------- scores


def psnr(picture: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean((picture - truth)[where] ** 2)))


def ssim(picture: np.ndarray, truth: np.ndarray, where: np.ndarray) -> float:
    """Mean of the SSIM map over some texels only: masked frames must not count what was given."""
    field = structural_similarity(picture, truth, channel_axis=2, data_range=1.0, full=True)[1]
    return float(field.mean(axis=2)[where].mean())


def seam_excess(picture: np.ndarray, truth: np.ndarray, seen: np.ndarray, surface: np.ndarray) -> float:
    """Steps across the rim of the holes beyond the truth's own steps there, levels of 255."""
    steps = []
    for one, other in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        rim = (seen[one] != seen[other]) & surface[one] & surface[other]
        steps.append([np.abs(p[one] - p[other])[rim].mean() for p in (picture, truth)])
    mine, its = np.mean(steps, axis=0)
    return float(255.0 * (mine - its))


def sigma_quartiles(values: np.ndarray, sigma: np.ndarray, truth: np.ndarray, hole: np.ndarray) -> list[float]:
    """Predicted over true RMS error in each quartile of the predicted one."""
    error, predicted = np.mean((values - truth)[hole] ** 2, axis=1), sigma[hole]
    quartile = np.digitize(predicted, np.percentile(predicted, [25.0, 50.0, 75.0]))
    return [float(np.sqrt(np.mean(predicted[quartile == q] ** 2) / error[quartile == q].mean())) for q in range(4)]
