"""Flags that say from where a mesh is seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range, parse_size
from seasonscapes.commands.mesh_options import three_numbers
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.terrain.textured_mesh import TexturedMesh


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
        eye, target = three_numbers("--eye", self.eye), three_numbers("--target", self.target)
        if (eye is None) != (target is None):
            raise InputError("--eye", "and --target go together", cure="give both or none")
        if eye is None or target is None:
            azimuths = [self.azimuth + 360.0 * number / count for number in range(count)]
            look = {"elevation_deg": self.elevation, "fov_deg": self.fov}
            return [mesh_camera(mesh, azimuth_deg=azimuth, size_px=size_px, **look) for azimuth in azimuths]
        if count > 1:
            raise InputError("--turntable", "and --eye name two ways to look", cure="drop one of them")
        return [camera_between(mesh, eye, target, fov_deg=self.fov, size_px=size_px)]
