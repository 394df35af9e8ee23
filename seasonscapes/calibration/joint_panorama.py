"""Joint calibration of a panorama from views that were calibrated separately, and the error of each of these views."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.pose_model import angles_from_rotation
from seasonscapes.calibration.resection import Calibration, resect
from seasonscapes.cameras.panorama import Panorama, project_panorama
from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.cameras.reference_poses import ReferenceView
from seasonscapes.cameras.webcam import Webcam, webcam_heading_deg, webcam_model
from seasonscapes.errors import NotEnoughEvidence
from seasonscapes.frames import LocalFrame, local_axes


@dataclass(frozen=True)
class JointPanorama:
    """Joint calibration of the N views of one panorama.

    Parameters
    ----------
    webcam, names
        Id of the webcam, and names of its views in order.
    heading_offset_deg
        ``(N,)`` heading of each refined view minus its heading in the camera table [deg].
    heading_error_deg, elevation_error_deg
        ``(N,)`` error of each view's optical axis against the joint solution [deg]; NaN without a solution.
    focal_ratio
        ``(N, 2)`` refined ``fx, fy`` of each view relative to those of the camera table.
    solution
        Joint calibration; ``None`` where the views have no pose in common.
    """

    webcam: str
    names: tuple[str, ...]
    heading_offset_deg: np.ndarray
    heading_error_deg: np.ndarray
    elevation_error_deg: np.ndarray
    focal_ratio: np.ndarray
    solution: Calibration | None


def joint_panoramas(
    webcams: Sequence[Webcam], refined: Sequence[ReferenceView], table: Sequence[ReferenceView], frame: LocalFrame
) -> list[JointPanorama]:
    """Solve for one pose per panorama from its refined views.

    A refined view maps pixels of the panorama to world directions: a grid of its pixels is mapped back to the panorama
    (azimuth and elevation are linear in panorama pixels) and forward along its metric rays. The correspondences of all
    views of a panorama determine one heading, tilt, roll, horizon row and scale, with the Cauchy loss.

    Parameters
    ----------
    webcams
        Webcams; those without refined views are skipped.
    refined
        Views after refinement (metric).
    table
        Views of the camera table from which the refinement started; matched by name.
    frame
        Local frame.

    Returns
    -------
    list of JointPanorama
        One entry per webcam with refined views, in the order of ``webcams``.
    """
    table_views = {view.name: view for view in table}
    groups: dict[str, list[ReferenceView]] = defaultdict(list)
    for view in refined:
        groups[view.webcam].append(view)
    return [_joint_panorama(webcam, groups[webcam.id], table_views, frame) for webcam in webcams if webcam.id in groups]


def _joint_panorama(
    webcam: Webcam, views: list[ReferenceView], table_views: dict[str, ReferenceView], frame: LocalFrame
) -> JointPanorama:
    axes = local_axes(frame, webcam.latitude_deg, webcam.longitude_deg)
    panorama = webcam_model(webcam, frame)
    pixel, position, offset, ratio = [], [], [], []
    for view in views:
        table_camera = table_views[view.name].camera
        grid = np.stack(np.meshgrid(np.linspace(300, 2772, 5), np.linspace(200, 1400, 4)), -1).reshape(-1, 2)
        pixel.append(_panorama_pixels(webcam, table_camera, axes, grid))
        position.append(panorama.position_m + 5000.0 * ray_directions(view.camera, grid))
        change = _axis_angles(view.camera, axes)[0] - _axis_angles(table_camera, axes)[0]
        offset.append((change + 180.0) % 360.0 - 180.0)
        ratio.append((view.camera.fx / table_camera.fx, view.camera.fy / table_camera.fy))
    priors = Priors(tilt_deg=5.0, roll_deg=5.0, horizontal_m=0.0, vertical_m=0.0, focal=0.05, horizon_px=400.0)
    points = Correspondences(np.concatenate(pixel), np.concatenate(position))
    try:
        solution = resect(panorama, points, priors=priors, axes=axes)
    except (NotEnoughEvidence, np.linalg.LinAlgError):
        return JointPanorama(
            webcam.id,
            tuple(v.name for v in views),
            np.array(offset),
            np.full(len(views), np.nan),
            np.full(len(views), np.nan),
            np.array(ratio),
            None,
        )
    errors = np.array([_axis_error(webcam, view, table_views[view.name].camera, solution, axes) for view in views])
    return JointPanorama(
        webcam.id, tuple(v.name for v in views), np.array(offset), errors[:, 0], errors[:, 1], np.array(ratio), solution
    )


def _panorama_pixels(webcam: Webcam, table_camera: Camera, axes: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Panorama pixels ``(N, 2)`` that the reference resampler used for view pixels: linear in azimuth and elevation."""
    heading, _, _ = angles_from_rotation(axes @ table_camera.world_from_camera[:3, :3])
    x, y = (grid[:, 0] - table_camera.cx) / table_camera.fx, (grid[:, 1] - table_camera.cy) / table_camera.fy
    azimuth = heading + np.degrees(np.arctan(x)) - webcam_heading_deg(webcam)
    elevation = -np.degrees(np.arctan2(y, np.hypot(1.0, x)))
    column = webcam.width_px * (0.5 + ((azimuth + 180.0) % 360.0 - 180.0) / webcam.horizontal_fov_deg)
    return np.stack([column, webcam.height_px * (0.5 - elevation / webcam.vertical_fov_deg)], -1)


def _axis_angles(camera: Camera, axes: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation [deg] of the ray through the centre of the image."""
    ray = axes @ ray_directions(camera, [[camera.width_px / 2.0, camera.height_px / 2.0]])[0]
    return float(np.degrees(np.arctan2(ray[0], ray[1]))), float(np.degrees(np.arcsin(ray[2])))


def _axis_error(
    webcam: Webcam, view: ReferenceView, table_camera: Camera, solution: Calibration, axes: np.ndarray
) -> tuple[float, float]:
    """Heading and elevation error [deg] of the central ray of a view against the joint panorama."""
    centre = np.array([[table_camera.width_px / 2.0, table_camera.height_px / 2.0]])
    expected = _panorama_pixels(webcam, table_camera, axes, centre)[0]
    panorama = solution.view
    assert isinstance(panorama, Panorama)
    projected, _ = project_panorama(panorama, panorama.position_m + 1000.0 * ray_directions(view.camera, centre))
    circle = 2.0 * np.pi * panorama.fx
    columns = projected[0, 0] - expected[0]
    columns -= circle * np.round(columns / circle)
    return np.degrees(columns / panorama.fx), -np.degrees((projected[0, 1] - expected[1]) / panorama.fy)
