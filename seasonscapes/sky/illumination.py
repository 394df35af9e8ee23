"""Data model of illumination: sun, moon, sky radiance and aerial perspective, the renderer's only light sources.

Also the illuminances on the horizontal plane that follow from them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.frames import LocalFrame, equirectangular_directions
from seasonscapes.images import REC709_LUMINANCE
from seasonscapes.photo_look import white_point


@dataclass(frozen=True)
class Luminary:
    """Directional light source, the sun or the moon, after attenuation by the atmosphere.

    Parameters
    ----------
    direction
        Apparent (refracted) unit vector towards the source, ``(3,)`` east-north-up.
    normal_illuminance_lx
        Illuminance on a plane perpendicular to the direction, photometric linear Rec.709, ``(3,)`` [lx].
    angular_radius_deg
        Apparent angular radius [deg].
    """

    direction: np.ndarray
    normal_illuminance_lx: np.ndarray
    angular_radius_deg: float

    @property
    def azimuth_deg(self) -> float:
        """Apparent azimuth, clockwise from north [deg]."""
        return float(np.degrees(np.arctan2(self.direction[0], self.direction[1])) % 360.0)

    @property
    def elevation_deg(self) -> float:
        """Apparent elevation [deg]."""
        return float(np.degrees(np.arcsin(np.clip(self.direction[2], -1.0, 1.0))))


class AerialPerspective(Protocol):
    """Transmittance and airlight of the air between a viewer and a surface."""

    def __call__(self, depth_m: np.ndarray | float, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate transmittance and airlight along rays from the viewer.

        Parameters
        ----------
        depth_m
            Distance from the viewer along the ray ``(...)`` [m], infinite for a ray without surface; or one number for all
            rays, or D distances ``(D, 1, ..., 1)`` along each of them.
        direction
            Unit viewing directions, away from the viewer, ``(..., 3)`` east-north-up.

        Returns
        -------
        transmittance
            In [0, 1], of a shape that broadcasts to ``(..., 3)``, or to ``(D, ..., 3)``.
        airlight
            Radiance scattered into the ray [cd/m²], likewise.
        """
        ...


@dataclass(frozen=True)
class ScaledAir:
    """Aerial perspective with airlight of another strength.

    Parameters
    ----------
    air
        The unchanged one.
    factor
        Of its airlight: ``(3,)``, or any shape that broadcasts to it.
    """

    air: AerialPerspective
    factor: np.ndarray

    def __call__(self, depth_m: np.ndarray | float, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return transmittance and airlight; see `AerialPerspective`."""
        transmittance, airlight = self.air(depth_m, direction)
        return transmittance, airlight * self.factor


@dataclass(frozen=True)
class Illumination:
    """Illumination of a scene at one instant and place, in absolute photometric units.

    Parameters
    ----------
    sky_radiance
        Equirectangular map ``(H, W, 3)`` without the discs of sun and moon, photometric linear Rec.709 [cd/m²].
        Row 0 is the zenith; column 0 begins at north and columns run clockwise. Rows below the horizon hold the
        radiance of rays that leave the modelled terrain downwards.
    sun, moon
        Directional sources; ``None`` where below the horizon or too faint.
    aerial_perspective
        Air between viewer and surface, or ``None`` for a vacuum.
    visible_sky
        Map of the sky behind the terrain as observed by the camera, where it differs from ``sky_radiance``: the sky
        observed from a summit differs from the sky that illuminates the valley. Without rows, ``(0, 0, 3)``, where the
        airlight at infinite distance is all of it.
    efficacy_lm_w
        Luminous efficacies of sunlight and of skylight [lm/W], where the sky model knows the infrared.
    model
        Name of the sky model and its parameters, for provenance.
    frame
        Local frame of all directions; ``None`` if unknown.
    time
        Aware datetime; ``None`` if the illumination does not belong to an instant.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> light = ss.illumination(place, "2024-07-20T13:30", sky="hosek")
    >>> light.model["name"], light.sky_radiance.shape[2]
    ('hosek', 3)
    """

    sky_radiance: np.ndarray
    sun: Luminary | None = None
    moon: Luminary | None = None
    aerial_perspective: AerialPerspective | None = None
    visible_sky: np.ndarray | None = None
    efficacy_lm_w: tuple[float, float] | None = None
    model: dict[str, Any] = field(default_factory=dict)
    frame: LocalFrame | None = None
    time: datetime | None = None

    @property
    def global_horizontal_lx(self) -> np.ndarray:
        """Illuminance ``(3,)`` of level ground from sun, moon and sky [lx]; see `global_horizontal_illuminance`."""
        return global_horizontal_illuminance(self)

    @property
    def cloudiness(self) -> float:
        """Cloud fraction of its sky model, 0 to 1."""
        return float(self.model.get("cloudiness", 0.0))

    @property
    def white_rgb(self) -> tuple[float, float, float]:
        """The colour that a camera takes for white under this light, linear Rec.709; see `photo_look.white_point`."""
        return white_point(None if self.sun is None else np.asarray(self.sun.normal_illuminance_lx))


def luminance(rgb: np.ndarray) -> np.ndarray:
    """Compute the luminance Y of linear Rec.709.

    Parameters
    ----------
    rgb
        Linear Rec.709 ``(..., 3)``.

    Returns
    -------
    ndarray
        Luminance ``(...)`` in the unit of ``rgb``.
    """
    return np.asarray(rgb) @ REC709_LUMINANCE


def diffuse_horizontal_illuminance(sky_radiance: np.ndarray) -> np.ndarray:
    """Integrate the illuminance on the horizontal plane from the upper hemisphere of a sky map.

    Parameters
    ----------
    sky_radiance
        Equirectangular map ``(H, W, C)`` [cd/m²], as in `Illumination`.

    Returns
    -------
    ndarray
        Illuminance ``(C,)`` [lx].
    """
    height, width = sky_radiance.shape[:2]
    edges_deg = 90.0 - np.arange(height + 1) * (180.0 / height)
    # Exact ∫ sin e cos e de over each row; a row that straddles the horizon is counted with its upper part.
    sine_squared = np.sin(np.radians(np.clip(edges_deg, 0.0, 90.0))) ** 2
    weight = 0.5 * (sine_squared[:-1] - sine_squared[1:]) * (2.0 * np.pi / width)
    return np.einsum("h,hwc->c", weight, sky_radiance)


def direct_horizontal_illuminance(luminary: Luminary | None) -> np.ndarray:
    """Compute the illuminance on the horizontal plane from a directional source.

    Parameters
    ----------
    luminary
        Sun or moon; ``None`` gives zero.

    Returns
    -------
    ndarray
        Illuminance ``(3,)`` [lx].
    """
    if luminary is None:
        return np.zeros(3)
    return np.asarray(luminary.normal_illuminance_lx) * max(float(luminary.direction[2]), 0.0)


def global_horizontal_illuminance(illumination: Illumination) -> np.ndarray:
    """Compute the illuminance on the horizontal plane from sun, moon and sky together.

    Parameters
    ----------
    illumination
        Illumination of one instant.

    Returns
    -------
    ndarray
        Illuminance ``(3,)`` [lx].
    """
    return (
        diffuse_horizontal_illuminance(illumination.sky_radiance)
        + direct_horizontal_illuminance(illumination.sun)
        + direct_horizontal_illuminance(illumination.moon)
    )


def uniform_sky(radiance_rgb: ArrayLike, *, height: int = 32) -> Illumination:
    """Build an illumination of equal radiance in all directions (white furnace).

    Parameters
    ----------
    radiance_rgb
        Radiance ``(3,)`` or scalar [cd/m²].
    height
        Rows of the sky map; it has twice as many columns.

    Returns
    -------
    Illumination
        Sky of uniform radiance, without sun, moon and air.

    Examples
    --------
    >>> diffuse_horizontal_illuminance(uniform_sky(1.0).sky_radiance).round(3)
    array([3.142, 3.142, 3.142])
    """
    shape = equirectangular_directions(height, 2 * height).shape
    return Illumination(
        sky_radiance=np.broadcast_to(np.asarray(radiance_rgb, np.float32), shape).copy(), model={"kind": "uniform"}
    )
