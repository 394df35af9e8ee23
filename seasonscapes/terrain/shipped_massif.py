"""The massifs of the bundled scenes, which are distributed with the package, so that nobody waits for their erosion.

``make massif`` writes them; a test compares them with those that are generated anew. Any other massif is generated.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.bundled import bundled_folder
from seasonscapes.images import atomic_path
from seasonscapes.terrain.synthetic_massif import SyntheticMassif, massif_of

# Increment whenever the generator makes another massif of the same parameters.
_REVISION = 1
_SHIPPED = {
    "alpine": {"seed": 1912, "size_m": 12000.0, "spacing_m": 15.0},
    "alpine_lake": {"seed": 1912, "size_m": 12000.0, "spacing_m": 30.0},
    "alpine_small": {"seed": 1912, "size_m": 12000.0, "spacing_m": 60.0},
}


def shipped_massif(*, seed: int, size_m: float, spacing_m: float) -> SyntheticMassif | None:
    """Load the massif of these parameters if it is distributed with the package.

    Parameters
    ----------
    seed, size_m, spacing_m
        As in `synthetic.alpine_massif`.

    Returns
    -------
    SyntheticMassif or None
        ``None`` for all massifs but those of the bundled scenes.

    Examples
    --------
    >>> shipped_massif(seed=1912, size_m=12000.0, spacing_m=15.0).spacing_m
    15.0
    >>> shipped_massif(seed=7, size_m=12000.0, spacing_m=15.0) is None
    True
    """
    wanted = {"seed": seed, "size_m": size_m, "spacing_m": spacing_m}
    name = next((name for name, parameters in _SHIPPED.items() if parameters == wanted), None)
    if name is None or not _path(name).is_file():
        return None
    with np.load(_path(name), allow_pickle=False) as file:
        if int(file["revision"]) != _REVISION:
            return None
        z, debris, shore_m = (_unpacked(file[name]) for name in ("elevation", "debris", "shore_m"))
        return massif_of(z, file["cover"], debris, shore_m, seed=seed, spacing_m=spacing_m)


def write_shipped_massifs() -> list[Path]:
    """Generate the bundled scenes' massifs and write them beside the scenes."""
    # The generator loads libraries that a shipped massif does not need.
    from seasonscapes.terrain.synthetic import alpine_massif

    for name, parameters in _SHIPPED.items():
        massif = alpine_massif(**parameters)
        maps = {"elevation": massif.elevation.values[..., 0], "debris": massif.debris, "shore_m": massif.shore_m}
        _path(name).parent.mkdir(exist_ok=True)
        with atomic_path(_path(name)) as temporary, open(temporary, "wb") as file:
            packed: dict[str, Any] = {each: _packed(values) for each, values in maps.items()}
            np.savez_compressed(file, revision=_REVISION, cover=massif.cover, **packed)
    return [_path(name) for name in _SHIPPED]


def _packed(values: np.ndarray) -> np.ndarray:
    """Bytes ``(4, H, W)`` of the differences between neighbouring floats: what is alike lies together and compresses well."""
    bits = np.ascontiguousarray(values, "<f4").view("<u4")
    return np.moveaxis(np.diff(bits, axis=1, prepend=np.uint32(0)).view(np.uint8).reshape(*bits.shape, 4), 2, 0)


def _unpacked(planes: np.ndarray) -> np.ndarray:
    """The inverse of `_packed`, to the bit."""
    steps = np.ascontiguousarray(np.moveaxis(planes, 0, 2)).view("<u4")[..., 0]
    return np.cumsum(steps, axis=1, dtype=np.uint32).view(np.float32)


def _path(name: str) -> Path:
    return bundled_folder("scenes") / "massif" / f"{name}.npz"


if __name__ == "__main__":
    print(*write_shipped_massifs(), sep="\n")
