"""``seasonscapes terrain``."""

from __future__ import annotations

import resource
import sys
import time as clock
from dataclasses import asdict

from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions


def terrain_command(scene: str, *, options: PlaceOptions | None = None, json: bool = False) -> None:
    """Build a place's terrain and report its triangles, vertical errors and texel density.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    json
        Print one machine-readable record.
    """
    from seasonscapes.terrain.mesh import mesh_report

    start = clock.perf_counter()
    with progress_bars() as progress:
        place = (options or PlaceOptions()).load(scene, progress)
    seconds = clock.perf_counter() - start
    if place.fill.filled_cells:
        fill = place.fill
        message(
            f"filled {fill.filled_cells} cells without data ({100 * fill.share:.2f} %) in {fill.holes} holes, "
            f"the largest of {fill.largest_hole_cells} cells"
        )
    report = mesh_report(place.terrain, place.elevation)
    # Linux counts in KiB, macOS in bytes.
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0) / 1e9
    record = {
        "scene": place.scene.name,
        "mesh": asdict(report),
        "atlas": asdict(place.atlas),
        "fill": asdict(place.fill),
        "frame": asdict(place.frame),
        "seconds": round(seconds, 2),
        "peak_gb": round(peak_gb, 3),
    }
    height, width = place.elevation.values.shape[:2]
    atlas = place.atlas
    lines = [
        f"{place.scene.title or place.scene.name}: {width} × {height} samples, frame at {place.frame.latitude_deg:.5f}°, "
        f"{place.frame.longitude_deg:.5f}°",
        f"triangles  {report.triangles:,}, {report.triangles / report.grid_triangles:.2f} times the raster's own grid",
        f"vertical   RMSE {report.vertical_rmse_m:.2f} m, largest {report.vertical_max_m:.2f} m, "
        f"over {report.samples:,} samples",
        f"texels     {atlas.width_px} × {atlas.height_px}, {atlas.texel_p50_m:.2f} m on the surface "
        f"({atlas.texel_p1_m:.2f} to {atlas.texel_p99_m:.2f}), {100 * atlas.utilization:.0f} % used, "
        f"{atlas.charts} charts",
        f"cost       {seconds:.1f} s, {peak_gb:.2f} GB at most",
    ]
    print_result(record, lines, as_json=json)
