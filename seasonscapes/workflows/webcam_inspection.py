"""Webcams of a scene file: heights against the terrain, lists of their pictures, and their problems."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from seasonscapes.errors import InputError
from seasonscapes.scene import SceneFile, read_scene
from seasonscapes.workflows.place import find_scene

if TYPE_CHECKING:
    from seasonscapes.cameras.observation import ManifestRow, PictureProblem
    from seasonscapes.cameras.webcam import HeightCheck


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
        cure = "add [[webcam]] tables; scenes/bernese_highlands.toml shows how"
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
        A folder of pictures to list and check, and the pattern of paths below it.
    manifest
        Write the list of good pictures to this ``.csv``; or, without ``pictures``, check the pictures it lists.
    decode
        Open every picture in full.
    elevation
        A raster to check the heights against; default the scene's own.

    Returns
    -------
    WebcamInspection
        Heights, pictures and problems.
    """
    from seasonscapes.cameras.observation import (
        REFERENCE_LAYOUT,
        check_pictures,
        read_manifest,
        scan_folder,
        write_manifest,
    )

    heights = _heights(scene, elevation)
    rows, problems = [], []
    if pictures is not None:
        rows, problems = scan_folder(pictures, scene.webcams, layout=layout or REFERENCE_LAYOUT)
        problems += check_pictures(rows, pictures, scene.webcams, decode=decode)
        if manifest is not None:
            bad = {problem.path for problem in problems}
            write_manifest(manifest, [row for row in rows if row.path not in bad])
    elif manifest is not None:
        rows = read_manifest(manifest, allow_outside=scene.confinement.allow_outside)
        problems = check_pictures(rows, manifest.parent, scene.webcams, decode=decode)
    return WebcamInspection(scene, heights, rows, problems)


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
