"""``seasonscapes path``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast, get_args

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_choice, check_range, parse_size
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions
from seasonscapes.commands.outputs import check_output
from seasonscapes.commands.waypoint_arguments import EXPECTED_WAYPOINT, parse_position, parse_waypoint
from seasonscapes.errors import InputError, InvalidPath


def path_command(
    scene: str,
    *,
    via: list[str] | None = None,
    reference: Path | None = None,
    kind: str = "refined",
    views: int | None = None,
    curve: str | None = None,
    turn: str = "smooth",
    look_at: str | None = None,
    closed: bool = False,
    clearance_m: float = 30.0,
    fov: float = 60.0,
    size: str | None = None,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/path.json"),
    map: Path | None = None,
    place: PlaceOptions | None = None,
    json: bool = False,
) -> None:
    """Make a camera path over a place: through waypoints, at constant speed, clear of the ground.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    via
        A waypoint, in order; repeat it for each. A camera of the scene, or LAT,LON,HEIGHT or LAT,LON,+ABOVE, with
        optional ,HEADING and ,PITCH; without, it looks towards the next one.
    reference
        Instead: a trajectory file of the SeasonScapes repository (waypoints, or all views).
    kind
        Of --reference: refined (its angles belong to its stretched grid) or unrefined.
    views
        How many, exactly; default 60, or what the reference file says.
    curve
        spline (smooth) or linear; default spline, or what the reference file says.
    turn
        How the camera turns: smooth or slerp.
    look_at
        LAT,LON or LAT,LON,HEIGHT that all views look at.
    closed
        Return to the first waypoint.
    clearance_m
        Keep at least so many metres above the ground; 0 follows the waypoints alone.
    fov
        Horizontal field of view in degrees, of waypoints given by position.
    size
        WIDTHxHEIGHT in pixels; default 1536x1024, or half of the reference's.
    output
        The path, a .json.
    map
        A .png map of it with a profile.
    json
        Print one machine-readable record.
    """
    options = place or PlaceOptions()
    check_output(output, (".json",))
    if map is not None:
        check_output(map, (".png",), flag="--map")
    check_range("--clearance-m", clearance_m, 0.0, 10_000.0)
    check_range("--fov", fov, 1.0, 169.0)
    check_range("--views", 60 if views is None else views, 2, 100_000)
    if (via is None) == (reference is None):
        raise InputError(
            "--via", "and --reference: give one of them", expected=f"--via {EXPECTED_WAYPOINT}, twice or more"
        )
    if via is not None and len(via) < 2:
        raise InputError(
            "--via", "a path needs at least two waypoints", got=via[0] if via else None, expected=EXPECTED_WAYPOINT
        )
    from seasonscapes.cameras.path_file import save_path
    from seasonscapes.cameras.reference_poses import Kind
    from seasonscapes.cameras.trajectory import CURVES, TURNS
    from seasonscapes.frames import enu_from_geodetic
    from seasonscapes.images import write_png8
    from seasonscapes.workflows import camera_paths as paths
    from seasonscapes.workflows.path_map import draw_path_map
    from seasonscapes.workflows.views import local_ground

    check_choice("--curve", curve or "spline", tuple(CURVES))
    check_choice("--kind", kind, get_args(Kind))
    check_choice("--turn", turn, tuple(TURNS))
    size_px = None if size is None else parse_size(size)
    with progress_bars() as progress:
        loaded = options.load(scene, progress, output=output)
    target = None if look_at is None else enu_from_geodetic(loaded.frame, *parse_position(loaded, look_at, "--look-at"))
    if reference is not None:
        path, meta = paths.reference_path(loaded, reference, kind=cast(Kind, kind), size_px=size_px)
        waypoints, interpolate = path.cameras, meta["count"] is not None
        count, shape = views or meta["count"], curve or meta["curve"]
    else:
        given = [parse_waypoint(loaded, text, size_px or (1536, 1024)) for text in via or ()]
        waypoints = paths.waypoint_cameras(loaded, given, fov_deg=fov, size_px=size_px or (1536, 1024))
        path, interpolate, count, shape = paths.CameraPath(waypoints, []), True, views or 60, curve or "spline"
    if interpolate:
        how = {"curve": shape, "turn": turn, "look_at": target, "closed": closed, "clearance_m": clearance_m}
        try:
            path = paths.camera_path(loaded, waypoints, count, **how)
        except InvalidPath as error:
            raise InputError("--via", str(error)) from None
    note = paths.path_record(loaded, path) | {"curve": shape, "turn": turn, "clearance_m": clearance_m}
    save_path(output, path.cameras, loaded.frame, note=note)
    record = {"output": str(output), **note, "map": None if map is None else str(map)}
    if map is not None:
        write_png8(map, draw_path_map(loaded, path.cameras, path.waypoints, local_ground(loaded)))
    facts = [f"{len(path.cameras)} views"]
    facts += [f"{note['length_m'] / 1000:.2f} km"] if note["length_m"] else []
    lowest = note["lowest_above_ground_m"]
    facts += [f"at least {lowest:.0f} m above the ground"] if lowest is not None else []
    facts += [f"lifted by up to {path.lifted_m:.0f} m"] if path.lifted_m > 0.0 else []
    print_result(record, [f"{output}  ({', '.join(facts)})", *([str(map)] if map else [])], as_json=json)
