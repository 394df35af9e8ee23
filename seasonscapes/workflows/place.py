"""Places: a scene file with its rasters read and its terrain built."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes import bundled
from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame, enu_from_geodetic, frame_record
from seasonscapes.progress import Progress, task_progress
from seasonscapes.scene import SceneFile, read_scene
from seasonscapes.source_hash import source_hash
from seasonscapes.terrain.raster_files import rasters_hash
from seasonscapes.terrain.surface import Raster, Terrain, Texture, atlas_identity, require_atlas
from seasonscapes.terrain.water import levelled
from seasonscapes.workflows.camera_ground import rendered_up_m
from seasonscapes.workflows.nested_heights import finer_heights
from seasonscapes.workflows.scene_water import scene_water, water_key
from seasonscapes.workflows.terrain_building import MeshOptions
from seasonscapes.workspace import Workspace, build_once, default_workspace

if TYPE_CHECKING:
    from seasonscapes.scene import SyntheticElevation
    from seasonscapes.terrain.raster import FillReport
    from seasonscapes.terrain.synthetic_massif import SyntheticMassif
    from seasonscapes.terrain.unwrap import Atlas

__all__ = ["MeshOptions", "Place", "find_scene", "ground_height_m", "load_place", "utc_at"]

_TERRAIN_CODE = ("workflows.terrain_building",)
_MASSIF_CODE = ("terrain.synthetic",)
# The farthest sight on record, by refraction over the Alps and the Pyrenees, is some 440 km; pictures end far before.
FARTHEST_CAMERA_KM = 200.0

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Place:
    """A scene file with its elevation read and its terrain built; made by `load_place`.

    Parameters
    ----------
    path
        The scene file.
    scene
        What the scene file states.
    frame
        The local east-north-up frame of all positions [m] and directions.
    elevation
        Heights ``(H, W, 1)`` [m] in the scene's vertical datum, holes filled.
    fill
        Which holes were filled.
    terrain
        The triangulated surface with texture coordinates.
    atlas
        Size and quality of the UV atlas.
    synthetic
        The synthetic massif, where the scene is one.
    key
        Plain values that determine the terrain; part of the key of every artefact made from it.
    workspace
        Where built artefacts are kept.
    options
        How the terrain was meshed and unwrapped.
    finer_heights
        Heights of the parts of the terrain that have finer data, the coarsest first; see `workflows.nested_heights`.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> place.terrain.faces.shape[1], place.texture_shape == (place.atlas.height_px, place.atlas.width_px)
    (3, True)
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
    options: MeshOptions
    finer_heights: tuple[Raster, ...] = ()

    @property
    def texture_shape(self) -> tuple[int, int]:
        """Rows and columns of the place's textures [texels]."""
        return self.atlas.height_px, self.atlas.width_px

    @property
    def height_rasters(self) -> tuple[Raster, ...]:
        """All of the place's heights in order of precedence, the finest first."""
        return (*reversed(self.finer_heights), self.elevation)

    @cached_property
    def atlas_id(self) -> str:
        """Identity of the UV atlas, which textures of this place carry; see `terrain.surface.atlas_identity`."""
        return atlas_identity(self.terrain, self.atlas.width_px, self.atlas.height_px)

    @cached_property
    def median_height_m(self) -> float:
        """Median height of the terrain [m]; sun, sky and interreflection are computed for this height."""
        return float(np.median(self.elevation.values))

    @cached_property
    def about(self) -> dict:
        """Plain values for the metadata of files: scene, attribution, local frame with its origin, datum and CRS."""
        from seasonscapes.terrain.crs import crs_name

        record = frame_record(self.frame)
        record["origin"] |= {"vertical_datum": self.scene.vertical_datum}
        return {
            "scene": self.scene.name,
            "attribution": self.scene.attribution,
            **record,
            "source_crs": crs_name(self.elevation.crs),
        }

    def require_texture(self, texture: Texture, *, what: str = "texture") -> Texture:
        """Return the texture, or raise `errors.AtlasMismatch` where it belongs to another atlas."""
        require_atlas(texture, self.atlas_id, self.texture_shape, what=what)
        return texture


def find_scene(scene: str | Path) -> Path:
    """Return the path of a scene file, or of a bundled scene by its bare name (``alpine``).

    Raises
    ------
    InputError
        Where there is neither; it lists the bundled scenes.
    """
    path = Path(scene)
    if path.suffix == ".toml" or path.is_file():
        return path
    return bundled.bundled_path("scenes", str(scene))


def load_place(
    scene: str | Path = "alpine",
    workspace: Workspace | None = None,
    *,
    options: MeshOptions | None = None,
    allow_outside: bool = False,
    progress: Progress | None = None,
) -> Place:
    """Read a scene file and its elevation, and build its terrain, or load the terrain built before.

    Parameters
    ----------
    scene
        A scene file (``.toml``), or the name of a bundled scene: ``"alpine"``, ``"alpine_lake"`` or ``"alpine_small"``.
    workspace
        Where built artefacts are kept; default `workspace.default_workspace`.
    options
        How to mesh and unwrap; default: decided by the data.
    allow_outside
        Let the scene file name rasters outside its own folder.
    progress
        Called with a task and its finished share.

    Returns
    -------
    Place
        With a terrain in east-north-up metres about the scene's origin.

    Raises
    ------
    InputError
        One line about what is wrong with the scene file or its rasters.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> place.terrain.vertices.shape[1], place.scene.cameras[0].name
    (3, 'aerial')
    """
    options = options or MeshOptions()
    path, declared = scene_with_elevation(scene, allow_outside=allow_outside)
    assert declared.elevation is not None
    workspace = workspace or default_workspace()
    from seasonscapes.workflows import terrain_building

    report = task_progress(progress, "terrain")
    report(0.0)
    massif = scene_massif(declared, workspace)
    source = declared.elevation.all_paths
    images_matter = options.texel_m is None or any(image.finer for image in declared.images)
    key_name = "files" if declared.elevation.files else "file"
    elevation, fill = terrain_building.read_heights(declared, massif, where=f"{path}: elevation.{key_name}")
    water = scene_water(declared, elevation, massif)
    if water is not None:
        elevation = levelled(elevation, water)
    of_water = water_key(declared)
    finer = finer_heights(declared, elevation, water, workspace, of_water)
    report(0.3)
    _check_cameras(path, declared, elevation)
    frame = terrain_building.local_frame(declared, elevation)
    key = {
        "code": source_hash(*_TERRAIN_CODE),
        "elevation": declared.elevation.without_folders(),
        "elevation_hash": rasters_hash(source, declared.confinement) if source else None,
        # The finest image decides how fine texels are, and finer images of parts lie over the albedo.
        "images": [content for _, content in declared.image_keys] if images_matter else None,
        "area": declared.area,
        "frame": frame,
        "options": options,
        **of_water,
        # Generated or shipped: its maps count, not the code that makes them.
        **({} if massif is None else {"massif": massif.content}),
        **({} if declared.snow is None else {"snow": declared.snow}),
        **({} if declared.forest is None else {"forest": declared.forest}),
    }
    terrain, atlas = build_once(
        workspace,
        f"{declared.name}/terrain",
        key,
        code=_TERRAIN_CODE,
        suffix=".npz",
        build=lambda: terrain_building.build_terrain(
            elevation,
            frame,
            declared,
            options,
            finer=finer,
            water=water,
            progress=lambda share: report(0.3 + 0.7 * share),
        ),
        save=terrain_building.save_built_terrain,
        load=terrain_building.load_built_terrain,
    )
    terrain_building.tell_texel_wish(terrain, declared, options)
    report(1.0)
    return Place(path, declared, frame, elevation, fill, terrain, atlas, massif, key, workspace, options, finer)


def scene_with_elevation(scene: str | Path, *, allow_outside: bool = False) -> tuple[Path, SceneFile]:
    """Find and read a scene file; `InputError` where it names no elevation."""
    path = find_scene(scene)
    declared = read_scene(path, allow_outside=allow_outside)
    if declared.elevation is None:
        raise InputError(path, "names no elevation raster", cure='add a table [elevation] with file = "dem.tif"')
    return path, declared


def _check_cameras(path: Path, scene: SceneFile, elevation: Raster) -> None:
    """`InputError` where all cameras of a scene stand far from its raster; a warning about single ones that do."""
    from seasonscapes.terrain.placement import distance_km, likely_cause
    from seasonscapes.terrain.raster import bounds_geographic

    views = [(each.name, each) for each in scene.cameras] + [(each.id, each) for each in scene.webcams]
    if not views:
        return
    bounds = bounds_geographic(elevation)
    far = [(distance_km(view.latitude_deg, view.longitude_deg, bounds), name, view) for name, view in views]
    nearest, name, view = min(far, key=lambda each: each[0])
    if nearest > FARTHEST_CAMERA_KM:
        raise InputError(
            f"{path}: elevation.file",
            f"lies {nearest:.0f} km from the nearest camera, '{name}'",
            got=f"latitude {bounds[1]:.3f} … {bounds[3]:.3f}, longitude {bounds[0]:.3f} … {bounds[2]:.3f}",
            expected=f"near {view.latitude_deg:.3f}, {view.longitude_deg:.3f}",
            cure=likely_cause(elevation, view.latitude_deg, view.longitude_deg)
            or "check the CRS of the raster, and latitude and longitude of the cameras",
        )
    for distance, name, view in far:
        if distance > FARTHEST_CAMERA_KM:
            cause = likely_cause(elevation, view.latitude_deg, view.longitude_deg) or "check latitude and longitude"
            log.warning("%s: camera '%s' stands %.0f km from the terrain: %s", path, name, distance, cause)


def require_near(place: Place, latitude_deg: float, longitude_deg: float, *, where: str) -> None:
    """`InputError` about a position from which no terrain of the place can be seen, since it is too far away."""
    from seasonscapes.terrain.placement import distance_km, likely_cause
    from seasonscapes.terrain.raster import bounds_geographic

    west, south, east, north = bounds_geographic(place.elevation)
    distance = distance_km(latitude_deg, longitude_deg, (west, south, east, north))
    if distance > FARTHEST_CAMERA_KM:
        raise InputError(
            where,
            f"stands {distance:.0f} km from the terrain",
            got=f"{latitude_deg}, {longitude_deg}",
            expected=f"near latitude {south:.4f} … {north:.4f}, longitude {west:.4f} … {east:.4f}",
            cure=likely_cause(place.elevation, latitude_deg, longitude_deg),
        )


def scene_massif(scene: SceneFile, workspace: Workspace) -> SyntheticMassif | None:
    """The synthetic massif that a scene declares, shipped or generated once for a workspace; ``None`` where it names files."""
    from seasonscapes.terrain.shipped_massif import shipped_massif
    from seasonscapes.terrain.synthetic_massif import load_massif, save_massif

    declared = None if scene.elevation is None else scene.elevation.synthetic
    if declared is None:
        return None
    shipped = shipped_massif(seed=declared.seed, size_m=declared.size_m, spacing_m=declared.spacing_m)
    return shipped or build_once(
        workspace,
        f"{scene.name}/massif",
        {"synthetic": declared},
        code=_MASSIF_CODE,
        suffix=".npz",
        build=lambda: _generated_massif(declared),
        save=save_massif,
        load=load_massif,
    )


def _generated_massif(declared: SyntheticElevation) -> SyntheticMassif:
    # Imported here, since the generator loads libraries that nothing else needs.
    from seasonscapes.terrain.synthetic import alpine_massif

    return alpine_massif(seed=declared.seed, size_m=declared.size_m, spacing_m=declared.spacing_m)


def ground_height_m(place: Place, latitude_deg: float, longitude_deg: float, *, where: str) -> float:
    """Height of the rendered terrain at a position in the scene's vertical datum [m].

    The mesh may lie above the heights of the raster, most of all on summits, since it follows a smooth surface through
    the samples: a camera 2 m above the raster could stand inside it.

    Parameters
    ----------
    place
        The place.
    latitude_deg, longitude_deg
        WGS 84 position [deg].
    where
        What an error message calls the position, such as a flag.

    Raises
    ------
    InputError
        Outside the elevation raster.
    """
    from seasonscapes.terrain.raster import bounds_geographic

    require_near(place, latitude_deg, longitude_deg, where=where)
    height = ground_or_nan(place, latitude_deg, longitude_deg)
    if not np.isfinite(height):
        west, south, east, north = bounds_geographic(place.elevation)
        raise InputError(
            where,
            "the place lies outside the elevation raster",
            got=f"{latitude_deg}, {longitude_deg}",
            expected=f"latitude {south:.4f} … {north:.4f}, longitude {west:.4f} … {east:.4f}",
        )
    return height


def ground_or_nan(place: Place, latitude_deg: float, longitude_deg: float) -> float:
    """`ground_height_m`, or NaN outside the elevation raster."""
    from seasonscapes.terrain.crs import map_position
    from seasonscapes.terrain.raster import sample_raster

    x, y = map_position(place.elevation, latitude_deg, longitude_deg)
    height = float(sample_raster(place.elevation, x, y)[..., 0])
    position = enu_from_geodetic(place.frame, latitude_deg, longitude_deg, np.nan_to_num(height))
    rendered = rendered_up_m(place.terrain, position)
    return height + (rendered - float(position[2])) if np.isfinite(rendered) else height


def utc_at(place: Place, time: str | datetime) -> datetime:
    """Return the UTC instant of a time at a place.

    Parameters
    ----------
    place
        Its origin decides the time zone.
    time
        An aware datetime, or ISO 8601 text. A time without offset is civil time at the place.

    Returns
    -------
    datetime.datetime
        Aware, in UTC.

    Raises
    ------
    InputError
        For text that is no time, and for civil times that daylight saving skips or repeats.
    """
    from seasonscapes.civil_time import resolve_time

    if isinstance(time, datetime):
        if time.tzinfo is not None:
            return time.astimezone(UTC)
        time = time.isoformat()
    return resolve_time(time, place.frame.latitude_deg, place.frame.longitude_deg).utc
