"""Light that the water in a view mirrors under a given illumination, from its mirror coefficients.

Mirrored ground is lit like that of a pixel: by sky and clusters through coefficients of its own, by sun and moon through
shadow rays. Mirrored sky is looked up in the sky map. Sun and moon themselves glitter in waves, and are seen as discs in
smooth water.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from seasonscapes.rendering.backend import point3, to_numpy
from seasonscapes.rendering.coefficients import MirrorCoefficients, ViewCoefficients
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.rendering.mitsuba_scene import mi_sky
from seasonscapes.rendering.receivers import (
    ClusterLight,
    DeviceReceivers,
    luminaries,
    total_incident_light,
    upload_receivers,
)
from seasonscapes.rendering.sun_visibility import SunRays, bayer_disc_offset, sum_incidence, sun_rays
from seasonscapes.rendering.terrain_material import device_water
from seasonscapes.rendering.water_surface import DeviceWater
from seasonscapes.sky.illumination import Illumination, Luminary

# Directions of mirrored sky in one look-up; bounds the memory.
_LANES = 1 << 22


# The filter against grain is at most so many pixels wide (standard deviation), and so small a part of what waves spread over.
_BLUR_PX, _BLUR_SHARE = 2.0, 0.125
# Share of a pixel from which on it is all water.
_WHOLE = 0.99


@dataclass(frozen=True)
class WaveBlur:
    """A filter of what neighbouring pixels of rough water mirror.

    Waves spread each mirrored point over many pixels, mostly upwards and downwards; a few facets per pixel leave grain of it.
    The filter is much narrower than that spread. What one pixel gives another it gets back in the same measure: the sum of the
    light stays, and so does even light.

    Parameters
    ----------
    row, column
        ``(m,)`` of the pixels in a part of the image that holds them.
    vertical_px
        Standard deviation of the filter along columns [px].
    down, across
        ``(m,)`` float32 0 to 1: how much pixels take part along columns, and along rows, where the filter is a binomial one
        of three pixels. Pixels that hold something else than water do not.
    """

    row: np.ndarray
    column: np.ndarray
    vertical_px: float
    down: np.ndarray
    across: np.ndarray

    def applied(self, radiance: np.ndarray) -> np.ndarray:
        """Filter radiance ``(m, 3)``."""
        import cv2

        reach = int(np.ceil(3.0 * self.vertical_px))
        along_columns = cv2.getGaussianKernel(2 * reach + 1, self.vertical_px, cv2.CV_32F)
        radiance = self._exchanged(radiance, self.down, along_columns)
        return self._exchanged(radiance, self.across, np.array([[0.25, 0.5, 0.25]], np.float32))

    def _exchanged(self, radiance: np.ndarray, part: np.ndarray, kernel: np.ndarray) -> np.ndarray:
        """Exchange light between pixels i and j by the symmetric weights part i × part j × kernel (i - j)."""
        import cv2

        image = np.zeros((self.row.max() + 1, self.column.max() + 1, 4), np.float32)
        image[self.row, self.column] = np.c_[radiance * part[:, None], part]
        near = cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_CONSTANT)[self.row, self.column]
        return radiance + part[:, None] * (near[:, :3] - radiance * near[:, 3:])


@dataclass(frozen=True)
class DeviceMirror:
    """What the water in a view mirrors, on the Dr.Jit device: m pixels show water, with S samples each.

    Parameters
    ----------
    coefficients
        In host memory.
    albedo
        ``(m, 3)`` mean reflectance × albedo of the mirrored ground, as in `MirrorCoefficients`.
    receivers
        Coefficients of the mirrored ground.
    ground_rays, water_rays
        Shadow rays from the mirrored ground, and from the water.
    water
        Optics of the water's surface.
    normal, viewer
        ``(m, 3)`` float32 unit normals of the water in the pixels, and unit directions towards the camera.
    pixel_angle_rad
        Angular size of a pixel [rad].
    blur
        Over which pixels waves spread what they mirror; ``None`` for smooth water.
    """

    coefficients: MirrorCoefficients
    albedo: np.ndarray
    receivers: DeviceReceivers
    ground_rays: SunRays
    water_rays: SunRays
    water: DeviceWater
    normal: np.ndarray
    viewer: np.ndarray
    pixel_angle_rad: float
    blur: WaveBlur | None


def upload_mirror(terrain: RayScene, view: ViewCoefficients) -> DeviceMirror | None:
    """Copy the mirror coefficients of a view to the device.

    Parameters
    ----------
    terrain
        The terrain, with water, that occludes shadow rays.
    view
        Coefficients of the view, possibly memory-mapped.

    Returns
    -------
    DeviceMirror or None
        ``None`` where the view shows no water.
    """
    mirror, water = view.mirror, device_water(terrain.mi_terrain.bsdf())
    if mirror is None or water is None:
        return None
    offset = bayer_disc_offset(view.pixel[mirror.pixel], view.camera.width_px, view.sampling.shadow_samples)
    ground_rays = sun_rays(
        terrain, mirror.sample_origin, mirror.sample_normal, mirror.sample_outward, mirror.sample_weight, offset
    )
    origin, normals = view.sample_origin[mirror.pixel], view.sample_normal[mirror.pixel]
    water_rays = sun_rays(terrain, origin, normals, view.sample_outward[mirror.pixel], mirror.water_weight, offset)
    weight = np.asarray(mirror.water_weight, np.float32)[..., None]
    towards = np.asarray(view.camera.position_m, np.float32) - origin
    normal, viewer = (_unit((weight * each).sum(axis=1, dtype=np.float32)) for each in (normals, towards))
    return DeviceMirror(
        mirror,
        np.asarray(mirror.albedo, np.float32),
        upload_receivers(mirror.receivers),
        ground_rays,
        water_rays,
        water,
        normal,
        viewer,
        1.0 / float(view.camera.fx),
        None if water.smooth else _wave_blur(view, mirror, normal, viewer, water),
    )


def _wave_blur(
    view: ViewCoefficients, mirror: MirrorCoefficients, normal: np.ndarray, viewer: np.ndarray, water: DeviceWater
) -> WaveBlur:
    row, column = np.divmod(view.pixel[mirror.pixel].astype(np.int64), view.camera.width_px)
    # Slopes turn mirrored rays by twice their angle; sideways by the sine of the grazing angle less.
    spread_px = 2.0 * water.roughness / np.sqrt(2.0) * float(view.camera.fx)
    grazing = np.abs((normal * viewer).sum(axis=1))
    across = np.clip(_BLUR_SHARE * spread_px * grazing / 0.7, 0.0, 1.0)
    whole = (np.asarray(mirror.water_weight, np.float32).sum(axis=1) > _WHOLE).astype(np.float32)
    vertical_px = max(min(_BLUR_PX, _BLUR_SHARE * spread_px), 0.1)
    across = whole * np.sqrt(across).astype(np.float32)
    return WaveBlur(row - row.min(), column - column.min(), vertical_px, whole, across)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def mirrored_radiance(mirror: DeviceMirror, illumination: Illumination, light: ClusterLight) -> np.ndarray:
    """Compute the radiance that the water in pixels mirrors.

    Parameters
    ----------
    mirror
        From `upload_mirror`.
    illumination
        Sky, sun and moon.
    light
        From `receivers.light_clusters`, of the same illumination.

    Returns
    -------
    numpy.ndarray
        ``(m, 3)`` float32 [cd/m²], averaged over the pixel; its other ground and sky count as black.
    """
    irradiance = total_incident_light(mirror.receivers, light)
    glitter = np.zeros_like(irradiance)
    pixels = np.arange(len(irradiance))
    for body in luminaries(illumination):
        normal_illuminance = np.asarray(body.normal_illuminance_lx, np.float32)
        irradiance += (
            sum_incidence(mirror.ground_rays, body, pixels)[0][:, None] * normal_illuminance / np.float32(np.pi)
        )
        if not mirror.water.smooth:
            glitter += (_visible_share(mirror, body) * _glitter(mirror, body))[:, None] * normal_illuminance
    mirrored = irradiance * mirror.albedo + _mirrored_sky(mirror, illumination)
    return (mirrored if mirror.blur is None else mirror.blur.applied(mirrored)) + glitter


def _visible_share(mirror: DeviceMirror, body: Luminary) -> np.ndarray:
    """Share ``(m,)`` of the pixels that is water from which a luminary is seen."""
    visible, unoccluded = sum_incidence(mirror.water_rays, body, np.arange(len(mirror.albedo)))
    water = np.asarray(mirror.coefficients.water_weight, np.float32).sum(axis=1)
    return water * visible / np.maximum(unoccluded, 1e-9)


def _glitter(mirror: DeviceMirror, body: Luminary) -> np.ndarray:
    """Radiance ``(m,)`` of water for unit normal irradiance from a luminary [1/sr]."""
    import drjit as dr
    import mitsuba as mi

    # The stubs reject normals as vectors.
    normal = cast(Any, mi.Normal3f(point3(mirror.normal)))
    light = mi.Vector3f(*(dr.opaque(mi.Float, float(axis)) for axis in body.direction))  # no kernel for each hour
    return np.array(mirror.water.glitter(normal, mi.Vector3f(point3(mirror.viewer)), light))


def _mirrored_sky(mirror: DeviceMirror, illumination: Illumination) -> np.ndarray:
    """Radiance ``(m, 3)`` of the sky in the water; in smooth water with the discs of sun and moon."""
    share = np.asarray(mirror.coefficients.sky_share, np.float32)
    total = np.zeros((*share.shape, 3), np.float32)
    row, sample = np.nonzero(share > 0.0)
    direction = mirror.coefficients.sky_direction[row, sample]
    total[row, sample] = _sky(illumination, direction)
    if mirror.water.smooth:
        for body in luminaries(illumination):
            angle = np.linalg.norm(direction - np.asarray(body.direction, np.float32), axis=1)
            radius = np.radians(body.angular_radius_deg)
            inside = np.clip((radius - angle) / mirror.pixel_angle_rad + 0.5, 0.0, 1.0)
            disc = np.asarray(body.normal_illuminance_lx) / (4.0 * np.pi * np.sin(0.5 * radius) ** 2)
            total[row, sample] += (inside[:, None] * disc).astype(np.float32)
    return np.einsum("ms,msc->mc", share, total)


def _sky(illumination: Illumination, direction: np.ndarray) -> np.ndarray:
    """Radiance ``(N, 3)`` of the sky map in directions ``(N, 3)``, with the filter of the path tracer's."""
    import drjit as dr
    import mitsuba as mi

    result = np.zeros((len(direction), 3), np.float32)
    if illumination.sky_radiance.max() <= 0.0:
        return result
    emitter = mi_sky(illumination.sky_radiance)
    for start in range(0, len(direction), _LANES):
        interaction = dr.zeros(mi.SurfaceInteraction3f)
        interaction.wi = -mi.Vector3f(point3(direction[start : start + _LANES]))
        result[start : start + _LANES] = to_numpy(emitter.eval(interaction))
    return result
