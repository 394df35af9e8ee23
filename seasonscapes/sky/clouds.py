"""Mean illumination under a partly or fully cloudy sky, parameterised by cloud fraction.

Individual clouds are not modelled. The result is the mean over about an hour of a sky with cloud fraction ``c``:
attenuated and spread direct light, soft shadows, a greyer sky.
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

# Half opening angle of pyrheliometers, within which light is measured as direct (WMO-No. 8, ch. 7).
_AUREOLE_RADIUS_DEG = 2.5


@dataclass(frozen=True)
class _CloudyAerialPerspective:
    """Aerial perspective of the clear sky with reduced airlight, plus airlight from the clouds."""

    clear: AerialPerspective
    clear_fraction: float
    cloud_radiance: np.ndarray

    def __call__(self, depth_m: np.ndarray | float, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        transmittance, airlight = self.clear(depth_m, direction)
        return transmittance, self.clear_fraction * airlight + (1.0 - transmittance) * self.cloud_radiance


def with_clouds(
    clear: Illumination,
    cloudiness: float,
    source_direction: np.ndarray,
    *,
    transmission: float | None = None,
    colour: np.ndarray | None = None,
) -> Illumination:
    """Compute the illumination under a cloud fraction from that of the clear sky.

    Global illuminance is multiplied by ``1 - (1 - t) c^3.4`` and the direct part in addition by ``1 - c²``, the forms
    that Kasten & Czeplak (1980, doi:10.1016/0038-092X(80)90391-6) fitted to ten years of hourly data, with their
    t = 0.25 at full cover replaced by `cloud_transmission`. Direct light comes from a disc that grows with ``c`` to the 2.5° opening of
    pyrheliometers, which softens shadows. Sky radiance is ``1 - c`` times the clear one; clouds contribute the
    remaining diffuse illuminance, as a blend with weight ``c`` from the CIE intermediate to the CIE overcast
    distribution.

    Parameters
    ----------
    clear
        Illumination without clouds.
    cloudiness
        Cloud fraction c in [0, 1]; 0 returns ``clear`` unchanged.
    source_direction
        Unit vector towards the body that illuminates the clouds, possibly below the horizon ``(3,)``.
    transmission
        Transmission t of a closed cloud layer; by default that for the sun in ``source_direction``.
    colour
        Linear Rec.709 of a closed cloud layer at luminance 1 ``(3,)``; by default that for the sun in
        ``source_direction``.

    Returns
    -------
    Illumination
        Illumination with the frame, the time and, under the same clouds, the ``visible_sky`` of ``clear``.

    Raises
    ------
    ValueError
        If the cloudiness is outside [0, 1].
    """
    if not 0.0 <= cloudiness <= 1.0:
        raise ValueError(f"cloudiness: got {cloudiness}, expected 0 to 1")
    if cloudiness == 0.0:
        return clear
    source_direction = np.asarray(source_direction, float)
    elevation_deg = float(np.degrees(np.arcsin(np.clip(source_direction[2], -1.0, 1.0))))
    transmission = float(cloud_transmission(elevation_deg)) if transmission is None else transmission
    dimming = 1.0 - (1.0 - transmission) * cloudiness**3.4
    clear_fraction, direct_factor = 1.0 - cloudiness, dimming * (1.0 - cloudiness**2)
    direct = direct_horizontal_illuminance(clear.sun) + direct_horizontal_illuminance(clear.moon)
    diffuse = diffuse_horizontal_illuminance(clear.sky_radiance)
    # The illuminance of the clouds follows from the balance of luminance; their colour is that of the layer.
    total = float(luminance(direct + diffuse)) * dimming
    from_clouds = total - float(luminance(direct)) * direct_factor - float(luminance(diffuse)) * clear_fraction
    grey = max(from_clouds, 0.0) * (overcast_rgb(elevation_deg) if colour is None else colour)
    # Rows below the horizon show ground, whose radiance is proportional to the illuminance on it.
    ground_ratio = (direct * direct_factor + diffuse * clear_fraction + grey) / np.maximum(direct + diffuse, 1e-12)

    def cloudy(clear_radiance: np.ndarray) -> np.ndarray:
        height = clear_radiance.shape[0]
        broken = overcast_sky_radiance(grey, height, ground_albedo=0.0, source_direction=source_direction)
        closed = overcast_sky_radiance(grey, height, ground_albedo=0.0)
        sky = clear_fraction * (clear_radiance + broken) + cloudiness * closed
        below = equirectangular_directions(height, 2 * height)[:, 0, 2] <= 0.0
        sky[below] = clear_radiance[below] * ground_ratio
        return sky.astype(np.float32)

    air = clear.aerial_perspective
    if air is not None:
        horizon = standard_overcast(0.0) * cloudiness * grey + clear_fraction * grey / np.pi
        air = _CloudyAerialPerspective(air, clear_fraction, horizon)
    return replace(
        clear,
        sky_radiance=cloudy(clear.sky_radiance),
        sun=_attenuated(clear.sun, direct_factor, cloudiness),
        moon=_attenuated(clear.moon, direct_factor, cloudiness),
        aerial_perspective=air,
        visible_sky=None if clear.visible_sky is None else cloudy(clear.visible_sky),
        model={**clear.model, "cloudiness": cloudiness},
    )


def _attenuated(luminary: Luminary | None, factor: float, cloudiness: float) -> Luminary | None:
    """A luminary of reduced illuminance whose disc is widened towards the aureole's radius."""
    if luminary is None or factor <= 0.0:
        return None
    radius = luminary.angular_radius_deg
    return replace(
        luminary,
        normal_illuminance_lx=np.asarray(luminary.normal_illuminance_lx) * factor,
        angular_radius_deg=radius + (max(_AUREOLE_RADIUS_DEG, radius) - radius) * cloudiness,
    )
