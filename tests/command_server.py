"""Commands in forks of one process that has imported everything already, killed when asked to.

As a program it reads orders, lines of JSON, on stdin, and answers each with a line (``code``, ``seconds``); -9 is a killed
one. Its arguments name what it imports beside the program's own, ``module`` or ``module:name``. Light transport is traced
with few rays. `CommandServer` is its other end.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path


class CommandServer:
    """Commands in one folder, each a process of its own that can be killed.

    Parameters
    ----------
    folder
        Where the commands run.
    imports
        What they need beside the program's own, ``module`` or ``module:name``: imported once for all of them.
    environment
        Variables beside those of this process.
    """

    def __init__(self, folder: Path, imports: Sequence[str] = (), environment: dict[str, str] | None = None) -> None:
        self.folder = folder
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__)), *imports],
            cwd=folder,
            env={**os.environ, **(environment or {})},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._answer()["ready"]

    def run(
        self, arguments: Sequence[str], log: str, *, kill_after_s: float | None = None, said: Sequence[str] = ()
    ) -> dict:
        """Run a command, and kill it so long after its start, or after it wrote a line that begins with one of ``said``.

        What it writes is appended to the file ``log`` in the folder.
        """
        order = {"arguments": list(arguments), "log": log, "kill_after_s": kill_after_s, "said": list(said)}
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        """End the server."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def _answer(self) -> dict:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())


def run(order: dict) -> dict:
    start = time.monotonic()
    log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    before = os.fstat(log).st_size
    child = os.fork()
    if child == 0:
        os.dup2(log, 1)
        os.dup2(log, 2)
        code = 1
        try:
            code = main(order["arguments"])
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    os.close(log)
    kill_after_s, said = order["kill_after_s"], tuple(order["said"])
    counted_from = None if said else start
    while kill_after_s is not None:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return {"code": os.waitstatus_to_exitcode(status), "seconds": time.monotonic() - start}
        if counted_from is None and _has_said(order["log"], before, said):
            counted_from = time.monotonic()
        left_s = 0.02 if counted_from is None else kill_after_s - (time.monotonic() - counted_from)
        if left_s <= 0.0:
            os.kill(child, signal.SIGKILL)
            break
        time.sleep(min(left_s, 0.02))
    status = os.waitpid(child, 0)[1]
    return {"code": os.waitstatus_to_exitcode(status), "seconds": time.monotonic() - start}


def _has_said(log: str, before: int, said: tuple[str, ...]) -> bool:
    """Whether a line of a file from its byte ``before`` on begins with one of the texts."""
    with open(log, "rb") as file:
        file.seek(before)
        lines = file.read().decode("utf-8", errors="replace").splitlines()
    return any(line.startswith(said) for line in lines)


def _import(name: str) -> None:
    from importlib import import_module

    module, _, attribute = name.partition(":")
    imported = import_module(module)
    # Libraries that load their classes at their first use.
    if attribute:
        getattr(imported, attribute)


if __name__ == "__main__":
    import drjit  # noqa: F401
    import mitsuba  # noqa: F401
    import rasterio  # noqa: F401
    import scipy.ndimage
    import scipy.sparse.linalg  # noqa: F401
    import skyfield.api  # noqa: F401
    from few_rays import trace_few_rays
    from kept_tables import keep_tables

    import seasonscapes as ss
    from seasonscapes.cli import main
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows import timelapse, view_rendering  # noqa: F401

    for each in ss.__all__:
        getattr(ss, each)
    # Sets the renderer up, which starts no threads: these begin with the first kernel, in a command's own process.
    use_backend()
    for each in sys.argv[1:]:
        _import(each)
    trace_few_rays()
    keep_tables()
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        print(json.dumps(run(json.loads(line))), flush=True)
