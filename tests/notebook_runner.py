"""Executes scripts of notebooks, each in a fork of one process that has imported what all need, with few rays.

Prints a line of JSON for each: ``name``, exit ``code`` and what it wrote to ``stderr``.
"""

import json
import os
import runpy
import sys
import tempfile
import traceback


def execute(name: str) -> dict:
    with tempfile.TemporaryFile() as log:
        child = os.fork()
        if child == 0:
            os.dup2(log.fileno(), 2)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            code = 0
            try:
                runpy.run_path(f"{name}.py", run_name="__main__")
            except BaseException:
                traceback.print_exc()
                code = 1
            sys.stderr.flush()
            os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        log.seek(0)
        return {"name": name, "code": code, "stderr": log.read().decode(errors="replace")}


if __name__ == "__main__":
    import matplotlib.pyplot  # noqa: F401
    import mitsuba  # noqa: F401
    import rasterio  # noqa: F401
    import scipy.ndimage
    import scipy.sparse.linalg  # noqa: F401
    import skyfield.api  # noqa: F401
    from few_rays import trace_few_rays
    from kept_tables import keep_tables

    trace_few_rays()
    keep_tables()
    for each in sys.argv[1:]:
        print(json.dumps(execute(each)), flush=True)
