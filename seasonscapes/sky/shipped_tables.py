"""Atmosphere tables that are distributed with the bundled sky models, so that nobody waits for their computation.

``make sky-tables`` writes them; a test compares them with tables computed anew. Any other atmosphere is computed.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from seasonscapes.bundled import bundled_folder, bundled_names
from seasonscapes.sky.atmosphere import Atmosphere
from seasonscapes.sky.clear_sky import TABLES_REVISION, atmosphere_tables, load_tables, save_tables
from seasonscapes.sky.models import AtmosphereModel, atmosphere_from_model, read_sky_model
from seasonscapes.sky.scattering import AtmosphereTables


def shipped_tables(atmosphere: Atmosphere) -> AtmosphereTables | None:
    """Load the tables of an atmosphere that are distributed with the package.

    Parameters
    ----------
    atmosphere
        Atmosphere.

    Returns
    -------
    AtmosphereTables or None
        ``None`` for all atmospheres but those of the bundled sky models.

    Examples
    --------
    >>> from seasonscapes.sky.models import atmosphere_from_model, read_sky_model
    >>> shipped_tables(atmosphere_from_model(read_sky_model("clear"))) is not None
    True
    """
    stated = json.dumps(asdict(atmosphere))
    for path in sorted(_folder().glob("*.npz")):
        with np.load(path, allow_pickle=False) as file:
            matches = int(file["revision"]) == TABLES_REVISION and str(file["atmosphere"]) == stated
        if matches:
            return load_tables(path)
    return None


def write_shipped_tables() -> list[Path]:
    """Compute the tables of all bundled sky models that have an atmosphere, and write them beside the models.

    Returns
    -------
    list of pathlib.Path
        The files written.
    """
    _folder().mkdir(exist_ok=True)
    paths = []
    for name in bundled_names("sun_models"):
        model = read_sky_model(name)
        if isinstance(model, AtmosphereModel):
            paths.append(_folder() / f"{name}.npz")
            save_tables(paths[-1], atmosphere_tables(atmosphere_from_model(model)))
    return paths


def _folder() -> Path:
    return bundled_folder("sun_models") / "tables"


if __name__ == "__main__":
    for path in write_shipped_tables():
        print(path)
