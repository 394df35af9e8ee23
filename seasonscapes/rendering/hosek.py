"""Hosek–Wilkie clear sky, evaluated by Mitsuba's ``sunsky`` emitter for a given sun direction, in photometric units.

Hosek & Wilkie, "An analytic model for full spectral sky-dome radiance", 2012, doi:10.1145/2185520.2185591; sun disc
after "Adding a solar-radiance function to the Hosek–Wilkie skylight model", 2013, doi:10.1109/MCG.2013.18.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from seasonscapes.declaration import InputError
from seasonscapes.frames import angles_from_direction, equirectangular_directions
from seasonscapes.rendering.backend import point3, to_numpy, use_backend
from seasonscapes.sky.illumination import Illumination, Luminary, diffuse_horizontal_illuminance

# The emitter returns W·m⁻²·sr⁻¹·nm⁻¹ averaged over CIE Y; 683 lm/W times ∫ȳ dλ = 106.857 nm converts this to cd/m².
CD_M2_PER_UNIT = 683.0 * 106.857
SUN_ANGULAR_RADIUS_DEG = 0.2666


def hosek_illumination(
    sun_direction: np.ndarray,
    *,
    turbidity: float = 3.0,
    ground_albedo: float = 0.2,
    shape: tuple[int, int] = (128, 256),
) -> Illumination:
    """Compute the illumination of a clear day at sea level.

    Parameters
    ----------
    sun_direction
        ``(3,)`` apparent unit direction to the sun, ENU. It is passed to the emitter directly: the emitter's own
        computation from date and location uses a frame with x south and y west, a mirror image of ENU.
    turbidity
        1 (pure air) to 10 (very hazy).
    ground_albedo
        Reflectance of the ground, which lights the sky from below and is visible below the horizon.
    shape
        Rows and columns of the equirectangular sky map.

    Returns
    -------
    Illumination
        Sky map [cd/m²] and sun.

    Raises
    ------
    InputError
        If the sun is not above the horizon, or turbidity or albedo are outside the model's range.
    """
    _, elevation_deg = angles_from_direction(sun_direction)
    if elevation_deg <= 0.0:
        raise InputError(
            "--sky hosek",
            f"the sun stands at {float(elevation_deg):.2f}°, below the horizon, where this model has no radiance",
            cure="choose a time between sunrise and sunset, or the atmosphere model",
        )
    if not 1.0 <= turbidity <= 10.0:
        raise InputError("--turbidity", "outside the Hosek model", got=turbidity, expected="1 to 10")
    if not 0.0 <= ground_albedo <= 1.0:
        raise InputError("ground_albedo", "not a reflectance", got=ground_albedo, expected="0 to 1")
    use_backend()
    parameters = {
        "turbidity": float(turbidity),
        "albedo": float(ground_albedo),
        "sun_direction": list(map(float, sun_direction)),
    }
    directions = equirectangular_directions(*shape)
    above = directions[..., 2] > 0.0
    sky = np.zeros((*shape, 3))
    sky[above] = _evaluate({**parameters, "sun_scale": 0.0}, directions[above]) * CD_M2_PER_UNIT
    normal_illuminance = _sun_illuminance(parameters, np.asarray(sun_direction, float))
    sun = Luminary(np.asarray(sun_direction, float), normal_illuminance, SUN_ANGULAR_RADIUS_DEG)
    ground = diffuse_horizontal_illuminance(sky) + normal_illuminance * float(sun_direction[2])
    # Below the horizon the radiance blends from that of the horizon (haze) to that of sunlit ground.
    haze = np.exp(np.degrees(np.arcsin(directions[~above][:, 2])) / 4.0)[:, None]
    horizon = np.broadcast_to(sky[shape[0] // 2 - 1], sky[shape[0] // 2 :].shape).reshape(-1, 3)
    sky[~above] = haze * horizon + (1.0 - haze) * ground_albedo / np.pi * ground
    record = {"kind": "hosek", "turbidity": turbidity, "ground_albedo": ground_albedo}
    return Illumination(sky.astype(np.float32), sun, model=record)


def _sun_illuminance(
    parameters: dict[str, Any], direction: np.ndarray, rings: int = 12, spokes: int = 16
) -> np.ndarray:
    """Normal illuminance ``(3,)`` [lx]: limb-darkened radiance integrated over the solid angle of the disc."""
    axis = np.array([0.0, 0.0, 1.0]) if abs(direction[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    side = np.cross(direction, axis)
    side /= np.linalg.norm(side)
    other = np.cross(direction, side)
    # Gauss–Legendre quadrature in the squared radius, in which area is uniform.
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    angle = np.radians(SUN_ANGULAR_RADIUS_DEG) * np.sqrt(0.5 * (nodes + 1.0))
    spoke = np.arange(spokes) * (2.0 * np.pi / spokes)
    rim = np.cos(spoke)[:, None] * side + np.sin(spoke)[:, None] * other
    points = np.cos(angle)[:, None, None] * direction + np.sin(angle)[:, None, None] * rim
    aperture_deg = 2.0 * SUN_ANGULAR_RADIUS_DEG * 1.0001
    radiance = _evaluate({**parameters, "sky_scale": 0.0, "sun_aperture": aperture_deg}, points.reshape(-1, 3))
    mean = (0.5 * weights) @ radiance.reshape(rings, spokes, 3).mean(axis=1)
    return np.maximum(mean, 0.0) * CD_M2_PER_UNIT * np.pi * np.radians(SUN_ANGULAR_RADIUS_DEG) ** 2


def _evaluate(parameters: dict[str, Any], directions: np.ndarray) -> np.ndarray:
    """Radiance ``(N, 3)`` of a ``sunsky`` emitter along unit directions ``(N, 3)``."""
    import drjit as dr
    import mitsuba as mi

    emitter = mi.load_dict({"type": "sunsky", **parameters})
    if use_backend().device == "scalar":
        rows = []
        for direction in directions:
            interaction = mi.SurfaceInteraction3f()
            interaction.wi = -mi.Vector3f(*map(float, direction))
            rows.append(np.array(emitter.eval(interaction)))
        return np.array(rows)
    interaction = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    interaction.wi = -mi.Vector3f(point3(directions))
    return to_numpy(emitter.eval(interaction)).reshape(-1, 3).astype(np.float64)
