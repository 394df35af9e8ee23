"""Detail of plain and amplified pictures beside photographs of the same place: how it falls off towards the pixel.

The webcam of Chamonix looks at a massif whose heights have 93 m. Each sunny photograph is rendered at its instant from its pose, of
one grey albedo, plain and amplified. Of the logarithm of luminance, what octaves of 2 to 4, 4 to 8 and 8 to 16 pixels hold is
related to that of 16 to 32 pixels, within the mask of the massif: so exposure, contrast and albedo of the whole do not count. The
distance of two pictures is the mean absolute difference of the three ratios' logarithms to base 2.
"""

from __future__ import annotations

import itertools
from datetime import date
from pathlib import Path

import cv2
import numpy as np
from realbench_cameras import FixedCase, Picture, chamonix
from scipy.ndimage import gaussian_filter

from seasonscapes.images import REC709_LUMINANCE, linear_from_srgb
from seasonscapes.terrain.surface import Texture
from seasonscapes.workflows.relight_session import still_session, view_at
from seasonscapes.workspace import Workspace

# Standard deviations [px] of the Gaussians between which the octaves lie.
_SIGMAS_PX = (0.5, 1.0, 2.0, 4.0, 8.0)
_GREY = 0.25


def falloff(luminance: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Logarithm to base 2 of the detail of three octaves, relative to that of the fourth, within a mask."""
    value = np.where(mask, np.log2(np.maximum(luminance, 1e-3 * np.median(luminance[mask]))), 0.0)

    def smooth(sigma: float) -> np.ndarray:
        return gaussian_filter(value, sigma) / np.maximum(gaussian_filter(mask.astype(float), sigma), 1e-6)

    levels = [smooth(sigma) for sigma in _SIGMAS_PX]
    bands = [np.sqrt(np.mean((fine - coarse)[mask] ** 2)) for fine, coarse in itertools.pairwise(levels)]
    return np.log2(np.array(bands[:-1]) / bands[-1])


def massif_mask(case: FixedCase, picture: Picture, coverage: np.ndarray) -> np.ndarray:
    """Terrain that is no skyline, no near ground and behind no cloud."""
    whole = cv2.erode((coverage > 0.999).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    return whole & picture.usable


def photograph_gains(data: Path, folder: Path, width_px: int, sheet: Path | None = None) -> dict[str, float]:
    """How much nearer to the photographs amplified pictures are than plain ones; empty where the data are not at hand."""
    if not (data / "chamonix-2013").is_dir():
        print(f"{data / 'chamonix-2013'}: not at hand, left out")
        return {}
    case = chamonix(data, Workspace(folder / "workspace"), width_px)
    grey = Texture(np.full((*case.place.texture_shape, 3), _GREY, np.float32), atlas_id=case.place.atlas_id)
    sunny = [each for each in case.pictures if each.sun_visible and each.season == "summer"]
    sessions = {
        name: still_session(
            case.place, case.camera, albedo=grey, base_day=date(2013, 7, 1), amplify=name == "amplified"
        )
        for name in ("plain", "amplified")
    }
    distances: dict[str, list[float]] = {name: [] for name in sessions}
    pictures = []
    for picture in sunny:
        seen = {}
        for name, session in sessions.items():
            view = view_at(session, picture.time)[0]
            seen[name] = view.radiance @ REC709_LUMINANCE
            mask = massif_mask(case, picture, view.coverage)
        seen["photograph"] = linear_from_srgb(picture.image) @ REC709_LUMINANCE
        curves = {name: falloff(luminance, mask) for name, luminance in seen.items()}
        for name in sessions:
            distances[name].append(float(np.abs(curves[name] - curves["photograph"]).mean()))
        print(picture.name, {name: np.round(curve, 2).tolist() for name, curve in curves.items()})
        if sheet is not None:
            shown = [np.clip(seen[name] / (2.5 * np.median(seen[name][mask])), 0.0, 1.0) ** (1 / 2.2) for name in seen]
            pictures.append(np.hstack(shown))
    if sheet is not None:
        cv2.imwrite(str(sheet), (255.0 * np.vstack(pictures)).astype(np.uint8))
    plain, amplified = (np.array(distances[name]) for name in ("plain", "amplified"))
    return {
        "photographs": len(sunny),
        "photograph_distance_plain_octaves": float(plain.mean()),
        "photograph_distance_amplified_octaves": float(amplified.mean()),
        "photograph_gain": float(1.0 - amplified.mean() / plain.mean()),
        "photograph_share_nearer": float((amplified < plain).mean()),
    }
