"""Artefacts are rebuilt after an edit of the code that makes them, and kept after an edit of anything else."""

import os
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
