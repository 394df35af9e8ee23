"""Manual annotation of correspondences: matches between a photograph and the terrain, a calibration from them.

All computation is done by functions on an `AnnotationSession`; `annotation_page` serves them to a page in the browser.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.calibration.calibration_file import write_calibration
from seasonscapes.calibration.evidence import Correspondences, Priors, write_points
from seasonscapes.calibration.pose_model import View, parameters_of_view, project_with_parameters
from seasonscapes.calibration.resection import Calibration, report_lines, resect
from seasonscapes.calibration.terrain_view import TerrainView, scaled_view, shaded_relief
from seasonscapes.errors import ImageSizeMismatch
from seasonscapes.frames import LocalFrame, geodetic_from_enu, local_axes


@dataclass
class AnnotationSession:
    """State of the annotation of one webcam; a mutable object, changed by the functions of this module.

    Parameters
    ----------
    webcam
        Id of the webcam, used in file names.
    image
        Photograph ``(H, W, 3)`` uint8 sRGB.
    start
        Approximate view; its size is that of the photograph.
    frame
        Local frame of the scene.
    render
        Function that computes the terrain view of a camera or panorama: `terrain_view.march_terrain_view` with its
        rasters and frame bound, or `terrain_view.trace_terrain_view` with a ray caster bound.
    folder
        Folder of ``<webcam>_points.csv`` and ``<webcam>_calibration.json``.
    priors
        Standard deviations about the start.
    k1
        Initial radial distortion coefficient.
    width_px
        Maximum width of the rendered terrain [px].
    pixel, position_m, terrain_pixel
        Of each match: pixel in the photograph, world position [m], pixel in the rendered terrain.
    solution
        Latest calibration, or ``None``.
    version
        Number of times that the terrain has been rendered.
    rendered_view, terrain_view, relief
        View of the rendered terrain, its surfaces, and its shaded relief ``(h, w, 3)`` uint8.

    Raises
    ------
    ImageSizeMismatch
        If the photograph and the view differ in size.
    """

    webcam: str
    image: np.ndarray
    start: View
    frame: LocalFrame
    render: Callable[[View], TerrainView]
    folder: Path
    priors: Priors = field(default_factory=Priors)
    k1: float = 0.0
    width_px: int = 1400
    pixel: list[list[float]] = field(default_factory=list)
    position_m: list[list[float]] = field(default_factory=list)
    terrain_pixel: list[list[float]] = field(default_factory=list)
    solution: Calibration | None = None
    version: int = 0
    rendered_view: View = field(init=False)
    terrain_view: TerrainView = field(init=False)
    relief: np.ndarray = field(init=False)

    def __post_init__(self):
        if self.image.shape[:2] != (self.start.height_px, self.start.width_px):
            raise ImageSizeMismatch(
                f"AnnotationSession: the image is {self.image.shape[1]} x {self.image.shape[0]} px, expected "
                f"{self.start.width_px} x {self.start.height_px} as the view"
            )
        render_terrain(self)

    @property
    def view(self) -> View:
        """The calibrated view, or the start before the first calibration."""
        return self.start if self.solution is None else self.solution.view


def render_terrain(session: AnnotationSession) -> None:
    """Render the terrain from the current view and reproject the matches into it.

    Parameters
    ----------
    session
        Session; its rendered terrain and ``terrain_pixel`` are updated.
    """
    session.rendered_view = scaled_view(session.view, min(session.width_px, session.view.width_px))
    session.terrain_view = session.render(session.rendered_view)
    session.relief = shaded_relief(session.terrain_view)
    session.version += 1
    if session.position_m:
        axes = np.eye(3)
        parameters = parameters_of_view(session.rendered_view, axes)
        pixel, _ = project_with_parameters(session.rendered_view, axes, parameters, np.array(session.position_m))
        session.terrain_pixel = pixel.tolist()


def position_at(session: AnnotationSession, terrain_pixel: Sequence[float]) -> np.ndarray:
    """Return the terrain point at a pixel of the rendered terrain: the first surface along the ray of the pixel.

    Parameters
    ----------
    session
        Session.
    terrain_pixel
        Pixel ``(x, y)`` of the rendered terrain.

    Returns
    -------
    ndarray
        Position ``(3,)``, east-north-up [m].

    Raises
    ------
    ValueError
        If the pixel lies in the sky or outside the image.
    """
    x, y = (int(np.floor(v)) for v in terrain_pixel)
    height, width = session.terrain_view.distance_m.shape
    if not (0 <= x < width and 0 <= y < height):
        raise ValueError("outside the terrain image")
    position = session.terrain_view.position_m[y, x]
    if not np.isfinite(position).all():
        raise ValueError("this pixel is sky; pick a point on the terrain")
    return position


def project_to_photograph(session: AnnotationSession, terrain_pixel: Sequence[float]) -> list[float] | None:
    """Project a pixel of the rendered terrain into the photograph, with the current view.

    Parameters
    ----------
    session
        Session.
    terrain_pixel
        Pixel ``(x, y)`` of the rendered terrain.

    Returns
    -------
    list of float or None
        Pixel ``[x, y]`` of the photograph; ``None`` in the sky, outside the image or behind the camera.
    """
    try:
        position = position_at(session, terrain_pixel)
    except ValueError:
        return None
    return _project(session, position[None])[0]


def add_match(session: AnnotationSession, photo_pixel: Sequence[float], terrain_pixel: Sequence[float]) -> None:
    """Add a match between the photograph and the rendered terrain.

    Parameters
    ----------
    session
        Session.
    photo_pixel, terrain_pixel
        Pixel ``(x, y)`` of the same feature in the photograph and in the rendered terrain.

    Raises
    ------
    ValueError
        If a pixel lies outside its image, or the terrain pixel in the sky.
    """
    x, y = (float(v) for v in photo_pixel)
    height, width = session.image.shape[:2]
    if not (0 <= x <= width and 0 <= y <= height):
        raise ValueError("outside the photograph")
    position = position_at(session, terrain_pixel)
    session.pixel.append([x, y])
    session.position_m.append(position.tolist())
    session.terrain_pixel.append([float(v) for v in terrain_pixel])


def remove_last_match(session: AnnotationSession) -> None:
    """Remove the last match.

    Parameters
    ----------
    session
        Session.

    Raises
    ------
    ValueError
        If there is no match.
    """
    if not session.pixel:
        raise ValueError("there is no match to remove")
    for values in (session.pixel, session.position_m, session.terrain_pixel):
        values.pop()


def matched_points(session: AnnotationSession) -> Correspondences:
    """Return the matches of a session as correspondences, pixels in the photograph.

    Parameters
    ----------
    session
        Session of N matches.

    Returns
    -------
    Correspondences
        N correspondences, numbered from 1.
    """
    return Correspondences(np.array(session.pixel).reshape(-1, 2), np.array(session.position_m).reshape(-1, 3))


def solve_session(session: AnnotationSession) -> None:
    """Calibrate from the matches, with priors about the original start, and render the terrain again.

    Parameters
    ----------
    session
        Session; its ``solution`` and rendered terrain are updated.

    Raises
    ------
    NotEnoughEvidence
        As `resect`.
    """
    latitude, longitude, _ = geodetic_from_enu(session.frame, session.start.position_m)
    axes = local_axes(session.frame, float(latitude), float(longitude))
    session.solution = resect(session.start, matched_points(session), priors=session.priors, k1=session.k1, axes=axes)
    render_terrain(session)


def save_session(session: AnnotationSession) -> list[Path]:
    """Write the matches, and the calibration if there is one.

    Parameters
    ----------
    session
        Session.

    Returns
    -------
    list of Path
        The files written.
    """
    files = [session.folder / f"{session.webcam}_points.csv"]
    write_points(files[0], matched_points(session), session.frame)
    if session.solution is not None:
        files.append(session.folder / f"{session.webcam}_calibration.json")
        write_calibration(files[1], session.webcam, session.solution, session.frame)
    return files


def _project(session: AnnotationSession, position: np.ndarray) -> list[list[float] | None]:
    """Pixels of world points ``(N, 3)`` in the photograph; ``None`` behind the camera."""
    axes = np.eye(3)
    k1 = session.k1 if session.solution is None else session.solution.k1
    pixel, in_front = project_with_parameters(session.view, axes, parameters_of_view(session.view, axes, k1), position)
    return [xy.tolist() if visible else None for xy, visible in zip(pixel, in_front, strict=True)]


def session_state(session: AnnotationSession) -> dict[str, Any]:
    """Return the state that the page displays, as JSON values.

    Parameters
    ----------
    session
        Session.

    Returns
    -------
    dict
        ``pairs`` (matches with their reprojections and outlier flags), ``solved``, ``version``, ``summary`` and
        ``report`` (lines of text).
    """
    projected = _project(session, np.array(session.position_m)) if session.position_m else []
    solution = session.solution
    outlier = [] if solution is None else solution.outlier.tolist()
    pairs = [
        {
            "name": str(i + 1),
            "photo": session.pixel[i],
            "terrain": session.terrain_pixel[i],
            "projected": projected[i],
            "set_aside": bool(i < len(outlier) and outlier[i]),
        }
        for i in range(len(session.pixel))
    ]
    summary = (
        ""
        if solution is None
        else (
            f"heading {solution.parameters[0]:.2f} ± {solution.sigma['heading_deg']:.2f}°, RMS {solution.rms_px:.1f} px"
        )
    )
    return {
        "pairs": pairs,
        "solved": solution is not None,
        "version": session.version,
        "summary": summary,
        "report": [] if solution is None else list(report_lines(solution)),
    }
