"""A real place's photograph loses its light: by command, by what the scene file states, and with a sun that is found."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import rasterio
from command_line import command
from scipy.ndimage import map_coordinates

import seasonscapes as ss
from seasonscapes.albedo.forward_model import ambient_on_texels, sun_on_texels, trace_texel_transport
from seasonscapes.errors import NotEnoughEvidence
from seasonscapes.frames import direction_from_angles, enu_from_geodetic
from seasonscapes.images import srgb_from_linear
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.hosek import hosek_illumination
from seasonscapes.scene import read_scene
from seasonscapes.sky.illumination import Illumination
from seasonscapes.terrain.crs import apply_affine
from seasonscapes.terrain.raster import geodetic_from_map
from seasonscapes.terrain.surface import Raster
from seasonscapes.terrain.synthetic import alpine_albedo, alpine_massif
from seasonscapes.workflows.delighting import delit_imagery

SUN_DEG = (150.0, 38.0)
SCENE = """name = "photographed"
attribution = "made by a test"
vertical_datum = "local"

[elevation]
file = "dem.tif"

[imagery]
file = "photograph.tif"
reflectance_scale = 0.9
"""


@dataclass(frozen=True)
class Case:
    """A place with its photograph on disk, and its true albedo in the place's texture."""

    folder: Path
    scene: Path
    place: ss.Place
    truth: np.ndarray

    def error(self, albedo: np.ndarray) -> float:
        """Median relative error of an albedo, three texels inside the rim."""
        inside = (slice(3, -3), slice(3, -3))
        return float(np.median(np.abs(albedo[inside] / self.truth[inside] - 1.0)))


def write(path: Path, values: np.ndarray, like: Raster) -> None:
    """A GeoTIFF ``(H, W, C)``."""
    rows, columns, count = values.shape
    profile = {"driver": "GTiff", "height": rows, "width": columns, "count": count, "dtype": values.dtype}
    with rasterio.open(path, "w", crs=like.crs, transform=like.transform, **profile) as file:
        file.write(values.transpose(2, 0, 1))


def photograph(place: ss.Place, albedo: np.ndarray, light: Illumination, transport) -> np.ndarray:
    """8-bit photograph ``(H, W, 3)`` on the grid of the heights; white is level ground of reflectance 0.9."""
    total = sun_on_texels(transport, light) + ambient_on_texels(transport, light, albedo)
    shown = total.reshape(albedo.shape) * albedo / (0.9 * light.global_horizontal_lx)
    raster = place.elevation
    rows, columns = raster.values.shape[:2]
    column, row = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    x, y = apply_affine(raster.transform, column.ravel(), row.ravel())
    latitude, longitude = geodetic_from_map(raster.crs, x, y)
    east_north = enu_from_geodetic(place.frame, latitude, longitude, raster.values.ravel())[:, :2]
    plan = np.c_[place.terrain.vertices[:, :2], np.ones(len(place.terrain.vertices))].astype(float)
    affine = np.linalg.lstsq(plan, place.terrain.uv.astype(float), rcond=None)[0]
    uv = np.c_[east_north, np.ones(len(east_north))] @ affine
    at = [(1.0 - uv[:, 1]) * albedo.shape[0] - 0.5, uv[:, 0] * albedo.shape[1] - 0.5]
    linear = np.stack([map_coordinates(shown[..., k], at, order=1, mode="nearest") for k in range(3)], axis=1)
    return np.rint(255.0 * srgb_from_linear(linear)).astype(np.uint8).reshape(rows, columns, 3)


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    folder = tmp_path_factory.mktemp("photographed")
    massif = alpine_massif(seed=11, size_m=7920.0, spacing_m=60.0)
    write(folder / "dem.tif", massif.elevation.values, massif.elevation)
    write(folder / "truth.tif", np.asarray(alpine_albedo(massif, 254), np.float32), massif.elevation)
    linear = 'encoding = "linear"\nfull_scale = 1.0\n'
    (folder / "truth.toml").write_text(
        SCENE.replace("photograph.tif", "truth.tif").replace("0.9", "1.0") + linear + "delit = true\n"
    )
    place = ss.load_place(folder / "truth.toml", options=ss.MeshOptions(texel_m=60.0))
    truth = ss.scene_albedo(place, "2024-09-10").values
    sampling = SamplingOptions(shadow_samples=1, rays=64, clusters_per_receiver=32, clusters=1024, rank=16)
    transport = trace_texel_transport(place.terrain, place.texture_shape, sampling=sampling)
    suns = {"photograph": SUN_DEG, "afternoon": (240.0, 28.0)}
    for name, angles in suns.items():
        light = hosek_illumination(direction_from_angles(*angles), shape=(64, 128))
        write(folder / f"{name}.tif", photograph(place, truth, light, transport), massif.elevation)
    scene = folder / "photographed.toml"
    scene.write_text(SCENE)
    return Case(folder, scene, place, truth)


def test_the_command_takes_the_light_out_and_its_file_is_an_albedo(case, tmp_path, capsys):
    output = tmp_path / "albedo.npz"
    command("delight", case.scene, sun="150,38", sky="hosek", texel_m=60, output=output, json=True)
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    place = ss.load_place(case.scene, options=ss.MeshOptions(texel_m=60.0))
    albedo = ss.load_albedo(place, output, "2024-09-10").load()
    lit = np.clip(ss.scene_albedo(place, "2024-09-10").values, 1e-3, None)
    assert case.error(albedo.values) < 0.075
    assert case.error(lit) > 0.3
    assert record["sun"] == {"azimuth_deg": 150.0, "elevation_deg": 38.0}
    assert 0.0 < record["shaded_share"] < 1.0
    with np.load(output, allow_pickle=False) as stored:
        assert {"values", "weight", "sigma", "source", "visibility", "atlas_id"} <= set(stored.files)


def test_layers_of_the_albedo_come_back_as_albedo(case, tmp_path):
    output = tmp_path / "albedo.exr"
    command("delight", case.scene, sun="150,38", sky="hosek", texel_m=60, output=output)
    place = ss.load_place(case.scene, options=ss.MeshOptions(texel_m=60.0))
    assert case.error(ss.load_albedo(place, output, "2024-09-10").load().values) < 0.08


def test_classes_of_land_are_asked_for_on_the_command_line(case, tmp_path, capsys):
    flags = {"sun": "150,38", "texel_m": 60, "output": tmp_path / "albedo.npz"}
    command("delight", case.scene, sky="hosek", land_classes=3, json=True, **flags)
    output = capsys.readouterr()
    record = json.loads(output.out.splitlines()[-1])
    assert record["land_classes"] == 3
    assert np.shape(record["class_exponents"]) == (3, 3)
    assert "direct light counts by cos^k" in output.err
    # The ground of the case is Lambertian, and stays so.
    assert np.median(record["class_exponents"]) == pytest.approx(1.0, abs=0.25)
    with pytest.raises(ss.InputError, match="--land-classes"):
        command("delight", case.scene, sky="hosek", land_classes=1, **flags)


def test_air_below_a_satellite_takes_its_light_of_the_land_around_with_it(case, tmp_path):
    place = ss.load_place(case.scene, options=ss.MeshOptions(texel_m=60.0))
    albedos = [
        delit_imagery(place, (150.0, 38.0), sensor_height_m=height).texture.values for height in (None, 705_000.0)
    ]
    # Less of what is dark and blue is the ground's own.
    dark = albedos[0].mean(axis=2) < np.percentile(albedos[0].mean(axis=2), 30.0)
    assert albedos[1][dark, 2].mean() < 0.8 * albedos[0][dark, 2].mean()
    contrast = [np.divide(*np.percentile(values[..., 2], [90.0, 10.0])) for values in albedos]
    assert contrast[1] > 1.1 * contrast[0]


def test_a_sun_that_nobody_knows_is_found(case, tmp_path, capsys):
    output = tmp_path / "albedo.png"
    command("delight", case.scene, time="unknown", sky="hosek", texel_m=60, output=output, json=True)
    found = json.loads(capsys.readouterr().out.splitlines()[-1])["found_sun"]
    assert found["azimuth_deg"] == pytest.approx(SUN_DEG[0], abs=5.0)
    assert found["elevation_deg"] == pytest.approx(SUN_DEG[1], abs=4.0)
    assert found["azimuth_sigma_deg"] < 3.0
    place = ss.load_place(case.scene, options=ss.MeshOptions(texel_m=60.0))
    # The picture states what it holds: an albedo of this atlas.
    assert case.error(ss.load_albedo(place, output, "2024-09-10").load().values) < 0.12


def test_a_mosaic_of_two_hours_has_no_single_sun(case, tmp_path):
    with rasterio.open(case.folder / "photograph.tif") as one, rasterio.open(case.folder / "afternoon.tif") as other:
        values, profile = one.read(), one.profile
        half = values.shape[2] // 2
        values[:, :, half:] = other.read()[:, :, half:]
    with rasterio.open(tmp_path / "mosaic.tif", "w", **profile) as file:
        file.write(values)
    output = tmp_path / "albedo.npz"
    with pytest.raises(NotEnoughEvidence, match="cannot be told: no"):
        command(
            "delight", case.scene, time="unknown", image=tmp_path / "mosaic.tif", sky="hosek", texel_m=60, output=output
        )
    assert not output.exists()


def test_a_scene_file_that_states_the_sun_is_used_without_its_light_once_built(case, caplog):
    place = ss.load_place(case.scene, options=ss.MeshOptions(texel_m=60.0))
    stated = case.folder / "stated.toml"
    stated.write_text(SCENE + 'sun_deg = [150.0, 38.0]\nsky = "hosek"\n')
    delit = ss.load_place(stated, options=ss.MeshOptions(texel_m=60.0))
    with caplog.at_level(logging.INFO, logger="seasonscapes"):
        values = ss.scene_albedo(delit, "2024-09-10").values
        again = ss.scene_albedo(delit, "2024-09-10").values
    assert np.array_equal(values, again)
    assert not [line for line in caplog.messages if "stays in the image" in line]
    assert case.error(values) < 0.5 * case.error(np.clip(ss.scene_albedo(place, "2024-09-10").values, 1e-3, None))


def test_a_scene_file_may_ask_for_classes_of_land(case):
    """The same albedo as by the flag; and keys about an hour that is not stated are refused."""
    from seasonscapes.workflows.delighting import delit_imagery

    options = ss.MeshOptions(texel_m=60.0)
    stated = case.folder / "classes.toml"
    stated.write_text(SCENE + 'sun_deg = [150.0, 38.0]\nsky = "hosek"\nland_classes = 3\n')
    in_file = ss.load_place(stated, options=options)
    by_flag = delit_imagery(ss.load_place(case.scene, options=options), (150.0, 38.0), sky="hosek", land_classes=3)
    assert by_flag.facts["land_classes"] == 3
    np.testing.assert_allclose(ss.scene_albedo(in_file, "2024-09-10").values, by_flag.texture.values, atol=1e-6)
    for line, said in {
        "land_classes = 3": "'land_classes' is about the light of the image's hour",
        "sun_deg = [150.0, 38.0]\nland_classes = 1": "land_classes: got 1, expected 2 to 20",
        "sun_deg = [150.0, 38.0]\nland_classes = 40": "land_classes",
    }.items():
        stated.write_text(SCENE + line + "\n")
        with pytest.raises(ss.InputError, match=said):
            ss.load_place(stated, options=options)


def test_that_the_light_stays_in_is_told_once(case, caplog):
    copy = case.folder / "copy.tif"
    copy.write_bytes((case.folder / "photograph.tif").read_bytes())
    scene = case.folder / "copy.toml"
    scene.write_text(SCENE.replace("photograph.tif", "copy.tif"))
    place = ss.load_place(scene, options=ss.MeshOptions(texel_m=60.0))
    with caplog.at_level(logging.INFO, logger="seasonscapes"):
        ss.scene_albedo(place, "2024-09-10")
        ss.scene_albedo(place, "2024-09-11")
    assert len([line for line in caplog.messages if "copy.tif: the light of its hour stays" in line]) == 1


def test_mistakes_get_their_line(case, tmp_path):
    output = tmp_path / "albedo.npz"
    with pytest.raises(ss.InputError, match="either --time"):
        command("delight", case.scene, output=output)
    with pytest.raises(ss.InputError, match="either --time"):
        command("delight", case.scene, time="unknown", sun="150,38", output=output)
    with pytest.raises(ss.InputError, match="--sun: not a direction"):
        command("delight", case.scene, sun="south", output=output)
    bare = case.folder / "bare.toml"
    bare.write_text(SCENE.partition("[imagery]")[0])
    with pytest.raises(ss.InputError, match=r"no image; add a table \[imagery\]"):
        command("delight", bare, sun="150,38", texel_m=60, output=output)
    with pytest.raises(ss.InputError, match="--image: no such file"):
        command("delight", case.scene, sun="150,38", image=tmp_path / "none.tif", texel_m=60, output=output)
    with pytest.raises(ss.InputError, match="--time: no daylight"):
        command("delight", case.scene, time="2024-09-10T01:00Z", sky="clear", texel_m=60, output=output)
    path = case.folder / "both.toml"
    path.write_text(SCENE + 'time = "unknown"\ndelit = true\n')
    with pytest.raises(ss.InputError, match="give one of 'time'"):
        read_scene(path)
    path.write_text(SCENE + 'sky = "hazy"\n')
    with pytest.raises(ss.InputError, match="give 'time' or 'sun_deg'"):
        read_scene(path)
    path.write_text(SCENE + "sun_deg = [150.0, -3.0]\n")
    with pytest.raises(ss.InputError, match="above the horizon"):
        read_scene(path)
    assert not output.exists()
