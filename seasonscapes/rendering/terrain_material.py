"""Material of terrain: Lambertian ground whose normals come from a smooth surface, and water that mirrors.

The triangles decide what is visible. Slopes for shading are those of the heights (`terrain.surface.SurfaceGrid`), so that
large facets shade like the ground that they approximate: a plain stays level up to the foot of a cliff, and shaded
slopes show no triangles. A facet is lit and seen as the surface that it approximates:

* It reflects towards every viewer that sees its front, also where the smooth normal faces away from the viewer. Normals
  that face away would otherwise make black slivers along crests.
* Rays start from the smooth surface where this lies above the facet (cf. Hanika 2021, "Hacking the shadow terminator",
  in Ray Tracing Gems II, doi:10.1007/978-1-4842-7185-8_4), and not from the facet, whose plane would cut them off.

Water (`water_surface`) mirrors where the viewer sees it, directly or in other water; lit by it or seen in the diffuse light
of other ground, it is Lambertian. So are snow (`snow_scattering`) and forest (`forest_scattering`) but for the light that
they send to the viewer directly.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from seasonscapes.rendering.albedo_detail import DeviceDetail
from seasonscapes.rendering.backend import aligned, use_backend
from seasonscapes.rendering.grid_placement import GridPlacement
from seasonscapes.rendering.ground_optics import GroundOptics, optics_of
from seasonscapes.rendering.image_detail import DeviceImages
from seasonscapes.rendering.snow_scattering import SnowOptics
from seasonscapes.rendering.water_surface import REFRACTIVE_INDEX, DeviceWater, slope_variance
from seasonscapes.terrain.surface import SurfaceGrid, Terrain
from seasonscapes.terrain.surface_classes import Water

log = logging.getLogger(__name__)

# Mitsuba's math::RayEpsilon in single precision.
RAY_EPSILON = float(np.finfo(np.float32).epsneg) * 1500.0
_PLUGIN = "seasonscapes_terrain"
# Farthest start of shadow rays, in spacings of the surface's nodes.
_REACH_NODES = 3.0


class DeviceSurface:
    """A `SurfaceGrid` on the Dr.Jit device.

    Parameters
    ----------
    grid
        The surface.
    """

    def __init__(self, grid: SurfaceGrid) -> None:
        import drjit as dr
        import mitsuba as mi

        # Without the texture units of a GPU, whose interpolation weights have 8 bits.
        self._mi_texture: Any = mi.Texture2f(  # pyright: ignore[reportCallIssue]
            mi.TensorXf(aligned(grid.nodes)), use_accel=False, wrap_mode=dr.WrapMode.Clamp
        )
        self._placement = GridPlacement(grid.to_node, grid.domain, grid.nodes.shape[:2], grid.rim_nodes)
        self._mi_error = dr.opaque(mi.Float, grid.mesh_error_m)
        self._mi_reach = dr.opaque(mi.Float, _REACH_NODES * grid.spacing_m)
        self._parts = [DeviceSurface(part) for part in grid.parts]

    def sample(self, mi_position: Any, active: Any = True) -> tuple[Any, Any]:
        """Return the unit normal ``mi.Normal3f`` and the up coordinate ``mi.Float`` [m] of the surface at positions."""
        import drjit as dr
        import mitsuba as mi

        slope_east, slope_north, up = self._mi_texture.eval(self._placement.uv(mi_position), active)
        for part in self._parts:
            uv = part._placement.uv(mi_position)
            weight = part._placement.share(uv)
            finer = part._mi_texture.eval(uv, active & (weight > 0.0))
            slope_east, slope_north, up = (
                value + weight * (fine - value)
                for value, fine in zip((slope_east, slope_north, up), finer, strict=True)
            )
        return dr.normalize(mi.Normal3f(-slope_east, -slope_north, 1.0)), up

    def error_and_reach(self, mi_position: Any) -> tuple[Any, Any]:
        """Vertical error bound of the mesh, and the farthest start of shadow rays, ``mi.Float`` [m] at positions."""
        error, reach = self._mi_error, self._mi_reach
        for part in self._parts:
            weight = part._placement.share(part._placement.uv(mi_position))
            error, reach = (error + weight * (part._mi_error - error), reach + weight * (part._mi_reach - reach))
        return error, reach


def shading_normal(material: Any, interaction: Any, active: Any = True) -> Any:
    """Return the shading normal of surface interactions on terrain.

    Parameters
    ----------
    material
        Of the terrain's mesh.
    interaction
        ``mi.SurfaceInteraction3f``.
    active
        ``mi.Bool``.

    Returns
    -------
    mi.Normal3f
        Of the smooth surface, or interpolated over the facet where the terrain has none; tilted where the ground is known better.
    """
    surface = device_surface(material)
    normal = interaction.sh_frame.n if surface is None else surface.sample(interaction.p, active)[0]
    return _level_water(material, interaction, _tilted(material, interaction, normal))


def leaving_points(material: Any, interaction: Any, active: Any = True) -> tuple[Any, Any, Any]:
    """Return where rays leave a surface: their origins, the normal of the surface there, and the shading normal.

    Parameters
    ----------
    material
        Of the terrain's mesh.
    interaction
        ``mi.SurfaceInteraction3f``.
    active
        ``mi.Bool``.

    Returns
    -------
    origin
        ``mi.Point3f`` off the surface by the offset of Mitsuba's own rays, and lifted to the smooth surface where this
        lies above the facet.
    outward
        ``mi.Normal3f``; rays on its other side enter the surface.
    normal
        ``mi.Normal3f`` for shading.
    """
    import drjit as dr

    offset = (1.0 + dr.max(dr.abs(interaction.p))) * RAY_EPSILON
    surface = device_surface(material)
    if surface is None:
        shading = _tilted(material, interaction, interaction.sh_frame.n)
        outward, normal = (_level_water(material, interaction, each) for each in (interaction.n, shading))
        return interaction.p + interaction.n * offset, outward, normal
    smooth, up = surface.sample(interaction.p, active)
    outward, normal = (
        _level_water(material, interaction, each) for each in (smooth, _tilted(material, interaction, smooth))
    )
    # The distance to a slope is less than the vertical one.
    lift = dr.maximum(up - interaction.p.z, 0.0) * outward.z
    return interaction.p + interaction.n * offset + outward * lift, outward, normal


def diffuse_normal(material: Any, outward: Any, normal: Any) -> Any:
    """The normal about which light from the sky and from other ground arrives.

    Parameters
    ----------
    material
        Of the terrain's mesh.
    outward, normal
        As `leaving_points` returns them, on the device or as arrays.

    Returns
    -------
    mi.Normal3f or numpy.ndarray
        Without tilts the shading normal. Ground below the resolution of the heights is turned towards other ground as often as
        towards the sky, and tilts were found under the skylight of the heights: with them the smooth surface's own.
    """
    tilted = getattr(material, "tilt", None) is not None and device_surface(material) is not None
    return outward if tilted else normal


def _tilted(material: Any, interaction: Any, normal: Any) -> Any:
    """Normals of the heights, tilted by what photographs tell of the ground below their resolution."""
    import drjit as dr
    import mitsuba as mi

    tilt = getattr(material, "tilt", None)
    return normal if tilt is None else dr.normalize(normal + mi.Normal3f(*tilt.eval(interaction.uv)))


def _level_water(material: Any, interaction: Any, normal: Any) -> Any:
    """Normals of the ground, and of still water where there is water."""
    import drjit as dr

    water = device_water(material)
    return normal if water is None else dr.select(water.covers(interaction.uv), water.vertical(interaction.p), normal)


def device_water(material: Any) -> DeviceWater | None:
    """The water of a terrain's material; ``None`` where it has none, or where it is that of the scalar variant."""
    return getattr(material, "water", None)


def ground_optics(material: Any) -> GroundOptics | None:
    """Snow and forest of a terrain's material; ``None`` where it has none, or where it is that of the scalar variant."""
    return getattr(material, "optics", None)


def device_surface(material: Any) -> DeviceSurface | None:
    """The surface of a terrain's material; ``None`` where its triangles shade themselves."""
    return getattr(material, "surface", None)


def shadow_ray_start(material: Any, cosine: Any, position: Any) -> Any:
    """Return how far from the surface a shadow ray begins [m].

    Facets may stand above the smooth surface by the error of the mesh. Under a low sun they would cast streaks of shadow
    on the ground beside them, although the surface there faces the sun. A ray is followed from where it is as high above
    the surface as the mesh may err, at most a few nodes away. If a slope rises before that, the ray begins within the
    terrain and hits it from the inside.

    Parameters
    ----------
    material
        Of the terrain's mesh.
    cosine
        ``mi.Float``: cosine of the angle between ray and the smooth surface's own normal, not a tilted one: the error is
        that of the geometry.
    position
        ``mi.Point3f``: where the ray leaves the surface.
    """
    import drjit as dr

    surface = device_surface(material)
    if surface is None:
        return 0.0
    error, reach = surface.error_and_reach(position)
    return dr.minimum(error / dr.maximum(cosine, 1e-3), reach)


def terrain_material(reflectance: dict[str, Any], terrain: Terrain, *, smooth: bool = True) -> Any:
    """Create the material of a terrain.

    Parameters
    ----------
    reflectance
        Mitsuba's dictionary of a texture.
    terrain
        Its smooth surface, its water, its snow and its forest.
    smooth
        Shade with the normals of the smooth surface; else with those of the mesh. The scalar variant, which would call
        Python for every sample, has Mitsuba's own materials with the normals of the mesh.

    Returns
    -------
    mi.BSDF
        One-sided. To Mitsuba's own integrators, water is Lambertian except in the scalar variant.
    """
    import mitsuba as mi

    if use_backend().device == "scalar":
        if terrain.images:
            log.warning("finer images are left out in the scalar variant; it needs the device llvm or cuda")
        if terrain.tilt is not None:
            log.warning("normals from photographs are left out in the scalar variant; it needs the device llvm or cuda")
        ground = {"type": "diffuse", "reflectance": reflectance}
        return mi.load_dict(ground if terrain.water is None else _scalar_water(ground, terrain.water))
    variant = mi.variant()
    assert variant is not None
    _register(variant)
    material: Any = mi.load_dict({"type": _PLUGIN, "reflectance": reflectance})
    material.surface = DeviceSurface(terrain.surface) if smooth and terrain.surface is not None else None
    material.tilt = None if terrain.tilt is None or not smooth else _device_texture(terrain.tilt)
    material.detail = None if terrain.detail is None else DeviceDetail(terrain.detail)
    material.images = DeviceImages(terrain.images) if terrain.images else None
    material.snow = None if terrain.snow is None else SnowOptics(terrain.snow)
    material.optics = optics_of(terrain)
    material.water = None if terrain.water is None else DeviceWater(terrain.water, terrain.frame)
    return material


def _device_texture(values: np.ndarray) -> Any:
    """Values ``(R, S, C)`` over the texture coordinates of the mesh, on the Dr.Jit device."""
    import drjit as dr
    import mitsuba as mi

    tensor = mi.TensorXf(aligned(values))
    return mi.Texture2f(tensor, use_accel=False, wrap_mode=dr.WrapMode.Clamp)  # pyright: ignore[reportCallIssue]


@contextmanager
def bare_texture(material: Any) -> Iterator[None]:
    """Within, the body of the ground is its texture alone, without detail, finer images and clean snow.

    For textures that hold something else than colours, such as the days on which snow goes.
    """
    kept = {name: getattr(material, name) for name in ("detail", "images", "snow") if hasattr(material, name)}
    for name in kept:
        setattr(material, name, None)
    try:
        yield
    finally:
        for name, value in kept.items():
            setattr(material, name, value)


def _scalar_water(ground: dict[str, Any], water: Water) -> dict[str, Any]:
    """Mitsuba's own plastic, which is water over a diffuse body, where there is water; the ground elsewhere."""
    import mitsuba as mi

    mask = np.ascontiguousarray(water.mask[..., None] > 0.5, np.float32)
    body = {
        "type": "plastic",
        "int_ior": REFRACTIVE_INDEX,
        "nonlinear": False,
        "diffuse_reflectance": ground["reflectance"],
    }
    if water.wind_m_s > 0.0:
        roughness = float(np.sqrt(slope_variance(water.wind_m_s)))
        body |= {"type": "roughplastic", "distribution": "beckmann", "alpha": roughness}
    weight = {
        "type": "bitmap",
        "data": mi.TensorXf(aligned(mask)),
        "raw": True,
        "filter_type": "nearest",
        "wrap_mode": "clamp",
    }
    return {"type": "blendbsdf", "weight": weight, "ground": ground, "water": body}


@cache
def _register(variant: str) -> None:
    """Register the plug-in, once for each variant of Mitsuba: its class belongs to the present one."""
    import mitsuba as mi

    mi.register_bsdf(_PLUGIN, _material_class())


def _material_class() -> Any:
    """The material as a plug-in of the present variant of Mitsuba."""
    import drjit as dr
    import mitsuba as mi

    class TerrainMaterial(mi.BSDF):
        """Lambertian reflection about the normals of ``surface``, whatever the normals of the mesh; see `body`."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.reflectance = properties.get_texture("reflectance")
            self.surface: Any = None
            self.tilt: Any = None
            self.water: Any = None
            self.snow: Any = None
            self.optics: Any = None
            self.detail: Any = None
            self.images: Any = None
            flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components, self.m_flags = [flags], flags

        def _normal(self, si: Any, active: Any) -> Any:
            return shading_normal(self, si, active)

        def _front(self, si: Any, active: Any) -> Any:
            return active & (dr.dot(si.n, si.to_world(si.wi)) > 0.0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any) -> Any:
            local = mi.warp.square_to_cosine_hemisphere(sample2)
            active = self._front(si, active)
            result: Any = dr.zeros(mi.BSDFSample3f)
            result.wo = si.to_local(mi.Frame3f(self._normal(si, active)).to_world(local))
            result.pdf = mi.warp.square_to_cosine_hemisphere_pdf(local)
            result.eta = 1.0
            result.sampled_type = mi.UInt32(int(self.m_flags))
            result.sampled_component = mi.UInt32(0)
            return result, dr.select(active, self.eval_diffuse_reflectance(si, active), 0.0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            active = self._front(si, active)
            cosine = dr.maximum(dr.dot(self._normal(si, active), si.to_world(wo)), 0.0) * dr.inv_pi
            reflectance = self.eval_diffuse_reflectance(si, active)
            return (dr.select(active, reflectance * cosine, 0.0), dr.select(active, cosine, 0.0))

        def eval_diffuse_reflectance(self, si: Any, active: Any) -> Any:
            """Of the ground, and of water for diffuse light."""
            albedo = self.body(si, active)
            if self.water is None:
                return albedo
            return dr.select(self.water.covers(si.uv, active), self.water.hemispherical(albedo), albedo)

        def body(self, si: Any, active: Any) -> Any:
            """The albedo texture: reflectance of the ground, or of the body of water below its surface."""
            albedo, texel_m = self.reflectance.eval(si, active), None
            if self.images is not None:
                texel_m = 0.0 if self.detail is None else self.detail.texel_m
                albedo, texel_m = self.images.applied(albedo, si.uv, si.p, texel_m, active)
            if self.detail is not None:
                albedo = self.detail.applied(albedo, si.p, texel_m)
            if self.snow is None or self.snow.clean is None:
                return albedo
            share = self.snow.share(*albedo, dr)
            return albedo + share * (mi.Color3f(*self.snow.clean) - albedo)

        def traverse(self, callback: Any) -> None:
            callback.put("reflectance", self.reflectance, mi.ParamFlags.Differentiable)

        def to_string(self) -> str:
            return "TerrainMaterial[]"

    return TerrainMaterial
