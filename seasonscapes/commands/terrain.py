"""``seasonscapes terrain``."""

from __future__ import annotations

import resource
import sys
import time as clock
from dataclasses import asdict
from pathlib import Path

from seasonscapes.commands.talk import finish, say


def terrain(
    scene: str,
    *,
    mesher: str = "adaptive",
    max_error_m: float | None = None,
    refine: int | None = None,
    atlas: str = "planar",
    texel_m: float | None = None,
    workspace: Path | None = None,
    allow_outside: bool = False,
    json: bool = False,
) -> None:
    """Build a place's terrain and report how good it is.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    mesher
        adaptive (error-bounded), grid (every sample), poisson (an extra).
    max_error_m
        Vertical bound of the adaptive mesh in metres; default a fifteenth of the samples' spacing, at most 5.
    refine
        Interpolate the heights this many times finer first; default as far as it pays.
    atlas
        planar (top-down), relief (more texels on cliffs), xatlas (charts).
    texel_m
        Side of a texel in metres; default as fine as the imagery.
    workspace
        Folder for built artefacts; default SEASONSCAPES_WORKSPACE or the user's cache.
    allow_outside
        Let the scene file name data outside its folder.
    json
        Print one machine-readable record.
    """
    from seasonscapes.pipeline import MeshOptions, find_scene, load_place
    from seasonscapes.terrain.mesh import mesh_report
    from seasonscapes.workspace import Workspace, default_workspace

    start = clock.perf_counter()
    place = load_place(find_scene(scene), Workspace(workspace) if workspace else default_workspace(),
                       options=MeshOptions(mesher, max_error_m, refine, atlas, texel_m), allow_outside=allow_outside)  # fmt: skip
    seconds = clock.perf_counter() - start
    if place.fill.filled_cells:
        fill = place.fill
        say(f"filled {fill.filled_cells} cells without data ({100 * fill.share:.2f} %) in {fill.holes} holes, "
            f"the largest of {fill.largest_hole_cells} cells")  # fmt: skip
    report = mesh_report(place.terrain, place.elevation)
    # Linux counts in KiB, macOS in bytes.
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0) / 1e9
    record = {"scene": place.scene.name, "mesh": asdict(report), "atlas": asdict(place.atlas), "fill": asdict(place.fill),
              "frame": asdict(place.frame), "seconds": round(seconds, 2), "peak_gb": round(peak_gb, 3)}  # fmt: skip
    height, width = place.elevation.values.shape[:2]
    texels = place.atlas
    lines = [
        f"{place.scene.title or place.scene.name}: {width} × {height} samples, frame at {place.frame.latitude_deg:.5f}°, "
        f"{place.frame.longitude_deg:.5f}°",
        f"triangles  {report.triangles:,} ({100 * report.saved_ratio:.1f} % fewer than the raster's own grid)",
        f"vertical   RMSE {report.vertical_rmse_m:.2f} m, largest {report.vertical_max_m:.2f} m, over {report.samples:,} samples",
        f"texels     {texels.width_px} × {texels.height_px}, {texels.texel_p50_m:.2f} m on the surface "
        f"({texels.texel_p1_m:.2f} to {texels.texel_p99_m:.2f}), {100 * texels.utilization:.0f} % used, {texels.charts} charts",
        f"cost       {seconds:.1f} s, {peak_gb:.2f} GB at most",
    ]
    finish(record, lines, as_json=json)
