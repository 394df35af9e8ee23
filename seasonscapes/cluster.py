"""Independent tasks on many processes or machines through Dask.

Tasks write their results atomically to a shared folder and return small records. When a worker dies, its tasks are
rescheduled on other workers, which keep the results that are already there.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

from seasonscapes.declaration import read_toml
from seasonscapes.errors import InputError

Item = TypeVar("Item")
# Deaths of workers that one task survives before the task itself is reported as failed.
_DEATHS = 10
# What the workers' memory allocator keeps for itself [bytes]: arrays up to the first size, and that much free memory (mallopt(3)).
_ALLOCATION = {"MALLOC_MMAP_THRESHOLD_": 1 << 25, "MALLOC_TRIM_THRESHOLD_": 1 << 28}
# Tasks submitted ahead for each worker.
_AHEAD = 4
# Items travel together while they take no longer than this [s], and no more than so many: much longer than a call of Dask
# costs, much shorter than what is worth sharing among workers. A batch that takes longer gives back the rest. Both chosen.
_BATCH_S, _MOST_TOGETHER = 0.25, 64


def run_on_cluster(cluster: str, task: Callable[[Item], dict], items: Iterable[Item]) -> Iterator[dict]:
    """Run a task for every item and give the records as they are done, in any order.

    Parameters
    ----------
    cluster
        ``local:N`` worker processes, ``tcp://HOST:PORT`` of a running scheduler, or ``slurm:FILE``.
    task
        A function that can be pickled; see `run_by`.
    items
        Its arguments, one for each call.

    Raises
    ------
    InputError
        For a cluster that cannot be reached, or a file that does not describe one.
    """
    with connected(cluster) as client:
        yield from run_by(client, task, items)


def check_cluster(cluster: str) -> None:
    """Check the description of a cluster before work begins, without reaching it.

    Raises
    ------
    InputError
        If it is neither ``local:N`` of 1 to 1024 workers, nor ``tcp://HOST:PORT``, nor ``slurm:FILE`` where there is
        SLURM and the file describes a cluster.
    """
    kind, _, rest = cluster.partition(":")
    if kind == "local" and re.fullmatch(r"[0-9]{1,4}", rest) and 1 <= int(rest) <= 1024:
        return
    if kind in ("tcp", "tls") and _is_address(cluster):
        return
    if kind == "slurm" and rest:
        _slurm_table(Path(rest))
        if shutil.which("sbatch") is None:
            raise InputError("--cluster", "there is no SLURM on this machine (sbatch is not found)", got=cluster)
        return
    raise InputError(
        "--cluster", "unknown kind of cluster", got=cluster, expected="local:N, tcp://HOST:PORT or slurm:FILE"
    )


def _is_address(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return bool(parts.hostname) and parts.port is not None and not parts.path and not parts.query
    except ValueError:
        return False


@contextmanager
def connected(cluster: str) -> Iterator[Any]:
    """A Dask client of a cluster; a cluster that was started for it ends with the block."""
    try:
        import dask.config
        from distributed import Client
    except ImportError:
        raise InputError("--cluster", "Dask is not installed", cure="pip install 'seasonscapes[cluster]'") from None
    check_cluster(cluster)
    settings = {
        "distributed.scheduler.allowed-failures": _DEATHS,
        "distributed.worker.daemon": False,
        # Statistics that only Dask's dashboard shows; they cost a worker some percent of a core.
        "distributed.worker.profile.enabled": False,
        # By Dask's own setting every freed array goes back to the system, and each new one's pages are faulted in again: frames
        # take twice the processor time.
        **{f"distributed.nanny.pre-spawn-environ.{name}": value for name, value in _ALLOCATION.items()},
    }
    with dask.config.set(settings):
        if cluster.startswith(("tcp://", "tls://")):
            try:
                client = Client(cluster, timeout="15s")
            except OSError as error:
                raise InputError(
                    "--cluster", "no scheduler answers", got=cluster, cure=f"start one there ({error})"
                ) from None
            with client:
                yield client
            return
        with _started(cluster) as started, Client(started) as client:
            if cluster.startswith("local:"):
                client.register_plugin(_own_cores(int(cluster.partition(":")[2])))
            yield client


def _own_cores(workers: int) -> Any:
    """A plugin that pins each of the machine's workers to its own cores, so that their threads do not compete."""
    from distributed import WorkerPlugin

    class OwnCores(WorkerPlugin):
        name = "own-cores"

        def setup(self, worker: Any) -> None:
            if not hasattr(os, "sched_setaffinity"):
                return  # macOS, Windows: the system decides
            cores = sorted(os.sched_getaffinity(os.getppid()))
            os.sched_setaffinity(0, cores[int(worker.name) % len(cores) :: workers] or cores)

    return OwnCores()


def _started(cluster: str) -> Any:
    kind, _, rest = cluster.partition(":")
    if kind == "local":
        from distributed import LocalCluster

        return LocalCluster(
            n_workers=int(rest),
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,  # pyright: ignore[reportArgumentType]
            memory_limit=0,
        )
    return _slurm(Path(rest))


def _slurm_table(path: Path) -> tuple[int, dict[str, Any]]:
    """From a TOML file: ``jobs = N`` and a table ``[slurm]`` of the resources of each job."""
    table = read_toml(path)
    jobs, resources = table.get("jobs"), table.get("slurm")
    if not isinstance(jobs, int) or not 1 <= jobs <= 10_000:
        raise InputError(f"{path}: jobs", "not a number of jobs", got=jobs, expected="1 to 10000, such as jobs = 8")
    if not isinstance(resources, dict) or set(table) - {"jobs", "slurm"}:
        expected = "jobs = 8 and a table [slurm] with cores, memory, walltime, queue, account"
        raise InputError(path, "does not describe a cluster", expected=expected)
    return jobs, resources


def _slurm(path: Path) -> Any:
    """A cluster of SLURM jobs."""
    jobs, resources = _slurm_table(path)
    from dask_jobqueue.slurm import SLURMCluster

    try:
        cluster = SLURMCluster(**{"processes": 1, **resources})
    except (TypeError, ValueError) as error:
        raise InputError(path, f"[slurm]: {error}") from None
    cluster.scale(jobs=jobs)
    return cluster


def run_by(client: Any, task: Callable[[Item], dict], items: Iterable[Item]) -> Iterator[dict]:
    """Run a task for every item on a Dask client's workers and give the records as they are done.

    Short tasks travel together: a call of Dask costs milliseconds by itself. How many follows from how long the latest took.
    Where they turn out to be long, those that a worker has not begun are shared among all workers again.
    An item's exception ends the iteration; of the items that travelled with it, some may have been run.

    Parameters
    ----------
    client
        Of `connected`.
    task
        A function that can be pickled. It may be called again for an item whose worker died, and knows which results exist.
    items
        Its arguments, one for each call; they are taken as workers need them.
    """
    from distributed import as_completed

    pending, given_back = iter(items), deque()
    workers = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
    together = 1
    running, batches = as_completed(), {}

    def submit() -> None:
        """Submit batches until enough wait for the workers or no item is left."""
        while len(batches) < _AHEAD * workers:
            batch = [given_back.popleft() for _ in range(min(together, len(given_back)))]
            batch += islice(pending, together - len(batch))
            if not batch:
                return
            # Impure, so that a second run calls the task again: the task itself knows which results exist.
            future = client.submit(_run_batch, task, batch, pure=False)
            batches[future.key] = batch
            running.add(future)

    submit()
    for future in running:
        records, seconds = future.result()
        future.release()
        given_back.extend(batches.pop(future.key)[len(records) :])
        # A worker's first item may be slow (it opens files, compiles kernels): the number may grow again afterwards.
        fitting = int(len(records) * _BATCH_S / max(seconds, 1e-6))
        together = max(1, min(fitting, 2 * together, _MOST_TOGETHER))
        submit()
        yield from records


def _run_batch(task: Callable[[Item], dict], items: Sequence[Item]) -> tuple[list[dict], float]:
    """The records of some items, at least of the first, until they took too long; and how long they took [s]."""
    start = time.perf_counter()
    records: list[dict] = []
    for item in items:
        records.append(task(item))
        if time.perf_counter() - start >= _BATCH_S:
            break
    return records, time.perf_counter() - start
