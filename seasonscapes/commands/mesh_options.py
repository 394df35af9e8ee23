"""Flags about textured meshes: where they lie, what they stand on, and how they are written."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_choice, check_range, parse_at
from seasonscapes.commands.console import message
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.albedo.delighting import DelightOptions
    from seasonscapes.sky.models import SkyModel
    from seasonscapes.terrain.textured_mesh import TexturedMesh
    from seasonscapes.workflows.meshes import MeshSurroundings
    from seasonscapes.workflows.place import Place
    from seasonscapes.workspace import Workspace


MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply")


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
    ground: bool = True
    """Whether there is such ground, or the mesh hangs in the air."""
    white_reflectance: float = 0.5
    """Where light is taken out: reflectance of level ground that is white (value 1) in the textures."""
    on: str | None = None
    """Scene on whose terrain the mesh stands, instead of level ground; --at without a height is on its ground."""
    rays: int = 256
    """Over the hemisphere of each texel or pixel, a power of two."""
    seed: int = 0
    """Equal seeds give equal results."""

    def place(self, workspace: Workspace, *, allow_outside: bool) -> Place | None:
        """The place that the mesh stands on."""
        from seasonscapes.workflows.place import load_place

        if self.on is not None and not self.ground:
            raise InputError("--on", "and --no-ground exclude each other", cure="drop one of them")
        return None if self.on is None else load_place(self.on, workspace, allow_outside=allow_outside)

    def load(self, path: Path, *, allow_outside: bool, place_needed: bool, on: Place | None = None) -> TexturedMesh:
        """The mesh, placed; what may not be meant is printed."""
        from seasonscapes.terrain.mesh_placing import MeshPlacing
        from seasonscapes.workflows.mesh_loading import load_mesh
        from seasonscapes.workflows.place import ground_height_m

        at = None
        if self.at is not None:
            latitude, longitude, height, _ = parse_at(self.at)
            if height is None and on is not None:
                height = ground_height_m(on, latitude, longitude, where="--at")
            at = (latitude, longitude, height or 0.0)
        elif (place_needed or on is not None) and self.crs is None:
            cure = "or --crs with --offset; or give the sun as --sun AZIMUTH,ELEVATION"
            raise InputError("--at", "missing: the sun of an hour depends on the place", expected="LAT,LON", cure=cure)
        placing = MeshPlacing(
            self.up, at, self.north, self.crs, three_numbers("--offset", self.offset) or (0.0, 0.0, 0.0)
        )
        mesh = load_mesh(path, placing, allow_outside=allow_outside)
        low, high = mesh.bounds_m
        size = " × ".join(f"{side:.3g}" for side in high - low)
        message(f"{path.name}: {size} m (east × north × up), {mesh.up} up, {len(mesh.textures)} textures")
        return mesh

    def delighting(self) -> DelightOptions:
        """How light is taken out."""
        from seasonscapes.albedo.delighting import DelightOptions

        check_range("--white-reflectance", self.white_reflectance, 0.01, 2.0)
        return DelightOptions(white_reflectance=self.white_reflectance)

    def around(self, sky: SkyModel, workspace: Workspace, mesh: TexturedMesh, on: Place | None) -> MeshSurroundings:
        """Ground and sky."""
        from seasonscapes.workflows.mesh_ground import scene_ground
        from seasonscapes.workflows.meshes import MeshSurroundings

        ground = self.ground_albedo if self.ground else None
        terrain = None if on is None else scene_ground(on, mesh)
        return MeshSurroundings(ground, sky, self.rays, workspace, self.seed, terrain)


def three_numbers(flag: str, text: str | None) -> tuple[float, float, float] | None:
    """``X,Y,Z``."""
    if text is None:
        return None
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(flag, "not three numbers", got=text, expected="X,Y,Z") from None
    return x, y, z


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class MeshFileFlags:
    """Of meshes: how their textures are written."""

    bits: int | None = None
    """Of textures, 8 or 16; default as in the file."""
    textures: str | None = None
    """png or exr: write the textures alone, into the folder --output."""

    def check(self, output: Path, mesh: TexturedMesh) -> None:
        """`InputError` for flags that are not valid, or a mesh that cannot be written so."""
        from seasonscapes.terrain.mesh_writing import require_writable

        if self.bits is not None:
            check_choice("--bits", str(self.bits), ("8", "16"))
        if self.textures is None:
            require_writable(output, mesh)
            return
        check_choice("--textures", self.textures, ("png", "exr"))
        if output.suffix:
            raise InputError("--output", "not a folder", got=str(output), expected="a folder for the textures")
