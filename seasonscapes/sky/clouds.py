"""Cloudiness: the mean light under a sky that is partly covered, from clear to closed.

Clouds here have no shapes. The result is what hourly measurements see under a sky whose share ``c`` is covered: sun
dimmed and spread, shadows soft, sky greyer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.frames import equirectangular_directions
from seasonscapes.sky.illumination import (
    AerialPerspective,
    Illumination,
    Luminary,
    diffuse_horizontal_illuminance,
    direct_horizontal_illuminance,
    luminance,
)
from seasonscapes.sky.overcast import cloud_transmission, overcast_rgb, overcast_sky_radiance, standard_overcast

# Half angle of the cone that pyrheliometers, and so the measured direct light, take in (WMO-No. 8, ch. 7).
_AUREOLE_RADIUS_DEG = 2.5


@dataclass(frozen=True)
class _CloudedAir:
    """Clear air whose own airlight is dimmed, with the clouds' light scattered into it."""

    clear: AerialPerspective
    share: float
    airlight: np.ndarray

    def __call__(self, depth_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        transmittance, airlight = self.clear(depth_m, direction)
        return transmittance, self.share * airlight + (1.0 - transmittance) * self.airlight


def with_clouds(
    clear: Illumination,
    cloudiness: float,
    source_direction: np.ndarray,
    *,
    transmission: float | None = None,
    colour: np.ndarray | None = None,
) -> Illumination:
    """The light under a sky whose share ``cloudiness`` is covered; 0 returns ``clear`` unchanged.

    Global light falls as ``1 - (1 - t) c^3.4`` and its direct share as ``1 - c²``, the forms that Kasten & Czeplak
    (1980, Solar Energy 24, 177) found in ten years of hourly data, with their t = 0.25 at full cover replaced by
    `cloud_transmission`. The direct part shines from a disc that grows to the 2.5° a pyrheliometer takes for direct,
    so shadows soften. Of the clear sky ``1 - c`` is left; the rest of the diffuse light comes from clouds, in the CIE
    intermediate distribution while there are gaps and the overcast one when there are not.

    Parameters
    ----------
    clear
        Illumination without clouds.
    cloudiness
        In [0, 1].
    source_direction
        Towards the body that lights the clouds, also when it is below the horizon, ``(3,)``.
    transmission, colour
        Of the closed layer: the share it lets through, and its linear Rec.709 at luminance 1 ``(3,)``. Left out, those
        for the sun in ``source_direction``.

    Raises
    ------
    ValueError
        For a cloudiness outside [0, 1].
    """
    if not 0.0 <= cloudiness <= 1.0:
        raise ValueError(f"cloudiness: got {cloudiness}, expected 0 to 1")
    if cloudiness == 0.0:
        return clear
    source_direction = np.asarray(source_direction, float)
    elevation_deg = float(np.degrees(np.arcsin(np.clip(source_direction[2], -1.0, 1.0))))
    transmission = float(cloud_transmission(elevation_deg)) if transmission is None else transmission
    dimming = 1.0 - (1.0 - transmission) * cloudiness**3.4
    open_share, direct_share = 1.0 - cloudiness, dimming * (1.0 - cloudiness**2)
    direct = direct_horizontal_illuminance(clear.sun) + direct_horizontal_illuminance(clear.moon)
    diffuse = diffuse_horizontal_illuminance(clear.sky_radiance)
    # Luminance decides how much light the clouds send; they are grey, and lit by all of it.
    total = float(luminance(direct + diffuse)) * dimming
    from_clouds = total - float(luminance(direct)) * direct_share - float(luminance(diffuse)) * open_share
    grey = max(from_clouds, 0.0) * (overcast_rgb(elevation_deg) if colour is None else colour)
    height = clear.sky_radiance.shape[0]
    broken = overcast_sky_radiance(grey, height, ground_albedo=0.0, source_direction=source_direction)
    closed = overcast_sky_radiance(grey, height, ground_albedo=0.0)
    sky = open_share * (clear.sky_radiance + broken) + cloudiness * closed
    # The rows below the horizon follow the light that falls on them.
    falls = (direct * direct_share + diffuse * open_share + grey) / np.maximum(direct + diffuse, 1e-12)
    below = equirectangular_directions(height, 2 * height)[:, 0, 2] <= 0.0
    sky[below] = clear.sky_radiance[below] * falls
    air = clear.aerial_perspective
    if air is not None:
        horizon = standard_overcast(0.0) * cloudiness * grey + open_share * grey / np.pi
        air = _CloudedAir(air, open_share, horizon)
    return Illumination(
        sky_radiance=sky.astype(np.float32),
        sun=_veiled(clear.sun, direct_share, cloudiness),
        moon=_veiled(clear.moon, direct_share, cloudiness),
        aerial_perspective=air,
        model={**clear.model, "cloudiness": cloudiness},
    )


def _veiled(luminary: Luminary | None, share: float, cloudiness: float) -> Luminary | None:
    if luminary is None or share <= 0.0:
        return None
    radius = luminary.angular_radius_deg
    return replace(
        luminary,
        normal_illuminance_lx=np.asarray(luminary.normal_illuminance_lx) * share,
        angular_radius_deg=radius + (max(_AUREOLE_RADIUS_DEG, radius) - radius) * cloudiness,
    )
