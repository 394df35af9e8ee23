"""Flags about textured meshes: where they lie, what they stand on, and from where they are seen."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range, parse_at, parse_size
from seasonscapes.commands.console import message
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.sky.models import SkyModel
    from seasonscapes.terrain.textured_mesh import TexturedMesh
    from seasonscapes.workflows.meshes import MeshSurroundings, Time
    from seasonscapes.workspace import Workspace


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class MeshFlags:
    """Of meshes: where they lie and what they stand on."""

    at: str | None = None
    """Where the mesh lies: LAT,LON or LAT,LON,HEIGHT."""
    up: str | None = None
    """The file's axis that points upwards, y or z; default y of glTF, z of other files."""
    north: float = 0.0
    """Azimuth of the file's own north (+y, or -z where y is up), in degrees."""
    crs: str | None = None
    """Instead of --at: the coordinate system of the file's coordinates, such as EPSG:2056."""
    offset: str | None = None
    """Of --crs: EAST,NORTH,HEIGHT to add to the file's coordinates, as photogrammetry shifts them."""
    ground_albedo: float = 0.2
    """Of the level ground at the mesh's lowest point."""
    no_ground: bool = False
    """Let the mesh hang in the air."""
    rays: int = 256
    """Over the hemisphere of each texel or pixel, a power of two."""
    seed: int = 0
    """Equal seeds give equal results."""

    def load(self, path: Path, *, allow_outside: bool, place_needed: bool) -> TexturedMesh:
        """The mesh, placed; what may not be meant is printed."""
        from seasonscapes.terrain.mesh_placing import MeshPlacing
        from seasonscapes.workflows.meshes import load_mesh

        at = None
        if self.at is not None:
            latitude, longitude, height, _ = parse_at(self.at)
            at = (latitude, longitude, height or 0.0)
        elif place_needed and self.crs is None:
            cure = "or --crs with --offset; or give the sun as --sun AZIMUTH,ELEVATION"
            raise InputError("--at", "missing: the sun of an hour depends on the place", expected="LAT,LON", cure=cure)
        placing = MeshPlacing(self.up, at, self.north, self.crs, _numbers("--offset", self.offset) or (0.0, 0.0, 0.0))
        mesh = load_mesh(path, placing, allow_outside=allow_outside)
        low, high = mesh.bounds_m
        size = " × ".join(f"{side:.3g}" for side in high - low)
        message(f"{path.name}: {size} m (east × north × up), {mesh.up} up, {len(mesh.textures)} textures")
        return mesh

    def around(self, sky: SkyModel, workspace: Workspace) -> MeshSurroundings:
        """Ground and sky."""
        from seasonscapes.workflows.meshes import MeshSurroundings

        ground = None if self.no_ground else self.ground_albedo
        return MeshSurroundings(ground, sky, self.rays, workspace, self.seed)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class MeshViewFlags:
    """From where a mesh is seen; without any of these the camera frames it."""

    azimuth: float = 200.0
    """Where the camera stands, as seen from the mesh: degrees clockwise from north."""
    elevation: float = 20.0
    """How high it stands, in degrees."""
    eye: str | None = None
    """Instead: X,Y,Z of the camera in the file's own coordinates."""
    target: str | None = None
    """Of --eye: X,Y,Z of the point that it looks at."""
    fov: float = 35.0
    """Horizontal field of view, in degrees."""
    size: str = "1200x900"
    """WIDTHxHEIGHT in pixels."""

    def cameras(self, mesh: TexturedMesh, count: int = 1) -> list[Camera]:
        """One camera, or ``count`` evenly about the mesh."""
        from seasonscapes.workflows.mesh_views import camera_between, mesh_camera

        check_range("--fov", self.fov, 1.0, 169.0)
        check_range("--elevation", self.elevation, -89.0, 89.0)
        size_px = parse_size(self.size)
        eye, target = _numbers("--eye", self.eye), _numbers("--target", self.target)
        if (eye is None) != (target is None):
            raise InputError("--eye", "and --target go together", cure="give both or none")
        if eye is None or target is None:
            azimuths = [self.azimuth + 360.0 * number / count for number in range(count)]
            look = {"elevation_deg": self.elevation, "fov_deg": self.fov}
            return [mesh_camera(mesh, azimuth_deg=azimuth, size_px=size_px, **look) for azimuth in azimuths]
        if count > 1:
            raise InputError("--turntable", "and --eye name two ways to look", cure="drop one of them")
        return [camera_between(mesh, eye, target, fov_deg=self.fov, size_px=size_px)]


def _numbers(flag: str, text: str | None) -> tuple[float, float, float] | None:
    """``X,Y,Z``."""
    if text is None:
        return None
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(flag, "not three numbers", got=text, expected="X,Y,Z") from None
    return x, y, z


def hour_on(mesh: TexturedMesh, time: str | None, sun: tuple[float, float] | None, *, flag: str = "--time") -> Time:
    """The hour that flags name: an instant, whose reading is printed, or the sun's angles."""
    from seasonscapes.commands.arguments import parse_time

    if (time is None) == (sun is None):
        got = "neither" if time is None else "both"
        raise InputError(flag, "give an hour or the sun's angles", got=got, expected=f"{flag} T, or --sun AZ,EL")
    if sun is not None:
        return sun
    assert time is not None
    return parse_time(time, mesh.frame.latitude_deg, mesh.frame.longitude_deg)
