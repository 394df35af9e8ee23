"""``seasonscapes delight`` of a mesh."""

from __future__ import annotations

import time as clock
from pathlib import Path

from seasonscapes.commands.console import found_sun_text, message, print_result, progress_bars
from seasonscapes.commands.mesh_hours import UNKNOWN, hour_on
from seasonscapes.commands.mesh_options import MeshFileFlags, MeshFlags
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.errors import InputError


def delight_mesh_file(
    source: Path,
    output: Path,
    hour: tuple[str | None, str | None],
    *,
    mesh: MeshFlags,
    files: MeshFileFlags,
    sky: SkyOptions,
    place: PlaceOptions,
    json: bool,
) -> None:
    """Take the light of an hour (``time`` and ``sun`` of the command line) out of a mesh's textures."""
    from seasonscapes.terrain.mesh_writing import save_mesh
    from seasonscapes.workflows.mesh_textures import save_delit_textures
    from seasonscapes.workflows.meshes import delight_mesh

    start = clock.perf_counter()
    model = sky.model()
    standing = mesh.place(place.folder(), allow_outside=place.allow_outside)
    loaded = mesh.load(
        source, allow_outside=place.allow_outside, place_needed=hour[0] not in (None, UNKNOWN), on=standing
    )
    files.check(output, loaded)
    when = hour_on(loaded, *hour, may_be_unknown=True)
    with progress_bars() as progress:
        around = mesh.around(model, place.folder(), loaded, standing)
        delit = delight_mesh(loaded, when, surroundings=around, options=mesh.delighting(), progress=progress)
    record = delit.facts | {"output": str(output), "rays": mesh.rays, "seed": mesh.seed}
    if files.textures is None:
        written = save_mesh(output, delit.mesh, bits=files.bits, facts=delit.facts)
    else:
        written = save_delit_textures(output, delit, kind=files.textures, bits=files.bits or 16)
    record |= {"files": [str(path) for path in written], "seconds": round(clock.perf_counter() - start, 2)}
    if "found_sun" in record:
        message(found_sun_text(record["found_sun"]))
    factors = ", ".join(f"{value:.2f}" for value in record["sky_factor"])
    message(f"skylight of the textures over the sky model's: {factors}")
    message(f"white of the textures counts as level ground of reflectance {mesh.white_reflectance:g} in that light")
    sun = record["sun"]
    facts = (
        f"sun {sun['azimuth_deg']:.1f}°/{sun['elevation_deg']:.1f}°; {100 * record['sunlit_share']:.0f} % in sun, "
        f"{100 * record['shaded_share']:.0f} % from skylight, {100 * record['completed_share']:.1f} % completed; "
        f"median σ {record['median_sigma']:.3f}; {record['seconds']} s"
    )
    print_result(record, [f"{output}  ({facts})"], as_json=json)


def require_no_scene_flags(
    place: PlaceOptions | None, *, image: Path | None, sensor_height_m: float | None, land_classes: int
) -> None:
    """`InputError` for flags of scenes beside a mesh."""
    about_files = PlaceOptions(workspace=place.workspace, allow_outside=place.allow_outside) if place else None
    if image is not None or sensor_height_m is not None or land_classes or place != about_files:
        cure = "leave out --image, --sensor-height-m, --land-classes, --mesher, --atlas and such"
        raise InputError("delight", "flags of scenes beside a mesh", cure=cure)
