"""``seasonscapes calibrate`` and ``seasonscapes annotate``: where a webcam truly stands and looks."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from cyclopts import Parameter

from seasonscapes.commands.talk import finish, say
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.cameras.webcam import Webcam
    from seasonscapes.frames import LocalFrame
    from seasonscapes.terrain.surface import Raster


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


def calibrate(
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
    from seasonscapes.calibration.evidence import Priors, read_points
    from seasonscapes.calibration.overlay import save_overlay
    from seasonscapes.calibration.resection import report_lines
    from seasonscapes.calibration.resection import resect as solve
    from seasonscapes.calibration.skyline import align_to_skyline
    from seasonscapes.calibration.terrain_horizon import horizon_from

    if points is None and not skyline:
        raise InputError("calibrate", "no evidence", cure="give --points FILE, --skyline, or both")
    stand = _stand(scene, webcam, terrain or TerrainSource())
    image = _picture(picture, "--picture")
    matched = None if points is None else read_points(points, stand.frame)
    doubts: tuple[str, ...] = ()
    try:
        if skyline:
            open_area = None if mask is None else _picture(mask, "--mask").max(axis=2) > 127
            fit = align_to_skyline(
                image, stand.view, stand.rasters, stand.frame, mask=open_area, points=matched, k1=stand.webcam.radial_k1
            )
            solution, horizon, doubts = fit.calibration, fit.horizon, fit.doubts
        else:
            priors = Priors(
                horizontal_m=stand.webcam.position_sigma_m,
                vertical_m=stand.webcam.position_sigma_m,
                k1=np.inf if radial else 0.0,
            )
            solution = solve(stand.view, matched, priors=priors, k1=stand.webcam.radial_k1, axes=stand.axes)
            horizon = horizon_from(stand.rasters, stand.frame, solution.view.position_m, below_ground_m=40.0)
    except ValueError as error:
        raise InputError(picture, str(error)) from None
    if solution is None:
        raise InputError(picture, "; ".join(doubts), cure="match points by hand: seasonscapes annotate")
    record_file = output / f"{stand.webcam.id}_calibration.json"
    figure = output / f"{stand.webcam.id}_overlay.png"
    write_calibration(record_file, stand.webcam.id, solution, stand.frame)
    save_overlay(figure, image, solution, points=matched, horizon=horizon, title=stand.webcam.id)
    for doubt in doubts:
        say(f"not reliable: {doubt}")
    record = {
        "webcam": stand.webcam.id,
        "reliable": not doubts,
        "doubts": list(doubts),
        "sigma": solution.sigma,
        "values": solution.values.tolist(),
        "rms_px": solution.rms_px,
        "outliers": list(solution.outlier_names),
        "calibration": str(record_file),
        "overlay": str(figure),
    }
    finish(record, [*report_lines(solution), f"{record_file}", f"{figure}"], as_json=json)


def annotate(
    scene: str,
    *,
    webcam: str | None = None,
    picture: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/calibration"),
    port: int = 0,
    terrain: TerrainSource | None = None,
) -> None:
    """Match points of a photograph and the terrain on a local page, solve and save; ends with Ctrl-C.

    Parameters
    ----------
    scene
        A scene file with [[webcam]] tables.
    webcam
        Which of them; may be left out where there is one.
    picture
        A photograph of that webcam, in full size.
    output
        Folder for the points and the calibration.
    port
        Of the page on 127.0.0.1; 0 takes a free one.
    """
    from functools import partial

    from seasonscapes.calibration.annotation import AnnotationSession, serve_session
    from seasonscapes.calibration.terrain_view import look_at_rasters

    stand = _stand(scene, webcam, terrain or TerrainSource())
    image = _picture(picture, "--picture")
    if image.shape[:2] != (stand.view.height_px, stand.view.width_px):
        raise InputError(
            picture,
            "the picture has another size than its webcam",
            got=f"{image.shape[1]} x {image.shape[0]}",
            expected=f"{stand.view.width_px} x {stand.view.height_px}",
        )
    look = partial(look_at_rasters, rasters=stand.rasters, frame=stand.frame)
    session = AnnotationSession(
        stand.webcam.id, image, stand.view, stand.frame, look, output, k1=stand.webcam.radial_k1
    )
    server, address = serve_session(session, port=port)
    say(f"annotate: open {address} in a browser; Ctrl-C ends")
    try:
        while True:
            clock.sleep(0.5)
    finally:
        server.shutdown()


@dataclass(frozen=True)
class _Stand:
    """A webcam where its facts put it, with the terrain around."""

    webcam: Webcam
    view: object
    frame: LocalFrame
    axes: np.ndarray
    rasters: list[Raster]


def _stand(scene: str, webcam_id: str | None, source: TerrainSource) -> _Stand:
    from seasonscapes.cameras.webcam import find_webcam, webcam_model
    from seasonscapes.frames import LocalFrame, local_axes
    from seasonscapes.pipeline import find_scene
    from seasonscapes.scene import read_scene
    from seasonscapes.terrain.raster import fill_nodata, map_from_geodetic, read_elevation, sample_raster

    path = find_scene(scene)
    place = read_scene(path, allow_outside=source.allow_outside)
    if not place.webcams:
        raise InputError(path, "names no webcam", cure="add [[webcam]] tables")
    if webcam_id is None and len(place.webcams) > 1:
        raise InputError("--webcam", "missing", expected="one of " + ", ".join(w.id for w in place.webcams))
    webcam = place.webcams[0] if webcam_id is None else find_webcam(place.webcams, webcam_id)
    files = [source.elevation or (place.elevation and place.elevation.file), source.context]
    if files[0] is None:
        raise InputError(path, "names no elevation raster", cure="give one with --elevation FILE")
    rasters = [fill_nodata(read_elevation(file), where=file)[0] for file in files if file is not None]
    x, y = map_from_geodetic(rasters[0].crs, webcam.latitude_deg, webcam.longitude_deg)
    ground = float(sample_raster(rasters[0], x, y)[..., 0])
    if not np.isfinite(ground):
        raise InputError("--webcam", f"'{webcam.id}' stands outside the elevation raster")
    frame = LocalFrame(webcam.latitude_deg, webcam.longitude_deg, 0.0, place.refraction_k)
    view = webcam_model(webcam, frame, ground_m=ground)
    return _Stand(webcam, view, frame, local_axes(frame, webcam.latitude_deg, webcam.longitude_deg), rasters)


def _picture(path: Path, flag: str) -> np.ndarray:
    """A picture file as ``(H, W, 3)`` uint8 sRGB; `InputError` about the flag where it is none."""
    from seasonscapes.calibration.skyline import encoded_from_file

    if not path.is_file():
        raise InputError(flag, "no such file", got=str(path))
    try:
        return encoded_from_file(path)
    except ValueError:
        raise InputError(flag, "not a readable picture", got=str(path)) from None
