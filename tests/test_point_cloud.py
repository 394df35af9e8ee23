"""The explicit point cloud: where its points are, which way they face, what colours they have, and that Poisson reads it."""

from dataclasses import replace

import numpy as np
import pytest
from affine import Affine
from plyfile import PlyData

from seasonscapes.frames import LocalFrame
from seasonscapes.terrain.point_cloud import coloured_cloud, oriented_points, save_point_cloud
from seasonscapes.terrain.poisson import poisson_raster
from seasonscapes.terrain.raster import centre_frame
from seasonscapes.terrain.surface import Raster

EAST, NORTH, CELL = 421_000.0, 5_156_000.0, 30.0


def hill(height=40, width=50) -> Raster:
    y, x = np.mgrid[0:height, 0:width]
    heights = 1500.0 + 300.0 * np.exp(-((x - 20.0) ** 2 + (y - 25.0) ** 2) / 200.0) + 2.0 * x
    return Raster(heights[..., None].astype(np.float32), Affine(CELL, 0, EAST, 0, -CELL, NORTH), "EPSG:32632")


def image() -> Raster:
    """Twice as fine as the hill, over its western three quarters; red grows to the east, green to the south."""
    rows, columns = np.mgrid[0:80, 0:76]
    values = np.stack([columns / 100.0, rows / 100.0, np.full(rows.shape, 0.3)], axis=-1)
    return Raster(values.astype(np.float32), Affine(CELL / 2, 0, EAST, 0, -CELL / 2, NORTH), "EPSG:32632")


def test_points_lie_on_the_samples_and_face_along_the_slope():
    raster = hill()
    frame = centre_frame(raster)
    cloud = coloured_cloud(oriented_points(raster), frame, None, grey=0.25)
    grid = cloud.position_m.reshape(40, 50, 3)
    assert np.linalg.norm((grid[10, 11] - grid[10, 10])[:2]) == pytest.approx(CELL, rel=1e-3)
    # Normals of differences of the positions themselves, in the local frame.
    expected = np.cross(np.gradient(grid, axis=1), -np.gradient(grid, axis=0))
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    off = np.degrees(np.arccos(np.clip((cloud.normal.reshape(40, 50, 3) * expected).sum(axis=-1), -1.0, 1.0)))
    assert off.max() < 0.05
    assert np.degrees(np.arccos(expected[..., 2].min())) > 15.0
    np.testing.assert_array_equal(cloud.colour, np.float32(0.25))
    # Far from the hill the land rises to the east by 2 m a cell, and faces west.
    normal = cloud.normal.reshape(40, 50, 3)[0, 48]
    np.testing.assert_allclose(normal / normal[2], [-2.0 / CELL, 0.0, 1.0], atol=5e-3)


def test_colours_are_the_image_s_at_the_points():
    raster = hill()
    cloud = coloured_cloud(oriented_points(raster), centre_frame(raster), image())
    colour = cloud.colour.reshape(40, 50, 3)
    # The centre of cell (i, j) lies between pixels 2j and 2j + 1.
    rows, columns = np.mgrid[0:40, 0:37]
    np.testing.assert_allclose(colour[:, :37, 0], (2.0 * columns + 0.5) / 100.0, atol=2e-3)
    np.testing.assert_allclose(colour[:, :37, 1], (2.0 * rows + 0.5) / 100.0, atol=2e-3)
    np.testing.assert_allclose(
        colour[:, 40:], np.broadcast_to(np.median(image().values.reshape(-1, 3), axis=0), (40, 10, 3))
    )


def test_strips_give_what_the_whole_gives(monkeypatch):
    raster = hill()
    whole = coloured_cloud(oriented_points(raster), centre_frame(raster), image())
    monkeypatch.setattr("seasonscapes.terrain.point_cloud._CHUNK", 130)
    parts = coloured_cloud(oriented_points(raster), centre_frame(raster), image())
    np.testing.assert_allclose(parts.position_m, whole.position_m, atol=1e-9)
    np.testing.assert_allclose(parts.normal, whole.normal, atol=1e-5)
    np.testing.assert_allclose(parts.colour, whole.colour, atol=1e-3)


def test_poisson_reads_the_points_and_their_normals():
    raster = hill()
    points = oriented_points(raster)
    whole = poisson_raster(points)
    np.testing.assert_array_equal(whole.values, poisson_raster(raster).values)
    assert np.abs(whole.values - raster.values).max() < 3.0
    # Normals that lean to the west: a surface that rises to the east, as far as the samples' own weight lets it.
    leaning = np.broadcast_to(np.array([-0.6, 0.0, 0.8], np.float32), points.normals.shape)
    tilted = poisson_raster(replace(points, normals=leaning)).values[..., 0] - whole.values[..., 0]
    assert np.gradient(tilted, axis=1)[5:-5, 5:-5].mean() != pytest.approx(0.0, abs=1e-4)
    assert np.abs(tilted).max() > 1.0


def test_a_ply_holds_the_cloud(tmp_path):
    raster = hill()
    cloud = coloured_cloud(oriented_points(raster), LocalFrame(46.55, 7.98, 1000.0), image())
    save_point_cloud(tmp_path / "points.ply", cloud, comments=["Säntis", "frame east north up"])
    read = PlyData.read(tmp_path / "points.ply")
    assert read.comments == ["S\\xe4ntis", "frame east north up"]
    vertex = read["vertex"]
    np.testing.assert_array_equal(np.stack([vertex[name] for name in "xyz"], axis=-1), cloud.position_m)
    np.testing.assert_array_equal(np.stack([vertex[f"n{name}"] for name in "xyz"], axis=-1), cloud.normal)
    from seasonscapes.images import linear_from_srgb

    shown = np.stack([vertex[name] for name in ("red", "green", "blue")], axis=-1)
    np.testing.assert_allclose(linear_from_srgb(shown / 255.0), cloud.colour, atol=0.004)
