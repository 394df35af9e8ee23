"""Files on disk, exposure, tone curve."""

import json

import colour
import cv2
import numpy as np
import pytest

from seasonscapes.errors import UnreadableImage
from seasonscapes.images import (
    atomic_path,
    auto_exposure_ev100,
    expose,
    linear_from_srgb,
    read_exr,
    read_image_linear,
    scaled_pixels,
    srgb_from_linear,
    tone_curve,
    write_exr,
    write_png,
    write_png8,
)


def test_srgb_agrees_with_colour_science():
    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(srgb_from_linear(values), colour.models.eotf_inverse_sRGB(values), atol=1e-7)
    np.testing.assert_allclose(linear_from_srgb(srgb_from_linear(values)), values, atol=2e-6)


@pytest.mark.parametrize("shape", [(), (7,), (5, 4), (2, 3, 4), (0,), (3, 0)])
def test_scaled_pixels_are_those_of_broadcasting(shape):
    rng = np.random.default_rng(0)
    image, factor = rng.random((*shape, 3), np.float32), rng.random(shape, np.float32)
    np.testing.assert_array_equal(scaled_pixels(image, factor), image * factor[..., None])


def test_exr_round_trip(tmp_path):
    rng = np.random.default_rng(0)
    layers = {
        "": rng.random((5, 7, 3), np.float32) * 1e5,
        "normal": rng.random((5, 7, 3), np.float32),
        "uv": rng.random((5, 7, 2), np.float32),
        "depth": np.full((5, 7), np.inf, np.float32),
        "alpha": rng.random((5, 7), np.float32),
    }
    path = tmp_path / "a.exr"
    write_exr(path, layers, header={"latitude": 46.5, "capDate": "2024:09:01 10:00:00", "camera": {"fx": 1000.25}})
    found, header = read_exr(path)
    assert found.keys() == layers.keys()
    for name, values in layers.items():
        np.testing.assert_array_equal(found[name], values)
    assert header["latitude"] == pytest.approx(46.5)
    assert json.loads(header["camera"]) == {"fx": 1000.25}


def test_png_round_trip_with_metadata(tmp_path):
    from PIL import Image

    values = np.linspace(0, 1, 64 * 64 * 3).reshape(64, 64, 3).astype(np.float32)
    path = tmp_path / "deep" / "a.png"
    write_png(path, values, metadata={"seasonscapes": "{}"})
    assert Image.open(path).text["seasonscapes"] == "{}"
    assert np.abs(srgb_from_linear(read_image_linear(path)) - srgb_from_linear(values)).max() <= 1.01 / 255
    assert list(path.parent.iterdir()) == [path]


def test_png_declares_its_colours_to_be_srgb(tmp_path):
    """Read back by Pillow, chunk by chunk; a grey mask is declared nothing."""
    from PIL import Image

    write_png(tmp_path / "a.png", np.full((4, 6, 3), 0.2))
    with Image.open(tmp_path / "a.png") as image:
        assert image.info["srgb"] == 0
        assert image.info["gamma"] == pytest.approx(1.0 / 2.2, abs=1e-4)
    write_png8(tmp_path / "mask.png", np.zeros((4, 6), np.uint8))
    with Image.open(tmp_path / "mask.png") as image:
        assert "srgb" not in image.info


def test_a_failed_write_leaves_nothing_and_keeps_the_old(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_path(path) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_missing_and_broken_pictures_are_named(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_image_linear(tmp_path / "none.png")
    (tmp_path / "bad.png").write_bytes(b"not a picture")
    with pytest.raises(UnreadableImage, match=r"bad\.png"):
        read_image_linear(tmp_path / "bad.png")
    cv2.imwrite(str(tmp_path / "float.tif"), np.ones((4, 4, 3), np.float32))
    with pytest.raises(UnreadableImage, match=r"float\.tif.*expected .* of 8 or 16 bits"):
        read_image_linear(tmp_path / "float.tif")
    (tmp_path / "bad.exr").write_bytes(b"not a picture")
    with pytest.raises(UnreadableImage, match=r"bad\.exr"):
        read_exr(tmp_path / "bad.exr")


def test_auto_exposure_of_a_sunny_grey_card():
    """18 % grey in 100,000 lx is 5,730 cd/m²: EV 15.5, the sunny-16 rule within half a stop."""
    card = np.full((8, 8, 3), 0.18 / np.pi * 1e5)
    assert auto_exposure_ev100(card) == pytest.approx(15.48, abs=0.01)
    assert auto_exposure_ev100(4 * card) - auto_exposure_ev100(card) == pytest.approx(2.0)
    with pytest.raises(ValueError, match="no positive luminance"):
        auto_exposure_ev100(np.zeros((2, 2, 3)))


def test_tone_curve_is_monotone_neutral_and_keeps_hue():
    grey = np.repeat(np.geomspace(1e-3, 100, 400)[:, None], 3, 1)
    out = tone_curve(grey)
    assert np.all(np.diff(out[:, 0]) > -1e-6)
    np.testing.assert_allclose(out, out[:, :1] * np.ones(3), atol=1e-6)
    assert out.min() >= 0.0
    assert out.max() <= 1.0
    colour_in = np.array([0.30, 0.20, 0.10])
    toned = tone_curve(0.3 * colour_in)
    np.testing.assert_allclose(toned / toned[0], colour_in / colour_in[0], rtol=1e-5)
    bright = tone_curve(40.0 * colour_in)
    assert bright.min() / bright.max() > 0.5, "very bright colours bleed to white"


def test_metered_grey_becomes_middle_grey():
    card = np.full((4, 4, 3), 0.18 / np.pi * 1e5)
    shown = tone_curve(expose(card, auto_exposure_ev100(card)))
    # The meter is calibrated by ISO 2720 (K = 12.5); the curve lifts it to within an eighth of a stop of 18 %.
    np.testing.assert_allclose(np.log2(shown / 0.18), 0.0, atol=0.125)
