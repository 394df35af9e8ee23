"""Illumination of a place at an instant: ephemeris, sky model and atmosphere tables.

The sun is computed once, at the origin of the scene's frame: all of the terrain shares its parallel rays, and the
frame's axes hold everywhere (a sun computed for each position's own horizon would be tilted twice).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache, partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.civil_time import resolve_time
from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame
from seasonscapes.progress import TaskProgress
from seasonscapes.sky.atmosphere import Atmosphere
from seasonscapes.sky.clear_sky import (
    LOWEST_SHINING_DEG,
    AtmosphereTables,
    atmosphere_tables,
    load_tables,
    save_tables,
    true_elevation_deg,
)
from seasonscapes.sky.eclipses import lunar_eclipse
from seasonscapes.sky.elevation_table import PartedTable, load_table, parts_at, save_table
from seasonscapes.sky.ephemeris import LunarPosition, SolarPosition, at_index, moon_position, sun_position
from seasonscapes.sky.illuminate import SkyEvaluators, illuminate, significant_moon
from seasonscapes.sky.illumination import Illumination
from seasonscapes.sky.models import AtmosphereModel, SkyModel, atmosphere_from_model, read_sky_model, with_overrides
from seasonscapes.sky.observer_radiance import LOWEST_DAY_DEG, observer_view
from seasonscapes.sky.shipped_tables import shipped_tables
from seasonscapes.sky.tables_by_elevation import day_by_elevation, diffuse_by_elevation, moon_by_elevation
from seasonscapes.workspace import Workspace, build_once

if TYPE_CHECKING:
    from seasonscapes.cameras.panorama import Panorama
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.workflows.place import Place

_TABLES_CODE, _BY_ELEVATION_CODE = ("sky.clear_sky",), ("sky.tables_by_elevation",)
# With the sun above this elevation [deg] the night sky's own light is less than a millionth of the sky's.
_NO_STAR_DEG = 1.0


@dataclass(frozen=True)
class SunMoonPosition:
    """Sun and moon at one instant and position; see `sky.ephemeris`.

    Parameters
    ----------
    time
        Aware.
    sun, moon
        Apparent topocentric positions.
    """

    time: datetime
    sun: SolarPosition
    moon: LunarPosition


def sun_moon_position(
    time: str | datetime, latitude_deg: float, longitude_deg: float, height_m: float = 0.0
) -> SunMoonPosition:
    """Return the positions of sun and moon.

    Parameters
    ----------
    time
        An aware datetime, or ISO 8601 text; without offset it is civil time at the position.
    latitude_deg, longitude_deg, height_m
        WGS 84 position of the observer [deg, m].

    Returns
    -------
    SunMoonPosition
        Azimuths clockwise from true north and elevations with refraction [deg].

    Raises
    ------
    ValueError
        For a naive datetime, or one outside the ephemeris (JPL DE421).

    Examples
    --------
    >>> import seasonscapes as ss
    >>> position = ss.sun_moon_position("2024-06-20T13:30", 46.55, 7.98)
    >>> round(float(position.sun.elevation_deg), 1)
    66.9
    """
    if isinstance(time, str):
        time = resolve_time(time, latitude_deg, longitude_deg).utc
    return SunMoonPosition(
        time,
        sun_position(time, latitude_deg, longitude_deg, height_m),
        moon_position(time, latitude_deg, longitude_deg, height_m),
    )


def sky_model(
    name: str | Path | SkyModel = "clear",
    *,
    turbidity: float | None = None,
    visibility_km: float | None = None,
    ozone_du: float | None = None,
    cloudiness: float | None = None,
) -> SkyModel:
    """Return a sky model by name, with some of its parameters replaced.

    Parameters
    ----------
    name
        A bundled model (``"clear"``, ``"alpine_winter"``, ``"hazy"``, ``"saharan_dust"``, ``"overcast"``,
        ``"hosek"``), a TOML file, or a model.
    turbidity
        Haze as ``(τ_gas + τ_aerosol) / τ_gas`` at 550 nm: 1 is pure air, 3 clear, 6 hazy.
    visibility_km
        Haze as meteorological range [km]; give this or ``turbidity``.
    ozone_du
        Ozone column [Dobson units].
    cloudiness
        Share of the sky that clouds cover, in [0, 1].

    Raises
    ------
    InputError
        For an unknown name, or a parameter that the model does not have or that is out of range.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> ss.sky_model("clear", visibility_km=25.0).name
    'clear'
    """
    model = name if isinstance(name, SkyModel) else read_sky_model(name)
    return with_overrides(
        model, turbidity=turbidity, visibility_km=visibility_km, ozone_du=ozone_du, cloudiness=cloudiness
    )


def illumination(
    place: Place, time: str | datetime, *, sky: str | Path | SkyModel = "clear", camera: Camera | Panorama | None = None
) -> Illumination:
    """Compute the light of an instant at a place: sun, moon, sky radiance and aerial perspective.

    Parameters
    ----------
    place
        Sun, moon and sky are those at its median height.
    time
        An aware datetime, or ISO 8601 text; without offset it is civil time at the place.
    sky
        A sky model, its name or its file; see `sky_model`.
    camera
        The observer whose aerial perspective and visible sky are wanted. Without one, the result lights surfaces but
        has no air between them and a viewer.

    Returns
    -------
    Illumination
        Photometric linear Rec.709: radiances in cd/m², illuminances in lux; directions east-north-up.

    Raises
    ------
    InputError
        For a time or sky model that is none, or a sun outside the model's range.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> light = ss.illumination(place, "2024-06-20T13:30", sky="hosek")
    >>> light.sky_radiance.shape[2], bool(light.sun.normal_illuminance_lx[1] > 80_000)
    (3, True)
    """
    # Here, since the sky of a position alone needs no place.
    from seasonscapes.workflows.place import utc_at

    model, utc = sky_model(sky), utc_at(place, time)
    if camera is None:
        return illumination_on_terrain(place, model, utc)[0]
    return illumination_for_camera(place, camera, model, utc)[0]


@lru_cache(maxsize=8)
def atmosphere_tables_in(
    workspace: Workspace, *, by_elevation: bool = False
) -> Callable[[Atmosphere], AtmosphereTables]:
    """Return a function that gives an atmosphere's tables: those of the bundled sky models are shipped, others computed once
    and kept in the workspace.

    Parameters
    ----------
    workspace
        Where tables are kept.
    by_elevation
        Also tabulate diffuse light, and all light of sky and air from a sun or moon that is up, over the elevation of sun or
        moon for each observer height, by parts as they are needed, which costs time and space once and makes the sky of an
        instant quicker. Radiances differ by less than 0.3 % while the sun is above -12°; in the haze of ``hazy`` by up to
        0.5 % where it is above 70°.
    """
    tables: dict[Atmosphere, AtmosphereTables] = {}

    def tables_of(atmosphere: Atmosphere) -> AtmosphereTables:
        if atmosphere not in tables:
            built = shipped_tables(atmosphere) or build_once(
                workspace,
                "sky/tables",
                {"atmosphere": atmosphere},
                code=_TABLES_CODE,
                suffix=".npz",
                build=lambda: atmosphere_tables(atmosphere),
                save=lambda tables, path: save_tables(path, tables),
                load=load_tables,
            )
            if by_elevation:
                built = replace(
                    built,
                    diffuse_of=_parted_in(workspace, built, "sky/diffuse", diffuse_by_elevation),
                    day_of=_parted_in(workspace, built, "sky/day", day_by_elevation),
                    moon_of=_parted_in(workspace, built, "sky/moon", moon_by_elevation),
                )
            tables[atmosphere] = built
        return tables[atmosphere]

    return tables_of


def _parted_in(
    workspace: Workspace, tables: AtmosphereTables, folder: str, tabulate: Callable[..., np.ndarray]
) -> Callable[[float, bool], PartedTable]:
    """Tables by elevation of every height of an observer, kept in the workspace part by part."""
    cached: dict[tuple[float, bool], PartedTable] = {}
    lock = Lock()

    def part_of(height_m: float, near: bool, part: int) -> np.ndarray:
        with lock:
            return build_once(
                workspace,
                folder,
                {"atmosphere": tables.atmosphere, "height_m": height_m, "near": near, "part": part},
                code=_BY_ELEVATION_CODE,
                suffix=".npy",
                build=lambda: tabulate(tables, height_m, near, part=part),
                save=save_table,
                load=load_table,
            )

    def table_of(height_m: float, near: bool) -> PartedTable:
        return cached.setdefault((height_m, near), PartedTable(partial(part_of, height_m, near)))

    return table_of


def illumination_at(
    model: SkyModel,
    position: SunMoonPosition,
    height_m: float,
    *,
    workspace: Workspace,
    map_height: int = 128,
    with_aerial_perspective: bool = True,
    by_elevation: bool = False,
) -> Illumination:
    """Compute the light for an observer at a height.

    Parameters
    ----------
    model
        The sky model.
    position
        Sun and moon.
    height_m
        Height of the observer [m].
    workspace
        Where atmosphere tables are kept.
    map_height
        Rows of the sky map.
    with_aerial_perspective
        Whether to compute the aerial perspective.
    by_elevation
        See `atmosphere_tables_in`.
    """
    from seasonscapes.rendering.hosek import hosek_illumination

    light = illuminate(
        model,
        position.sun,
        position.moon,
        height_m=height_m,
        map_height=map_height,
        with_aerial_perspective=with_aerial_perspective,
        evaluators=SkyEvaluators(atmosphere_tables_in(workspace, by_elevation=by_elevation), hosek_illumination),
    )
    return replace(light, time=position.time)


def illumination_for_camera(
    place: Place,
    camera: Camera | Panorama,
    model: SkyModel,
    time: datetime,
    *,
    map_height: int = 128,
    by_elevation: bool = False,
    of_another_camera: Illumination | None = None,
) -> tuple[Illumination, SunMoonPosition]:
    """Compute the light on a place as seen by a camera, and the positions of sun and moon.

    Sun, moon and sky are those at the terrain's median height, since they light the terrain; the visible sky and the
    aerial perspective are those of the camera's own height.

    Parameters
    ----------
    place, camera
        The camera's pose is in the place's frame.
    model
        The sky model.
    time
        Aware.
    map_height
        Rows of both sky maps; with ``by_elevation`` the visible one is empty by day, where the aerial perspective holds all of it.
    by_elevation
        For many instants of one camera; see `atmosphere_tables_in`.
    of_another_camera
        What this function found for another camera at the same instant under the same model: its light on the terrain is taken.

    Raises
    ------
    ValueError
        Where the light of the other camera is of another instant.
    """
    from seasonscapes.workflows.views import camera_geodetic

    if of_another_camera is not None and of_another_camera.time != time:
        raise ValueError(f"illumination_for_camera: got the light of {of_another_camera.time}, expected that of {time}")
    position = _position_in_film(place, time) if by_elevation else position_at(place, time)
    on_terrain = of_another_camera or illumination_at(
        model,
        position,
        place.median_height_m,
        workspace=place.workspace,
        map_height=map_height,
        with_aerial_perspective=False,
        by_elevation=by_elevation,
    )
    # By day no star is seen, and the aerial perspective knows the sky in more detail than a map.
    cloudless = isinstance(model, AtmosphereModel) and model.cloudiness == 0.0
    all_in_air = by_elevation and cloudless and position.sun.elevation_deg > _NO_STAR_DEG
    at_camera = illumination_at(
        model,
        position,
        camera_geodetic(place, camera)[2],
        workspace=place.workspace,
        map_height=0 if all_in_air else map_height,
        by_elevation=by_elevation,
    )
    light = replace(
        on_terrain,
        aerial_perspective=at_camera.aerial_perspective,
        visible_sky=at_camera.sky_radiance,
        frame=place.frame,
    )
    return light, position


def illumination_on_terrain(place: Place, model: SkyModel, time: datetime) -> tuple[Illumination, SunMoonPosition]:
    """Compute the light that a place's terrain receives, without aerial perspective, and where sun and moon stand."""
    position = position_at(place, time)
    light = illumination_at(
        model, position, place.median_height_m, workspace=place.workspace, with_aerial_perspective=False
    )
    return replace(light, frame=place.frame), position


def position_at(place: Place, time: datetime) -> SunMoonPosition:
    """Sun and moon over the origin of a place at an aware instant."""
    return sun_moon_position(time, place.frame.latitude_deg, place.frame.longitude_deg, place.median_height_m)


def _position_in_film(place: Place, time: datetime) -> SunMoonPosition:
    """`position_at` for an instant of many: those of its day at the same minute are computed with it, for the price of one."""
    utc = time.astimezone(UTC)
    where = (place.frame.latitude_deg, place.frame.longitude_deg, place.median_height_m)
    suns, moons = _positions_of_day(utc.replace(hour=0), *where)
    return SunMoonPosition(time, at_index(suns, utc.hour), at_index(moons, utc.hour))


@lru_cache(maxsize=4)
def _positions_of_day(
    midnight: datetime, latitude_deg: float, longitude_deg: float, height_m: float
) -> tuple[SolarPosition, LunarPosition]:
    """Sun and moon at the 24 hours of a day from an aware instant in its first hour on."""
    times = [midnight + timedelta(hours=hour) for hour in range(24)]
    where = (latitude_deg, longitude_deg, height_m)
    return sun_position(times, *where), moon_position(times, *where)


def given_sun_position(place: Place, azimuth_deg: float, elevation_deg: float) -> SunMoonPosition:
    """A sun at stated angles over a place; see `given_sun_in_frame`."""
    return given_sun_in_frame(place.frame, azimuth_deg, elevation_deg)


def given_sun_in_frame(frame: LocalFrame, azimuth_deg: float, elevation_deg: float) -> SunMoonPosition:
    """A sun at stated angles over the origin of a frame, without a moon; its instant stands for no date.

    Raises
    ------
    InputError
        For angles that are none.
    """
    if not (-360.0 <= azimuth_deg <= 360.0 and -18.0 <= elevation_deg <= 90.0):
        expected = "azimuth -360 to 360, elevation -18 to 90"
        raise InputError("--sun", "out of range", got=f"{azimuth_deg:g},{elevation_deg:g}", expected=expected)
    instant = datetime(2024, 6, 1, 12, tzinfo=UTC)
    position = sun_moon_position(instant, frame.latitude_deg, frame.longitude_deg, frame.height_m)
    hidden = replace(position.moon, elevation_deg=-60.0, true_elevation_deg=-60.0)
    return SunMoonPosition(instant, SolarPosition(azimuth_deg, elevation_deg, elevation_deg, 1.0), hidden)


def tabulate_illumination(
    place: Place,
    camera: Camera | Panorama,
    model: SkyModel,
    times: Sequence[datetime],
    *,
    progress: TaskProgress | None = None,
) -> None:
    """Build the tables that `illumination_for_camera` reads at these times with ``by_elevation``, before other processes need them."""
    from seasonscapes.workflows.views import camera_geodetic

    if not times or not isinstance(model, AtmosphereModel):
        return
    tables = atmosphere_tables_in(place.workspace, by_elevation=True)(atmosphere_from_model(model))
    assert tables.diffuse_of is not None
    assert tables.day_of is not None
    assert tables.moon_of is not None
    where = (place.frame.latitude_deg, place.frame.longitude_deg, place.median_height_m)
    # All instants at once: one by one, those of a year take minutes.
    suns, moons = sun_position(times, *where), moon_position(times, *where)
    sun_deg, moon_deg, eclipsed = [], [], []
    for index in range(len(times)):
        sun = at_index(suns, index)
        moon = significant_moon(sun, at_index(moons, index))
        sun_deg.append(sun.elevation_deg)
        if moon is not None:
            moon_deg.append(moon.elevation_deg)
            # Its light has another colour, for which there is no table.
            eclipsed.append(lunar_eclipse(moon) is not None)
    camera_m, wanted = camera_geodetic(place, camera)[2], []
    for height_m, near in ((place.median_height_m, False), (camera_m, False), (camera_m, True)):
        sun_rad, moon_rad = (
            np.radians(true_elevation_deg(tables.atmosphere, np.array(each, float), height_m))
            for each in (sun_deg, moon_deg)
        )
        sun_up, moon_up = (each >= np.radians(LOWEST_DAY_DEG) for each in (sun_rad, moon_rad))
        moon_up &= ~np.array(eclipsed, bool)
        for table_of, true_rad in (
            (tables.day_of, sun_rad[sun_up]),
            (tables.moon_of, moon_rad[moon_up]),
            (tables.diffuse_of, np.concatenate([sun_rad[~sun_up], moon_rad[~moon_up]])),
        ):
            table = table_of(observer_view(tables, height_m).height_m, near)
            assert isinstance(table, PartedTable)
            shining = true_rad[true_rad > np.radians(LOWEST_SHINING_DEG)]
            wanted += [(table, part) for part in sorted({part for each in shining for part in parts_at(each)})]
    for number, (table, part) in enumerate(wanted):
        table.part(part)
        if progress is not None:
            progress((number + 1) / len(wanted))
