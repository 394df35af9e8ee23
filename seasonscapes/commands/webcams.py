"""``seasonscapes webcams``."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.talk import finish, say
from seasonscapes.errors import InputError


def webcams(
    scene: str,
    *,
    pictures: Path | None = None,
    layout: str | None = None,
    manifest: Path | None = None,
    decode: bool = False,
    elevation: Path | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    allow_outside: bool = False,
    json: bool = False,
) -> None:
    """List a scene's webcams, check their heights and pictures, and draw a map of what they see.

    Parameters
    ----------
    scene
        A scene file with [[webcam]] tables, or the name of a bundled scene (bernese_highlands).
    pictures
        A folder of pictures to list and check.
    layout
        How paths below that folder are made of {day}, {time} (the camera's clock) and {webcam};
        default {day}/{time}/360/{webcam}.jpg.
    manifest
        Write the list of good pictures to this .csv; or, without --pictures, check the pictures it lists.
    decode
        Open every picture in full, which also finds damage in the middle.
    elevation
        A raster to check the cameras' heights against; default the scene's own.
    output
        A .png map: where they stand, what they cover, headings.
    allow_outside
        Let the scene file name data outside its folder.
    json
        Print one machine-readable record.
    """
    from seasonscapes.cameras.observation import (
        REFERENCE_LAYOUT,
        check_pictures,
        read_manifest,
        scan_folder,
        write_manifest,
    )
    from seasonscapes.cameras.webcam import draw_webcam_map, webcam_heading_deg
    from seasonscapes.images import write_png8
    from seasonscapes.pipeline import find_scene
    from seasonscapes.scene import read_scene

    path = find_scene(scene)
    place = read_scene(path, allow_outside=allow_outside)
    if not place.webcams:
        raise InputError(path, "names no webcam", cure="add [[webcam]] tables; scenes/bernese_highlands.toml shows how")
    if output is not None and output.suffix.lower() != ".png":
        raise InputError("--output", "unknown kind of picture", got=str(output), expected="a name that ends in .png")
    source = elevation if elevation is not None else place.elevation and place.elevation.file
    heights = _heights(place, source)
    rows, problems = [], []
    if pictures is not None:
        rows, problems = scan_folder(pictures, place.webcams, layout=layout or REFERENCE_LAYOUT)
        problems += check_pictures(rows, pictures, place.webcams, decode=decode)
        if manifest is not None:
            bad = {problem.path for problem in problems}
            write_manifest(manifest, [row for row in rows if row.path not in bad])
            say(f"manifest: {manifest}")
    elif manifest is not None:
        rows = read_manifest(manifest)
        problems = check_pictures(rows, manifest.parent, place.webcams, decode=decode)
    if output is not None:
        write_png8(output, draw_webcam_map(place.webcams))
    counts = Counter(row.webcam for row in rows)
    record = {
        "scene": place.name,
        "webcams": [
            {**webcam.model_dump(), "heading_deg": webcam_heading_deg(webcam), "pictures": counts[webcam.id]}
            for webcam in place.webcams
        ],
        "heights": [asdict(check) for check in heights],
        "pictures": len(rows),
        "problems": [asdict(problem) for problem in problems],
    }
    verdicts = {check.webcam_id: check.verdict for check in heights}
    lines = [
        f"{webcam.id:<14} {webcam.latitude_deg:.5f}, {webcam.longitude_deg:.5f}  {webcam.projection:<15} "
        f"{webcam.horizontal_fov_deg:5.1f}° about {webcam_heading_deg(webcam):5.1f}°  "
        f"{verdicts.get(webcam.id, 'height unchecked')}{f'  {counts[webcam.id]} pictures' if rows else ''}"
        for webcam in place.webcams
    ]
    lines.append(
        f"{len(place.webcams)} webcams" + (f", {len(rows)} pictures, {len(problems)} problems" if rows else "")
    )
    lines += [f"{problem.kind}: {problem.path}: {problem.detail}" for problem in problems[:50]]
    if len(problems) > 50:
        lines.append(f"… and {len(problems) - 50} more problems; --json lists all")
    finish(record, lines, as_json=json)


def _heights(place, source) -> list:
    """Each webcam's height against the terrain; nothing where there is no raster."""
    from seasonscapes.cameras.webcam import check_heights
    from seasonscapes.terrain.raster import map_from_geodetic, read_elevation, sample_raster

    if source is None:
        return []
    bounds = place.area.bounds_deg if place.area is not None else None
    raster = read_elevation(source, bounds_deg=bounds)
    x, y = map_from_geodetic(
        raster.crs, [w.latitude_deg for w in place.webcams], [w.longitude_deg for w in place.webcams]
    )
    return check_heights(place.webcams, sample_raster(raster, x, y)[..., 0])
