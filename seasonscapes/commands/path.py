"""``seasonscapes path``: a flight over a place, made from waypoints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from seasonscapes.commands.options import PlaceOptions
from seasonscapes.commands.talk import check_range, check_suffix, finish, parse_at, parse_size
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.cameras.trajectory import Curve, Ground
    from seasonscapes.pipeline import Place

_VIA = "a camera of the scene, or LAT,LON,HEIGHT or LAT,LON,+ABOVE, with ,HEADING and ,PITCH if you like"


def path(
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
    """Lay a path of views over a place: through waypoints, at constant speed, clear of the ground.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    via
        A waypoint, in order; say it again for each. A camera of the scene, or LAT,LON,HEIGHT or LAT,LON,+ABOVE, with
        ,HEADING and ,PITCH if you like; without, it looks towards the next one.
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
        LAT,LON or LAT,LON,HEIGHT to look at all the way.
    closed
        Return to the first waypoint.
    clearance_m
        Keep at least so many metres above the ground; 0 follows the waypoints alone.
    fov
        Horizontal field of view in degrees, of waypoints given by place.
    size
        WIDTHxHEIGHT in pixels; default 1536x1024, or half of the reference's.
    output
        The path, a .json.
    map
        A .png map of it with a profile.
    json
        Print one machine-readable record.
    """
    place = place or PlaceOptions()
    check_suffix(output, (".json",))
    if map is not None and map.suffix.lower() != ".png":
        raise InputError("--map", "unknown kind of file", got=str(map), expected="a name that ends in .png")
    check_range("--clearance-m", clearance_m, 0.0, 10_000.0)
    check_range("--fov", fov, 1.0, 169.0)
    if views is not None:
        check_range("--views", views, 2, 100_000)
    if (via is None) == (reference is None):
        raise InputError("--via", "and --reference: give one of them", expected=f"--via {_VIA}, twice or more")
    if via is not None and len(via) < 2:
        raise InputError("--via", "a path needs at least two waypoints", got=via[0] if via else None, expected=_VIA)
    import numpy as np

    from seasonscapes.cameras.path_file import read_reference_path, resize_camera, save_path
    from seasonscapes.cameras.trajectory import CURVES, TURNS, height_above_ground
    from seasonscapes.commands.path_map import draw_path_map
    from seasonscapes.images import write_png8

    for flag, value, known in (
        ("--curve", curve or "spline", CURVES),
        ("--turn", turn, TURNS),
        ("--kind", kind, ("refined", "unrefined")),
    ):
        if value not in known:
            raise InputError(flag, "unknown", got=value, expected=" or ".join(known))
    land = place.load(scene)
    given = None
    if reference is not None:
        given = read_reference_path(reference, land.frame, kind=kind)
        size_px = parse_size(size) if size else (given.cameras[0].width_px // 2, given.cameras[0].height_px // 2)
        waypoints = [resize_camera(camera, size_px) for camera in given.cameras]
    else:
        waypoints = waypoints_of(land, via or [], fov, parse_size(size or "1536x1024"))
    target = None if look_at is None else _place_of(land, look_at)
    ground, lift_m, line = ground_of(land), 0.0, None
    if given is not None and given.count is None:
        cameras = waypoints
    else:
        count = views or (60 if given is None else given.count) or 60
        line, lift_m, cameras = _flown(
            waypoints,
            count,
            curve or ("spline" if given is None else given.curve),
            turn,
            target,
            closed,
            (ground, clearance_m),
        )
    positions = np.array([camera.position_m for camera in cameras])
    above = height_above_ground(positions, ground, 0.0)
    note = {
        "scene": land.scene.name,
        "views": len(cameras),
        "length_m": line.length_m if line else None,
        "curve": curve or (given.curve if given else "spline"),
        "turn": turn,
        "clearance_m": clearance_m,
        "lifted_m": lift_m,
        "lowest_above_ground_m": float(np.nanmin(above)) if np.isfinite(above).any() else None,
    }
    save_path(output, cameras, land.frame, note=note)
    record = {"output": str(output), **note, "map": None if map is None else str(map)}
    if map is not None:
        write_png8(map, draw_path_map(land, cameras, waypoints if line is not None else [], ground))
    lowest = note["lowest_above_ground_m"]
    lines = [
        f"{output}  ({len(cameras)} views"
        + (f", {line.length_m / 1000:.2f} km" if line else "")
        + (f", at least {lowest:.0f} m above the ground" if lowest is not None else "")
        + (f", lifted by up to {lift_m:.0f} m" if lift_m > 0.0 else "")
        + ")"
    ]
    finish(record, [*lines, *([str(map)] if map else [])], as_json=json)


def _flown(
    waypoints: list[Camera],
    count: int,
    curve: str,
    turn: str,
    target: np.ndarray | None,
    closed: bool,
    clear_of: tuple[Ground, float],
) -> tuple[Curve, float, list[Camera]]:
    import numpy as np

    from seasonscapes.cameras.trajectory import curve_through, lift_above_ground, views_along

    waypoints = [*waypoints, waypoints[0]] if closed else waypoints
    lift_m = 0.0
    try:
        line = curve_through(np.array([each.position_m for each in waypoints]), curve=curve, closed=closed)
        if clear_of[1] > 0.0:
            line, lift_m = lift_above_ground(line, *clear_of)
        return line, lift_m, views_along(line, waypoints, count, turn=turn, look_at_m=target, closed=closed)
    except ValueError as error:
        raise InputError("--via", str(error)) from None


def waypoints_of(land: Place, specs: list[str], fov_deg: float, size_px: tuple[int, int]) -> list[Camera]:
    """Cameras of the ``--via`` flags."""
    import numpy as np

    from seasonscapes.cameras.pinhole import camera_at
    from seasonscapes.frames import angles_from_direction, local_axes
    from seasonscapes.pipeline import camera_for, camera_geodetic

    names = {camera.name for camera in land.scene.cameras}
    cameras, free = [], []
    for spec in specs:
        if spec in names:
            cameras.append(camera_for(land, land.scene.camera(spec), size_px=size_px, where="--via"))
            continue
        parts = [part.strip() for part in spec.split(",")]
        if not 2 <= len(parts) <= 5:
            raise InputError("--via", "not a waypoint", got=spec, expected=_VIA)
        latitude, longitude, height = _geodetic(land, ",".join(parts[:3]), "--via")
        angles = _angles(spec, parts[3:])
        free.append(len(cameras) if angles is None else -1)
        heading, pitch = angles or (0.0, 0.0)
        cameras.append(
            camera_at(
                land.frame,
                latitude,
                longitude,
                height,
                heading_deg=heading,
                pitch_deg=pitch,
                fov_deg=fov_deg,
                size_px=size_px,
            )
        )
    for number in (index for index in free if index >= 0):
        # Towards the next one; the last looks on as it came.
        start = min(number, len(cameras) - 2)
        latitude, longitude, height = camera_geodetic(land, cameras[number])
        towards = local_axes(land.frame, latitude, longitude) @ (
            cameras[start + 1].position_m - cameras[start].position_m
        )
        heading, pitch = (float(value) for value in angles_from_direction(towards))
        cameras[number] = camera_at(
            land.frame,
            latitude,
            longitude,
            height,
            heading_deg=heading,
            pitch_deg=float(np.clip(pitch, -30.0, 30.0)),
            fov_deg=fov_deg,
            size_px=size_px,
        )
    return cameras


def _angles(spec: str, parts: list[str]) -> tuple[float, float] | None:
    if not parts:
        return None
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        raise InputError("--via", "not a heading or pitch", got=spec, expected=_VIA) from None
    heading, pitch = numbers[0], numbers[1] if len(numbers) > 1 else 0.0
    check_range("--via: heading", heading, -360.0, 360.0)
    check_range("--via: pitch", pitch, -90.0, 90.0)
    return heading, pitch


def _geodetic(land: Place, text: str, where: str) -> tuple[float, float, float]:
    from seasonscapes.pipeline import ground_height_m

    try:
        latitude, longitude, height, above = parse_at(text)
    except InputError as error:
        raise InputError(where, error.problem, got=error.got, expected=_VIA, cure=error.cure) from None
    if height is None:
        height = ground_height_m(land, latitude, longitude, where=where) + (above or 0.0)
    return latitude, longitude, height


def _place_of(land: Place, text: str) -> np.ndarray:
    from seasonscapes.frames import enu_from_geodetic

    return enu_from_geodetic(land.frame, *_geodetic(land, text, "--look-at"))


def ground_of(land: Place) -> Ground:
    """Heights of a place's ground in the local frame, NaN off its raster."""
    import numpy as np

    from seasonscapes.frames import enu_from_geodetic, geodetic_from_enu
    from seasonscapes.terrain.raster import map_from_geodetic, sample_raster

    def heights(places: np.ndarray) -> np.ndarray:
        up = np.zeros(len(places))
        # The vertical of a place is not the frame's: its height moves it sideways a little.
        for _ in range(2):
            latitude, longitude, _ = geodetic_from_enu(land.frame, np.column_stack([places, up]))
            height = sample_raster(land.elevation, *map_from_geodetic(land.elevation.crs, latitude, longitude))[..., 0]
            up = enu_from_geodetic(land.frame, latitude, longitude, np.nan_to_num(height))[..., 2]
        return np.where(np.isfinite(height), up, np.nan)

    return heights
