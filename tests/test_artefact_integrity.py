"""What was written is whole, and what is read is what was written: films, frames, built artefacts, files of others."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from seasonscapes.errors import InputError
from seasonscapes.relighting.film import write_video
from seasonscapes.relighting.frame_file import is_whole_frame, load_frame, save_frame
from seasonscapes.workflows.frame_claims import frames_claimed
from seasonscapes.workspace import Workspace, build_once

FILM = """import sys, numpy as np
from pathlib import Path
from seasonscapes.errors import InputError
from seasonscapes.errors import InputError
from seasonscapes.relighting.film import write_video
rng = np.random.default_rng(0)
try:
    write_video(Path(sys.argv[1]), (rng.random((64, 96, 3), np.float32) for _ in range(30)))
except InputError as error:
    sys.exit(f"told: {error}")
"""


def flipped(path: Path, at: float = 0.5) -> None:
    """Change one bit of a file."""
    content = bytearray(path.read_bytes())
    content[int(at * len(content))] ^= 0x10
    path.write_bytes(content)


# --------------------------------------------------------------------------------------------------- films


def test_a_film_that_cannot_be_encoded_is_told_and_leaves_no_file(tmp_path):
    film = tmp_path / "film.mp4"
    small = subprocess.run(
        [sys.executable, "-c", FILM, str(film)],
        capture_output=True,
        text=True,
        # No file may grow beyond 4 kB: the encoder ends as on a full disk.
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)),
    )
    assert small.returncode == 1
    assert small.stderr.startswith("told: ")
    assert "could not be encoded" in small.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_film_keeps_what_was_there_where_its_images_fail(tmp_path):
    def images(count):
        yield from (np.full((8, 8, 3), 0.5, np.float32) for _ in range(count))
        raise KeyboardInterrupt

    film = tmp_path / "film.mp4"
    film.write_bytes(b"yesterday's")
    for count in (0, 1, 3):
        with pytest.raises(KeyboardInterrupt):
            write_video(film, images(count))
    assert film.read_bytes() == b"yesterday's"
    assert list(tmp_path.iterdir()) == [film]


# -------------------------------------------------------------------------------------------------- frames


def test_a_damaged_frame_is_not_taken_for_a_whole_one(tmp_path):
    path = tmp_path / "frame.exr"
    radiance = np.random.default_rng(0).random((24, 32, 3), np.float32) * 4000.0
    save_frame(path, radiance, metered_ev100=12.0, provenance={"scene": "x"})
    assert is_whole_frame(path)
    assert np.allclose(load_frame(path)[0], radiance, rtol=1e-3)
    whole = path.read_bytes()
    for at in np.linspace(0.0, 0.999, 60):
        path.write_bytes(whole)
        flipped(path, at)
        # A bit that no pixel and no field depends on may be another.
        if is_whole_frame(path):
            assert np.array_equal(load_frame(path)[0], load_frame_of(whole, tmp_path))
    for cut in (0, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        assert not is_whole_frame(path)
    assert not is_whole_frame(tmp_path)
    assert not is_whole_frame(tmp_path / "none.exr")


def load_frame_of(content: bytes, folder: Path) -> np.ndarray:
    (folder / "whole.exr").write_bytes(content)
    return load_frame(folder / "whole.exr")[0]


def test_frames_that_another_film_needs_are_left_to_it(tmp_path):
    folder, names = tmp_path / "frames-1", ["a.exr", "b.exr", "c.exr"]
    with frames_claimed(folder, names[:2]) as first, frames_claimed(folder, names[1:]) as second:
        for name in names:
            (folder / name).write_text(name)
        first.sweep()
        assert sorted(path.name for path in folder.glob("*.exr")) == ["b.exr", "c.exr"]
        second.sweep()
        assert not list(folder.glob("*.exr"))
    assert not folder.exists()


def test_the_claim_of_a_killed_film_ends_with_it(tmp_path):
    folder = tmp_path / "frames-1"
    script = (
        "import sys, time; from pathlib import Path; from seasonscapes.workflows.frame_claims import frames_claimed\n"
        "with frames_claimed(Path(sys.argv[1]), ['a.exr']):\n    print('here', flush=True)\n    time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", script, str(folder)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "here\n"
        (folder / "a.exr").write_text("a")
        with frames_claimed(folder, ["a.exr"]) as mine:
            mine.sweep()
            assert (folder / "a.exr").is_file(), "the other one lives"
            process.kill()
            process.wait()
            mine.sweep()
    assert not folder.exists()


# --------------------------------------------------------------------------------------- built artefacts


def built(folder: Path, value: float = 1.0, name: str = "place/thing") -> tuple[np.ndarray, list[str]]:
    """An artefact, and ``["built"]`` where it was made by this call."""
    made: list[str] = []

    def build() -> np.ndarray:
        made.append("built")
        return np.full(1000, value)

    def save(values: np.ndarray, path: Path) -> None:
        np.savez(path, values=values)

    def load(path: Path) -> np.ndarray:
        with np.load(path) as stored:
            return stored["values"]

    found = build_once(
        Workspace(folder), name, {"value": value}, code=("frames",), suffix=".npz", build=build, save=save, load=load
    )
    return found, made


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-200])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def text(path: Path) -> None:
    path.write_text("not an array")


def pickled(path: Path) -> None:
    np.savez(path, values=np.array([{"a": 1}], object))


def other_and_valid(path: Path) -> None:
    np.savez(path, values=np.full(1000, 7.0))


def deep(path: Path) -> None:
    path.write_text("[" * 100_000)


@pytest.mark.parametrize(
    "damage", [cut, empty, text, pickled, other_and_valid, flipped, lambda path: flipped(path, 0.0)]
)
@pytest.mark.parametrize("kind", ["artefact", "manifest"])
def test_a_damaged_artefact_or_manifest_is_told_and_built_again(tmp_path, caplog, damage, kind):
    caplog.set_level("INFO")
    assert built(tmp_path)[1] == ["built"]
    assert built(tmp_path)[1] == []
    path = next((tmp_path / "place").glob("*.npz" if kind == "artefact" else "*.json"))
    damage(path)
    values, made = built(tmp_path)
    np.testing.assert_array_equal(values, 1.0)
    # A flipped bit of a manifest may lie in what only people read.
    assert made == ["built"] or (kind == "manifest" and damage not in (cut, empty, text))
    assert [record.message for record in caplog.records if "is built again" in record.message] or not made
    assert built(tmp_path)[1] == []


def test_the_files_of_another_artefact_are_not_believed(tmp_path):
    built(tmp_path, 1.0)
    built(tmp_path, 2.0)
    one, two = sorted((tmp_path / "place").glob("*.npz"))
    for suffix in ("", ".json"):
        (two.parent / (two.name + suffix)).write_bytes((one.parent / (one.name + suffix)).read_bytes())
    for value in (1.0, 2.0):
        np.testing.assert_array_equal(built(tmp_path, value)[0], value)


@pytest.mark.parametrize("suffix", [".npz", ".npz.json"])
def test_a_folder_in_the_place_of_an_artefact_is_named(tmp_path, suffix):
    built(tmp_path)
    path = next((tmp_path / "place").glob(f"*{suffix}"))
    path.unlink()
    path.mkdir()
    (path / "mine.txt").write_text("precious")
    with pytest.raises(InputError, match="a folder stands where a built file belongs"):
        built(tmp_path)
    assert (path / "mine.txt").is_file()


def test_daylight_coefficients_are_compared_with_what_was_written(tmp_path):
    import shutil

    from seasonscapes.errors import DamagedFile
    from seasonscapes.rendering import coefficients_file
    from seasonscapes.rendering.hemisphere_rays import SurfacePoints

    names = SurfacePoints.__dataclass_fields__
    points = SurfacePoints(*(np.arange(12.0, dtype=np.float32).reshape(4, 3) for _ in names))
    coefficients_file.save_coefficients(tmp_path / "whole", points, key="k")
    coefficients_file.load_coefficients(tmp_path / "whole", key="k")
    for name in [path.name for path in (tmp_path / "whole").iterdir()]:
        for damage in (flipped, cut, empty, deep, Path.unlink):
            shutil.copytree(tmp_path / "whole", tmp_path / "copy", dirs_exist_ok=True)
            damage(tmp_path / "copy" / name)
            expected = FileNotFoundError if name == "coefficients.json" and damage is Path.unlink else DamagedFile
            try:
                coefficients_file.load_coefficients(tmp_path / "copy", key="k")
            except expected:
                continue
            # A bit within the text of the record that says nothing about the arrays, such as a blank.
            assert name == "coefficients.json"
            assert damage is flipped


# ------------------------------------------------------------------------------------- files of others


@pytest.mark.parametrize("damage", [cut, empty, text, pickled, flipped, deep])
def test_a_texture_that_is_none_has_its_line(tmp_path, damage):
    from seasonscapes.terrain.surface import Texture, load_texture, save_texture

    path = tmp_path / "albedo.npz"
    values = np.random.default_rng(0).random((40, 50, 3), np.float32)
    save_texture(Texture(values), path)
    np.testing.assert_array_equal(load_texture(path).values, values)
    damage(path)
    with pytest.raises(InputError, match="not a texture") as error:
        load_texture(path)
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="no such file"):
        load_texture(tmp_path / "none.npz")


@pytest.mark.parametrize(
    "arrays",
    [
        {"values": np.zeros((4, 5, 3), np.float32)},
        {"values": np.zeros((4, 5), np.float32), "weight": np.zeros((4, 5), np.float32)},
        {"values": np.zeros((4, 5, 3), np.uint8), "weight": np.zeros((4, 5), np.float32)},
        {"values": np.array(["a"]), "weight": np.array(["b"])},
        {"values": np.zeros((4, 5, 3), np.float32), "weight": np.full((4, 5), np.nan, np.float32)},
    ],
)
def test_arrays_that_are_no_texture_are_refused(tmp_path, arrays):
    from seasonscapes.terrain.surface import load_texture

    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(InputError, match="not a texture"):
        load_texture(tmp_path / "a.npz")


@pytest.mark.parametrize("kind", ["pickle", "torch", "cut", "text", "empty", "other"])
def test_lpips_weights_are_plain_tensors(tmp_path, kind):
    import pickle

    torch = pytest.importorskip("torch")
    from seasonscapes.evaluation.lpips import join_lpips, load_lpips

    ran, path = tmp_path / "ran", tmp_path / "alexnet.pth"

    class Evil:
        def __reduce__(self):
            return (Path.touch, (ran,))

    torch.save({"a": torch.zeros(64)}, path)
    if kind == "pickle":
        path.write_bytes(pickle.dumps(Evil()))
    elif kind == "torch":
        torch.save(Evil(), path)
    elif kind != "other":
        {"cut": cut, "text": text, "empty": empty}[kind](path)
    for read in (lambda: join_lpips(path, path, tmp_path / "l.safetensors"), lambda: load_lpips(path)):
        with pytest.raises(InputError) as error:
            read()
        assert "\n" not in str(error.value)
    assert not ran.exists()
    assert not (tmp_path / "l.safetensors").exists()


def test_lpips_weights_that_have_changed_are_refused(tmp_path):
    pytest.importorskip("torch")
    from tiny_diffusion import random_lpips, write_lpips_parts

    from seasonscapes.evaluation.lpips import join_lpips, load_lpips

    join_lpips(*write_lpips_parts(tmp_path, *random_lpips())[:2], tmp_path / "l.safetensors")
    flipped(tmp_path / "l.safetensors")
    with pytest.raises(InputError, match=r"l\.safetensors: damaged"):
        load_lpips(tmp_path / "l.safetensors")


def test_a_model_of_gaussians_is_compared_with_what_was_written(tmp_path):
    pytest.importorskip("torch")
    from safetensors.numpy import save_file

    from seasonscapes.gaussians.model import FORMAT, content_digest, load_model

    tensors = {"taken": np.array([255], np.uint8), "height": np.zeros(8, np.uint16)}

    def written(facts: str, **changed: str) -> Path:
        metadata = {"format": FORMAT, "facts": facts, "sha256": content_digest(tensors, facts)} | changed
        save_file(tensors, tmp_path / "m.safetensors", metadata=metadata)
        return tmp_path / "m.safetensors"

    plan = '{"plan": {"west_m": 0, "north_m": 0, "east_step_m": 1, "north_step_m": 1, "columns": %s, "rows": 2}, "height": [0, 1]}'
    # Whole by its checksum, but no model.
    for facts in ("{}", "[]", "7", "[" * 100_000, plan % 4, plan % -4, plan % 10**9, plan % '"4"'):
        with pytest.raises(InputError, match="not a Gaussian model") as error:
            load_model(written(facts))
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="damaged"):
        load_model(written("{}", sha256="0" * 64))
    path = written(plan % 4)
    whole = path.read_bytes()
    for at in np.linspace(0.0, 0.9999, 40):
        path.write_bytes(whole)
        flipped(path, at)
        with pytest.raises(InputError, match=r"damaged|not a safetensors|not a Gaussian model"):
            load_model(path)


@pytest.mark.slow
def test_a_workspace_whose_every_file_is_damaged_is_built_again(tmp_path, capsys, request):
    """The same picture from a workspace of which all files were changed or cut short."""
    import places
    from few_rays import trace_few_rays

    from seasonscapes.cli import main
    from seasonscapes.images import read_exr

    request.addfinalizer(trace_few_rays())
    scene = places.write_place(tmp_path / "scene")
    arguments = ["render", str(scene), "--time", "2024-07-20T13:00", "--sky", "hosek", "--size", "32x24"]
    arguments += ["--texel-m", "100", "--refine", "1", "--workspace", str(tmp_path / "work")]
    pictures = []
    for number, damage in enumerate((None, flipped, cut)):
        files = [path for path in (tmp_path / "work").rglob("*") if path.is_file() and path.stat().st_size > 400]
        for path in files if damage is not None else ():
            damage(path)
        assert main([*arguments, "-o", str(tmp_path / f"{number}.exr")]) == 0, capsys.readouterr().err
        told = capsys.readouterr().err
        assert (damage is None) == ("again" not in told)
        pictures.append(read_exr(tmp_path / f"{number}.exr")[0][""])
    for picture in pictures[1:]:
        np.testing.assert_array_equal(picture, pictures[0])


def test_photographs_of_the_workspace_are_compared_with_what_was_written(tmp_path, caplog):
    from seasonscapes.workflows.synthetic_photographs import _SUMS, _remove_changed
    from seasonscapes.workspace import file_hash

    caplog.set_level("INFO")
    names = ["a.png", "a_calibration.json", "later.png"]
    for name in names:
        (tmp_path / name).write_text(name)
    (tmp_path / _SUMS).write_text(json.dumps({name: file_hash(tmp_path / name) for name in names[:2]}))
    _remove_changed(tmp_path)
    assert all((tmp_path / name).is_file() for name in names)
    flipped(tmp_path / names[1])
    _remove_changed(tmp_path)
    assert [name for name in names if (tmp_path / name).is_file()] == ["a.png", "later.png"]
    assert "is made again" in caplog.text
    (tmp_path / _SUMS).write_text("{")
    _remove_changed(tmp_path)
    assert not any((tmp_path / name).is_file() for name in names)


def test_keys_hold_the_sources_of_a_mosaic_the_world_file_the_sky_the_albedo_and_the_cameras(tmp_path):
    """Terrain, image and the checkpoint of a distillation follow the content of every file that they are made of."""
    from datetime import date

    import places
    from test_confinement import vrt

    from seasonscapes.albedo.seasons import DatedAlbedo
    from seasonscapes.sky.models import read_sky_model
    from seasonscapes.workflows.albedo_sources import dated_albedos
    from seasonscapes.workflows.distillation import DistilOptions, _data_key, near_cameras
    from seasonscapes.workflows.place import MeshOptions, load_place

    scene = places.write_place(tmp_path / "scene", places.SCENE.replace('file = "dem.tif"', 'file = "mosaic.vrt"'))
    (scene.parent / "mosaic.vrt").write_text(vrt("dem.tif"))
    options = MeshOptions(texel_m=100.0, refine=1, max_error_m=20.0)

    def load():
        return load_place(scene, Workspace(tmp_path / "work"), options=options)

    def key(place, sky="hosek", albedo=(), **changed):
        options = DistilOptions(**changed)
        return _data_key(place, read_sky_model(sky), albedo, options, near_cameras(place, options))

    first = load()
    own = DatedAlbedo(date(2024, 7, 1), "recovered", lambda: None)
    keys = [key(first), key(first, sky="clear"), key(first, albedo=[own]), key(first, suns=9)]
    image = dated_albedos(first)[0].content
    unmoved, unseen = scene.read_text(), key(first, disc_px=0.0)
    scene.write_text(unmoved.replace("heading_deg = 0.0", "heading_deg = 9.0"))
    turned = load()
    keys.append(key(turned))
    assert key(turned, disc_px=0.0) == unseen, "discs of one size follow no camera"
    scene.write_text(unmoved)
    places.write_raster(scene.parent / "dem.tif", places.hill_heights() + 300.0, spacing_m=50.0)
    higher = load()
    assert np.isclose(higher.elevation.values.max(), first.elevation.values.max() + 300.0)
    assert higher.terrain.vertices[:, 2].max() > first.terrain.vertices[:, 2].max() + 200.0
    keys.append(key(higher))
    (scene.parent / "image.tif.aux.xml").write_text("<PAMDataset><Metadata/></PAMDataset>")
    keys.append(key(load()))
    assert dated_albedos(load())[0].content != image
    assert len(set(keys)) == 7
