"""Reflection by open water: an exact dielectric whose waves have the slopes of Cox & Munk.

A facet of the waves reflects the share of light that Fresnel's equations give. What it lets in comes out of the body of
the water as diffuse light in proportion to the irradiance of the surface, as the albedo texture says (the irradiance
reflectance of ocean optics); it leaves through the facet that the viewer sees, which lets through what it does not
reflect. A viewer sees facets in proportion to the area that they turn to him (masking after Smith for Gaussian slopes,
Walter et al. 2007, § 5.3). Reflected rays that would go down meet another wave and count as reflected up from it, so that
no light is lost under grazing views.

Light that water sends to other ground is taken as spread evenly: its caustics on the shore are not rendered.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from seasonscapes.frames import MEAN_RADIUS_M, LocalFrame
from seasonscapes.rendering.backend import aligned, use_backend
from seasonscapes.terrain.surface_classes import Water

# Of fresh water at 20 °C in the middle of the visible spectrum.
REFRACTIVE_INDEX = 1.333


def fresnel_reflectance(cosine: np.ndarray, refractive_index: float = REFRACTIVE_INDEX) -> np.ndarray:
    """Reflectance of a smooth dielectric for unpolarised light from air: Fresnel's equations.

    Parameters
    ----------
    cosine
        Cosine of the angle of incidence, 0 to 1.
    refractive_index
        Of the medium.

    Returns
    -------
    numpy.ndarray
        Of the shape of ``cosine``.

    Examples
    --------
    >>> [round(float(fresnel_reflectance(np.cos(np.radians(angle)))), 3) for angle in (0, 60, 85)]
    [0.02, 0.059, 0.584]
    """
    cosine = np.asarray(cosine, float)
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / refractive_index**2)
    across = (cosine - refractive_index * inside) / (cosine + refractive_index * inside)
    along = (inside - refractive_index * cosine) / (inside + refractive_index * cosine)
    return 0.5 * (across**2 + along**2)


def diffuse_reflectance(refractive_index: float = REFRACTIVE_INDEX) -> float:
    """Share of evenly diffuse light that smooth water reflects: the cosine-weighted mean of `fresnel_reflectance`."""
    node, weight = np.polynomial.legendre.leggauss(64)
    cosine = 0.5 * (node + 1.0)
    return float(np.sum(weight * cosine * fresnel_reflectance(cosine, refractive_index)))


def slope_variance(wind_m_s: float) -> float:
    """Mean square slope of water under a wind, of both directions together.

    Cox & Munk 1954, doi:10.1364/JOSA.44.000838: 0.003 + 0.00512 W for a wind W at 12.5 m height, measured from 1 to 14 m/s. Below 1 m/s its constant,
    which is smaller than its own standard error, fades out: without wind a lake is a mirror.

    Parameters
    ----------
    wind_m_s
        Wind speed [m/s].

    Examples
    --------
    >>> slope_variance(0.0), round(slope_variance(5.0), 4)
    (0.0, 0.0286)
    """
    return 0.003 * min(wind_m_s, 1.0) + 0.00512 * wind_m_s


class DeviceWater:
    """A `Water` on the Dr.Jit device, with the optics of its surface.

    Parameters
    ----------
    water
        The water.
    frame
        Local frame of the terrain, in which still water follows the curvature of the Earth.
    """

    def __init__(self, water: Water, frame: LocalFrame) -> None:
        use_backend()
        import drjit as dr
        import mitsuba as mi

        # The stub of Dr.Jit gives the texture types as `object`.
        self._mi_mask: Any = mi.Texture2f(  # pyright: ignore[reportCallIssue]
            mi.TensorXf(aligned(water.mask[..., None])), use_accel=False, wrap_mode=dr.WrapMode.Clamp
        )
        self._mi_curvature = dr.opaque(mi.Float, (1.0 - frame.refraction_k) / MEAN_RADIUS_M)
        self.roughness = float(np.sqrt(slope_variance(water.wind_m_s)))
        self.smooth = self.roughness == 0.0
        # Beckmann's distribution of slopes is a Gaussian of this width.
        self._mi_roughness = dr.opaque(mi.Float, self.roughness)
        self.diffuse_reflectance = diffuse_reflectance()

    def covers(self, mi_uv: Any, active: Any = True) -> Any:
        """Whether there is water (``mi.Bool``) at texture coordinates ``mi.Point2f`` of the mesh."""
        return self._mi_mask.eval(mi_uv, active)[0] > 0.5

    def vertical(self, mi_position: Any) -> Any:
        """Normal ``mi.Normal3f`` of still water at positions."""
        import drjit as dr
        import mitsuba as mi

        tilt = self._mi_curvature
        return dr.normalize(mi.Normal3f(mi_position.x * tilt, mi_position.y * tilt, 1.0))

    def hemispherical(self, mi_albedo: Any) -> Any:
        """Reflectance of the surface for diffuse light, where its body has an albedo."""
        return self.diffuse_reflectance + (1.0 - self.diffuse_reflectance) * mi_albedo

    def mirrored(self, mi_normal: Any, mi_viewer: Any, mi_sample: Any) -> tuple[Any, Any]:
        """Direction from which a facet that the viewer sees reflects light, and its reflectance.

        Parameters
        ----------
        mi_normal
            ``mi.Normal3f`` of the still water.
        mi_viewer
            ``mi.Vector3f`` towards the viewer.
        mi_sample
            ``mi.Point2f`` that chooses the facet.
        """
        import drjit as dr
        import mitsuba as mi

        frame = mi.Frame3f(mi_normal)
        local = self._above(frame.to_local(mi_viewer))
        if self.smooth:
            facet = mi.Normal3f(0.0, 0.0, 1.0)
        else:
            facet, _ = self._waves().sample(local, mi_sample)
        cosine = dr.clip(dr.dot(local, facet), 0.0, 1.0)
        direction = 2.0 * cosine * facet - local
        direction.z = dr.abs(direction.z)
        return frame.to_world(dr.normalize(direction)), _fresnel(cosine)

    def glitter(self, mi_normal: Any, mi_viewer: Any, mi_light: Any) -> Any:
        """Radiance towards the viewer for unit normal irradiance from a small light [1/sr]; 0 for smooth water.

        Of smooth water, a light is seen by following the mirrored ray.
        """
        import drjit as dr
        import mitsuba as mi

        if self.smooth:
            return mi.Float(0.0)
        frame, waves = mi.Frame3f(mi_normal), self._waves()
        local, light = self._above(frame.to_local(mi_viewer)), frame.to_local(mi_light)
        total = mi.Float(0.0)
        # Directly, and by way of a second wave.
        for source in (light, mi.Vector3f(light.x, light.y, -light.z)):
            facet = dr.normalize(local + source)
            cosine = dr.dot(local, facet)
            density = waves.pdf(local, facet) / (4.0 * cosine)
            seen = (facet.z > 0.0) & (cosine > 1e-4) & (light.z > 0.0)
            total += dr.select(seen, density * _fresnel(cosine), 0.0)
        return total

    def _waves(self) -> Any:
        import mitsuba as mi

        # The stubs name another float type.
        return mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, self._mi_roughness, True)  # pyright: ignore[reportArgumentType, reportCallIssue]

    @staticmethod
    def _above(local: Any) -> Any:
        """A direction of a viewer who sees the surface: on facets of the mesh that stand up, it may lie below it."""
        import drjit as dr
        import mitsuba as mi

        return dr.normalize(mi.Vector3f(local.x, local.y, dr.maximum(dr.abs(local.z), 1e-3)))


def _fresnel(cosine: Any) -> Any:
    """`fresnel_reflectance` on the device."""
    import mitsuba as mi

    # The stubs name another float type.
    return mi.fresnel(cosine, REFRACTIVE_INDEX)[0]  # pyright: ignore[reportArgumentType]
