"""Methods of albedo recovery at a place: the closed form, and the joint recovery with the unknowns that a place gives it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.cameras.observation import Observation
from seasonscapes.errors import AtlasMismatch
from seasonscapes.progress import Progress, task_progress
from seasonscapes.sky.models import SkyModel, visibility_km, with_overrides
from seasonscapes.terrain.surface import Texture
from seasonscapes.workflows.illumination import illumination_for_camera
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.terrain_building import sample_spacing_m

if TYPE_CHECKING:
    from seasonscapes.albedo.closed_form import AlbedoFit
    from seasonscapes.albedo.forward_model import TexelTransport
    from seasonscapes.albedo.joint_recovery import JointRecovery
    from seasonscapes.albedo.photographs import AlbedoPhotograph
    from seasonscapes.albedo.recovery_pictures import HazeLights
    from seasonscapes.sky.illumination import Illumination

log = logging.getLogger(__name__)

METHODS = ("closed", "differentiable")
# Thick haze to polar air [km]; light in between is interpolated, linearly in extinction.
_VISIBILITIES_KM = (12.0, 25.0, 50.0, 100.0)


@dataclass(frozen=True)
class PaintedTexture:
    """A painting of a place as an observation of its albedo.

    Parameters
    ----------
    time
        The instant that it shows, aware UTC.
    texture
        Radiance [cd/m²] with weights, such as `paint` makes.
    name
        Where it came from, for messages.
    confidence
        Factor on the weights, in (0, 1]: a painting of photographs that are given as well repeats their errors.
    sky
        What it was painted under; ``None`` for the sky that is asked for.

    Examples
    --------
    >>> from datetime import UTC, datetime
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> lit = ss.scene_albedo(place, "2024-07-20")
    >>> ss.PaintedTexture(datetime(2024, 7, 20, 10, tzinfo=UTC), lit).name
    'painted'
    """

    time: datetime
    texture: Texture
    name: str = "painted"
    confidence: float = 1.0
    sky: SkyModel | None = None


def illuminations(place: Place, photographs: Sequence[Observation], models: Sequence[SkyModel]) -> list[Illumination]:
    """The light of each photograph under its sky, as seen from its camera; those of one position, instant and sky share it."""
    lights: dict = {}
    found = []
    for photograph, model in zip(photographs, models, strict=True):
        camera, instant = photograph.camera, (photograph.time, model.model_dump_json())
        of_cameras, position = lights.setdefault(instant, {}), camera.position_m.tobytes()
        if position not in of_cameras:
            other = next(iter(of_cameras.values()), None)
            of_cameras[position], _ = illumination_for_camera(
                place, camera, model, photograph.time, of_another_camera=other
            )
        found.append(of_cameras[position])
    return found


def painted_photographs(
    place: Place, transport: TexelTransport, painted: Sequence[PaintedTexture], models: Sequence[SkyModel]
) -> list[AlbedoPhotograph]:
    """Observations of painted textures under the light of their instants and skies.

    Raises
    ------
    AtlasMismatch
        For a painting of another atlas.
    """
    from seasonscapes.albedo.painted_textures import painted_photograph
    from seasonscapes.workflows.illumination import illumination

    result = []
    for each, model in zip(painted, models, strict=True):
        if each.texture.values.shape[:2] != place.texture_shape or each.texture.atlas_id not in (None, place.atlas_id):
            raise AtlasMismatch(
                f"{each.name}: painted in another atlas than the scene has now; give the --texel-m, --atlas and mesh "
                "options that it was painted with"
            )
        light = illumination(place, each.time, sky=model)
        made = painted_photograph(transport, each.texture, light, each.time, each.name)
        assert made.confidence is not None, "a painting has weights"
        result.append(replace(made, confidence=made.confidence * np.float32(each.confidence)))
    return result


def closed_fit(
    transport: TexelTransport, photographs: list[AlbedoPhotograph], progress: Progress | None = None
) -> AlbedoFit:
    """The closed form of 8-bit photographs."""
    from seasonscapes.albedo.closed_form import solve_albedo
    from seasonscapes.albedo.photographs import EIGHT_BIT

    report = task_progress(progress, "albedo")
    return solve_albedo(transport, photographs, noise_model=EIGHT_BIT, progress=report)


def tilted_fit(
    place: Place,
    transport: TexelTransport,
    photographs: list[AlbedoPhotograph],
    start: AlbedoFit,
    progress: Progress | None = None,
) -> tuple[np.ndarray, AlbedoFit, dict[str, Any]]:
    """Tilts ``(R, S, 3)`` of the texels' normals, the closed form under them, and what was found as plain values."""
    from seasonscapes.albedo.photographs import EIGHT_BIT
    from seasonscapes.albedo.subgrid_normals import FEWEST_SUNS, solve_tilts, tilt_sigma

    spacing_m = sample_spacing_m(place.elevation)
    sigma = tilt_sigma(place.elevation.values[..., 0], spacing_m, place.atlas.texel_p50_m)
    report = task_progress(progress, "normals below the heights")
    tilt, fit = solve_tilts(transport, photographs, start, sigma, noise_model=EIGHT_BIT, progress=report)
    tilted = np.linalg.norm(tilt, axis=-1)
    found = tilted > 0.0
    if not found.any():
        log.warning("no normals were found: no texel is seen in sunlight from %d directions of the sun", FEWEST_SUNS)
    size = float(np.sqrt(np.mean(tilted[found] ** 2))) if found.any() else 0.0
    return tilt, fit, {"tilt_prior_sigma": sigma, "tilted_share": float(found.mean()), "tilt_rms": size}


def joint_fit(
    place: Place,
    transport: TexelTransport,
    photographs: list[AlbedoPhotograph],
    models: Sequence[SkyModel],
    progress: Progress | None = None,
) -> tuple[JointRecovery, dict[str, Any]]:
    """The joint recovery under the sky of each photograph, started from the closed form, and what it found as plain values."""
    from seasonscapes.albedo.joint_recovery import recover_jointly

    if place.terrain.snow is not None or place.terrain.forest:
        log.warning("the differentiable method treats snow and forest as matt; the closed form does not")
    start = closed_fit(transport, photographs, progress)
    haze = _haze_lights(place, photographs, models, progress)
    report = task_progress(progress, "haze, exposures, response, clouds, poses")
    found = recover_jointly(transport, photographs, start, haze=haze, progress=report)
    if not found.accepted:
        log.warning(
            "the closed form stays: photographs that were held out are explained no better by the joint recovery "
            "(loss %.4f, before %.4f)",
            found.held_out_end,
            found.held_out_start,
        )
    return found, _facts(found, photographs, haze is not None)


def _haze_lights(
    place: Place, photographs: list[AlbedoPhotograph], models: Sequence[SkyModel], progress: Progress | None
) -> HazeLights | None:
    """Lights of all photographs at several visibilities; ``None`` where a sky model has no haze to change."""
    from seasonscapes.albedo.recovery_pictures import HazeLights

    # Skies differ in their clouds; the haze is that of all photographs.
    assumed, ranges = visibility_km(models[0]), [model.valid.visibility_km for model in models]
    valid = [each for each in ranges if each is not None]
    if assumed is None or len(valid) < len(models):
        log.info("haze stays as it is: the sky model has no visibility to change")
        return None
    report = task_progress(progress, "light at several visibilities")
    nodes = tuple(km for km in _VISIBILITIES_KM if all(low <= km <= high for low, high in valid))
    lights = []
    for number, km in enumerate(nodes):
        lights.append(_lights_in(place, photographs, [with_overrides(model, visibility_km=km) for model in models]))
        report((number + 1) / len(nodes))
    return HazeLights(nodes, lights, assumed)


def _lights_in(place: Place, photographs: list[AlbedoPhotograph], models: Sequence[SkyModel]) -> list[Illumination]:
    """The lights of photographs under other models; a painting has no air in front."""
    from seasonscapes.workflows.illumination import illumination

    seen, skies = [], []
    for photograph, model in zip(photographs, models, strict=True):
        if isinstance(photograph.observation, Observation):
            seen.append(photograph.observation)
            skies.append(model)
    of_cameras, result = iter(illuminations(place, seen, skies)), []
    for photograph, model in zip(photographs, models, strict=True):
        if isinstance(photograph.observation, Observation):
            result.append(next(of_cameras))
        else:
            light = illumination(place, photograph.observation.time, sky=model)
            result.append(replace(light, aerial_perspective=None))
    return result


def _facts(found: JointRecovery, photographs: list[AlbedoPhotograph], hazy: bool) -> dict[str, Any]:
    conditions, names = found.conditions, list(dict.fromkeys(id(each.footprints) for each in photographs))
    webcams = [next(p.observation.webcam for p in photographs if id(p.footprints) == name) for name in names]
    facts: dict[str, Any] = {
        "joint": {
            "accepted": found.accepted,
            "held_out_loss": [round(found.held_out_start, 4), round(found.held_out_end, 4)],
            "sun_share": [round(float(value), 3) for value in conditions.sun_share],
            "sky_scale": np.round(conditions.sky_scale.mean(axis=1), 3).tolist(),
            "cameras": {
                webcam: {
                    "curve_strength": round(float(strength), 3),
                    "curve_exponent": round(float(exponent), 3),
                    "turn_deg": [round(float(angle), 3) for angle in turn],
                }
                for webcam, strength, exponent, turn in zip(
                    webcams, conditions.curve_strength, conditions.curve_exponent, conditions.turn_deg, strict=True
                )
            },
        }
    }
    if hazy:
        facts["visibility_km"] = round(conditions.visibility_km, 1)
    return facts
