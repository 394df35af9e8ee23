"""All commands read photographs by one reader: the same pixels at the same places, or one line about the file."""

import io
import logging
import struct
from datetime import UTC, datetime

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms, ImageOps

from seasonscapes.cameras.observation import ManifestRow, check_pictures
from seasonscapes.cameras.webcam import Webcam
from seasonscapes.errors import InputError, UnreadableImage
from seasonscapes.images import (
    linear_from_srgb,
    picture_size,
    read_image_linear,
    read_image_srgb,
    read_image_srgb8,
    srgb_from_linear,
)
from seasonscapes.workflows.webcam_calibration import read_picture

SHAPE = (20, 32)


def landscape(shape=SHAPE):
    """Sky over meadow, brighter to the left: no symmetry of the square maps it to itself."""
    levels = np.zeros((*shape, 3), np.uint8)
    levels[: shape[0] // 3] = (90, 140, 230)
    levels[shape[0] // 3 :] = (60, 120, 40)
    levels[..., 1] -= np.linspace(0, 40, shape[1]).astype(np.uint8)
    return levels


def with_orientation(image, orientation):
    """The image stored so that a viewer who follows the tag sees it upright."""
    stored = {
        1: image,
        2: image[:, ::-1],
        3: image[::-1, ::-1],
        4: image[::-1],
        5: image.transpose(1, 0, 2),
        6: np.rot90(image, 1),
        7: image[::-1, ::-1].transpose(1, 0, 2),
        8: np.rot90(image, -1),
    }[orientation]
    tag = Image.Exif()
    tag[0x0112] = orientation
    return np.ascontiguousarray(stored), tag


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_a_picture_is_turned_by_its_orientation(tmp_path, orientation, suffix):
    stored, tag = with_orientation(landscape(), orientation)
    path = tmp_path / f"a{suffix}"
    Image.fromarray(stored).save(path, exif=tag)
    np.testing.assert_array_equal(np.asarray(ImageOps.exif_transpose(Image.open(path))), landscape())
    np.testing.assert_array_equal(read_image_srgb(path), landscape())
    np.testing.assert_array_equal(read_picture(path, "--picture"), landscape())
    np.testing.assert_allclose(read_image_linear(path), linear_from_srgb(landscape() / 255.0), rtol=1e-5)
    assert picture_size(path)[:2] == SHAPE[::-1]
    webcam = Webcam(
        id="w", latitude_deg=46.0, longitude_deg=8.0, height_m=900.0, projection="perspective", width_px=SHAPE[1],
        height_px=SHAPE[0], horizontal_fov_deg=60.0, heading_deg=0.0, time_zone="UTC",
    )  # fmt: skip
    row = ManifestRow("w", datetime(2024, 6, 1, tzinfo=UTC), path.name)
    assert check_pictures([row], tmp_path, [webcam], decode=True) == []


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_are_kept(tmp_path, suffix):
    levels = landscape().astype(np.uint16) * 257 + 100
    path = tmp_path / f"deep{suffix}"
    cv2.imwrite(str(path), levels[..., ::-1])
    np.testing.assert_array_equal(read_image_srgb(path), levels)
    np.testing.assert_allclose(read_image_linear(path), linear_from_srgb(levels / 65535.0), rtol=1e-5)
    np.testing.assert_array_equal(read_image_srgb8(path), landscape())
    cv2.imwrite(str(path), levels[..., 0])
    np.testing.assert_array_equal(read_image_srgb(path)[..., 2], levels[..., 0])


def test_grey_palettes_and_alpha_are_colours_too(tmp_path):
    grey = Image.fromarray(landscape()[..., 0])
    for name, picture in (("L", grey), ("LA", grey.convert("LA")), ("1", grey.convert("1"))):
        picture.save(tmp_path / "a.png")
        np.testing.assert_array_equal(
            read_image_srgb(tmp_path / "a.png")[..., 1], np.asarray(picture.convert("L")), name
        )
    Image.fromarray(landscape()).quantize(256).save(tmp_path / "p.png")
    assert np.abs(read_image_srgb(tmp_path / "p.png").astype(int) - landscape()).mean() < 3
    Image.fromarray(landscape()).convert("RGBA").save(tmp_path / "rgba.png")
    np.testing.assert_array_equal(read_image_srgb(tmp_path / "rgba.png"), landscape())


# Columns are the red, green and blue primaries of Adobe RGB (1998) and sRGB in XYZ under D50 (Lindbloom).
ADOBE_RGB = np.array(
    [[0.6097559, 0.2052401, 0.1492240], [0.3111242, 0.6256560, 0.0632197], [0.0194811, 0.0608902, 0.7448387]]
)
SRGB = np.array(
    [[0.4360747, 0.3850649, 0.1430804], [0.2225045, 0.7168786, 0.0606169], [0.0139322, 0.0971045, 0.7141733]]
)


def matrix_profile(primaries, gamma, name):
    """An ICC version 2 profile of three primaries and a gamma (ICC.1:2001-04, 6.3)."""
    fixed = lambda values: np.round(np.asarray(values) * 65536).astype(">i4").tobytes()  # noqa: E731
    text = name.encode()
    tags = {b"desc": b"desc" + bytes(4) + struct.pack(">I", len(text) + 1) + text + bytes(1 + 78)}
    tags |= {b"cprt": b"text" + bytes(4) + b"none\0", b"wtpt": b"XYZ " + bytes(4) + fixed([0.9642, 1.0, 0.8249])}
    for channel, column in zip("rgb", primaries.T, strict=True):
        tags[f"{channel}XYZ".encode()] = b"XYZ " + bytes(4) + fixed(column)
        tags[f"{channel}TRC".encode()] = b"curv" + bytes(4) + struct.pack(">IH", 1, round(gamma * 256))
    table, body = struct.pack(">I", len(tags)), b""
    for tag, data in tags.items():
        table += tag + struct.pack(">II", 128 + 4 + 12 * len(tags) + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    header = bytearray(128)
    header[:4] = struct.pack(">I", 128 + len(table) + len(body))
    header[8:24] = bytes([2, 16, 0, 0]) + b"mntrRGB XYZ "
    header[36:40], header[68:80] = b"acsp", fixed([0.9642, 1.0, 0.8249])
    return bytes(header) + table + body


@pytest.mark.parametrize("deep", [False, True])
def test_an_embedded_profile_is_converted_to_srgb_and_told(tmp_path, caplog, deep):
    caplog.set_level(logging.INFO)
    profile, levels = matrix_profile(ADOBE_RGB, 2.19921875, "Adobe RGB (1998)"), landscape()
    path = tmp_path / "a.tif"
    if deep:
        options = {"photometric": "rgb", "extratags": [(34675, "B", len(profile), profile, True)]}
        tifffile.imwrite(path, levels.astype(np.uint16) * 257, **options)
    else:
        Image.fromarray(levels).save(path, icc_profile=profile)
    linear = (levels / 255.0) ** 2.19921875 @ (np.linalg.inv(SRGB) @ ADOBE_RGB).T
    expected = 255.0 * srgb_from_linear(linear)
    assert np.abs(expected - levels).max() > 20
    assert np.abs(read_image_srgb(path) - expected).max() < 2.5
    assert "converted to sRGB from Adobe RGB (1998)" in caplog.text
    assert ("8 of its 16 bits" in caplog.text) == deep
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(levels).save(tmp_path / "s.png", icc_profile=srgb)
    np.testing.assert_array_equal(read_image_srgb(tmp_path / "s.png"), levels)


def test_printing_inks_without_a_profile_are_told_to_be_a_guess(tmp_path, caplog):
    Image.fromarray(landscape()).convert("CMYK").save(tmp_path / "c.tif")
    assert np.abs(read_image_srgb(tmp_path / "c.tif").astype(int) - landscape()).max() <= 1
    assert "(CMYK) and without a colour profile" in caplog.text


def test_a_damaged_profile_is_told(tmp_path, caplog):
    Image.fromarray(landscape()).save(tmp_path / "d.png", icc_profile=b"no profile at all")
    np.testing.assert_array_equal(read_image_srgb(tmp_path / "d.png"), landscape())
    assert "colour profile is damaged" in caplog.text


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.6, 0.95])
def test_a_truncated_picture_is_refused_and_never_half_read(tmp_path, suffix, share):
    noise = np.random.default_rng(0).integers(0, 255, (64, 96, 3), np.uint8)
    held = io.BytesIO()
    Image.fromarray(noise).save(held, format={".jpg": "JPEG", ".tif": "TIFF"}.get(suffix, suffix[1:].upper()))
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(held.getvalue()[: int(share * len(held.getvalue()))])
    with pytest.raises(UnreadableImage, match=rf"cut\{suffix}: not a readable picture"):
        read_image_srgb(path)
    with pytest.raises(InputError, match=r"--picture: .*not a readable picture"):
        read_picture(path, "--picture")


def test_a_picture_that_declares_an_absurd_size_is_refused_by_its_header(tmp_path):
    header = b"P6\n60000 60000\n255\n"
    (tmp_path / "bomb.ppm").write_bytes(header)
    for read in (read_image_srgb, picture_size):
        with pytest.raises(UnreadableImage, match=r"bomb.ppm: the picture is too large"):
            read(tmp_path / "bomb.ppm")


def test_files_that_run_programs_are_no_photographs(tmp_path):
    (tmp_path / "a.eps").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\nshowpage\n")
    with pytest.raises(UnreadableImage, match="not a readable picture; expected JPEG, PNG"):
        read_image_srgb(tmp_path / "a.eps")
