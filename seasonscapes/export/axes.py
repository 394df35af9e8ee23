"""Axes of other programs: glTF's y-up, and rotations that point a lamp."""

from __future__ import annotations

import numpy as np


def y_up(east_north_up: np.ndarray) -> np.ndarray:
    """Turn east-north-up vectors ``(..., 3)`` to glTF's axes: x east, y up, z south."""
    east, north, up = np.moveaxis(np.asarray(east_north_up), -1, 0)
    return np.stack([east, up, -north], axis=-1)


def lamp_quaternion(towards: np.ndarray) -> list[float]:
    """Rotation (x, y, z, w) of a lamp that shines along its own -z, placed so that +z points towards the source.

    Parameters
    ----------
    towards
        ``(3,)`` vector from the ground to the source, in the axes that the rotation is for.
    """
    from scipy.spatial.transform import Rotation

    z = np.asarray(towards, float) / np.linalg.norm(towards)
    # Any axis that is not along z completes the frame; the lamp is round.
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1)).as_quat(canonical=True).tolist()
