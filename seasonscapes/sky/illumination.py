"""All that rendering knows of light: sun, moon, the sky's radiance and the air between viewer and mountain."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import Protocol

import numpy as np

from seasonscapes.frames import LocalFrame, equirectangular_directions

# Linear Rec.709 weights of luminance (ITU-R BT.709): Y = w · rgb. Photometric RGB means that this Y is in lux or cd/m².
LUMINANCE_WEIGHTS = np.array([0.2126390, 0.7151687, 0.0721923])


@dataclass(frozen=True)
class Luminary:
    """A body that lights the scene from one direction: the sun or the moon, as seen through the air.

    Parameters
    ----------
    direction
        Unit vector towards the body, apparent (refracted), ``(3,)`` east-north-up.
    normal_illuminance_lx
        Illuminance on a plane facing it, photometric linear Rec.709, ``(3,)`` [lx].
    angular_radius_deg
        Apparent angular radius [deg].
    """

    direction: np.ndarray
    normal_illuminance_lx: np.ndarray
    angular_radius_deg: float


class AerialPerspective(Protocol):
    """What the air between a viewer and a surface takes away and adds."""

    def __call__(self, depth_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Transmittance ``(..., 3)`` in [0, 1] and airlight ``(..., 3)`` [cd/m²].

        Parameters
        ----------
        depth_m
            Distance from the viewer along the ray ``(...)`` [m]; infinite means no surface.
        direction
            Unit viewing directions, away from the viewer, ``(..., 3)`` east-north-up.
        """


@dataclass(frozen=True)
class Illumination:
    """The light of one instant at one place, in absolute photometric units.

    Parameters
    ----------
    sky_radiance
        Equirectangular map ``(H, W, 3)`` without the sun's and moon's discs, photometric linear Rec.709 [cd/m²].
        Row 0 is the zenith; column 0 begins at north and columns run clockwise. Rows below the horizon carry what
        a ray that leaves the modelled terrain downwards would meet.
    sun, moon
        Directional sources; ``None`` where below the horizon or too faint.
    aerial_perspective
        The air between viewer and surface, or ``None`` for clear space.
    visible_sky
        The map that the viewer sees behind the terrain, where that is not ``sky_radiance``: a camera on a summit looks
        at another sky than the one that lights the valley.
    model
        Name of the sky model and its parameters, for the record.
    frame
        The local frame in whose east-north-up axes all directions are given; ``None`` where it is not known.
    time
        The instant, aware; ``None`` where the light belongs to no instant.
    """

    sky_radiance: np.ndarray
    sun: Luminary | None = None
    moon: Luminary | None = None
    aerial_perspective: AerialPerspective | None = None
    visible_sky: np.ndarray | None = None
    model: dict = field(default_factory=dict)
    frame: LocalFrame | None = None
    time: datetime | None = None


def luminance(rgb: np.ndarray) -> np.ndarray:
    """Photometric Y ``(...)`` of linear Rec.709 ``(..., 3)``."""
    return np.asarray(rgb) @ LUMINANCE_WEIGHTS


def diffuse_horizontal_illuminance(sky_radiance: np.ndarray) -> np.ndarray:
    """Illuminance ``(3,)`` [lx] on the horizontal plane from the upper half of a map ``(H, W, 3)`` [cd/m²]."""
    height, width = sky_radiance.shape[:2]
    edges_deg = 90.0 - np.arange(height + 1) * (180.0 / height)
    # ∫ sin e cos e de over each row, exact; rows that straddle the horizon count with their upper part.
    sine_squared = np.sin(np.radians(np.clip(edges_deg, 0.0, 90.0))) ** 2
    weight = 0.5 * (sine_squared[:-1] - sine_squared[1:]) * (2.0 * np.pi / width)
    return np.einsum("h,hwc->c", weight, sky_radiance)


def direct_horizontal_illuminance(luminary: Luminary | None) -> np.ndarray:
    """Illuminance ``(3,)`` [lx] on the horizontal plane from a sun or moon."""
    if luminary is None:
        return np.zeros(3)
    return np.asarray(luminary.normal_illuminance_lx) * max(float(luminary.direction[2]), 0.0)


def global_horizontal_illuminance(illumination: Illumination) -> np.ndarray:
    """Illuminance ``(3,)`` [lx] on the horizontal plane from sun, moon and sky together."""
    return (
        diffuse_horizontal_illuminance(illumination.sky_radiance)
        + direct_horizontal_illuminance(illumination.sun)
        + direct_horizontal_illuminance(illumination.moon)
    )


def uniform_sky(radiance_rgb, *, height: int = 32) -> Illumination:
    """The same radiance from every direction (the white furnace), ``radiance_rgb`` ``(3,)`` or scalar [cd/m²]."""
    shape = equirectangular_directions(height, 2 * height).shape
    return Illumination(
        sky_radiance=np.broadcast_to(np.asarray(radiance_rgb, np.float32), shape).copy(), model={"kind": "uniform"}
    )
