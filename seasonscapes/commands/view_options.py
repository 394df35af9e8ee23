"""Flags about views and instants that several commands share, and the values that they stand for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range, parse_at, parse_size
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.scene import NamedCamera, SceneFile
    from seasonscapes.workflows.place import Place

_SIZE = "1536x1024"
# What a view keeps of each pixel at least, in single precision: radiance, surface radiance, albedo, position and normal of
# three numbers each, uv of two, depth and alpha.
_BYTES_PER_PIXEL = 4 * (5 * 3 + 2 + 2)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """From where to look."""

    camera: str | None = None
    """A camera that the scene names, or a calibration record (.json); the scene's first one when left out."""
    at: str | None = None
    """A position instead: LAT,LON or LAT,LON,HEIGHT or LAT,LON,+ABOVE_GROUND."""
    heading: float | None = None
    """Of --at: azimuth clockwise from north, in degrees."""
    pitch: float = 0.0
    """Of --at: elevation of the view, in degrees."""
    fov: float = 60.0
    """Of --at: horizontal field of view, in degrees."""
    size: str | None = None
    """WIDTHxHEIGHT in pixels; 1536x1024, or with a calibration record the shape of its picture."""

    def size_px(self) -> tuple[int, int]:
        """Width and height; `InputError` where a picture of that size would not fit into memory."""
        from seasonscapes.terrain.memory import require_bytes

        width, height = self._shape()
        needed, got = width * height * _BYTES_PER_PIXEL, f"{width}x{height}"
        require_bytes(needed, where="--size", got=got, cure="choose a smaller one")
        return width, height

    def _shape(self) -> tuple[int, int]:
        record = self._record
        if record is None:
            return parse_size(self.size or _SIZE)
        width, height = record[1]
        if self.size is None:
            scale = min(1.0, parse_size(_SIZE)[0] / width)
            return max(1, round(scale * width)), max(1, round(scale * height))
        wide, high = parse_size(self.size)
        if abs(high - wide * height / width) > 1.0:
            fitting = f"{wide}x{round(wide * height / width)}"
            raise InputError("--size", "has another shape than the calibrated picture", got=self.size, expected=fitting)
        return wide, high

    @cached_property
    def _record(self) -> tuple[NamedCamera, tuple[int, int]] | None:
        """The viewpoint and the picture's size where ``--camera`` is a calibration record."""
        from seasonscapes.workflows.views import calibrated_viewpoint

        is_record = self.camera is not None and self.camera.lower().endswith(".json")
        return calibrated_viewpoint(Path(str(self.camera))) if is_record else None

    def chosen(self, scene: SceneFile) -> NamedCamera:
        """The scene's camera of that name, or the view that ``--at`` describes."""
        from seasonscapes.declaration import validate
        from seasonscapes.scene import NamedCamera

        if self.at is None:
            if self.heading is not None:
                raise InputError("--heading", "goes with --at", cure="name a place with --at LAT,LON,+ABOVE_GROUND")
            record = self._record
            return scene.camera(self.camera) if record is None else record[0]
        if self.camera is not None:
            raise InputError("--camera", "and --at name two views", cure="drop one of them")
        if self.heading is None:
            expected = "the azimuth to look at, clockwise from north, in degrees"
            raise InputError("--heading", "missing", expected=expected)
        check_range("--heading", self.heading, -360.0, 360.0)
        check_range("--pitch", self.pitch, -90.0, 90.0)
        check_range("--fov", self.fov, 1.0, 169.0)
        latitude, longitude, height, above = parse_at(self.at)
        facts = {
            "name": "at",
            "latitude_deg": latitude,
            "longitude_deg": longitude,
            "height_m": height,
            "above_ground_m": above,
            "heading_deg": self.heading,
            "pitch_deg": self.pitch,
            "fov_deg": self.fov,
        }
        return validate(facts, NamedCamera, where="--at")

    def pinhole(self, place: Place) -> Camera:
        """The camera of the chosen view."""
        from seasonscapes.workflows.views import camera_for

        where = "--camera" if self.at is None else "--at"
        return camera_for(place, self.chosen(place.scene), size_px=self.size_px(), where=where)
