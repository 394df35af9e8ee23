"""Artefacts are rebuilt after an edit of the code that makes them, and kept after an edit of anything else."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import seasonscapes
from seasonscapes.source_hash import imported_modules, source_hash

ROOT = Path(seasonscapes.__file__).parent
LOAD = "import seasonscapes as ss; print(len(ss.load_place('alpine_small').terrain.faces))"


@pytest.fixture
def copied(tmp_path):
    """A copy of the package and of the bundled scenes, with a workspace of its own."""
    shutil.copytree(ROOT, tmp_path / "seasonscapes", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in ("scenes", "sun_models"):
        if (ROOT.parent / folder).is_dir():
            shutil.copytree(ROOT.parent / folder, tmp_path / folder)
    return tmp_path


def terrains(copied: Path) -> set[str]:
    """Load the place with the copied package; the terrain artefacts in its workspace afterwards."""
    environment = os.environ | {"PYTHONPATH": str(copied), "SEASONSCAPES_WORKSPACE": str(copied / "workspace")}
    done = subprocess.run(
        [sys.executable, "-c", LOAD], cwd=copied, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return {path.name for path in (copied / "workspace").rglob("terrain-*.npz")}


def test_an_edit_of_the_mesher_rebuilds_the_terrain(copied):
    first = terrains(copied)
    assert len(first) == 1
    mesher = copied / "seasonscapes" / "terrain" / "mesh.py"
    source = mesher.read_text()
    mesher.write_text(source + "\n# A remark changes nothing.\n")
    assert terrains(copied) == first
    mesher.write_text(source + "\n_ANOTHER_CONSTANT = 3\n")
    assert len(terrains(copied)) == 2
    mesher.write_text(source)
    assert len(terrains(copied)) == 2
    console = copied / "seasonscapes" / "commands" / "console.py"
    console.write_text(console.read_text() + "\n_ANOTHER_CONSTANT = 3\n")
    assert len(terrains(copied)) == 2


HASH = "from seasonscapes.source_hash import source_hash; print(source_hash('terrain.mesh', 'sky.models'))"


def hash_of(copied: Path, cache: str = "cache") -> str:
    """The hash of two modules by a new process of the copied package, with a folder as the user's home and cache."""
    home = str(copied / cache)
    environment = os.environ | {"PYTHONPATH": str(copied), "HOME": home, "XDG_CACHE_HOME": home}
    done = subprocess.run(
        [sys.executable, "-c", HASH], cwd=copied, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip()


def test_what_is_kept_of_modules_is_that_of_their_files(copied):
    """Kept facts are used, and only as long as file, program and the file of facts itself are what they were."""
    package = copied / "seasonscapes"
    (copied / "a file").write_text("")
    first = hash_of(copied, "a file")
    assert hash_of(copied) == first, "nothing depends on what can be kept"
    (kept,) = (copied / "cache").rglob("modules-*.json")
    assert list(kept.parent.iterdir()) == [kept]
    facts = json.loads(kept.read_text())
    facts["modules"]["terrain.mesh"][1] = "0" * 64
    kept.write_text(json.dumps(facts))
    assert hash_of(copied) != first, "kept facts are used"
    (package / "terrain" / "a_new_module.py").write_text("")
    assert hash_of(copied) == first, "imports depend on which modules there are"
    kept.write_text(kept.read_text()[:-40])
    assert hash_of(copied) == first
    facts = json.loads(kept.read_text())
    facts["modules"]["terrain.mesh"] = facts["modules"]["terrain.mesh"][:1]
    kept.write_text(json.dumps(facts))
    assert hash_of(copied) == first
    # A change that leaves the size as it was, and sets the old time again.
    mesher = package / "terrain" / "mesh.py"
    about, source = mesher.stat(), mesher.read_text()
    number = re.search(r"= (\d)", source)
    mesher.write_text(source[: number.start(1)] + str(9 - int(number[1])) + source[number.end(1) :])
    os.utime(mesher, ns=(about.st_atime_ns, about.st_mtime_ns))
    assert mesher.stat().st_size == about.st_size
    assert hash_of(copied) != first
    mesher.write_text(source)
    assert hash_of(copied) == first


def test_imports_inside_functions_count():
    modules = imported_modules("workflows.place")
    assert {"workflows.terrain_building", "terrain.mesh"} <= modules
    assert not any(module.startswith("commands") for module in modules)


def test_a_module_that_does_not_exist():
    with pytest.raises(ValueError, match=r"terrain\.nowhere"):
        source_hash("terrain.nowhere")


def test_albedo_of_a_view_is_rebuilt_with_the_ground_that_it_was_traced_on():
    from seasonscapes.workflows.relight_session import _COEFFICIENTS_CODE, _VIEW_ALBEDO_CODE

    for code in (_COEFFICIENTS_CODE, _VIEW_ALBEDO_CODE):
        assert {"terrain.amplification", "workflows.nested_images"} <= imported_modules(*code)
