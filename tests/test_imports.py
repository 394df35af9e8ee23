"""What each verb imports: nothing heavy before it works, and then only what its work needs, so that answers come at once."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "faults"))
from fault_verbs import BASE, write_land

# Modules of the verbs, found by their files: tests import none of them.
COMMANDS = Path(__file__).parents[1] / "seasonscapes" / "commands"
VERBS = sorted(path.stem for path in COMMANDS.glob("*.py") if f"\ndef {path.stem}_command(" in path.read_text())
# Packages that take a tenth of a second to several seconds to import.
HEAVY = {
    *(
        "mitsuba",
        "torch",
        "diffusers",
        "transformers",
        "safetensors",
        "colour",
        "trimesh",
        "sklearn",
        "skimage",
        "scipy",
    ),
    *("rasterio", "pyproj", "cv2", "PIL", "skyfield", "distributed", "dask", "pxr", "matplotlib", "pandas", "xatlas"),
}
# To parse any command line and answer --help.
PARSING = {
    *("annotated_types", "attr", "attrs", "cyclopts", "numpy", "pydantic", "pydantic_core", "seasonscapes"),
    *("typing_extensions", "typing_inspection"),
}
_LAND = {"rasterio", "pyproj", "cv2"}
# Verb, flags besides those of `fault_verbs.BASE`, and the heavy packages of a whole call.
WORK = [
    ("sky", ["--at", "46.5,8,1500", "--time", "2024-07-20T12:00Z"], {"skyfield"}),
    ("render", [*BASE["render"], "--sky", "hosek"], {*_LAND, "PIL", "skyfield", "mitsuba"}),
    ("irradiance", [*BASE["irradiance"], "--sky", "hosek"], {*_LAND, "scipy", "skyfield", "mitsuba"}),
    ("webcams", BASE["webcams"], {*_LAND, "PIL"}),
    ("path", BASE["path"], {*_LAND, "scipy"}),
    ("terrain", BASE["terrain"], _LAND),
    ("evaluate", BASE["evaluate"], {"cv2", "PIL", "scipy", "skimage", "colour"}),
    ("info", BASE["info"], {"PIL"}),
]
_TELL = """
import sys
{0}
print("\\nimported", *sorted({{name.split(".")[0] for name in sys.modules}} - set(sys.stdlib_module_names)))
"""


def imported(program: str, *arguments: str, folder: Path) -> set[str]:
    """The packages outside the standard library that a program has imported when it ends."""
    environment = {**os.environ, "SEASONSCAPES_WORKSPACE": str(folder / "work")}
    environment["PYTHONPATH"] = str(Path(__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", _TELL.format(program), *arguments],
        capture_output=True,
        text=True,
        cwd=folder,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    told = done.stdout.splitlines()[-1].split()
    assert told[0] == "imported"
    return {name for name in told[1:] if not name.startswith("_")}


@pytest.mark.parametrize("module", VERBS)
def test_a_verb_s_flags_need_no_more_than_parsing(module, tmp_path):
    assert imported(f"import seasonscapes.commands.{module}", folder=tmp_path) <= PARSING


@pytest.fixture(scope="module")
def land(tmp_path_factory):
    return write_land(tmp_path_factory.mktemp("imports")) / "inside"


@pytest.mark.parametrize(("verb", "arguments", "heavy"), WORK, ids=[verb for verb, *_ in WORK])
def test_work_imports_what_it_needs(land, verb, arguments, heavy):
    program = "from seasonscapes.cli import main\nassert main(sys.argv[1:]) == 0"
    found = imported(program, verb, *arguments, folder=land) & HEAVY
    # colour-science imports these where they are installed.
    assert found - ({"matplotlib", "pandas"} if "colour" in heavy else set()) == heavy
