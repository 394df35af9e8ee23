"""Calibration of webcams: by matched points, by the skyline, or both; and of synthetic webcams by their skylines."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.cameras.lens import Lens, rectify, undistort
from seasonscapes.cameras.pinhole import view_in_frame
from seasonscapes.errors import CameraBelowGround, InputError, NotEnoughEvidence, NoUsablePixels, UnreadableImage
from seasonscapes.frames import LocalFrame, local_axes
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.views import camera_geodetic
from seasonscapes.workflows.webcam_inspection import scene_with_webcams

if TYPE_CHECKING:
    from seasonscapes.calibration.evidence import Correspondences
    from seasonscapes.calibration.resection import Calibration
    from seasonscapes.calibration.terrain_horizon import Horizon
    from seasonscapes.cameras.panorama import Panorama
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.cameras.webcam import Webcam
    from seasonscapes.terrain.surface import Raster

# Largest error of the compass heading that the first guess of a synthetic webcam has [deg].
_COMPASS_DEG = 3.0


@dataclass(frozen=True)
class WebcamStation:
    """A webcam at its stated position, with the terrain around it.

    Parameters
    ----------
    webcam
        The facts that the scene file states.
    view
        The uncalibrated camera that they describe, in ``frame``.
    frame
        A local frame with its origin at the webcam.
    axes
        The webcam's east, north and up as rows ``(3, 3)``.
    rasters
        Elevation rasters, the finest first.
    lens
        Distortion that is known beforehand.
    pose_is_known
        Whether ``view`` is a finished calibration rather than a first guess.
    vertical_datum
        Of the heights.
    """

    webcam: Webcam
    view: Camera | Panorama
    frame: LocalFrame
    axes: np.ndarray
    rasters: list[Raster]
    lens: Lens = field(default_factory=Lens)
    pose_is_known: bool = False
    vertical_datum: str = "unknown"


@dataclass(frozen=True)
class WebcamCalibration:
    """The calibration of one picture and how reliable it is.

    Parameters
    ----------
    station
        The webcam.
    solution
        The solved view with its covariance.
    horizon
        The terrain's horizon at the solved position.
    points
        The matched points, where there were some.
    picture
        The picture ``(H, W, 3)`` uint8 sRGB, without a distortion that was known beforehand.
    doubts
        Why the result is not reliable; empty where it is.
    """

    station: WebcamStation
    solution: Calibration
    horizon: Horizon | None
    points: Correspondences | None
    picture: np.ndarray = field(repr=False)
    doubts: tuple[str, ...] = ()


def webcam_station(
    scene: str,
    webcam: str | None = None,
    *,
    elevation: str | Path | None = None,
    context: str | Path | None = None,
    allow_outside: bool = False,
) -> WebcamStation:
    """Read a scene's webcam and the terrain around it.

    Parameters
    ----------
    scene
        A scene file with ``[[webcam]]`` tables, or a bundled one.
    webcam
        Which of them; may be left out where there is one.
    elevation
        A raster of heights; default the scene's own.
    context
        A coarser raster for the mountains beyond it.
    allow_outside
        Let the scene file name data outside its folder.

    Raises
    ------
    InputError
        For an unknown webcam, a missing raster, or a webcam outside it.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import rasterio
    >>> import seasonscapes as ss
    >>> heights = ss.load_place("alpine_small").elevation
    >>> rows, columns = heights.values.shape[:2]
    >>> profile = {"driver": "GTiff", "height": rows, "width": columns, "count": 1, "dtype": "float32"}
    >>> scene = '''
    ... name = "valley"
    ... attribution = "of the example"
    ... vertical_datum = "local"
    ... [[webcam]]
    ... id = "hut"
    ... latitude_deg = 46.556
    ... longitude_deg = 7.98
    ... above_ground_m = 5.0
    ... projection = "perspective"
    ... width_px = 960
    ... height_px = 640
    ... horizontal_fov_deg = 60.0
    ... heading_deg = 180.0
    ... time_zone = "Europe/Zurich"
    ... '''
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     raster, file = Path(folder, "heights.tif"), Path(folder, "valley.toml")
    ...     with rasterio.open(raster, "w", **profile, crs=heights.crs, transform=heights.transform) as tif:
    ...         tif.write(heights.values[..., 0], 1)
    ...     _ = file.write_text(scene)
    ...     station = ss.webcam_station(str(file), "hut", elevation=raster)
    >>> station.view.width_px
    960
    """
    from seasonscapes.calibration.terrain_horizon import terrain_height
    from seasonscapes.cameras.webcam import find_webcam, webcam_model
    from seasonscapes.terrain.raster import fill_nodata
    from seasonscapes.workflows.nested_heights import finer_heights
    from seasonscapes.workflows.terrain_building import read_heights, read_scene_elevation
    from seasonscapes.workspace import default_workspace

    read = scene_with_webcams(scene, allow_outside=allow_outside)
    if webcam is None and len(read.webcams) > 1:
        raise InputError("--webcam", "missing", expected="one of " + ", ".join(w.id for w in read.webcams))
    found = read.webcams[0] if webcam is None else find_webcam(read.webcams, webcam)
    own = read.elevation.label if read.elevation is not None and read.elevation.paths else None
    if elevation is None and own is None:
        raise InputError(scene, "names no elevation raster", cure="give one with --elevation FILE")
    files = [elevation, *([] if context is None else [context])]
    rasters = [fill_nodata(read_scene_elevation(read, file), where=str(file or own))[0] for file in files]
    if elevation is None and own is not None and read.elevation is not None and read.elevation.finer:
        # Blended into the heights of the scene's area, as `load_place` blends them; the skyline is that of all the heights.
        within, _ = read_heights(read, None, where=own)
        rasters = [*reversed(finer_heights(read, within, None, default_workspace(), {})), *rasters]
    ground = float(terrain_height(rasters, [found.latitude_deg], [found.longitude_deg])[0])
    if not np.isfinite(ground):
        raise InputError("--webcam", f"'{found.id}' stands outside the elevation raster")
    frame = LocalFrame(found.latitude_deg, found.longitude_deg, 0.0, read.refraction_k)
    view = webcam_model(found, frame, ground_m=ground)
    axes = local_axes(frame, found.latitude_deg, found.longitude_deg)
    lens = Lens(**found.distortion)
    return WebcamStation(found, view, frame, axes, rasters, lens, vertical_datum=read.vertical_datum)


def camera_station(place: Place, camera: Camera, *, name: str = "webcam") -> WebcamStation:
    """Make a station of a camera whose pose is known roughly, with the elevation of a loaded place around it.

    Parameters
    ----------
    place
        The place.
    camera
        The first guess of the pose; its position is taken to be known to 10 m.
    name
        What messages and records call the webcam.

    Returns
    -------
    WebcamStation
        For `calibrate`.

    Raises
    ------
    FrameMismatch
        For a camera without a frame.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> station = ss.camera_station(place, ss.camera(place, "meadow", size_px=(96, 64)))
    >>> round(station.webcam.horizontal_fov_deg)
    60
    """
    from seasonscapes.calibration.pose_model import parameters_of_view
    from seasonscapes.cameras.webcam import Webcam

    camera = view_in_frame(camera, place.frame)
    latitude, longitude, height = camera_geodetic(place, camera)
    axes = local_axes(place.frame, latitude, longitude)
    heading, pitch, roll = parameters_of_view(camera, axes)[:3]
    webcam = Webcam(
        id=name,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        projection="perspective",
        width_px=camera.width_px,
        height_px=camera.height_px,
        horizontal_fov_deg=float(np.degrees(2.0 * np.arctan(0.5 * camera.width_px / camera.fx))),
        heading_deg=float(heading),
        tilt_deg=float(pitch),
        roll_deg=float(roll),
        time_zone="UTC",
    )
    rasters = list(place.height_rasters)
    return WebcamStation(webcam, camera, place.frame, axes, rasters, vertical_datum=place.scene.vertical_datum)


def read_picture(path: Path, where: str) -> np.ndarray:
    """A picture file as ``(H, W, 3)`` uint8 sRGB; `InputError` about ``where`` where it is none."""
    from seasonscapes.images import read_image_srgb8

    if not path.is_file():
        raise InputError(where, "no such file", got=str(path))
    try:
        return read_image_srgb8(path)
    except UnreadableImage as error:
        raise InputError(where, str(error)) from None


def station_picture(path: Path, station: WebcamStation, where: str) -> np.ndarray:
    """A picture of a webcam in full size, as `read_picture` reads it; `InputError` where it has another size."""
    image, view = read_picture(path, where), station.view
    if image.shape[:2] != (view.height_px, view.width_px):
        got, expected = f"{image.shape[1]} x {image.shape[0]} px", f"{view.width_px} x {view.height_px} px"
        raise InputError(path, "the picture has another size than its webcam", got=got, expected=expected)
    return image


def calibrate(
    station: WebcamStation,
    picture: np.ndarray,
    *,
    points: Correspondences | None = None,
    skyline: bool = False,
    mask: np.ndarray | None = None,
    radial: bool = False,
) -> WebcamCalibration:
    """Calibrate a webcam's pose and lens from matched points, from the skyline, or both.

    Parameters
    ----------
    station
        Of `webcam_station`.
    picture
        ``(H, W, 3)`` uint8 sRGB, in full size.
    points
        Matches between pixels and terrain positions.
    skyline
        Align to the terrain's skyline and ridges within 12° of the stated heading.
    mask
        ``(H, W)`` bool, False where something stands before the landscape.
    radial
        Solve for one radial lens term too (needs points).

    Returns
    -------
    WebcamCalibration
        The pose in the station's frame, with standard deviations and doubts.

    Raises
    ------
    InputError
        Where neither points nor the skyline are to be used.
    NotEnoughEvidence
        Where they do not determine the pose.

    Notes
    -----
    Robust resection with priors on position and focal length; see `calibration.resection` and `calibration.skyline`.

    Examples
    --------
    Ten points of the terrain, whose pixels are known from a rendered view, correct a heading that is 2° off.

    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> named = place.scene.camera("aerial")
    >>> view = ss.render(place, ss.camera(place, named, size_px=(96, 64)), "2024-07-20T13:30", sky="hosek", spp=1)
    >>> seen = np.argwhere(np.isfinite(view.gbuffer.depth))[::200][:10]
    >>> points = ss.Correspondences(seen[:, ::-1] + 0.5, view.gbuffer.position[seen[:, 0], seen[:, 1]])
    >>> off = named.model_copy(update={"heading_deg": named.heading_deg + 2.0})
    >>> station = ss.camera_station(place, ss.camera(place, off, size_px=(96, 64)))
    >>> picture = np.zeros((64, 96, 3), np.uint8)
    >>> found = ss.calibrate(station, picture, points=points)
    >>> bool(found.solution.rms_px < 0.1)
    True
    """
    from seasonscapes.calibration.terrain_horizon import HorizonOptions, horizon_from

    if points is None and not skyline and not station.pose_is_known:
        raise InputError("calibrate", "no evidence", cure="give --points FILE, --skyline, or both")
    if radial and not station.lens.is_ideal:
        raise InputError("--radial", "and a distortion that is known beforehand contradict each other", cure="drop one")
    if not station.lens.is_ideal:
        picture, mask, points = _without_lens(station, picture, mask, points)
    if skyline:
        solution, horizon, doubts = _by_skyline(station, picture, points, mask)
    else:
        solution, doubts = _by_points(station, points, radial=radial), ()
        # The resection has refused what lies too deep in the ground.
        options = HorizonOptions(below_ground_m=40.0 if points is None else np.inf)
        horizon = horizon_from(station.rasters, station.frame, solution.view.position_m, options=options)
    doubts = (*doubts, *_contradictions(station, solution, points))
    solution = replace(solution, lens=station.lens)
    return WebcamCalibration(station, solution, horizon, points, picture, doubts)


def _by_skyline(
    station: WebcamStation, picture: np.ndarray, points: Correspondences | None, mask: np.ndarray | None
) -> tuple[Calibration, Horizon, tuple[str, ...]]:
    from seasonscapes.calibration.skyline import SearchRange, align_to_skyline

    search = SearchRange(k1=station.webcam.radial_k1)
    if station.pose_is_known:
        search = replace(search, heading_deg=3.0, tilt_deg=3.0)
    fit = align_to_skyline(
        picture, station.view, station.rasters, station.frame, mask=mask, search=search, points=points
    )
    if fit.calibration is None:
        raise NotEnoughEvidence("; ".join(fit.doubts))
    return fit.calibration, fit.horizon, fit.doubts


def _by_points(station: WebcamStation, points: Correspondences | None, *, radial: bool) -> Calibration:
    """The resection of points; without points, the pose that is known already."""
    from seasonscapes.calibration.contradictions import datum_doubts
    from seasonscapes.calibration.evidence import Priors
    from seasonscapes.calibration.ground_clearance import height_sigma_m
    from seasonscapes.calibration.pose_model import parameters_of_view
    from seasonscapes.calibration.resection import Calibration, ResectionOptions, resect

    if points is None:
        parameters = parameters_of_view(station.view, station.axes)
        none = np.empty((0, 2)), np.empty(0, bool)
        return Calibration(station.view, 0.0, parameters, np.zeros((9, 9)), (), *none, noise_px=0.0)
    sigma_m = station.webcam.position_sigma_m
    priors = Priors(horizontal_m=sigma_m, vertical_m=sigma_m, k1=np.inf if radial else 0.0)
    webcam = station.webcam
    ground_sigma_m = height_sigma_m(station.rasters, webcam.latitude_deg, webcam.longitude_deg)
    # Points in another vertical datum put the camera as far off the ground, which tells nothing then: they are doubted.
    ground_m = None if datum_doubts(points, station.frame, station.rasters) else _ground_of(station)
    options = ResectionOptions(ground_m=ground_m, ground_sigma_m=ground_sigma_m)
    return resect(station.view, points, priors=priors, k1=station.webcam.radial_k1, axes=station.axes, options=options)


def _ground_of(station: WebcamStation) -> Callable[[float, float], float]:
    """Height of the ground in the station's frame [m] at (east, north) [m]; NaN outside the rasters."""
    from seasonscapes.calibration.terrain_horizon import terrain_height
    from seasonscapes.frames import enu_from_geodetic, geodetic_from_enu

    def ground_m(east_m: float, north_m: float) -> float:
        plan = np.array([[east_m, north_m, station.view.position_m[2]]])
        latitude, longitude, _ = geodetic_from_enu(station.frame, plan)
        height = terrain_height(station.rasters, latitude, longitude)
        return float(enu_from_geodetic(station.frame, latitude, longitude, height)[0, 2])

    return ground_m


def _without_lens(
    station: WebcamStation, picture: np.ndarray, mask: np.ndarray | None, points: Correspondences | None
) -> tuple[np.ndarray, np.ndarray, Correspondences | None]:
    """Picture, mask and points as the ideal pinhole would show them."""
    from seasonscapes.cameras.pinhole import Camera

    view = station.view
    assert isinstance(view, Camera)  # a panorama's distortion is refused where it is declared
    straight, inside = straight_picture(picture, view, station.lens)
    if mask is not None:
        weight = rectify(np.repeat(mask[..., None], 3, axis=2).astype(np.float32), view, station.lens)[0]
        inside = inside & (weight[..., 0] > 0.99)
    if points is not None:
        points = replace(points, pixel=undistort(points.pixel, view, station.lens))
    return straight, inside, points


def straight_picture(picture: np.ndarray, view: Camera | Panorama, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """A picture ``(H, W, 3)`` uint8 without its lens's distortion, and ``(H, W)`` bool where it has pixels."""
    from seasonscapes.cameras.pinhole import Camera

    if lens.is_ideal or not isinstance(view, Camera):
        return picture, np.ones(picture.shape[:2], bool)
    image, inside = rectify(picture.astype(np.float32), view, lens)
    return np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8), inside


def _contradictions(station: WebcamStation, solution: Calibration, points: Correspondences | None) -> tuple[str, ...]:
    """Doubts about a pose far from the stated one, and about points in another vertical datum."""
    from seasonscapes.calibration.contradictions import datum_doubts, position_doubts

    doubts = position_doubts(station.view, solution, station.axes, station.webcam.position_sigma_m)
    if points is not None:
        doubts += datum_doubts(points, station.frame, station.rasters)
    return tuple(doubts)


def calibrate_by_skylines(
    place: Place, pictures: Mapping[str, Path], records: Path, output: Path, *, seed: int
) -> tuple[list[Path], dict[str, str]]:
    """Calibrate synthetic webcams by their skylines, from a first guess with a compass error.

    Parameters
    ----------
    place
        The place.
    pictures
        Photograph of each webcam.
    records
        Folder of calibration records with the stated poses.
    output
        Folder for the new records; records that exist there are kept.
    seed
        Of the compass errors.

    Returns
    -------
    list of pathlib.Path, dict
        The records written, and the reason for each webcam that could not be calibrated reliably.
    """
    from seasonscapes.calibration.calibration_file import read_calibration, write_calibration
    from seasonscapes.calibration.pose_model import parameters_of_view, view_from_parameters
    from seasonscapes.calibration.skyline import align_to_skyline
    from seasonscapes.images import read_image_srgb8

    files, doubts = [], {}
    for record in sorted(records.glob("*_calibration.json")):
        if not (output / record.name).is_file():
            stated = read_calibration(record)
            rng = np.random.default_rng([seed, zlib.crc32(stated.webcam.encode())])
            parameters = parameters_of_view(stated.view, np.eye(3))
            parameters[0] += rng.uniform(-_COMPASS_DEG, _COMPASS_DEG)
            guess = view_from_parameters(stated.view, np.eye(3), parameters)
            try:
                image = read_image_srgb8(pictures[stated.webcam])
                fit = align_to_skyline(image, guess, [place.elevation], stated.frame)
            except (NotEnoughEvidence, CameraBelowGround, NoUsablePixels) as error:
                doubts[stated.webcam] = str(error)
                continue
            if fit.calibration is None or fit.doubts:
                doubts[stated.webcam] = ", ".join(fit.doubts)
                continue
            write_calibration(output / record.name, stated.webcam, fit.calibration, stated.frame)
        files.append(output / record.name)
    return files, doubts
