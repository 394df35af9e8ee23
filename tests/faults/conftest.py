"""The small land of the fault campaign, and the sum of all verdicts at the end."""

from collections import Counter

import pytest
from fault_verbs import write_land


@pytest.fixture(scope="module")
def land(tmp_path_factory):
    """A folder with ``inside``, ``outside`` and a workspace that all cases of a module share; none may change it."""
    folder = tmp_path_factory.mktemp("land")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SEASONSCAPES_WORKSPACE", str(folder / "workspace"))
        patch.setenv("COLUMNS", "200")
        yield write_land(folder)


@pytest.fixture
def own_land(tmp_path, monkeypatch):
    """The same for one case alone, which may change it."""
    monkeypatch.setenv("SEASONSCAPES_WORKSPACE", str(tmp_path / "workspace"))
    return write_land(tmp_path)


def pytest_terminal_summary(terminalreporter):
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
