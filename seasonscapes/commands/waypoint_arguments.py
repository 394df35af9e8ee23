"""Waypoints and positions as text on the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from seasonscapes.commands.arguments import check_range, parse_at
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.workflows.camera_paths import Waypoint
    from seasonscapes.workflows.place import Place

EXPECTED_WAYPOINT = "a camera of the scene, or LAT,LON,HEIGHT or LAT,LON,+ABOVE, with optional ,HEADING and ,PITCH"


def parse_waypoint(place: Place, text: str, size_px: tuple[int, int]) -> Camera | Waypoint:
    """One ``--via`` flag: a named camera, or a position with optional angles."""
    from seasonscapes.workflows.camera_paths import Waypoint
    from seasonscapes.workflows.views import camera_for

    if text in {camera.name for camera in place.scene.cameras}:
        return camera_for(place, place.scene.camera(text), size_px=size_px, where="--via")
    parts = [part.strip() for part in text.split(",")]
    if not 2 <= len(parts) <= 5:
        raise InputError("--via", "not a waypoint", got=text, expected=EXPECTED_WAYPOINT)
    position = parse_position(place, ",".join(parts[:3]), "--via")
    try:
        angles = [float(part) for part in parts[3:]]
    except ValueError:
        raise InputError("--via", "not a heading or pitch", got=text, expected=EXPECTED_WAYPOINT) from None
    for name, angle, limit in zip(("heading", "pitch"), angles, (360.0, 90.0), strict=False):
        check_range(f"--via: {name}", angle, -limit, limit)
    return Waypoint(*position, *angles)


def parse_position(place: Place, text: str, flag: str) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and height [m] of a position on the command line."""
    from seasonscapes.workflows.place import ground_height_m

    try:
        latitude, longitude, height, above = parse_at(text, flag=flag)
    except InputError as error:
        raise InputError(flag, error.problem, got=error.got, expected=EXPECTED_WAYPOINT, cure=error.cure) from None
    if height is None:
        height = ground_height_m(place, latitude, longitude, where=flag) + (above or 0.0)
    return latitude, longitude, height
