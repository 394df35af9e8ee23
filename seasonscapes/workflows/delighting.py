"""Delighting: the light of an hour removed from an image that lies in a place's texture, such as an orthophoto."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.errors import InputError, NotEnoughEvidence
from seasonscapes.progress import Progress, task_progress
from seasonscapes.scene import Imagery
from seasonscapes.sky.models import SkyModel
from seasonscapes.terrain.raster_files import OWN_FOLDER, Confinement
from seasonscapes.terrain.surface import Texture
from seasonscapes.workflows.illumination import given_sun_position, illumination_at, position_at, sky_model
from seasonscapes.workflows.place import Place, utc_at
from seasonscapes.workflows.scene_imagery import AtlasImage, atlas_image
from seasonscapes.workflows.terrain_building import sample_spacing_m

if TYPE_CHECKING:
    from seasonscapes.albedo.adjacency import Surroundings
    from seasonscapes.albedo.delighting import Air, DelitImage, TexelIrradiance
    from seasonscapes.albedo.ground_above import GroundAbove
    from seasonscapes.albedo.sun_search import FoundSun
    from seasonscapes.sky.illumination import Illumination

log = logging.getLogger(__name__)

UNKNOWN = "unknown"
# When an image was taken: an instant, text for one (civil time at the place) or "unknown", or azimuth and elevation of
# the sun [deg].
ImageTime = str | datetime | tuple[float, float]

# Azimuths of the horizons, and texels on a side, at which the sun of an image is searched.
_AZIMUTHS, _SEARCH_SIDE = 72, 240
# Skylight and interreflection are traced for about so many texels at most, and not more finely than the heights.
_MOST_TRACED = 1_000_000
# Sky models know observers up to here; nearly all haze and two thirds of the molecules are below [m].
_HIGHEST_SENSOR_M = 9_000.0
# Of the air that scatters light of the land around into an image: wavelengths of red, green and blue, and scale height
# of the molecules.
_PRIMARIES_NM, _MOLECULES_M = np.array([611.0, 549.0, 464.0]), 8000.0


@dataclass(frozen=True)
class DelitScene:
    """A scene's image without its light; made by `delit_imagery`.

    Parameters
    ----------
    texture
        Albedo ``(R, S, 3)``; ``weight`` is the share of the texel that the image covers, 0 where the albedo is a guess.
    delit
        Albedo, σ, visibility of the sun and source of each texel, and what was fitted.
    day
        Date of the image; ``None`` where only its sun is known.
    facts
        Plain values about light, sun and fit.
    """

    texture: Texture
    delit: DelitImage = field(repr=False)
    day: date | None
    facts: dict[str, Any]

    def save(self, path: str | Path) -> None:
        """Write a ``.npz`` file, atomically; `load_albedo` and ``--albedo`` read it."""
        from seasonscapes.images import atomic_path

        dated = {} if self.day is None else {"date": np.array(self.day.isoformat())}
        with atomic_path(Path(path)) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(
                file,
                allow_pickle=False,
                values=self.texture.values,
                weight=self.texture.weight,
                sigma=self.delit.sigma,
                source=self.delit.source,
                visibility=self.delit.visibility,
                atlas_id=np.array(self.texture.atlas_id),
                **dated,
            )


def delight(
    place: Place,
    image: Texture,
    time: str | datetime,
    *,
    sky: str | Path | SkyModel = "clear",
    progress: Progress | None = None,
) -> Texture:
    """Remove the light of a known hour from an image that lies in a place's texture, such as an orthophoto.

    Parameters
    ----------
    place
        The place.
    image
        Radiance ``(R, S, 3)`` [cd/m²] of the surface in the place's atlas; ``weight`` is 0 where there is none.
    time
        When it was taken: an aware datetime, or ISO 8601 text; without offset it is civil time at the place.
    sky
        The sky model of that hour.
    progress
        Called with a task and its finished share.

    Returns
    -------
    Texture
        Albedo ``(R, S, 3)``; ``weight`` is 0 where it is unknown.

    Raises
    ------
    AtlasMismatch
        For an image of another atlas.

    Notes
    -----
    Borders of cast shadows follow the image, so that no ghost of them remains; see `albedo.delighting`. For the image
    that a scene file names use ``[imagery] time = …`` or ``seasonscapes delight``.

    Examples
    --------
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> lit = ss.lit_texture(place, "2024-07-20T13:30", sky="hosek", rays=16)
    >>> albedo = ss.delight(place, ss.Texture(lit.radiance), "2024-07-20T13:30", sky="hosek")
    >>> known = albedo.weight > 0.0
    >>> bool(np.median(np.abs(albedo.values[known] / lit.albedo[known] - 1.0)) < 0.2)
    True
    """
    from seasonscapes.albedo.delighting import DelightOptions, delight_image

    place.require_texture(image, what="image")
    light, _, _ = image_light(place, time, sky)
    irradiance = _texel_light(place, light, progress)
    radiance = np.where(image.weight[..., None] > 0.0, image.values, np.float32(np.nan))
    # The image was laid into the texture by the caller, exactly.
    options = DelightOptions(radiance_per_unit=1.0, register=False)
    clipped = np.zeros(radiance.shape, bool)
    delit = delight_image(radiance, clipped, irradiance, options=options, progress=task_progress(progress, "light"))
    known = np.isfinite(delit.albedo).all(axis=2)
    return Texture(np.nan_to_num(delit.albedo), np.asarray(known, np.float32), place.atlas_id)


def imagery_time(imagery: Imagery) -> ImageTime | None:
    """When a scene file says that its image was taken; ``None`` where it does not."""
    return imagery.time if imagery.sun_deg is None else (float(imagery.sun_deg[0]), float(imagery.sun_deg[1]))


def delit_imagery(
    place: Place,
    time: ImageTime,
    *,
    image: Path | Imagery | None = None,
    sky: str | Path | SkyModel = "clear",
    sensor_height_m: float | None = None,
    land_classes: int = 0,
    progress: Progress | None = None,
) -> DelitScene:
    """Remove the light from an image that a scene file names, or from another image of the same land.

    Parameters
    ----------
    place
        The place.
    time
        When the image was taken; see `ImageTime`.
    image
        One of the scene's images, or a georeferenced file to use instead, encoded as the scene file says of its first one;
        ``None`` for the only image of the scene.
    sky
        The sky model of that hour.
    sensor_height_m
        Height of the aeroplane or satellite in the scene's vertical datum [m], if the air below it is still in the
        image. Above 9 km it counts as 9 km. ``None``: what the scene file says of the image, else it was corrected for.
    land_classes
        Number of classes of land that are found in the image by their colours, and whose response to direct light is
        fitted one by one (forests are not Lambertian). 0: what the scene file says, else all land is Lambertian.
    progress
        Called with a task and its finished share.

    Returns
    -------
    DelitScene
        Albedo with its standard error.

    Raises
    ------
    InputError
        Where the scene has no image, or several and none is given, for a time that is none, or a sensor below the ground.
    NotEnoughEvidence
        Where the sun of an image of unknown time cannot be told.
    """
    from seasonscapes.albedo.delighting import SLOPE_ERROR, DelightOptions, delight_image
    from seasonscapes.rendering.backend import use_backend

    imagery, confinement = _chosen_image(place, image)
    sensor_height_m = imagery.sensor_height_m if sensor_height_m is None else sensor_height_m
    land_classes = land_classes or imagery.land_classes
    use_backend()
    pixels = atlas_image(place, imagery, confinement)
    facts: dict[str, Any] = {}
    if time == UNKNOWN:
        found = image_sun(place, pixels, progress=progress)
        time = trusted_sun(found, imagery.label, cure="state the image's time or sun")
        facts["found_sun"] = found_sun_record(found)
    light, day, record = image_light(place, time, sky)
    irradiance = _texel_light(place, light, progress, slope_error=SLOPE_ERROR)
    options = DelightOptions(
        white_reflectance=imagery.reflectance_scale,
        air=None if sensor_height_m is None else _air(place, time, sky, sensor_height_m),
        # A texture of another layout than the plan has no single shift.
        register=place.atlas.kind == "planar",
        land_class=land_classes or None,
        ground=_ground_above(place, light),
    )
    values = np.where(pixels.weight[..., None] > 0.0, pixels.values, np.float32(np.nan))
    report = task_progress(progress, "removing the light")
    delit = delight_image(values, pixels.clipped, irradiance, options=options, progress=report)
    known = delit.source > 0
    albedo = np.where(known[..., None], delit.albedo, np.median(delit.albedo[known], axis=0))
    weight = np.where(known, pixels.weight, 0.0).astype(np.float32)
    facts |= record | {"sensor_height_m": sensor_height_m, "land_classes": land_classes, **delit.facts}
    return DelitScene(Texture(albedo.astype(np.float32), weight, place.atlas_id), delit, day, facts)


def _chosen_image(place: Place, image: Path | Imagery | None) -> tuple[Imagery, Confinement]:
    """An image of the scene, or another file of its encoding, and where its files may lie."""
    own = place.scene.images
    if isinstance(image, Imagery):
        return image, place.scene.confinement
    if image is not None:
        if not image.is_file():
            raise InputError("--image", "no such file", got=str(image))
        given = {"file": str(image.resolve()), "files": None}
        return own[0].model_copy(update=given) if own else Imagery(file=given["file"]), OWN_FOLDER
    where = f"{place.path}: imagery"
    if not own:
        cure = 'add a table [imagery] with file = "image.tif", or give --image'
        raise InputError(where, "the scene has no image", cure=cure)
    if len(own) > 1:
        labels = ", ".join(each.label for each in own)
        raise InputError(where, "the scene has several images", got=labels, cure="name one with --image FILE")
    return own[0], place.scene.confinement


def image_light(
    place: Place, time: ImageTime, sky: str | Path | SkyModel
) -> tuple[Illumination, date | None, dict[str, Any]]:
    """Light on a place's terrain at the time of an image, the image's date, and plain values about both."""
    model = sky_model(sky)
    day = None
    if isinstance(time, tuple):
        position = given_sun_position(place, *time)
        record: dict[str, Any] = {}
    else:
        utc = utc_at(place, time)
        position, day = position_at(place, utc), utc.date()
        record = {"time_utc": utc.isoformat()}
    elevation_deg = float(position.sun.elevation_deg)
    if elevation_deg <= 0.0:
        got = f"the sun stands at {elevation_deg:.1f}°"
        raise InputError("--time", "no daylight in the image", got=got, expected="a sun above the horizon")
    height_m = place.median_height_m
    light = illumination_at(model, position, height_m, workspace=place.workspace, with_aerial_perspective=False)
    record["sun"] = {"azimuth_deg": round(float(position.sun.azimuth_deg), 3), "elevation_deg": round(elevation_deg, 3)}
    return replace(light, frame=place.frame), day, record | {"sky": light.model}


def _texel_light(
    place: Place, light: Illumination, progress: Progress | None, *, slope_error: float = 0.0
) -> TexelIrradiance:
    from seasonscapes.albedo.forward_model import trace_texel_transport
    from seasonscapes.albedo.texel_light import coarse_irradiance, texel_irradiance
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.coefficients import SamplingOptions

    use_backend()
    # Skylight and interreflection vary slowly over an image whose texels are far finer than the relief.
    sampling = SamplingOptions(shadow_samples=1, rays=128, clusters_per_receiver=64, clusters=8192, rank=32)
    report = task_progress(progress, "light of the texels")
    every = _traced_every(place)
    if every > 1:
        return coarse_irradiance(
            place.terrain,
            place.texture_shape,
            light,
            every=every,
            sampling=sampling,
            slope_error=slope_error,
            progress=report,
        )
    transport = trace_texel_transport(place.terrain, place.texture_shape, sampling=sampling, progress=report)
    return texel_irradiance(transport, light, slope_error=slope_error)


def _ground_above(place: Place, light: Illumination) -> GroundAbove | None:
    """Snow, forest and water that the scene file declares, as an image from above sees them."""
    from seasonscapes.albedo.ground_above import GroundAbove
    from seasonscapes.rendering.ground_optics import optics_of
    from seasonscapes.terrain.texels import texel_positions
    from seasonscapes.terrain.textured_mesh import face_normals

    terrain = place.terrain
    optics = optics_of(terrain)
    if optics is None and terrain.water is None:
        return None
    positions, face = texel_positions(terrain, place.atlas.width_px, place.atlas.height_px)
    normal, on_surface = np.full(positions.shape, np.nan, np.float32), face >= 0
    if terrain.surface is not None:
        normal[on_surface] = terrain.surface.sample(positions[on_surface])[1]
    else:
        corners = terrain.vertices[terrain.faces[face[on_surface]]].astype(np.float64)
        normal[on_surface] = face_normals(corners)[0]
    return GroundAbove(
        optics,
        normal,
        np.array([0.0, 0.0, 1.0]) if light.sun is None else np.asarray(light.sun.direction, float),
        None if terrain.water is None else terrain.water.mask,
        light.sky_radiance[0].mean(axis=0),
    )


def _traced_every(place: Place) -> int:
    """Of how many rows and columns of texels one is enough for skylight and interreflection, an odd number."""
    if place.atlas.kind == "xatlas":
        return 1
    rows, columns = place.texture_shape
    by_heights = sample_spacing_m(place.elevation) / place.atlas.texel_p50_m
    every = max(by_heights, np.sqrt(rows * columns / _MOST_TRACED))
    return 2 * round((every - 1.0) / 2.0) + 1


def _air(place: Place, time: ImageTime, sky: str | Path | SkyModel, sensor_height_m: float) -> Air:
    """Air straight below a sensor, for each texel by its height."""
    from seasonscapes.albedo.delighting import Air
    from seasonscapes.terrain.texels import texel_positions

    position = given_sun_position(place, *time) if isinstance(time, tuple) else position_at(place, utc_at(place, time))
    # Heights of the frame are above its origin's.
    up = texel_positions(place.terrain, place.atlas.width_px, place.atlas.height_px)[0][..., 2]
    ground_m = np.where(np.isfinite(up), up, np.nanmedian(up)) + place.frame.height_m
    if sensor_height_m <= float(np.nanmax(ground_m)):
        expected = f"above the highest ground, {float(np.nanmax(ground_m)):.0f} m"
        raise InputError("--sensor-height-m", "below the ground", got=sensor_height_m, expected=expected)
    height_m = min(sensor_height_m, _HIGHEST_SENSOR_M)
    seen = illumination_at(sky_model(sky), position, height_m, workspace=place.workspace, map_height=64)
    if seen.aerial_perspective is None:
        cure = "choose clear, hazy or another atmosphere"
        raise InputError("--sensor-height-m", "this sky model has no air before the ground", cure=cure)
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), (*ground_m.shape, 3))
    transmittance, airlight = seen.aerial_perspective(height_m - ground_m, down)
    transmittance = np.asarray(transmittance, np.float32)
    around = None if place.atlas.kind != "planar" else _surroundings(place, transmittance, height_m)
    return Air(transmittance, np.asarray(airlight, np.float32), around)


def _surroundings(place: Place, transmittance: np.ndarray, sensor_height_m: float) -> Surroundings:
    """Light of the land around that the air scatters into the image: what is not molecules counts as haze."""
    from seasonscapes.albedo.adjacency import Surroundings, scattered_upwards
    from seasonscapes.sky.spectrum import rayleigh_optical_depth

    low, high = (np.exp(-height / _MOLECULES_M) for height in (place.median_height_m, sensor_height_m))
    molecules = rayleigh_optical_depth(_PRIMARIES_NM) * (low - high)
    total = -np.log(np.clip(transmittance.reshape(-1, 3).mean(axis=0), 1e-3, 1.0))
    by_molecules, by_haze = scattered_upwards(molecules, np.maximum(total - molecules, 0.0))
    return Surroundings(by_molecules, by_haze, place.atlas.texel_p50_m)


def image_sun(place: Place, image: AtlasImage, *, progress: Progress | None = None) -> FoundSun:
    """Estimate the sun of an image of unknown hour; see `albedo.sun_search`.

    Raises
    ------
    InputError
        For an atlas of charts, in which neighbouring texels do not adjoin.
    """
    from seasonscapes.albedo.sun_search import Relief, find_sun
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.horizon_angles import horizon_angles
    from seasonscapes.rendering.irradiance import surface_at
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.terrain.texels import texel_positions

    if place.atlas.kind == "xatlas":
        cure = "use --atlas planar"
        raise InputError("--atlas", "an image of unknown time needs a top-down atlas", got="xatlas", cure=cure)
    use_backend()
    step = max(1, int(np.ceil(max(place.texture_shape) / _SEARCH_SIDE)))
    rows, columns = (size // step for size in place.texture_shape)

    def block_mean(values: np.ndarray) -> np.ndarray:
        return values[: rows * step, : columns * step].reshape(rows, step, columns, step, -1).mean(axis=(1, 3))

    usable = (image.weight > 0.99) & ~image.clipped.any(axis=2)
    brightness = block_mean(image.values.mean(axis=2))[..., 0]
    known = block_mean(usable.astype(np.float32))[..., 0] > 0.99
    surface = ray_scene(mi_mesh(place.terrain, np.full(3, 0.3, np.float32)))
    # Positions of the blocks' centres; a smaller texture of the same atlas, cropped as the image was.
    centre = texel_positions(place.terrain, place.atlas.width_px, place.atlas.height_px)[0][
        step // 2 : rows * step : step, step // 2 : columns * step : step
    ]
    points, index = surface_at(surface, centre.reshape(-1, 3))
    normal = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (rows * columns, 1))
    horizon = np.zeros((rows * columns, _AZIMUTHS), np.float32)
    on_surface = np.zeros(rows * columns, bool)
    report = task_progress(progress, "horizons")
    normal[index], on_surface[index] = points.normal, True
    horizon[index] = horizon_angles(surface, points, azimuths=_AZIMUTHS, progress=report)
    relief = Relief(
        normal.reshape(rows, columns, 3),
        horizon.reshape(rows, columns, _AZIMUTHS),
        known & on_surface.reshape(rows, columns),
    )
    return find_sun(
        brightness, relief, latitude_deg=place.frame.latitude_deg, progress=task_progress(progress, "sun of the image")
    )


def trusted_sun(found: FoundSun, where: str, *, cure: str) -> tuple[float, float]:
    """Azimuth and elevation [deg] of a sun that was found; `NotEnoughEvidence` with the cure where it is not to be trusted."""
    if not found.trusted:
        best = f"{found.azimuth_deg:.0f},{found.elevation_deg:.0f}"
        cure = f"{cure}, or see what the best one gives, --sun {best}"
        raise NotEnoughEvidence(f"{where}: its sun cannot be told: {found.reason}; {cure}")
    return found.azimuth_deg, found.elevation_deg


def found_sun_record(found: FoundSun) -> dict[str, Any]:
    """Plain values about a sun that was found."""
    return {
        "azimuth_deg": round(found.azimuth_deg, 2),
        "elevation_deg": round(found.elevation_deg, 2),
        "azimuth_sigma_deg": round(found.azimuth_sigma_deg, 2),
        "elevation_sigma_deg": round(found.elevation_sigma_deg, 2),
        "trusted": found.trusted,
        "reason": found.reason,
    }
