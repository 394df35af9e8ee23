"""Runs commands in forks of one process that has imported everything already, and kills them when asked to.

Reads lines of JSON (``arguments``, ``kill_after_s`` or null, ``log``) on stdin, answers each with a line (``code``,
``seconds``); -9 is a killed one. Light transport is traced with few rays.
"""

import json
import os
import signal
import sys
import time


def run(order: dict) -> dict:
    start = time.monotonic()
    child = os.fork()
    if child == 0:
        log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1)
        os.dup2(log, 2)
        code = 1
        try:
            code = main(order["arguments"])
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    kill_after = order["kill_after_s"]
    while kill_after is not None:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return {"code": os.waitstatus_to_exitcode(status), "seconds": time.monotonic() - start}
        left = kill_after - (time.monotonic() - start)
        if left <= 0.0:
            os.kill(child, signal.SIGKILL)
            break
        time.sleep(min(left, 0.02))
    status = os.waitpid(child, 0)[1]
    return {"code": os.waitstatus_to_exitcode(status), "seconds": time.monotonic() - start}


if __name__ == "__main__":
    import drjit  # noqa: F401
    import mitsuba  # noqa: F401
    import rasterio  # noqa: F401
    import scipy.ndimage
    import scipy.sparse.linalg  # noqa: F401
    import skyfield.api  # noqa: F401
    from few_rays import trace_few_rays

    from seasonscapes.cli import main
    from seasonscapes.workflows import timelapse, view_rendering  # noqa: F401

    trace_few_rays()
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        print(json.dumps(run(json.loads(line))), flush=True)
