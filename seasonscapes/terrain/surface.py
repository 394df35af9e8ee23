"""Data types of terrain and their storage: georeferenced raster, triangulated surface, texture over a UV atlas."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from affine import Affine

from seasonscapes.array_files import read_arrays
from seasonscapes.errors import AtlasMismatch, InputError
from seasonscapes.frames import MEAN_RADIUS_M, LocalFrame
from seasonscapes.terrain.interpolation import bilinear
from seasonscapes.terrain.surface_classes import AlbedoDetail, ImageDetail, Snow, Water


@dataclass(frozen=True)
class Raster:
    """Gridded values with a georeference.

    Parameters
    ----------
    values
        ``(H, W, C)`` float32; row 0 is the first row of the file (north, for north-up rasters). NaN for cells without
        data.
    transform
        Affine map from (column, row) to map coordinates; (0, 0) is the **corner** of the first pixel.
    crs
        Coordinate reference system as WKT or ``EPSG:n``.
    """

    values: np.ndarray
    transform: Affine
    crs: str


def monomials(position_m: np.ndarray, domain: tuple[float, float, float], degree: int) -> np.ndarray:
    """Terms of the polynomial of a `SurfaceGrid` at positions ``(N, 3)``: ``(N, T)``, ``east^i north^j``, i + j ≤ degree.

    East and north are projected along the verticals to height zero first (to the Earth's mean radius), then scaled to
    [-1, 1] over the domain.
    """
    shrink = MEAN_RADIUS_M / (MEAN_RADIUS_M + position_m[:, 2])
    east, north = ((position_m[:, k] * shrink - domain[k]) / domain[2] for k in range(2))
    return np.stack([east**i * north**j for i, j in exponents(degree)], axis=1)


def exponents(degree: int) -> list[tuple[int, int]]:
    """Exponents of east and north in the terms of `monomials`."""
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def polynomial_degree(to_node: np.ndarray) -> int:
    """Degree of polynomials ``(2, T)`` of `monomials`."""
    return round((8 * to_node.shape[1] + 1) ** 0.5 - 3) // 2


@dataclass(frozen=True)
class SurfaceGrid:
    """The smooth surface of a terrain at the samples of its raster, from which shading takes its normals.

    Parameters
    ----------
    nodes
        ``(R, S, 3)`` float32: slope towards east, slope towards north, up coordinate [m].
    to_node
        ``(2, T)`` polynomials of position for column and row of the nodes; see `monomials`.
    domain
        East and north of the polynomials' centre, and their radius [m].
    mesh_error_m
        Vertical error bound of the mesh against the nodes [m].
    parts
        Finer surfaces of parts of it, coarse ones first, each of which takes the place of those before it; towards its rim
        they are blended.
    rim_nodes
        Of a part: width of that rim, in its own nodes.
    """

    nodes: np.ndarray
    to_node: np.ndarray
    domain: tuple[float, float, float]
    mesh_error_m: float = 0.0
    parts: tuple[SurfaceGrid, ...] = ()
    rim_nodes: float = 1.0

    @property
    def degree(self) -> int:
        """Degree of the polynomials."""
        return polynomial_degree(self.to_node)

    @property
    def spacing_m(self) -> float:
        """Distance of neighbouring nodes at the centre of the domain [m]."""
        step = self.domain[2] / 100.0
        points = np.array([[0.0, 0.0, 0.0], [step, 0.0, 0.0], [0.0, step, 0.0]])
        points[:, :2] += self.domain[:2]
        node = self.nodes_at(points)
        return float(step / np.sqrt(abs(np.linalg.det(node[1:] - node[0]))))

    def nodes_at(self, position_m: np.ndarray) -> np.ndarray:
        """Column and row ``(N, 2)`` of positions ``(N, 3)`` among the nodes; integers at the nodes."""
        return monomials(position_m, self.domain, self.degree) @ self.to_node.T

    def up_at(self, position_m: np.ndarray) -> np.ndarray:
        """Up coordinates ``(N,)`` float64 at positions ``(N, 3)`` [m]; see `sample`."""
        return self._interpolated(position_m, (2,))[0]

    def spacing_at(self, position_m: np.ndarray) -> np.ndarray:
        """Distance ``(N,)`` of neighbouring nodes at positions ``(N, 3)`` [m]."""
        return self._of_finest(position_m, lambda surface: surface.spacing_m)

    def error_at(self, position_m: np.ndarray) -> np.ndarray:
        """Vertical error bound ``(N,)`` of the mesh at positions ``(N, 3)`` [m]."""
        return self._of_finest(position_m, lambda surface: surface.mesh_error_m)

    def _of_finest(self, position_m: np.ndarray, value: Callable[[SurfaceGrid], float]) -> np.ndarray:
        result = np.full(len(position_m), value(self))
        for part in self.parts:
            result[part.share_at(position_m) > 0.0] = value(part)
        return result

    def share_at(self, position_m: np.ndarray) -> np.ndarray:
        """Share ``(N,)`` of this surface in one that it is a part of: 1 within, 0 at its rim and outside."""
        column, row = self.nodes_at(np.asarray(position_m, np.float64)).T
        rows, columns = self.nodes.shape[:2]
        inside = np.minimum(np.minimum(column, columns - 1 - column), np.minimum(row, rows - 1 - row))
        return np.clip(inside / self.rim_nodes, 0.0, 1.0)

    def _interpolated(self, position_m: np.ndarray, channels: tuple[int, ...]) -> list[np.ndarray]:
        position_m = np.asarray(position_m, np.float64)
        values = list(bilinear(self.nodes, *self.nodes_at(position_m).T)[:, list(channels)].T)
        for part in self.parts:
            share = part.share_at(position_m)
            near = np.flatnonzero(share > 0.0)
            for value, finer in zip(values, part._interpolated(position_m[near], channels), strict=True):
                value[near] += share[near] * (finer - value[near])
        return values

    def sample(self, position_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interpolate the surface bilinearly.

        Parameters
        ----------
        position_m
            ``(N, 3)`` positions, east-north-up [m]; heights matter little.

        Returns
        -------
        up_m
            ``(N,)`` float64 up coordinates; at the rim's beyond it.
        normal
            ``(N, 3)`` float32 unit normals of the interpolated slopes.
        """
        east, north, up = self._interpolated(position_m, (0, 1, 2))
        normal = np.stack([-east, -north, np.ones_like(up)], axis=1)
        return up, (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)


@dataclass(frozen=True)
class Terrain:
    """A triangulated terrain surface with texture coordinates.

    Parameters
    ----------
    vertices
        ``(V, 3)`` float32 east-north-up [m].
    faces
        ``(F, 3)`` uint32, counter-clockwise when viewed from above (from outside).
    uv
        ``(V, 2)`` float32 in [0, 1]; v points upwards: v = 1 is the upper edge of row 0 of a texture.
    frame
        Local frame of the vertices.
    surface
        The smooth surface that the triangles approximate; ``None``: shading interpolates normals of the vertices.
    normals
        ``(V, 3)`` float32 unit normals of the vertices; ``None``: those of the triangles about them.
    water
        Its open water, which mirrors; ``None``: water is Lambertian.
    snow
        How its snow scatters; ``None``: snow is Lambertian.
    forest
        Whether its forests have a hot spot, or are Lambertian.
    detail
        Detail of the albedo below its texels, for one camera; ``None``: the texture alone. `save_terrain` leaves it out.
    images
        Images finer than the texels, for one camera, whose detail lies over the albedo. `save_terrain` leaves them out.
    tilt
        ``(R, S, 3)`` added to its unit normals where it is shaded, see `Texture`. `save_terrain` leaves it out.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    frame: LocalFrame
    surface: SurfaceGrid | None = None
    normals: np.ndarray | None = None
    water: Water | None = None
    snow: Snow | None = None
    forest: bool = False
    detail: AlbedoDetail | None = None
    images: tuple[ImageDetail, ...] = ()
    tilt: np.ndarray | None = None


def mesh_up_m(terrain: Terrain, position_m: np.ndarray) -> float:
    """Find the up coordinate of the uppermost triangle at a horizontal position.

    Parameters
    ----------
    terrain
        The mesh.
    position_m
        ``(2,)`` or ``(3,)`` position, east-north(-up) [m]; the height is not used.

    Returns
    -------
    float
        Up coordinate [m]; NaN where no triangle covers the position.
    """
    point = np.asarray(position_m, np.float64)[:2]
    corners = terrain.vertices[terrain.faces, :2]
    near = (corners.min(axis=1) <= point + 1e-3).all(axis=1) & (corners.max(axis=1) >= point - 1e-3).all(axis=1)
    a, b, c = np.moveaxis(terrain.vertices[terrain.faces[near]].astype(np.float64), 1, 0)
    matrix = np.stack([(b - a)[:, :2], (c - a)[:, :2]], axis=2)
    determinant = np.linalg.det(matrix)
    plain = np.abs(determinant) > 1e-9
    weights = np.linalg.solve(matrix[plain], (point - a[plain, :2])[..., None])[..., 0]
    inside = (weights >= -1e-6).all(axis=1) & (weights.sum(axis=1) <= 1.0 + 1e-6)
    up = a[plain, 2] + weights[:, 0] * (b - a)[plain, 2] + weights[:, 1] * (c - a)[plain, 2]
    return float(up[inside].max()) if inside.any() else float("nan")


@dataclass(frozen=True)
class Texture:
    """An image over the UV atlas of a terrain.

    Parameters
    ----------
    values
        ``(R, S, 3)`` float32 with row 0 at v = 1: albedo in [0, 1] or radiance [cd/m²], depending on the use.
    weight
        ``(R, S)`` float32 weight of the observations, 0 for unobserved texels; ones if left out.
    atlas_id
        Identifier of the UV atlas that the texture belongs to, see `atlas_identity`; ``None`` if unknown.
    tilt
        Of an albedo: ``(R, S, 3)`` float32 added to the terrain's unit normals (east-north-up) where it is shaded; or ``None``.

    Examples
    --------
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> grey = ss.Texture(np.full((*place.texture_shape, 3), 0.2, np.float32), atlas_id=place.atlas_id)
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> view = ss.render(place, camera, "2024-07-20T13:30", sky="hosek", albedo=grey, spp=1)
    """

    values: np.ndarray
    weight: np.ndarray = field(default=None)  # type: ignore[assignment]  # set in __post_init__
    atlas_id: str | None = None
    tilt: np.ndarray | None = None

    def __post_init__(self):
        if self.weight is None:
            object.__setattr__(self, "weight", np.ones(self.values.shape[:2], np.float32))
        if self.values.shape[:2] != self.weight.shape:
            raise ValueError(f"Texture: values {self.values.shape} and weight {self.weight.shape} differ in size")
        if self.tilt is not None and self.tilt.shape != self.values.shape:
            raise ValueError(f"Texture: values {self.values.shape} and tilt {self.tilt.shape} differ in size")

    @property
    def content(self) -> str:
        """Hash of values and tilt."""
        tilt = b"" if self.tilt is None else self.tilt.tobytes()
        return hashlib.sha256(self.values.tobytes() + tilt).hexdigest()


def atlas_identity(terrain: Terrain, width_px: int, height_px: int) -> str:
    """Compute an identifier of a UV atlas as a hash of texture coordinates, faces and texture size.

    Parameters
    ----------
    terrain
        The surface that the atlas belongs to.
    width_px, height_px
        Size of its textures [texels].

    Returns
    -------
    str
        16 hexadecimal digits.
    """
    digest = hashlib.sha256(f"{width_px}x{height_px}".encode())
    digest.update(np.ascontiguousarray(terrain.uv, np.float32).data)
    digest.update(np.ascontiguousarray(terrain.faces, np.uint32).data)
    return digest.hexdigest()[:16]


def require_atlas(texture: Texture, atlas_id: str, shape: tuple[int, int], *, what: str = "texture") -> None:
    """Raise `AtlasMismatch` where a texture belongs to another atlas.

    Parameters
    ----------
    texture
        The texture to check; without ``atlas_id``, only its size is compared.
    atlas_id, shape
        Identifier and size (rows, columns) of the expected atlas.
    what
        Name of the texture in the message, such as its file.

    Raises
    ------
    AtlasMismatch
        Size or identifier differ.
    """
    size = texture.values.shape[:2]
    if size != shape:
        raise AtlasMismatch(
            f"{what}: belongs to another atlas; got {size[1]} × {size[0]} texels; expected {shape[1]} × {shape[0]}; "
            "use the --atlas, --texel-m and mesh options that it was made with"
        )
    if texture.atlas_id is not None and texture.atlas_id != atlas_id:
        raise AtlasMismatch(
            f"{what}: belongs to another atlas of the same size; got {texture.atlas_id}; expected {atlas_id}; "
            "use the --atlas, --texel-m and mesh options that it was made with"
        )


def raster_arrays(raster: Raster) -> dict[str, Any]:
    """A raster as arrays to store."""
    return {"values": raster.values, "transform": np.array(tuple(raster.transform)[:6]), "crs": raster.crs}


def raster_from_arrays(stored: Any) -> Raster:
    """The raster of `raster_arrays`."""
    transform = Affine(*(float(value) for value in stored["transform"]))
    return Raster(stored["values"], transform, str(stored["crs"]))


def surface_arrays(surface: SurfaceGrid, prefix: str = "") -> dict[str, Any]:
    """A surface without its parts as arrays to store."""
    return {
        f"{prefix}nodes": surface.nodes,
        f"{prefix}to_node": surface.to_node,
        f"{prefix}domain": surface.domain,
        f"{prefix}measures": np.array([surface.mesh_error_m, surface.rim_nodes], np.float64),
    }


def surface_from_arrays(stored: Any, prefix: str = "") -> SurfaceGrid:
    """The surface of `surface_arrays`."""
    east, north, radius = (float(value) for value in stored[f"{prefix}domain"])
    error_m, rim_nodes = (float(value) for value in stored[f"{prefix}measures"])
    return SurfaceGrid(
        stored[f"{prefix}nodes"], stored[f"{prefix}to_node"], (east, north, radius), error_m, rim_nodes=rim_nodes
    )


def save_terrain(terrain: Terrain, path: str | os.PathLike[str], *, note: dict[str, Any] | None = None) -> None:
    """Write a terrain and its metadata to one ``.npz`` file.

    Parameters
    ----------
    terrain
        The surface.
    path
        File to write.
    note
        JSON-serialisable metadata.
    """
    frame = np.array([getattr(terrain.frame, name) for name in LocalFrame.__dataclass_fields__], np.float64)
    arrays: dict[str, Any] = {"vertices": terrain.vertices, "faces": terrain.faces, "uv": terrain.uv, "frame": frame}
    if terrain.surface is not None:
        for number, surface in enumerate((terrain.surface, *terrain.surface.parts)):
            arrays |= surface_arrays(surface, f"surface{number}_")
    if terrain.water is not None:
        # Shares in steps of 1/255.
        arrays |= {"water": np.round(terrain.water.mask * 255.0).astype(np.uint8), "water_wind": terrain.water.wind_m_s}
    if terrain.snow is not None:
        arrays["snow_grain_mm"] = np.nan if terrain.snow.grain_mm is None else terrain.snow.grain_mm
    if terrain.forest:
        arrays["forest"] = True
    np.savez(path, note=json.dumps(note or {}), **arrays)


def load_terrain(path: str | os.PathLike[str]) -> tuple[Terrain, dict[str, Any]]:
    """Read a terrain and its metadata from a file of `save_terrain`.

    Parameters
    ----------
    path
        File to read.

    Returns
    -------
    terrain
        The surface.
    note
        Its metadata.
    """
    with np.load(path, allow_pickle=False) as stored:
        frame = LocalFrame(*map(float, stored["frame"]))
        surfaces = []
        while f"surface{len(surfaces)}_nodes" in stored:
            surfaces.append(surface_from_arrays(stored, f"surface{len(surfaces)}_"))
        surface = replace(surfaces[0], parts=tuple(surfaces[1:])) if surfaces else None
        terrain = Terrain(stored["vertices"], stored["faces"], stored["uv"], frame, surface)
        if "water" in stored:
            water = Water(stored["water"].astype(np.float32) / np.float32(255.0), float(stored["water_wind"]))
            terrain = replace(terrain, water=water)
        if "snow_grain_mm" in stored:
            grain = float(stored["snow_grain_mm"])
            terrain = replace(terrain, snow=Snow(None if np.isnan(grain) else grain))
        terrain = replace(terrain, forest="forest" in stored)
        return terrain, json.loads(str(stored["note"]))


def save_texture(texture: Texture, path: str | os.PathLike[str]) -> None:
    """Write a texture to one ``.npz`` file, without loss of precision.

    Parameters
    ----------
    texture
        The texture.
    path
        File to write.
    """
    more: dict[str, Any] = {key: each for key in ("atlas_id", "tilt") if (each := getattr(texture, key)) is not None}
    np.savez(path, values=texture.values, weight=texture.weight, **more)


def load_texture(path: str | os.PathLike[str]) -> Texture:
    """Read a texture from a file of `save_texture`.

    Parameters
    ----------
    path
        File to read.

    Returns
    -------
    Texture
        The texture; ``atlas_id`` is ``None`` if the file has none.

    Raises
    ------
    InputError
        Where the file is missing, damaged, or no texture.
    """
    stored = read_arrays(path, ["values", "weight"], optional=["atlas_id", "tilt"], what="a texture")
    values, weight = stored["values"], stored["weight"]
    if values.dtype.kind != "f" or weight.dtype.kind != "f" or values.shape != (*weight.shape, 3) or weight.ndim != 2:
        got = f"values {values.dtype} {values.shape}, weight {weight.dtype} {weight.shape}"
        raise InputError(
            os.fspath(path), "not a texture", got=got, expected="values (R, S, 3) and weight (R, S), floats"
        )
    if not np.isfinite(weight).all():
        raise InputError(os.fspath(path), "not a texture: its weights are not finite")
    tilt = stored.get("tilt")
    if tilt is not None and (tilt.dtype.kind != "f" or tilt.shape != values.shape or not np.isfinite(tilt).all()):
        raise InputError(os.fspath(path), "not a texture: tilt", got=tilt.shape, expected=f"finite, {values.shape}")
    return Texture(values, weight, str(stored["atlas_id"]) if "atlas_id" in stored else None, tilt)


def sample_texture(values: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Interpolate a texture bilinearly at UV coordinates, clamped at its edges.

    Parameters
    ----------
    values
        Texture ``(R, S, C)`` with row 0 at v = 1.
    uv
        Texture coordinates ``(..., 2)``.

    Returns
    -------
    numpy.ndarray
        ``(..., C)`` float32; NaN where ``uv`` is NaN.
    """
    height, width = values.shape[:2]
    known = np.all(np.isfinite(uv), axis=-1)
    u, v = np.moveaxis(np.where(known[..., None], uv, 0.0), -1, 0)
    column, row = np.clip(u * width - 0.5, 0.0, width - 1.0), np.clip((1.0 - v) * height - 0.5, 0.0, height - 1.0)
    column0, row0 = np.minimum(column.astype(int), max(width - 2, 0)), np.minimum(row.astype(int), max(height - 2, 0))
    column1, row1 = np.minimum(column0 + 1, width - 1), np.minimum(row0 + 1, height - 1)
    fx, fy = (column - column0)[..., None], (row - row0)[..., None]
    top = values[row0, column0] * (1.0 - fx) + values[row0, column1] * fx
    bottom = values[row1, column0] * (1.0 - fx) + values[row1, column1] * fx
    return np.where(known[..., None], top * (1.0 - fy) + bottom * fy, np.nan).astype(np.float32)
