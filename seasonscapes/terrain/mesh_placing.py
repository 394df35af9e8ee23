"""Where a mesh lies on Earth: from a file's own axes, or shifted map coordinates, to east-north-up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame, enu_from_geodetic
from seasonscapes.terrain.crs import geodetic_from_map, horizontal_crs
from seasonscapes.terrain.textured_mesh import turn_from_axes

# A mesh no wider than this in numbers that could be degrees, and so much taller than wide, is one in degrees.
_WIDEST_DEG, _TALLER = 5.0, 20.0
_LARGEST_M = 2.0e5


@dataclass(frozen=True)
class MeshPlacing:
    """How to place a mesh on Earth.

    Parameters
    ----------
    up
        ``"y"`` or ``"z"``: the file's axis that points upwards; ``None``: y of glTF, z of other files.
    at
        Latitude and longitude [deg] and height [m] of the middle of the mesh, if it has no map coordinates.
    north_deg
        Azimuth of the file's own north (+y, or −z where y is up), clockwise from true north [deg].
    crs
        Coordinate system of the file's coordinates (``EPSG:n`` or WKT).
    offset
        Added to the file's coordinates (east, north, height) to reach those of ``crs``.

    Raises
    ------
    InputError
        For values that contradict each other.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> ss.MeshPlacing(crs="EPSG:2056", offset=(2_641_000.0, 1_158_000.0, 1_200.0)).crs
    'EPSG:2056'
    """

    up: str | None = None
    at: tuple[float, float, float] | None = None
    north_deg: float = 0.0
    crs: str | None = None
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self):
        if self.up not in (None, "y", "z"):
            raise InputError("--up", "unknown axis", got=self.up, expected="y or z")
        if self.crs is not None and self.at is not None:
            raise InputError("--at", "and --crs both say where the mesh lies", cure="drop one of them")
        if self.crs is None and any(self.offset):
            raise InputError("--offset", "wants the coordinate system it is in", cure="--crs EPSG:n")
        if self.crs is not None and self.north_deg:
            raise InputError("--north", "and --crs both say where north is", cure="drop one of them")


def placed(
    positions: list[np.ndarray], placing: MeshPlacing, *, suffix: str, where: str
) -> tuple[list[np.ndarray], np.ndarray, LocalFrame, str]:
    """Convert positions in a file's axes to east-north-up.

    Parameters
    ----------
    positions
        ``(V, 3)`` each, of vertices that faces use.
    placing
        Where the mesh lies.
    suffix, where
        Of the file, and its name for messages.

    Returns
    -------
    positions
        ``(V, 3)`` float64 each, east-north-up [m] about the middle of the mesh.
    turn
        ``(3, 3)`` rotation of directions from the file's axes to east-north-up.
    frame
        Local frame.
    up
        ``"y"`` or ``"z"``.

    Raises
    ------
    InputError
        For a mesh in degrees without its coordinate system, coordinates outside the one given, or a mesh without size.
    """
    up = placing.up or ("y" if suffix in (".glb", ".gltf") else "z")
    axes = turn_from_axes(up, 0.0)
    level = [position @ axes.T + np.asarray(placing.offset) for position in positions]
    low = np.min([position.min(axis=0) for position in level], axis=0)
    high = np.max([position.max(axis=0) for position in level], axis=0)
    if placing.crs is None:
        _require_metres(low, high, where)
        latitude, longitude, height = placing.at or (0.0, 0.0, 0.0)
        turn, middle = turn_from_axes(up, placing.north_deg), 0.5 * (low + high) @ axes
        frame = LocalFrame(latitude, longitude, height)
        return [(position - middle) @ turn.T for position in positions], turn, frame, up
    middle = 0.5 * (low + high)
    _require_inside(placing.crs, low, high, where)
    latitude, longitude = (float(value) for value in geodetic_from_map(placing.crs, middle[0], middle[1]))
    frame = LocalFrame(latitude, longitude, float(middle[2]))
    moved = [enu_from_geodetic(frame, *geodetic_from_map(placing.crs, p[:, 0], p[:, 1]), p[:, 2]) for p in level]
    size = np.max([position.max(axis=0) for position in moved], axis=0)
    if not np.isfinite(size).all():
        raise InputError(where, "coordinates outside the coordinate system", got=placing.crs)
    return moved, _turn_at(placing.crs, middle, frame) @ axes, frame, up


def _require_metres(low: np.ndarray, high: np.ndarray, where: str) -> None:
    size = high - low
    if size.max() <= 0.0:
        raise InputError(where, "all vertices are the same point")
    degrees = abs(low[0]) <= 180.0 and abs(high[0]) <= 180.0 and abs(low[1]) <= 90.0 and abs(high[1]) <= 90.0
    if degrees and max(size[:2]) < _WIDEST_DEG and size[2] > _TALLER * max(size[:2]):
        text = f"{size[0]:.4g} × {size[1]:.4g} × {size[2]:.4g}"
        cure = "--crs EPSG:4326, or project the mesh to metres; or is another axis up (--up)?"
        raise InputError(where, "horizontal coordinates look like degrees", got=text, expected="metres", cure=cure)
    if size.max() > _LARGEST_M:
        expected = f"at most {_LARGEST_M / 1000:.0f} km"
        raise InputError(where, "the mesh is too large", got=f"{size.max() / 1000:.0f} km", expected=expected)


def _require_inside(crs: str, low: np.ndarray, high: np.ndarray, where: str) -> None:
    """`InputError` where coordinates lie outside the area for which a coordinate system is made."""
    system = horizontal_crs(crs)
    middle = 0.5 * (low + high)
    latitude, longitude = (float(value) for value in geodetic_from_map(crs, middle[0], middle[1]))
    area = system.area_of_use
    margin = 1.0
    inside = np.isfinite([latitude, longitude]).all() and (
        area is None
        or (
            area.south - margin <= latitude <= area.north + margin
            and area.west - margin <= longitude <= area.east + margin
        )
    )
    if not inside:
        got = f"{middle[0]:.6g}, {middle[1]:.6g}"
        cure = "give the shift of the coordinates as --offset X,Y,Z"
        raise InputError(where, f"coordinates outside the area of {crs}", got=got, cure=cure)
    if not system.is_geographic:
        degrees = abs(middle[0]) <= 180.0 and abs(middle[1]) <= 90.0
        if degrees and max((high - low)[:2]) < _WIDEST_DEG and (high - low)[2] > _TALLER * max((high - low)[:2]):
            raise InputError(where, f"horizontal coordinates look like degrees, not {crs}", cure="--crs EPSG:4326")


def _turn_at(crs: str, middle: np.ndarray, frame: LocalFrame) -> np.ndarray:
    """Rotation ``(3, 3)`` from map east, north and up to true ones at a point (grid convergence)."""
    step = 1e-4 if horizontal_crs(crs).is_geographic else 10.0
    latitude, longitude = geodetic_from_map(crs, middle[0] + np.array([0.0, 0.0]), middle[1] + np.array([0.0, step]))
    east, north, _ = np.diff(enu_from_geodetic(frame, latitude, longitude, frame.height_m), axis=0)[0]
    length = np.hypot(east, north)
    cosine, sine = north / length, east / length
    return np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
