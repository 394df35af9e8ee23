"""The benchmark's scene as one would write it by hand for Mitsuba, with nothing of seasonscapes: the yardstick.

It reads what `render.py` wrote to a folder. The caller sets the variant.
"""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np


def load(folder: Path, *, sun: str) -> mi.Scene:
    """The scene, its sun a far ``polygon`` of the true size or an infinitely sharp ``directional`` light."""
    facts = json.loads((folder / "facts.json").read_text())
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": facts["max_depth"]},
        "sensor": {
            "type": "perspective",
            "fov_axis": "x",
            "fov": facts["fov_deg"],
            "near_clip": 0.5,
            "far_clip": 1.0e7,
            # Mitsuba's cameras look along +z with x to the left.
            "to_world": mi.ScalarTransform4f(np.array(facts["world_from_camera"]) @ np.diag([-1.0, -1.0, 1.0, 1.0])),
            "film": {
                "type": "hdrfilm",
                "width": facts["width_px"],
                "height": facts["height_px"],
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        },
        "terrain": {
            "type": "ply",
            "filename": str(folder / "terrain.ply"),
            "bsdf": {
                "type": "diffuse",
                "reflectance": {
                    "type": "bitmap",
                    "filename": str(folder / "albedo.exr"),
                    "raw": True,
                    "wrap_mode": "clamp",
                },
            },
        },
        "sky": {
            "type": "envmap",
            "filename": str(folder / "sky.exr"),
            # The map's own axes have y up.
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
        },
    }
    if sun == "directional":
        scene["sun"] = {
            "type": "directional",
            "direction": [-component for component in facts["sun_direction"]],
            "irradiance": {"type": "rgb", "value": facts["sun_normal_illuminance"]},
        }
    else:
        scene["sun"] = {
            "type": "ply",
            "filename": str(folder / "sun.ply"),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": facts["sun_polygon_radiance"]}},
        }
    return mi.load_dict(scene)


def render(scene: mi.Scene, spp: int, seed: int) -> np.ndarray:
    """The picture ``(H, W, 3)``."""
    return np.array(mi.render(scene, spp=spp, seed=seed))[..., :3]
