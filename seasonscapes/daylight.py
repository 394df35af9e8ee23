"""The light of a place at an instant: ephemeris, sky model and atmosphere tables brought together.

The sun is placed once, at the origin of the scene's frame: all of the terrain shares its parallel rays, and the
frame's axes carry it to every corner (a sun computed for each corner's own horizon would tilt twice).
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from threading import Lock

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.pipeline import Place, camera_geodetic
from seasonscapes.sky.atmosphere import Atmosphere
from seasonscapes.sky.clear_sky import TABLES_REVISION, AtmosphereTables, atmosphere_tables, load_tables, save_tables
from seasonscapes.sky.elevation_table import TABLE_REVISION, load_table, save_table
from seasonscapes.sky.ephemeris import LunarPosition, SolarPosition, moon_position, sun_position
from seasonscapes.sky.illuminate import illuminate
from seasonscapes.sky.illumination import Illumination
from seasonscapes.sky.models import AtmosphereModel, SkyModel, atmosphere_of
from seasonscapes.sky.observer_radiance import diffuse_by_elevation, observer_view
from seasonscapes.workspace import Workspace, build_once


@dataclass(frozen=True)
class Moment:
    """An instant at a place: where sun and moon stand."""

    time: datetime
    sun: SolarPosition
    moon: LunarPosition


def moment_at(time: datetime, latitude_deg: float, longitude_deg: float, height_m: float = 0.0) -> Moment:
    """Sun and moon of an aware datetime at a place."""
    return Moment(
        time,
        sun_position(time, latitude_deg, longitude_deg, height_m),
        moon_position(time, latitude_deg, longitude_deg, height_m),
    )


@lru_cache(maxsize=8)
def tables_in(workspace: Workspace, *, tabulated: bool = False):
    """Atmosphere tables by way of the workspace: computed once (some seconds), read once a process.

    ``tabulated`` brings along diffuse light by the sun's elevation, for each observer's height: some seconds and 110 MB
    more, and an instant's sky takes a third of the time. Radiances differ by less than 0.3 % while the sun is above -12°.
    """
    held: dict[Atmosphere, AtmosphereTables] = {}

    def tables_of(atmosphere: Atmosphere) -> AtmosphereTables:
        if atmosphere not in held:
            tables = build_once(
                workspace,
                "sky/tables",
                {"revision": TABLES_REVISION, "atmosphere": atmosphere},
                suffix=".npz",
                build=lambda: atmosphere_tables(atmosphere),
                save=lambda tables, path: save_tables(path, tables),
                load=load_tables,
            )
            held[atmosphere] = replace(tables, diffuse_of=_diffuse_in(workspace, tables)) if tabulated else tables
        return held[atmosphere]

    return tables_of


def _diffuse_in(workspace: Workspace, tables: AtmosphereTables) -> Callable[[float, bool], np.ndarray]:
    held: dict[tuple[float, bool], np.ndarray] = {}
    lock = Lock()  # the sky of sun and moon is worked out side by side

    def diffuse_of(height_m: float, near: bool) -> np.ndarray:
        key = (height_m, near)
        with lock:
            if key not in held:
                inputs = {
                    "revision": [TABLES_REVISION, TABLE_REVISION],
                    "atmosphere": tables.atmosphere,
                    "height_m": height_m,
                    "near": near,
                }
                held[key] = build_once(
                    workspace,
                    "sky/diffuse",
                    inputs,
                    suffix=".npy",
                    save=save_table,
                    load=load_table,
                    build=lambda: diffuse_by_elevation(tables, height_m, near),
                )
            return held[key]

    return diffuse_of


def light_at(
    model: SkyModel,
    moment: Moment,
    height_m: float,
    *,
    workspace: Workspace,
    map_height: int = 128,
    with_air: bool = True,
    tabulated: bool = False,
) -> Illumination:
    """The light of an instant for an observer at a height [m]; see `sky.illuminate` and `tables_in`."""
    from seasonscapes.rendering.hosek import hosek_illumination

    return illuminate(
        model,
        moment.sun,
        moment.moon,
        height_m=height_m,
        map_height=map_height,
        with_air=with_air,
        tables_of=tables_in(workspace, tabulated=tabulated),
        hosek=hosek_illumination,
    )


def light_for(
    place: Place, camera: Camera, model: SkyModel, time: datetime, *, map_height: int = 128, tabulated: bool = False
) -> tuple[Illumination, Moment]:
    """The light that falls on a place, seen by a camera.

    Sun, moon and sky are those at the terrain's median height, since they light the land; the sky behind it and the
    air in between are those of the camera's own height. ``map_height`` are the rows of both maps; ``tabulated`` is for
    many instants of one camera, see `tables_in`.
    """
    ground_m = median_height_m(place)
    moment = moment_at(time, place.frame.latitude_deg, place.frame.longitude_deg, ground_m)
    on_land = light_at(
        model, moment, ground_m, workspace=place.workspace, map_height=map_height, with_air=False, tabulated=tabulated
    )
    from_camera = light_at(
        model,
        moment,
        camera_geodetic(place, camera)[2],
        workspace=place.workspace,
        map_height=map_height,
        tabulated=tabulated,
    )
    return replace(
        on_land, aerial_perspective=from_camera.aerial_perspective, visible_sky=from_camera.sky_radiance
    ), moment


def tabulate_light(
    place: Place, camera: Camera, model: SkyModel, *, progress: Callable[[float], None] | None = None
) -> None:
    """Build what `light_for` looks up when ``tabulated``, where the workspace has none, before others ask for it."""
    if not isinstance(model, AtmosphereModel):
        return
    tables = tables_in(place.workspace, tabulated=True)(atmosphere_of(model))
    camera_m = camera_geodetic(place, camera)[2]
    wanted = [(median_height_m(place), False), (camera_m, False), (camera_m, True)]
    for index, (height_m, near) in enumerate(wanted):
        tables.diffuse_of(observer_view(tables, height_m).height_m, near)
        if progress is not None:
            progress((index + 1) / len(wanted))


def land_light(place: Place, model: SkyModel, time: datetime) -> tuple[Illumination, Moment]:
    """The light that a place's land receives at an instant, for receivers that no air lies before."""
    ground_m = median_height_m(place)
    moment = moment_at(time, place.frame.latitude_deg, place.frame.longitude_deg, ground_m)
    return light_at(model, moment, ground_m, workspace=place.workspace, with_air=False), moment


_medians_m: dict[int, tuple[weakref.ref, float]] = {}


def median_height_m(place: Place) -> float:
    """Median height of a place's terrain [m], whose light is taken for all of it; worked out once for a raster."""
    heights = place.elevation.values
    known = _medians_m.get(id(heights))
    if known is None or known[0]() is not heights:
        known = _medians_m[id(heights)] = (weakref.ref(heights), float(np.median(heights)))
    return known[1]
