"""Notebooks: short, paired with a script, of the public interface alone, and they execute, with less of everything."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import seasonscapes as ss

FOLDER = Path(__file__).parents[1] / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.py"))


# What the tests run with less of: texels, pixels, samples, hours, steps. A text that a file does not hold is stale and fails.
LESS = {
    "small.toml": {"spacing_m = 30.0": "spacing_m = 60.0", "detail_m = 15.0": "detail_m = 60.0"},
    "00_tour.py": {"(384, 256)": "(96, 64)", "spp=16": "spp=4", "dome_picture(light, 400)": "dome_picture(light, 64)"},
    "01_terrain.py": {"[20.0, 10.0, 5.0, 2.0]": "[20.0, 10.0]", "(420, 280)": "(105, 70)"},
    "02_sky.py": {
        "np.arange(11.0, 24.0, 0.5)": "np.arange(11.0, 24.0, 2.0)",
        "dome_picture(light, 300)": "dome_picture(light, 64)",
    },
    "03_webcams.py": {
        "(300, 200)": "(150, 100)",
        "spp=8": "spp=2",
        "(7, 9, 12, 15)": "(7, 9)",
        "subplots(1, 4,": "subplots(1, 2,",
    },
    "04_texture.py": {"texel_m=25.0": "texel_m=90.0", "(210, 140)": "(84, 56)", "spp=32": "spp=4"},
    "05_albedo.py": {
        "texel_m=40.0": "texel_m=120.0",
        "(180, 120)": "(60, 40)",
        "(7, 10, 13, 15)": "(10, 13)",
        "subplots(2, 4,": "subplots(2, 2,",
    },
    "06_relight.py": {
        '"06:00", "08:00", "11:00", "14:00", "16:30", "17:36"': '"08:00", "11:00", "14:00"',
        "subplots(2, 3,": "subplots(1, 3,",
        "(270, 180)": "(90, 60)",
        "spp=64": "spp=4",
        "range(5, 19)": "range(5, 19, 6)",
    },
    "07_gaussians.py": {"suns=8, dates=2": "suns=3, dates=1", "steps=250": "steps=20", "spp=32": "spp=4"},
    "08_inverse_rendering_experiment.py": {"range(60)": "range(4)", "spp=256": "spp=16"},
}


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
def executed(tmp_path_factory):
    """Each notebook as its script, with `LESS`: exit code and error by name."""
    folder = tmp_path_factory.mktemp("notebooks")
    for name in ("small.toml", *(f"{name}.py" for name in NAMES)):
        text = (FOLDER / name).read_text()
        for printed, less in LESS.get(name, {}).items():
            assert printed in text, f"{name} has no {printed}"
            text = text.replace(printed, less)
        (folder / name).write_text(text)
    own = {"MPLBACKEND": "Agg"}
    runner = [sys.executable, str(Path(__file__).with_name("notebook_runner.py")), *NAMES]
    done = subprocess.run(runner, cwd=folder, env=os.environ | own, capture_output=True, text=True)
    records = [json.loads(line) for line in done.stdout.splitlines()]
    # A runner that was killed has no record of the notebook that it was at, nor of those after it.
    killed = dict.fromkeys(NAMES, (done.returncode, done.stderr[-2000:]))
    return killed | {record["name"]: (record["code"], record["stderr"]) for record in records}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_executes(executed, name):
    code, error = executed[name]
    assert code == 0, error[-3000:]
