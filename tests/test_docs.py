"""Tables equal their records, commands on the pages parse, stored notebooks are those of the tree, versions agree."""

import ast
import importlib.util
import json
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import seasonscapes

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.glob("*.md"), *DOCS.glob("start/*.md"), *DOCS.glob("howto/*.md"), ROOT / "README.md"])
CONSOLE = re.compile(r"```(?:console|sh)\n(.*?)```", re.DOTALL)

sys.path[:0] = [str(ROOT / "benchmarks"), str(DOCS / "_ext")]
import tables  # noqa: E402
from generated_pages import command_line  # noqa: E402


def commands_of(page: Path) -> list[str]:
    """The seasonscapes commands of a page's console blocks, continued lines joined."""
    lines: list[str] = []
    for block in CONSOLE.findall(page.read_text(encoding="utf-8")):
        lines += re.sub(r"\\\n\s*", "", block).splitlines()
    stripped = [line.strip().removeprefix("$ ") for line in lines]
    return [line for line in stripped if line.startswith("seasonscapes ")]


@pytest.mark.parametrize("page", [page for page in PAGES if commands_of(page)], ids=lambda page: page.name)
def test_commands_of_a_page_parse(page):
    app = command_line()
    for command in commands_of(page):
        tokens = shlex.split(command, comments=True)[1:]
        function, bound, _ = app.parse_args(tokens, exit_on_error=False, print_error=False)
        assert function is not None, command
        assert tokens[0].startswith("-") or bound is not None, command


def test_no_command_stands_outside_a_console_block():
    for page in PAGES:
        rest = CONSOLE.sub("", page.read_text(encoding="utf-8"))
        assert re.findall(r"^[ $]*seasonscapes [a-z-]+ .*", rest, re.MULTILINE) == [], page.name


def test_pages_have_commands():
    assert sum(len(commands_of(page)) for page in PAGES) > 50


@pytest.mark.parametrize("name", tables.DOCUMENTS)
def test_tables_equal_their_records(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    assert tables.filled(text) == text, "run `make tables`"


def test_every_table_stands_in_a_document_and_every_mark_names_one():
    texts = [(ROOT / name).read_text(encoding="utf-8") for name in tables.DOCUMENTS]
    marks = [mark for text in texts for mark in re.findall(r"<!-- table: (.*?) -->", text)]
    filled = [match[2] for text in texts for match in tables._REGION.finditer(text)]
    assert marks == filled, "a mark that is not understood would never be filled"
    assert len(marks) == len(set(marks))
    assert set(tables.TABLES) <= set(marks)


def test_a_wrong_number_in_a_table_is_found():
    text = (ROOT / "docs" / "measured.md").read_text(encoding="utf-8")
    table = re.search(r"<!-- table: night -->\n(.*?)<!-- end -->", text, re.DOTALL)
    assert table is not None
    number = re.search(r"\d\.\d\d", table[1])
    assert number is not None
    planted = text.replace(number[0], "1.01", 1)
    assert planted != text
    assert tables.filled(planted) == text


def test_times_measured_beside_other_work_are_marked():
    row = tables.Row("a frame", "{frame_s:.1f} s", "≤ 1 s", "frame_s <= 1")
    figures = {"frame_s": 1.25, "error": 0.5}
    busy, quiet = {"machine": {"cores": 2, "load_5min": 3.0}}, {"machine": {"cores": 2, "load_5min": 2.1}}
    assert (tables._busy(busy), tables._busy(quiet)) == (True, False)
    assert tables._row_text(row, figures, busy=True) == "| a frame | 1.2 s (beside other work) **(missed)** | ≤ 1 s |"
    assert tables._row_text(row, figures, busy=False) == "| a frame | 1.2 s **(missed)** | ≤ 1 s |"
    assert tables._row_text(tables.Row("error", "{error:.0%}"), figures, busy=True) == "| error | 50 % | – |"
    assert tables._row_text(tables.Row("noise", "{noise:.0%}"), figures, busy=False) is None


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_flags_that_a_benchmark_documents_exist(path):
    source = path.read_text(encoding="utf-8")
    documented = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", ast.get_docstring(ast.parse(source)) or ""))
    # Benchmarks of one family share their flags.
    shared = "".join(
        (ROOT / "benchmarks" / f"{name}.py").read_text(encoding="utf-8")
        for name in re.findall(r"^from (\w+) import", source, re.MULTILINE)
        if (ROOT / "benchmarks" / f"{name}.py").is_file() and name != "record"
    )
    assert {flag for flag in documented if f'"{flag}"' not in source + shared} == set()


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_names_that_a_benchmark_imports_exist(path):
    """Also those that are imported within functions, late in a run of an hour."""
    imports = [
        node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.ImportFrom)
    ]
    for node in (node for node in imports if node.module and node.module.split(".")[0] == "seasonscapes"):
        module = importlib.import_module(node.module or "")
        for name in (each.name for each in node.names if not hasattr(module, each.name)):
            assert importlib.util.find_spec(f"{node.module}.{name}") is not None, f"{node.module} has no {name}"


def test_records_say_how_they_came_about():
    records = sorted((ROOT / "benchmarks" / "results").glob("*.json"))
    assert records
    for path in records:
        figures = json.loads(path.read_text(encoding="utf-8"))
        record = figures.pop("record")
        assert set(record) == {"command", "seed", "commit", "date", "machine", "versions"}, path.name
        assert figures
        script = shlex.split(record["command"])[1]
        assert (ROOT / script).is_file(), path.name
        assert " /" not in record["command"], "a folder of one machine"


def test_a_record_is_written_with_its_circumstances(tmp_path):
    script = (
        "from record import write_record; from pathlib import Path; write_record(Path('r.json'), {'a_m': 1.5}, seed=7)"
    )
    environment_path = {"PYTHONPATH": f"{ROOT / 'benchmarks'}", "PATH": "/usr/bin:/bin"}
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, env=environment_path, check=True)
    figures = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    record = figures.pop("record")
    assert figures == {"a_m": 1.5}
    assert record["seed"] == 7
    assert record["command"].endswith("--seed 7")
    assert record["versions"]["mitsuba"]


@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_stored_notebooks_are_those_of_the_tree(path):
    import nbformat

    original = nbformat.read(path, as_version=4)
    stored = nbformat.read(DOCS / "tutorials" / path.name, as_version=4)
    assert [cell.source for cell in stored.cells] == [cell.source for cell in original.cells], "make docs-notebooks"
    assert any(cell.get("outputs") for cell in stored.cells)


def test_versions_agree():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    assert cited is not None
    assert seasonscapes.__version__ == declared == cited[1]
