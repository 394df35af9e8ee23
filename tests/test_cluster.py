"""Independent tasks on Dask's workers: nothing lost, short tasks travel together, long ones alone."""

from __future__ import annotations

import resource
import sys
import time
from collections import Counter
from importlib.util import find_spec

import numpy as np
import pytest

# Not imported here: that takes seconds in each process that collects this file.
pytestmark = pytest.mark.skipif(find_spec("distributed") is None, reason="the extra 'cluster' is not installed")


@pytest.fixture(scope="module")
def client():
    from distributed import Client, LocalCluster

    # Threads of this process: the scheduler is Dask's own, and no process has to start.
    with (
        LocalCluster(n_workers=3, threads_per_worker=1, processes=False, dashboard_address=None) as cluster,
        Client(cluster) as connected,
    ):
        yield connected


def record(item: tuple[int, float]) -> dict:
    from distributed import get_worker

    number, seconds = item
    time.sleep(seconds)
    return {"number": number, "call": get_worker().get_current_task(), "worker": get_worker().name}


def test_short_tasks_travel_together_and_none_is_lost_or_done_twice(client):
    from seasonscapes.cluster import run_by

    records = list(run_by(client, record, ((number, 0.0) for number in range(2000))))
    assert sorted(each["number"] for each in records) == list(range(2000))
    assert len({each["call"] for each in records}) < 2000 / 8


def test_long_tasks_travel_alone(client):
    from seasonscapes.cluster import run_by

    records = list(run_by(client, record, ((number, 0.3) for number in range(15))))
    assert len({each["call"] for each in records}) == 15


def test_long_tasks_after_many_short_ones_are_shared_among_all_workers(client):
    from seasonscapes.cluster import run_by

    items = [(number, 0.0 if number < 1000 else 0.05) for number in range(1090)]
    records = list(run_by(client, record, items))
    assert sorted(each["number"] for each in records) == list(range(1090))
    slow = [each for each in records if each["number"] >= 1000]
    # Some 5 fill a batch's 0.25 s; short ones before them, none.
    assert max(Counter(each["call"] for each in slow).values()) <= 6
    # 30 would be an even share of the 90.
    shares = Counter(each["worker"] for each in slow)
    assert len(shares) == 3
    assert max(shares.values()) < 45, shares


def test_a_task_that_fails_after_its_batch_was_given_back_tells_so(client):
    from seasonscapes.cluster import run_by

    with pytest.raises(ZeroDivisionError):
        list(run_by(client, slowly_divided, range(-400, 1)))


def slowly_divided(number: int) -> dict:
    time.sleep(0.02 if number > -40 else 0.0)
    return {"number": number, "quotient": 1 / number}


def test_items_are_taken_as_workers_need_them(client):
    from seasonscapes.cluster import run_by

    taken = []

    def items():
        for number in range(500):
            taken.append(number)
            yield number, 0.2

    running = run_by(client, record, items())
    next(running)
    assert len(taken) < 40
    running.close()


def test_a_task_that_fails_ends_the_iteration_with_its_own_exception(client):
    from seasonscapes.cluster import run_by

    with pytest.raises(ZeroDivisionError):
        list(run_by(client, divided, range(-300, 300)))


def divided(number: int) -> dict:
    return {"quotient": 1 / number}


def faults(number: int) -> dict:
    """Pages that a worker faults in while it makes and frees an array of 1 MB, again and again."""
    np.ones(1 << 17).sum()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        np.ones(1 << 17).sum()
    return {"faults": resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before}


@pytest.mark.skipif(sys.platform != "linux", reason="the allocator of glibc is told so")
def test_workers_keep_freed_memory():
    """Their pages are not faulted in anew for each array: with Dask's own setting there are some 250 an array."""
    from seasonscapes.cluster import run_on_cluster

    assert all(each["faults"] < 20 * 50 for each in run_on_cluster("local:1", faults, range(4)))
