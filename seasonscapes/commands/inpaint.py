"""``seasonscapes inpaint``."""

from __future__ import annotations

import time as clock
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.inpaint_path import DiffusionOptions, Effort
from seasonscapes.commands.options import PlaceOptions, SkyOptions, ViewOptions
from seasonscapes.commands.talk import check_range, check_suffix, finish, progress_bar, say
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from datetime import datetime

    from seasonscapes.pipeline import Place
    from seasonscapes.terrain.surface import Texture
    from seasonscapes.texturing.completion import Completed
    from seasonscapes.texturing.predictors import Predictors

_FIGURE_PX = 1024


def inpaint(
    scene: str,
    *,
    time: str,
    texture: Path = Path("out/paint/painted.npz"),
    method: str = "guided",
    albedo: Path | None = None,
    detail: float = 0.0,
    fast: bool = False,
    seed: int = 0,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/completed.npz"),
    figures: Path | None = None,
    view: ViewOptions | None = None,
    sky: SkyOptions | None = None,
    place: PlaceOptions | None = None,
    diffusion: DiffusionOptions | None = None,
    json: bool = False,
) -> None:
    """Complete a painted texture: give every texel that no camera saw a value, from what the land itself tells.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    time
        When the pictures were taken, ISO 8601. Without an offset it is civil time at the scene's origin.
    texture
        What ``seasonscapes paint`` wrote for this scene, with the same --atlas and --texel-m.
    method
        guided (learns from satellite colour, relief and sun), membrane (smooth), telea (from the rims inwards) or
        diffusion (an image model along --path, then guided; needs weights and, in earnest, a GPU).
    albedo
        What ``seasonscapes albedo`` wrote for this scene. Relit at this hour it takes the place of guided: painted
        texels are weighed against it, each by its error, and it is what no camera saw. With diffusion it is a guide.
    detail
        Strength of synthesised grain: 0 for albedo recovery, about 0.6 for pictures.
    fast
        A little less accurate, about three times as fast.
    seed
        Equal seeds give equal textures.
    output
        A .npz texture with its σ.
    figures
        Folder for pictures: texture before and after, σ, and with --camera or --at the view before and after.
    json
        Print one machine-readable record.
    """
    view, place, sky = view or ViewOptions(), place or PlaceOptions(), sky or SkyOptions()
    start = clock.perf_counter()
    check_suffix(output, (".npz",))
    check_range("--detail", detail, 0.0, 1.0)
    check_range("--seed", seed, 0, 2**32 - 1)
    from seasonscapes.civil_time import resolve_time
    from seasonscapes.images import atomic_path
    from seasonscapes.texturing.completion import INPAINTERS, complete
    from seasonscapes.texturing.predictors import predictors_for

    if method not in (*INPAINTERS, "diffusion"):
        raise InputError("--method", "unknown method", got=method, expected=", ".join([*INPAINTERS, "diffusion"]))
    if albedo is not None and method not in ("guided", "diffusion"):
        raise InputError("--albedo", f"of no use with --method {method}", expected="guided or diffusion")
    diffusion, told = diffusion or DiffusionOptions(), {}
    if method == "diffusion":
        diffusion.check()
    land = place.load(scene)
    moment = resolve_time(time, land.frame.latitude_deg, land.frame.longitude_deg)
    say(moment.reading)
    painted = read_painted(texture, land)
    relit = None
    if albedo is not None:
        from seasonscapes.commands.expected import expected_radiance

        relit = expected_radiance(land, albedo, moment.utc, sky.model())
    fused = relit is not None and method == "guided"
    # Of a fused texture's guides only the surface and the charts matter: neither sun nor image is looked at.
    predictors = predictors_for(land.terrain, land.atlas) if fused else guides_of(land, moment.utc, relit)
    if method == "diffusion":
        from seasonscapes.commands.inpaint_path import complete_along_path

        effort = Effort(detail, fast, seed, sky.cloudiness or float(sky.sky == "overcast"))
        completed, told = complete_along_path(land, painted, predictors, moment.utc, diffusion, effort)
    elif fused:
        from seasonscapes.commands.expected import albedo_error
        from seasonscapes.texturing.bayesian_fusion import fuse_with_albedo

        completed = fuse_with_albedo(painted, relit.values, albedo_error(albedo), predictors)
        told = {"guides": ["albedo, relit"]}
    else:
        with progress_bar(f"completing ({method})") as progress:
            completed = complete(
                painted, predictors, method=method, detail=detail, fast=fast, seed=seed, progress=progress
            )
    with atomic_path(output) as temporary:
        save_completed(completed, painted, temporary)
    pictures = []
    if figures is not None:
        pictures = save_figures(figures, land, completed)
        if view.camera is not None or view.at is not None:
            pictures += save_views(figures, land, completed, view, sky, moment.utc)
    hole = predictors.surface & ~completed.painted
    share = float(hole.sum() / max(predictors.surface.sum(), 1))
    record: dict[str, Any] = {
        "output": str(output),
        "scene": land.scene.name,
        "method": method,
        "time_utc": moment.utc.isoformat(),
        "texels": int(predictors.surface.sum()),
        "filled_share": share,
        "guides": list(predictors.names),
        "sigma_median": float(_median(completed.sigma[hole])),
        "value_median": float(_median(completed.values[hole])),
        "figures": [str(path) for path in pictures],
        "seconds": round(clock.perf_counter() - start, 2),
    } | told
    finish(
        record,
        [
            f"{output}  ({100 * share:.1f} % of {record['texels']:,} texels filled by {method}, median σ "
            f"{record['sigma_median']:.3g} on {record['value_median']:.3g}, {record['seconds']} s)",
            *record["figures"],
        ],
        as_json=json,
    )


def _median(values) -> float:
    import numpy as np

    return float(np.median(values)) if values.size else 0.0


def read_painted(path: Path, land: Place) -> Texture:
    """A painted texture of this place, or an `InputError` that says what is wrong with it."""
    from zipfile import BadZipFile

    from seasonscapes.terrain.surface import load_texture
    from seasonscapes.texturing.completion import painted_texels

    if not path.is_file():
        raise InputError("--texture", "no such file", got=str(path), cure="run `seasonscapes paint` first")
    try:
        texture = load_texture(path)
    except (BadZipFile, KeyError, ValueError, EOFError) as error:
        raise InputError("--texture", f"not a painted texture: {error}", got=str(path)) from None
    size = (land.atlas.height_px, land.atlas.width_px)
    if texture.weight.shape != size:
        raise InputError(
            "--texture",
            "made for another atlas",
            got=f"{texture.weight.shape[1]} × {texture.weight.shape[0]}",
            expected=f"{size[1]} × {size[0]}",
            cure="give the same --atlas and --texel-m as for painting",
        )
    painted = painted_texels(texture)
    if not painted.any():
        raise InputError(
            "--texture",
            "no painted texel: there is nothing to learn from",
            got=str(path),
            cure="did the cameras see the land? look at the figures of `seasonscapes paint`",
        )
    if texture.values[painted].min() < 0.0:
        raise InputError("--texture", "negative radiance", got=str(path), expected="values of at least 0")
    return texture


def guides_of(land: Place, moment: datetime, relit: Texture | None = None) -> Predictors:
    """Relief, the sun of the hour and of the day, the place's image, and a relit albedo, for every texel."""
    import numpy as np

    from seasonscapes.pipeline import image_from_above
    from seasonscapes.sky.ephemeris import sun_position
    from seasonscapes.texturing.predictors import predictors_for

    satellite = image_from_above(land, moment)
    at = (land.frame.latitude_deg, land.frame.longitude_deg)
    hours = [moment + timedelta(hours=h) for h in range(-12, 12)]
    day = np.asarray(sun_position(hours, *at).direction, float)
    return predictors_for(
        land.terrain,
        land.atlas,
        satellite=satellite,
        relit=None if relit is None else relit.values,
        sun_direction=sun_position(moment, *at).direction,
        day_suns=day,
    )


def save_completed(completed: Completed, painted: Texture, path: Path) -> None:
    """A ``.npz`` that `load_texture` reads: values, the painting's weight (0 where filled), and σ."""
    import numpy as np

    weight = np.where(completed.painted, painted.weight, np.float32(0.0)).astype(np.float32)
    np.savez(path, values=completed.values, weight=weight, sigma=completed.sigma)


def save_figures(folder: Path, land: Place, completed: Completed) -> list[Path]:
    """Texture before and after, and σ relative to the median."""
    import numpy as np

    from seasonscapes.exposure import develop, exposure_ev100
    from seasonscapes.images import write_png

    shrink = max(1, -(-max(completed.painted.shape) // _FIGURE_PX))
    values = _shrunk(completed.values, shrink)
    seen = _shrunk(completed.painted[..., None].astype(np.float32), shrink)
    ev100 = exposure_ev100(values)
    after = develop(values, ev100)
    sigma = _shrunk(completed.sigma[..., None], shrink)
    scale = np.percentile(sigma, 99.0) or 1.0
    pictures = {
        "before": after * seen + 0.05 * (1.0 - seen),
        "after": after,
        "sigma": np.repeat(np.clip(sigma / scale, 0.0, 1.0) ** 2.2, 3, axis=2),
    }
    paths = []
    for name, picture in pictures.items():
        paths.append(folder / f"{land.scene.name}_texture_{name}.png")
        write_png(paths[-1], picture)
    return paths


def _shrunk(values, factor: int):
    import cv2

    size = (max(1, values.shape[1] // factor), max(1, values.shape[0] // factor))
    return cv2.resize(values, size, interpolation=cv2.INTER_AREA).reshape(size[1], size[0], -1)


def save_views(
    folder: Path, land: Place, completed: Completed, view: ViewOptions, sky: SkyOptions, moment: datetime
) -> list[Path]:
    """The land as a camera sees it, through the air of that hour, before and after completion."""
    import numpy as np

    from seasonscapes.daylight import light_for
    from seasonscapes.exposure import develop, exposure_ev100
    from seasonscapes.images import write_png
    from seasonscapes.rendering.gbuffer import trace_gbuffer
    from seasonscapes.rendering.mitsuba_scene import build_scene
    from seasonscapes.rendering.radiance import apply_aerial_perspective
    from seasonscapes.terrain.surface import sample_texture

    camera, chosen = view.pinhole(land), view.chosen(land.scene)
    light, _ = light_for(land, camera, sky.model(), moment)
    stage = build_scene(land.terrain, np.full(3, 0.2, np.float32), light)
    gbuffer = trace_gbuffer(stage, camera)
    coverage = np.isfinite(gbuffer.depth).astype(np.float32)
    surface = np.nan_to_num(sample_texture(completed.values, gbuffer.uv))
    seen = np.nan_to_num(sample_texture(completed.painted[..., None].astype(np.float32), gbuffer.uv), nan=1.0)
    picture = apply_aerial_perspective(stage, camera, surface, coverage, gbuffer)
    after = develop(picture, exposure_ev100(picture))
    paths = []
    for name, shown in (("before", after * seen + 0.05 * (1.0 - seen)), ("after", after)):
        paths.append(folder / f"{land.scene.name}_{chosen.name}_{name}.png")
        write_png(paths[-1], shown)
    return paths
