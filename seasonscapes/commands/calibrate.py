"""``seasonscapes calibrate``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from seasonscapes.commands.console import message, print_result
from seasonscapes.commands.outputs import check_output_folder
from seasonscapes.errors import InputError, NotEnoughEvidence

if TYPE_CHECKING:
    from seasonscapes.workflows.webcam_calibration import WebcamStation


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class TerrainSource:
    """The heights to calibrate against."""

    elevation: Path | None = None
    """A raster of heights; default the scene's own."""
    context: Path | None = None
    """A coarser raster for the mountains beyond it."""
    allow_outside: bool = False
    """Let the scene file name data outside its folder."""

    def station(self, scene: str, webcam: str | None) -> WebcamStation:
        """The webcam at its stated position, with the terrain around it."""
        from seasonscapes.workflows.webcam_calibration import webcam_station

        return webcam_station(
            scene, webcam, elevation=self.elevation, context=self.context, allow_outside=self.allow_outside
        )


def calibrate_command(
    scene: str,
    *,
    webcam: str | None = None,
    picture: Path,
    points: Path | None = None,
    skyline: bool = False,
    mask: Path | None = None,
    radial: bool = False,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/calibration"),
    terrain: TerrainSource | None = None,
    json: bool = False,
) -> None:
    """Calibrate a webcam from matched points, from the skyline, or both; write the pose and an overlay figure.

    Parameters
    ----------
    scene
        A scene file with [[webcam]] tables.
    webcam
        Which of them; may be left out where there is one.
    picture
        A photograph of that webcam, in full size.
    points
        A .csv of name,x_px,y_px,latitude_deg,longitude_deg,height_m.
    skyline
        Align to the terrain's skyline and ridges within 12 degrees of the stated heading.
    mask
        A picture of the same size, black where something stands before the landscape.
    radial
        Solve for one radial lens term too (needs points).
    output
        Folder for WEBCAM_calibration.json and WEBCAM_overlay.png.
    json
        Print one machine-readable record.
    """
    from seasonscapes.calibration.calibration_file import write_calibration
    from seasonscapes.calibration.evidence import read_points
    from seasonscapes.calibration.overlay import save_overlay
    from seasonscapes.calibration.resection import report_lines
    from seasonscapes.workflows.webcam_calibration import calibrate, station_picture

    check_output_folder(output)
    if points is None and not skyline:
        raise InputError("calibrate", "no evidence", cure="give --points FILE, --skyline, or both")
    station = (terrain or TerrainSource()).station(scene, webcam)
    image = station_picture(picture, station, "--picture")
    matched = None if points is None else read_points(points, station.frame)
    open_area = None if mask is None else station_picture(mask, station, "--mask").max(axis=2) > 127
    try:
        found = calibrate(station, image, points=matched, skyline=skyline, mask=open_area, radial=radial)
    except NotEnoughEvidence as error:
        raise InputError(picture, str(error), cure="match points by hand: seasonscapes annotate") from None
    name, solution = station.webcam.id, found.solution
    record_file, figure = output / f"{name}_calibration.json", output / f"{name}_overlay.png"
    write_calibration(record_file, name, solution, station.frame, doubts=found.doubts)
    save_overlay(figure, image, solution, points=matched, horizon=found.horizon, title=name)
    for doubt in found.doubts:
        message(f"not reliable: {doubt}")
    if found.doubts:
        message("the record says so, and what uses poses leaves it out unless --doubtful-poses is given")
    record = {
        "webcam": name,
        "reliable": not found.doubts,
        "doubts": list(found.doubts),
        "sigma": solution.sigma,
        "values": solution.parameters.tolist(),
        "rms_px": solution.rms_px,
        "outliers": list(solution.outlier_names),
        "calibration": str(record_file),
        "overlay": str(figure),
    }
    print_result(record, [*report_lines(solution), f"{record_file}", f"{figure}"], as_json=json)
