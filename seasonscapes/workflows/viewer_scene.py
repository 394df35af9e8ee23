"""What the page in a browser needs of a place: heights on a grid, albedos by date, light transport, tables of the light."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, date, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.albedo.seasons import AlbedoSeries, DatedAlbedo
from seasonscapes.errors import InputError
from seasonscapes.frames import geodetic_from_enu
from seasonscapes.progress import Progress, task_progress
from seasonscapes.scene import Viewpoint
from seasonscapes.sky.models import AtmosphereModel, SkyModel, atmosphere_from_model, visibility_km
from seasonscapes.workflows.albedo_sources import dated_albedos, snow_transition_between
from seasonscapes.workflows.illumination import atmosphere_tables_in
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.viewer_grid import ViewerGrid, grid_heights, height_tiles, surface_positions
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import build_once

if TYPE_CHECKING:
    from seasonscapes.export.viewer_files import AlbedoPicture, ViewerScene
    from seasonscapes.rendering.hemisphere_rays import RayScene
    from seasonscapes.sky.light_tables import LightTables

log = logging.getLogger(__name__)

_CODE = (
    "workflows.viewer_scene",
    "workflows.viewer_grid",
    "export.viewer_files",
    "rendering.grid_transport",
    "sky.light_tables",
)
_SEARCH_M = 1000.0
# Heights above the highest ground up to which air and sky are tabulated [m].
_ABOVE_M = 3000.0
# Terms of the airlight's cosine series that are kept; the aerosol's phase function is not among what they describe.
_AIR_TERMS = 8
# Dates of a place whose albedo is known for every day: snow goes and comes fast in spring and autumn.
_SHOWN = ((1, 16), (3, 1), (4, 1), (5, 1), (6, 1), (7, 16), (9, 16), (10, 16), (11, 16))


@dataclass(frozen=True)
class ViewerDetail:
    """How finely a place is shown; the defaults keep a place of 12 km below 20 MB.

    Parameters
    ----------
    most_nodes
        Largest number of heights along a side; finer rasters are thinned.
    albedo_px
        Texels along the longer side of the sharpest albedo pictures, of which there are at most two.
    other_albedo_px
        The same of all other dates.
    sky_px, bounce_px
        Points along the longer side at which skylight and reflected light are computed.
    rank
        Daylight coefficients of a point, a multiple of 4.
    clusters
        Groups of faces that reflect light, at most; a power of two.
    clusters_per_point
        Groups that each point sees, a multiple of 4, at most a sixteenth of the rays.
    rays
        Hemisphere rays of each point, a power of two.
    tile_levels
        Times that the grid of heights is halved into tiles at most, which the page loads near its viewer.
    light_heights
        Heights of the viewer at which sky and air are tabulated, 2 to 5; between them the page interpolates.
    """

    most_nodes: int = 1280
    albedo_px: int = 2048
    other_albedo_px: int = 1024
    sky_px: int = 384
    bounce_px: int = 192
    rank: int = 12
    clusters: int = 4096
    clusters_per_point: int = 16
    rays: int = 256
    tile_levels: int = 0
    light_heights: int = 5

    def __post_init__(self):
        if not 2 <= self.light_heights <= 5:
            raise ValueError(f"ViewerDetail: got {self.light_heights} light_heights, expected 2 to 5")


SMALL = ViewerDetail(640, 1024, 640, 224, 112, 8, 1024, 8, 128)
# Of places with more heights along a side than the default shows: what the first picture needs stays below 60 MB.
LARGE = ViewerDetail(2560, 4096, 2048, 640, 320, 12, 16384, 8, 128, tile_levels=3)


def viewer_scene(
    place: Place,
    *,
    albedo: AlbedoSeries | None = None,
    sky: SkyModel,
    detail: ViewerDetail | None = None,
    progress: Progress | None = None,
) -> ViewerScene:
    """Compute what the page shows, or load it from the workspace.

    Parameters
    ----------
    place
        The place.
    albedo
        Dated albedos; ``None``: the scene's own.
    sky
        A model of the atmosphere without clouds.
    detail
        How finely; ``None``: the defaults, or `LARGE` for a place that has more heights than these show.
    progress
        Called with a task and its finished share.

    Raises
    ------
    InputError
        For skies that the page cannot show, and terrain without a grid of heights.
    """
    from seasonscapes.export.viewer_files import load_scene, save_scene

    if not isinstance(sky, AtmosphereModel) or sky.cloudiness > 0.0:
        got = sky.name if not isinstance(sky, AtmosphereModel) else f"cloudiness {sky.cloudiness:g}"
        expected = "a cloudless model of the atmosphere: clear, alpine_winter, hazy, saharan_dust or your own"
        raise InputError("--sky", "the page shows cloudless skies", got=got, expected=expected)
    if place.terrain.surface is None:
        raise InputError(place.path, "has no grid of heights, which the page shows")
    if place.terrain.water is not None or place.terrain.snow is not None or place.terrain.forest:
        log.warning("%s: the page shows water, snow and forest as matt as other ground", place.path)
    if detail is None:
        longest = float(np.ptp(place.terrain.vertices[:, :2], axis=0).max())
        detail = LARGE if longest / place.terrain.surface.spacing_m > ViewerDetail.most_nodes else ViewerDetail()
    dated = list(albedo.dated) if albedo is not None else _own_albedos(place)
    inputs = {
        "terrain": place.key,
        "cameras": [view.model_dump() for view in place.scene.cameras],
        "about": place.about | {"title": place.scene.title},
        "sky": sky,
        "albedo": [[each.day.isoformat(), each.content] for each in dated],
        "detail": asdict(detail),
    }
    return build_once(
        place.workspace,
        f"{place.scene.name}/viewer",
        inputs,
        code=_CODE,
        suffix=".viewer",
        build=lambda: _build(place, dated, sky, detail, progress),
        save=save_scene,
        load=load_scene,
    )


def _own_albedos(place: Place) -> list[DatedAlbedo]:
    """The scene's own albedos: of places whose albedo is known for every day, those of `_SHOWN`."""
    dated = dated_albedos(place)
    if place.synthetic is None:
        return dated
    return [each for each in dated if (each.day.month, each.day.day) in _SHOWN]


def _build(
    place: Place, dated: Sequence[DatedAlbedo], sky: AtmosphereModel, detail: ViewerDetail, progress: Progress | None
) -> ViewerScene:
    from seasonscapes.export.viewer_files import ViewerScene
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh

    grid, up, known = grid_heights(place, detail.most_nodes)
    detail = _fitting(detail, max(grid.columns, grid.rows))
    low, high = float(up[known].min()), float(up[known].max())
    scale = max(high - low, 1.0) / 65534.0
    heights = np.where(known, 1 + np.rint((up - low) / scale), 0).astype(np.uint16)
    light = _light(place, sky, detail.light_heights, task_progress(progress, "light", end=0.3))
    arrays: dict[str, np.ndarray] = {"heights": heights}
    # Where reflected light matters does not depend much on the date: the brightest one decides.
    base = max(dated, key=lambda each: float(each.load().values.mean()))
    rays = ray_scene(mi_mesh(place.terrain, base.load().values))
    pictures, order = _albedo(place, grid, rays, dated, detail, progress)
    if order is not None:
        arrays["snow_order"] = order
    arrays |= _transport(place, grid, rays, detail, task_progress(progress, "light", start=0.3))
    arrays |= _light_arrays(light)
    about = {
        "name": place.scene.name,
        "title": place.scene.title or place.scene.name,
        "attribution": place.scene.attribution,
        "datum": place.scene.vertical_datum,
        "time_zone": _zone(place),
        "frame": asdict(place.frame),
        "grid": {
            "west_m": grid.west_m,
            "south_m": grid.south_m,
            "step_m": grid.step_m,
            "low_m": low,
            "height_scale_m": scale,
        },
        "cameras": _cameras(place),
        "surface_m": place.median_height_m,
        "sky": {
            "name": sky.name,
            "visibility_km": visibility_km(sky),
            "aerosol_depth": [float(value) for value in light.aerosol_depth],
            **_haze(sky),
        },
        "made_utc": datetime.now(UTC).replace(microsecond=0).isoformat(),
    }
    return ViewerScene(about, arrays, pictures, tiles=height_tiles(place, grid, detail.tile_levels))


def _fitting(detail: ViewerDetail, nodes: int) -> ViewerDetail:
    """A detail that is not finer than ``nodes`` heights along a side ask for."""
    clusters = detail.clusters if nodes > 256 else min(detail.clusters, 1024)
    sky_px, bounce_px = min(detail.sky_px, nodes), min(detail.bounce_px, max(nodes // 2, 8))
    return replace(detail, sky_px=sky_px, bounce_px=bounce_px, clusters=clusters)


def _haze(sky: AtmosphereModel) -> dict[str, Any]:
    """Vertical optical depths of aerosol and gas in red, green and blue, by which the page scales the haze."""
    from seasonscapes.sky.spectrum import angstrom_ratio, rayleigh_optical_depth

    middle = np.array([610.0, 550.0, 465.0])
    aerosol = sky.aerosol.optical_depth_500nm * np.asarray(angstrom_ratio(sky.aerosol.angstrom_exponent, 500.0, middle))
    return {
        "aerosol_extinction": aerosol.tolist(),
        "gas_depth": np.asarray(rayleigh_optical_depth(middle)).tolist(),
        "aerosol_scale_m": sky.aerosol.scale_height_m,
        "ground_m": sky.ground.height_m,
    }


def _zone(place: Place) -> str:
    from seasonscapes.civil_time import zone_at

    return str(zone_at(place.frame.latitude_deg, place.frame.longitude_deg))


def _albedo(
    place: Place,
    grid: ViewerGrid,
    rays: RayScene,
    dated: Sequence[DatedAlbedo],
    detail: ViewerDetail,
    progress: Progress | None,
) -> tuple[list[AlbedoPicture], np.ndarray | None]:
    """Pictures of the albedos, and in which order places lose their snow, where there are several dates."""
    from seasonscapes.export.viewer_files import albedo_picture

    report = task_progress(progress, "albedo")
    means = [float(each.load().values.mean()) for each in dated] if len(dated) > 2 else [0.0] * len(dated)
    # The barest and the snowiest dates are looked at most.
    sharp = {int(np.argmin(means)), int(np.argmax(means))} if len(dated) > 2 else set(range(len(dated)))
    lookups: dict[int, tuple[np.ndarray, np.ndarray, tuple[int, int]]] = {}
    pictures = []
    for index, each in enumerate(dated):
        longest = detail.albedo_px if index in sharp else detail.other_albedo_px
        if longest not in lookups:
            lookups[longest] = _uv(place, grid, rays, longest)
        uv, nearest, shape = lookups[longest]
        pictures.append(albedo_picture(each.day, _seen(each.load().values, uv, nearest, shape)))
        report((index + 1) / len(dated))
    if len(dated) < 2:
        return pictures, None
    if len(dated) == 2:
        first, last = dated
    else:
        first, last = dated[int(np.argmax(means))], dated[int(np.argmin(means))]
    uv, nearest, shape = _uv(place, grid, rays, detail.sky_px)
    order = _seen(snow_transition_between(place, first, last).values, uv, nearest, shape)[::-1, :, 0]
    return pictures, np.rint(np.clip(order, 0.0, 1.0) * 255.0).astype(np.uint8)


def _uv(place: Place, grid: ViewerGrid, rays: RayScene, longest: int) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Texture coordinates ``(K, 2)`` seen from above, which of them each of N texels shows, rows and columns."""
    from scipy.ndimage import distance_transform_edt

    from seasonscapes.rendering.irradiance import surface_at

    positions, shape = surface_positions(place, grid, longest)
    found, index = surface_at(rays, positions, search_m=_SEARCH_M)
    number = np.full(len(positions), -1)
    number[index] = np.arange(len(index))
    number = number.reshape(shape)
    indices = distance_transform_edt(number < 0, return_distances=False, return_indices=True)
    rows, columns = np.asarray(indices)
    return found.uv, number[rows, columns], shape


def _seen(values: np.ndarray, uv: np.ndarray, nearest: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A texture seen from above ``(R, C, 3)``, row 0 in the north."""
    from seasonscapes.terrain.surface import sample_texture

    # Pictures coarser than the texture show its mean over a texel.
    factor = int(max(1, values.shape[0] // max(shape)))
    if factor > 1:
        height, width = (size // factor * factor for size in values.shape[:2])
        blocks = values[:height, :width].reshape(height // factor, factor, width // factor, factor, -1)
        if height == values.shape[0] and width == values.shape[1]:
            values = blocks.mean(axis=(1, 3))
    return sample_texture(values, uv)[nearest][::-1]


def _transport(place: Place, grid: ViewerGrid, rays: RayScene, detail: ViewerDetail, report) -> dict[str, Any]:
    from seasonscapes.rendering.coefficients import SamplingOptions
    from seasonscapes.rendering.grid_transport import grid_transport

    sampling = SamplingOptions(
        shadow_samples=1,
        rays=detail.rays,
        clusters=detail.clusters,
        clusters_per_receiver=detail.clusters_per_point,
        rank=detail.rank,
    )
    sky_m, sky_shape = surface_positions(place, grid, detail.sky_px)
    bounce_m, bounce_shape = surface_positions(place, grid, detail.bounce_px)
    traced = grid_transport(rays, sky_m, bounce_m, sampling, search_m=_SEARCH_M, progress=report)
    clusters = traced.clusters
    width, height = (grid.columns - 1) * grid.step_m, (grid.rows - 1) * grid.step_m
    origin = clusters.points.origin[..., :2]
    uv = (origin - np.array([grid.west_m, grid.south_m])) / np.array([width, height])
    both = np.concatenate([traced.sky, clusters.receivers.direct.astype(np.float32)])
    low, high = both.min(axis=0), np.maximum(both.max(axis=0), both.min(axis=0) + 1e-6)

    def levels(values: np.ndarray) -> np.ndarray:
        return np.rint((values - low) / (high - low) * 255.0).astype(np.uint8)

    return {
        "sky_levels": levels(traced.sky).reshape(*sky_shape, detail.rank),
        "sky_range": np.stack([low, high]).astype(np.float32),
        "from_sky": clusters.from_sky.astype(np.float32),
        "bounce_cluster": traced.cluster.reshape(*bounce_shape, -1),
        "bounce_share": np.rint(traced.share * 255.0).astype(np.uint8).reshape(bounce_shape),
        "cluster_uv": np.rint(np.clip(uv, 0.0, 1.0) * 65535.0).astype(np.uint16),
        "cluster_levels": levels(clusters.receivers.direct.astype(np.float32)),
        "cluster_cluster": clusters.receivers.cluster,
        "cluster_share": np.rint(clusters.receivers.share.astype(np.float32) * 255.0).astype(np.uint8),
    }


def _light(place: Place, sky: AtmosphereModel, count: int, report) -> LightTables:
    from seasonscapes.sky.light_tables import light_tables

    heights = place.elevation.values
    low, high = float(heights.min()), float(heights.max()) + _ABOVE_M
    middle = place.median_height_m
    # The surface's own and the highest are always among them.
    by_importance = (middle, high, low + 2.0, high - _ABOVE_M, 0.5 * (middle + high - _ABOVE_M))
    knots = sorted(set(by_importance[:count]))
    highest = min(
        90.0, 90.0 - abs(abs(place.frame.latitude_deg) - 28.7) if abs(place.frame.latitude_deg) > 28.7 else 90.0
    )
    extent = float(np.ptp(place.terrain.vertices[:, :2], axis=0).max())
    tables = atmosphere_tables_in(place.workspace)(atmosphere_from_model(sky))
    return light_tables(tables, np.array(knots), middle, highest_deg=highest, farthest_m=2.0 * extent, progress=report)


def _light_arrays(light: LightTables) -> dict[str, np.ndarray]:
    """The tables, components in half precision relative to their mean size at each elevation and height."""
    sky, sky_size = _relative(light.sky, (2, 3))
    air, air_size = _relative(light.air[..., :_AIR_TERMS, :], (2, 4))
    return {
        "light_elevation_deg": light.elevation_deg.astype(np.float32),
        "light_height_m": light.height_m.astype(np.float32),
        "light_horizon_rad": light.horizon_rad.astype(np.float32),
        "light_sky": sky,
        "light_sky_size": sky_size,
        "light_air": air,
        "light_air_size": air_size,
        "light_depth": light.depth.astype(np.float16),
        "light_distance_m": light.distance_m.astype(np.float32),
        "direct_deg": light.direct_deg.astype(np.float32),
        "direct_lx": light.direct_lx.astype(np.float32),
        "phase": light.phase.astype(np.float32),
        "night": light.night.astype(np.float32),
    }


def _relative(components: np.ndarray, axes: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Components over their mean size, float16; the size, float32. The last channel is a column and stays as it is."""
    size = np.abs(components[..., :9]).mean(axis=(*axes, -1))
    size = np.maximum(size, 1e-30).astype(np.float32)
    relative = components.copy()
    relative[..., :9] /= np.expand_dims(size, (*axes, components.ndim - 1))
    return relative.astype(np.float16), size


def _cameras(place: Place) -> list[dict[str, Any]]:
    """The scene's cameras with their heights; without any, one that looks at the place from the south."""
    rows = []
    for view in place.scene.cameras or (_overview(place),):
        camera = camera_for(place, view, size_px=(4, 3))
        latitude, longitude, height = (float(value) for value in geodetic_from_enu(place.frame, camera.position_m))
        rows.append(
            {
                "name": getattr(view, "name", "overview"),
                "latitude_deg": latitude,
                "longitude_deg": longitude,
                "height_m": height,
                "heading_deg": view.heading_deg,
                "pitch_deg": view.pitch_deg,
                "fov_deg": view.fov_deg,
            }
        )
    return rows


def _overview(place: Place) -> Viewpoint:
    """A view over the whole place from beyond its southern rim."""
    low, high = place.terrain.vertices.min(axis=0), place.terrain.vertices.max(axis=0)
    size = float((high - low)[:2].max())
    middle = 0.5 * (low + high)
    position = np.array([middle[0], low[1] - 0.25 * size, high[2] + 0.35 * size])
    latitude, longitude, height = (float(value) for value in geodetic_from_enu(place.frame, position))
    return Viewpoint(
        latitude_deg=latitude, longitude_deg=longitude, height_m=height, heading_deg=0.0, pitch_deg=-24.0, fov_deg=55.0
    )


def nearest_date(scene: ViewerScene, day: date) -> date:
    """The date among a scene's albedos that is nearest in the year to a day."""
    from seasonscapes.albedo.seasons import days_apart

    return min((picture.day for picture in scene.albedo), key=lambda other: days_apart(day, other))
