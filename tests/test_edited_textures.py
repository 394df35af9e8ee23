"""Textures that this program writes, edited elsewhere, come back as albedo; those of another atlas do not."""

import json
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from command_line import command
from PIL import Image
from places import MASSIF

import seasonscapes as ss
from seasonscapes.albedo.standard_error import AlbedoEstimate
from seasonscapes.errors import AtlasMismatch
from seasonscapes.images import linear_from_display, linear_from_srgb, read_exr, tone_curve, write_exr, write_png
from seasonscapes.terrain.surface import Texture, save_texture
from seasonscapes.workflows.albedo_recovery import save_albedo_figures
from seasonscapes.workflows.edited_textures import albedo_date, read_albedo

pytestmark = pytest.mark.usefixtures("few_rays")

TIME = "2024-07-20T13:30"


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("massif") / "little.toml"
    path.write_text(MASSIF)
    return path


@pytest.fixture(scope="module")
def lit(scene) -> dict[str, Path]:
    """The same hour as picture, layers and model."""
    paths = {kind: scene.with_name(f"lit.{kind}") for kind in ("png", "exr", "glb")}
    for path in paths.values():
        command("lit-texture", scene, time=TIME, sky="hosek", rays=16, texel_m=60, output=path)
    return paths


@pytest.fixture(scope="module")
def place(scene):
    return ss.load_place(scene, options=ss.MeshOptions(texel_m=60.0))


@pytest.mark.parametrize("kind", ["png", "exr", "glb"])
def test_light_put_in_is_taken_out(place, lit, kind):
    """The albedo comes back: within 8 bits of a picture, and to rounding from linear values."""
    texture = read_albedo(place, lit[kind])
    truth = ss.scene_albedo(place, "2024-07-20").values
    seen = texture.weight > 0.0
    assert seen.mean() > (0.5 if kind != "exr" else 0.999)
    error = np.abs(texture.values - truth)[seen] / truth[seen]
    assert np.median(error) < (1e-5 if kind == "exr" else 0.02)
    assert np.percentile(error, 95) < (1e-4 if kind == "exr" else 0.1)


def test_an_edit_arrives_where_it_was_made(place, lit, tmp_path):
    """A square painted half as bright in the picture is half as bright in the albedo, and nowhere else."""
    layers, header = read_exr(lit["exr"])
    before = read_albedo(place, lit["exr"]).values
    layers[""][20:30, 40:60] *= 0.5
    own = {key: value for key, value in header.items() if key.startswith("seasonscapes:")}
    path = tmp_path / "edited.exr"
    write_exr(path, {"": layers[""]}, header={key: json.loads(value) for key, value in own.items() if value[:1] == "{"})
    ratio = read_albedo(place, path).values / before
    inside = np.zeros(ratio.shape[:2], bool)
    inside[20:30, 40:60] = True
    np.testing.assert_allclose(ratio[inside], 0.5, rtol=1e-3)
    np.testing.assert_allclose(ratio[~inside], 1.0, rtol=1e-3)


def test_a_picture_without_a_word_is_an_albedo(place, tmp_path):
    """What an editor wrote without metadata, in 16 bits: sRGB reflectance."""
    import cv2

    levels = np.random.default_rng(1).integers(2000, 60000, (*place.texture_shape, 3), np.uint16)
    path = tmp_path / "plain.png"
    cv2.imwrite(str(path), levels[..., ::-1])
    np.testing.assert_allclose(read_albedo(place, path).values, linear_from_srgb(levels / 65535.0), atol=1e-6)
    assert albedo_date(path) is None


def test_render_takes_an_edited_picture(scene, place, tmp_path):
    """Through the command line: a red land."""
    path, out = tmp_path / "red.png", tmp_path / "view.png"
    Image.new("RGB", place.texture_shape[::-1], (200, 30, 30)).save(path)
    albedo = f"2024-07-20={path}"
    command(
        "render", scene, camera="aerial", time=TIME, sky="hosek", texel_m=60, size="32x24", albedo=albedo, output=out
    )
    land = np.asarray(Image.open(out), float)[14:]
    assert (land[..., 0] > 1.5 * land[..., 2]).mean() > 0.9


def test_an_albedo_brings_its_atlas_along(scene, lit, tmp_path):
    """Made with texels of 60 m, it is accepted without saying so again; other texels asked for are refused."""
    out = tmp_path / "view.png"
    common = {"camera": "aerial", "time": TIME, "sky": "hosek", "size": "24x16", "output": out}
    command("render", scene, albedo=f"2024-07-20={lit['png']}", **common)
    assert out.is_file()
    with pytest.raises(AtlasMismatch):
        command("render", scene, albedo=f"2024-07-20={lit['png']}", texel_m=90, **common)


def _figure(place, folder: Path) -> Path:
    from seasonscapes.workflows.edited_textures import texture_facts
    from seasonscapes.workflows.pictures import png_metadata

    path = folder / "sigma.png"
    image = np.full((*place.texture_shape, 3), 0.2)
    write_png(path, image, metadata=png_metadata({"texture": texture_facts(place, "figure")}))
    return path


def _radiance(place, folder: Path) -> Path:
    path = folder / "painted.npz"
    values = np.full((*place.texture_shape, 3), 900.0, np.float32)
    save_texture(Texture(values, values[..., 0], place.atlas_id), path)
    return path


def _size(place, folder: Path) -> Path:
    path = folder / "half.png"
    Image.new("RGB", (100, 50)).save(path)
    return path


def _transparent(place, folder: Path) -> Path:
    path = folder / "holes.png"
    image = Image.new("RGBA", place.texture_shape[::-1], (90, 90, 90, 255))
    image.putpixel((3, 4), (0, 0, 0, 0))
    image.save(path)
    return path


def _nan(place, folder: Path) -> Path:
    path = folder / "nan.exr"
    write_exr(path, {"": np.full((*place.texture_shape, 3), np.nan, np.float32)})
    return path


def _nan_texel(place, folder: Path) -> Path:
    path = folder / "albedo.npz"
    values = np.full((*place.texture_shape, 3), 0.2, np.float32)
    values[3, 4, 1] = np.nan
    save_texture(Texture(values, values[..., 0], place.atlas_id), path)
    return path


def _pickle(place, folder: Path) -> Path:
    path = folder / "albedo.npz"
    np.savez(path, values=np.array([{}], object), weight=np.zeros(1, np.float32))
    return path


def _no_picture(place, folder: Path) -> Path:
    path = folder / "notes.png"
    path.write_text("no picture")
    return path


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (_figure, "is a figure"),
        (_radiance, "holds radiance"),
        (_size, "another atlas"),
        (_transparent, "transparent"),
        (_nan, "not finite"),
        (_nan_texel, "not finite"),
        (_pickle, "never loaded"),
        (_no_picture, "not a readable picture"),
    ],
)
def test_what_is_no_albedo_is_refused_by_name(place, tmp_path, make, said):
    path = make(place, tmp_path)
    with pytest.raises(ss.SeasonscapesError, match=said) as caught:
        read_albedo(place, path)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_picture_of_another_atlas_is_refused(lit, scene):
    """As many texels, laid out otherwise."""
    other = ss.load_place(scene, options=ss.MeshOptions(texel_m=60.0, max_error_m=25.0))
    with pytest.raises(AtlasMismatch, match=r"lit\.png: belongs to another atlas of the same size"):
        read_albedo(other, lit["png"])


def test_light_on_normals_that_a_picture_does_not_hold_is_no_albedo(scene, place, tmp_path, caplog):
    """The light on tilted normals is not that which reading computes; nor does an albedo's picture hold tilts."""
    values = np.full((*place.texture_shape, 3), 0.3, np.float32)
    tilted = Texture(values, values[..., 0], place.atlas_id, np.full_like(values, 0.1))
    save_texture(tilted, tmp_path / "tilted.npz")
    command(
        "lit-texture",
        scene,
        time=TIME,
        sky="hosek",
        rays=16,
        texel_m=60,
        albedo=tmp_path / "tilted.npz",
        output=tmp_path / "lit.exr",
    )
    with pytest.raises(ss.InputError, match=r"lit\.exr: is lit on normals .* --normals") as caught:
        read_albedo(place, tmp_path / "lit.exr")
    assert "\n" not in str(caught.value)
    known = AlbedoEstimate(values, values[..., 0], values[..., 0], np.ones(place.texture_shape, np.uint8))
    for each in (False, True):
        caplog.clear()
        paths = save_albedo_figures(place, known, date(2024, 7, 20), tmp_path / "a.npz", tilted=each)
        texture = read_albedo(place, Path(paths["albedo"]))
        assert texture.tilt is None
        assert ("normals" in caplog.text) == each


def test_developed_values_are_inverted():
    """Up to clipped highlights, whose luminance is gone."""
    scene = np.random.default_rng(3).lognormal(7.0, 1.2, (10_000, 3))
    shown = tone_curve(scene / (1.2 * 2.0**13))
    clear = shown.max(axis=-1) < 0.995
    assert 0.5 < clear.mean() <= 1.0
    np.testing.assert_allclose(linear_from_display(shown, 13.0)[clear], scene[clear], rtol=3e-3)
