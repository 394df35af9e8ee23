"""What the pictures of a fixed camera give without light: rivals of realbench, in encoded values of equal exposure.

`blend` and the other rivals see the other pictures, and of the asked one its time and weather. What sees pixels of the
asked picture says so by its name: ``half_…`` are fitted on the half that is not scored, ``oracle_…`` where it is scored.
"""

from __future__ import annotations

import numpy as np
from realbench_kriging import kriged

from seasonscapes.images import linear_from_srgb, srgb_from_linear


def equally_exposed(pictures: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Pictures ``(K, n, 3)`` with one factor each and colour, so that medians agree; hidden pixels take the others' mean."""
    linear = linear_from_srgb(pictures)
    reference = np.median(linear, axis=0)
    out = np.empty_like(pictures)
    for k, (picture, mask) in enumerate(zip(linear, usable, strict=True)):
        gain = np.median(picture[mask], axis=0) / np.maximum(np.median(reference[mask], axis=0), 1e-4)
        out[k] = srgb_from_linear(picture / np.maximum(gain, 1e-4))
    weight = usable[..., None].astype(float)
    mean = (out * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1.0)
    return np.where(weight > 0.0, out, mean)


def rival_pictures(
    pictures: np.ndarray, usable: np.ndarray, sun: np.ndarray, known: np.ndarray, asked: tuple[np.ndarray, np.ndarray]
) -> dict[str, np.ndarray]:
    """Predictions ``(n, 3)`` by name.

    Parameters
    ----------
    pictures, usable
        ``(K, n, 3)`` encoded values and ``(K, n)`` masks of the other pictures.
    sun
        ``(K, 3)`` directions of their suns.
    known
        ``(K, f)`` what is known of each: sun, season, weather, its own sky.
    asked
        Direction of the sun ``(3,)`` and what is known ``(f,)`` of the asked picture.
    """
    equal = equally_exposed(pictures, usable)
    nearest = int(np.argmax(sun @ asked[0]))
    return {
        "nearest": equal[nearest],
        "mean": equal.mean(axis=0),
        "blend": np.clip(equal.mean(axis=0) + kriged(known, asked[1], equal - equal.mean(axis=0)), 0.0, 1.0),
    }


def seeing_pictures(
    equal: np.ndarray, truth: np.ndarray, valid: np.ndarray, half: np.ndarray, layers: np.ndarray
) -> dict[str, np.ndarray]:
    """Predictions ``(n, 3)`` that see pixels of the truth: linear blends and free embeddings.

    ``layers`` ``(n, L)`` are those of `ground_layers`, for the blend whose weights vary over the ground.
    """
    flat = equal.reshape(len(equal), -1)
    centre = flat.mean(axis=0)
    components = np.linalg.svd(flat - centre, full_matrices=False)[2][: min(4, len(equal) - 1)]
    found = {name: np.zeros_like(truth) for name in ("half_blend", "half_embedding", "half_layers")}
    for side in (False, True):
        seen, asked = valid & (half == side), half != side
        found["half_blend"][asked] = _combination(equal, truth, seen, ridge=0.5)[asked]
        basis = np.concatenate([centre[None], components]).reshape(-1, *truth.shape)
        found["half_embedding"][asked] = _combination(basis, truth, seen, ridge=1e-6)[asked]
        found["half_layers"][asked] = _layered(equal, truth, seen, layers)[asked]
    found["oracle_blend"] = _combination(equal, truth, valid, ridge=1e-6)
    return {name: np.clip(values, 0.0, 1.0) for name, values in found.items()}


def _layered(equal: np.ndarray, truth: np.ndarray, seen: np.ndarray, layers: np.ndarray) -> np.ndarray:
    """The blend of pictures ``(K, n, 3)`` with weights for each layer and colour, about their mean."""
    mean, out = equal.mean(axis=0), np.empty_like(truth)
    basis = np.concatenate([mean[None], equal - mean])
    for c in range(3):
        rows = (basis[:, None, :, c] * layers.T[None]).reshape(-1, len(truth))
        known = rows[:, seen]
        products = known @ known.T
        ridge = 0.003 * float(np.mean(np.diag(products)[layers.shape[1] :]))
        weights = np.linalg.solve(products + ridge * np.eye(len(products)), known @ (truth - mean)[seen, c])
        out[:, c] = mean[:, c] + weights @ rows
    return out


def _combination(basis: np.ndarray, truth: np.ndarray, seen: np.ndarray, *, ridge: float) -> np.ndarray:
    """The linear combination of pictures ``(K, n, 3)`` that is nearest to the truth where it is seen."""
    rows = basis[:, seen].reshape(len(basis), -1)
    weight = np.linalg.solve(rows @ rows.T + ridge * np.eye(len(basis)), rows @ truth[seen].ravel())
    return np.tensordot(weight, basis, 1)
