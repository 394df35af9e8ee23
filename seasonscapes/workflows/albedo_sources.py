"""The albedo of a place by date: from the synthetic massif, the scene's image, or recovered albedo files."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
from seasonscapes.scene import Imagery
from seasonscapes.source_hash import source_hash
from seasonscapes.terrain.surface import Raster, Texture, load_texture, save_texture
from seasonscapes.workflows.delighting import UNKNOWN, delit_imagery, imagery_time
from seasonscapes.workflows.edited_textures import albedo_date, read_albedo, require_albedo_file
from seasonscapes.workflows.place import Place, utc_at
from seasonscapes.workflows.scene_imagery import atlas_image
from seasonscapes.workspace import build_once, file_hash

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
# A synthetic place has no satellite; its albedo of this day of the year stands for a summer image.
_IMAGE_DAY = 205
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


def scene_albedo(place: Place, day: date | str) -> Texture:
    """Return the albedo texture of a date: the synthetic truth of that day, or the scene's image.

    Parameters
    ----------
    place
        The place.
    day
        A date, datetime or ISO 8601 text; it matters for synthetic places alone.

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
        day_of_year = day.timetuple().tm_yday
        return texture_once(
            place,
            f"albedo-day{day_of_year:03d}",
            inputs | {"day_of_year": day_of_year},
            code=_SYNTHETIC_CODE,
            build=lambda: bake_imagery(place.terrain, place.atlas, _synthetic_image(place, day_of_year)),
        )
    imagery = place.scene.imagery
    if imagery is None:
        log.warning("%s: names no image: the land is grey, with an albedo of %g", place.path, GREY_ALBEDO)
        values = np.full((*place.texture_shape, 3), GREY_ALBEDO, np.float32)
        return Texture(values, np.zeros(place.texture_shape, np.float32), place.atlas_id)
    inputs.update(imagery=imagery.model_copy(update={"file": Path(imagery.file).name}), hash=place.scene.image_hash)
    time = imagery_time(imagery)
    if time is None:
        if not imagery.delit:
            _tell_light_stays(imagery.file)
        texture = texture_once(place, "albedo", inputs, code=_IMAGE_CODE, build=lambda: _baked_image(place, imagery))
    else:
        log.info("%s: its light is taken out", Path(imagery.file).name)
        texture = texture_once(
            place,
            "albedo-delit",
            inputs,
            code=_DELIT_CODE,
            build=lambda: delit_imagery(place, time, sky=imagery.sky).texture,
        )
    _tell_image(place, texture)
    return texture


def _tell_image(place: Place, texture: Texture) -> None:
    """Warn of what was understood of the scene's image, and of land that it does not cover."""
    from seasonscapes.terrain.image_bands import image_facts
    from seasonscapes.terrain.texels import covered_share

    imagery = place.scene.imagery
    assert imagery is not None
    facts = image_facts(
        imagery.file,
        bands=tuple(imagery.bands) if imagery.bands else None,
        full_scale=imagery.full_scale,
        confinement=place.scene.confinement,
    )
    for line in facts.told:
        log.warning("%s", line)
    share = covered_share(place.terrain, texture.weight)
    if share < 0.999:
        log.warning(
            "%s: the image covers %.3g %% of the land; the rest has its median colour", imagery.file, 100.0 * share
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
    """Return the scene's image in the atlas (``weight`` 0 where it does not reach), or ``None`` without one.

    The image of a synthetic place is its albedo of a summer day; only the year of ``day`` matters.
    """
    if place.synthetic is not None:
        return scene_albedo(place, day.replace(month=1, day=1) + timedelta(days=_IMAGE_DAY - 1))
    return None if place.scene.imagery is None else scene_albedo(place, day)


def dated_albedos(place: Place, files: Sequence[AlbedoFile] = ()) -> list[DatedAlbedo]:
    """Return the albedos of a place through the year, by date.

    Parameters
    ----------
    place
        The place.
    files
        Recovered albedos to use instead of the scene's own.

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
        day, imagery, content = date(2024, 7, 1), place.scene.imagery, "grey"
        if imagery is not None:
            time = imagery_time(imagery)
            code = source_hash(*_IMAGE_CODE if time is None else _DELIT_CODE)
            content = ":".join((imagery.model_dump_json(), str(place.scene.image_hash), code))
            if isinstance(time, str) and time != UNKNOWN:
                day = utc_at(place, time).date()
        return [DatedAlbedo(day, content, lambda: scene_albedo(place, day))]
    days = [datetime(2024, month, day) for month in range(1, 13) for day in _FILM_DAYS]
    return [
        DatedAlbedo(
            day.date(),
            f"synthetic:{day.timetuple().tm_yday}:{source_hash(*_SYNTHETIC_CODE)}",
            partial(scene_albedo, place, day),
        )
        for day in days
    ]


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
    return Texture(values, weight, place.atlas_id)


def chosen_albedo(place: Place, day: date, albedo: AlbedoSource = None) -> Texture:
    """Resolve the ``albedo`` argument of a workflow to a texture of the place on a day.

    Parameters
    ----------
    place, day
        The place and the date.
    albedo
        A texture of the place's atlas, a dated albedo, a series of them, or ``None`` for the scene's own albedo.

    Raises
    ------
    AtlasMismatch
        For a texture of another atlas.
    """
    if albedo is None:
        return scene_albedo(place, day)
    if isinstance(albedo, Texture):
        return place.require_texture(albedo, what="albedo")
    return albedo_of_day(place, AlbedoSeries((albedo,)) if isinstance(albedo, DatedAlbedo) else albedo, day)


def _synthetic_image(place: Place, day_of_year: int) -> Raster:
    """The true albedo of a synthetic place on its own finer grid."""
    from affine import Affine

    from seasonscapes.terrain.synthetic import alpine_albedo

    assert place.synthetic is not None
    assert place.scene.elevation is not None
    declared = place.scene.elevation.synthetic
    assert declared is not None
    # The albedo's own detail comes in powers of two of the massif's cells.
    ratio = place.synthetic.spacing_m / declared.detail_m
    upsample = 2 ** int(np.clip(round(np.log2(ratio)), 0, 3))
    values = alpine_albedo(place.synthetic, day_of_year, upsample=upsample)
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
def _tell_light_stays(file: str) -> None:
    """Log once for each file that its light is not taken out."""
    log.info(
        '%s: the light of its hour stays in the image; to take it out, state [imagery] time = "…" (or "unknown"), '
        "or delit = true where it holds none",
        Path(file).name,
    )
