"""``seasonscapes calibrate``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from seasonscapes.commands.camera_model_options import CameraModelOptions
from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.outputs import check_output_folder
from seasonscapes.errors import InputError, NotEnoughEvidence

if TYPE_CHECKING:
    import numpy as np

    from seasonscapes.workflows.picture_series import PicturePose
    from seasonscapes.workflows.webcam_calibration import WebcamCalibration, WebcamStation


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
    model: CameraModelOptions | None = None,
    series: Path | None = None,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/calibration"),
    terrain: TerrainSource | None = None,
    json: bool = False,
) -> None:
    """Calibrate a webcam from matched points, the skyline, or another program's camera; write pose and overlay figure.

    The scene's position counts as known to its position_sigma_m (10 m where it is left out), and moves within that.

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
    series
        A .csv of `seasonscapes webcams --manifest`: find how far each other picture of the webcam is turned from this one,
        and write a record for each.
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
    source, model = terrain or TerrainSource(), model or CameraModelOptions()
    if points is None and not skyline and model.camera_model is None:
        raise InputError("calibrate", "no evidence", cure="give --points FILE, --skyline, or --camera-model FILE")
    station = model.applied(source.station(scene, webcam))
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
    save_overlay(figure, found.picture, solution, points=found.points, horizon=found.horizon, title=name)
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
        "distortion": asdict(solution.distortion),
        "calibration": str(record_file),
        "overlay": str(figure),
    }
    lines = [*report_lines(solution), f"{record_file}", f"{figure}"]
    if series is not None:
        poses = _followed(found, series, output, open_area, allow_outside=source.allow_outside)
        record["series"] = [{**asdict(pose), "row": pose.row.path, "record": str(pose.record)} for pose in poses]
        lines += [_pose_line(pose) for pose in poses]
    print_result(record, lines, as_json=json)


def _followed(
    found: WebcamCalibration, series: Path, output: Path, mask: np.ndarray | None, *, allow_outside: bool
) -> list[PicturePose]:
    from seasonscapes.workflows.picture_series import follow_series, rows_of_webcam

    rows = rows_of_webcam(series, found.station.webcam.id, allow_outside=allow_outside)
    with progress_bars() as progress:
        return follow_series(found, rows, series.parent, output, mask=mask, progress=progress)


def _pose_line(pose: PicturePose) -> str:
    if pose.doubts:
        return f"{pose.row.time:%Y-%m-%d %H:%M} UTC  not reliable: {'; '.join(pose.doubts)}"
    found = f"turned {pose.turn_deg:.3f}° ± {pose.heading_sigma_deg:.3f}° by {pose.evidence}"
    return f"{pose.row.time:%Y-%m-%d %H:%M} UTC  {found}  {pose.record}"
