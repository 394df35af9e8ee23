"""Views of a distilled Gaussian model at any instant, and its Gaussians baked for other programs."""

from __future__ import annotations

import logging
import time as clock
import weakref
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.cameras.pinhole import ray_directions, view_in_frame
from seasonscapes.errors import InputError
from seasonscapes.sky.models import SkyModel
from seasonscapes.workflows.distillation import require_torch
from seasonscapes.workflows.illumination import illumination_for_camera, sky_model
from seasonscapes.workflows.place import Place, utc_at

if TYPE_CHECKING:
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.gaussians.frame_appearance import FrameGaussians
    from seasonscapes.gaussians.interchange import BakedSplats
    from seasonscapes.gaussians.land_shadows import DiscShadows
    from seasonscapes.gaussians.model import GaussianModel
    from seasonscapes.gaussians.splat_view import SplatView
    from seasonscapes.sky.illumination import Illumination


log = logging.getLogger(__name__)

# Discs so far apart in a picture are seen as blots.
_COARSE_PX = 12.0
# The shadow rays of the last model and place.
_LAST: dict[str, tuple[weakref.ref[GaussianModel], weakref.ref[Place], DiscShadows | None]] = {}
# Pixels that are asked about it.
_SAMPLES = 5000


def day_of_year(time: datetime) -> float:
    """Day of the year with the hour as its fraction; the first of January begins at 1."""
    return time.timetuple().tm_yday + time.hour / 24.0


def require_scene(model: GaussianModel | FrameGaussians, place: Place) -> None:
    """`InputError` where a model was distilled from another scene."""
    if model.note.get("scene") != place.scene.name:
        got = str(model.note.get("scene"))
        raise InputError("--model", "was distilled from another scene", got=got, expected=place.scene.name)


def cast_shadows(model: GaussianModel, place: Place) -> DiscShadows | None:
    """Shadow rays of a model's discs on its place's land, for any hour.

    ``None`` for models that know no physics, and without a vectorised variant, where the discs' horizons tell shadows. Those of
    the last model and place are kept, so that a loop over hours makes them once.

    Parameters
    ----------
    model, place
        The model, and the place that it was distilled from.

    Raises
    ------
    InputError
        If the model lies on another terrain than the place's.
    """
    known = _LAST.get("shadows")
    if known is not None and known[0]() is model and known[1]() is place:
        return known[2]
    shadows = _cast_shadows(model, place)
    _LAST["shadows"] = (weakref.ref(model), weakref.ref(place), shadows)
    return shadows


def _cast_shadows(model: GaussianModel, place: Place) -> DiscShadows | None:
    from seasonscapes.gaussians.land_shadows import disc_shadows
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh

    if model.kind not in ("physical", "full"):
        return None
    cure = "load the scene with the terrain's options of `distill`, or distil again"
    if model.frame != place.frame:
        raise InputError("--model", "was distilled about another origin", cure=cure)
    if use_backend().device == "scalar":
        log.warning(
            "cast shadows come from the Gaussians' horizons, which are coarser: tracing them needs libLLVM or CUDA"
        )
        return None
    try:
        return disc_shadows(ray_scene(mi_mesh(place.terrain, np.full(3, 0.3))), model)
    except ValueError as error:
        raise InputError("--model", f"does not lie on the scene's land: {error}", cure=cure) from None


def render_gaussians(
    model: GaussianModel,
    place: Place,
    camera: Camera,
    time: str | datetime,
    *,
    sky: str | Path | SkyModel = "clear",
    subpixels: int = 2,
    device: str = "cpu",
) -> SplatView:
    """Render a distilled model at a date and hour.

    Parameters
    ----------
    model
        Of `distil`, or `gaussians.model.load_model`.
    place
        The place that it was distilled from.
    camera
        A camera; one calibrated in another frame is converted to the place's.
    time
        An aware datetime, or ISO 8601 text; without offset it is civil time at the place.
    sky
        A sky model, its name or its file.
    subpixels
        Samples along a pixel's side.
    device
        ``"cpu"``, or ``"cuda"`` (needs the extra ``gsplat``).

    Returns
    -------
    SplatView
        Radiance ``(H, W, 3)`` [cd/m²], surface radiance, coverage and depth.

    Raises
    ------
    InputError
        For a model of another scene.
    NoTerrainInView
        Where no Gaussian is in view.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> quick = ss.DistilOptions(discs=12, suns=2, dates=1, views=0, steps=2, picture_steps=0)
    >>> model = ss.distil(place, sky="hosek", options=quick)
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> noon = ss.render_gaussians(model, place, camera, "2024-07-20T13:30", sky="hosek")
    >>> noon.radiance.shape, noon.coverage.shape
    ((32, 48, 3), (32, 48))
    """
    require_torch()
    from seasonscapes.gaussians.rasterise import set_torch_threads
    from seasonscapes.gaussians.splat_view import RasterOptions, model_colours, render_model

    set_torch_threads(1)
    require_scene(model, place)
    camera = view_in_frame(camera, place.frame)
    utc = utc_at(place, time)
    light, _ = illumination_for_camera(place, camera, sky_model(sky), utc)
    day = day_of_year(utc)
    colours = model_colours(model, light, day, shadows=cast_shadows(model, place))
    view = render_model(model, camera, light, day, colours=colours, raster=RasterOptions(subpixels, device))
    _warn_of_coarse_discs(model, camera, view)
    return replace(view, provenance={"white_rgb": light.white_rgb})


def _warn_of_coarse_discs(model: GaussianModel, camera: Camera, view: SplatView) -> None:
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    seen = (view.coverage > 0.5) & np.isfinite(view.depth)
    if not seen.any() or model.grid.spacing_m * np.median(camera.fx / view.depth[seen]) <= _COARSE_PX:
        return
    # Discs may be smaller than the grid's cells: those count that stand where pixels look.
    row, column = (index[:: 1 + len(index) // _SAMPLES] for index in np.nonzero(seen))
    depth_m = view.depth[row, column].astype(np.float64)
    rays = ray_directions(camera, np.stack([column, row], axis=-1) + 0.5)
    nearest = cKDTree(model.means).query(camera.position_m + depth_m[:, None] * rays)[1]
    spacing_m = model.spacing_m[nearest]
    across_px = float(np.median(camera.fx * spacing_m / depth_m))
    if across_px > _COARSE_PX:
        log.warning(
            "Gaussians %.3g m apart lie %.0f pixels from each other in half of this view or more: it shows no detail; distil "
            "more of them (--discs) or stand farther away",
            float(np.median(spacing_m)),
            across_px,
        )


def timed_view(
    model: GaussianModel,
    camera: Camera,
    light: Illumination,
    day: float,
    *,
    shadows: DiscShadows | None,
    subpixels: int,
    device: str,
) -> tuple[SplatView, dict[str, float]]:
    """`render_gaussians` for a known light, and the milliseconds of colouring and rasterisation."""
    from seasonscapes.gaussians.splat_view import RasterOptions, model_colours, render_model

    start = clock.perf_counter()
    colours = model_colours(model, light, day, shadows=shadows)
    middle = clock.perf_counter()
    view = render_model(model, camera, light, day, colours=colours, raster=RasterOptions(subpixels, device))
    end = clock.perf_counter()
    return view, {"colours_ms": round(1e3 * (middle - start), 1), "render_ms": round(1e3 * (end - middle), 1)}


def bake_gaussians(
    model: GaussianModel,
    light: Illumination,
    day: float,
    *,
    shadows: DiscShadows | None,
    exposure: str | float = "auto",
) -> tuple[BakedSplats, float]:
    """All Gaussians of one instant in display colours, and the EV100 of their exposure.

    Parameters
    ----------
    model
        The model.
    light, day
        Illumination, and day of the year.
    shadows
        From `cast_shadows`.
    exposure
        ``"auto"`` or ``"eye"`` expose for a grey card in the open; or EV100.
    """
    from seasonscapes.exposure import develop, exposure_ev100
    from seasonscapes.gaussians.interchange import BakedSplats
    from seasonscapes.gaussians.splat_view import model_colours
    from seasonscapes.images import srgb_from_linear

    colours, state = model_colours(model, light, day, shadows=shadows)
    radiance = colours * np.float32(state.global_lx / np.pi)
    card = np.full((1, 1, 3), 0.18 * state.global_lx / np.pi)
    ev100 = exposure_ev100(card, exposure)
    rgb = srgb_from_linear(develop(radiance[None], ev100, eye=exposure == "eye"))[0].astype(np.float32)
    splats = BakedSplats(model.means, model.quaternions, model.log_scales, model.opacity_logits, rgb)
    return splats, ev100
