"""Albedo recovery: the light of known hours removed from photographs, and the result completed."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.cameras.observation import Observation
from seasonscapes.cameras.pinhole import view_in_frame
from seasonscapes.errors import NoTerrainInView
from seasonscapes.progress import Progress, task_progress
from seasonscapes.sky.models import SkyModel, with_overrides
from seasonscapes.terrain.surface import Texture
from seasonscapes.workflows.albedo_sources import orthoimage, scene_albedo
from seasonscapes.workflows.illumination import sky_model
from seasonscapes.workflows.photograph_skies import photograph_skies, without_land_beyond
from seasonscapes.workflows.place import MeshOptions, Place
from seasonscapes.workflows.recovery_methods import (
    METHODS,
    PaintedTexture,
    closed_fit,
    illuminations,
    joint_fit,
    painted_photographs,
    tilted_fit,
)

if TYPE_CHECKING:
    from seasonscapes.albedo.closed_form import AlbedoFit
    from seasonscapes.albedo.forward_model import TexelTransport
    from seasonscapes.albedo.photographs import AlbedoPhotograph, TextureObservation
    from seasonscapes.albedo.seasons import DatedAlbedo
    from seasonscapes.albedo.standard_error import AlbedoEstimate
    from seasonscapes.sky.illumination import Illumination

log = logging.getLogger(__name__)

# Webcams resolve no finer where they look farther than some kilometres; coefficients of finer atlases take long.
TEXEL_M = 20.0
# Photographs that model and fit explain leave a median of some percent; snow, leaves and grass change within two months.
_DOUBTFUL_RESIDUAL, _SEASON_DAYS = 0.2, 60


@dataclass(frozen=True)
class RecoveryOptions:
    """How to recover an albedo.

    Parameters
    ----------
    fit_haze
        Search the visibility that explains the photographs best, before the closed form.
    fit_curve
        Search the strength of the cameras' tone curve, before either method; the differentiable one finds what is left of
        each camera's response.
    method
        ``closed``: light, air, response and poses are given (or searched, see above). ``differentiable``: haze, exposures,
        each camera's response, clouds before the sun and poses within their standard deviations are unknowns beside the
        albedo; the closed form is its start, and stays where it explains held-out photographs better.
    normals
        With the closed form: find normals below the resolution of the heights from the shading of three or more suns, beside
        the albedo; see `albedo.subgrid_normals`.

    Raises
    ------
    ValueError
        For an unknown method, or a search beside the method that contains it.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> ss.RecoveryOptions(fit_haze=True).method
    'closed'
    """

    fit_haze: bool = False
    fit_curve: bool = False
    method: str = "closed"
    normals: bool = False

    def __post_init__(self):
        if self.method not in METHODS:
            raise ValueError(f"RecoveryOptions: method: got {self.method!r}, expected one of {', '.join(METHODS)}")
        if self.method != "closed" and self.fit_haze:
            raise ValueError("RecoveryOptions: fit_haze belongs to the closed form")
        if self.method != "closed" and self.normals:
            raise ValueError("RecoveryOptions: normals belong to the closed form")


@dataclass(frozen=True)
class RecoveredAlbedo:
    """An albedo recovered from photographs of one season; made by `recover_albedo`.

    Parameters
    ----------
    day
        Date of the first photograph.
    estimate
        Albedo ``(R, S, 3)``, standard error, times sunlit and source (1 measured, 2 completed) of each texel.
    fit
        The fit: gains, residuals.
    photographs
        The photographs used, with their light.
    atlas_id
        Identity of the UV atlas.
    facts
        Plain values: what was fitted besides.
    mesh
        How the terrain and its atlas were built.
    tilt
        ``(R, S, 3)`` to be added to the terrain's normals, where they were asked for; see `terrain.surface.Texture`.
    """

    day: date
    estimate: AlbedoEstimate
    fit: AlbedoFit
    photographs: list[AlbedoPhotograph] = field(repr=False)
    atlas_id: str
    facts: dict[str, Any] = field(default_factory=dict)
    mesh: MeshOptions = field(default_factory=MeshOptions)
    tilt: np.ndarray | None = field(default=None, repr=False)

    @property
    def texture(self) -> Texture:
        """The albedo as a texture; ``weight`` is ``1 / σ²`` where photographs measured it and 0 elsewhere."""
        known = self.estimate
        weight = np.where(known.source == 1, 1.0 / np.maximum(known.sigma, 1e-4) ** 2, 0.0).astype(np.float32)
        return Texture(known.albedo, weight, self.atlas_id, self.tilt)

    def dated(self) -> DatedAlbedo:
        """The albedo with its date, for `render`, `relight_session` and others."""
        from seasonscapes.albedo.seasons import DatedAlbedo

        return DatedAlbedo(self.day, self.texture.content, lambda: self.texture)

    def save(self, path: str | Path) -> None:
        """Write a ``.npz`` file, atomically; `load_albedo` and ``--albedo`` read it."""
        from seasonscapes.images import atomic_path

        known, texture = self.estimate, self.texture
        more: dict[str, Any] = {} if self.tilt is None else {"tilt": self.tilt}
        with atomic_path(Path(path)) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(
                file,
                values=known.albedo,
                weight=texture.weight,
                sigma=known.sigma,
                sunlit=known.sunlit,
                source=known.source,
                gains=self.fit.gains,
                residual=self.fit.residual,
                atlas_id=self.atlas_id,
                date=self.day.isoformat(),
                mesh=json.dumps(asdict(self.mesh)),
                **more,
            )


def recover_albedo(
    place: Place,
    photographs: Sequence[Observation],
    *,
    sky: str | Path | SkyModel = "clear",
    options: RecoveryOptions | None = None,
    painted: Sequence[PaintedTexture] = (),
    progress: Progress | None = None,
) -> RecoveredAlbedo:
    """Recover the albedo of a place from photographs of several hours of one season, whose light is known.

    Where no photograph shows the surface, and as far as one shows it badly, the albedo is the scene's image corrected
    by what the photographs show elsewhere; without an image it is predicted from relief.

    Parameters
    ----------
    place
        The place.
    photographs
        Such as `open_photographs` gives; their cameras are converted to the place's frame. May be none beside paintings.
    sky
        The sky model of all photographs; clouds are added where a photograph's own sky shows them.
    options
        The method, and what to fit besides the albedo.
    painted
        Painted textures of some of the hours, as further observations. A painting of photographs that are given as well
        counts them twice.
    progress
        Called with a task and its finished share.

    Returns
    -------
    RecoveredAlbedo
        Linear reflectance with a standard error for each texel.

    Raises
    ------
    NoTerrainInView
        Where no photograph shows any of the terrain.
    NoUsablePixels
        Where all pixels on terrain are masked or clipped.

    Notes
    -----
    Robust (Cauchy) least squares in image space over all photographs with per-texel daylight coefficients; exposures
    come from the sky in each photograph. See `albedo.closed_form` and `albedo.joint_recovery`.

    Examples
    --------
    >>> import tempfile
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> times = ["2024-07-20T10:00", "2024-07-20T15:00"]
    >>> camera = ss.camera(place, "aerial", size_px=(96, 64))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sources = ss.synthetic_photographs(place, times, folder, cameras={"aerial": camera})
    ...     photographs = ss.open_photographs(place, sources.manifest, sources.calibrations, times)
    >>> recovered = ss.recover_albedo(place, photographs)
    >>> recovered.estimate.albedo.shape == (*place.texture_shape, 3)
    True
    """
    options, model = options or RecoveryOptions(), sky_model(sky)
    in_frame = [replace(each, camera=view_in_frame(each.camera, place.frame)) for each in photographs]
    return recovered_over(place, texel_transport(place, progress), in_frame, model, options, painted, progress)


def texel_transport(place: Place, progress: Progress | None = None) -> TexelTransport:
    """Daylight coefficients of a place's texels."""
    from seasonscapes.albedo.forward_model import trace_texel_transport
    from seasonscapes.rendering.backend import use_backend

    use_backend()
    report = task_progress(progress, "daylight of the atlas")
    return trace_texel_transport(place.terrain, place.texture_shape, progress=report)


def recovered_over(
    place: Place,
    transport: TexelTransport,
    photographs: list[Observation],
    model: SkyModel,
    options: RecoveryOptions,
    painted: Sequence[PaintedTexture] = (),
    progress: Progress | None = None,
) -> RecoveredAlbedo:
    """`recover_albedo` from photographs in the place's frame and daylight coefficients that were traced before."""
    prepared, skies, facts = _prepared(place, transport, photographs, model, options, progress)
    painted_skies = [model if each.sky is None else each.sky for each in painted]
    prepared = [*prepared, *painted_photographs(place, transport, painted, painted_skies)]
    tilt = None
    if options.method == "closed":
        fit = closed_fit(transport, prepared, progress)
        if options.normals:
            tilt, fit, found = tilted_fit(place, transport, prepared, fit, progress)
            facts = facts | found
    else:
        joint, found = joint_fit(place, transport, prepared, [*skies, *painted_skies], progress)
        fit, prepared, facts = joint.fit, joint.photographs, facts | found
    known = _completed(place, transport, prepared, fit, progress)
    for doubt in recovery_doubts([each.observation for each in prepared], fit.residual):
        log.warning("%s", doubt)
    day = min(each.observation.time for each in prepared).date()
    return RecoveredAlbedo(day, known, fit, prepared, place.atlas_id, facts, place.options, tilt)


def recovery_doubts(photographs: Sequence[Observation | TextureObservation], residual: np.ndarray) -> list[str]:
    """In words why an albedo that was recovered cannot be trusted; empty where nothing speaks against it.

    Parameters
    ----------
    photographs
        The K photographs.
    residual
        Median relative residual of each, ``(K,)``; see `albedo.closed_form.AlbedoFit`.
    """
    doubts = []
    for each, value in zip(photographs, residual, strict=True):
        if value > _DOUBTFUL_RESIDUAL:
            doubts.append(
                f"{each.webcam} {each.time:%Y-%m-%d %H:%M} UTC is not explained: its pixels differ from the fit by {100.0 * value:.0f} % "
                "in the median; its sky (--sky, --cloudiness), pose or date is probably another one"
            )
    days = sorted({each.time.date().replace(year=2024) for each in photographs})
    gaps = [(later - sooner).days for sooner, later in pairwise(days)]
    # Through the turn of the year the days lie closer together.
    apart = 366 - max([*gaps, 366 - (days[-1] - days[0]).days])
    if apart > _SEASON_DAYS:
        doubts.append(
            f"the photographs span {apart} days of the year, and one albedo cannot hold several seasons: recover each season by "
            "itself, and give them back as --albedo DATE=FILE"
        )
    return doubts


def with_terrain(transport: TexelTransport, photographs: Sequence[Observation]) -> list[Observation]:
    """The photographs whose unmasked pixels show terrain; others (parts of a panorama may be all sky) are logged.

    Raises
    ------
    NoTerrainInView
        Where none is left.
    """
    from seasonscapes.rendering.sightlines import visible_faces

    terrain_of: dict[bytes, np.ndarray] = {}
    kept, empty = [], set()
    for photograph in photographs:
        camera = photograph.camera
        key = repr((photograph.webcam, camera.width_px, camera.height_px, camera.fx)).encode()
        key += camera.world_from_camera.tobytes()
        if key not in terrain_of:
            terrain_of[key] = visible_faces(transport.ray_scene, camera) >= 0
        if (terrain_of[key] & photograph.mask).any():
            kept.append(photograph)
        else:
            empty.add(photograph.webcam)
    for name in sorted(empty):
        log.info("left out: %s: it sees none of the terrain", name)
    if not kept:
        raise NoTerrainInView("albedo: no photograph shows any of the terrain")
    return kept


def photographs_of_ground(
    place: Place,
    transport: TexelTransport,
    photographs: Sequence[Observation],
    model: SkyModel,
    progress: Progress | None = None,
) -> tuple[list[AlbedoPhotograph], list[SkyModel], float]:
    """The photographs that show ground, under the light of their skies: clouds as they show them, and pixels of water left out.

    Where none shows sky, some have an assumed gain; see `albedo.assumed_exposure`.

    Parameters
    ----------
    place, transport
        The place, and the daylight coefficients of its texels.
    photographs
        In the place's frame.
    model
        The sky asked for; see `photograph_skies`.
    progress
        Called with a task and its finished share.

    Returns
    -------
    photographs, skies
        In the same order, without those that show none of the ground, and the sky of each.
    water_share
        Of all pixels on terrain, how many show water, 0 to 1.

    Raises
    ------
    NoTerrainInView
        Where no photograph shows any of the terrain.
    NoUsablePixels
        Where all that they show is water.
    """
    from seasonscapes.albedo.assumed_exposure import tells_gain
    from seasonscapes.albedo.ground_pixels import without_water
    from seasonscapes.albedo.natural_colours import with_assumed_colours
    from seasonscapes.albedo.photographs import prepare_photographs

    seen = without_land_beyond(place, with_terrain(transport, photographs))
    skies = photograph_skies(place, transport, seen, model)
    report = task_progress(progress, "footprints of the photographs")
    prepared = prepare_photographs(transport, seen, illuminations(place, seen, skies), progress=report)
    share = 0.0
    if place.terrain.water is not None:
        sky_of = {id(each): sky for each, sky in zip(seen, skies, strict=True)}
        prepared, share = without_water(prepared, place.terrain.water.mask)
        skies = [sky_of[id(each.observation)] for each in prepared]
    exposed = with_assumed_colours(transport, prepared)
    if any(after is not before for after, before in zip(exposed, prepared, strict=True)):
        log.warning(
            "no photograph shows enough sky to tell its exposure and white balance: they are taken as set for level ground, "
            "so that brightness and colours of the albedo are the camera's own, as far as land can have them"
        )
    if not any(tells_gain(each) for each in prepared):
        _tell_nights(exposed)
    return exposed, skies, share


def _tell_nights(photographs: list[AlbedoPhotograph]) -> None:
    from seasonscapes.albedo.assumed_exposure import too_dark

    days = {each.observation.time.date() for each in photographs}
    nights = days - {each.observation.time.date() for each in photographs if not too_dark(each)}
    if nights:
        log.warning(
            "%s: no photograph shows enough sky to tell its exposure, and all were taken at night, where a camera's own is not known",
            ", ".join(sorted(map(str, nights))),
        )


def _prepared(
    place: Place,
    transport: TexelTransport,
    photographs: list[Observation],
    model: SkyModel,
    options: RecoveryOptions,
    progress: Progress | None,
) -> tuple[list[AlbedoPhotograph], list[SkyModel], dict[str, Any]]:
    """Photographs with their light, and their skies; tone curve and visibility fitted where asked for."""
    from seasonscapes.albedo.haze import fit_visibility
    from seasonscapes.albedo.natural_colours import with_assumed_colours
    from seasonscapes.albedo.photographs import EIGHT_BIT
    from seasonscapes.albedo.tone_curve import fit_tone_curve, with_tone_curve

    facts: dict[str, Any] = {}
    if not photographs:
        return [], [], facts
    prepared, skies, share = photographs_of_ground(place, transport, photographs, model, progress)
    photographs = [each.observation for each in prepared if isinstance(each.observation, Observation)]
    if place.terrain.water is not None:
        facts["water_share"] = round(share, 4)
        log.info(
            "water: %.3g %% of the pixels on terrain show it and tell no albedo; its texels are completed",
            100.0 * share,
        )
    # Contrast of one picture whose exposure is assumed is its land's as well as its camera's.
    alone = len({each.observation.time for each in prepared}) == 1 and prepared[0].gain is not None
    if options.fit_curve and alone:
        log.info("tone curve: taken as sRGB's; one photograph without sky does not tell another")
    elif options.fit_curve:
        curve = fit_tone_curve(transport, prepared, progress=task_progress(progress, "tone curve"))
        prepared = with_tone_curve(prepared, curve.strength)
        facts["curve_strength"] = round(curve.strength, 3)
        log.info("tone curve: strength %.2f", curve.strength)
    if options.fit_haze:

        def lights_of(visibility_km: float) -> list[Illumination]:
            hazy = [with_overrides(each, visibility_km=visibility_km) for each in skies]
            return illuminations(place, photographs, hazy)

        report = task_progress(progress, "visibility")
        found = fit_visibility(transport, prepared, lights_of, noise_model=EIGHT_BIT, progress=report)
        facts["visibility_km"] = round(found.visibility_km, 1)
        log.info("visibility %.0f km", found.visibility_km)
        hazy = lights_of(found.visibility_km)
        # An assumed exposure is that under the light: here no other gain is known.
        lit = [replace(each, light=light, gain=None) for each, light in zip(prepared, hazy, strict=True)]
        prepared = with_assumed_colours(transport, lit)
    if any(each.gain is not None for each in prepared):
        facts["exposure"] = "assumed: no photograph shows enough sky"
    return prepared, skies, facts


def _completed(
    place: Place,
    transport: TexelTransport,
    photographs: list[AlbedoPhotograph],
    fit: AlbedoFit,
    progress: Progress | None,
) -> AlbedoEstimate:
    from seasonscapes.albedo.albedo_completion import completed_estimate
    from seasonscapes.albedo.standard_error import albedo_estimate
    from seasonscapes.texturing.predictors import predictors_for

    known = albedo_estimate(transport, photographs, fit)
    image = orthoimage(place, photographs[0].observation.time)
    base = None if image is None else np.where(image.weight[..., None] > 0.0, image.values, np.float32(np.nan))
    report = task_progress(progress, "completing")
    return completed_estimate(known, fit, base, predictors_for(place.terrain, place.atlas), progress=report)


def save_albedo_figures(
    place: Place, known: AlbedoEstimate, day: date, output: Path, *, tilted: bool = False
) -> dict[str, str]:
    """Write pictures beside an albedo file: the albedo, what was measured, and σ (white is 0.1); their paths.

    The picture of the albedo may be edited and given back as an albedo; ``tilted``: which has normals of its own.
    """
    from seasonscapes.images import write_png
    from seasonscapes.workflows.edited_textures import texture_facts
    from seasonscapes.workflows.pictures import png_metadata

    sigma = np.clip(np.nan_to_num(known.sigma, posinf=1.0) / 0.1, 0.0, 1.0)
    pictures: dict[str, np.ndarray] = {
        "albedo": known.albedo,
        "measured": (known.source == 1)[..., None] * known.albedo,
        "sigma": np.repeat(sigma[..., None], 3, 2),
    }
    paths = {}
    for name, image in pictures.items():
        path = output.with_name(f"{output.stem}_{name}.png")
        holds = "albedo" if name == "albedo" else "figure"
        facts = texture_facts(place, holds, date=day.isoformat(), tilted=tilted)
        record = {"texture": facts, "attribution": place.scene.attribution}
        write_png(path, np.clip(image, 0.0, 1.0), metadata=png_metadata(record))
        paths[name] = str(path)
    return paths


def error_against_truth(place: Place, recovered: RecoveredAlbedo) -> dict[str, float]:
    """PSNR [dB] and relative error over measured texels of a synthetic place, whose albedo is known."""
    truth, measured = scene_albedo(place, recovered.day).values, recovered.estimate.source == 1
    error = recovered.estimate.albedo[measured] - truth[measured]
    return {
        "true_psnr_db": round(float(-10.0 * np.log10(np.mean(error**2))), 2),
        "true_relative_error": round(float(np.abs(error).sum() / truth[measured].sum()), 4),
    }
