"""Painting: calibrated photographs of one time projected into the texture of their place, as radiance."""

from __future__ import annotations

import hashlib
import logging
import shutil
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.cameras.pinhole import view_in_frame
from seasonscapes.progress import Progress, task_progress
from seasonscapes.sky.models import SkyModel
from seasonscapes.texturing.painting import Painting, PaintOptions
from seasonscapes.workflows.foreground import foreground_masks
from seasonscapes.workflows.illumination import illumination_at, position_at, sky_model
from seasonscapes.workflows.photograph_files import PhotographSources, observations, rows_at
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.views import camera_geodetic
from seasonscapes.workspace import artefact_key, build_once, file_hash

if TYPE_CHECKING:
    from seasonscapes.cameras.observation import ManifestRow, Observation
    from seasonscapes.texturing.inputs import PaintingInput
    from seasonscapes.texturing.radiometric_fit import RadiometricReference

log = logging.getLogger(__name__)

__all__ = ["PaintOptions", "Painting", "paint", "painting_inputs", "painting_of", "painting_record"]

_CODE = ("workflows.painting",)


def paint(
    place: Place,
    photographs: Sequence[Observation],
    *,
    sky: str | Path | SkyModel = "clear",
    options: PaintOptions | None = None,
    reference: RadiometricReference | None = None,
    resume: Path | None = None,
    progress: Progress | None = None,
) -> Painting:
    """Paint photographs of one time into a place's texture, as radiance of the surface with the air removed.

    Parameters
    ----------
    place
        The place.
    photographs
        Of one time, such as `open_photographs` gives; their cameras are converted to the place's frame.
    sky
        The sky model of that time: it gives the aerial perspective and the scale of radiance.
    options
        Mode, radiometric fit and limits.
    reference
        Radiance predicted from a recovered albedo (see `predict_radiance`) with its relative error. It determines
        exposures better than the sky does.
    resume
        Folder for finished tiles, with which an interrupted painting continues.
    progress
        Called with a task and its finished share.

    Returns
    -------
    Painting
        Texture of radiance [cd/m²] with weights, coverage, and the fitted gains, contrasts and haze.

    Raises
    ------
    NoUsablePixels
        Where no photograph contributes to any texel.

    Examples
    --------
    >>> import tempfile
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sources = ss.synthetic_photographs(place, ["2024-07-20T13:30"], folder, sky="hosek", cameras={"aerial": camera})
    ...     photographs = ss.open_photographs(place, sources.manifest, sources.calibrations, "2024-07-20T13:30")
    >>> painting = ss.paint(place, photographs, sky="hosek")
    >>> bool((painting.texture.weight > 0.0).any())
    True
    """
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.texturing.painting import PaintTarget, paint_atlas

    inputs, options = painting_inputs(place, photographs, sky_model(sky)), options or PaintOptions()
    target = PaintTarget(place.terrain, place.atlas, ray_scene(mi_mesh(place.terrain, np.full(3, 0.2))))
    rejects = None
    if options.foreground:
        plain = replace(options, foreground=False)
        rejects = foreground_masks(
            place,
            inputs,
            target,
            plain,
            lambda masks: paint_atlas(inputs, target, options=plain, reference=reference, rejects=masks),
            progress=progress,
        )
        for item, mask in zip(inputs, rejects, strict=True):
            share = 0.0 if mask is None else float(mask.mean())
            log.info("%s: %.1f %% of the picture is foreground", item.observation.webcam, 100.0 * share)
    painting = paint_atlas(
        inputs,
        target,
        options=options,
        reference=reference,
        rejects=rejects,
        resume=resume,
        progress=task_progress(progress, "painting"),
    )
    return replace(painting, texture=replace(painting.texture, atlas_id=place.atlas_id))


def painting_inputs(place: Place, photographs: Sequence[Observation], model: SkyModel) -> list[PaintingInput]:
    """Photographs with the air between their camera and the terrain; views of one camera and time share it."""
    from seasonscapes.texturing.inputs import PaintingInput

    airs: dict = {}
    inputs = []
    for photograph in photographs:
        camera = view_in_frame(photograph.camera, place.frame)
        key = (photograph.time, camera.position_m.tobytes())
        if key not in airs:
            position, height_m = position_at(place, photograph.time), camera_geodetic(place, camera)[2]
            light = illumination_at(model, position, height_m, workspace=place.workspace)
            airs[key] = light.aerial_perspective
        inputs.append(PaintingInput(replace(photograph, camera=camera), airs[key]))
    return inputs


def painting_of(
    place: Place,
    sources: PhotographSources,
    utc: datetime,
    model: SkyModel,
    options: PaintOptions,
    *,
    within_min: float = 30.0,
    reference: RadiometricReference | None = None,
    progress: Progress | None = None,
) -> Painting:
    """The painting of a time from files, or from the workspace where equal files were painted before.

    An interrupted painting continues from its finished tiles.

    Parameters
    ----------
    place, sources
        The place; manifest, calibrations and masks.
    utc
        The time, aware.
    model, options, reference
        See `paint`.
    within_min
        Largest difference in time of a photograph [min].
    progress
        Called with a task and its finished share.

    Raises
    ------
    InputError
        Where no photograph is near enough or none is calibrated.
    NoUsablePixels
        Where no photograph contributes to any texel.
    """
    from seasonscapes.texturing.painting_file import load_painting, save_painting

    rows = rows_at(sources, utc, within_min=within_min)
    inputs = {"place": place.key, "sky": model, "options": options, "files": _hashes(sources, rows)}
    if reference is not None:
        predicted = reference.predicted
        inputs["reference"] = {
            "predicted": None if predicted is None else hashlib.sha256(predicted.tobytes()).hexdigest(),
            "predicted_sigma": reference.predicted_sigma,
            "radiance": reference.radiance,
        }
    tiles = place.workspace.folder / place.scene.name / f"tiles-{artefact_key(inputs, _CODE)}"

    def build() -> Painting:
        opened = observations(rows, sources, place.frame, place=place, progress=progress)
        return paint(place, opened, sky=model, options=options, reference=reference, resume=tiles, progress=progress)

    painting = build_once(
        place.workspace,
        f"{place.scene.name}/painting",
        inputs,
        code=_CODE,
        suffix=".npz",
        build=build,
        save=save_painting,
        load=load_painting,
    )
    shutil.rmtree(tiles, ignore_errors=True)
    return painting


def _hashes(sources: PhotographSources, rows: Sequence[ManifestRow]) -> list[list[str | None]]:
    found = []
    for row in rows:
        files = [sources.manifest.parent / row.path, sources.calibration_of(row.webcam, row.time)]
        if sources.masks is not None:
            files.append(sources.masks / f"{row.webcam}.png")
        hashes = (file_hash(path) if path.is_file() else None for path in files)
        found.append([row.webcam, row.time.isoformat(), *hashes])
    return found


def painting_record(painting: Painting) -> dict:
    """Plain numbers about a painting: gains [1 / (cd/m²)], haze, and the share of the texture each webcam paints best.

    Differences between cameras are ``None`` where no two see the same land: JSON has no NaN.
    """
    radiometry, size = painting.radiometry, painting.best.size
    shares = np.bincount(painting.best[painting.best >= 0].ravel(), minlength=len(painting.webcams)) / size
    return {
        "webcams": list(painting.webcams),
        "skipped": list(painting.skipped),
        "gains": np.exp(radiometry.log_gain).tolist(),
        "contrasts": radiometry.contrast.tolist(),
        "haze": radiometry.haze,
        "overlaps": radiometry.overlaps,
        "scatter_before": radiometry.scatter_before if radiometry.overlaps else None,
        "scatter_after": radiometry.scatter_after if radiometry.overlaps else None,
        "shares": shares.tolist(),
        "painted_share": float(np.mean(painting.texture.weight > 0.0)),
    }
