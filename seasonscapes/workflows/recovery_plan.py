"""How finely to recover an albedo: texels as fine as the photographs resolve the ground, and what that costs.

The finest texel worth having is what a pixel covers on the ground. It is enlarged until the atlas, which covers the whole
elevation raster, has no more texels than their light can be traced for in minutes. Pictures are reduced to a number of pixels
that is enough for such texels: a pixel that covers a tenth of a texel tells nothing that its neighbours do not.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.cameras.panorama import Panorama, split_panorama
from seasonscapes.cameras.pinhole import project

if TYPE_CHECKING:
    from seasonscapes.calibration.calibration_file import CalibratedWebcam
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.frames import LocalFrame
    from seasonscapes.terrain.surface import Raster
    from seasonscapes.workflows.photograph_files import PhotographSources
    from seasonscapes.workspace import Workspace

log = logging.getLogger(__name__)

# Texels and pixels whose light and footprints take minutes on two cores.
MOST_TEXELS = 500_000
MOST_PIXELS = 1_500_000
# Measured peaks of `albedo`: the program with its renderer, a texel, and a pixel of a picture.
_BYTES, _BYTES_PER_TEXEL, _BYTES_PER_PIXEL = 0.6e9, 2_500.0, 600.0
_AZIMUTHS, _DISTANCES, _REACH_M = 60, 500, 30_000.0


@dataclass(frozen=True)
class RecoveryPlan:
    """Sizes of a recovery.

    Parameters
    ----------
    texel_m
        Side of a texel [m].
    footprint_m
        What a pixel covers on the ground, median over the pictures as they are used [m]; NaN where it is unknown.
    texels
        Number of texels of the atlas.
    pixels
        Pixels of all pictures together, as they are used.
    """

    texel_m: float
    footprint_m: float
    texels: int
    pixels: int

    @property
    def memory_gb(self) -> float:
        """Estimated peak of memory [GB]."""
        return (_BYTES + _BYTES_PER_TEXEL * self.texels + _BYTES_PER_PIXEL * self.pixels) / 1e9

    def __str__(self) -> str:
        known = f"a pixel covers {self.footprint_m:.3g} m in the median"
        covers = known if np.isfinite(self.footprint_m) else "the cameras see no ground of these heights near them"
        return f"{self.texels / 1e3:.0f} thousand texels of {self.texel_m:.3g} m ({covers}), {self.pixels / 1e6:.2g} million pixels, about {self.memory_gb:.1f} GB"


def plan_recovery(
    scene: str,
    sources: PhotographSources,
    *,
    texel_m: float | None = None,
    workspace: Workspace | None = None,
    allow_outside: bool = False,
) -> RecoveryPlan:
    """Plan the recovery of an albedo from the photographs of a manifest.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene.
    sources
        Manifest and calibration records.
    texel_m
        Side of a texel that is asked for [m]; ``None`` chooses it.
    workspace
        Where the heights of a synthetic scene are kept; default `workspace.default_workspace`.
    allow_outside
        Let the scene file name rasters outside its folder.

    Returns
    -------
    RecoveryPlan
        Texels and pixels.

    Raises
    ------
    InputError
        Where the scene names no elevation, or a file is damaged.
    """
    from seasonscapes.cameras.observation import read_manifest
    from seasonscapes.terrain.placement import cell_sides_m
    from seasonscapes.workflows.place import scene_massif, scene_with_elevation
    from seasonscapes.workflows.terrain_building import read_scene_elevation
    from seasonscapes.workspace import default_workspace

    _, read = scene_with_elevation(scene, allow_outside=allow_outside)
    massif = scene_massif(read, workspace or default_workspace())
    bounds_deg = None if read.area is None else read.area.bounds_deg
    raster = read_scene_elevation(read, bounds_deg=bounds_deg) if massif is None else massif.elevation
    rows = read_manifest(sources.manifest, allow_outside=sources.allow_outside)
    records = _records([sources.calibration_of(row.webcam, row.time) for row in rows])
    views = [view for record in records.values() for view in _views_of(record)]
    width_m, height_m = cell_sides_m(raster)
    area_m2 = width_m * height_m * raster.values.shape[0] * raster.values.shape[1]
    footprints = [
        _clear_footprint_m(view, raster, record.frame) for record in records.values() for view in _views_of(record)
    ]
    footprint = float(np.nanmedian(footprints)) if np.isfinite(footprints).any() else float("nan")
    if texel_m is None:
        least = float(np.sqrt(area_m2 / MOST_TEXELS))
        texel_m = float(np.nanmax([least, footprint]))
    pixels = sum(view.width_px * view.height_px for view in views)
    return RecoveryPlan(texel_m, footprint, round(area_m2 / texel_m**2), pixels)


def _records(paths: Sequence[Path]) -> dict[Path, CalibratedWebcam]:
    from seasonscapes.calibration.calibration_file import read_calibration

    return {path: read_calibration(path) for path in sorted(set(paths)) if path.is_file()}


def _views_of(record: CalibratedWebcam) -> list[Camera]:
    """The pinhole views of a webcam's pictures, at the size at which they are used."""
    whole = split_panorama(record.view) if isinstance(record.view, Panorama) else [record.view]
    return [reduced_camera(view, MOST_PIXELS) for view in whole]


def _clear_footprint_m(camera: Camera, raster: Raster, frame: LocalFrame) -> float:
    """`footprint_m` of a camera that is lifted where it lies in these heights, as it is when its photographs are opened.

    However deep it lies: these are the scene's coarse heights, and where finer ones lie lower the camera may stand on them.
    """
    from seasonscapes.calibration.ground_clearance import clear_of_ground
    from seasonscapes.calibration.terrain_horizon import terrain_height
    from seasonscapes.frames import enu_from_geodetic, geodetic_from_enu

    latitude, longitude, _ = (float(each) for each in geodetic_from_enu(frame, camera.position_m))
    height_m = float(terrain_height([raster], [latitude], [longitude])[0])
    up_m = float(enu_from_geodetic(frame, latitude, longitude, height_m)[2])
    return footprint_m(clear_of_ground(camera, up_m), raster, frame)


def reduced_camera(camera: Camera, most_pixels: int) -> Camera:
    """The same view with no more pixels; the camera itself where it has no more."""
    scale = min(1.0, float(np.sqrt(most_pixels / (camera.width_px * camera.height_px))))
    if scale == 1.0:
        return camera
    width, height = round(camera.width_px * scale), round(camera.height_px * scale)
    across, along = width / camera.width_px, height / camera.height_px
    return replace(
        camera,
        width_px=width,
        height_px=height,
        fx=camera.fx * across,
        cx=camera.cx * across,
        fy=camera.fy * along,
        cy=camera.cy * along,
    )


def footprint_m(camera: Camera, raster: Raster, frame) -> float:
    """Side of a square as large as the ground in a pixel, median over the pixels that see ground [m]; NaN without any.

    Parameters
    ----------
    camera
        The view, its pose in ``frame``.
    raster
        Heights.
    frame
        Local frame.
    """
    from seasonscapes.calibration.terrain_horizon import terrain_profile
    from seasonscapes.cameras.pinhole import ray_directions

    middle = ray_directions(camera, [[camera.cx, camera.cy]])[0]
    half = np.degrees(np.arctan(0.5 * camera.width_px / camera.fx))
    azimuth = np.degrees(np.arctan2(middle[0], middle[1])) + np.linspace(-half, half, _AZIMUTHS)
    distance = np.geomspace(5.0, _REACH_M, _DISTANCES)
    points = terrain_profile([raster], frame, camera.position_m, azimuth, distance)
    slope = (points[..., 2] - camera.position_m[2]) / distance
    filled = np.where(np.isfinite(slope), slope, -np.inf)
    visible = np.isfinite(slope) & (filled >= np.maximum.accumulate(filled, axis=1))
    pixel, _ = project(camera, points)
    inside = (
        np.isfinite(pixel).all(-1) & (pixel >= 0.0).all(-1) & (pixel <= [camera.width_px, camera.height_px]).all(-1)
    )
    # Between neighbours in azimuth and distance that are both seen: their area in the picture and on the ground.
    seen = (visible & inside)[:-1, :-1] & visible[1:, :-1] & visible[:-1, 1:]
    across, along = pixel[1:, :-1] - pixel[:-1, :-1], pixel[:-1, 1:] - pixel[:-1, :-1]
    in_picture = np.abs(across[..., 0] * along[..., 1] - across[..., 1] * along[..., 0])
    wide = np.radians(azimuth[1] - azimuth[0]) * distance[:-1]
    deep = np.linalg.norm(np.diff(points, axis=1), axis=-1)[:-1]
    use = seen & (in_picture > 1e-6) & np.isfinite(deep)
    if not use.any():
        return float("nan")
    side = np.sqrt(wide * deep / np.where(use, in_picture, 1.0))[use]
    order = np.argsort(side)
    share = np.cumsum(in_picture[use][order])
    return float(side[order][np.searchsorted(share, 0.5 * share[-1])])
