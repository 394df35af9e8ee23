"""Webcams of a scene file: heights against the terrain, lists of their pictures, and their problems."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import TYPE_CHECKING

from seasonscapes.errors import InputError
from seasonscapes.scene import SceneFile, read_scene
from seasonscapes.workflows.place import find_scene

if TYPE_CHECKING:
    from seasonscapes.cameras.observation import ManifestRow, PictureProblem
    from seasonscapes.cameras.webcam import HeightCheck

log = logging.getLogger(__name__)

# What a table needs at least, for people who have not written one yet.
_NEEDED_KEYS = (
    "id, latitude_deg, longitude_deg, height_m or above_ground_m, projection, width_px, height_px, horizontal_fov_deg, "
    "heading_deg, time_zone"
)


@dataclass(frozen=True)
class WebcamInspection:
    """What was found about the webcams of a scene.

    Parameters
    ----------
    scene
        The scene file.
    heights
        Each webcam's height against the terrain; empty without a raster.
    rows
        The pictures listed.
    problems
        Problems of single pictures.
    """

    scene: SceneFile
    heights: list[HeightCheck]
    rows: list[ManifestRow] = field(default_factory=list)
    problems: list[PictureProblem] = field(default_factory=list)


def scene_with_webcams(scene: str, *, allow_outside: bool = False) -> SceneFile:
    """Read a scene file that names webcams; `InputError` where it names none."""
    path = find_scene(scene)
    read = read_scene(path, allow_outside=allow_outside)
    if not read.webcams:
        cure = f"add a [[webcam]] table with {_NEEDED_KEYS}; docs/howto/scene-file.md shows one"
        raise InputError(path, "names no webcam", cure=cure)
    return read


def inspect_webcams(
    scene: SceneFile,
    *,
    pictures: Path | None = None,
    layout: str | None = None,
    manifest: Path | None = None,
    decode: bool = False,
    elevation: Path | str | None = None,
) -> WebcamInspection:
    """Check the webcams of a scene and their pictures.

    Parameters
    ----------
    scene
        With webcams.
    pictures, layout
        A folder of pictures to list and check, and the pattern of paths below it (`picture_names.scan_folder`).
    manifest
        Write the list of good pictures to this ``.csv``, with paths relative to its folder; or, without ``pictures``, check the pictures it lists.
    decode
        Open every picture in full.
    elevation
        A raster to check the heights against; default the scene's own.

    Returns
    -------
    WebcamInspection
        Heights, pictures and problems.
    """
    from seasonscapes.cameras.observation import check_pictures, read_manifest, write_manifest
    from seasonscapes.cameras.picture_names import scan_folder

    heights = _heights(scene, elevation)
    for check in heights:
        if not check.plausible:
            log.warning(
                "webcam %s: %s; its position, its height or their datum is wrong, or the heights are too coarse",
                check.webcam_id,
                check.verdict,
            )
    rows, problems = [], []
    if pictures is not None:
        rows, problems = scan_folder(pictures, scene.webcams, layout=layout)
        problems += check_pictures(rows, pictures, scene.webcams, decode=decode)
        if manifest is not None:
            bad = {problem.path for problem in problems}
            good = [row for row in rows if row.path not in bad]
            write_manifest(manifest, _relative_to_manifest(good, pictures, manifest, scene.confinement.allow_outside))
    elif manifest is not None:
        rows = read_manifest(manifest, allow_outside=scene.confinement.allow_outside)
        problems = check_pictures(rows, manifest.parent, scene.webcams, decode=decode)
    return WebcamInspection(scene, heights, rows, problems)


def _relative_to_manifest(
    rows: Sequence[ManifestRow], pictures: Path, manifest: Path, allow_outside: bool
) -> list[ManifestRow]:
    """Rows whose paths are relative to the manifest's folder, as readers of a manifest expect them."""
    folder, base = Path(os.path.abspath(pictures)), Path(os.path.abspath(manifest.parent))
    if not (allow_outside or folder.is_relative_to(base)):
        cure = f"write it into {pictures} or a folder above, or pass --allow-outside"
        raise InputError("--manifest", "lies beside its pictures, not above them", got=str(manifest), cure=cure)
    prefix = PurePath(os.path.relpath(folder, base))
    return [replace(row, path=(prefix / row.path).as_posix()) for row in rows]


def _heights(scene: SceneFile, elevation: Path | str | None) -> list[HeightCheck]:
    """Each webcam's height against the given or the scene's own raster; nothing where there is none."""
    from seasonscapes.cameras.webcam import check_heights
    from seasonscapes.terrain.crs import map_position
    from seasonscapes.terrain.raster import sample_raster
    from seasonscapes.workflows.terrain_building import read_scene_elevation

    if elevation is None and (scene.elevation is None or not scene.elevation.paths):
        return []
    bounds = scene.area.bounds_deg if scene.area is not None else None
    raster = read_scene_elevation(scene, elevation, bounds_deg=bounds)
    latitudes, longitudes = zip(*((webcam.latitude_deg, webcam.longitude_deg) for webcam in scene.webcams), strict=True)
    x, y = map_position(raster, list(latitudes), list(longitudes))
    return check_heights(scene.webcams, sample_raster(raster, x, y)[..., 0].tolist())
