"""Flags that several verbs share, and what they stand for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.talk import check_range, parse_at, parse_size
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.pipeline import MeshOptions, Place
    from seasonscapes.scene import NamedCamera, SceneFile
    from seasonscapes.sky.models import SkyModel
    from seasonscapes.workspace import Workspace


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PlaceOptions:
    """How to read a scene and build its terrain."""

    mesher: str = "adaptive"
    """adaptive (error-bounded), grid (every sample), poisson (an extra)."""
    max_error_m: float | None = None
    """Vertical bound of the adaptive mesh in metres; default a fifteenth of the samples' spacing, at most 5."""
    refine: int | None = None
    """Interpolate the heights this many times finer first; default as far as it pays."""
    atlas: str = "planar"
    """planar (top-down), relief (more texels on cliffs), xatlas (charts)."""
    texel_m: float | None = None
    """Side of a texel in metres; default as fine as the imagery."""
    workspace: Path | None = None
    """Folder for built artefacts; default SEASONSCAPES_WORKSPACE or the user's cache."""
    allow_outside: bool = False
    """Let the scene file name data outside its folder."""

    def folder(self) -> Workspace:
        """The workspace that was asked for."""
        from seasonscapes.workspace import Workspace, default_workspace

        return default_workspace() if self.workspace is None else Workspace(self.workspace)

    def mesh(self) -> MeshOptions:
        """How to build the terrain."""
        from seasonscapes.pipeline import MeshOptions

        return MeshOptions(self.mesher, self.max_error_m, self.refine, self.atlas, self.texel_m)

    def load(self, scene: str) -> Place:
        """The place of a scene file or bundled scene."""
        from seasonscapes.pipeline import find_scene, load_place

        return load_place(find_scene(scene), self.folder(), options=self.mesh(), allow_outside=self.allow_outside)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SkyOptions:
    """Which sky."""

    sky: str = "clear"
    """A sky model's name (clear, alpine_winter, hazy, saharan_dust, overcast, hosek) or file."""
    turbidity: float | None = None
    """Replace the model's haze: 1 is pure air, 3 clear, 6 hazy."""
    visibility_km: float | None = None
    """Replace the model's haze by how far one sees."""
    ozone_du: float | None = None
    """Replace the model's ozone column, in Dobson units."""
    cloudiness: float | None = None
    """Share of the sky that clouds cover, 0 to 1."""

    def model(self) -> SkyModel:
        """The declared model with these flags applied."""
        from seasonscapes.sky.models import read_sky_model, with_overrides

        return with_overrides(
            read_sky_model(self.sky),
            turbidity=self.turbidity,
            visibility_km=self.visibility_km,
            ozone_du=self.ozone_du,
            cloudiness=self.cloudiness,
        )


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """From where to look."""

    camera: str | None = None
    """A camera that the scene names; the first one when left out."""
    at: str | None = None
    """A place of your own instead: LAT,LON or LAT,LON,HEIGHT or LAT,LON,+ABOVE_GROUND."""
    heading: float | None = None
    """Of --at: azimuth clockwise from north, in degrees."""
    pitch: float = 0.0
    """Of --at: elevation of the view, in degrees."""
    fov: float = 60.0
    """Of --at: horizontal field of view, in degrees."""
    size: str = "1536x1024"
    """WIDTHxHEIGHT in pixels."""

    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return parse_size(self.size)

    def chosen(self, scene: SceneFile) -> NamedCamera:
        """The scene's camera of that name, or the view that ``--at`` describes."""
        from seasonscapes.scene import NamedCamera

        if self.at is None:
            if self.heading is not None:
                raise InputError("--heading", "goes with --at", cure="name a place with --at LAT,LON,+ABOVE_GROUND")
            return scene.camera(self.camera)
        if self.camera is not None:
            raise InputError("--camera", "and --at name two views", cure="drop one of them")
        if self.heading is None:
            raise InputError(
                "--heading", "missing", expected="the azimuth to look at, clockwise from north, in degrees"
            )
        check_range("--heading", self.heading, -360.0, 360.0)
        check_range("--pitch", self.pitch, -90.0, 90.0)
        check_range("--fov", self.fov, 1.0, 169.0)
        latitude, longitude, height, above = parse_at(self.at)
        return NamedCamera(
            name="at",
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=height,
            above_ground_m=above,
            heading_deg=self.heading,
            pitch_deg=self.pitch,
            fov_deg=self.fov,
        )

    def pinhole(self, place: Place) -> Camera:
        """The camera of the chosen view."""
        from seasonscapes.pipeline import camera_for

        where = "--camera" if self.at is None else "--at"
        return camera_for(place, self.chosen(place.scene), size_px=self.size_px(), where=where)
