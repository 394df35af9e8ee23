"""Shared fixtures. Threads are pinned before numpy loads, so that timings and results do not depend on the machine."""

import os
from pathlib import Path

import pytest

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The optional folder of real rasters and photographs; tests that ask for it skip where it is absent."""
    given = os.environ.get("SEASONSCAPES_DATA")
    folder = Path(given) if given else Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real data set not found at {folder}; set SEASONSCAPES_DATA to its folder")
    return folder
