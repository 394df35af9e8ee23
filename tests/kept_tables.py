"""Tables of atmospheres are computed once in a run of the tests, whatever workspace asks for them, by the program's own cache.

Several tests and notebooks ask for the same hazes, each in an empty workspace, and a table takes seconds. Those that test
the tables call `atmosphere_tables` itself; workspaces are written as ever.
"""

from __future__ import annotations

import os
from pathlib import Path

# Tells processes that tests start where the tables lie.
VARIABLE = "SEASONSCAPES_TESTS_TABLES"


def keep_tables() -> None:
    """From now on this process looks for tables in the folder that `VARIABLE` names, if it does, before it computes them."""
    if VARIABLE not in os.environ:
        return
    from seasonscapes.sky.clear_sky import atmosphere_tables, load_tables, save_tables
    from seasonscapes.workflows import illumination
    from seasonscapes.workspace import Workspace, build_once

    kept = Workspace(Path(os.environ[VARIABLE]))

    def tables_of(atmosphere):
        return build_once(
            kept,
            "tables",
            {"atmosphere": atmosphere},
            code=illumination._TABLES_CODE,
            suffix=".npz",
            build=lambda: atmosphere_tables(atmosphere),
            save=lambda tables, path: save_tables(path, tables),
            load=load_tables,
        )

    illumination.atmosphere_tables = tables_of
