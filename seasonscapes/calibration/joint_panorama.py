"""One pose per panorama out of views that were calibrated apart, and how far each of those was off."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.pose_model import angles_from_rotation
from seasonscapes.calibration.resection import Calibration, resect
from seasonscapes.cameras.panorama import project_panorama
from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.cameras.reference_poses import ReferenceView
from seasonscapes.cameras.webcam import Webcam, webcam_heading_deg, webcam_model
from seasonscapes.frames import LocalFrame, local_axes


@dataclass(frozen=True)
class JointPanorama:
    """What one panorama's views say together.

    Parameters
    ----------
    webcam, names
        Id, and the views' names in order.
    heading_offset_deg
        ``(N,)`` of each view: its own heading minus the table's.
    heading_error_deg, elevation_error_deg
        ``(N,)`` of each view's axis against the joint solution.
    focal_ratio
        ``(N, 2)`` metric ``fx, fy`` of each view over those of the table.
    solution
        The joint calibration; ``None`` where the views have nothing in common.
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
    """Solve one pose per panorama from its refined views.

    A view is a statement about where pixels of the panorama look: a grid of its pixels goes back through the cut that
    made it (azimuth and elevation linear in panorama pixels) and forward along its metric rays. All such statements of
    one panorama are evidence for one heading, tilt, roll, horizon row and scale, by the Cauchy loss.

    Parameters
    ----------
    refined, table
        Views after refinement (metric) and as first cut from the camera table; matched by name.
    """
    first = {view.name: view for view in table}
    groups = defaultdict(list)
    for view in refined:
        groups[view.webcam].append(view)
    return [_joint(webcam, groups[webcam.id], first, frame) for webcam in webcams if webcam.id in groups]


def _joint(webcam: Webcam, views: list[ReferenceView], first: dict[str, ReferenceView], frame) -> JointPanorama:
    axes = local_axes(frame, webcam.latitude_deg, webcam.longitude_deg)
    panorama = webcam_model(webcam, frame)
    pixel, position, offset, ratio = [], [], [], []
    for view in views:
        cut = first[view.name].camera
        grid = np.stack(np.meshgrid(np.linspace(300, 2772, 5), np.linspace(200, 1400, 4)), -1).reshape(-1, 2)
        pixel.append(_panorama_pixels(webcam, cut, axes, grid))
        position.append(panorama.position_m + 5000.0 * ray_directions(view.camera, grid))
        change = _axis_angles(view.camera, axes)[0] - _axis_angles(cut, axes)[0]
        offset.append((change + 180.0) % 360.0 - 180.0)
        ratio.append((view.camera.fx / cut.fx, view.camera.fy / cut.fy))
    priors = Priors(tilt_deg=5.0, roll_deg=5.0, horizontal_m=0.0, vertical_m=0.0, focal=0.05, horizon_px=400.0)
    points = Correspondences(np.concatenate(pixel), np.concatenate(position))
    try:
        solution = resect(panorama, points, priors=priors, axes=axes)
    except ValueError:
        return JointPanorama(
            webcam.id,
            tuple(v.name for v in views),
            np.array(offset),
            np.full(len(views), np.nan),
            np.full(len(views), np.nan),
            np.array(ratio),
            None,
        )
    errors = np.array([_axis_error(webcam, view, first[view.name].camera, solution, axes) for view in views])
    return JointPanorama(
        webcam.id, tuple(v.name for v in views), np.array(offset), errors[:, 0], errors[:, 1], np.array(ratio), solution
    )


def _panorama_pixels(webcam: Webcam, cut: Camera, axes: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Panorama pixels that the reference's resampler took for pixels of a view: linear in azimuth and elevation."""
    heading, _, _ = angles_from_rotation(axes @ cut.world_from_camera[:3, :3])
    x, y = (grid[:, 0] - cut.cx) / cut.fx, (grid[:, 1] - cut.cy) / cut.fy
    azimuth = heading + np.degrees(np.arctan(x)) - webcam_heading_deg(webcam)
    elevation = -np.degrees(np.arctan2(y, np.hypot(1.0, x)))
    column = webcam.width_px * (0.5 + ((azimuth + 180.0) % 360.0 - 180.0) / webcam.horizontal_fov_deg)
    return np.stack([column, webcam.height_px * (0.5 - elevation / webcam.vertical_fov_deg)], -1)


def _axis_angles(camera: Camera, axes: np.ndarray) -> tuple[float, float]:
    """Azimuth and elevation [deg] of the ray through the picture's middle."""
    ray = axes @ ray_directions(camera, [[camera.width_px / 2.0, camera.height_px / 2.0]])[0]
    return float(np.degrees(np.arctan2(ray[0], ray[1]))), float(np.degrees(np.arcsin(ray[2])))


def _axis_error(webcam: Webcam, view: ReferenceView, cut: Camera, solution: Calibration, axes: np.ndarray):
    """Heading and elevation [deg] by which a view's own middle ray misses the joint panorama's."""
    middle = np.array([[cut.width_px / 2.0, cut.height_px / 2.0]])
    expected = _panorama_pixels(webcam, cut, axes, middle)[0]
    panorama = solution.view
    seen, _ = project_panorama(panorama, panorama.position_m + 1000.0 * ray_directions(view.camera, middle))
    turn = 2.0 * np.pi * panorama.fx
    columns = seen[0, 0] - expected[0]
    columns -= turn * np.round(columns / turn)
    return np.degrees(columns / panorama.fx), -np.degrees((seen[0, 1] - expected[1]) / panorama.fy)
