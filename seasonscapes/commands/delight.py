"""``seasonscapes delight``."""

from __future__ import annotations

import time as clock
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range, parse_sun, parse_time
from seasonscapes.commands.console import found_sun_text, message, print_result, progress_bars
from seasonscapes.commands.delight_mesh import delight_mesh_file, require_no_scene_flags
from seasonscapes.commands.mesh_options import MESH_SUFFIXES, MeshFileFlags, MeshFlags
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.workflows.delighting import DelitScene, ImageTime
    from seasonscapes.workflows.place import Place


def delight_command(
    source: str,
    *,
    time: str | None = None,
    sun: str | None = None,
    image: Path | None = None,
    sensor_height_m: float | None = None,
    land_classes: int = 0,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/albedo.npz"),
    sky: SkyOptions | None = None,
    place: PlaceOptions | None = None,
    mesh: MeshFlags | None = None,
    files: MeshFileFlags | None = None,
    json: bool = False,
) -> None:
    """Take the light of its hour out of an image: sun, cast shadows, skylight and light from other slopes.

    Parameters
    ----------
    source
        A scene file with an image, or the name of a bundled scene; or a textured mesh (.glb, .gltf, .obj with MTL,
        .ply), whose textures or vertex colours are delit.
    time
        When the image was taken, ISO 8601; without an offset it is civil time at the place. unknown: its sun is found
        from shading and cast shadows, or the command says that it cannot be told.
    sun
        AZIMUTH,ELEVATION of the sun in degrees, where they are known and the time is not.
    image
        A georeferenced image to use instead of the scene's; with several dates this gives dated albedos.
    sensor_height_m
        Height of the aeroplane or satellite above sea level, if the air below it is still in the image. Orthophotos
        and mosaics are mostly corrected for it. From 9 km up all count alike.
    land_classes
        Find so many classes of land (2 to 20) in the image by their colours, and fit the response of each to direct
        light: forests and crops are not Lambertian. Default 0: all land is.
    output
        .npz (albedo, σ, source and visibility of the sun of each texel), .png or .exr (albedo and σ); all of
        them can be given back with --albedo DATE=FILE. Of a mesh: .glb, or the same kind of file with the same
        texture coordinates.
    json
        Print one machine-readable record.
    """
    start = clock.perf_counter()
    sky, options = sky or SkyOptions(), place or PlaceOptions()
    if Path(source).suffix.lower() in MESH_SUFFIXES:
        require_no_scene_flags(place, image=image, sensor_height_m=sensor_height_m, land_classes=land_classes)
        flags, written = mesh or MeshFlags(), files or MeshFileFlags()
        delight_mesh_file(
            Path(source), output, (time, sun), mesh=flags, files=written, sky=sky, place=options, json=json
        )
        return
    if mesh is not None or files is not None:
        raise InputError(source, "flags of meshes beside a scene", cure="leave out --at, --up, --crs, --bits and such")
    check_output(output, (".npz", ".png", ".exr"))
    if (time is None) == (sun is None):
        raise InputError("--time", "give either --time (or --time unknown) or --sun AZIMUTH,ELEVATION")
    if land_classes != 0:
        check_range("--land-classes", land_classes, 2, 20)
    angles = None if sun is None else parse_sun(sun)
    from seasonscapes.workflows.delighting import UNKNOWN, delit_imagery

    model = sky.model()
    with progress_bars() as progress:
        loaded = options.load(source, progress, output=output)
        when: ImageTime
        if angles is not None:
            when = angles
        else:
            assert time is not None  # one of them was given
            known = time != UNKNOWN
            when = parse_time(time, loaded.frame.latitude_deg, loaded.frame.longitude_deg) if known else UNKNOWN
        chosen: dict[str, Any] = {"sensor_height_m": sensor_height_m, "land_classes": land_classes}
        result = delit_imagery(loaded, when, image=image, sky=model, progress=progress, **chosen)
    record: dict[str, Any] = {
        "output": str(output),
        "scene": loaded.scene.name,
        **result.facts,
        "attribution": loaded.scene.attribution,
    }
    _write(output, loaded, result, record)
    record["seconds"] = round(clock.perf_counter() - start, 2)
    _tell(result)
    sun_text = f"sun {record['sun']['azimuth_deg']:.1f}°/{record['sun']['elevation_deg']:.1f}°"
    shares = (
        f"{100 * record['sunlit_share']:.0f} % in sun, {100 * record['shaded_share']:.0f} % from skylight, "
        f"{100 * record['completed_share']:.1f} % completed"
    )
    line = f"{output}  ({sun_text}; {shares}; median σ {record['median_sigma']:.3f}; {record['seconds']} s)"
    print_result(record, [line], as_json=json)


def _write(output: Path, place: Place, result: DelitScene, record: dict[str, Any]) -> None:
    import numpy as np

    from seasonscapes.images import write_exr
    from seasonscapes.workflows.edited_textures import texture_facts
    from seasonscapes.workflows.pictures import png_metadata, save_png

    if output.suffix.lower() == ".npz":
        result.save(output)
        return
    record["texture"] = texture_facts(place, "albedo")
    if result.day is not None:
        record["texture"]["date"] = result.day.isoformat()
    if output.suffix.lower() == ".exr":
        layers = {"": result.texture.values, "sigma": result.delit.sigma}
        write_exr(output, layers, header={"seasonscapes:provenance": record, "seasonscapes:units": "reflectance"})
    else:
        save_png(output, np.clip(result.texture.values, 0.0, 1.0), metadata=png_metadata(record))


def _tell(result: DelitScene) -> None:
    facts = result.facts
    if "found_sun" in facts:
        message(found_sun_text(facts["found_sun"]))
    if facts["shift_texels"] is not None:
        message(f"the image lay {facts['shift_texels'][0]:+.2f} rows, {facts['shift_texels'][1]:+.2f} columns off")
    factors = ", ".join(f"{value:.2f}" for value in facts["sky_factor"])
    message(f"skylight of the image over the sky model's: {factors}")
    if "class_exponents" in facts:
        classes = "; ".join("/".join(f"{value:.2f}" for value in row) for row in facts["class_exponents"])
        message(f"direct light counts by cos^k of its incidence, k (red/green/blue) of the classes: {classes}")
    message("exposure unknown: the image's white counts as level ground of the scene's reflectance_scale in that light")
