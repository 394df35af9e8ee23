"""Imagery in the atlas: registered to a fraction of a texel, free of aliasing, and silent where there is no image."""

from dataclasses import replace

import numpy as np
import pyproj
import pytest
from affine import Affine
from terrain_cases import hill_lv95, raster_of, write_tiff

from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame, geodetic_from_enu
from seasonscapes.terrain.imagery import bake_imagery, dilate, image_pixels, pixel_map, read_imagery
from seasonscapes.terrain.mesh import build_mesh
from seasonscapes.terrain.surface import Raster, Texture, atlas_identity
from seasonscapes.terrain.texels import texel_coordinates, texel_positions
from seasonscapes.terrain.unwrap import ATLASES, unwrap

FRAME = LocalFrame(46.55, 7.98)
SQUARE_DEG = (0.0020, 0.0014)


@pytest.fixture(scope="module")
def terrain():
    return build_mesh(hill_lv95(64, 72), FRAME)


def board(latitude, longitude):
    """A checkerboard of about 150 m on meridians and parallels, 0.2 and 0.8."""
    east, north = np.floor((longitude - 7.9) / SQUARE_DEG[0]), np.floor((latitude - 46.5) / SQUARE_DEG[1])
    return 0.2 + 0.6 * ((east + north) % 2)


def image_of(function, crs, transform, height, width, supersample=3):
    """A picture whose pixels are box means of ``function(latitude, longitude)``."""
    t, n = transform, supersample
    fine = Affine(t.a / n, t.b / n, t.c, t.d / n, t.e / n, t.f)
    values = raster_of(function, crs, fine, height * n, width * n).values[..., 0]
    mean = values.reshape(height, n, width, n).mean(axis=(1, 3))
    return Raster(np.repeat(mean[..., None], 3, axis=2).astype(np.float32), transform, crs)


def utm_board(pixel_m=20.0, function=board, supersample=3):
    """The checkerboard as seen in UTM 32, whose grid is turned by 0.7° against the Swiss one here."""
    east, north = pyproj.Transformer.from_crs("EPSG:2056", "EPSG:32632", always_xy=True).transform(2637000, 1159900)
    size = int(5_600 / pixel_m)
    transform = Affine(pixel_m, 0, np.floor(east) + 300, 0, -pixel_m, np.floor(north))
    return image_of(function, "EPSG:32632", transform, size, size, supersample)


def registration_error_px(terrain, atlas, texture):
    """Median and worst shift [texels] of the baked board against the formula, over blocks of 40 × 40 texels.

    The truth at a texel is the formula's mean over the texel, through `frames` alone. The shift is that of
    Lucas & Kanade: least squares of the difference on the truth's gradients.
    """
    width, height = atlas.width_px, atlas.height_px
    n = 4
    positions, face_id = texel_positions(terrain, width * n, height * n)
    latitude, longitude, _ = geodetic_from_enu(terrain.frame, np.nan_to_num(positions, nan=0.0))
    fine = np.where(face_id >= 0, board(latitude, longitude), np.nan)
    truth = fine.reshape(height, n, width, n).mean(axis=(1, 3))
    gy, gx = np.gradient(truth)
    difference = texture.values[..., 0] - truth
    shifts = []
    for row in range(0, height - 39, 40):
        for column in range(0, width - 39, 40):
            part = slice(row, row + 40), slice(column, column + 40)
            good = np.isfinite(difference[part]) & np.isfinite(gx[part] + gy[part]) & (texture.weight[part] > 0.999)
            if good.mean() < 0.6:
                continue
            basis = np.stack([gx[part][good], gy[part][good]], axis=-1)
            shifts.append(np.linalg.lstsq(basis, -difference[part][good], rcond=None)[0])
    shift = np.linalg.norm(shifts, axis=1)
    return np.median(shift), shift.max(), len(shift)


@pytest.mark.parametrize("kind", ATLASES)
def test_registration_of_a_checkerboard_in_another_map(terrain, kind):
    terrain, atlas = unwrap(terrain, kind=kind, texel_m=20.0, max_side_px=1500)
    texture = bake_imagery(terrain, atlas, utm_board(10.0))
    median, worst, blocks = registration_error_px(terrain, atlas, texture)
    assert blocks > 15
    assert median < 0.05
    assert worst < 0.25


def test_the_measure_of_registration_sees_half_a_texel(terrain):
    """The proof above could fail: an image misplaced by half a texel is reported as such."""
    terrain, atlas = unwrap(terrain, texel_m=20.0)
    image = utm_board(10.0)
    t = image.transform
    moved = Raster(image.values, Affine(t.a, 0, t.c + 10.0, 0, t.e, t.f), image.crs)
    median, _, _ = registration_error_px(terrain, atlas, bake_imagery(terrain, atlas, moved))
    assert 0.35 < median < 0.65


def test_fine_stripes_become_their_mean_and_not_a_moire(terrain):
    """Every other column of 4 m pixels is bright, texels are 50 m: 0.5 all over; picked pixels would be 0.2 or 0.8."""
    stripes = utm_board(4.0, lambda latitude, longitude: np.zeros_like(latitude), 1)
    stripes.values[:] = 0.2 + 0.6 * (np.arange(stripes.values.shape[1])[None, :, None] % 2)
    terrain, atlas = unwrap(terrain, texel_m=50.0)
    texture = bake_imagery(terrain, atlas, stripes)
    seen = texture.values[..., 0][texture.weight > 0.999]
    assert abs(seen.mean() - 0.5) < 0.01
    assert seen.std() < 0.03


def test_anisotropic_footprints_keep_what_the_short_side_can_see():
    """Texels of 10 × 80 m: stripes of 80 m across the short side survive, those along the long side are averaged."""
    terrain = build_mesh(
        Raster(np.full((40, 40, 1), 800.0, np.float32), Affine(100, 0, 2640000, 0, -100, 1158000), "EPSG:2056"), FRAME
    )
    terrain, atlas = unwrap(terrain, texel_m=10.0)
    tall = type(atlas)(**{**vars(atlas), "height_px": atlas.height_px // 8})
    image = Affine(10, 0, 2639900, 0, -10, 1158100)
    x = np.arange(420) // 4 % 2
    across = Raster(np.broadcast_to(x[None, :, None], (420, 420, 3)).astype(np.float32), image, "EPSG:2056")
    along = Raster(np.broadcast_to(x[:, None, None], (420, 420, 3)).astype(np.float32), image, "EPSG:2056")
    inner = slice(3, -3), slice(20, -20)
    assert bake_imagery(terrain, tall, across).values[inner][..., 0].std() > 0.35
    averaged = bake_imagery(terrain, tall, along).values[inner][..., 0]
    assert averaged.std() < 0.08
    assert abs(averaged.mean() - 0.5) < 0.02


def test_channels_baked_together_are_those_baked_alone(terrain):
    rng = np.random.default_rng(3)
    image = utm_board(20.0, lambda latitude, longitude: np.full_like(latitude, 0.7))
    height, width = image.values.shape[:2]
    six = replace(image, values=rng.random((height, width, 6), np.float32))
    six.values[:, :140] = np.nan
    terrain, atlas = unwrap(terrain, texel_m=30.0)
    together = bake_imagery(terrain, atlas, six)
    for channels in (np.s_[..., :3], np.s_[..., 3:]):
        alone = bake_imagery(terrain, atlas, replace(six, values=six.values[channels]))
        assert together.values[channels].tobytes() == alone.values.tobytes()
        assert together.weight.tobytes() == alone.weight.tobytes()
    assert together.values.std() > 0.1


def test_weight_is_zero_where_there_is_no_image_and_colour_is_not_diluted(terrain):
    image = utm_board(20.0, lambda latitude, longitude: np.full_like(latitude, 0.7))
    image.values[:, :140] = np.nan
    terrain, atlas = unwrap(terrain, texel_m=30.0)
    texture = bake_imagery(terrain, atlas, image)
    positions, face_id = texel_positions(terrain, atlas.width_px, atlas.height_px)
    pixel = image_pixels(FRAME, image, np.nan_to_num(positions).reshape(-1, 3)).reshape(*face_id.shape, 2)
    on = face_id >= 0
    assert (texture.weight[on & (pixel[..., 0] < 138)] == 0).all()
    assert (texture.weight[on & (pixel[..., 0] > 142)] > 0.9999).all()
    np.testing.assert_allclose(texture.values[texture.weight > 0], 0.7, atol=1e-5)
    assert (texture.values[texture.weight == 0] == 0).all()


def test_an_image_of_elsewhere_is_refused(terrain):
    terrain, atlas = unwrap(terrain, texel_m=100.0)
    elsewhere = Raster(np.ones((4, 4, 3), np.float32), Affine(100, 0, 2500000, 0, -100, 1100000), "EPSG:2056")
    with pytest.raises(InputError, match="imagery: the image covers none of the terrain; check the CRS of both files"):
        bake_imagery(terrain, atlas, elsewhere)


@pytest.mark.parametrize("kind", ATLASES)
def test_bilinear_look_ups_never_meet_an_empty_texel(terrain, kind):
    """White imagery: any bilinear look-up anywhere on the surface is white, also at chart borders."""
    terrain, atlas = unwrap(terrain, kind=kind, max_side_px=600)
    texture = bake_imagery(terrain, atlas, utm_board(50.0, lambda latitude, longitude: np.ones_like(latitude)))
    rng = np.random.default_rng(0)
    face = terrain.faces[rng.integers(0, len(terrain.faces), 20_000)]
    weights = rng.dirichlet(np.full(3, 0.3), len(face))[..., None]
    column, row = (texel_coordinates((terrain.uv[face] * weights).sum(1), atlas.width_px, atlas.height_px) - 0.5).T
    column0, row0 = np.floor(column).astype(int), np.floor(row).astype(int)
    for r in (row0, row0 + 1):
        for c in (column0, column0 + 1):
            r, c = np.clip(r, 0, atlas.height_px - 1), np.clip(c, 0, atlas.width_px - 1)
            np.testing.assert_allclose(texture.values[r, c], 1.0, atol=1e-5)


def test_fitted_map_agrees_with_the_exact_one(terrain):
    image = utm_board(1.0 * 20)
    fitted = pixel_map(terrain, image)
    rng = np.random.default_rng(1)
    low, high = terrain.vertices.min(0), terrain.vertices.max(0)
    points = rng.uniform(low, high, (5000, 3))
    assert np.abs(fitted(points) - image_pixels(FRAME, image, points)).max() < 0.002


def test_baked_textures_belong_to_the_atlas_of_the_terrain(terrain):
    unwrapped, atlas = unwrap(terrain, kind="planar", texel_m=80.0)
    texture = bake_imagery(unwrapped, atlas, utm_board(80.0))
    assert texture.atlas_id == atlas_identity(unwrapped, atlas.width_px, atlas.height_px)
    assert dilate(texture, texture.weight > 0.0, 1).atlas_id == texture.atlas_id


def test_dilation_repeats_the_rim_and_nothing_else():
    values, weight = np.zeros((7, 7, 3), np.float32), np.zeros((7, 7), np.float32)
    covered = np.zeros((7, 7), bool)
    covered[3, 3] = True
    values[3, 3], weight[3, 3] = 0.4, 1.0
    grown = dilate(Texture(values, weight), covered, 2)
    expected = np.zeros((7, 7))
    expected[1:6, 1:6] = 0.4
    np.testing.assert_allclose(grown.values[..., 0], expected, atol=1e-7)
    np.testing.assert_allclose(grown.weight, expected > 0)
    assert weight.sum() == 1.0, "the input is left alone"


# ---------------------------------------------------------------------------------------------- reading


def test_pictures_are_decoded_to_linear_light(tmp_path):
    """sRGB 188 is half of full light (IEC 61966-2-1)."""
    transform = Affine(10, 0, 2640000, 0, -10, 1160000)
    rgb = np.full((3, 2, 2), 188, np.uint8)
    rgb[:, 0, 0] = 255, 0, 10
    path = write_tiff(tmp_path / "rgb.tif", rgb, transform, "EPSG:2056", photometric="RGB")
    image = read_imagery(path)
    np.testing.assert_allclose(image.values[1, 1], 0.5029, atol=1e-4)
    np.testing.assert_allclose(image.values[0, 0], (1.0, 0.0, 10 / 255 / 12.92), rtol=1e-5)
    np.testing.assert_allclose(read_imagery(path, encoding="linear").values[1, 1], 188 / 255, rtol=1e-6)
    grey = write_tiff(tmp_path / "grey.tif", rgb[:1], transform, "EPSG:2056")
    assert read_imagery(grey).values.shape == (2, 2, 3)


def test_fine_pictures_are_averaged_in_linear_light(tmp_path):
    """Black beside white is half the light, which is sRGB 188 and not 128."""
    checker = (np.indices((8, 8)).sum(0) % 2 * 255).astype(np.uint8)
    path = write_tiff(tmp_path / "a.tif", checker, Affine(10, 0, 2640000, 0, -10, 1160000), "EPSG:2056")
    image = read_imagery(path, finest_m=20.0)
    assert image.values.shape == (4, 4, 3)
    np.testing.assert_allclose(image.values, 0.5, rtol=1e-6)
    assert image.transform == Affine(20, 0, 2640000, 0, -20, 1160000)


def test_images_that_are_no_colour_images_are_named(tmp_path):
    transform = Affine(10, 0, 2640000, 0, -10, 1160000)
    five = write_tiff(tmp_path / "five.tif", np.full((5, 2, 2), 300, np.uint16), transform, "EPSG:2056")
    with pytest.raises(InputError, match=r"five.tif: not a colour image; got 5; expected one \(grey\) or three bands"):
        read_imagery(five, full_scale=10_000.0)
    with pytest.raises(
        InputError, match=r"brighter than full scale; got '300'; expected at most 255; state \[imagery\] full_scale"
    ):
        read_imagery(five, bands=(3, 2, 1))
    reflectance = read_imagery(five, bands=(3, 2, 1), encoding="linear", full_scale=10_000.0)
    np.testing.assert_allclose(reflectance.values, 0.03, rtol=1e-6)
    with pytest.raises(ValueError, match="encoding: got 'gamma', expected one of srgb, linear"):
        read_imagery(five, encoding="gamma")


def test_real_image_lies_on_the_real_mountains(data_dir):
    """SWISSIMAGE through its own map and through the elevation's grid give the same texture."""
    from seasonscapes.terrain.raster import read_elevation

    bounds = (7.95, 46.52, 8.05, 46.60)
    terrain = build_mesh(read_elevation(data_dir / "jungfrau" / "dem_surface_100m.tif", bounds_deg=bounds), FRAME)
    terrain, atlas = unwrap(terrain, texel_m=50.0)
    a, b = (
        bake_imagery(terrain, atlas, read_imagery(data_dir / "jungfrau" / name, bounds_deg=bounds))
        for name in ("swissimage_136m.tif", "swissimage_on_dem_100m.tif")
    )
    both = (a.weight > 0.9) & (b.weight > 0.9)
    assert both.mean() > 0.9
    assert np.corrcoef(a.values[both].ravel(), b.values[both].ravel())[0, 1] > 0.98
