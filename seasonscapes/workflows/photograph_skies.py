"""Which sky each photograph was taken under: the one asked for, with the clouds that the photograph's own sky shows."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.albedo.cloud_cover import grey_share
from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.errors import NoTerrainInView
from seasonscapes.images import srgb_from_linear
from seasonscapes.sky.ephemeris import sun_position
from seasonscapes.sky.models import AtmosphereModel, SkyModel

if TYPE_CHECKING:
    from seasonscapes.albedo.forward_model import TexelTransport
    from seasonscapes.cameras.observation import Observation
    from seasonscapes.workflows.place import Place

log = logging.getLogger(__name__)

# A clear sky is as grey as clouds where the sun is low, and about the sun [deg].
_LOWEST_SUN_DEG, _AROUND_SUN_DEG = 10.0, 60.0
# Below this share of grey sky a picture counts as clear: haze and clouds on the horizon are grey too.
_CLOUDY = 0.5
# Land beyond the raster seldom rises higher above the horizontal; azimuths are looked at in steps [deg].
_BEYOND_DEG, _AZIMUTH_STEP_DEG = 15.0, 0.25


def photograph_skies(
    place: Place, transport: TexelTransport, photographs: Sequence[Observation], model: SkyModel
) -> list[SkyModel]:
    """The sky model of each photograph: clouds are added to a clear one where half of the photograph's sky or more is grey.

    Without them, the blue light of a clear sky would be taken out of land that clouds lit: snow turns blue, or pink.

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
    skies: dict = {}
    for each in photographs:
        skies.setdefault((each.webcam, each.time), []).append(_grey_share(place, transport, each))
    models = {}
    for (webcam, time), shares in skies.items():
        told = [share for share in shares if share is not None]
        grey = round(float(np.median(told)), 1) if told else 0.0
        models[webcam, time] = model
        if grey >= _CLOUDY:
            log.info(
                "%s %s UTC: %.0f %% of its sky is grey: taken as clouds", webcam, f"{time:%Y-%m-%d %H:%M}", 100.0 * grey
            )
            models[webcam, time] = model.model_copy(update={"cloudiness": grey})
    _warn_of_untold(skies)
    return [models[each.webcam, each.time] for each in photographs]


def without_land_beyond(place: Place, photographs: Sequence[Observation]) -> list[Observation]:
    """Mask what looks like sky only because the heights end before it: where the land still rises at their border.

    Mountains beyond the raster, taken for a grey and dim sky, would make clouds of a clear day and falsify exposure and colours.

    Parameters
    ----------
    place
        The place; a synthetic one has nothing beyond its heights.
    photographs
        In the place's frame.

    Returns
    -------
    list of Observation
        In the same order; pixels less than 15° above the horizontal are masked in the azimuths without a known skyline.
    """
    from seasonscapes.scene import SyntheticElevation

    if isinstance(place.scene.elevation, SyntheticElevation):
        return list(photographs)
    open_to: dict[tuple, np.ndarray] = {}
    result, told = [], set()
    for each in photographs:
        camera = each.camera
        assert isinstance(camera, Camera)  # panoramas were cut into views
        key = (camera.width_px, camera.height_px, camera.fx, camera.world_from_camera.tobytes())
        if key not in open_to:
            open_to[key] = _under_unknown_skyline(place, camera)
        beyond = open_to[key] & each.mask
        webcam = each.webcam.split("/")[0]
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
    """Pixels ``(H, W)`` bool without ground in them that land beyond the raster may fill."""
    from seasonscapes.calibration.terrain_horizon import HorizonOptions, horizon_from

    directions = ray_directions(camera)
    unknown = np.zeros(directions.shape[:2], bool)
    options = HorizonOptions(below_ground_m=np.inf)
    try:
        azimuths = np.arange(0.0, 360.0, _AZIMUTH_STEP_DEG)
        horizon = horizon_from([place.elevation], place.frame, camera.position_m, azimuth_deg=azimuths, options=options)
    except NoTerrainInView:
        return unknown
    east, north, up = np.moveaxis(directions @ horizon.axes.T, -1, 0)
    column = np.rint(np.degrees(np.arctan2(east, north)) % 360.0 / _AZIMUTH_STEP_DEG).astype(int) % len(azimuths)
    highest = horizon.edge_of_heights_deg[column]
    elevation_deg = np.degrees(np.arcsin(np.clip(up, -1.0, 1.0)))
    return np.isfinite(highest) & (elevation_deg > highest) & (elevation_deg < _BEYOND_DEG)


def _warn_of_untold(skies: dict[tuple[str, datetime], list[float | None]]) -> None:
    """Say which pictures tell nothing of their weather; a panorama tells it in any of its views."""
    told: dict[tuple[str, datetime], bool] = {}
    for (view, time), shares in skies.items():
        webcam = view.split("/")[0]
        told[webcam, time] = told.get((webcam, time), False) or any(share is not None for share in shares)
    untold = [f"{webcam} {time:%Y-%m-%d %H:%M} UTC" for (webcam, time), known in told.items() if not known]
    if untold:
        log.warning(
            "%s: the weather is not told, since no unclipped sky away from the sun is seen: taken as clear; where clouds hid the sun, "
            "state --sky overcast or --cloudiness",
            ", ".join(untold),
        )


def _grey_share(place: Place, transport: TexelTransport, photograph: Observation) -> float | None:
    """See `grey_share`, away from the sun; ``None`` for a low one."""
    from seasonscapes.rendering.sightlines import visible_faces

    sun = sun_position(photograph.time, place.frame.latitude_deg, place.frame.longitude_deg)
    if float(np.asarray(sun.elevation_deg)) < _LOWEST_SUN_DEG:
        return None
    camera = photograph.camera
    assert isinstance(camera, Camera)  # panoramas were cut into views
    away = ray_directions(camera) @ sun.direction < np.cos(np.radians(_AROUND_SUN_DEG))
    sky = (visible_faces(transport.ray_scene, camera) < 0) & photograph.mask & away
    return grey_share(srgb_from_linear(np.clip(photograph.image, 0.0, 1.0)), sky)
