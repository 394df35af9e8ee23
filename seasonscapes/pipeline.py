"""From a scene file to things in memory: load, call one function of a stage, save in the workspace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import date, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes import bundled
from seasonscapes.albedo.seasons import (
    DatedAlbedo,
    day_number,
    interpolate_albedo,
    season_weights,
    snow_transition,
    snowline_fraction,
)
from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame, geodetic_from_enu
from seasonscapes.scene import NamedCamera, SceneFile, camera_from_place, read_scene
from seasonscapes.terrain.surface import (
    Raster,
    Terrain,
    Texture,
    load_terrain,
    load_texture,
    save_terrain,
    save_texture,
)
from seasonscapes.workspace import Workspace, build_once, file_hash

if TYPE_CHECKING:
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.terrain.raster import FillReport
    from seasonscapes.terrain.synthetic import SyntheticMassif
    from seasonscapes.terrain.unwrap import Atlas

# Raised when a stage's result changes for equal inputs, so that old artefacts are not taken for new ones.
REVISIONS = {"place": 3, "terrain": 1, "albedo": 1, "turning": 1}


@dataclass(frozen=True)
class MeshOptions:
    """How to build the terrain; ``None`` lets the data decide.

    Parameters
    ----------
    mesher, max_error_m
        See `terrain.mesh.build_mesh`. Left out, the bound is a fifteenth of the samples' spacing, at most 5 m.
    refine
        Interpolate this many times finer before meshing; see `terrain.refine`. Left out, as far as it pays.
    atlas, texel_m
        See `terrain.unwrap.unwrap`. Left out, texels are as fine as the imagery, at most 4,096 on a side.
    """

    mesher: str = "adaptive"
    max_error_m: float | None = None
    refine: int | None = None
    atlas: str = "planar"
    texel_m: float | None = None
    max_side_px: int = 4096


@dataclass(frozen=True)
class Place:
    """A scene file with its rasters read and its terrain built.

    Parameters
    ----------
    path
        The scene file.
    elevation
        Heights ``(H, W, 1)`` [m] in the scene's datum, holes filled; ``fill`` says what was filled.
    synthetic
        The synthetic place, where the scene is one.
    key
        Plain values that decide the terrain; the start of every later artefact's key.
    """

    path: Path
    scene: SceneFile
    frame: LocalFrame
    elevation: Raster
    fill: FillReport
    terrain: Terrain
    atlas: Atlas
    synthetic: SyntheticMassif | None
    key: dict
    workspace: Workspace


def find_scene(name: str) -> Path:
    """The path of a scene file, or of a bundled scene by its bare name (``alpine``)."""
    path = Path(name)
    if path.suffix == ".toml" or path.is_file():
        return path
    return bundled.bundled_path("scenes", name)


def load_place(
    path: Path, workspace: Workspace, *, options: MeshOptions | None = None, allow_outside: bool = False
) -> Place:
    """Read a scene file and its elevation, and build its terrain (or load it, where it was built before)."""
    options = options or MeshOptions()
    scene = read_scene(path, allow_outside=allow_outside)
    if scene.elevation is None:
        raise InputError(path, "names no elevation raster", cure='add a table [elevation] with file = "dem.tif"')
    elevation, fill, synthetic = _elevation(path, scene, workspace)
    frame = _frame(scene, elevation)
    source = scene.elevation.file
    key = {
        "revision": [REVISIONS["place"], REVISIONS["terrain"]],
        "elevation": scene.elevation.model_copy(update={"file": source and Path(source).name}),
        "elevation_hash": source and file_hash(source),
        "area": scene.area,
        "frame": frame,
        "options": options,
    }
    terrain, atlas = build_once(
        workspace,
        f"{scene.name}/terrain",
        key,
        suffix=".npz",
        save=_save_terrain,
        load=_load_terrain,
        build=lambda: _terrain(elevation, frame, scene, options),
    )
    return Place(Path(path), scene, frame, elevation, fill, terrain, atlas, synthetic, key, workspace)


def _elevation(path: Path, scene: SceneFile, workspace: Workspace):
    from seasonscapes.terrain.raster import fill_nodata, read_elevation

    if scene.elevation.synthetic is not None:
        from seasonscapes.terrain.synthetic import alpine_massif, load_massif, save_massif

        made = scene.elevation.synthetic
        inputs = {"revision": REVISIONS["place"], "synthetic": made}
        synthetic = build_once(
            workspace,
            f"{scene.name}/massif",
            inputs,
            suffix=".npz",
            save=save_massif,
            load=load_massif,
            build=lambda: alpine_massif(seed=made.seed, size_m=made.size_m, spacing_m=made.spacing_m),
        )
        raster = synthetic.elevation
    else:
        synthetic = None
        bounds = scene.area.bounds_deg if scene.area is not None else None
        raster = read_elevation(scene.elevation.file, bounds_deg=bounds, band=scene.elevation.band)
    filled, report = fill_nodata(raster, max_share=scene.elevation.max_hole_share, where=f"{path}: elevation.file")
    return filled, report, synthetic


def _frame(scene: SceneFile, elevation: Raster) -> LocalFrame:
    from seasonscapes.terrain.raster import bounds_geographic, centre_frame

    if scene.origin is None:
        return centre_frame(elevation, refraction_k=scene.refraction_k)
    origin = scene.origin
    west, south, east, north = bounds_geographic(elevation)
    if not (west - 1.0 <= origin.longitude_deg <= east + 1.0 and south - 1.0 <= origin.latitude_deg <= north + 1.0):
        raise InputError(
            "origin",
            "lies more than 1° outside the elevation raster",
            got=f"{origin.latitude_deg}, {origin.longitude_deg}",
            expected=f"latitude {south:.3f} … {north:.3f}, longitude {west:.3f} … {east:.3f}",
        )
    return LocalFrame(origin.latitude_deg, origin.longitude_deg, origin.height_m, scene.refraction_k)


def sample_spacing_m(raster: Raster) -> float:
    """Mean distance between neighbouring samples on the ground [m]."""
    from seasonscapes.frames import enu_from_geodetic
    from seasonscapes.terrain.raster import geodetic_from_map

    height, width = raster.values.shape[:2]
    column, row = np.array([0.0, 1.0, 0.0]) + width // 2, np.array([0.0, 0.0, 1.0]) + height // 2
    latitude, longitude = geodetic_from_map(raster.crs, *(raster.transform * (column, row)))
    places = enu_from_geodetic(LocalFrame(float(latitude[0]), float(longitude[0])), latitude, longitude, 0.0)
    return float(np.mean(np.linalg.norm(places[1:], axis=1)))


def _terrain(elevation: Raster, frame: LocalFrame, scene: SceneFile, options: MeshOptions) -> tuple[Terrain, Atlas]:
    from seasonscapes.terrain.mesh import MESHERS, build_mesh
    from seasonscapes.terrain.refine import refine_raster, refinement_factor
    from seasonscapes.terrain.unwrap import ATLASES, unwrap

    if options.mesher not in MESHERS:
        raise InputError("--mesher", "unknown mesher", got=options.mesher, expected=", ".join(MESHERS))
    if options.atlas not in ATLASES:
        raise InputError("--atlas", "unknown atlas", got=options.atlas, expected=", ".join(ATLASES))
    spacing_m = sample_spacing_m(elevation)
    factor = options.refine or refinement_factor(elevation.values[..., 0].size, spacing_m)
    bound = options.max_error_m or min(5.0, spacing_m / factor / 15.0)
    terrain = build_mesh(refine_raster(elevation, factor), frame, mesher=options.mesher, max_error_m=bound)
    return unwrap(
        terrain,
        kind=options.atlas,
        texel_m=_texel_m(terrain, elevation, scene, options),
        max_side_px=options.max_side_px,
    )


def _save_terrain(built: tuple[Terrain, Atlas], path: Path) -> None:
    terrain, atlas = built
    save_terrain(terrain, path, note=asdict(atlas))


def _load_terrain(path: Path) -> tuple[Terrain, Atlas]:
    from seasonscapes.terrain.unwrap import Atlas

    terrain, note = load_terrain(path)
    return terrain, Atlas(**note)


def _texel_m(terrain: Terrain, elevation: Raster, scene: SceneFile, options: MeshOptions) -> float:
    """Texel side [m]: what was asked for, or as fine as the place's colours are, within the side limit."""
    wish = options.texel_m
    if wish is None and scene.elevation.synthetic is not None:
        wish = scene.elevation.synthetic.detail_m
    elif wish is None and scene.imagery is not None:
        wish = 0.7 * sample_spacing_m(_image_grid(scene.imagery.file))
    elif wish is None:
        wish = sample_spacing_m(elevation)
    extent_m = float(np.ptp(terrain.vertices[:, :2], axis=0).max())
    return max(wish, extent_m / options.max_side_px * (1.0 + 1e-9))


def _image_grid(path: str) -> Raster:
    """The grid of a raster file without its values."""
    import rasterio

    with rasterio.open(path) as source:
        return Raster(np.empty((source.height, source.width, 0), np.float32), source.transform, source.crs.to_string())


def albedo_for(place: Place, date: datetime) -> Texture:
    """The albedo texture of a date: the synthetic truth of that day, or the scene's image.

    ``weight`` is 0 where the image does not reach; there the albedo is the image's median colour.
    """
    from seasonscapes.terrain.imagery import bake_imagery

    inputs: dict[str, Any] = {"revision": REVISIONS["albedo"], "terrain": place.key}
    if place.synthetic is not None:
        day = date.timetuple().tm_yday
        inputs["day_of_year"] = day
        return build_once(
            place.workspace,
            f"{place.scene.name}/albedo-day{day:03d}",
            inputs,
            suffix=".npz",
            save=save_texture,
            load=load_texture,
            build=lambda: bake_imagery(place.terrain, place.atlas, _synthetic_image(place, day)),
        )
    imagery = place.scene.imagery
    if imagery is None:
        inputs["uniform"] = GREY_ALBEDO
        shape = (place.atlas.height_px, place.atlas.width_px)
        return Texture(np.full((*shape, 3), GREY_ALBEDO, np.float32), np.zeros(shape, np.float32))
    inputs.update(imagery=imagery.model_copy(update={"file": Path(imagery.file).name}), hash=file_hash(imagery.file))
    return build_once(
        place.workspace,
        f"{place.scene.name}/albedo",
        inputs,
        suffix=".npz",
        save=save_texture,
        load=load_texture,
        build=lambda: _baked_image(place),
    )


# The synthetic place has no satellite; its colours of this day stand for a summer's image.
_IMAGE_DAY = 205


def image_from_above(place: Place, date: datetime) -> Texture | None:
    """The scene's image, ``weight`` 0 where it does not reach; of a synthetic place its colours of a summer's day.

    ``None`` where the scene names none. Of ``date`` the year counts alone.
    """
    if place.synthetic is not None:
        return albedo_for(place, date.replace(month=1, day=1) + timedelta(days=_IMAGE_DAY - 1))
    return None if place.scene.imagery is None else albedo_for(place, date)


# A synthetic place's albedo is known for every day; films pass through those of these days of each month.
_FILM_DAYS = (1, 16)


def dated_albedos(place: Place, given: Sequence[tuple[str, str]] = ()) -> list[DatedAlbedo]:
    """The albedos that a place wears through the year, by date.

    Parameters
    ----------
    given
        Pairs of date (ISO 8601) and file (of `terrain.surface.save_texture`) to use in place of the scene's own.

    Raises
    ------
    InputError
        For a date that is none, a file that is missing, or a texture that is not of this place's atlas.
    """
    if given:
        return sorted((_given_albedo(place, day, Path(name)) for day, name in given), key=lambda each: each.day)
    if place.synthetic is None:
        moment = datetime(2024, 7, 1)
        imagery = place.scene.imagery
        content = "grey" if imagery is None else f"{imagery.model_dump_json()}:{file_hash(imagery.file)}"
        return [DatedAlbedo(moment.date(), content, lambda: albedo_for(place, moment))]
    moments = [datetime(2024, month, day) for month in range(1, 13) for day in _FILM_DAYS]
    return [
        DatedAlbedo(
            each.date(), f"synthetic:{REVISIONS['albedo']}:{each.timetuple().tm_yday}", partial(albedo_for, place, each)
        )
        for each in moments
    ]


def turning_between(place: Place, first: DatedAlbedo, second: DatedAlbedo) -> Texture:
    """When each texel changes between two dated albedos, see `albedo.seasons.snow_transition`; kept in the workspace."""
    inputs = {"revision": REVISIONS["turning"], "terrain": place.key, "dated": [first.content, second.content]}

    def build() -> Texture:
        from seasonscapes.albedo.closed_form import fill_nearest
        from seasonscapes.terrain.attributes import texel_attributes

        shape = (place.atlas.height_px, place.atlas.width_px)
        ground, texel = texel_attributes(place.terrain, shape)
        values, weight = np.zeros((shape[0] * shape[1], 3), np.float32), np.zeros(shape, np.float32)
        weight.reshape(-1)[texel] = 1.0
        values[texel] = snow_transition(ground, *(each.load().values.reshape(-1, 3)[texel] for each in (first, second)))
        # Bilinear look-ups at the rim reach texels beyond the surface.
        return Texture(fill_nearest(values.reshape(*shape, 3), weight), weight)

    return build_once(
        place.workspace,
        f"{place.scene.name}/snow-turning",
        inputs,
        suffix=".npz",
        save=save_texture,
        load=load_texture,
        build=build,
    )


def albedo_of_day(place: Place, dated: Sequence[DatedAlbedo], day: date, *, season: str = "blended") -> Texture:
    """The albedo texture that a place wears on a day, from dated ones; ``season`` as in `albedo.seasons.season_weights`.

    On the dates themselves it is the dated texture to the bit.
    """
    weights = season_weights([each.day for each in dated], day, season=season)
    textures = [dated[index].load() for index, _ in weights]
    if len(weights) == 1:
        return textures[0]
    first, second = (dated[index] for index, _ in weights)
    way, seen = weights[1][1], np.minimum(textures[0].weight, textures[1].weight)
    if season == "snow-line":
        turning = turning_between(place, first, second).values
        line = snowline_fraction(*(day_number(each) for each in (first.day, second.day, day)))
    else:
        turning, line = np.zeros_like(textures[0].values), way
    return Texture(interpolate_albedo((textures[0].values, textures[1].values), turning, way, line), seen)


def _given_albedo(place: Place, day: str, path: Path) -> DatedAlbedo:
    try:
        when = date.fromisoformat(day)
    except ValueError:
        raise InputError(
            "--albedo", "not a date", got=day, expected="DATE=FILE.npz, such as 2024-07-20=summer.npz"
        ) from None
    if not path.is_file():
        raise InputError("--albedo", "no such file", got=str(path))

    def load() -> Texture:
        texture = load_texture(path)
        shape = (place.atlas.height_px, place.atlas.width_px)
        if texture.values.shape[:2] != shape:
            raise InputError(
                path,
                "this texture is of another atlas",
                got="{} × {} texels".format(*texture.values.shape[:2]),
                expected="{} × {}".format(*shape),
                cure="give the --atlas and --texel-m that it was made with",
            )
        return texture

    return DatedAlbedo(when, file_hash(path), load)


def _synthetic_image(place: Place, day_of_year: int) -> Raster:
    """The truth of a synthetic place's albedo on its own finer grid."""
    from affine import Affine

    from seasonscapes.terrain.synthetic import alpine_albedo

    # The albedo's own detail comes in powers of two of the massif's cells.
    ratio = place.synthetic.spacing_m / place.scene.elevation.synthetic.detail_m
    upsample = 2 ** int(np.clip(round(np.log2(ratio)), 0, 3))
    values = alpine_albedo(place.synthetic, day_of_year, upsample=upsample)
    elevation = place.synthetic.elevation
    return Raster(values, elevation.transform * Affine.scale(1.0 / upsample), elevation.crs)


# Without any image the ground is grey rock and meadow alike.
GREY_ALBEDO = 0.2


def _baked_image(place: Place) -> Texture:
    from dataclasses import replace

    from seasonscapes.terrain.imagery import bake_imagery, read_imagery
    from seasonscapes.terrain.raster import bounds_geographic

    imagery = place.scene.imagery
    bands = tuple(imagery.bands) if imagery.bands else None
    # Imagery far finer than the texels is averaged while it is read.
    image = read_imagery(
        imagery.file,
        bounds_deg=bounds_geographic(place.elevation),
        bands=bands,
        finest_m=0.5 * place.atlas.texel_p50_m,
        encoding=imagery.encoding,
        full_scale=imagery.full_scale,
    )
    texture = bake_imagery(place.terrain, place.atlas, image)
    values = np.clip(texture.values * imagery.reflectance_scale, 0.0, 0.95)
    seen = texture.weight > 0.0
    values[~seen] = np.median(values[seen], axis=0)
    return replace(texture, values=values)


def ground_height_m(place: Place, latitude_deg: float, longitude_deg: float, *, where: str) -> float:
    """Height of the terrain at a place in the scene's datum [m]; `InputError` outside the raster."""
    from seasonscapes.terrain.raster import bounds_geographic, map_from_geodetic, sample_raster

    x, y = map_from_geodetic(place.elevation.crs, latitude_deg, longitude_deg)
    height = float(sample_raster(place.elevation, x, y)[..., 0])
    if not np.isfinite(height):
        west, south, east, north = bounds_geographic(place.elevation)
        raise InputError(
            where,
            "the place lies outside the elevation raster",
            got=f"{latitude_deg}, {longitude_deg}",
            expected=f"latitude {south:.4f} … {north:.4f}, longitude {west:.4f} … {east:.4f}",
        )
    return height


def camera_for(place: Place, view: NamedCamera, *, size_px: tuple[int, int], where: str = "--camera") -> Camera:
    """The pinhole camera of a view; `InputError` where it stands below the ground or, above ground, off the raster."""
    from seasonscapes.terrain.raster import map_from_geodetic, sample_raster

    if view.above_ground_m is not None:
        ground = ground_height_m(place, view.latitude_deg, view.longitude_deg, where=where)
    else:
        x, y = map_from_geodetic(place.elevation.crs, view.latitude_deg, view.longitude_deg)
        ground = float(sample_raster(place.elevation, x, y)[..., 0])  # NaN off the raster: nothing to be below of
        if view.height_m < ground:
            raise InputError(
                where,
                f"'{view.name}' stands below the ground",
                got=f"{view.height_m:g} m",
                expected=f"above {ground:.1f} m",
                cure="give above_ground_m instead",
            )
    return camera_from_place(place.frame, view, ground, size_px=size_px)


def camera_geodetic(place: Place, camera: Camera) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and height [m] of a camera."""
    latitude, longitude, height = geodetic_from_enu(place.frame, camera.position_m)
    return float(latitude), float(longitude), float(height)
