"""The light of a place at an instant: ephemeris, sky model and atmosphere tables brought together.

The sun is placed once, at the origin of the scene's frame: all of the terrain shares its parallel rays, and the
frame's axes carry it to every corner (a sun computed for each corner's own horizon would tilt twice).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.pipeline import Place, camera_geodetic
from seasonscapes.sky.air import Atmosphere
from seasonscapes.sky.atmosphere import (
    TABLES_REVISION,
    AtmosphereTables,
    atmosphere_tables,
    load_tables,
    save_tables,
)
from seasonscapes.sky.ephemeris import LunarPosition, SolarPosition, moon_position, sun_position
from seasonscapes.sky.illuminate import illuminate
from seasonscapes.sky.illumination import Illumination
from seasonscapes.sky.models import SkyModel
from seasonscapes.workspace import Workspace, build_once


@dataclass(frozen=True)
class Moment:
    """An instant at a place: where sun and moon stand."""

    time: datetime
    sun: SolarPosition
    moon: LunarPosition


def moment_at(time: datetime, latitude_deg: float, longitude_deg: float, height_m: float = 0.0) -> Moment:
    """Sun and moon of an aware datetime at a place."""
    return Moment(time, sun_position(time, latitude_deg, longitude_deg, height_m),
                  moon_position(time, latitude_deg, longitude_deg, height_m))  # fmt: skip


@lru_cache(maxsize=4)
def tables_in(workspace: Workspace):
    """Atmosphere tables by way of the workspace: computed once (tens of seconds), read once a process."""
    held: dict[Atmosphere, AtmosphereTables] = {}

    def tables_of(atmosphere: Atmosphere) -> AtmosphereTables:
        if atmosphere not in held:
            held[atmosphere] = build_once(
                workspace, "sky/tables", {"revision": TABLES_REVISION, "atmosphere": atmosphere}, suffix=".npz",
                build=lambda: atmosphere_tables(atmosphere), save=lambda tables, path: save_tables(path, tables),
                load=load_tables,
            )  # fmt: skip
        return held[atmosphere]

    return tables_of


def light_at(
    model: SkyModel,
    moment: Moment,
    height_m: float,
    *,
    workspace: Workspace,
    map_height: int = 128,
    with_air: bool = True,
) -> Illumination:
    """The light of an instant for an observer at a height [m]; see `sky.illuminate`."""
    from seasonscapes.rendering.hosek import hosek_illumination

    return illuminate(model, moment.sun, moment.moon, height_m=height_m, map_height=map_height, with_air=with_air,
                      tables_of=tables_in(workspace), hosek=hosek_illumination)  # fmt: skip


def light_for(place: Place, camera: Camera, model: SkyModel, time: datetime, *,
              map_height: int = 128) -> tuple[Illumination, Moment]:  # fmt: skip
    """The light that falls on a place, seen by a camera.

    Sun, moon and sky are those at the terrain's median height, since they light the land; the sky behind it and the
    air in between are those of the camera's own height. ``map_height`` are the rows of both maps.
    """
    heights = place.elevation.values
    ground_m = float(np.median(heights))
    moment = moment_at(time, place.frame.latitude_deg, place.frame.longitude_deg, ground_m)
    on_land = light_at(model, moment, ground_m, workspace=place.workspace, map_height=map_height,
                       with_air=False)  # fmt: skip
    camera_m = camera_geodetic(place, camera)[2]
    from_camera = light_at(model, moment, camera_m, workspace=place.workspace, map_height=map_height)
    return replace(
        on_land, aerial_perspective=from_camera.aerial_perspective, visible_sky=from_camera.sky_radiance
    ), moment
