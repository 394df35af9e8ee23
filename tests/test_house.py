"""The house stands: floors, circles, walls, and a quick front door."""

import ast
import graphlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "seasonscapes"
# Lowest first; a module may import from its own floor or from below.
FLOORS = [
    ("words", {"errors", "declaration", "frames", "images", "exposure", "bundled", "civil_time", ""}),
    ("sky", {"sky"}),
    ("nouns", {"scene", "terrain", "cameras"}),
    ("wall", {"rendering"}),
    ("stages", {"calibration", "texturing", "albedo", "relighting", "gaussians", "evaluation"}),
    (
        "street",
        {
            "workspace",
            "pipeline",
            "daylight",
            "studio",
            "ledger",
            "cluster",
            "viewer",
            "annotator",
            "commands",
            "cli",
            "__main__",
        },
    ),
]
WALLS = {
    "mitsuba": {"rendering", "albedo"},
    "drjit": {"rendering", "albedo"},
    "torch": {"gaussians", "texturing.diffusion", "evaluation.lpips"},
    "dask": {"cluster"},
    "distributed": {"cluster"},
    "dask_jobqueue": {"cluster"},
    "viser": {"viewer", "annotator"},
    "diffusers": {"texturing.diffusion"},
}


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def imports(path: Path) -> set[str]:
    """Every module that a file imports, wherever in it; type-checking imports too, as they bind the design."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            module = node.module or ""
            inner = {f"{module}.{alias.name}" for alias in node.names}
            found |= {name for name in inner if (ROOT / (name.replace(".", "/") + ".py")).exists()} or {module}
    return found


MODULES = {module_name(path): imports(path) for path in sorted(PACKAGE.rglob("*.py"))}


def floor_of(module: str) -> int:
    room = module.split(".")[0]
    for index, (_, rooms) in enumerate(FLOORS):
        if room in rooms:
            return index
    raise AssertionError(f"{module} has no floor: give its room one in ARCHITECTURE.md and here")


def own(name: str) -> str | None:
    return name.removeprefix("seasonscapes").removeprefix(".") if name.split(".")[0] == "seasonscapes" else None


def test_imports_point_down():
    for module, names in MODULES.items():
        for name in filter(None, map(own, names)):
            assert floor_of(name) <= floor_of(module), f"{module} imports {name} from a floor above"


def test_stages_do_not_call_later_stages():
    order = ["calibration", "texturing", "albedo", "relighting", "gaussians", "evaluation"]
    for module, names in MODULES.items():
        room = module.split(".")[0]
        for other in {name.split(".")[0] for name in filter(None, map(own, names))} & set(order):
            if room in order:
                assert order.index(other) <= order.index(room), f"{module} calls the later stage {other}"


def test_no_circles():
    graph = {
        module: {o for o in map(own, names) if o is not None and o in MODULES and o != module}
        for module, names in MODULES.items()
    }
    graphlib.TopologicalSorter(graph).prepare()


@pytest.mark.parametrize("library", WALLS)
def test_walls(library):
    for module, names in MODULES.items():
        if any(name.split(".")[0] == library for name in names):
            room = module.split(".")[0]
            assert room in WALLS[library] or module in WALLS[library], f"{module} imports {library} behind its wall"


def test_help_is_quick():
    """Within half a second, in processor time, so that a busy machine does not decide; the best of several counts."""

    def cpu_seconds() -> float:
        before = os.times()
        subprocess.run([sys.executable, "-m", "seasonscapes", "--help"], check=True, capture_output=True)
        after = os.times()
        return after.children_user + after.children_system - before.children_user - before.children_system

    assert min(cpu_seconds() for _ in range(5)) < 0.5


def test_help_loads_nothing_heavy():
    code = "import sys; from seasonscapes.cli import main\ntry:\n main(['--help'])\nexcept SystemExit: pass\nprint(sorted(sys.modules), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    loaded = set(ast.literal_eval(done.stderr.strip().splitlines()[-1]))
    assert not loaded & {
        "mitsuba",
        "drjit",
        "torch",
        "rasterio",
        "scipy",
        "skyfield",
        "colour",
        "cv2",
        "sklearn",
        "trimesh",
    }
