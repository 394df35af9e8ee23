"""The small land of the fault campaign; `tests/conftest.py` sums its verdicts."""

import os
import time

import pytest
from fault_verbs import write_land
from hypothesis import given, seed, settings
from hypothesis.database import DirectoryBasedExampleDatabase

# Minutes of fuzzing of each format, with examples at random; without it seconds, with the same examples each time.
FUZZ_MINUTES = float(os.environ.get("SEASONSCAPES_FUZZ_MINUTES", "0"))
SEEDS = DirectoryBasedExampleDatabase(os.path.join(os.path.dirname(__file__), "seeds"))


@pytest.fixture
def fuzz():
    """Run a property of hypothesis: ``fuzz(strategy, check)``; returns the number of examples.

    What fails is kept in ``tests/faults/seeds`` and tried first from then on.
    """

    def run(strategy, check):
        count = 0

        @settings(max_examples=500 if FUZZ_MINUTES else 60, deadline=None, database=SEEDS)
        @given(strategy)
        def holds(value):
            nonlocal count
            count += 1
            check(value)

        end = time.monotonic() + 60.0 * FUZZ_MINUTES
        (holds if FUZZ_MINUTES else seed(0)(holds))()
        while time.monotonic() < end:
            holds()
        return count

    return run


def pytest_collection_modifyitems(items):
    for item in items:
        if FUZZ_MINUTES and "fuzz" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.timeout(0))


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
