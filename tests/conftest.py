"""Shared fixtures. Threads are pinned before numpy loads, so that timings and results do not depend on the machine."""

import os
from collections import Counter
from pathlib import Path

import pytest

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


@pytest.fixture(scope="session", autouse=True)
def kept_tables(request, tmp_path_factory):
    """Atmosphere tables are computed once for all workers and what they start; see `kept_tables.py`."""
    # What takes milliseconds asks for none, and would wait for the import.
    if request.config.option.markexpr == "fast":
        yield
        return
    from kept_tables import VARIABLE, keep_tables

    base = tmp_path_factory.getbasetemp()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, str((base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "tables"))
        keep_tables()
        yield


@pytest.fixture(scope="module")
def few_rays():
    """Light transport with few rays for a module's tests; see `few_rays.py`."""
    from few_rays import trace_few_rays

    take_back = trace_few_rays()
    yield
    take_back()


@pytest.fixture(scope="module")
def coarse_viewer():
    """Coarse pages of `view` and `show`, which have no flag for it, for a module's tests."""
    from dataclasses import astuple

    from seasonscapes.workflows import viewer, viewer_scene
    from seasonscapes.workflows.viewer_scene import ViewerDetail

    coarse = ViewerDetail(160, 256, 160, 48, 24, 8, 256, 16, 64, light_heights=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ViewerDetail.__init__, "__defaults__", astuple(coarse))
        patch.setattr(viewer, "SMALL", coarse)
        # Of the dates of a place that is known all year, each baked: one with snow and one without.
        patch.setattr(viewer_scene, "_SHOWN", ((1, 16), (7, 16)))
        yield


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The optional folder of real rasters and photographs; tests that ask for it skip where it is absent."""
    given = os.environ.get("SEASONSCAPES_DATA")
    folder = Path(given) if given else Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real data set not found at {folder}; set SEASONSCAPES_DATA to its folder")
    return folder


def pytest_ignore_collect(collection_path, config):
    """`make check` imports the files that hold fast tests alone: importing all takes longer than most of its tests."""
    if config.option.markexpr == "fast" and collection_path.name.startswith("test_") and collection_path.is_file():
        return "mark.fast" not in collection_path.read_text(encoding="utf-8") or None
    return None


def pytest_collection_modifyitems(items):
    """Files with slow tests first: begun last, one of them alone would keep a worker busy while the other has ended."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def pytest_terminal_summary(terminalreporter):
    """Sum the verdicts of the fault campaign. Here, since the process that gathers results of several loads no other."""
    cases, wrong = 0, Counter()
    for reports in terminalreporter.stats.values():
        for report in reports:
            for name, value in getattr(report, "user_properties", ()):
                if name == "fault" and report.when == "call":
                    cases += value["cases"]
                    wrong.update(value["wrong"])
    if cases:
        told = {
            "tracebacks": wrong["traceback"],
            "half files": wrong["half file"],
            "escapes": wrong["escape"],
            "silent": wrong["silent"],
            "not one line of text or JSON": wrong["not one line"] + wrong["no JSON"],
            "refused in error": wrong["refused"],
        }
        terminalreporter.write_line(f"faults: {cases} cases, " + ", ".join(f"{n} {what}" for what, n in told.items()))
