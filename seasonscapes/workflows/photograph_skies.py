"""Which sky each photograph was taken under: the one asked for, with the clouds that the photograph's own sky shows."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.albedo.cloud_cover import grey_share
from seasonscapes.cameras.observation import webcam_of
from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.frames import MEAN_RADIUS_M, geodetic_from_enu
from seasonscapes.images import srgb_from_linear
from seasonscapes.sky.ephemeris import sun_position
from seasonscapes.sky.models import AtmosphereModel, SkyModel

if TYPE_CHECKING:
    from seasonscapes.albedo.forward_model import TexelTransport
    from seasonscapes.calibration.terrain_horizon import Horizon
    from seasonscapes.cameras.observation import Observation
    from seasonscapes.terrain.surface import Raster
    from seasonscapes.workflows.place import Place

log = logging.getLogger(__name__)

# A clear sky is as grey as clouds where the sun is low, and about the sun [deg].
_LOWEST_SUN_DEG, _AROUND_SUN_DEG = 10.0, 60.0
# Below this share of grey sky a picture counts as clear: haze and clouds on the horizon are grey too.
_CLOUDY = 0.5
# Azimuths are looked at in steps [deg].
_AZIMUTH_STEP_DEG = 0.25
# Land rises to the border of its heights where it does so by 10 m per km over the last fifth of the way there, or over two cells.
_RISING, _LAST_SHARE, _LAST_CELLS = 0.01, 0.2, 2.0
# Flanks of whole mountains rise by 500 m per km at most, though single walls are steeper.
_STEEPEST = 0.5

# A webcam and its instant; views of a panorama have it in common.
_Moment = tuple[str, datetime]


def photograph_skies(
    place: Place, transport: TexelTransport, photographs: Sequence[Observation], model: SkyModel
) -> list[SkyModel]:
    """The sky model of each photograph: clouds are added to a clear one where half of the photograph's sky or more is grey.

    Without them, the blue light of a clear sky would be taken out of land that clouds lit: snow turns blue, or pink. Views of one
    panorama have one sky, which those decide that show it.

    Parameters
    ----------
    place
        The place.
    transport
        Of its texels; what terrain covers in a photograph is no sky.
    photographs
        In the place's frame.
    model
        The sky asked for; one that states its cloudiness stays as it is, a clear one (0) too.
    """
    if not isinstance(model, AtmosphereModel) or model.states_clouds:
        return [model] * len(photographs)
    shares: dict[_Moment, list[tuple[float, int]]] = {}
    low_sun: set[_Moment] = set()
    for each in photographs:
        moment = webcam_of(each.webcam), each.time
        told = shares.setdefault(moment, [])
        sun = sun_position(each.time, place.frame.latitude_deg, place.frame.longitude_deg)
        if float(np.asarray(sun.elevation_deg)) < _LOWEST_SUN_DEG:
            low_sun.add(moment)
            continue
        share = _grey_share(transport, each, sun.direction)
        if share is not None:
            told.append(share)
    models = {}
    for moment, told in shares.items():
        # Views of a panorama count by how much sky each of them shows.
        seen_px = sum(count for _, count in told)
        grey = round(sum(share * count for share, count in told) / seen_px, 1) if told else 0.0
        models[moment] = model
        if grey >= _CLOUDY:
            log.info("%s: %.0f %% of its sky is grey: taken as clouds", _name(moment), 100.0 * grey)
            models[moment] = model.model_copy(update={"cloudiness": grey})
    _warn_of_untold([moment for moment, told in shares.items() if not told], low_sun)
    return [models[webcam_of(each.webcam), each.time] for each in photographs]


def without_land_beyond(place: Place, photographs: Sequence[Observation]) -> list[Observation]:
    """Mask what looks like sky only because the heights end before it.

    Mountains beyond the raster, taken for a grey and dim sky, would make clouds of a clear day and falsify exposure and colours.
    Where the highest land of an azimuth is the border of the heights, nothing below the horizon is sky. Where the land rises to
    that border, neither is what it may rise to farther on: by as much again as the highest of all heights lies above the lowest, at
    500 m per km.

    Parameters
    ----------
    place
        The place; a synthetic one has nothing beyond its heights.
    photographs
        In the place's frame.

    Returns
    -------
    list of Observation
        In the same order, with masks that leave such pixels out.

    Raises
    ------
    NoTerrainInView
        Where a camera has none of the heights about it at all.
    """
    from seasonscapes.scene import SyntheticElevation

    if isinstance(place.scene.elevation, SyntheticElevation):
        return list(photographs)
    open_to: dict[tuple, np.ndarray] = {}
    result, told = [], set()
    for each in photographs:
        camera = each.camera
        assert isinstance(camera, Camera)  # panoramas were cut into views
        lens = (camera.fx, camera.fy, camera.cx, camera.cy)
        key = (camera.width_px, camera.height_px, lens, camera.world_from_camera.tobytes())
        if key not in open_to:
            open_to[key] = _under_unknown_skyline(place, camera)
        beyond = open_to[key] & each.mask
        webcam = webcam_of(each.webcam)
        if beyond.any() and webcam not in told:
            told.add(webcam)
            log.warning(
                "%s: the heights end before the skyline in %.0f %% of its columns: nothing there is taken for sky; heights that reach "
                "farther would tell",
                webcam,
                100.0 * float(open_to[key].any(axis=0).mean()),
            )
        result.append(replace(each, mask=each.mask & ~open_to[key]) if beyond.any() else each)
    return result


def _under_unknown_skyline(place: Place, camera: Camera) -> np.ndarray:
    """Pixels ``(H, W)`` bool above the border of the heights that land beyond it may fill."""
    from seasonscapes.calibration.terrain_horizon import HorizonOptions, horizon_from

    # All of the heights are within reach, so that they end at their border alone.
    away_m = np.hypot(*(place.terrain.vertices[:, :2] - camera.position_m[:2]).T)
    options = HorizonOptions(below_ground_m=np.inf, reach_m=1.1 * float(away_m.max()))
    azimuths = np.arange(0.0, 360.0, _AZIMUTH_STEP_DEG)
    rasters = place.height_rasters
    horizon = horizon_from(rasters, place.frame, camera.position_m, azimuth_deg=azimuths, options=options)
    highest_deg = _highest_beyond_deg(place, rasters, horizon)
    directions = ray_directions(camera)
    east, north, up = np.moveaxis(directions @ horizon.axes.T, -1, 0)
    column = np.rint(np.degrees(np.arctan2(east, north)) % 360.0 / _AZIMUTH_STEP_DEG).astype(int) % len(azimuths)
    elevation_deg = np.degrees(np.arcsin(np.clip(up, -1.0, 1.0)))
    # Comparisons with NaN are false: a known skyline, or no land at all.
    return (elevation_deg > horizon.edge_of_heights_deg[column]) & (elevation_deg < highest_deg[column])


def _highest_beyond_deg(place: Place, rasters: Sequence[Raster], horizon: Horizon) -> np.ndarray:
    """Elevation angle ``(A,)`` that land beyond the border of the heights may reach [deg]; NaN where the skyline is known."""
    from seasonscapes.calibration.terrain_horizon import cell_size_m, terrain_height

    eye_m, border_m = horizon.position_m, horizon.edge_of_heights_m
    found = np.flatnonzero(np.isfinite(horizon.edge_of_heights_deg))
    result = np.full(len(border_m), np.nan)
    if not len(found):
        return result
    border_m = border_m[found]
    distance_m = np.linalg.norm(border_m[:, :2] - eye_m[:2], axis=1)
    last_m = np.maximum(_LAST_SHARE * distance_m, _LAST_CELLS * cell_size_m(place.elevation))
    before_m = border_m - np.minimum(last_m / distance_m, 0.5)[:, None] * (border_m - eye_m)
    border_height_m = geodetic_from_enu(place.frame, border_m)[2]
    latitude, longitude, _ = geodetic_from_enu(place.frame, before_m)
    before_height_m = terrain_height(rasters, latitude, longitude)
    step_m = np.linalg.norm((border_m - before_m)[:, :2], axis=1)
    rises = border_height_m - before_height_m > _RISING * step_m
    eye_height_m = float(geodetic_from_enu(place.frame, eye_m)[2])
    curvature = (1.0 - place.frame.refraction_k) / (2.0 * MEAN_RADIUS_M)
    # The horizon of a sphere through the border, which lies lower than the eye.
    below_m = np.maximum(eye_height_m - border_height_m, 0.0)
    horizon_deg = np.where(below_m > 0.0, -np.degrees(np.arctan(2.0 * np.sqrt(curvature * below_m))), -90.0)
    relief_m = float(np.ptp(place.elevation.values))
    crest_m = distance_m + relief_m / _STEEPEST
    crest_height_m = border_height_m + relief_m - curvature * crest_m**2
    crest_deg = np.degrees(np.arctan((crest_height_m - eye_height_m) / crest_m))
    result[found] = np.maximum(horizon_deg, np.where(rises, crest_deg, -90.0))
    return result


def _name(moment: _Moment) -> str:
    return f"{moment[0]} {moment[1]:%Y-%m-%d %H:%M} UTC"


def _warn_of_untold(untold: list[_Moment], low_sun: set[_Moment]) -> None:
    """Say which photographs tell nothing of their weather, and why."""
    reasons = {
        f"the sun stands lower than {_LOWEST_SUN_DEG:.0f}°, where a clear sky is as grey as clouds": [
            each for each in untold if each in low_sun
        ],
        "no unclipped sky away from the sun is seen": [each for each in untold if each not in low_sun],
    }
    for reason, moments in reasons.items():
        if moments:
            log.warning(
                "%s: the weather is not told, since %s: taken as clear; where clouds hid the sun, state --sky overcast or --cloudiness",
                ", ".join(map(_name, moments)),
                reason,
            )


def _grey_share(
    transport: TexelTransport, photograph: Observation, sun_direction: np.ndarray
) -> tuple[float, int] | None:
    """See `grey_share`, away from the sun, and the number of pixels of that sky; ``None`` where it is not told."""
    from seasonscapes.rendering.sightlines import visible_faces

    camera = photograph.camera
    assert isinstance(camera, Camera)  # panoramas were cut into views
    away = ray_directions(camera) @ sun_direction < np.cos(np.radians(_AROUND_SUN_DEG))
    sky = (visible_faces(transport.ray_scene, camera) < 0) & photograph.mask & away
    share = grey_share(srgb_from_linear(np.clip(photograph.image, 0.0, 1.0)), sky)
    return None if share is None else (share, int(sky.sum()))
