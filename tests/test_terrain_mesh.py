"""Meshes: Earth curvature, the error bound, orientation, and one hill seen through two maps."""

from dataclasses import replace

import numpy as np
import pyproj
import pytest
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from terrain_cases import hill, hill_lv95, raster_of

from seasonscapes.frames import MEAN_RADIUS_M, SEMI_MAJOR_AXIS_M, LocalFrame, enu_from_geodetic
from seasonscapes.terrain.atlas import signed_uv_areas
from seasonscapes.terrain.mesh import MESHERS, build_mesh, mesh_report
from seasonscapes.terrain.placement import cell_sides_m
from seasonscapes.terrain.poisson import poisson_raster
from seasonscapes.terrain.raster import centre_frame
from seasonscapes.terrain.surface import Raster

FRAME = LocalFrame(46.55, 7.98, 0.0)


def sample_truth(raster, frame):
    """East, north, up of every sample, by pyproj and `frames` alone."""
    height, width = raster.values.shape[:2]
    row, column = np.mgrid[0:height, 0:width] + 0.5
    t = raster.transform
    transformer = pyproj.Transformer.from_crs(raster.crs, "EPSG:4326", always_xy=True)
    longitude, latitude = transformer.transform(t.a * column + t.b * row + t.c, t.d * column + t.e * row + t.f)
    return enu_from_geodetic(frame, latitude, longitude, raster.values[..., 0]).reshape(-1, 3)


def mesh_height(terrain, east, north):
    """Up of the mesh at plan positions, NaN outside: matplotlib's trapezoid map, which shares no code with ours."""
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    v = terrain.vertices.astype(np.float64)
    plan = Triangulation(v[:, 0], v[:, 1], terrain.faces.astype(np.int32))
    return LinearTriInterpolator(plan, v[:, 2])(east, north).filled(np.nan)


# ---------------------------------------------------------------------------------------------- Earth


@pytest.mark.parametrize("refraction_k", [0.0, 0.13])
def test_the_earth_drops_away_as_on_a_circle(refraction_k):
    """Along the equator WGS 84 is a circle: u = (a + h) cos λ − a, so 70.6 m at 30 km; refraction gives k back."""
    step = np.degrees(30_000.0 / SEMI_MAJOR_AXIS_M) / 10.0
    transform = Affine(step, 0, -10.5 * step, 0, -step, 1.5 * step)
    raster = Raster(np.full((3, 21, 1), 2000.0, np.float32), transform, "EPSG:4326")
    terrain = build_mesh(raster, LocalFrame(0.0, 0.0, 0.0, refraction_k), mesher="grid")
    row = terrain.vertices.reshape(3, 21, 3)[1]
    angle = np.radians(step) * (np.arange(21) - 10)
    east = (SEMI_MAJOR_AXIS_M + 2000.0) * np.sin(angle)
    up = (SEMI_MAJOR_AXIS_M + 2000.0) * np.cos(angle) - SEMI_MAJOR_AXIS_M
    np.testing.assert_allclose(row[:, 0], east, atol=3e-3)
    np.testing.assert_allclose(row[:, 1], 0.0, atol=1e-3)
    np.testing.assert_allclose(row[:, 2], up + refraction_k * east**2 / (2 * MEAN_RADIUS_M), atol=1e-3)
    assert 70.5 < 2000.0 - up[0] < 70.7


def test_vertices_are_the_samples_to_a_millimetre():
    raster = hill_lv95(40, 50)
    terrain = build_mesh(raster, FRAME, mesher="grid")
    assert (terrain.vertices.dtype, terrain.faces.dtype, terrain.uv.dtype) == (np.float32, np.uint32, np.float32)
    assert terrain.faces.shape == (2 * 39 * 49, 3)
    np.testing.assert_allclose(terrain.vertices, sample_truth(raster, FRAME), atol=1e-3)


# ---------------------------------------------------------------------------------------------- the bound


@pytest.mark.parametrize("max_error_m", [1.0, 5.0, 20.0])
def test_no_sample_is_further_from_the_adaptive_mesh_than_the_bound(max_error_m):
    raster = hill_lv95()
    terrain = build_mesh(raster, FRAME, max_error_m=max_error_m)
    truth = sample_truth(raster, FRAME)
    error = mesh_height(terrain, truth[:, 0], truth[:, 1]) - truth[:, 2]
    inside = np.isfinite(error)
    # Samples on the rim may fall a float32 rounding outside the mesh.
    assert (~inside).sum() <= 2 * sum(raster.values.shape[:2])
    assert np.abs(error[inside]).max() <= max_error_m
    report = mesh_report(terrain, raster)
    assert report.uncovered_samples == 0
    assert report.triangles == len(terrain.faces)
    assert report.samples == raster.values.size
    # The report and the independent twin see the same mesh.
    np.testing.assert_allclose(report.vertical_max_m, np.abs(error[inside]).max(), atol=0.01)
    np.testing.assert_allclose(report.vertical_rmse_m, np.sqrt(np.mean(error[inside] ** 2)), rtol=0.01)
    assert report.vertical_max_m > 0.7 * max_error_m, "a bound that is not used wastes triangles"
    assert report.saved_ratio == 1 - len(terrain.faces) / report.grid_triangles


def test_a_wide_lake_bulges_with_the_earth():
    """A 60 km lake at one level bulges 71 m out of any plane; two triangles would pass a bound on bare heights."""
    raster = Raster(np.full((151, 201, 1), 558.0, np.float32), Affine(300, 0, 2610000, 0, -300, 1180000), "EPSG:2056")
    frame = centre_frame(raster)
    terrain = build_mesh(raster, frame, max_error_m=1.0)
    truth = sample_truth(raster, frame)
    error = mesh_height(terrain, truth[:, 0], truth[:, 1]) - truth[:, 2]
    assert np.nanmax(np.abs(error)) <= 1.0
    assert 100 < len(terrain.faces) < 3000


def test_report_measures_a_known_displacement():
    """Lift the whole mesh by 3 m: RMSE and maximum are 3 m (plus the mesh's own millimetres)."""
    raster = hill_lv95(30, 30)
    terrain = build_mesh(raster, FRAME, mesher="grid")
    terrain.vertices[:, 2] += 3.0
    report = mesh_report(terrain, raster)
    np.testing.assert_allclose((report.vertical_rmse_m, report.vertical_max_m), 3.0, atol=2e-3)
    cut = type(terrain)(terrain.vertices, terrain.faces[: len(terrain.faces) // 2], terrain.uv, FRAME)
    assert mesh_report(cut, raster).uncovered_samples > 0.4 * raster.values.size


# ---------------------------------------------------------------------------------------------- handedness


def letter_raster(transform, crs="EPSG:2056"):
    """Flat ground with a raised F that reads correctly on a north-up map, whatever way the rows run."""
    row, column = np.mgrid[0:28, 0:20] + 0.5
    x = transform.a * column + transform.b * row + transform.c - 2640000.0
    y = transform.d * column + transform.e * row + transform.f - 1160000.0
    return Raster(np.where(is_letter(x, y), 1500.0, 1000.0)[..., None].astype(np.float32), transform, crs)


def is_letter(x, y):
    """An F of 500 × 900 m standing at x 200…700, y 200…1100: stem in the west, arms to the east, open at the foot."""
    stem = (x > 200) & (x < 350) & (y > 200) & (y < 1100)
    upper = (x > 200) & (x < 700) & (y > 950) & (y < 1100)
    middle = (x > 200) & (x < 550) & (y > 600) & (y < 750)
    return stem | upper | middle


GRIDS = {
    "north-up": Affine(50, 0, 2640000, 0, -50, 1161400),
    "south-up": Affine(50, 0, 2640000, 0, 50, 1160000),
    "east-to-west": Affine(-50, 0, 2641000, 0, -50, 1161400),
    "turned": Affine(0, 50, 2640000, 50, 0, 1160150),
}


@pytest.mark.parametrize("mesher", ["grid", "adaptive"])
@pytest.mark.parametrize("grid", GRIDS)
def test_faces_look_up_and_the_letter_reads_right(grid, mesher):
    raster = letter_raster(GRIDS[grid])
    frame = LocalFrame(46.59, 7.96)
    terrain = build_mesh(raster, frame, mesher=mesher, max_error_m=1.0)
    a, b, c = (terrain.vertices[terrain.faces[:, k]].astype(float) for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    # A point raised on the map is raised in the world, where the world's east and north come from pyproj alone.
    x, y = np.meshgrid(np.arange(125.0, 900.0, 50.0), np.arange(225.0, 1100.0, 50.0))
    longitude, latitude = pyproj.Transformer.from_crs("EPSG:2056", "EPSG:4326", always_xy=True).transform(
        x + 2640000, y + 1160000
    )
    enu = enu_from_geodetic(frame, latitude, longitude, 1000.0)
    up = mesh_height(terrain, enu[..., 0], enu[..., 1])
    np.testing.assert_array_equal(up > 1250, is_letter(x, y))
    # v runs to the north and u to the east.
    assert (signed_uv_areas(terrain.uv, terrain.faces) > 0).all()
    assert np.corrcoef(terrain.vertices[:, 0], terrain.uv[:, 0])[0, 1] > 0.999
    assert np.corrcoef(terrain.vertices[:, 1], terrain.uv[:, 1])[0, 1] > 0.999


def test_one_hill_through_two_maps_is_one_hill():
    """Swiss grid and plain degrees of the same formula agree in the frame; wrong convergence would shift by 130 m."""
    swiss = build_mesh(hill_lv95(180, 190, 40.0), FRAME, mesher="grid")
    degrees = raster_of(hill, "EPSG:4326", Affine(0.0005, 0, 7.94, 0, -0.00035, 46.58), 170, 160)
    degrees = build_mesh(degrees, FRAME, mesher="grid")
    rng = np.random.default_rng(0)
    east, north = rng.uniform(-2500, 2500, (2, 4000))
    a, b = mesh_height(swiss, east, north), mesh_height(degrees, east, north)
    assert np.isfinite(a).all()
    assert np.isfinite(b).all()
    assert np.abs(a - b).max() < 1.0
    assert np.ptp(a) > 1500.0


@given(st.integers(0, 10_000), st.integers(2, 7), st.integers(2, 7), st.floats(0.5, 100.0))
@settings(max_examples=25, deadline=None)
def test_every_small_raster_gives_a_whole_mesh_within_its_bound(seed, height, width, max_error_m):
    values = np.random.default_rng(seed).uniform(500, 900, (height, width, 1)).astype(np.float32)
    raster = Raster(values, Affine(50, 0, 2640000, 0, -50, 1160000), "EPSG:2056")
    report = mesh_report(build_mesh(raster, FRAME, max_error_m=max_error_m), raster)
    assert report.uncovered_samples == 0
    assert report.vertical_max_m <= max_error_m
    assert report.triangles <= report.grid_triangles


# ---------------------------------------------------------------------------------------------- refusals, Poisson


def test_callers_mistakes_are_named():
    raster = hill_lv95(5, 5)
    holed = Raster(np.where(raster.values > 0, np.nan, 0).astype(np.float32), raster.transform, raster.crs)
    with pytest.raises(ValueError, match="mesher: got 'delaunay', expected one of adaptive, grid, poisson"):
        build_mesh(raster, FRAME, mesher="delaunay")
    with pytest.raises(ValueError, match="holes; call fill_nodata first"):
        build_mesh(holed, FRAME)
    with pytest.raises(ValueError, match="at least 2 × 2"):
        build_mesh(Raster(raster.values[:1], raster.transform, raster.crs), FRAME)
    with pytest.raises(ValueError, match="expected a positive bound"):
        build_mesh(raster, FRAME, max_error_m=0.0)
    assert list(MESHERS) == ["adaptive", "grid", "poisson"]


def test_poisson_surface_follows_a_smooth_hill():
    raster = hill_lv95(60, 70)
    terrain = build_mesh(raster, FRAME, mesher="poisson", max_error_m=1.0)
    report = mesh_report(terrain, raster)
    assert report.vertical_rmse_m < 1.5
    assert report.uncovered_samples == 0
    a, b, c = (terrain.vertices[terrain.faces[:, k]].astype(float) for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_poisson_surface_is_that_of_its_functional():
    """One ridge across many equal columns: the two-dimensional problem, solved densely on a grid without a band."""
    screening = 4.0
    column = np.arange(40)
    profile = 60.0 * np.exp(-(((column - 20) / 4.0) ** 2)) + 3.0 * np.sin(column * 1.7)
    raster = replace(hill_lv95(3, 40), values=np.repeat(profile[None, :, None], 3, 0).astype(np.float32))
    dx, dy = cell_sides_m(raster)
    found = poisson_raster(raster, screening=screening).values[1, :, 0]
    expected = dense_poisson_profile(profile, dx, float(np.sqrt(dx * dy)), screening)
    inner = slice(8, -8)
    np.testing.assert_allclose(found[inner], expected[inner], atol=0.05)
    assert np.abs(found - profile)[inner].max() > 10 * 0.05, "the surface differs from its samples"


def dense_poisson_profile(heights, dx, dz, screening):
    """χ on all nodes of a section, by dense least squares over its edges; the splines by numerical integration."""
    columns, floor = len(heights), (heights.min() // dz - 10) * dz
    level = (heights - floor) / dz
    levels = int(np.ceil(level.max())) + 10
    fine = np.linspace(-1.5, 1.5, 601)
    spline = np.where(np.abs(fine) < 0.5, 0.75 - fine**2, 0.5 * (1.5 - np.abs(fine)) ** 2)
    slope = np.gradient(level)
    field = np.zeros((columns, levels, 2))
    for k in range(columns):
        half = max(abs(slope[k]), 0.5) / 2
        box = level[k] + np.linspace(-half, half, 401)
        density = np.interp(np.arange(levels)[:, None] - box, fine, spline, left=0, right=0).mean(axis=1)
        field[k] = density[:, None] * np.array([slope[k] * dz / dx, -1.0]) / dz
    field = ndimage.correlate1d(field, [0.125, 0.75, 0.125], axis=0, mode="nearest")
    number = np.arange(columns * levels).reshape(columns, levels)
    rows, right = [], []

    def equation(terms, value, weight):
        row = np.zeros(number.size)
        for node, factor in terms:
            row[node] += factor
        rows.append(np.sqrt(weight) * row)
        right.append(np.sqrt(weight) * value)

    for k in range(columns):
        for z in range(levels):
            here = field[k, z]
            if k + 1 < columns:
                step = dx * 0.5 * (here[0] + field[k + 1, z, 0])
                equation([(number[k + 1, z], 1), (number[k, z], -1)], step, dz / dx)
            if z + 1 < levels:
                step = dz * 0.5 * (here[1] + field[k, z + 1, 1])
                equation([(number[k, z + 1], 1), (number[k, z], -1)], step, dx / dz)
        below = int(level[k])
        share = level[k] - below
        length = dx * np.hypot(1.0, slope[k] * dz / dx)
        equation([(number[k, below], 1 - share), (number[k, below + 1], share)], 0.0, screening / dz * length)
        equation([(number[k, 0], 1)], 0.5, 1e3)
        equation([(number[k, -1], 1)], -0.5, 1e3)
    matrix, right = np.array(rows), np.array(right)
    chi = np.linalg.solve(matrix.T @ matrix, matrix.T @ right).reshape(columns, levels)
    last = levels - 1 - np.argmax(chi[:, ::-1] >= 0, axis=1)
    at, above = (chi[np.arange(columns), last + step] for step in (0, 1))
    return floor + dz * (last + at / (at - above))


def test_poisson_tiles_give_what_the_whole_gives(monkeypatch):
    rng = np.random.default_rng(3)
    rough = ndimage.gaussian_filter(rng.normal(size=(70, 80)), 2.0) * 300.0
    raster = replace(hill_lv95(70, 80), values=rough[..., None].astype(np.float32))
    whole = poisson_raster(raster)
    monkeypatch.setattr("seasonscapes.terrain.poisson._TILE", 32)
    np.testing.assert_allclose(poisson_raster(raster).values, whole.values, atol=0.02)


def test_poisson_keeps_planes_however_steep():
    for slope in (0.0, 0.7, 3.0):
        plane = (slope * 25.0 * np.add.outer(np.arange(20.0), 0.5 * np.arange(24.0)))[..., None].astype(np.float32)
        raster = replace(hill_lv95(20, 24), values=plane)
        assert np.abs(poisson_raster(raster).values - plane).max() < 0.02 * 60.0
