"""Cameras whose pixels the discs of a Gaussian model follow: a scene's, and the calibrated ones of a run."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.calibration.ground_clearance import clear_of_ground
from seasonscapes.cameras.panorama import Panorama, split_panorama
from seasonscapes.cameras.pinhole import view_in_frame
from seasonscapes.workflows.camera_ground import ground_below
from seasonscapes.workflows.place import Place, ground_or_nan
from seasonscapes.workflows.recovery_plan import reduced_camera
from seasonscapes.workflows.views import scene_cameras

if TYPE_CHECKING:
    from seasonscapes.cameras.pinhole import Camera

log = logging.getLogger(__name__)


def scene_disc_cameras(place: Place, size_px: tuple[int, int]) -> dict[str, Camera]:
    """The cameras that a scene file names, in pictures of a size, and its webcams as they are declared, with no more pixels.

    Webcams beside the heights are left out with a warning, and those in the ground are lifted out of it.
    """
    from seasonscapes.cameras.webcam import webcam_model

    found: dict[str, Camera] = {}
    if place.scene.cameras:
        found |= {f"camera {name}": camera for name, camera in scene_cameras(place, size_px=size_px).items()}
    for webcam in place.scene.webcams:
        ground_m = ground_or_nan(place, webcam.latitude_deg, webcam.longitude_deg)
        if not np.isfinite(ground_m):
            log.warning("discs do not follow webcam %s: it stands beside the heights", webcam.id)
            continue
        whole = webcam_model(webcam, place.frame, ground_m=ground_m)
        found |= _views(place, f"webcam {webcam.id}", whole, size_px[0] * size_px[1])
    return found


def calibrated_disc_cameras(place: Place, records: Sequence[Path], most_pixels: int) -> dict[str, Camera]:
    """The webcams of calibration records, without their distortion and with no more pixels each; a panorama as several views."""
    from seasonscapes.calibration.calibration_file import read_calibration

    found: dict[str, Camera] = {}
    for path in records:
        whole = view_in_frame(read_calibration(path).view, place.frame)
        found |= _views(place, path.name.removesuffix("_calibration.json"), whole, most_pixels)
    return found


def _views(place: Place, name: str, whole: Camera | Panorama, most_pixels: int) -> dict[str, Camera]:
    above = clear_of_ground(whole, ground_below(place, whole.position_m).up_m)
    views = split_panorama(above) if isinstance(above, Panorama) else [above]
    share = max(most_pixels // len(views), 1)
    names = [name] if len(views) == 1 else [f"{name}/{number}" for number in range(len(views))]
    return {each: reduced_camera(view, share) for each, view in zip(names, views, strict=True)}
