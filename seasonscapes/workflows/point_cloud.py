"""The explicit coloured point cloud of a place, from which the Poisson mesher reconstructs its surface; and that mesh."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.images import atomic_path
from seasonscapes.workflows.albedo_sources import GREY_ALBEDO, IMAGE_DAY, synthetic_image
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.scene_water import scene_water
from seasonscapes.workflows.terrain_building import sample_spacing_m, samples_to_mesh

if TYPE_CHECKING:
    from seasonscapes.scene import Imagery
    from seasonscapes.terrain.surface import Raster


def write_point_cloud(place: Place, day: date, own: Path) -> list[Path]:
    """Write a place's point cloud (``points.ply``), its mesh (``mesh.ply``) and what they are (``cloud.json``).

    The points are the samples that were meshed, with the normals that screened Poisson reconstruction reads, coloured by the
    scene's image as it is, light and all. Both files are in the place's frame, east-north-up [m].

    Parameters
    ----------
    place
        The place.
    day
        Of several dated images the nearest in the year is taken.
    own
        Folder to write into.

    Returns
    -------
    list of pathlib.Path
        The files.
    """
    import trimesh

    from seasonscapes.terrain.mesh import mesh_report
    from seasonscapes.terrain.point_cloud import coloured_cloud, oriented_points, save_point_cloud

    assert place.scene.elevation is not None, "load_place refuses scenes without elevation"
    samples = samples_to_mesh(
        place.elevation, place.options, scene_water(place.scene, place.elevation, place.synthetic)
    )
    label, image = _image(place, day, sample_spacing_m(samples))
    cloud = coloured_cloud(oriented_points(samples), place.frame, image, grey=GREY_ALBEDO)
    origin = place.frame
    about = [
        f"seasonscapes {place.scene.name}, {place.scene.attribution}",
        f"east north up [m] about {origin.latitude_deg:.7f} {origin.longitude_deg:.7f} {origin.height_m:.3f} m",
    ]
    files = [own / "points.ply", own / "mesh.ply", own / "cloud.json"]
    save_point_cloud(files[0], cloud, comments=about)
    mesh = trimesh.Trimesh(place.terrain.vertices, place.terrain.faces, process=False)
    with atomic_path(files[1]) as temporary:
        mesh.export(str(temporary), file_type="ply")
    report = mesh_report(place.terrain, place.elevation)
    facts = {
        "points": len(cloud.position_m),
        "spacing_m": sample_spacing_m(samples),
        "colours": label,
        "mesher": place.options.mesher,
        "triangles": report.triangles,
        # Against the raster as it was read, before interpolation.
        "vertical_rmse_m": report.vertical_rmse_m,
        "vertical_max_m": report.vertical_max_m,
    }
    with atomic_path(files[2]) as temporary:
        temporary.write_text(json.dumps(facts, indent=1, default=float) + "\n", encoding="utf-8")
    return files


def _image(place: Place, day: date, spacing_m: float) -> tuple[str, Raster | None]:
    """Name and linear reflectance of the image nearest to a day; ``None`` without one."""
    from seasonscapes.terrain.imagery import read_imagery
    from seasonscapes.terrain.raster import bounds_geographic

    if place.synthetic is not None:
        return f"synthetic albedo of day {IMAGE_DAY}", synthetic_image(place, IMAGE_DAY)
    if not place.scene.images:
        return "grey: the scene names no image", None

    def days_off(imagery: Imagery) -> int:
        if imagery.day is None:
            return 0
        apart = abs(imagery.day.timetuple().tm_yday - day.timetuple().tm_yday)
        return min(apart, 365 - apart)

    imagery = min(place.scene.images, key=days_off)
    image = read_imagery(
        imagery.paths,
        bounds_deg=bounds_geographic(place.elevation),
        bands=tuple(imagery.bands) if imagery.bands else None,
        finest_m=0.5 * spacing_m,
        encoding=imagery.encoding,
        full_scale=imagery.full_scale,
        confinement=place.scene.confinement,
    )
    return imagery.label, replace(image, values=np.clip(image.values * imagery.reflectance_scale, 0.0, 1.0))
