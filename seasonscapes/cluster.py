"""Frames on many processes or machines by Dask.

Workers keep place and coefficients warm, write each frame atomically into the shared workspace and return a small
record. A killed worker takes nothing with it: its frames are handed to others, which keep what is already there.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

from seasonscapes.errors import InputError
from seasonscapes.studio import Assignment, render_frame

# How often a frame's worker may die before the frame itself is blamed.
_DEATHS = 10
# Frames handed out ahead for each worker.
_AHEAD = 4


def frames_on_cluster(
    cluster: str, assignment: Assignment, times: list[datetime], *, exr_folder: str | None = None
) -> Iterator[dict]:
    """The records of frames as they are done, in any order; see `studio.render_frame`.

    Parameters
    ----------
    cluster
        ``local:N``, ``tcp://HOST:PORT`` of a running scheduler, or ``slurm:FILE``.

    Raises
    ------
    InputError
        For a cluster that cannot be reached, or a file that does not describe one.
    """
    with connected(cluster) as client:
        yield from frames_by(client, assignment, times, exr_folder)


@contextmanager
def connected(cluster: str) -> Iterator[Any]:
    """A Dask client of a cluster, which ends with the block if it was started for it."""
    try:
        import dask
        from distributed import Client
    except ImportError:
        raise InputError("--cluster", "Dask is not installed", cure="pip install 'seasonscapes[cluster]'") from None
    settings = {"distributed.scheduler.allowed-failures": _DEATHS, "distributed.worker.daemon": False}
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
    """Gives each of so many workers of this machine its own cores, so that their threads do not fight over all of them."""
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
    if kind == "local" and rest.isdigit() and 1 <= int(rest) <= 1024:
        from distributed import LocalCluster

        return LocalCluster(
            n_workers=int(rest),
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            memory_limit=0,
        )
    if kind == "slurm" and rest:
        return _slurm(Path(rest))
    raise InputError(
        "--cluster", "unknown kind of cluster", got=cluster, expected="local:N, tcp://HOST:PORT or slurm:FILE"
    )


def _slurm(path: Path) -> Any:
    """A cluster of SLURM jobs from a TOML file: ``jobs = N`` and a table ``[slurm]`` of what each job asks for."""
    if not path.is_file():
        raise InputError("--cluster", "no such file", got=str(path))
    try:
        table = tomllib.loads(path.read_text())
    except tomllib.TOMLDecodeError as error:
        raise InputError(path, f"not TOML: {error}") from None
    jobs, wishes = table.get("jobs"), table.get("slurm")
    if not isinstance(jobs, int) or jobs < 1 or not isinstance(wishes, dict) or set(table) - {"jobs", "slurm"}:
        raise InputError(
            path,
            "does not describe a cluster",
            expected="jobs = 8 and a table [slurm] with cores, memory, walltime, queue, account",
        )
    from dask_jobqueue import SLURMCluster

    try:
        cluster = SLURMCluster(**{"processes": 1, **wishes})
    except (TypeError, ValueError) as error:
        raise InputError(path, f"[slurm]: {error}") from None
    cluster.scale(jobs=jobs)
    return cluster


def frames_by(client: Any, assignment: Assignment, times: list[datetime], exr_folder: str | None) -> Iterator[dict]:
    """The records of frames that a client's workers render, in the order in which they are done."""
    from distributed import as_completed

    pending = iter(times)
    workers = max(1, len(client.scheduler_info(n_workers=-1)["workers"]))

    def submit(time: datetime) -> Any:
        # Impure, so that a second run asks again: only the workspace knows what is whole.
        return client.submit(render_frame, assignment, time, exr_folder=exr_folder, pure=False)

    first = [submit(time) for _, time in zip(range(_AHEAD * workers), pending, strict=False)]
    running = as_completed(first)
    for future in running:
        yield future.result()
        future.release()
        following = next(pending, None)
        if following is not None:
            running.add(submit(following))
