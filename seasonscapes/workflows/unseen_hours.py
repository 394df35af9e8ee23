"""A fixed camera's pictures to the same view at hours that it never took."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from seasonscapes.albedo.picture_conditions import ViewLight
from seasonscapes.albedo.seasons import warn_of_unseen_seasons
from seasonscapes.cameras.pinhole import Camera, view_in_frame
from seasonscapes.errors import InputError
from seasonscapes.progress import Progress, task_progress
from seasonscapes.workflows.illumination import illumination_for_camera, sky_model
from seasonscapes.workflows.place import Place, utc_at
from seasonscapes.workflows.relight_session import relight_session

if TYPE_CHECKING:
    from seasonscapes.albedo.fixed_camera import FixedCamera
    from seasonscapes.cameras.observation import Observation
    from seasonscapes.rendering.relit_view import RelightableView
    from seasonscapes.workflows.photograph_files import PhotographSources

log = logging.getLogger(__name__)

_MAP_ROWS = 64
# The camera may have moved by this much between two pictures [px].
_STANDS_STILL_PX = 0.5
# A picture that shows less of the terrain than this share tells nothing.
_LEAST_SHOWN = 0.02
# A picture is meant by a time within so many seconds.
_SAME_PICTURE_S = 60.0
Sky = Literal["any", "sun", "no sun"]


@dataclass(frozen=True)
class FixedView:
    """The terrain in a fixed camera's pixels, ready for the light of any instant; from `fixed_view`.

    Parameters
    ----------
    place, camera
        The place and the camera, in the place's frame.
    view
        Daylight coefficients.
    chosen
        ``(n,)`` those of the view's pixels that terrain covers wholly.
    pixel
        ``(n,)`` their flat indices in the image.
    distance_km, height_m, normal
        ``(n,)`` [km], ``(n,)`` above the frame's origin [m] and ``(n, 3)`` of the terrain there.
    """

    place: Place
    camera: Camera
    view: RelightableView = field(repr=False)
    chosen: np.ndarray = field(repr=False)
    pixel: np.ndarray = field(repr=False)
    distance_km: np.ndarray = field(repr=False)
    height_m: np.ndarray = field(repr=False)
    normal: np.ndarray = field(repr=False)


def fixed_view(place: Place, camera: Camera, *, progress: Progress | None = None) -> FixedView:
    """Trace the light transport of a fixed camera's view; kept in the place's workspace.

    Parameters
    ----------
    place
        The place.
    camera
        The camera; one calibrated in another frame is converted to the place's.
    progress
        Called with a task and its finished share.

    Raises
    ------
    NoTerrainInView
        Where the camera sees no terrain.
    """
    from seasonscapes.albedo.view_light import view_distances_km, view_heights_m, view_normals
    from seasonscapes.rendering.coefficients import SamplingOptions

    camera = view_in_frame(camera, place.frame)
    # Light is compared with pictures of 8 bits: a quarter of a film's samples.
    sampling = SamplingOptions(shadow_samples=4, albedo_samples=16, rays=256)
    session = relight_session(place, camera, sampling=sampling, progress=progress)
    chosen = np.flatnonzero(np.asarray(session.coefficients.coverage) > 0.99)
    return FixedView(
        place,
        camera,
        session.relightable,
        chosen,
        np.asarray(session.coefficients.pixel)[chosen],
        view_distances_km(session.relightable)[chosen],
        view_heights_m(session.relightable)[chosen],
        view_normals(session.relightable)[chosen],
    )


def light_on_view(view: FixedView, time: datetime) -> ViewLight:
    """The light of an aware instant on the pixels of a view, under a clear and an overcast sky."""
    from seasonscapes.albedo.view_light import view_light

    clear, overcast = (
        illumination_for_camera(view.place, view.camera, sky_model(name), time, map_height=_MAP_ROWS)[0]
        for name in ("clear", "overcast")
    )
    return view_light(view.view, clear, overcast).at(view.chosen)


@dataclass(frozen=True)
class PictureWeather:
    """Weather of one picture as it was found in it.

    Parameters
    ----------
    time
        Aware UTC.
    sun_shone
        Whether sunlight fell on the terrain; ``None`` where the sun stood below the horizon.
    sun, sun_sigma
        Direct light as a share of that of a clear sky, and its standard deviation.
    overcast
        Share of the skylight that came from clouds.
    visibility_km
        Meteorological range [km].
    residual
        Robust standard deviation of picture - model, in encoded values.
    explained
        False where the model leaves much more than in the other pictures.
    """

    time: datetime
    sun_shone: bool | None
    sun: float
    sun_sigma: float
    overcast: float
    visibility_km: float
    residual: float
    explained: bool


@dataclass(frozen=True)
class CameraHours:
    """What the pictures of a fixed camera tell of the view at any hour; made by `camera_hours`.

    Parameters
    ----------
    webcam
        Name of the camera.
    view
        The view and its light transport.
    times
        Of the pictures, aware UTC.
    fitted
        Ground of each pixel and conditions of each picture.
    shown
        ``(n,)`` terrain pixels that a picture shows: what stands before the landscape in all of them is no terrain.
    background
        ``(H, W, 3)`` median of the pictures, sRGB-encoded: the sky and all that is no terrain.
    closed
        ``(K,)`` bool: pictures whose sky is a closed layer of clouds.
    shone
        ``(K,)`` bool: pictures in which sunlight fell on ground (`sunlit_patches.sun_shone`).

    Examples
    --------
    >>> import tempfile
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> times = ["2024-07-20T09:00", "2024-07-20T12:00", "2024-07-20T16:00"]
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sources = ss.synthetic_photographs(place, times, folder, sky="hosek", cameras={"aerial": camera})
    ...     photographs = ss.open_photographs(place, sources.manifest, sources.calibrations, times)
    >>> hours = ss.camera_hours(place, photographs)
    >>> [each.sun_shone for each in hours.weather]
    [True, True, True]
    """

    webcam: str
    view: FixedView
    times: list[datetime]
    fitted: FixedCamera = field(repr=False)
    shown: np.ndarray = field(repr=False)
    background: np.ndarray = field(repr=False)
    closed: np.ndarray = field(repr=False)
    shone: np.ndarray = field(repr=False)

    @property
    def weather(self) -> list[PictureWeather]:
        """Weather of each picture, in the order of the photographs."""
        from seasonscapes.albedo.fixed_camera import unexplained

        odd = unexplained(self.fitted)
        return [
            PictureWeather(
                time,
                bool(shone) if sun[2] > 0.0 else None,
                each.sun,
                each.sun_sigma,
                each.overcast,
                each.visibility_km,
                float(residual),
                not strange,
            )
            for time, each, sun, shone, residual, strange in zip(
                self.times,
                self.fitted.conditions,
                self.fitted.sun_direction,
                self.shone,
                self.fitted.residual,
                odd,
                strict=True,
            )
        ]

    def at(self, time: str | datetime, *, sky: Sky = "any") -> np.ndarray:
        """The view at another instant.

        Each picture of the stated sky is relit to the instant, under its own haze and exposure; the result is their
        mean, weighted by how near their sun and their day of the year are to the instant's.

        Parameters
        ----------
        time
            An aware datetime, or ISO 8601 text; without offset it is civil time at the place.
        sky
            ``"sun"`` takes pictures in which all ground that faces the sun was lit, ``"no sun"`` those in which none was,
            ``"any"`` all, those with patches of sunlight included.

        Returns
        -------
        numpy.ndarray
            ``(H, W, 3)`` sRGB-encoded, in [0, 1]; the sky is the median of the pictures'.

        Raises
        ------
        InputError
            Where no picture has the stated sky.
        """
        from seasonscapes.albedo.fixed_camera import SUN_SHONE, relit_mean

        utc = utc_at(self.view.place, time)
        warn_of_unseen_seasons([utc.date()], [each.date() for each in self.times])
        light = light_on_view(self.view, utc)
        lit = (self.fitted.direct > SUN_SHONE) & ~self.closed
        alike = {"any": np.ones_like(lit), "sun": lit, "no sun": ~self.shone}[sky]
        taken = [k for k, each in enumerate(alike) if each]
        if not taken:
            raise InputError("--sky", "no picture has this sky", got=sky, cure="give --sky any")
        values = relit_mean(self.fitted, light, taken)
        image = self.background.copy()
        image.reshape(-1, 3)[self.view.pixel[self.shown]] = values[self.shown]
        return image


def camera_hours(place: Place, photographs: Sequence[Observation], *, progress: Progress | None = None) -> CameraHours:
    """Learn from a fixed camera's pictures what its view looks like at other hours.

    Parameters
    ----------
    place
        The place.
    photographs
        Of one camera that stands still; masks leave out what stands before the terrain.
    progress
        Called with a task and its finished share.

    Returns
    -------
    CameraHours
        Weather of each picture, and the view at any hour.

    Raises
    ------
    InputError
        Where the photographs are of several cameras, or of one that turned.
    NoTerrainInView
        Where the camera sees no terrain.
    NoUsablePixels
        For fewer than two photographs.

    Examples
    --------
    >>> import tempfile
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> times = ["2024-07-20T09:00", "2024-07-20T12:00", "2024-07-20T16:00"]
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sources = ss.synthetic_photographs(place, times, folder, sky="hosek", cameras={"aerial": camera})
    ...     photographs = ss.open_photographs(place, sources.manifest, sources.calibrations, times)
    >>> hours = ss.camera_hours(place, photographs)
    >>> hours.at("2024-07-20T14:00").shape
    (32, 48, 3)
    """
    from seasonscapes.albedo.cloud_cover import closed_clouds, sky_above
    from seasonscapes.albedo.fixed_camera import fit_fixed_camera
    from seasonscapes.albedo.sunlit_patches import sun_shone
    from seasonscapes.rendering.backend import use_backend

    if not photographs:
        raise InputError("photographs", "none given", expected="two or more of one camera")
    for each in photographs[1:]:
        require_same_view(photographs[0], each)
    camera = photographs[0].camera
    if not isinstance(camera, Camera):
        raise InputError(photographs[0].webcam, "a panorama", expected="views cut out of it, as open_photographs gives")
    use_backend()
    view = fixed_view(place, camera, progress=progress)
    clear = without_hidden(view, photographs)
    photographs, encoded = [each for each, _, _ in clear], [image for _, image, _ in clear]
    usable = [mask for _, _, mask in clear]
    lights = [light_on_view(view, each.time) for each in photographs]
    values = [image.reshape(-1, 3)[view.pixel] for image in encoded]
    fitted = fit_fixed_camera(
        values, usable, lights, view.distance_km, view.normal, progress=task_progress(progress, "ground and weather")
    )
    terrain = np.zeros((camera.height_px, camera.width_px), bool)
    terrain.reshape(-1)[view.pixel] = True
    sky, size = sky_above(terrain), (camera.width_px, camera.height_px)
    closed = [closed_clouds(image, sky & each.mask) for each, image in zip(photographs, encoded, strict=True)]
    shone = [
        sun_shone(fitted, direct, picture, mask, light, view.pixel, size, closed=cloud)
        for direct, picture, mask, light, cloud in zip(fitted.direct, values, usable, lights, closed, strict=True)
    ]
    hours = CameraHours(
        photographs[0].webcam,
        view,
        [each.time for each in photographs],
        fitted,
        np.any(usable, axis=0),
        np.median(encoded, axis=0),
        np.array(closed),
        np.array(shone),
    )
    for each in hours.weather:
        if not each.explained:
            log.warning("%s UTC: not explained by light, haze and exposure; it counts little", each.time.isoformat())
    return hours


def without_hidden(
    view: FixedView, photographs: Sequence[Observation]
) -> list[tuple[Observation, np.ndarray, np.ndarray]]:
    """Photographs with their sRGB-encoded images ``(H, W, 3)`` and usable terrain pixels ``(n,)``: clouds before the
    terrain are not, and pictures that show next to no terrain are left out with a warning."""
    from seasonscapes.albedo.cloud_cover import clouds_before
    from seasonscapes.images import srgb_from_linear

    kept = []
    for each in photographs:
        image = srgb_from_linear(each.image)
        terrain = np.zeros(image.shape[:2], bool)
        terrain.reshape(-1)[view.pixel] = True
        usable = (each.mask & ~clouds_before(image, terrain)).reshape(-1)[view.pixel]
        if usable.mean() < _LEAST_SHOWN:
            log.warning("%s UTC: left out: it shows next to no terrain", each.time.isoformat())
            continue
        kept.append((each, image, usable))
    return kept


def webcam_photographs(
    place: Place,
    sources: PhotographSources,
    webcam: str | None = None,
    *,
    hold_out: Sequence[datetime] = (),
    most_pixels: int | None = None,
    progress: Progress | None = None,
) -> list[Observation]:
    """All photographs of one webcam that a manifest lists, with their poses, in a place's frame.

    Parameters
    ----------
    place
        The place.
    sources
        Manifest, calibrations and masks.
    webcam
        Its name; may be left out where the manifest lists one webcam alone.
    hold_out
        Aware times of photographs to leave out, within a minute.
    most_pixels
        Larger photographs are reduced to as many.
    progress
        Called with a task and its finished share.

    Raises
    ------
    InputError
        Where the manifest lists several webcams or not this one, nothing was taken at a time of ``hold_out``, or fewer
        than two photographs are left.
    """
    from seasonscapes.cameras.observation import read_manifest
    from seasonscapes.workflows.photograph_files import observations, reduced_observation

    rows = read_manifest(sources.manifest, allow_outside=sources.allow_outside)
    names = sorted({row.webcam for row in rows})
    if webcam is None and len(names) != 1:
        raise InputError("--webcam", "missing", expected=", ".join(names) or "a manifest that is not empty")
    wanted = webcam or names[0]
    if wanted not in names:
        raise InputError("--webcam", "has no picture in the manifest", got=wanted, expected=", ".join(names))
    rows = [row for row in rows if row.webcam == wanted]
    for time in hold_out:
        kept = [row for row in rows if abs((row.time - time).total_seconds()) > _SAME_PICTURE_S]
        if len(kept) == len(rows):
            nearest = min(rows, key=lambda row: abs(row.time - time), default=None)
            expected = "no picture is left" if nearest is None else f"the nearest is of {nearest.time.isoformat()}"
            raise InputError("--hold-out", "no picture of that time", got=time.isoformat(), expected=expected)
        rows = kept
    if len(rows) < 2:
        raise InputError(
            sources.manifest, f"{len(rows)} pictures of {wanted}", expected="two or more of a fixed camera"
        )
    for row in rows:
        sources.picture_of(row)
    opened = observations(rows, sources, place.frame, place=place, progress=progress)
    return opened if most_pixels is None else [reduced_observation(each, most_pixels) for each in opened]


def save_hours(hours: CameraHours, times: Sequence[datetime], folder: Path, *, sky: Sky = "any") -> dict[str, Any]:
    """Write the view at some instants, and the weather of the photographs, into a folder.

    Parameters
    ----------
    hours
        From `camera_hours`.
    times
        Aware.
    folder
        Gets ``WEBCAM_TIME.png`` for each and ``weather.json``; made where it is missing.
    sky
        See `CameraHours.at`.

    Returns
    -------
    dict
        ``files`` that were written, ``weather`` of each photograph, ``scene`` and ``attribution``.
    """
    from seasonscapes.images import atomic_path, linear_from_srgb
    from seasonscapes.workflows.pictures import png_metadata, save_png

    scene = hours.view.place.scene
    weather = [asdict(each) for each in hours.weather]
    for each in weather:
        each["time_utc"] = each.pop("time").isoformat()
    record: dict[str, Any] = {"scene": scene.name, "attribution": scene.attribution, "webcam": hours.webcam, "sky": sky}
    files = []
    for time in times:
        path = folder / f"{hours.webcam}_{time.astimezone(UTC):%Y-%m-%dT%H%MZ}.png"
        picture = linear_from_srgb(hours.at(time, sky=sky))
        save_png(path, picture, metadata=png_metadata(record | {"time_utc": time.astimezone(UTC).isoformat()}))
        files.append(str(path))
    with atomic_path(folder / "weather.json") as path:
        path.write_text(json.dumps(weather, indent=1) + "\n", encoding="utf-8")
    return record | {"files": [*files, str(folder / "weather.json")], "weather": weather}


def require_same_view(first: Observation, other: Observation) -> None:
    """Raise `InputError` unless two observations are of one camera in one pose."""
    a, b = first.camera, other.camera
    size = (a.width_px, a.height_px) == (b.width_px, b.height_px)
    turned = np.arccos(np.clip((np.trace(a.world_from_camera[:3, :3].T @ b.world_from_camera[:3, :3]) - 1) / 2, -1, 1))
    if first.webcam != other.webcam or not size or turned * a.fx > _STANDS_STILL_PX:
        raise InputError(
            other.webcam,
            "not the same view in all photographs",
            got=f"{other.time.isoformat()} is turned by {np.degrees(turned):.2f}° from {first.webcam}'s first",
            expected="one camera that stands still",
        )
