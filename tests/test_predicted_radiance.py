"""An albedo, relit, tells paint how bright the land is, and inpaint what the hidden texels look like."""

import json

import numpy as np
import pytest
from places import MASSIF

from seasonscapes.cli import main
from seasonscapes.images import atomic_path
from seasonscapes.terrain.surface import Texture, load_texture, save_texture


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a scene, its true albedo of the day as a file, and what the land truly sends then."""
    from datetime import UTC, datetime

    from seasonscapes.workflows.albedo_sources import load_albedo, scene_albedo
    from seasonscapes.workflows.place import MeshOptions, load_place
    from seasonscapes.workflows.predicted_radiance import predict_radiance
    from seasonscapes.workspace import Workspace

    folder = tmp_path_factory.mktemp("expected")
    scene = folder / "little.toml"
    scene.write_text(MASSIF)
    land = load_place(scene, Workspace(folder / "work"), options=MeshOptions(texel_m=60.0))
    utc = datetime(2024, 7, 20, 8, 0, tzinfo=UTC)
    true = scene_albedo(land, utc)
    with atomic_path(folder / "albedo.npz") as temporary:
        save_texture(Texture(true.values, np.ones_like(true.weight)), temporary)
    albedo = load_albedo(land, folder / "albedo.npz", utc.date())
    radiance = predict_radiance(land, albedo, utc, sky="hosek")
    return folder, radiance.values


def _run(folder, capsys, verb: str, *extra: str) -> dict:
    common = [
        str(folder / "little.toml"),
        "--workspace",
        str(folder / "work"),
        "--texel-m",
        "60",
        "--time",
        "2024-07-20T10:00+02:00",
        "--json",
    ]
    assert main([verb, *common, *extra]) == 0
    return json.loads(capsys.readouterr().out)


def test_exposures_are_found(place, capsys):
    folder, true = place
    pictures = ["--synthetic-webcams", "--size", "192x128", "--sky", "hosek"]
    off = {}
    for name, extra in (("skies", []), ("albedo", ["--albedo", str(folder / "albedo.npz")])):
        _run(folder, capsys, "paint", *pictures, *extra, "-o", str(folder / name))
        texture = load_texture(folder / name / "painted.npz")
        seen = texture.weight > 0.05
        ratio = np.log(texture.values[seen] / true[seen])
        off[name] = float(np.abs(np.median(ratio, axis=0)).max())
    assert off["albedo"] < 0.1
    assert off["albedo"] < off["skies"]


def test_hidden_texels_follow_the_albedo(place, capsys):
    folder, true = place
    texture = str(folder / "albedo" / "painted.npz")
    error = {}
    for name, extra in (("relief", ["--fast"]), ("relit", ["--albedo", str(folder / "albedo.npz"), "--sky", "hosek"])):
        record = _run(folder, capsys, "inpaint", "--texture", texture, *extra, "-o", str(folder / f"{name}.npz"))
        assert ("albedo, relit" in record["guides"]) == (name == "relit")
        assert record["method"] == ("fused" if name == "relit" else "guided")
        completed, painted = load_texture(folder / f"{name}.npz"), load_texture(texture)
        hole = (painted.weight == 0.0) & (true > 0.0).all(axis=2)
        error[name] = float(np.median(np.abs(np.log(np.maximum(completed.values[hole], 1e-3) / true[hole]))))
    assert error["relit"] < 0.8 * error["relief"]


def test_another_atlas_is_refused(place, capsys):
    folder, _ = place
    with atomic_path(folder / "wrong.npz") as temporary:
        save_texture(Texture(np.ones((8, 8, 3), np.float32), np.ones((8, 8), np.float32)), temporary)
    assert (
        main(
            [
                "paint",
                str(folder / "little.toml"),
                "--workspace",
                str(folder / "work"),
                "--texel-m",
                "60",
                "--sky",
                "hosek",
                "--time",
                "2024-07-20T11:00+02:00",
                "--synthetic-webcams",
                "--albedo",
                str(folder / "wrong.npz"),
                "-o",
                str(folder / "other"),
            ]
        )
        == 2
    )
    assert "belongs to another atlas" in capsys.readouterr().err
    assert not (folder / "other").exists()
