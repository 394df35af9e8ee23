"""Flags that name a camera that another program calibrated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cyclopts import Parameter

from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.workflows.webcam_calibration import WebcamStation


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class CameraModelOptions:
    """A camera that another program calibrated."""

    camera_model: Path | None = None
    """Start from this camera instead of the scene's numbers: OpenCV (.yml, .xml, .json), COLMAP (folder), glimpse (.json),
    ImGRAFT (.mat, .json), PyTrx (.txt) or plain .json. Without --points or --skyline its pose is taken as it is."""
    model_format: Literal["json", "opencv", "colmap", "glimpse", "imgraft", "pytrx"] | None = None
    """Its format, where the file does not tell."""
    model_view: str | None = None
    """In a model of several pictures: the name of one."""
    model_crs: str | None = None
    """Coordinates of its position, such as EPSG:32633; its north is then that map's grid north."""
    ellipsoid_heights: bool = False
    """Its height is above the WGS 84 ellipsoid, and not in the scene's vertical datum."""

    def applied(self, station: WebcamStation) -> WebcamStation:
        """The station with the model's camera; the station itself without a model."""
        from seasonscapes.workflows.camera_import import ModelSource, station_of_model

        if self.camera_model is None:
            if self != CameraModelOptions():
                raise InputError("--camera-model", "missing", expected="the file that the other flags are about")
            return station
        source = ModelSource(
            self.camera_model, self.model_format, self.model_view, self.model_crs, self.ellipsoid_heights
        )
        return station_of_model(station, source)
