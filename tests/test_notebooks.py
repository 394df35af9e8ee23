"""Notebooks: short, paired with a script, of the public interface alone, and they execute on the small place."""

import ast
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import seasonscapes as ss

FOLDER = Path(__file__).parents[1] / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.py"))


def test_all_are_there():
    assert NAMES == [
        "00_tour",
        "01_terrain",
        "02_sky",
        "03_webcams",
        "04_texture",
        "05_albedo",
        "06_relight",
        "07_gaussians",
        "08_inverse_rendering_experiment",
    ]


@pytest.mark.parametrize("name", NAMES)
def test_paired_short_and_clean(name):
    import jupytext
    import nbformat

    script, notebook = jupytext.read(FOLDER / f"{name}.py"), nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    assert [(cell.cell_type, cell.source) for cell in script.cells] == [
        (cell.cell_type, cell.source) for cell in notebook.cells
    ]
    assert len(notebook.cells) <= 15
    assert not any(cell.get("outputs") for cell in notebook.cells), "outputs belong to whoever runs it"
    assert any("plt." in cell.source for cell in notebook.cells)


@pytest.mark.parametrize("name", NAMES)
def test_the_public_interface_alone(name):
    imports, used = [], set()
    for node in ast.walk(ast.parse((FOLDER / f"{name}.py").read_text())):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            imports.append(ast.unparse(node))
        if isinstance(node, ast.Attribute):
            assert not node.attr.startswith("_")
            if isinstance(node.value, ast.Name) and node.value.id == "ss":
                used.add(node.attr)
    assert len(imports) <= 3
    assert [each for each in imports if "seasonscapes" in each] == ["import seasonscapes as ss"]
    assert used <= set(ss.__all__)


@pytest.fixture(scope="module")
def executed():
    """Each notebook as its script, in a process of its own, two at a time: exit code and error."""

    def execute(name: str) -> tuple[int, str]:
        environment = os.environ | {"MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [sys.executable, f"{name}.py"], cwd=FOLDER, env=environment, capture_output=True, text=True, check=False
        )
        return done.returncode, done.stderr

    with ThreadPoolExecutor(2) as pool:
        return dict(zip(NAMES, pool.map(execute, NAMES), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_executes(executed, name):
    code, error = executed[name]
    assert code == 0, error[-3000:]
