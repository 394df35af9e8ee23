"""What a scene file says: the facts of a place. No settings of any stage live here."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from seasonscapes.cameras.pinhole import Camera, camera_at
from seasonscapes.cameras.webcam import Webcam
from seasonscapes.declaration import Declaration, InputError, read_declaration
from seasonscapes.frames import STANDARD_REFRACTION_K, LocalFrame

VerticalDatum = Literal["ellipsoidal", "EGM96", "EGM2008", "LN02", "NN2000", "NAVD88", "EVRF", "local"]
Latitude = Field(ge=-90.0, le=90.0)
Longitude = Field(ge=-180.0, le=180.0)


class Origin(Declaration):
    """Where the local frame touches the Earth. Left out of the file, it is the middle of the elevation raster."""

    latitude_deg: float = Latitude
    longitude_deg: float = Longitude
    height_m: float = Field(default=0.0, ge=-500.0, le=9000.0)


class Area(Declaration):
    """The part of the rasters to use, in WGS 84."""

    west_deg: float = Longitude
    south_deg: float = Latitude
    east_deg: float = Longitude
    north_deg: float = Latitude

    @model_validator(mode="after")
    def _ordered(self) -> Area:
        if not (self.west_deg < self.east_deg and self.south_deg < self.north_deg):
            raise ValueError("expected west_deg < east_deg and south_deg < north_deg")
        if self.east_deg - self.west_deg > 3.0 or self.north_deg - self.south_deg > 3.0:
            raise ValueError("spans more than 3°; one sun and one sky no longer fit it, choose a smaller area")
        return self

    @property
    def bounds_deg(self) -> tuple[float, float, float, float]:
        return self.west_deg, self.south_deg, self.east_deg, self.north_deg


class SyntheticElevation(Declaration):
    """A place made by this package's own code; its albedo is known for every date."""

    kind: Literal["alpine"] = "alpine"
    seed: int = Field(default=1912, ge=0)
    size_m: float = Field(default=12000.0, ge=2000.0, le=12000.0)
    spacing_m: Literal[15.0, 30.0, 60.0] = 15.0
    detail_m: float = Field(default=3.75, ge=0.5, le=500.0)

    @model_validator(mode="after")
    def _whole_cells(self):
        if self.size_m % (2.0 * self.spacing_m):
            raise ValueError(f"size_m: got {self.size_m:g}, expected an even number of cells of {self.spacing_m:g} m")
        return self


class Elevation(Declaration):
    """The raster of heights: a file, or a synthetic place."""

    file: str | None = None
    band: int | None = Field(default=None, ge=1)
    synthetic: SyntheticElevation | None = None
    max_hole_share: float = Field(default=0.25, ge=0.0, le=1.0)

    @model_validator(mode="after")
    def _one_source(self) -> Elevation:
        if (self.file is None) == (self.synthetic is None):
            raise ValueError("give either 'file' or a table 'synthetic'")
        return self


class Imagery(Declaration):
    """A colour image of the ground, taken as its albedo."""

    file: str
    encoding: Literal["srgb", "linear"] = "srgb"
    full_scale: float = Field(default=255.0, gt=0.0)
    bands: list[int] | None = Field(default=None, min_length=1, max_length=3)
    # Pictures for the eye are stretched: their white is not a reflectance of 1. 0.5 brings an Alpine mosaic's
    # meadows and rock to the reflectances that field spectra have.
    reflectance_scale: float = Field(default=0.5, gt=0.0, le=2.0)


class NamedCamera(Declaration):
    """A view of the place, as one would tell it a photographer."""

    name: str = Field(min_length=1)
    latitude_deg: float = Latitude
    longitude_deg: float = Longitude
    height_m: float | None = Field(default=None, ge=-500.0, le=100_000.0)
    above_ground_m: float | None = Field(default=None, gt=0.0, le=100_000.0)
    heading_deg: float = Field(ge=-360.0, le=360.0)
    pitch_deg: float = Field(default=0.0, ge=-90.0, le=90.0)
    roll_deg: float = Field(default=0.0, ge=-180.0, le=180.0)
    fov_deg: float = Field(default=60.0, gt=0.0, lt=170.0)

    @model_validator(mode="after")
    def _one_height(self) -> NamedCamera:
        if (self.height_m is None) == (self.above_ground_m is None):
            raise ValueError("give either 'height_m' (in the scene's vertical datum) or 'above_ground_m'")
        return self


class SceneFile(Declaration):
    """A scene file. ``camera`` and ``webcam`` are arrays of tables, ``[[camera]]`` and ``[[webcam]]``.

    A file without ``elevation`` tells where a place and its webcams are; terrain needs a raster.
    """

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")
    title: str = ""
    attribution: str
    vertical_datum: VerticalDatum
    refraction_k: float = Field(default=STANDARD_REFRACTION_K, ge=0.0, lt=0.9)
    origin: Origin | None = None
    area: Area | None = None
    elevation: Elevation | None = None
    imagery: Imagery | None = None
    cameras: list[NamedCamera] = Field(default_factory=list, alias="camera")
    webcams: list[Webcam] = Field(default_factory=list, alias="webcam")

    @model_validator(mode="after")
    def _unique(self) -> SceneFile:
        for kind, names in (("cameras", [c.name for c in self.cameras]), ("webcams", [w.id for w in self.webcams])):
            twice = next((name for name in names if names.count(name) > 1), None)
            if twice is not None:
                raise ValueError(f"two {kind} are named '{twice}'")
        return self

    @model_validator(mode="after")
    def _albedo_known(self) -> SceneFile:
        if self.imagery is not None and self.elevation is not None and self.elevation.synthetic is not None:
            raise ValueError("a synthetic place brings its own albedo: drop the table 'imagery'")
        return self

    def camera(self, name: str | None, *, where: str | Path = "--camera") -> NamedCamera:
        """The camera of that name, the first one when left out; `InputError` listing the names otherwise."""
        if not self.cameras:
            raise InputError(
                where, f"the scene '{self.name}' names no camera", cure="give a place with --at LAT,LON,+ABOVE"
            )
        if name is None:
            return self.cameras[0]
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise InputError(
            where, "no such camera", got=name, expected="one of " + ", ".join(c.name for c in self.cameras)
        )


def read_scene(path: str | Path, *, allow_outside: bool = False) -> SceneFile:
    """Read a scene file and turn its paths into absolute ones.

    Parameters
    ----------
    allow_outside
        Let the file name rasters outside its own folder.

    Raises
    ------
    InputError
        One line for the first thing wrong in the file, or a path that leaves the file's folder.
    """
    path = Path(path)
    scene = read_declaration(path, SceneFile)
    folder = path.resolve().parent

    def resolved(key: str, name: str) -> str:
        # GDAL's virtual file systems (/vsicurl/, /vsizip/ …) are places outside too, and may reach the network.
        virtual = name.startswith("/vsi")
        target = Path(name) if virtual else (folder / name).resolve()
        if not allow_outside and (virtual or not target.is_relative_to(folder)):
            raise InputError(
                f"{path}: {key}",
                "leads outside the scene file's folder",
                got=name,
                cure="move the data beside the file, or pass --allow-outside",
            )
        if not virtual and not target.is_file():
            raise InputError(f"{path}: {key}", "no such file", got=str(target))
        return name if virtual else str(target)

    updates: dict = {}
    if scene.elevation is not None and scene.elevation.file is not None:
        updates["elevation"] = scene.elevation.model_copy(
            update={"file": resolved("elevation.file", scene.elevation.file)}
        )
    if scene.imagery is not None:
        updates["imagery"] = scene.imagery.model_copy(update={"file": resolved("imagery.file", scene.imagery.file)})
    return scene.model_copy(update=updates)


def camera_from_place(
    frame: LocalFrame, view: NamedCamera, ground_height_m: float, *, size_px: tuple[int, int]
) -> Camera:
    """The pinhole camera of a named view, whose ground lies at ``ground_height_m`` in the scene's datum."""
    height_m = view.height_m if view.height_m is not None else ground_height_m + float(view.above_ground_m)
    return camera_at(
        frame,
        view.latitude_deg,
        view.longitude_deg,
        height_m,
        heading_deg=view.heading_deg,
        pitch_deg=view.pitch_deg,
        roll_deg=view.roll_deg,
        fov_deg=view.fov_deg,
        size_px=size_px,
    )
