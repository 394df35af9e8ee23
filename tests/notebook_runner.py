"""Executes scripts of notebooks one after the other in one process, each in a namespace of its own, with few rays.

Libraries are loaded, kernels read and the renderer set up once for all; each notebook sets what it needs itself, and what one
leaves in a library is there for the next. Prints a line of JSON for each: ``name``, exit
``code`` and what it wrote to ``stderr``.
"""

import contextlib
import io
import json
import os
import runpy
import sys
import traceback


def execute(name: str) -> dict:
    """Run a script; what it prints is dropped."""
    code, log = 0, io.StringIO()
    with open(os.devnull, "w") as nothing, contextlib.redirect_stdout(nothing), contextlib.redirect_stderr(log):
        try:
            runpy.run_path(f"{name}.py", run_name="__main__")
        except BaseException:
            traceback.print_exc()
            code = 1
    pyplot.close("all")
    return {"name": name, "code": code, "stderr": log.getvalue()}


if __name__ == "__main__":
    from few_rays import trace_few_rays
    from kept_tables import keep_tables
    from matplotlib import pyplot

    trace_few_rays()
    keep_tables()
    for each in sys.argv[1:]:
        print(json.dumps(execute(each)), flush=True)
