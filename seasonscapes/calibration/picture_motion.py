"""How a fixed camera turned between two of its pictures: wind, thaw, maintenance, image stabilisation.

Edges are compared and not brightness: snow, light and colours change between seasons, the lines of roads, ridges, rocks and
water much less. Tiles of one picture are looked for in the other by the correlation of their gradients' directions (both
senses of a gradient count as one, since dark may have become bright). Many tiles find nothing and are wrong; the rotation on
which most agree is taken, and only where more agree than chance would bring together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.initial_rotation import nearest_rotations
from seasonscapes.calibration.resection import Calibration, ResectionOptions, resect
from seasonscapes.calibration.terrain_horizon import Horizon
from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.errors import ImageSizeMismatch, NotEnoughEvidence

# Widths of the picture [px], tiles [px] and reaches as a share of the width: the whole range coarsely, the rest finely.
_COARSE_PX, _COARSE_TILE_PX, _COARSE_REACH = 720, 72, 0.10
_FINE_PX, _FINE_TILE_PX, _FINE_REACH = 2000, 128, 0.010
_HYPOTHESES = 1500
_LEAST_TILES = 12
# Tiles must agree this many standard deviations beyond the number that chance brings together.
_BEYOND_CHANCE = 6.0
# Tiles overlap by half, so that neighbours are not independent: a standard deviation grows by their number's root.
_OVERLAP = 4.0


@dataclass(frozen=True)
class PictureMotion:
    """The pose of a picture, found from another picture of the same camera.

    Parameters
    ----------
    calibration
        As that of the other picture, with the rotation of this one and the covariance of both.
    turn_deg
        Angle between the two rotations [deg].
    tiles, agreeing
        Number of tiles compared, and of those that agree on the rotation.
    """

    calibration: Calibration
    turn_deg: float
    tiles: int
    agreeing: int


def follow_picture(
    reference: np.ndarray,
    picture: np.ndarray,
    calibration: Calibration,
    axes: np.ndarray,
    *,
    usable: tuple[np.ndarray, np.ndarray],
) -> PictureMotion:
    """Find the rotation of a picture from a calibrated picture of the same camera at the same place.

    Parameters
    ----------
    reference, picture
        Two pictures ``(H, W, 3)`` uint8 sRGB without lens distortion, the first of the calibration.
    calibration
        Of the reference, a perspective camera.
    axes
        East, north and up at the camera, rows ``(3, 3)``.
    usable
        For each picture ``(H, W)`` bool, False where it shows sky, frame, stamps or the camera's own surroundings.

    Returns
    -------
    PictureMotion
        The pose of the second picture.

    Raises
    ------
    NotEnoughEvidence
        Where no more tiles agree on a rotation than chance brings together.
    ImageSizeMismatch
        Where the pictures differ in size.
    """
    view = calibration.view
    if not isinstance(view, Camera):
        raise NotEnoughEvidence("pictures of a panorama are not followed; calibrate each by itself")
    if reference.shape != picture.shape or reference.shape[:2] != (view.height_px, view.width_px):
        raise ImageSizeMismatch(f"follow_picture: pictures of {reference.shape} and {picture.shape}")
    turn = np.eye(3)
    for width, tile, reach in ((_COARSE_PX, _COARSE_TILE_PX, _COARSE_REACH), (_FINE_PX, _FINE_TILE_PX, _FINE_REACH)):
        scale = min(1.0, width / view.width_px)
        reach_px = max(3, round(reach * view.width_px * scale))
        here, there = _tile_pairs(reference, picture, usable, _homography(view, turn), (scale, tile, reach_px))
        turn, agrees = _common_rotation(view, here, there, tolerance_px=2.0 / scale)
        chance = len(here) * np.pi * 2.0**2 / (2.0 * reach_px + 1.0) ** 2
        if agrees.sum() < max(_LEAST_TILES, chance + _BEYOND_CHANCE * np.sqrt(chance)):
            raise NotEnoughEvidence(
                f"the picture shares too little with the calibrated one: {int(agrees.sum())} of {len(here)} tiles agree "
                f"on a rotation, chance alone brings {chance:.0f} together"
            )
    return _posed(view, calibration, axes, (here, there), agrees, turn)


def open_ground(view: Camera, horizon: Horizon, shape: tuple[int, int]) -> np.ndarray:
    """Mask ``(H, W)`` of pixels below the terrain's horizon; all of a column's where the horizon is unknown."""
    step = max(1, max(shape) // 400)
    x, y = np.meshgrid(np.arange(0.5, shape[1], step), np.arange(0.5, shape[0], step))
    local = ray_directions(view, np.stack([x, y], -1)) @ horizon.axes.T
    azimuth = np.degrees(np.arctan2(local[..., 0], local[..., 1])) % 360.0
    elevation = np.degrees(np.arcsin(np.clip(local[..., 2], -1.0, 1.0)))
    order = np.argsort(horizon.azimuth_deg % 360.0)
    limit = np.interp(azimuth, horizon.azimuth_deg[order] % 360.0, horizon.skyline_elevation_deg[order], period=360.0)
    ground = ~(elevation > limit)  # unknown limits are NaN and count as ground
    return cv2.resize(ground.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST).astype(bool)


def _homography(view: Camera, turn: np.ndarray) -> np.ndarray:
    """Pixels of the second picture from those of the reference, where it is turned by camera rotation ``turn``."""
    matrix = np.array([[view.fx, 0.0, view.cx], [0.0, view.fy, view.cy], [0.0, 0.0, 1.0]])
    return matrix @ turn @ np.linalg.inv(matrix)


def _tile_pairs(
    reference: np.ndarray,
    picture: np.ndarray,
    usable: tuple[np.ndarray, np.ndarray],
    homography: np.ndarray,
    search: tuple[float, int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels ``(N, 2)`` of tiles' centres in the reference, and where they were found in the picture."""
    scale, tile, reach = search
    size = (round(reference.shape[1] * scale), round(reference.shape[0] * scale))
    ratio = np.array([size[0] / reference.shape[1], size[1] / reference.shape[0]])
    first = _directions(cv2.resize(reference, size, interpolation=cv2.INTER_AREA), _shrunk(usable[0], size))
    # The picture is turned back by what is known, so that tiles are only shifted.
    shrink = np.diag([*ratio, 1.0])
    offset = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # OpenCV counts from a pixel's centre
    warp = np.linalg.inv(offset) @ shrink @ homography @ np.linalg.inv(shrink) @ offset
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    second = cv2.warpPerspective(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), warp, size, flags=flags)
    seen = cv2.warpPerspective(_shrunk(usable[1], size).astype(np.uint8), warp, size, flags=flags)
    here, there = [], []
    for centre, found in _found_tiles(first, _directions(second, seen > 0), tile, reach):
        here.append(centre)
        there.append(found)
    pixel = np.array(here, float).reshape(-1, 2) / ratio
    moved = np.column_stack([np.array(there, float).reshape(-1, 2) / ratio, np.ones(len(there))]) @ homography.T
    return pixel, moved[:, :2] / moved[:, 2:]


def _shrunk(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_AREA) > 0


def _directions(image: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Directions of gradients with both senses as one ``(2, H, W)`` float32, damped where the gradient is weak."""
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.2)
    gradient = cv2.Sobel(grey, cv2.CV_32F, 1, 0) + 1j * cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    strength = np.abs(gradient)
    weak = float(np.percentile(strength[usable], 60.0)) if usable.any() else 1.0
    doubled = (gradient / (strength + max(weak, 1e-3))) ** 2
    # A mask's own border is no edge of the land.
    inner = cv2.erode(usable.astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=0) > 0
    doubled[~inner] = 0.0
    return np.stack([doubled.real, doubled.imag]).astype(np.float32)


def _found_tiles(
    first: np.ndarray, second: np.ndarray, tile: int, reach: int
) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
    """Centres of tiles of the first picture with the places of best correlation in the second, to parts of a pixel."""
    _, height, width = first.shape
    for top in range(0, height - tile + 1, tile // 2):
        for left in range(0, width - tile + 1, tile // 2):
            patch = first[:, top : top + tile, left : left + tile]
            if np.count_nonzero(patch[0]) < 0.5 * tile * tile:
                continue
            y, x = max(0, top - reach), max(0, left - reach)
            area = second[:, y : top + tile + reach, x : left + tile + reach]
            if area.shape[1] < tile or area.shape[2] < tile:
                continue
            score = cv2.matchTemplate(area[0], patch[0], cv2.TM_CCORR)
            score += cv2.matchTemplate(area[1], patch[1], cv2.TM_CCORR)
            row, column = divmod(int(np.argmax(score)), score.shape[1])
            rise = _peak(score[max(0, row - 1) : row + 2, column], row > 0)
            run = _peak(score[row, max(0, column - 1) : column + 2], column > 0)
            middle = 0.5 * tile
            yield (left + middle, top + middle), (x + column + run + middle, y + row + rise + middle)


def _peak(values: np.ndarray, has_left: bool) -> float:
    """Offset of the maximum of a parabola through three values about the greatest one; 0 at a border."""
    if len(values) < 3 or not has_left:
        return 0.0
    curvature = float(values[0] - 2.0 * values[1] + values[2])
    return 0.0 if curvature >= 0.0 else float(np.clip(0.5 * (values[0] - values[2]) / curvature, -0.5, 0.5))


def _common_rotation(
    view: Camera, here: np.ndarray, there: np.ndarray, *, tolerance_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rotation ``(3, 3)`` of the camera axes on which most tiles agree, and which ``(N,)`` do."""
    if len(here) < _LEAST_TILES:
        raise NotEnoughEvidence(
            f"the picture has structure in {len(here)} tiles only; at least {_LEAST_TILES} are needed"
        )
    own = replace(view, world_from_camera=np.eye(4))
    from_rays, to_rays = ray_directions(own, here), ray_directions(own, there)
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, len(here), (2, _HYPOTHESES))
    apart = np.linalg.norm(here[first] - here[second], axis=1) > 0.1 * view.width_px
    first, second = first[apart], second[apart]
    moment = np.einsum("pi,pj->pij", to_rays[first], from_rays[first])
    moment += np.einsum("pi,pj->pij", to_rays[second], from_rays[second])
    limit = tolerance_px / view.fx
    best, most = np.eye(3), -1
    for rotation in nearest_rotations(moment):
        count = int(np.sum(np.linalg.norm(from_rays @ rotation.T - to_rays, axis=1) < limit))
        if count > most:
            best, most = rotation, count
    for _ in range(5):
        agrees = np.linalg.norm(from_rays @ best.T - to_rays, axis=1) < limit
        best = nearest_rotations(np.einsum("ni,nj->ij", to_rays[agrees], from_rays[agrees])[None])[0]
    return best, np.linalg.norm(from_rays @ best.T - to_rays, axis=1) < limit


def _posed(
    view: Camera,
    calibration: Calibration,
    axes: np.ndarray,
    tiles: tuple[np.ndarray, np.ndarray],
    agrees: np.ndarray,
    turn: np.ndarray,
) -> PictureMotion:
    """The pose from agreeing tiles: position, focal length and lens are those of the reference."""
    here, there = (pixel[agrees] for pixel in tiles)
    distant = view.position_m + 1000.0 * ray_directions(view, here)
    pose = view.world_from_camera.copy()
    pose[:3, :3] = view.world_from_camera[:3, :3] @ turn.T
    solved = resect(
        replace(view, world_from_camera=pose),
        Correspondences(there, distant),
        priors=Priors(horizontal_m=0.0, vertical_m=0.0, focal=0.0),
        axes=axes,
        options=ResectionOptions(loss="cauchy"),
    )
    covariance = calibration.covariance.copy()
    covariance[:3, :3] += _OVERLAP * solved.covariance[:3, :3]
    relative = solved.view.world_from_camera[:3, :3].T @ view.world_from_camera[:3, :3]
    angle = float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(relative) - 1.0), -1.0, 1.0))))
    values = calibration.parameters.copy()
    values[:3] = solved.parameters[:3]
    posed = replace(
        calibration,
        view=solved.view,
        parameters=values,
        covariance=covariance,
        names=(),
        residual_px=np.empty((0, 2)),
        outlier=np.empty(0, bool),
        noise_px=solved.noise_px,
        skyline_rms_px=float("nan"),
    )
    return PictureMotion(posed, angle, len(agrees), int(agrees.sum()))
