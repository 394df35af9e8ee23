"""Satellite and aerial imagery: reading as linear colour, anisotropically filtered resampling into a UV atlas."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np

from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame, geodetic_from_enu
from seasonscapes.terrain.atlas import Atlas
from seasonscapes.terrain.crs import raster_pixels
from seasonscapes.terrain.image_bands import Decoder, image_facts
from seasonscapes.terrain.raster import read_raster
from seasonscapes.terrain.raster_files import OWN_FOLDER, Confinement
from seasonscapes.terrain.surface import Raster, Terrain, Texture, atlas_identity
from seasonscapes.terrain.texels import covering_faces, face_gradients, texel_coordinates
from seasonscapes.terrain.tile_files import path_list, read_tiles

ENCODINGS = ("srgb", "linear")
# Largest number of samples along a footprint; more elongated footprints use a coarser mip level.
_MAX_ANISOTROPY = 8
# Numbers of an image that are filtered together, coverage among them: what is made for them stays in a processor's cache.
_CHUNK = 1 << 17
# Exponents of east, north and up in the polynomial from the local frame to image pixels.
_DEGREE = 6
_EXPONENTS = [(i, j, k) for k, top in ((0, _DEGREE), (1, 3)) for i in range(top + 1) for j in range(top + 1 - i)]
# Largest accepted error of the polynomial [image pixels], about a tenth of a visible shift.
_MAX_FIT_ERROR_PX = 0.01


def read_imagery(
    path: str | os.PathLike[str] | Sequence[str],
    *,
    bounds_deg: tuple[float, float, float, float] | None = None,
    bands: tuple[int, ...] | None = None,
    finest_m: float | None = None,
    encoding: str = "srgb",
    full_scale: float | None = None,
    confinement: Confinement = OWN_FOLDER,
    window: bool = False,
) -> Raster:
    """Read a georeferenced colour image as scene-linear Rec.709.

    Parameters
    ----------
    path, bounds_deg, finest_m, confinement
        As in `read_raster`, or the tiles of one image (`tile_files.read_tiles`); for baking, half the texel size is
        sufficient for ``finest_m``.
    bands
        Red, green and blue band numbers from 1; ``None`` for the bands that the file marks as such, or its three colour
        bands, or its only band as grey (by its colour table where it has one).
    encoding
        ``srgb`` for display-referred images, ``linear`` for reflectance.
    full_scale
        The value that corresponds to 1, after the file's own scale and offset; see `image_bands.image_facts`.
    window
        It is a window of an image that was read before as a whole: its numbers are not judged.

    Returns
    -------
    Raster
        ``values`` ``(H, W, 3)`` float32, NaN where the image has no data or alpha is 0.

    Raises
    ------
    InputError
        As `read_raster`; neither one nor three colour bands; numbers that cannot be what was stated: brighter than
        ``full_scale``, negative, or black everywhere.
    ValueError
        Unknown ``encoding``.
    """
    if encoding not in ENCODINGS:
        raise ValueError(f"encoding: got {encoding!r}, expected one of {', '.join(ENCODINGS)}")
    paths = path_list(path)
    # Tiles are parts of one image, which is impossible or not as a whole: a tile may be all dark.
    decoders: dict[float, Decoder] = {}

    def read(tile: str, bounds: tuple[float, float, float, float] | None, finest: float | None) -> Raster:
        facts = image_facts(tile, bands=bands, full_scale=full_scale, confinement=confinement)
        decode = decoders.setdefault(facts.full_scale, Decoder(tile, encoding, facts.full_scale))
        raster = read_raster(
            tile, bounds_deg=bounds, bands=facts.bands, finest_m=finest, decode=decode, confinement=confinement
        )
        # A pixel with one missing channel counts as missing.
        values = np.where(np.isfinite(raster.values).all(axis=2, keepdims=True), raster.values, np.float32(np.nan))
        return replace(raster, values=np.repeat(values, 3 // raster.values.shape[2], axis=2))

    image = read_tiles(paths, read, bounds_deg=bounds_deg, finest_m=finest_m, confinement=confinement)
    for decode in () if window else decoders.values():
        decode.check()
    # Cubic interpolation between tiles of different grids overshoots at sharp borders.
    return image if len(paths) == 1 else replace(image, values=np.maximum(image.values, 0.0))


def bake_imagery(terrain: Terrain, atlas: Atlas, image: Raster, *, gutter_px: int = 4) -> Texture:
    """Resample an image in any CRS into the terrain's atlas with anisotropic filtering.

    Each texel is the mean of the image over the texel's footprint: the mip level follows from the footprint's minor
    axis, and samples are averaged along its major axis (McCormack et al. 1999, "Feline"), which avoids aliasing under
    minification and on steep faces.

    Parameters
    ----------
    terrain
        Surface with the atlas's UV coordinates.
    atlas
        Size of the texture.
    image
        ``values`` ``(H, W, C)``, scene-linear; NaN in one of the channels has zero weight.
    gutter_px
        Width of the dilated border around each chart, for bilinear look-ups at chart borders [texels].

    Returns
    -------
    Texture
        ``values`` of as many channels as the image. ``weight`` is the fraction of the footprint that the image covers; 0 outside
        the image and outside the charts. ``atlas_id`` is that of the terrain's atlas.

    Raises
    ------
    InputError
        The image covers none of the terrain.
    """
    xy = texel_coordinates(terrain.uv, atlas.width_px, atlas.height_px)
    face_id = covering_faces(xy, terrain.faces, atlas.width_px, atlas.height_px)
    channels = image.values.shape[2]
    values = np.zeros((atlas.height_px, atlas.width_px, channels), np.float32)
    weight = np.zeros((atlas.height_px, atlas.width_px), np.float32)
    pixels_of = pixel_map(terrain, image)
    vertex_px = pixels_of(terrain.vertices)
    gradients = face_gradients(vertex_px, terrain.faces, xy)
    footprint = _footprints(*gradients[1:])
    linear = _linear_on_faces(terrain, vertex_px, pixels_of)
    if not linear:
        gradients = face_gradients(terrain.vertices, terrain.faces, xy)
    side = _footprint_side(footprint)
    pyramid = _pyramid(image.values, 1 + int(np.ceil(np.log2(side).max())))
    # How to filter follows from the face, of which there are far fewer than texels.
    filters = _FaceFilters.of(footprint, side, len(pyramid))
    # Columns that lie together in memory: rows of two or three numbers cost several times as much.
    columns = [np.ascontiguousarray(column) for column in np.concatenate(gradients, axis=1).T]
    texel = np.flatnonzero(face_id >= 0)
    step = _CHUNK // (channels + 1)
    for start in range(0, len(texel), step):
        part = texel[start : start + step]
        face, row = face_id.ravel()[part].astype(np.intp), part // atlas.width_px
        across, down = part - row * atlas.width_px + 0.5, row + 0.5
        place = [_on_faces(columns[axis :: len(columns) // 3], face, across, down) for axis in range(len(columns) // 3)]
        where = place if linear else list(pixels_of(np.stack(place, axis=-1)).T)
        values.reshape(-1, channels)[part], weight.ravel()[part] = _filtered(pyramid, where, face, filters)
    if not weight.any():
        raise InputError("imagery", "the image covers none of the terrain", cure="check the CRS of both files")
    atlas_id = atlas_identity(terrain, atlas.width_px, atlas.height_px)
    covered = face_id >= 0
    # In place: copies of the arrays cost more than what is done to the few texels at their rims.
    _dilate(values, weight, covered, gutter_px)
    _fill_gutters(values, weight, covered, gutter_px)
    return Texture(values, weight, atlas_id)


def image_pixels(frame: LocalFrame, image: Raster, positions: np.ndarray) -> np.ndarray:
    """Project points of the local frame to pixel coordinates of a raster, through the exact CRS transformation.

    Parameters
    ----------
    frame
        Local frame of the positions.
    image
        Raster that supplies transform and CRS.
    positions
        ``(N, 3)`` east-north-up [m].

    Returns
    -------
    numpy.ndarray
        Column and row ``(N, 2)``; the first pixel's centre is (0.5, 0.5).
    """
    latitude, longitude, _ = geodetic_from_enu(frame, positions)
    return raster_pixels(image, latitude, longitude)


def pixel_map(terrain: Terrain, image: Raster) -> Callable[[np.ndarray], np.ndarray]:
    """Build a fast version of `image_pixels`: a polynomial in east and north that is linear in up.

    The polynomial is fitted at Chebyshev nodes of the terrain's bounding box and accepted if its error at a sample of
    the vertices is at most `_MAX_FIT_ERROR_PX`; otherwise the exact transformation is returned.

    Parameters
    ----------
    terrain
        Supplies local frame and bounding box.
    image
        Raster that supplies transform and CRS.

    Returns
    -------
    Callable
        Function from positions ``(N, 3)`` [m] to column and row ``(N, 2)``.
    """
    low, high = terrain.vertices.min(0).astype(np.float64), terrain.vertices.max(0).astype(np.float64)
    middle, half = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1.0)
    nodes = np.cos((np.arange(16) + 0.5) * np.pi / 16.0)
    e, n, u = (axis.ravel() for axis in np.meshgrid(nodes, nodes, (-1.0, 0.0, 1.0)))
    target = image_pixels(terrain.frame, image, middle + half * np.stack([e, n, u], axis=-1))
    if not np.isfinite(target).all():
        return lambda positions: image_pixels(terrain.frame, image, positions)
    basis = np.stack([e**i * n**j * u**k for i, j, k in _EXPONENTS], axis=-1)
    coefficients = np.linalg.lstsq(basis, target, rcond=None)[0]

    def fitted(positions: np.ndarray) -> np.ndarray:
        e, n, u = ((positions - middle) / half).T
        return np.stack([_polynomial(coefficients[:, axis], e, n, u) for axis in (0, 1)], axis=-1)

    check = terrain.vertices[:: max(1, len(terrain.vertices) // 2000)]
    if np.abs(fitted(check) - image_pixels(terrain.frame, image, check)).max() > _MAX_FIT_ERROR_PX:
        return lambda positions: image_pixels(terrain.frame, image, positions)
    return fitted


def _polynomial(coefficients: np.ndarray, e: np.ndarray, n: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Σ c e^i n^j u^k over `_EXPONENTS` by Horner's rule, ``(N,)``."""
    table = dict(zip(_EXPONENTS, coefficients, strict=True))
    total = np.zeros_like(e)
    for i in range(_DEGREE, -1, -1):
        inner = np.zeros_like(e)
        for j in range(_DEGREE - i, -1, -1):
            inner *= n
            inner += table[i, j, 0] + (table[i, j, 1] * u if (i, j, 1) in table else 0.0)
        total *= e
        total += inner
    return total


def _linear_on_faces(terrain: Terrain, vertex_px: np.ndarray, pixels_of: Callable[[np.ndarray], np.ndarray]) -> bool:
    """Whether image pixels are linear over the faces: they are, unless faces are many kilometres wide."""
    width = np.zeros(len(terrain.faces), np.float32)
    for axis in (0, 1):
        a, b, c = (np.take(terrain.vertices[:, axis], terrain.faces[:, corner]) for corner in range(3))
        np.maximum(width, np.maximum(np.maximum(a, b), c) - np.minimum(np.minimum(a, b), c), out=width)
    widest = np.argpartition(width, -min(1000, len(width)))[-1000:]
    exact = pixels_of(terrain.vertices[terrain.faces[widest]].mean(axis=1, dtype=np.float64))
    error_px = np.abs(exact - vertex_px[terrain.faces[widest]].mean(axis=1))
    return bool(error_px.max(initial=0.0) <= _MAX_FIT_ERROR_PX)


def _footprints(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Footprint ellipses of texels in the image, ``(F, 4)`` float32: major axis (x, y), its length, minor.

    ``x`` and ``y`` ``(F, 2)`` are the changes of the pixel by column and row. The lengths are the singular values of the
    map from texels to pixels.
    """
    a, b, c = (np.sum(x * x, 1), np.sum(x * y, 1), np.sum(y * y, 1))
    largest = (a + c + np.sqrt((a - c) ** 2 + 4.0 * b * b)) / 2.0
    # Eigenvector of the 2 × 2 Gram matrix, from a row that does not vanish, mapped to the image.
    vector = np.where((a >= c)[:, None], np.stack([largest - c, b], 1), np.stack([b, largest - a], 1))
    vector = vector / np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-300)
    footprint = np.empty((len(x), 4), np.float32)
    footprint[:, :2] = x * vector[:, :1] + y * vector[:, 1:]
    footprint[:, 2] = np.sqrt(largest)
    footprint[:, 3] = np.sqrt(np.maximum(a + c - largest, 0.0))
    return footprint


# Zeros around the levels of a pyramid, so that interpolation outside the image needs no test [pixels].
_RIM_PX = 3


def _footprint_side(footprint: np.ndarray) -> np.ndarray:
    """Side ``(N,)`` of the samples along footprints ``(N, 4)`` [image pixels], at least 1."""
    return np.maximum(np.maximum(footprint[:, 3], footprint[:, 2] / _MAX_ANISOTROPY), 1.0)


def _pyramid(values: np.ndarray, most: int) -> list[np.ndarray]:
    """At most ``most`` mip levels ``(H, W, C + 1)`` of premultiplied colour and coverage, each within a rim of zeros.

    A level is the 2 × 2 box mean of the previous one.
    """
    height, width, channels = values.shape
    finite = np.isfinite(values)
    known = np.logical_and.reduce([finite[..., channel] for channel in range(channels)])
    finest = np.zeros((height + 2 * _RIM_PX, width + 2 * _RIM_PX, channels + 1), np.float32)
    inside = np.s_[_RIM_PX : _RIM_PX + height, _RIM_PX : _RIM_PX + width]
    finest[inside][..., :-1] = values if known.all() else np.where(known[..., None], values, 0.0)
    finest[inside][..., -1] = known
    level: np.ndarray = finest[inside]
    levels: list[np.ndarray] = [finest]
    while max(level.shape[:2]) > 1 and len(levels) < most:
        level = np.pad(level, ((0, level.shape[0] % 2), (0, level.shape[1] % 2), (0, 0)))
        rows = level[0::2] + level[1::2]
        level = (rows[:, 0::2] + rows[:, 1::2]) * np.float32(0.25)
        levels.append(np.pad(level, ((_RIM_PX, _RIM_PX), (_RIM_PX, _RIM_PX), (0, 0))))
    return levels


@dataclass(frozen=True)
class _FaceFilters:
    """How texels of each of F faces are filtered.

    ``major`` are columns and rows ``(F,)`` of the footprint's major axis [image pixels], ``taps`` ``(F,)`` the samples along it
    and ``level`` ``(F,)`` their level of the pyramid. ``kind`` ``(F,)`` is one number for ``taps`` and the whole part of ``level``.
    """

    major: tuple[np.ndarray, np.ndarray]
    taps: np.ndarray
    level: np.ndarray
    kind: np.ndarray

    @classmethod
    def of(cls, footprint: np.ndarray, side: np.ndarray, levels: int) -> _FaceFilters:
        """Filters of footprints ``(F, 4)`` whose samples have sides ``(F,)`` [image pixels], with a pyramid of ``levels``."""
        taps = np.ceil(np.maximum(footprint[:, 2], 1.0) / side - 1e-3).astype(np.intp)
        level = np.clip(np.log2(side), 0.0, levels - 1.0)
        major = (np.ascontiguousarray(footprint[:, 0]), np.ascontiguousarray(footprint[:, 1]))
        return cls(major, taps, level, taps * levels + level.astype(np.intp))


def _on_faces(columns: Sequence[np.ndarray], face: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """A quantity ``(N,)`` at texels of N faces, from its start and gradients ``(F,)`` on the faces; see `face_gradients`."""
    start, by_column, by_row = (column[face] for column in columns)
    by_column *= across
    start += by_column
    by_row *= down
    start += by_row
    return start


def _filtered(
    pyramid: list[np.ndarray], pixel: list[np.ndarray], face: np.ndarray, filters: _FaceFilters
) -> tuple[np.ndarray, np.ndarray]:
    """Mean colour ``(N, C)`` and coverage ``(N,)`` over the footprints of N texels.

    ``pixel`` are their columns and rows in the image, ``(N,)`` each, ``face`` ``(N,)`` their faces.
    """
    kind_of = filters.kind[face]
    kinds = np.flatnonzero(np.bincount(kind_of))
    if len(kinds) == 1:
        result = _sampled(pyramid, pixel, face, filters)
    else:
        result = np.empty((len(face), pyramid[0].shape[2]), np.float32)
        for kind in kinds:
            chosen = np.flatnonzero(kind_of == kind)
            result[chosen] = _sampled(pyramid, [axis[chosen] for axis in pixel], face[chosen], filters)
    coverage = result[:, -1]
    if (coverage == 1.0).all():
        return result[:, :-1], coverage
    rgb = np.where(coverage[:, None] > 1e-6, result[:, :-1] / np.maximum(coverage, 1e-6)[:, None], 0.0)
    return rgb.astype(np.float32), np.where(coverage > 1e-6, np.minimum(coverage, 1.0), 0.0)


def _sampled(
    pyramid: list[np.ndarray], pixel: Sequence[np.ndarray], face: np.ndarray, filters: _FaceFilters
) -> np.ndarray:
    """Mean of premultiplied colour and coverage ``(N, C + 1)`` over the footprints of texels, all of one `kind`."""
    count, lower = filters.taps[face[0]], int(filters.level[face[0]])
    blend = (filters.level[face] - lower).astype(np.float32)[:, None]
    total: np.ndarray | None = None
    for tap in range(count):
        at = pixel
        if count > 1:
            share = (tap + 0.5) / count - 0.5
            at = [axis + share * major[face] for axis, major in zip(pixel, filters.major, strict=True)]
        sample = _bilinear(pyramid[lower], *(axis / 2.0**lower for axis in at) if lower else at)
        if blend.any():
            coarser = _bilinear(pyramid[lower + 1], *(axis / 2.0 ** (lower + 1) for axis in at))
            sample = sample * (1.0 - blend) + coarser * blend
        total = sample if total is None else total + sample
    assert total is not None
    return total / np.float32(count) if count > 1 else total


def _bilinear(level: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Bilinear interpolation ``(N, C)`` at pixels of a level within its rim, with zeros outside the image."""
    height, width = level.shape[:2]
    # Columns and rows of the level with its rim; what lies outside, or nowhere (NaN), reads two zeros.
    x, y = (
        np.fmin(np.fmax(place + (_RIM_PX - 0.5), 0.0), side - 2.0) for place, side in ((column, width), (row, height))
    )
    first_x, first_y = x.astype(np.intp), y.astype(np.intp)
    x -= first_x
    y -= first_y
    fx, fy = x.astype(np.float32)[:, None], y.astype(np.float32)[:, None]
    flat, index = level.reshape(-1, level.shape[2]), first_y * width + first_x
    rows = []
    for corner in (index, index + width):
        left, right = np.take(flat, corner, axis=0), np.take(flat, corner + 1, axis=0)
        right -= left
        right *= fx
        right += left
        rows.append(right)
    rows[1] -= rows[0]
    rows[1] *= fy
    rows[1] += rows[0]
    return rows[1]


def dilate(texture: Texture, covered: np.ndarray, gutter_px: int) -> Texture:
    """Extend a texture beyond its covered texels by rings of weighted neighbour means.

    Parameters
    ----------
    texture
        The texture to extend.
    covered
        ``(H, W)`` bool, True where the texture is defined.
    gutter_px
        Number of rings [texels].

    Returns
    -------
    Texture
        The extended texture of the same atlas.
    """
    values, weight = texture.values.copy(), texture.weight.copy()
    _dilate(values, weight, covered, gutter_px)
    return replace(texture, values=values, weight=weight)


def _dilate(values: np.ndarray, weight: np.ndarray, covered: np.ndarray, gutter_px: int) -> None:
    """`dilate` of values ``(H, W, C)`` and weights ``(H, W)`` in place."""
    known = covered.copy()
    rim_row, rim_column = np.nonzero(_widened(known, 1) & ~known)
    for _ in range(gutter_px):
        if not len(rim_row):
            break
        total, total_weight, count = (
            np.zeros((len(rim_row), values.shape[2])),
            np.zeros(len(rim_row)),
            np.zeros(len(rim_row)),
        )
        for d_row, d_column in product((-1, 0, 1), repeat=2):
            r, c = rim_row + d_row, rim_column + d_column
            inside = (r >= 0) & (r < known.shape[0]) & (c >= 0) & (c < known.shape[1])
            r, c = np.clip(r, 0, known.shape[0] - 1), np.clip(c, 0, known.shape[1] - 1)
            use = inside & known[r, c]
            total += np.where(use[:, None], values[r, c] * weight[r, c, None], 0.0)
            total_weight += np.where(use, weight[r, c], 0.0)
            count += use
        values[rim_row, rim_column] = total / np.maximum(total_weight, 1e-12)[:, None]
        weight[rim_row, rim_column] = total_weight / count
        known[rim_row, rim_column] = True
        # The next ring lies beside this one.
        rim_row, rim_column = _unknown_beside(known, rim_row, rim_column)


def _unknown_beside(known: np.ndarray, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns, in order, of cells outside a mask ``(H, W)`` in the 8-neighbourhoods of given cells."""
    height, width = known.shape
    around = [(row + down, column + across) for down, across in product((-1, 0, 1), repeat=2)]
    r, c = (np.concatenate(each) for each in zip(*around, strict=True))
    inside = (r >= 0) & (r < height) & (c >= 0) & (c < width)
    cell = np.unique(r[inside] * width + c[inside])
    return np.divmod(cell[~known.ravel()[cell]], width)


def _fill_gutters(values: np.ndarray, weight: np.ndarray, covered: np.ndarray, gutter_px: int) -> None:
    """Give texels farther from every chart than its gutter the colour and weight of the nearest that has one, in place.

    Nothing on the surface reads them at full resolution; coarser copies of the texture, made by other programs, do.
    ``covered`` ``(H, W)`` is True where a chart lies, ``gutter_px`` the number of rings that `_dilate` has added [texels].
    """
    known = _widened(covered, gutter_px) if gutter_px else covered
    if known.all() or not known.any():
        return
    empty = ~known
    # Distances are those of steps on the grid of texels, a few percent off.
    _, labelled = cv2.distanceTransformWithLabels(
        empty.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = labelled.astype(np.int32, copy=False)
    # The nearest known texel lies beside an unknown one.
    rim = np.flatnonzero(_widened(empty, 1) & known)
    source = np.empty(int(label.max()) + 1, np.intp)
    source[label.ravel()[rim]] = rim
    nearest = source[label[empty]]
    values[empty], weight[empty] = values.reshape(-1, values.shape[2])[nearest], weight.ravel()[nearest]


def _widened(mask: np.ndarray, rings: int) -> np.ndarray:
    """A mask with rings of its 8-neighbourhood added."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=rings).astype(bool)
