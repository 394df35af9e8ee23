"""One-second test render, run as a child process by `seasonscapes doctor`: ``python -m seasonscapes.rendering.probe``.

The scene is a Lambertian plane under a uniform sky, whose radiance is known; variant and duration are printed.
"""

from __future__ import annotations

import sys
import time

from seasonscapes.declaration import InputError
from seasonscapes.rendering.backend import use_backend


def main(device: str) -> str:
    """Render the test scene.

    Parameters
    ----------
    device
        See `backend.choose_backend`.

    Returns
    -------
    str
        One line with the variant and the duration.

    Raises
    ------
    InputError
        If the device is not available.
    RuntimeError
        If the radiance is wrong.
    """
    start = time.perf_counter()
    backend = use_backend(device)
    import mitsuba as mi

    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "plane": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}},
            "sky": {"type": "constant"},
            "sensor": {
                "type": "perspective",
                "fov": 20,
                "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}},
            },
        }
    )
    import numpy as np

    mean = float(np.array(mi.render(scene, spp=64, seed=0)).mean())  # pyright: ignore[reportArgumentType]
    if abs(mean - 0.5) > 0.01:
        raise RuntimeError(f"test render: got mean radiance {mean:.4f}, expected 0.5")
    return f"{backend.variant} rendered the test plane in {time.perf_counter() - start:.1f} s"


if __name__ == "__main__":
    try:
        print(main(sys.argv[1] if len(sys.argv) > 1 else "auto"))
    except (InputError, RuntimeError) as error:
        sys.exit(str(error))
