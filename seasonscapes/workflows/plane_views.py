"""Panoramas as the SeasonScapes paper uses them: cut to plane views, graded, each posed by 2D–3D points of its own."""

from __future__ import annotations

import logging
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.errors import InputError, NotEnoughEvidence
from seasonscapes.workflows.place import Place

if TYPE_CHECKING:
    from seasonscapes.calibration.evidence import Correspondences
    from seasonscapes.calibration.resection import Calibration
    from seasonscapes.cameras.panorama import Panorama
    from seasonscapes.cameras.pinhole import Camera

log = logging.getLogger(__name__)

_FEWEST, _MOST_DEG = 4, 85.0
# Of synthetic webcams: points clicked in each view, and how well a person hits a pixel.
_POINTS, _CLICK_PX = 12, 1.0
# A heading is not told that shifts the picture by more of its width than this (one standard deviation).
_MOST_SIGMA = 0.01
# A whole panorama is searched about its stated heading, which a synthetic webcam's compass has off by as much.
_COMPASS_DEG = 3.0
_NEAREST_M, _FARTHEST_M = 200.0, 40_000.0


@dataclass(frozen=True)
class PlaneView:
    """A plane view of a webcam: its name, the camera that was stated for it, and the webcam's picture that it is cut from."""

    name: str
    camera: Camera
    webcam: str
    whole: Camera | Panorama


def plane_views(webcam: str, whole: Camera | Panorama) -> list[PlaneView]:
    """The plane views of a webcam: itself where it is plane, else 4 to 6 views that cover its panorama."""
    from seasonscapes.cameras.panorama import Panorama, split_panorama

    if not isinstance(whole, Panorama):
        return [PlaneView(f"{webcam}-0", whole, webcam, whole)]
    cameras = split_panorama(whole, fov_deg=_MOST_DEG)
    if len(cameras) < _FEWEST and whole.full_circle:
        cameras = split_panorama(whole, fov_deg=_MOST_DEG, count=_FEWEST)
    return [PlaneView(f"{webcam}-{number}", camera, webcam, whole) for number, camera in enumerate(cameras)]


def pose_plane_views(
    place: Place, stated: Sequence[Path], own: Path, *, points: Path | None, seed: int = 0
) -> tuple[list[Path], dict[str, str]]:
    """Solve heading, ``fx`` and ``fy`` of each plane view from 2D–3D points under an L1 loss, as the paper does.

    Parameters
    ----------
    place
        The place.
    stated
        Calibration records of the webcams, whose position, tilt and roll are kept.
    own
        Folder for the records of the views and, of synthetic webcams, the points.
    points
        Folder of ``WEBCAM.csv`` with points in the pixels of the webcam's picture; ``None`` for a synthetic place, whose
        points are terrain seen by the true camera, clicked with an error of a pixel. Stated headings are not used.
    seed
        Of the synthetic clicks.

    Returns
    -------
    list of pathlib.Path, dict
        The files written, and the reason for each view that could not be posed.

    Raises
    ------
    NotEnoughEvidence
        Where no view could be posed.
    """
    return _posed(place, stated, own, points, seed, whole=False)


def pose_panoramas(
    place: Place, stated: Sequence[Path], own: Path, *, points: Path | None, seed: int = 0
) -> tuple[list[Path], dict[str, str]]:
    """Solve one heading and scale of each whole panorama from the same points as `pose_plane_views`, all its views together.

    Parameters, results and errors are those of `pose_plane_views`; a plane webcam is its own only view.
    """
    return _posed(place, stated, own, points, seed, whole=True)


def _posed(
    place: Place, stated: Sequence[Path], own: Path, points: Path | None, seed: int, *, whole: bool
) -> tuple[list[Path], dict[str, str]]:
    from seasonscapes.calibration.calibration_file import read_calibration, record_name, write_calibration
    from seasonscapes.calibration.evidence import read_points, write_points
    from seasonscapes.calibration.l1_pose import l1_pose
    from seasonscapes.cameras.panorama import Panorama

    if points is None and place.synthetic is None:
        raise InputError("--points", "missing", expected="a folder of WEBCAM.csv, of `seasonscapes annotate`")
    files, doubts = [], {}
    for record in stated:
        known = read_calibration(record)
        table = own / f"{known.webcam}.csv" if points is None else points / f"{known.webcam}.csv"
        if points is None:
            write_points(table, _clicked_points(place, known.view, seed, known.webcam), known.frame)
            files.append(table)
        elif not table.is_file():
            doubts[known.webcam] = f"no such file: {table}"
            continue
        matches = read_points(table, known.frame)
        views = plane_views(known.webcam, known.view)
        stated_view = _turned(known.view, seed, known.webcam) if points is None else known.view
        starts: list[tuple[str, Camera | Panorama, Correspondences]] = [(known.webcam, stated_view, matches)]
        if not whole:
            starts = [(view.name, view.camera, _points_in_view(matches, view)) for view in views]
        for name, start, seen in starts:
            try:
                solved = _whole_pose(start, seen) if isinstance(start, Panorama) else l1_pose(start, seen)
            except NotEnoughEvidence as error:
                doubts[name] = str(error)
                continue
            sigma_deg = solved.sigma["heading_deg"]
            if np.radians(sigma_deg) * solved.view.fx > _MOST_SIGMA * solved.view.width_px:
                # Points that lie close together leave a turn and a change of fx alike.
                doubts[name] = f"its points leave the heading to ± {sigma_deg:.1f} deg"
                continue
            files.append(own / record_name(name))
            write_calibration(files[-1], name, solved, known.frame)
    for each, doubt in doubts.items():
        log.info("run: calibrate: %s is left out: %s", each, doubt)
    if not any(path.suffix == ".json" for path in files):
        raise NotEnoughEvidence(f"run: no view could be posed by points: {'; '.join(sorted(set(doubts.values())))}")
    return files, doubts


def _turned(view: Camera | Panorama, seed: int, webcam: str) -> Camera | Panorama:
    """A synthetic webcam's view as a compass states it."""
    from seasonscapes.calibration.pose_model import parameters_of_view, view_from_parameters

    parameters = parameters_of_view(view, np.eye(3))
    parameters[0] += np.random.default_rng([seed, zlib.crc32(webcam.encode())]).uniform(-_COMPASS_DEG, _COMPASS_DEG)
    return view_from_parameters(view, np.eye(3), parameters)


def _whole_pose(start: Panorama, points: Correspondences) -> Calibration:
    """Heading and scale of a whole panorama under an L1 loss; position, tilt and roll are kept."""
    from seasonscapes.calibration.evidence import Priors
    from seasonscapes.calibration.resection import ResectionOptions, resect

    priors = Priors(tilt_deg=0.0, roll_deg=0.0, horizontal_m=0.0, vertical_m=0.0, focal=np.inf)
    return resect(start, points, priors=priors, options=ResectionOptions(loss="l1"))


def cut_plane_views(pictures: Path, stated: Sequence[Path], own: Path, *, grade: str) -> list[Path]:
    """Cut and grade the plane views of all pictures of a manifest.

    Parameters
    ----------
    pictures
        Folder with ``manifest.csv``, pictures and, where there are some, ``masks``.
    stated
        Calibration records of the webcams.
    own
        Folder for the views, their masks and their manifest.
    grade
        Name of a grade, or ``"none"``.

    Returns
    -------
    list of pathlib.Path
        The files written.
    """
    from seasonscapes.calibration.calibration_file import read_calibration
    from seasonscapes.cameras.colour_grade import apply_grade, named_grade
    from seasonscapes.cameras.observation import read_manifest, write_manifest
    from seasonscapes.cameras.panorama import Panorama, cut_view
    from seasonscapes.images import read_image_linear, write_png8

    known = {record.webcam: record.view for record in map(read_calibration, stated)}
    look = named_grade("identity" if grade == "none" else grade)
    rows, files = [], []
    for row in read_manifest(pictures / "manifest.csv"):
        if row.webcam not in known:
            continue
        image = read_image_linear(pictures / row.path)
        mask_file = pictures / "masks" / f"{row.webcam}.png"
        mask = read_image_linear(mask_file) if mask_file.is_file() else np.ones_like(image)
        for view in plane_views(row.webcam, known[row.webcam]):
            cut, kept = image, mask[..., 0] > 0.5
            if isinstance(view.whole, Panorama):
                cut, inside = cut_view(image, view.whole, view.camera)
                kept = inside & (cut_view(mask, view.whole, view.camera)[0][..., 0] > 0.99)
            name = f"{view.name}_{Path(row.path).stem}.png"
            write_png8(own / name, _encoded(apply_grade(cut, look)))
            mask_name = own / "masks" / f"{view.name}.png"
            if mask_name not in files:
                write_png8(mask_name, np.repeat(np.where(kept, 255, 0).astype(np.uint8)[..., None], 3, axis=2))
                files.append(mask_name)
            rows.append(replace(row, webcam=view.name, path=name))
            files.append(own / name)
    write_manifest(own / "manifest.csv", rows)
    return [*files, own / "manifest.csv"]


def _encoded(linear: np.ndarray) -> np.ndarray:
    from seasonscapes.images import srgb_from_linear

    return np.rint(255.0 * np.clip(srgb_from_linear(np.clip(linear, 0.0, 1.0)), 0.0, 1.0)).astype(np.uint8)


def _clicked_points(place: Place, whole: Camera | Panorama, seed: int, webcam: str) -> Correspondences:
    """Points on the terrain that a picture truly shows, with the error of a person's click, in its own pixels."""
    from seasonscapes.calibration.evidence import Correspondences
    from seasonscapes.cameras.panorama import Panorama, project_panorama
    from seasonscapes.cameras.pinhole import project
    from seasonscapes.rendering.gbuffer import trace_gbuffer
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.texturing.inputs import unlit_scene

    rng = np.random.default_rng([seed, 5, zlib.crc32(webcam.encode())])
    scene = unlit_scene(ray_scene(mi_mesh(place.terrain, np.full(3, 0.2))))
    pixels, positions = [], []
    for view in plane_views(webcam, whole):
        seen = trace_gbuffer(scene, view.camera)
        usable = np.flatnonzero((seen.depth > _NEAREST_M).ravel() & (seen.depth < _FARTHEST_M).ravel())
        if not len(usable):
            continue
        chosen = rng.choice(usable, min(_POINTS, len(usable)), replace=False)
        position = seen.position.reshape(-1, 3)[chosen]
        pixel = project_panorama(whole, position)[0] if isinstance(whole, Panorama) else project(whole, position)[0]
        pixels.append(pixel + rng.normal(0.0, _CLICK_PX, pixel.shape))
        positions.append(position)
    return Correspondences(np.concatenate(pixels), np.concatenate(positions))


def _points_in_view(points: Correspondences, view: PlaneView) -> Correspondences:
    """Points of a webcam's picture in the pixels of a view cut from it; those outside are left out."""
    from seasonscapes.calibration.evidence import Correspondences
    from seasonscapes.cameras.panorama import Panorama, panorama_directions
    from seasonscapes.cameras.pinhole import project

    pixel = points.pixel
    if isinstance(view.whole, Panorama):
        # One centre of projection: a pixel of the panorama is a direction, and that direction a pixel of the view.
        far = view.camera.position_m + 1e4 * panorama_directions(view.whole, points.pixel)
        pixel, depth = project(view.camera, far)
        pixel = np.where((depth > 0.0)[..., None], pixel, -1.0)
    inside = np.all((pixel >= 0.0) & (pixel <= [view.camera.width_px, view.camera.height_px]), axis=1)
    names = tuple(name for name, kept in zip(points.names, inside, strict=True) if kept)
    return Correspondences(pixel[inside], points.position_m[inside], names)
