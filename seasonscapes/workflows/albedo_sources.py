"""The albedo of a place by date: from the synthetic massif, the scene's image, or recovered albedo files."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.albedo.seasons import (
    SEASONS,
    AlbedoSeries,
    DatedAlbedo,
    day_number,
    interpolate_albedo,
    season_weights,
    snow_transition,
    snowline_fraction,
)
from seasonscapes.errors import InputError
from seasonscapes.progress import Progress
from seasonscapes.scene import Imagery
from seasonscapes.source_hash import source_hash
from seasonscapes.terrain.surface import Raster, Texture, load_texture, save_texture
from seasonscapes.workflows.delighting import delit_imagery, imagery_time
from seasonscapes.workflows.edited_textures import albedo_date, read_albedo, require_albedo_file
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.scene_imagery import atlas_image
from seasonscapes.workspace import build_once, file_hash, is_built

# What workflows accept as ``albedo``: a texture of the place's atlas, an albedo of one date, albedos of several dates
# with their interpolation, or ``None`` for the scene's own.
AlbedoSource = Texture | DatedAlbedo | AlbedoSeries | None

log = logging.getLogger(__name__)

_IMAGE_CODE = ("terrain.imagery", "workflows.scene_imagery")
_DELIT_CODE = ("workflows.delighting",)
_SYNTHETIC_CODE = ("terrain.imagery", "terrain.synthetic")
_EDITED_CODE = ("workflows.edited_textures",)
_TRANSITION_CODE = ("albedo.seasons", "albedo.closed_form", "terrain.attributes")
# Where a scene has no image, the ground is uniformly grey: between rock and meadow.
GREY_ALBEDO = 0.2
# Day of an albedo that states none.
_UNDATED = date(2024, 7, 1)
# A synthetic place has no satellite; its albedo of this day of the year stands for a summer image.
IMAGE_DAY = 205
# The albedo of a synthetic place is known for every day; films interpolate between these days of each month.
_FILM_DAYS = (1, 16)


@dataclass(frozen=True)
class AlbedoFile:
    """A recovered albedo texture on disk and the date that it is valid for.

    Parameters
    ----------
    day
        The date.
    path
        What ``seasonscapes albedo`` wrote, or a picture of the atlas; see `edited_textures.read_albedo`.
    """

    day: date
    path: Path


def scene_albedo(place: Place, day: date | str, *, progress: Progress | None = None) -> Texture:
    """Return the albedo texture of a date: the synthetic truth of that day, or that of the scene's images.

    Parameters
    ----------
    place
        The place.
    day
        A date, datetime or ISO 8601 text; it matters for synthetic places and for scenes with several dated images, between
        which the albedo is interpolated.
    progress
        Called with a task and its finished share.

    Returns
    -------
    Texture
        Linear reflectance in [0, 1]. ``weight`` is 0 where the image does not reach; the albedo there is the image's
        median colour. Without an image it is uniformly 0.2, of weight 0.

    Examples
    --------
    >>> from datetime import date
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> summer, winter = (ss.scene_albedo(place, date(2024, month, 15)).values.mean() for month in (7, 1))
    >>> bool(winter > summer)
    True
    """
    from seasonscapes.terrain.imagery import bake_imagery

    day = date.fromisoformat(day) if isinstance(day, str) else day
    inputs: dict[str, Any] = {"terrain": place.key}
    if place.synthetic is not None:
        name, inputs = _synthetic_day(place, day)
        image = partial(synthetic_image, place, day.timetuple().tm_yday)
        return texture_once(
            place, name, inputs, code=_SYNTHETIC_CODE, build=lambda: bake_imagery(place.terrain, place.atlas, image())
        )
    images = place.scene.images
    if len(images) > 1:
        return albedo_of_day(place, AlbedoSeries(tuple(dated_albedos(place, progress=progress))), day)
    if not images:
        log.warning("%s: names no image: the land is grey, with an albedo of %g", place.path, GREY_ALBEDO)
        values = np.full((*place.texture_shape, 3), GREY_ALBEDO, np.float32)
        return Texture(values, np.zeros(place.texture_shape, np.float32), place.atlas_id)
    return _image_albedo(place, 0, progress)


def _synthetic_day(place: Place, day: date) -> tuple[str, dict[str, Any]]:
    """Name and inputs of the albedo of a day, as an artefact of a synthetic place."""
    day_of_year = day.timetuple().tm_yday
    return f"albedo-day{day_of_year:03d}", {"terrain": place.key, "day_of_year": day_of_year}


def keep_synthetic_albedos(place: Place, days: Sequence[date]) -> None:
    """Make the albedos of several days that a synthetic place's workspace lacks, together.

    What no day changes (noise, the faces under the texels, and where these lie in the image) is computed once for all. Nothing is
    made where one albedo alone is missing, since `scene_albedo` makes it where it is asked for.

    Parameters
    ----------
    place
        The place; without a synthetic massif nothing is done.
    days
        The dates; all of their textures are in memory at once.
    """
    from seasonscapes.terrain.imagery import bake_imagery

    artefacts = {day: _synthetic_day(place, day) for day in days} if place.synthetic is not None else {}

    def is_kept(name: str, inputs: dict[str, Any]) -> bool:
        return is_built(place.workspace, f"{place.scene.name}/{name}", inputs, code=_SYNTHETIC_CODE, suffix=".npz")

    missing = [day for day, artefact in artefacts.items() if not is_kept(*artefact)]
    if len(missing) < 2:
        return
    image = synthetic_image(place, *(day.timetuple().tm_yday for day in missing))
    baked = bake_imagery(place.terrain, place.atlas, image)
    for number, day in enumerate(missing):
        name, inputs = artefacts[day]
        values = np.ascontiguousarray(baked.values[..., 3 * number : 3 * number + 3])
        texture = replace(baked, values=values)
        texture_once(place, name, inputs, code=_SYNTHETIC_CODE, build=lambda texture=texture: texture)


def _image_albedo(place: Place, number: int, progress: Progress | None = None) -> Texture:
    """The albedo of one of the scene's images; where its hour or sun is stated, without its light."""
    imagery, (declared, content) = place.scene.images[number], place.scene.image_keys[number]
    inputs: dict[str, Any] = {"terrain": place.key, "imagery": declared, "hash": content}
    time = imagery_time(imagery)
    if time is None:
        if not imagery.delit:
            _tell_light_stays(imagery.label)
        texture = texture_once(place, "albedo", inputs, code=_IMAGE_CODE, build=lambda: _baked_image(place, imagery))
    else:
        log.info("%s: its light is taken out", imagery.label)
        texture = texture_once(
            place,
            "albedo-delit",
            inputs,
            code=_DELIT_CODE,
            build=lambda: delit_imagery(place, time, image=imagery, sky=imagery.sky, progress=progress).texture,
        )
    _tell_image(place, imagery, texture)
    return texture


def _tell_image(place: Place, imagery: Imagery, texture: Texture) -> None:
    """Warn of what was understood of one of the scene's images, and of land that it does not cover."""
    from seasonscapes.terrain.image_bands import image_facts
    from seasonscapes.terrain.texels import covered_share

    facts = image_facts(
        imagery.paths[0],
        bands=tuple(imagery.bands) if imagery.bands else None,
        full_scale=imagery.full_scale,
        confinement=place.scene.confinement,
    )
    for line in facts.told:
        log.warning("%s", line)
    share = covered_share(place.terrain, texture.weight)
    if share < 0.999:
        log.warning(
            "%s: the image covers %.3g %% of the land; the rest has its median colour", imagery.label, 100.0 * share
        )


def texture_once(
    place: Place, name: str, inputs: dict[str, Any], *, code: tuple[str, ...], build: Callable[[], Texture]
) -> Texture:
    """A texture of a place from its workspace, or built and kept there; see `workspace.build_once`."""
    return build_once(
        place.workspace,
        f"{place.scene.name}/{name}",
        inputs,
        code=code,
        suffix=".npz",
        build=build,
        save=save_texture,
        load=load_texture,
    )


def orthoimage(place: Place, day: date) -> Texture | None:
    """Return the scene's image of a day in the atlas (``weight`` 0 where it does not reach), or ``None`` without one.

    The image of a synthetic place is its albedo of a summer day; only the year of ``day`` matters.
    """
    if place.synthetic is not None:
        return scene_albedo(place, day.replace(month=1, day=1) + timedelta(days=IMAGE_DAY - 1))
    return scene_albedo(place, day) if place.scene.images else None


def dated_albedos(
    place: Place, files: Sequence[AlbedoFile] = (), *, progress: Progress | None = None
) -> list[DatedAlbedo]:
    """Return the albedos of a place through the year, by date.

    Parameters
    ----------
    place
        The place.
    files
        Recovered albedos to use instead of the scene's own.
    progress
        Called with a task and its finished share while light is taken out of an image.

    Returns
    -------
    list of DatedAlbedo
        Sorted by date; textures are read when they are needed.

    Raises
    ------
    InputError
        For a file that is missing or no texture; `errors.AtlasMismatch` (when it is read) for one of another atlas.
    """
    if files:
        return sorted((_from_file(place, file) for file in files), key=lambda dated: dated.day)
    if place.synthetic is None:
        if not place.scene.images:
            return [DatedAlbedo(_UNDATED, "grey", lambda: scene_albedo(place, _UNDATED))]
        return sorted(
            (_dated_image(place, number, progress) for number in range(len(place.scene.images))),
            key=lambda dated: dated.day,
        )
    days = [datetime(2024, month, day) for month in range(1, 13) for day in _FILM_DAYS]
    return [
        DatedAlbedo(
            day.date(),
            f"synthetic:{day.timetuple().tm_yday}:{source_hash(*_SYNTHETIC_CODE)}",
            partial(scene_albedo, place, day),
        )
        for day in days
    ]


def _dated_image(place: Place, number: int, progress: Progress | None) -> DatedAlbedo:
    declared, content = place.scene.image_keys[number]
    code = source_hash(*_IMAGE_CODE if imagery_time(declared) is None else _DELIT_CODE)
    identity = ":".join((declared.model_dump_json(), content, code))
    return DatedAlbedo(declared.day or _UNDATED, identity, partial(_image_albedo, place, number, progress))


def albedo_series(
    place: Place, files: Sequence[AlbedoFile] = (), season: str = "blended", *, progress: Progress | None = None
) -> AlbedoSeries | None:
    """The dated albedos of given files, else of the scene's several images; ``None`` where there is nothing to choose from.

    Parameters
    ----------
    place, files, progress
        As in `dated_albedos`.
    season
        Interpolation between the dates; see `albedo.seasons.AlbedoSeries`.
    """
    if not files and len(place.scene.images) < 2:
        return None
    return AlbedoSeries(tuple(dated_albedos(place, files, progress=progress)), season)


def load_albedo(place: Place, path: str | Path, day: date | str | None = None) -> DatedAlbedo:
    """Return a recovered albedo file as a dated albedo of a place.

    Parameters
    ----------
    place
        The place whose atlas the texture belongs to.
    path
        A ``.npz`` file that ``seasonscapes albedo`` or `RecoveredAlbedo.save` wrote; or a ``.png``, ``.exr`` or ``.glb``
        of this place's atlas, edited elsewhere. The light that ``seasonscapes lit-texture`` put in is taken out again.
    day
        The date it is valid for (date or ISO 8601); default: the date that the file states.

    Returns
    -------
    DatedAlbedo
        The texture is read when it is needed.

    Raises
    ------
    InputError
        Where the file is missing or no texture, or states no date and none is given.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     values = np.full((*place.texture_shape, 3), 0.2, np.float32)
    ...     np.savez(f"{folder}/albedo.npz", values=values, weight=values[..., 0], atlas_id=place.atlas_id)
    ...     albedo = ss.load_albedo(place, f"{folder}/albedo.npz", "2024-07-20")
    ...     light = ss.predict_radiance(place, albedo, "2024-07-20T13:30", sky="hosek")
    >>> albedo.day.isoformat()
    '2024-07-20'
    """
    path = Path(path)
    if day is None:
        day = albedo_date(path)
        if day is None:
            raise InputError(path, "states no date", cure="give one: load_albedo(place, path, day='2024-07-20')")
    return _from_file(place, AlbedoFile(date.fromisoformat(day) if isinstance(day, str) else day, path))


def _from_file(place: Place, file: AlbedoFile) -> DatedAlbedo:
    require_albedo_file(file.path)
    content = file_hash(file.path)

    def load() -> Texture:
        if file.path.suffix.lower() == ".npz":
            return read_albedo(place, file.path)
        # The light of an hour is computed once for all frames and processes.
        inputs = {"terrain": place.key, "atlas": place.atlas_id, "file": content}
        build = partial(read_albedo, place, file.path)
        return texture_once(place, "edited-albedo", inputs, code=_EDITED_CODE, build=build)

    return DatedAlbedo(file.day, content, load)


def require_season(season: str, *, where: str = "season") -> None:
    """`InputError` for a way of interpolating between dated albedos that does not exist."""
    if season not in SEASONS:
        raise InputError(where, "unknown", got=season, expected=", ".join(SEASONS))


def snow_transition_between(place: Place, first: DatedAlbedo, second: DatedAlbedo) -> Texture:
    """When each texel changes between two dated albedos, see `albedo.seasons.snow_transition`; kept in the workspace."""

    def build() -> Texture:
        from seasonscapes.albedo.closed_form import fill_nearest
        from seasonscapes.terrain.attributes import texel_attributes

        shape = place.texture_shape
        attributes, texel = texel_attributes(place.terrain, shape)
        values, weight = np.zeros((shape[0] * shape[1], 3), np.float32), np.zeros(shape, np.float32)
        weight.reshape(-1)[texel] = 1.0
        both = (dated.load().values.reshape(-1, 3)[texel] for dated in (first, second))
        values[texel] = snow_transition(attributes, *both)
        # Bilinear look-ups at the rim reach texels beyond the surface.
        return Texture(fill_nearest(values.reshape(*shape, 3), weight), weight, place.atlas_id)

    return texture_once(
        place,
        "snow-transition",
        {"terrain": place.key, "dated": [first.content, second.content]},
        code=_TRANSITION_CODE,
        build=build,
    )


def albedo_of_day(place: Place, series: AlbedoSeries, day: date) -> Texture:
    """Interpolate a place's albedo on a day from dated albedos.

    Parameters
    ----------
    place
        The place.
    series
        Albedos with their dates and their interpolation.
    day
        The day; on a date of ``series`` the result is that texture to the bit.

    Returns
    -------
    Texture
        Linear reflectance in [0, 1].
    """
    dated = series.dated
    weights = season_weights([each.day for each in dated], day, season=series.season)
    textures = [dated[index].load() for index, _ in weights]
    if len(weights) == 1:
        return textures[0]
    first, second = (dated[index] for index, _ in weights)
    fraction, weight = weights[1][1], np.minimum(textures[0].weight, textures[1].weight)
    if series.season == "snow-line":
        transition = snow_transition_between(place, first, second).values
        snowline = snowline_fraction(*(day_number(each) for each in (first.day, second.day, day)))
    else:
        transition, snowline = np.zeros_like(textures[0].values), fraction
    values = interpolate_albedo((textures[0].values, textures[1].values), transition, fraction, snowline)
    return Texture(values, weight, place.atlas_id, _mixed_tilt(textures, fraction))


def _mixed_tilt(textures: Sequence[Texture], fraction: float) -> np.ndarray | None:
    """Tilts between two dates; a texture without any has the normals of the heights."""
    shares = zip(textures, (1.0 - fraction, fraction), strict=True)
    parts = [np.float32(share) * each.tilt for each, share in shares if each.tilt is not None]
    return np.asarray(np.sum(parts, axis=0), np.float32) if parts else None


def chosen_albedo(place: Place, day: date, albedo: AlbedoSource = None, *, progress: Progress | None = None) -> Texture:
    """Resolve the ``albedo`` argument of a workflow to a texture of the place on a day.

    Parameters
    ----------
    place, day
        The place and the date.
    albedo
        A texture of the place's atlas, a dated albedo, a series of them, or ``None`` for the scene's own albedo.
    progress
        Called with a task and its finished share.

    Raises
    ------
    AtlasMismatch
        For a texture of another atlas.
    """
    if albedo is None:
        return scene_albedo(place, day, progress=progress)
    if isinstance(albedo, Texture):
        return place.require_texture(albedo, what="albedo")
    return albedo_of_day(place, AlbedoSeries((albedo,)) if isinstance(albedo, DatedAlbedo) else albedo, day)


def synthetic_image(place: Place, *days_of_year: int) -> Raster:
    """The true albedo of a synthetic place on its own finer grid: three channels of each day."""
    from affine import Affine

    from seasonscapes.terrain.synthetic_albedo import alpine_albedos

    assert place.synthetic is not None
    assert place.scene.elevation is not None
    declared = place.scene.elevation.synthetic
    assert declared is not None
    # The albedo's own detail comes in powers of two of the massif's cells.
    ratio = place.synthetic.spacing_m / declared.detail_m
    upsample = 2 ** int(np.clip(round(np.log2(ratio)), 0, 3))
    values = alpine_albedos(place.synthetic, days_of_year, upsample=upsample)
    elevation = place.synthetic.elevation
    return Raster(values, elevation.transform * Affine.scale(1.0 / upsample), elevation.crs)


def _baked_image(place: Place, imagery: Imagery) -> Texture:
    """The scene's image as it is, taken for an albedo."""
    image = atlas_image(place, imagery)
    values = np.clip(image.values * imagery.reflectance_scale, 0.0, 0.95)
    covered = image.weight > 0.0
    values[~covered] = np.median(values[covered], axis=0)
    return Texture(values, image.weight, place.atlas_id)


@lru_cache(maxsize=64)
def _tell_light_stays(label: str) -> None:
    """Log once for each image that its light is not taken out."""
    log.info(
        '%s: the light of its hour stays in the image; to take it out, state [imagery] time = "…" (or "unknown"), '
        "or delit = true where it holds none",
        label,
    )
