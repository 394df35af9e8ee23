"""What a command frees serves its next arrays, without a page fault for each of their pages."""

import subprocess
import sys

import pytest

COUNT = """
import resource
import numpy as np
{first}
for _ in range(2):
    np.ones(5_000_000, np.float64)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    np.ones(5_000_000, np.float64)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""
KEEP = "from seasonscapes.freed_memory import keep_freed_memory\nassert keep_freed_memory()"


def page_faults(first: str) -> int:
    """Page faults of ten arrays of 40 MB one after another."""
    run = subprocess.run([sys.executable, "-c", COUNT.format(first=first)], capture_output=True, text=True, check=True)
    return int(run.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="only glibc's malloc is told to keep memory")
def test_arrays_reuse_freed_memory():
    assert page_faults(KEEP) * 5 < page_faults("")
