"""Building a place's terrain: elevation raster, local frame, mesh and UV atlas."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame
from seasonscapes.terrain.crs import wrapped
from seasonscapes.terrain.memory import check_memory
from seasonscapes.terrain.mesh import MESHERS, build_mesh
from seasonscapes.terrain.nested_heights import rim_m
from seasonscapes.terrain.placement import cell_sides_m, check_area
from seasonscapes.terrain.raster import bounds_geographic, centre_frame, fill_nodata, read_elevation
from seasonscapes.terrain.raster_files import OWN_FOLDER
from seasonscapes.terrain.refine import refine_raster, refinement_factor
from seasonscapes.terrain.surface import Raster, SurfaceGrid, Terrain, load_terrain, save_terrain
from seasonscapes.terrain.surface_classes import Snow
from seasonscapes.terrain.surface_grid import surface_grid
from seasonscapes.terrain.tile_files import read_elevation_tiles, tile_spacing_m
from seasonscapes.terrain.unwrap import ATLASES, Atlas, unwrap
from seasonscapes.terrain.view_refinement import moved_to, refined_in_parts
from seasonscapes.terrain.water import levelled
from seasonscapes.workflows.scene_water import with_water

if TYPE_CHECKING:
    from seasonscapes.scene import SceneFile
    from seasonscapes.terrain.raster import FillReport
    from seasonscapes.terrain.synthetic_massif import SyntheticMassif

__all__ = [
    "MeshOptions",
    "build_terrain",
    "finest_texel_m",
    "load_built_terrain",
    "local_frame",
    "read_heights",
    "read_scene_elevation",
    "sample_spacing_m",
    "save_built_terrain",
    "tell_texel_wish",
]

log = logging.getLogger(__name__)


# Error of the mesh in finer parts, in their spacings: near a camera it is refined further.
_PART_ERROR = 0.25
# Texels a little finer than the image's pixels lose none of it by resampling.
_TEXELS_PER_PIXEL = 0.7


@dataclass(frozen=True)
class MeshOptions:
    """How to build the terrain; ``None`` lets the data decide.

    Parameters
    ----------
    mesher
        ``"adaptive"`` (error-bounded triangulation), ``"grid"`` (every sample) or ``"poisson"`` (the same of the
        screened Poisson surface, as in the paper).
    max_error_m
        Vertical error bound of the triangulation [m]. Default: a tenth of the sample spacing, at most 5 m.
    refine
        Interpolate the heights this many times finer before meshing; see `terrain.refine`. Default: as far as it pays.
    atlas
        ``"planar"`` (top-down), ``"relief"`` (more texels on steep ground) or ``"xatlas"`` (charts).
    texel_m
        Side of a texel [m]. Default: as fine as the imagery, at most ``max_side_px`` texels on a side.
    max_side_px
        Largest side of a texture [texels].

    Examples
    --------
    >>> import seasonscapes as ss
    >>> coarse = ss.load_place("alpine_small", options=ss.MeshOptions(max_error_m=20.0))
    >>> fine = ss.load_place("alpine_small", options=ss.MeshOptions(max_error_m=5.0))
    >>> len(coarse.terrain.faces) < len(fine.terrain.faces)
    True
    """

    mesher: str = "adaptive"
    max_error_m: float | None = None
    refine: int | None = None
    atlas: str = "planar"
    texel_m: float | None = None
    max_side_px: int = 4096

    def __post_init__(self) -> None:
        if self.mesher not in MESHERS:
            raise InputError("--mesher", "unknown mesher", got=self.mesher, expected=", ".join(MESHERS))
        if self.atlas not in ATLASES:
            raise InputError("--atlas", "unknown atlas", got=self.atlas, expected=", ".join(ATLASES))
        for flag, size_m in (("--max-error-m", self.max_error_m), ("--texel-m", self.texel_m)):
            if size_m is not None and not 0.001 <= size_m <= 100_000.0:
                raise InputError(flag, "out of range", got=size_m, expected="0.001 to 100000 (metres)")
        if self.refine is not None and not 1 <= self.refine <= 64:
            raise InputError("--refine", "out of range", got=self.refine, expected="1 to 64")
        if not 1 <= self.max_side_px <= 32_768:
            raise InputError("max_side_px", "out of range", got=self.max_side_px, expected="1 to 32768")


def read_heights(scene: SceneFile, massif: SyntheticMassif | None, *, where: str) -> tuple[Raster, FillReport]:
    """Read a scene's elevation raster, or take the synthetic massif's, and fill its holes.

    Parameters
    ----------
    scene
        Its table ``elevation`` names the file, band and largest share of holes.
    massif
        The synthetic massif, where the scene declares one.
    where
        What error messages call the raster.

    Returns
    -------
    Raster, FillReport
        Heights ``(H, W, 1)`` float32 [m] without NaN, and what was filled.
    """
    elevation = scene.elevation
    assert elevation is not None, "load_place refuses scenes without elevation"
    if massif is not None:
        raster = massif.elevation
    else:
        bounds = scene.area.bounds_deg if scene.area is not None else None
        raster = read_scene_elevation(scene, bounds_deg=bounds)
        check_area(bounds_geographic(raster), where)
    return fill_nodata(raster, max_share=elevation.max_hole_share, where=where)


def read_scene_elevation(
    scene: SceneFile, file: str | Path | None = None, *, bounds_deg: tuple[float, float, float, float] | None = None
) -> Raster:
    """Read a scene's own raster of heights as its file declares it, or another ``file`` of the user's choice.

    A raster that the user names may lie anywhere; what it names in turn may not.
    """
    elevation = scene.elevation
    if file is not None:
        return read_elevation(file, bounds_deg=bounds_deg, confinement=OWN_FOLDER)
    assert elevation is not None, "callers refuse scenes without elevation"
    assert elevation.paths, "a scene has either a synthetic elevation or files"
    return read_elevation_tiles(
        elevation.paths,
        bounds_deg=bounds_deg,
        band=elevation.band,
        unit=elevation.unit,
        nodata=elevation.nodata,
        confinement=scene.confinement,
    )


def local_frame(scene: SceneFile, elevation: Raster) -> LocalFrame:
    """Return the east-north-up frame of a scene: its stated origin, or the centre of the raster.

    Raises
    ------
    InputError
        Where the stated origin lies more than 1° outside the raster.
    """
    if scene.origin is None:
        return centre_frame(elevation, refraction_k=scene.refraction_k)
    origin = scene.origin
    west, south, east, north = bounds_geographic(elevation)
    longitude = float(wrapped(origin.longitude_deg, 0.5 * (west + east), 360.0))
    if not (west - 1.0 <= longitude <= east + 1.0 and south - 1.0 <= origin.latitude_deg <= north + 1.0):
        raise InputError(
            "origin",
            "lies more than 1° outside the elevation raster",
            got=f"{origin.latitude_deg}, {origin.longitude_deg}",
            expected=f"latitude {south:.3f} … {north:.3f}, longitude {west:.3f} … {east:.3f}",
        )
    return LocalFrame(origin.latitude_deg, origin.longitude_deg, origin.height_m, scene.refraction_k)


def sample_spacing_m(raster: Raster) -> float:
    """Mean distance between neighbouring samples of a raster on the ground [m]."""
    return float(np.mean(cell_sides_m(raster)))


def samples_to_mesh(elevation: Raster, options: MeshOptions, water: Raster | None = None) -> Raster:
    """The samples that are meshed: a place's heights, interpolated where that pays; lakes stay level."""
    if options.refine is not None:
        height, width = elevation.values.shape[:2]
        check_memory((height * options.refine, width * options.refine), "--refine")
    factor = options.refine or refinement_factor(elevation.values[..., 0].size, sample_spacing_m(elevation))
    refined = refine_raster(elevation, factor)
    # Interpolated heights rise towards the banks before the shore.
    return levelled(refined, water) if water is not None and factor > 1 else refined


def build_terrain(
    elevation: Raster,
    frame: LocalFrame,
    scene: SceneFile,
    options: MeshOptions,
    *,
    finer: Sequence[Raster] = (),
    water: Raster | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[Terrain, Atlas]:
    """Mesh an elevation raster in a local frame and unwrap it; see `terrain.mesh` and `terrain.unwrap`.

    Where there are ``finer`` heights of parts (`workflows.nested_heights`), mesh and surface follow them.
    Where there is ``water``, its share ``(H, W, 1)`` at the raster's cells, lakes are level, and the terrain has a mask.
    """
    report = progress or (lambda fraction: None)
    refined = samples_to_mesh(elevation, options, water)
    factor = (refined.values.shape[1] - 1) // (elevation.values.shape[1] - 1)
    bound = options.max_error_m or min(5.0, sample_spacing_m(elevation) / factor / 10.0)
    report(0.1)
    mesher = options.mesher
    if mesher == "poisson":
        from seasonscapes.terrain.poisson import poisson_raster

        # Mesh and shading share one surface.
        refined, mesher = poisson_raster(refined), "adaptive"
    terrain = build_mesh(refined, frame, mesher=mesher, max_error_m=bound)
    report(0.6)
    error = bound if mesher == "adaptive" else 0.0
    terrain = replace(terrain, surface=surface_grid(refined, frame, mesh_error_m=error))
    if finer:
        assert terrain.surface is not None
        parts = tuple(
            _finer_part(part, (*reversed(finer[:number]), elevation), frame, bound) for number, part in enumerate(finer)
        )
        terrain = moved_to(terrain, replace(terrain.surface, parts=parts))
    report(0.8)
    texel_m = _texel_m(terrain, elevation, scene, options)
    terrain, atlas = unwrap(terrain, kind=options.atlas, texel_m=texel_m, max_side_px=options.max_side_px)
    # Refined last: texture coordinates are interpolated, so that slivers among the new faces cannot fold over.
    terrain = refined_in_parts(terrain)
    if water is not None and scene.water is not None:
        terrain = with_water(terrain, atlas, water, scene.water.wind_m_s)
    if scene.snow is not None and scene.snow.scattering:
        terrain = replace(terrain, snow=Snow(scene.snow.grain_mm))
    if scene.forest is not None and scene.forest.hot_spot:
        terrain = replace(terrain, forest=True)
    return terrain, atlas


def _finer_part(part: Raster, under: Sequence[Raster], frame: LocalFrame, bound_m: float) -> SurfaceGrid:
    """The surface of finer heights above the rasters ``under`` them, which the mesh follows as closely as their spacing deserves."""
    spacing_m = sample_spacing_m(part)
    error_m = min(bound_m, spacing_m * _PART_ERROR)
    return surface_grid(part, frame, mesh_error_m=error_m, rim_nodes=rim_m(part, under) / spacing_m)


def save_built_terrain(built: tuple[Terrain, Atlas], path: Path) -> None:
    """Write a terrain and the report on its atlas to one file."""
    terrain, atlas = built
    save_terrain(terrain, path, note=asdict(atlas))


def load_built_terrain(path: Path) -> tuple[Terrain, Atlas]:
    """Read what `save_built_terrain` wrote."""
    terrain, note = load_terrain(path)
    return terrain, Atlas(**note)


def _texel_m(terrain: Terrain, elevation: Raster, scene: SceneFile, options: MeshOptions) -> float:
    """Texel side [m]: the requested one, or as fine as the place's colours are, within the limit of the side."""
    wish = options.texel_m
    if wish is None and scene.elevation is not None and scene.elevation.synthetic is not None:
        wish = scene.elevation.synthetic.detail_m
    elif wish is None and scene.images:
        wish = _TEXELS_PER_PIXEL * _image_pixel_m(scene)
    elif wish is None:
        wish = sample_spacing_m(elevation)
    return max(wish, finest_texel_m(terrain, options))


def _image_pixel_m(scene: SceneFile) -> float:
    """Side of a pixel of the finest image [m]."""
    return min(tile_spacing_m(image.paths, scene.confinement) for image in scene.images)


def finest_texel_m(terrain: Terrain, options: MeshOptions) -> float:
    """Smallest side of a texel that the largest side of a texture allows [m]."""
    return float(np.ptp(terrain.vertices[:, :2].astype(np.float64), axis=0).max()) / options.max_side_px * (1.0 + 1e-9)


def tell_texel_wish(terrain: Terrain, scene: SceneFile, options: MeshOptions) -> None:
    """Warn where the texels that were asked for, or the pixels of the scene's image, are finer than a texture can be."""
    finest = finest_texel_m(terrain, options)
    limit = f"the {options.max_side_px} texels that a side may have here allow {finest:.3g} m"
    if options.texel_m is not None:
        if options.texel_m < finest:
            log.warning(
                "--texel-m: texels of %g m were asked for, but %s; choose a smaller [area]", options.texel_m, limit
            )
    elif scene.images and (pixel := _image_pixel_m(scene)) < 0.9 * finest:
        log.warning(
            "%s: its pixels of %.3g m are finer than texels can be: %s; choose a smaller [area]",
            scene.images[0].label,
            pixel,
            limit,
        )
