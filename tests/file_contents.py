"""What files hold, for comparing the results of two runs to the bit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image


def contents(path: Path) -> dict:
    """What a file holds, to the bit; without the seconds that it took."""
    if path.suffix == ".safetensors":
        from safetensors import safe_open

        with safe_open(path, "np") as file:
            return {"": file.metadata()} | {name: file.get_tensor(name).tobytes() for name in file.keys()}  # noqa: SIM118
    if path.suffix == ".npz":
        with np.load(path) as file:
            return {name: file[name].tobytes() for name in file.files}
    if path.suffix == ".png":
        return {"pixels": np.asarray(Image.open(path)).tobytes()}
    if path.suffix == ".exr":
        from seasonscapes.images import read_exr

        return {name: np.ascontiguousarray(layer).tobytes() for name, layer in read_exr(path)[0].items()}
    if path.suffix == ".json":
        return {"record": timeless(json.loads(path.read_text()))}
    return {"bytes": path.read_bytes()}


def timeless(value: object) -> object:
    if isinstance(value, dict):
        return {key: timeless(item) for key, item in value.items() if "seconds" not in key}
    return [timeless(item) for item in value] if isinstance(value, list) else value
