"""The design holds: imports follow the contracts of pyproject.toml, and the command line starts quickly."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OUTSIDE = [path for folder in ("tests", "benchmarks", "notebooks", "tools") for path in (ROOT / folder).rglob("*.py")]


def imported(path: Path) -> set[str]:
    """Every module that a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def contracts(folder: Path) -> subprocess.CompletedProcess[str]:
    linter = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    env = os.environ | {"PYTHONPATH": str(folder)}
    return subprocess.run(linter, cwd=folder, env=env, capture_output=True, text=True)


@pytest.fixture
def copied_package(tmp_path) -> Path:
    """A copy of the package's sources with their contracts, to break."""
    for path in [ROOT / "pyproject.toml", *(ROOT / "seasonscapes").rglob("*.py")]:
        copy = tmp_path / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(path.read_text())
    return tmp_path


@pytest.mark.parametrize(
    ("module", "line", "contract"),
    [
        ("sky/models.py", "import seasonscapes.rendering.radiance", "Imports point to lower layers"),
        ("workflows/place.py", "from seasonscapes import commands", "Only the command line imports commands"),
        ("terrain/surface.py", "import mitsuba", "Mitsuba and Dr.Jit"),
        ("workflows/paint.py", "import torch", "PyTorch"),
        ("workspace.py", "import distributed", "Dask"),
        ("workflows/fetching.py", "import requests", "The network"),
    ],
)
def test_a_forbidden_import_breaks_a_contract(copied_package, module, line, contract):
    path = copied_package / "seasonscapes" / module
    path.write_text((path.read_text() if path.exists() else "") + f"\n{line}\n")
    checked = contracts(copied_package)
    assert checked.returncode != 0
    assert any(contract in said and "BROKEN" in said for said in checked.stdout.splitlines()), checked.stdout


def test_imports_follow_the_contracts():
    checked = contracts(ROOT)
    assert checked.returncode == 0, checked.stdout


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda path: str(path.relative_to(ROOT)))
def test_nobody_outside_imports_commands(path):
    assert not [name for name in imported(path) if name.split(".")[:2] == ["seasonscapes", "commands"]]


def test_help_is_quick():
    """Within half a second of processor time, so that a busy machine does not decide; the best of several counts."""

    def cpu_seconds() -> float:
        before = os.times()
        subprocess.run([sys.executable, "-m", "seasonscapes", "--help"], check=True, capture_output=True)
        after = os.times()
        return after.children_user + after.children_system - before.children_user - before.children_system

    assert min(cpu_seconds() for _ in range(5)) < 0.5


HEAVY = {"mitsuba", "drjit", "torch", "rasterio", "scipy", "skyfield", "colour", "cv2", "sklearn", "trimesh", "numpy"}


@pytest.mark.parametrize(
    "code",
    ["from seasonscapes.cli import main\ntry:\n main(['--help'])\nexcept SystemExit: pass", "import seasonscapes"],
)
def test_starting_loads_nothing_heavy(code):
    report = "\nimport sys\nprint(sorted(sys.modules), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code + report], check=True, capture_output=True, text=True)
    assert not set(ast.literal_eval(done.stderr.strip().splitlines()[-1])) & HEAVY
