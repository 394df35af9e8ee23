"""Atlases: no two places share a texel, and a texel is as large on the ground as its report says."""

from dataclasses import replace

import numpy as np
import pytest
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from terrain_cases import hill_lv95, overlapping_pairs

from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame
from seasonscapes.terrain import charts, relief
from seasonscapes.terrain.atlas import measure_atlas, signed_uv_areas
from seasonscapes.terrain.imagery import bake_imagery
from seasonscapes.terrain.mesh import build_mesh
from seasonscapes.terrain.surface import Raster, Terrain
from seasonscapes.terrain.texels import coverage_count, covering_faces, texel_coordinates, texel_positions
from seasonscapes.terrain.unwrap import ATLASES, unwrap

FRAME = LocalFrame(46.55, 7.98)


def cliff_terrain(size=60, drop_m=900.0):
    """A plateau that falls to a plain over two samples (80°), with a bent rim."""
    row, column = np.mgrid[0:size, 0:size].astype(float)
    edge = size * 0.45 + 6.0 * np.sin(row / 9.0)
    heights = 600.0 + drop_m / (1.0 + np.exp((column - edge) * 3.0)) + 20.0 * np.sin(row / 5.0) * np.cos(column / 4.0)
    raster = Raster(heights[..., None].astype(np.float32), Affine(60, 0, 2640000, 0, -60, 1160000), "EPSG:2056")
    return build_mesh(raster, FRAME, max_error_m=4.0)


def points_on(terrain, count, seed=0):
    """Random places on the surface: position ``(N, 3)`` and UV ``(N, 2)``, by barycentric weights."""
    rng = np.random.default_rng(seed)
    face = terrain.faces[rng.integers(0, len(terrain.faces), count)]
    weights = rng.dirichlet(np.ones(3), count)[..., None]
    return (terrain.vertices[face] * weights).sum(1), (terrain.uv[face].astype(np.float64) * weights).sum(1)


# ---------------------------------------------------------------------------------------------- injectivity


@pytest.mark.parametrize("kind", ATLASES)
@given(seed=st.integers(0, 10_000), height=st.integers(2, 6), width=st.integers(2, 6), relief_m=st.floats(1.0, 400.0))
@settings(max_examples=25, deadline=None)
def test_no_two_faces_share_an_area(kind, seed, height, width, relief_m):
    """All pairs of faces, by the separating axis theorem. 400 m between neighbours of 50 m: walls of 83°."""
    values = 1000.0 + relief_m * np.random.default_rng(seed).random((height, width, 1))
    raster = Raster(values.astype(np.float32), Affine(50, 0, 2640000, 0, -50, 1160000), "EPSG:2056")
    terrain, atlas = unwrap(build_mesh(raster, FRAME, mesher="grid"), kind=kind, max_side_px=512)
    assert overlapping_pairs(terrain.uv, terrain.faces) == []
    assert (signed_uv_areas(terrain.uv, terrain.faces) != 0).all()
    assert terrain.uv.min() >= 0.0
    assert terrain.uv.max() <= 1.0
    assert max(atlas.width_px, atlas.height_px) <= 512


@pytest.mark.parametrize("kind", ATLASES)
def test_every_texel_belongs_to_at_most_one_face(kind):
    terrain, atlas = unwrap(cliff_terrain(), kind=kind, max_side_px=1024)
    size = atlas.width_px, atlas.height_px
    count = coverage_count(texel_coordinates(terrain.uv, *size), terrain.faces, *size)
    assert count.max() == 1
    np.testing.assert_allclose(count.mean(), atlas.utilization, atol=2e-3)
    if kind == "relief":
        assert count.min() == 1, "the rectangle is filled to its last texel"


@pytest.mark.parametrize("kind", ATLASES)
def test_from_texel_to_ground_and_back_to_the_texel(kind):
    """Place → UV → texel → place returns to within a texel's own size on the ground, and UV to half a texel."""
    terrain, atlas = unwrap(cliff_terrain(), kind=kind, max_side_px=700)
    size = atlas.width_px, atlas.height_px
    positions, face_id = texel_positions(terrain, *size)
    place, uv = points_on(terrain, 3000)
    column, row = np.floor(texel_coordinates(uv, *size)).astype(int).T
    known = face_id[row, column] >= 0
    # A texel whose centre lies just outside a chart is not covered by it.
    assert known.mean() > (0.93 if kind == "xatlas" else 0.99)
    distance = np.linalg.norm(positions[row, column] - place, axis=1)[known]
    assert np.quantile(distance, 0.98) < 0.75 * atlas.stretch_p99_m
    # And exactly: the centre's place, laid out by its face's barycentric weights, is the centre.
    face = terrain.faces[face_id[row, column][known]]
    corners, centre = terrain.vertices[face].astype(np.float64), positions[row, column][known]
    sides, offset = corners[:, 1:] - corners[:, :1], centre - corners[:, 0]
    share = np.stack([np.linalg.lstsq(s.T, o, rcond=None)[0] for s, o in zip(sides, offset, strict=True)])
    uv = terrain.uv[face].astype(np.float64)
    back = texel_coordinates(uv[:, 0] + ((uv[:, 1:] - uv[:, :1]) * share[..., None]).sum(1), *size)
    np.testing.assert_allclose(back, np.stack([column, row], -1)[known] + 0.5, atol=0.05)


# ---------------------------------------------------------------------------------------------- the rasteriser


def inside(corners, point):
    """Signed distances say whether a point is in a triangle; 0 on an edge."""
    sides = []
    for k in range(3):
        edge, to = corners[(k + 1) % 3] - corners[k], point - corners[k]
        sides.append(edge[0] * to[1] - edge[1] * to[0])
    return min(sides), max(sides)


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_covering_faces_agrees_with_a_loop_over_texels_and_triangles(seed):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-3, 15, (9, 2)) if seed % 2 else rng.integers(-2, 28, (9, 2)) / 2.0
    faces = rng.integers(0, 9, (4, 3))
    got = covering_faces(xy, faces, 12, 10)
    for row in range(10):
        for column in range(12):
            spread = [inside(xy[f], np.array([column + 0.5, row + 0.5])) for f in faces]
            strictly = [i for i, (low, high) in enumerate(spread) if low > 1e-9 or high < -1e-9]
            touching = [i for i, (low, high) in enumerate(spread) if low >= -1e-9 or high <= 1e-9]
            if strictly:
                assert got[row, column] >= strictly[-1]
                assert got[row, column] in touching
            else:
                assert got[row, column] == -1 or got[row, column] in touching


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_a_mesh_covers_each_texel_exactly_once_even_where_edges_pass_through_centres(seed):
    """Vertices on half-integers put edges and corners exactly on texel centres."""
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(seed)
    points = np.concatenate([[(0, 0), (16, 0), (0, 12), (16, 12)], rng.integers(0, [32, 24], (40, 2)) / 2.0])
    points = np.unique(points, axis=0)
    count = coverage_count(points, Delaunay(points).simplices, 16, 12)
    assert (count == 1).all()


# ---------------------------------------------------------------------------------------------- planar


def test_planar_is_one_exact_affine_map_with_square_texels():
    terrain, atlas = unwrap(build_mesh(hill_lv95(), FRAME), texel_m=17.0)
    low = terrain.vertices[:, :2].min(0).astype(np.float64)
    texel = texel_coordinates(terrain.uv, atlas.width_px, atlas.height_px)
    np.testing.assert_allclose(texel[:, 0] * 17.0 + low[0], terrain.vertices[:, 0], atol=2e-3)
    np.testing.assert_allclose((atlas.height_px - texel[:, 1]) * 17.0 + low[1], terrain.vertices[:, 1], atol=2e-3)
    extent = np.ptp(terrain.vertices[:, :2], axis=0)
    assert (atlas.width_px, atlas.height_px) == tuple(np.ceil(extent / 17.0).astype(int))
    # The closed form of the texel map.
    positions, face_id = texel_positions(terrain, atlas.width_px, atlas.height_px)
    row, column = np.nonzero(face_id >= 0)
    np.testing.assert_allclose(positions[row, column, 0], low[0] + (column + 0.5) * 17.0, atol=5e-3)
    np.testing.assert_allclose(positions[row, column, 1], low[1] + (atlas.height_px - row - 0.5) * 17.0, atol=5e-3)


def test_texel_sizes_on_an_inclined_plane_follow_the_cosine():
    """A plane of 60° in texels of 10 m in plan: 20 m along the slope, √2 · 10 m in area."""
    vertices = np.array([(0, 0, 0), (100, 0, 0), (100, 50, 50 * np.sqrt(3)), (0, 50, 50 * np.sqrt(3))], np.float32)
    terrain = Terrain(vertices, np.array([(0, 1, 2), (0, 2, 3)], np.uint32), np.zeros((4, 2), np.float32), FRAME)
    _, atlas = unwrap(terrain, texel_m=10.0)
    assert (atlas.width_px, atlas.height_px, atlas.charts) == (10, 5, 1)
    sizes = (atlas.texel_p1_m, atlas.texel_p50_m, atlas.texel_p99_m, atlas.stretch_p99_m, atlas.utilization)
    np.testing.assert_allclose(sizes, (200**0.5, 200**0.5, 200**0.5, 20.0, 1.0), rtol=1e-5)


def test_an_overhang_is_refused_by_planar_with_the_way_out():
    vertices = np.array([(0, 0, 0), (10, 0, 0), (10, 10, 0), (0, 10, 0), (4, 5, 20), (-6, 5, 10)], np.float32)
    faces = np.array([(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4), (0, 5, 3)], np.uint32)
    faces[4] = (4, 3, 5)
    terrain = Terrain(vertices, faces, np.zeros((6, 2), np.float32), FRAME)
    folded = Terrain(vertices, np.array([(0, 1, 4), (0, 4, 1)], np.uint32), terrain.uv, FRAME)
    with pytest.raises(InputError, match=r"atlas planar: 1 of 2 faces fold over in UV space; use the xatlas atlas"):
        unwrap(folded)


# ---------------------------------------------------------------------------------------------- relief and charts


def test_relief_gives_cliffs_their_texels_at_the_same_count():
    terrain = cliff_terrain()
    planar, relief_ = (unwrap(terrain, kind=kind, max_side_px=512)[1] for kind in ("planar", "relief"))
    assert (planar.width_px, planar.height_px) == (relief_.width_px, relief_.height_px)
    assert relief_.texel_p99_m < 0.6 * planar.texel_p99_m
    assert relief_.stretch_p99_m < 0.5 * planar.stretch_p99_m
    assert relief_.texel_p99_m / relief_.texel_p1_m < 0.6 * planar.texel_p99_m / planar.texel_p1_m


def test_relief_of_level_ground_is_planar():
    raster = Raster(np.full((12, 15, 1), 700.0, np.float32), Affine(50, 0, 2640000, 0, -50, 1160000), "EPSG:2056")
    terrain = build_mesh(raster, LocalFrame(46.588, 7.968), mesher="grid")
    planar, _ = unwrap(terrain, max_side_px=100)
    flat, atlas = unwrap(terrain, kind="relief", max_side_px=100)
    # The map's grid is turned by 0.4° against true north; the relief atlas squares it up.
    np.testing.assert_allclose(flat.uv, planar.uv, atol=0.02)
    np.testing.assert_allclose(atlas.texel_p99_m / atlas.texel_p1_m, 1.0, atol=1e-3)


def test_relief_refuses_what_has_holes_or_too_many_faces(monkeypatch):
    terrain = build_mesh(hill_lv95(6, 6), FRAME, mesher="grid")
    torn = Terrain(terrain.vertices, np.delete(terrain.faces, 24, axis=0), terrain.uv, FRAME)
    with pytest.raises(InputError, match=r"atlas relief: the surface is not one piece without holes; use the xatlas"):
        unwrap(torn, kind="relief")
    monkeypatch.setattr(relief, "MAX_FACES", 49)
    with pytest.raises(
        InputError, match=r"too many faces to solve for: 50; expected at most 49; use the adaptive mesher"
    ):
        unwrap(terrain, kind="relief")


def test_charts_are_split_copies_of_the_same_surface(monkeypatch):
    terrain = cliff_terrain()
    split, atlas = unwrap(terrain, kind="xatlas", texel_m=20.0, max_side_px=4096)
    again, _ = unwrap(terrain, kind="xatlas", texel_m=20.0, max_side_px=4096)
    np.testing.assert_array_equal(split.uv, again.uv)
    assert atlas.charts > 1
    assert len(split.vertices) > len(terrain.vertices)
    assert len(split.faces) == len(terrain.faces)
    as_set = lambda t: sorted(map(tuple, t.vertices[t.faces].reshape(-1, 9).tolist()))  # noqa: E731
    assert as_set(split) == as_set(terrain)
    assert 14.0 < atlas.texel_p50_m < 26.0
    normal = lambda t: np.cross(*np.moveaxis(np.diff(t.vertices[t.faces].astype(float), axis=1), 1, 0))  # noqa: E731
    assert (normal(split)[:, 2] > 0).all()
    monkeypatch.setattr(charts, "MAX_FACES", 10)
    with pytest.raises(InputError, match="too many faces to cut into charts: "):
        unwrap(terrain, kind="xatlas")


def test_charts_of_a_landscape_fill_the_texture_and_leave_no_black_texel():
    raster = hill_lv95(300, 300)
    terrain, atlas = unwrap(
        build_mesh(raster, FRAME, mesher="poisson", max_error_m=2.0), kind="xatlas", texel_m=25.0, max_side_px=4096
    )
    assert atlas.utilization > 0.6
    assert atlas.charts > 4
    white = replace(raster, values=np.ones((300, 300, 3), np.float32))
    baked = bake_imagery(terrain, atlas, white)
    assert baked.values.min() > 0.999
    assert baked.weight.min() > 0.0


def test_charts_keep_their_distance():
    """Around each chart at least two texels are nobody else's, so that its gutter is its own."""
    from scipy.ndimage import label, maximum_filter, minimum_filter

    terrain, atlas = unwrap(cliff_terrain(), kind="xatlas", max_side_px=1024)
    size = atlas.width_px, atlas.height_px
    face_id = covering_faces(texel_coordinates(terrain.uv, *size), terrain.faces, *size)
    chart = _chart_of_faces(terrain)
    owner = np.where(face_id >= 0, chart[face_id], -1)
    high = maximum_filter(owner, 3)
    low = minimum_filter(np.where(owner < 0, 10**6, owner), 3)
    assert label(owner >= 0)[1] >= 2
    assert not ((low != high) & (low < 10**6) & (high >= 0)).any()


def _chart_of_faces(terrain):
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([terrain.faces[:, :2], terrain.faces[:, 1:]]).astype(int)
    size = (len(terrain.vertices),) * 2
    return connected_components(coo_array((np.ones(len(edges)), edges.T), shape=size))[1][terrain.faces[:, 0]]


def test_texels_that_do_not_fit_are_refused_with_a_size_that_does():
    terrain = build_mesh(hill_lv95(20, 20), FRAME)
    for kind in ATLASES:
        with pytest.raises(
            InputError, match=r"atlas: texels of 1 m need \d+ × \d+ of them; .*at most 100 along a side"
        ):
            unwrap(terrain, kind=kind, texel_m=1.0, max_side_px=100)
    with pytest.raises(ValueError, match="kind: got 'conformal', expected one of planar, relief, xatlas"):
        unwrap(terrain, kind="conformal")
    with pytest.raises(ValueError, match="expected a positive size"):
        unwrap(terrain, texel_m=-1.0)


def test_percentiles_weigh_by_area():
    """One face of 1 % of the area does not move the median, however many small ones there are."""
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32)
    vertices = np.array([(0, 0, 0), (10, 0, 0), (10, 10, 0), (0, 10, 0)], np.float32)
    terrain = Terrain(vertices, np.array([(0, 1, 2), (0, 2, 3)], np.uint32), uv, FRAME)
    atlas = measure_atlas(terrain, "planar", 20, 10)
    np.testing.assert_allclose((atlas.texel_p50_m, atlas.stretch_p99_m), (0.5**0.5, 1.0), rtol=1e-6)
