"""The rest of a picture of which part is seen, from the other pictures of a fixed camera.

What the seen part tells is more than weather, haze and exposure (`fixed_camera.conditions_of`): how much of which other
day's snow, crowns and valley haze is in this one. The picture is the mean of the other ones, and a sum of what the model
says of it beyond that mean, of what the model left in the others, of them as they are, and of them relit to the asked
instant. The weights of the sum are found where the picture is seen, by ridge regression; they vary with distance and
height, as air, snow and leaves do. The ridge draws towards the mean, and not towards the model: the mean has the detail
that the model leaves in every picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.albedo.fixed_camera import FixedCamera, relit_at
from seasonscapes.albedo.picture_conditions import Conditions, ViewLight, picture_under
from seasonscapes.errors import NoUsablePixels

# Heights [quantiles of the near and of the far ground] between which weights are interpolated.
_KNOTS = (0.1, 0.4, 0.7, 0.95)
# Strength of the ridge as a share of the pictures' mean energy in a layer.
_RIDGE = 0.003
_SMALLEST_RIDGE = 1e-9
# Ground is far beyond the geometric middle of the range of distances; nearer than this it is never told apart [km].
_NEAREST_KM = 1e-3


@dataclass(frozen=True)
class SeenPart:
    """What is seen of a picture.

    Parameters
    ----------
    picture
        ``(n, 3)`` sRGB-encoded values of the terrain pixels.
    seen
        ``(n,)`` bool, where they are seen.
    light
        Light of its instant.
    conditions
        From its seen pixels; see `fixed_camera.conditions_of`.
    """

    picture: np.ndarray
    seen: np.ndarray
    light: ViewLight
    conditions: Conditions


def ground_layers(distance_km: np.ndarray, height_m: np.ndarray) -> np.ndarray:
    """Shares ``(n, 8)`` of the pixels in layers of near and far ground, low to high; each pixel's sum to 1.

    Parameters
    ----------
    distance_km, height_m
        ``(n,)`` of the ground in the pixels.
    """
    far = distance_km > np.sqrt(max(float(distance_km.min()), _NEAREST_KM) * float(distance_km.max()))
    groups = [group for group in (~far, far) if group.any()]
    layers = np.zeros((len(distance_km), len(_KNOTS) * len(groups)))
    for number, group in enumerate(groups):
        knots = np.quantile(height_m[group], _KNOTS)
        for k, unit in enumerate(np.eye(len(_KNOTS))):
            layers[group, number * len(_KNOTS) + k] = np.interp(height_m[group], knots, unit)
    return layers


def completed_picture(camera: FixedCamera, pictures: np.ndarray, part: SeenPart, layers: np.ndarray) -> np.ndarray:
    """Values ``(n, 3)`` of all terrain pixels of a picture of which part is seen, sRGB-encoded.

    Parameters
    ----------
    camera
        From K other pictures.
    pictures
        ``(K, n, 3)`` those pictures, in one exposure.
    part
        What is seen.
    layers
        ``(n, L)`` from `ground_layers`.

    Raises
    ------
    NoUsablePixels
        Where nothing is seen.
    """
    if not part.seen.any():
        raise NoUsablePixels("completed_picture: no pixel of the picture is seen")
    mean = pictures.mean(axis=0)
    model = picture_under(camera.ground, part.light, part.conditions.values)
    relit = np.stack([relit_at(camera, part.light, j) for j in range(len(pictures))])
    basis = np.concatenate(
        [mean[None], (model - mean)[None], camera.misfit, pictures - mean, relit - relit.mean(axis=0)]
    ).astype(np.float32)
    out = mean.copy()
    # Layers of near and of far ground share no pixel.
    for group in np.split(layers, layers.shape[1] // len(_KNOTS), axis=1):
        inside = np.flatnonzero(group.any(axis=1))
        seen = part.seen[inside]
        for c in range(3):
            rows = (basis[:, None, inside, c] * group[inside].T[None].astype(np.float32)).reshape(-1, len(inside))
            # float64 for the products: the rows are nearly alike.
            known = rows[:, seen].astype(np.float64)
            products = known @ known.T
            ridge = max(_RIDGE * float(np.mean(np.diag(products)[len(_KNOTS) :])), _SMALLEST_RIDGE)
            aim = known @ (part.picture - mean)[inside[seen], c]
            out[inside, c] += np.linalg.solve(products + ridge * np.eye(len(products)), aim) @ rows
    return np.clip(out, 0.0, 1.0)
