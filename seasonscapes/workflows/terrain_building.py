"""Building a place's terrain: elevation raster, local frame, mesh and UV atlas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame, enu_from_geodetic
from seasonscapes.terrain.crs import geodetic_from_map
from seasonscapes.terrain.mesh import MESHERS, build_mesh
from seasonscapes.terrain.raster import bounds_geographic, centre_frame, fill_nodata, read_elevation
from seasonscapes.terrain.raster_files import open_raster
from seasonscapes.terrain.refine import refine_raster, refinement_factor
from seasonscapes.terrain.surface import Raster, Terrain, load_terrain, save_terrain
from seasonscapes.terrain.surface_grid import surface_grid
from seasonscapes.terrain.synthetic import alpine_massif, load_massif, save_massif
from seasonscapes.terrain.unwrap import ATLASES, Atlas, unwrap

if TYPE_CHECKING:
    from seasonscapes.scene import SceneFile, SyntheticElevation
    from seasonscapes.terrain.raster import FillReport
    from seasonscapes.terrain.synthetic import SyntheticMassif

__all__ = [
    "MeshOptions",
    "build_massif",
    "build_terrain",
    "load_built_terrain",
    "load_massif",
    "local_frame",
    "read_heights",
    "sample_spacing_m",
    "save_built_terrain",
    "save_massif",
]


@dataclass(frozen=True)
class MeshOptions:
    """How to build the terrain; ``None`` lets the data decide.

    Parameters
    ----------
    mesher
        ``"adaptive"`` (error-bounded triangulation), ``"grid"`` (every sample) or ``"poisson"`` (needs an extra).
    max_error_m
        Vertical error bound of the adaptive mesh [m]. Default: a tenth of the sample spacing, at most 5 m.
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


def build_massif(declared: SyntheticElevation) -> SyntheticMassif:
    """Generate the synthetic massif that a scene file declares."""
    return alpine_massif(seed=declared.seed, size_m=declared.size_m, spacing_m=declared.spacing_m)


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
        assert elevation.file is not None, "a scene has either a synthetic elevation or a file"
        bounds = scene.area.bounds_deg if scene.area is not None else None
        raster = read_elevation(elevation.file, bounds_deg=bounds, band=elevation.band, confinement=scene.confinement)
    return fill_nodata(raster, max_share=elevation.max_hole_share, where=where)


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
    if not (west - 1.0 <= origin.longitude_deg <= east + 1.0 and south - 1.0 <= origin.latitude_deg <= north + 1.0):
        raise InputError(
            "origin",
            "lies more than 1° outside the elevation raster",
            got=f"{origin.latitude_deg}, {origin.longitude_deg}",
            expected=f"latitude {south:.3f} … {north:.3f}, longitude {west:.3f} … {east:.3f}",
        )
    return LocalFrame(origin.latitude_deg, origin.longitude_deg, origin.height_m, scene.refraction_k)


def sample_spacing_m(raster: Raster) -> float:
    """Mean distance between neighbouring samples of a raster on the ground [m]."""
    height, width = raster.values.shape[:2]
    column, row = np.array([0.0, 1.0, 0.0]) + width // 2, np.array([0.0, 0.0, 1.0]) + height // 2
    latitude, longitude = geodetic_from_map(raster.crs, *(raster.transform * (column, row)))
    positions = enu_from_geodetic(LocalFrame(float(latitude[0]), float(longitude[0])), latitude, longitude, 0.0)
    return float(np.mean(np.linalg.norm(positions[1:], axis=1)))


def build_terrain(
    elevation: Raster,
    frame: LocalFrame,
    scene: SceneFile,
    options: MeshOptions,
    *,
    progress: Callable[[float], None] | None = None,
) -> tuple[Terrain, Atlas]:
    """Mesh an elevation raster in a local frame and unwrap it; see `terrain.mesh` and `terrain.unwrap`."""
    report = progress or (lambda fraction: None)
    spacing_m = sample_spacing_m(elevation)
    factor = options.refine or refinement_factor(elevation.values[..., 0].size, spacing_m)
    bound = options.max_error_m or min(5.0, spacing_m / factor / 10.0)
    refined = refine_raster(elevation, factor)
    report(0.1)
    terrain = build_mesh(refined, frame, mesher=options.mesher, max_error_m=bound)
    report(0.6)
    if options.mesher != "poisson":
        error = bound if options.mesher == "adaptive" else 0.0
        terrain = replace(terrain, surface=surface_grid(refined, frame, mesh_error_m=error))
    report(0.8)
    texel_m = _texel_m(terrain, elevation, scene, options)
    return unwrap(terrain, kind=options.atlas, texel_m=texel_m, max_side_px=options.max_side_px)


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
    elif wish is None and scene.imagery is not None:
        wish = 0.7 * sample_spacing_m(_image_grid(scene))
    elif wish is None:
        wish = sample_spacing_m(elevation)
    extent_m = float(np.ptp(terrain.vertices[:, :2], axis=0).max())
    return max(wish, extent_m / options.max_side_px * (1.0 + 1e-9))


def _image_grid(scene: SceneFile) -> Raster:
    """The grid of a scene's image without its values."""
    assert scene.imagery is not None
    with open_raster(scene.imagery.file, scene.confinement) as source:
        return Raster(np.empty((source.height, source.width, 0), np.float32), source.transform, source.crs.to_string())
