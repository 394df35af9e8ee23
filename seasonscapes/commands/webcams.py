"""``seasonscapes webcams``."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from seasonscapes.commands.console import message, print_result
from seasonscapes.commands.outputs import check_output

if TYPE_CHECKING:
    from seasonscapes.workflows.webcam_inspection import WebcamInspection

_MOST_PROBLEMS = 50


def webcams_command(
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
    """List a scene's webcams, check their heights and pictures, and draw a map of their fields of view.

    Parameters
    ----------
    scene
        A scene file with [[webcam]] tables, or the name of a bundled scene (bernese_highlands).
    pictures
        A folder of pictures to list and check.
    layout
        How paths below that folder are made of {day} (2024-09-01 or 20240901), {time} (12-00, 12-00-00 or 120000 by the
        camera's clock; 120000Z is UTC), {webcam} (not needed where there is one) and {any}, such as
        '{webcam}/{day}_{time}.jpg'; default what fits most files.
    manifest
        Write the list of good pictures to this .csv, in the pictures' folder or above it; or, without --pictures, check
        the pictures it lists.
    decode
        Open every picture in full, which also finds damage in the middle.
    elevation
        A raster to check the cameras' heights against; default the scene's own.
    output
        A .png map: positions, fields of view, headings.
    allow_outside
        Trust the scene: data and pictures outside its folder, any raster format, servers.
    json
        Print one machine-readable record.
    """
    from seasonscapes.cameras.webcam import draw_webcam_map, webcam_heading_deg
    from seasonscapes.images import write_png8
    from seasonscapes.workflows.webcam_inspection import inspect_webcams, scene_with_webcams

    if output is not None:
        check_output(output, (".png",))
    if pictures is not None and manifest is not None:
        check_output(manifest, (".csv",), flag="--manifest")
    read = scene_with_webcams(scene, allow_outside=allow_outside)
    found = inspect_webcams(
        read, pictures=pictures, layout=layout, manifest=manifest, decode=decode, elevation=elevation
    )
    if pictures is not None and manifest is not None:
        message(f"manifest: {manifest}")
    if output is not None:
        write_png8(output, draw_webcam_map(read.webcams))
    counts = Counter(row.webcam for row in found.rows)
    record = {
        "scene": read.name,
        "webcams": [
            {**webcam.model_dump(), "heading_deg": webcam_heading_deg(webcam), "pictures": counts[webcam.id]}
            for webcam in read.webcams
        ],
        "heights": [asdict(check) for check in found.heights],
        "pictures": len(found.rows),
        "problems": [asdict(problem) for problem in found.problems],
    }
    print_result(record, _lines(found, counts), as_json=json)


def _lines(found: WebcamInspection, counts: Counter) -> list[str]:
    from seasonscapes.cameras.webcam import webcam_heading_deg

    rows, problems, webcams = found.rows, found.problems, found.scene.webcams
    verdicts = {check.webcam_id: check.verdict for check in found.heights}
    lines = [
        f"{webcam.id:<14} {webcam.latitude_deg:.5f}, {webcam.longitude_deg:.5f}  {webcam.projection:<15} "
        f"{webcam.horizontal_fov_deg:5.1f}° about {webcam_heading_deg(webcam):5.1f}°  "
        f"{verdicts.get(webcam.id, 'height unchecked')}{f'  {counts[webcam.id]} pictures' if rows else ''}"
        for webcam in webcams
    ]
    lines.append(f"{len(webcams)} webcams" + (f", {len(rows)} pictures, {len(problems)} problems" if rows else ""))
    lines += [f"{problem.kind}: {problem.path}: {problem.detail}" for problem in problems[:_MOST_PROBLEMS]]
    if len(problems) > _MOST_PROBLEMS:
        lines.append(f"… and {len(problems) - _MOST_PROBLEMS} more problems; --json lists all")
    return lines
