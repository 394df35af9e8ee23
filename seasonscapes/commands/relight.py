"""``seasonscapes relight``."""

from __future__ import annotations

import time as clock
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range
from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.look_options import LookOptions
from seasonscapes.commands.mesh_hours import UNKNOWN, hour_on
from seasonscapes.commands.mesh_options import MESH_SUFFIXES, MeshFileFlags, MeshFlags
from seasonscapes.commands.mesh_view_options import MeshViewFlags
from seasonscapes.commands.options import SkyOptions
from seasonscapes.commands.outputs import check_file_or_folder
from seasonscapes.commands.when_options import WhenOptions
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.workflows.meshes import Time


def relight_command(
    source: Path,
    *,
    time: str | None = None,
    sun: str | None = None,
    when: WhenOptions | None = None,
    taken: str | None = None,
    taken_sun: str | None = None,
    turntable: int = 1,
    fps: float = 24.0,
    mesh: MeshFlags | None = None,
    view: MeshViewFlags | None = None,
    files: MeshFileFlags | None = None,
    sky: SkyOptions | None = None,
    look: LookOptions | None = None,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/relit.png"),
    workspace: Path | None = None,
    allow_outside: bool = False,
    device: str = "auto",
    json: bool = False,
) -> None:
    """Light a textured mesh anew: pictures of it, its lit textures, or a film of a day.

    Parameters
    ----------
    source
        .glb, .gltf, .obj with MTL, or .ply, with textures or vertex colours; they are taken for albedo, as
        `seasonscapes delight` writes them, unless --taken is given.
    time
        ISO 8601; without an offset it is civil time at the mesh. For a film give --from, --to and --every.
    sun
        AZIMUTH,ELEVATION of the sun in degrees, instead of an hour.
    taken
        When the textures were photographed: the light of that hour is taken out first. unknown: its sun is found.
    taken_sun
        AZIMUTH,ELEVATION of the sun when the textures were photographed, instead of --taken.
    turntable
        Pictures from so many sides, into a folder or an .mp4.
    fps
        Frames per second of a film.
    output
        .png or .exr: a picture. .mp4 or a folder: a film or turntable. A mesh (.glb, or as the source): it with its
        lit textures.
    workspace
        Folder for built artefacts; default SEASONSCAPES_WORKSPACE or the user's cache.
    allow_outside
        Let the mesh refer to files outside its folder.
    device
        auto, cuda or llvm.
    json
        Print one machine-readable record.
    """
    start = clock.perf_counter()
    flags, files, sky = mesh or MeshFlags(), files or MeshFileFlags(), sky or SkyOptions()
    view, look = view or MeshViewFlags(), look or LookOptions()
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows.mesh_textures import write_lit
    from seasonscapes.workflows.mesh_views import relit_pictures
    from seasonscapes.workflows.meshes import delight_mesh, light_mesh
    from seasonscapes.workflows.timelapse import FilmLook
    from seasonscapes.workspace import Workspace, default_workspace

    check_range("--turntable", turntable, 1, 3600)
    check_range("--fps", fps, 0.1, 240.0)
    film = FilmLook(look.metering(), fps=fps, look=look.look, white_balance=look.white_balance)
    check_file_or_folder(output)
    pictures = _pictures_wanted(output, files, film=when is not None, turntable=turntable)
    by_hour = time is not None or when is not None or taken not in (None, UNKNOWN)
    folder = default_workspace() if workspace is None else Workspace(workspace)
    use_backend(device)
    standing = flags.place(folder, allow_outside=allow_outside)
    loaded = flags.load(source, allow_outside=allow_outside, place_needed=by_hour, on=standing)
    if not pictures:
        files.check(output, loaded)
    cameras = view.cameras(loaded, turntable)
    before = None
    if taken is not None or taken_sun is not None:
        before = hour_on(loaded, taken, taken_sun, flags=("--taken", "--taken-sun"), may_be_unknown=True)
    if when is not None and (time is not None or sun is not None):
        raise InputError("--time", "and --from … --to name two sets of hours", cure="drop one of them")
    at = (loaded.frame.latitude_deg, loaded.frame.longitude_deg)
    hours: list[Time] = [hour_on(loaded, time, sun)] if when is None else [*when.instants(*at)]
    around = flags.around(sky.model(), folder, loaded, standing)
    with progress_bars() as progress:
        if before is None:
            message("the textures are taken for albedo; give --taken T if the light of an hour is in them")
        else:
            options = flags.delighting()
            loaded = delight_mesh(loaded, before, surroundings=around, options=options, progress=progress).mesh
        if pictures:
            written, record = relit_pictures(
                loaded, hours, cameras, output, film, surroundings=around, progress=progress
            )
        else:
            lit = light_mesh(loaded, hours[0], surroundings=around, progress=progress)
            written, record = write_lit(lit, output, look=film, textures=files.textures, bits=files.bits)
    record |= {"output": str(output), "files": [str(path) for path in written], "rays": flags.rays, "seed": flags.seed}
    record["seconds"] = round(clock.perf_counter() - start, 2)
    print_result(record, [f"{output}  ({len(written)} files, {record['seconds']} s)"], as_json=json)


def _pictures_wanted(output: Path, files: MeshFileFlags, *, film: bool, turntable: int) -> bool:
    """Whether pictures are asked for and not textures; `InputError` for flags that contradict each other."""
    if film and turntable > 1:
        raise InputError("--turntable", "and --from … --to both make films", cure="drop one of them")
    many, suffix = film or turntable > 1, output.suffix.lower()
    if files.textures is None and suffix not in MESH_SUFFIXES:
        expected = (".mp4", "") if many else (".png", ".exr")
        if suffix not in expected:
            text = ".mp4 or a folder" if many else ".png, .exr or a mesh; a folder with --textures"
            raise InputError("--output", "unknown kind of file", got=str(output), expected=text)
        if files.bits is not None:
            raise InputError("--bits", "is of textures", cure="leave it out, or write a mesh")
        return True
    if many:
        cure = "give an .mp4 or a folder for pictures, or one --time for textures"
        raise InputError("--output", "textures of many pictures", got=str(output), cure=cure)
    return False
