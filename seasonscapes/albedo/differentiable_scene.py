"""A differentiable view of a terrain: albedo, sun, sky, haze, exposure and camera rotation as unknowns of an experiment.

Radiance is rendered by path replay backpropagation (Vicini, Speierer & Jakob 2021, doi:10.1145/3450626.3459804), which
differentiates every bounce with respect to the scene's parameters. A rotation of the camera about its projection centre
changes no visibility: the rotated image is a homography of the unrotated one (Hartley & Zisserman 2004, section 8.4.2).
The rotation is therefore applied by differentiable bilinear resampling of an image with a margin, and its gradient is
exact at silhouettes as well, where differentiated ray tracing would miss the moving edges.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.frames import geodetic_from_enu, local_axes
from seasonscapes.rendering.backend import aligned, use_backend
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight, sky_radiance_towards
from seasonscapes.sky.illumination import Illumination
from seasonscapes.terrain.surface import Terrain

# Keys of Mitsuba's parameters.
ALBEDO, SUN, SKY = "terrain.bsdf.reflectance.data", "sun.emitter.radiance.value", "sky.scale"
UNKNOWNS = ("albedo", "sun", "sky", "haze", "log_gain", "heading_deg", "pitch_deg", "roll_deg")


@dataclass(frozen=True)
class DifferentiableScene:
    """A Mitsuba scene of a terrain under known light, seen by one camera; made by `build_differentiable_scene`.

    Parameters
    ----------
    camera
        The camera of the rendered images, at zero rotation.
    mi_scene, mi_params
        Mitsuba's scene and its traversed parameters: every differentiable one may be an unknown by its key.
    mi_sensor, mi_integrator
        The camera with a margin around its image, and the path replay integrator.
    mi_depth, mi_airlight, mi_background
        Optical depth and airlight up to the terrain, and radiance of the sky, tensors of the size with margin.
    sun_radiance
        ``(3,)`` of the sun's polygon, or ``None`` without a sun.
    margin_px
        Width of the margin.
    up
        The camera's zenith ``(3,)`` in camera axes: heading turns about it.
    """

    camera: Camera
    mi_scene: Any
    mi_params: Any
    mi_sensor: Any
    mi_integrator: Any
    mi_depth: Any
    mi_airlight: Any
    mi_background: Any
    sun_radiance: np.ndarray | None
    margin_px: int
    up: np.ndarray

    def render(self, unknowns: Mapping[str, Any] | None = None, *, spp: int = 16, seed: int = 0) -> Any:
        """Render a differentiable image.

        Parameters
        ----------
        unknowns
            Dr.Jit values by name; missing ones keep their value. ``albedo`` tensor ``(R, S, 3)``; ``sun`` and ``sky``
            (scales), ``haze`` (scale of the air's optical depth), ``log_gain`` (logarithm of the exposure);
            ``heading_deg``, ``pitch_deg`` and ``roll_deg`` (offsets of the camera's rotation [deg], clockwise, upwards
            and clockwise, limited by the margin); and any of Mitsuba's parameters by its key in ``mi_params``.
        spp
            Samples per pixel.
        seed
            Image and gradients use independent samples derived from it, so that their product is unbiased.

        Returns
        -------
        mitsuba.TensorXf
            Radiance ``(H, W, 3)`` [cd/m²] times exposure.

        Raises
        ------
        ValueError
            For an unknown that is neither listed above nor a parameter of the scene.
        """
        import drjit as dr
        import mitsuba as mi

        unknowns = dict(unknowns or {})
        self._update(unknowns)
        rgba = mi.render(
            self.mi_scene,
            self.mi_params,
            sensor=self.mi_sensor,
            integrator=self.mi_integrator,
            spp=spp,
            seed=2 * seed,  # pyright: ignore[reportArgumentType]
            seed_grad=2 * seed + 1,  # pyright: ignore[reportArgumentType]
        )
        coverage = dr.detach(rgba[:, :, 3:4])
        image = mi_through_air(rgba[:, :, :3], self.mi_depth, self.mi_airlight, unknowns.get("haze"))
        image = image + self.mi_background * (1.0 - coverage)
        angles = [unknowns.get(name) for name in ("heading_deg", "pitch_deg", "roll_deg")]
        image = self._rotated(image, angles)
        if "log_gain" in unknowns:
            image = image * mi.TensorXf(dr.exp(mi.Float(unknowns["log_gain"])), shape=(1, 1, 1))
        return image

    def optimizer(self, start: Mapping[str, Any], *, step: float = 0.05) -> Any:
        """Make an optimiser of unknowns of `render`.

        Parameters
        ----------
        start
            First value of each unknown: a number, or an array ``(R, S, 3)`` for ``albedo``.
        step
            Learning rate.

        Returns
        -------
        mitsuba.ad.Adam
            A mapping of the unknowns' current values; ``step()`` follows the gradients (Kingma & Ba 2015,
            arXiv:1412.6980).
        """
        import mitsuba as mi

        mi_optimizer = mi.ad.Adam(lr=step)
        for name, value in start.items():
            mi_optimizer[name] = mi.Float(value) if np.ndim(value) == 0 else mi.TensorXf(value)
        return mi_optimizer

    def _update(self, unknowns: Mapping[str, Any]) -> None:
        import mitsuba as mi

        for name, value in unknowns.items():
            if name == "albedo":
                self.mi_params[ALBEDO] = value
            elif name == "sun":
                if self.sun_radiance is not None:
                    self.mi_params[SUN] = mi.Color3f(*map(float, self.sun_radiance)) * value
            elif name == "sky":
                if SKY in self.mi_params:
                    self.mi_params[SKY] = mi.Float(value)
            elif name in self.mi_params:
                self.mi_params[name] = value
            elif name not in UNKNOWNS:
                known = ", ".join([*UNKNOWNS, "or a key of mi_params"])
                raise ValueError(f"DifferentiableScene: unknown {name!r}, expected one of {known}")
        self.mi_params.update()

    def _rotated(self, mi_image: Any, angles_deg: list[Any]) -> Any:
        """Resample the image with margin for a camera that is rotated by heading, pitch and roll."""
        import drjit as dr
        import mitsuba as mi

        camera, margin = self.camera, self.margin_px
        # Python floats: a numpy scalar times a Dr.Jit array would become a numpy array.
        fx, fy, cx, cy = (float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
        if all(angle is None for angle in angles_deg):
            return mi_image[margin : margin + camera.height_px, margin : margin + camera.width_px, :]
        heading, pitch, roll = (mi.Float(0.0 if angle is None else angle) * (np.pi / 180.0) for angle in angles_deg)
        index = dr.arange(mi.UInt32, camera.width_px * camera.height_px)
        column, row = mi.Float(index % camera.width_px) + 0.5, mi.Float(index // camera.width_px) + 0.5
        ray = mi.Vector3f((column - cx) / fx, (row - cy) / fy, 1.0)
        # A ray of the rotated camera in the axes of the unrotated one: roll about z, pitch about x, heading about up.
        ray = _about(mi.Vector3f(0.0, 0.0, 1.0), ray, roll)
        ray = _about(mi.Vector3f(1.0, 0.0, 0.0), ray, pitch)
        ray = _about(mi.Vector3f(*map(float, self.up)), ray, -heading)
        x = fx * ray.x / ray.z + cx + margin
        y = fy * ray.y / ray.z + cy + margin
        mi_values: Any = dr.ravel(_bilinear(mi_image, x, y))
        return mi.TensorXf(mi_values, shape=(camera.height_px, camera.width_px, 3))


def build_differentiable_scene(
    terrain: Terrain,
    albedo: np.ndarray,
    camera: Camera,
    light: Illumination,
    *,
    max_depth: int = 6,
    margin_px: int = 16,
) -> DifferentiableScene:
    """Build a differentiable scene of a terrain.

    Parameters
    ----------
    terrain
        Mesh with texture coordinates.
    albedo
        ``(R, S, 3)`` initial texture, linear reflectance.
    camera
        Perspective camera with square pixels, in the terrain's frame.
    light
        Illumination with the camera's aerial perspective.
    max_depth
        Largest number of edges of a light path.
    margin_px
        Margin of the rendered image, which limits the rotation of the camera.

    Returns
    -------
    DifferentiableScene
        Its ``render`` gives differentiable images.

    Raises
    ------
    InputError
        If only the scalar variant is available, which has no gradients.
    ValueError
        If the camera's pixels are not square.
    """
    use_backend(gradients=True)
    import mitsuba as mi

    wide = replace(
        camera,
        width_px=camera.width_px + 2 * margin_px,
        height_px=camera.height_px + 2 * margin_px,
        cx=camera.cx + margin_px,
        cy=camera.cy + margin_px,
    )
    mi_terrain = mi_mesh(terrain, albedo)
    scene = relight(mi_terrain, light)
    mi_params = mi.traverse(scene.mi_scene)
    depth, airlight, sky = _air_and_sky(scene, wide, light)
    latitude, longitude, _ = geodetic_from_enu(terrain.frame, camera.position_m)
    zenith = local_axes(terrain.frame, float(latitude), float(longitude))[2]
    return DifferentiableScene(
        camera,
        scene.mi_scene,
        mi_params,
        mi_sensor(wide, pixel_format="rgba"),
        mi.load_dict({"type": "prb", "max_depth": max_depth, "rr_depth": 64, "hide_emitters": True}),
        mi.TensorXf(aligned(depth)),
        mi.TensorXf(aligned(airlight)),
        mi.TensorXf(aligned(sky)),
        np.array(mi_params[SUN]).ravel() if SUN in mi_params else None,
        margin_px,
        camera.world_from_camera[:3, :3].T @ zenith,
    )


def _air_and_sky(scene: Any, camera: Camera, light: Illumination) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Optical depth, airlight and sky radiance ``(H, W, 3)`` of a camera's pixels, by their centres."""
    direction = ray_directions(camera)
    distance = trace_gbuffer(scene, camera).depth
    depth, airlight = np.zeros((2, *distance.shape, 3), np.float32)
    terrain = np.isfinite(distance)
    if light.aerial_perspective is not None:
        transmittance, air = light.aerial_perspective(distance[terrain], direction[terrain])
        depth[terrain], airlight[terrain] = -np.log(np.maximum(transmittance, 1e-6)), air
    sky = sky_radiance_towards(light, direction, float(np.degrees(1.0 / camera.fx))).astype(np.float32)
    return depth, airlight, sky


def _about(axis: Any, vector: Any, angle: Any) -> Any:
    """Rotate a vector about a unit axis by an angle [rad]: Rodrigues' formula."""
    import drjit as dr

    cosine, sine = dr.cos(angle), dr.sin(angle)
    return vector * cosine + dr.cross(axis, vector) * sine + axis * (dr.dot(axis, vector) * (1.0 - cosine))


def _bilinear(mi_image: Any, x: Any, y: Any) -> Any:
    """Bilinear values ``mi.Color3f`` of a tensor ``(H, W, 3)`` at pixel positions, clamped at its rim."""
    import drjit as dr
    import mitsuba as mi

    height, width = mi_image.shape[:2]
    x, y = dr.clip(x - 0.5, 0.0, width - 1.001), dr.clip(y - 0.5, 0.0, height - 1.001)
    column, row = mi.UInt32(dr.detach(x)), mi.UInt32(dr.detach(y))
    fx, fy = x - mi.Float(column), y - mi.Float(row)
    first = row * width + column

    def at(offset: int) -> Any:
        return dr.gather(mi.Color3f, mi_image.array, first + offset)

    top = at(0) * (1.0 - fx) + at(1) * fx
    bottom = at(width) * (1.0 - fx) + at(width + 1) * fx
    return top * (1.0 - fy) + bottom * fy


def mi_sensor(camera: Camera | Panorama, *, pixel_format: str = "rgb") -> Any:
    """Build Mitsuba's perspective sensor of a camera.

    Parameters
    ----------
    camera
        Perspective camera with square pixels.
    pixel_format
        ``"rgb"``, or ``"rgba"`` for the coverage too.

    Returns
    -------
    mitsuba.Sensor
        Sensor with a box filter and linear float32 pixels.

    Raises
    ------
    ValueError
        If the camera is a panorama or its pixels are not square.
    """
    import mitsuba as mi

    if not isinstance(camera, Camera) or abs(camera.fx / camera.fy - 1.0) > 1e-6:
        raise ValueError("mi_sensor: differentiable rendering needs a perspective camera with square pixels")
    film = {
        "type": "hdrfilm",
        "width": camera.width_px,
        "height": camera.height_px,
        "pixel_format": pixel_format,
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "near_clip": 0.5,
            "far_clip": 1.0e7,
            "film": film,
            "fov": float(np.degrees(2.0 * np.arctan(0.5 * camera.width_px / camera.fx))),
            "principal_point_offset_x": 0.5 - camera.cx / camera.width_px,
            "principal_point_offset_y": 0.5 - camera.cy / camera.height_px,
            # Mitsuba's camera axes: z forward, x to the left.
            "to_world": mi.ScalarTransform4f(camera.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])),
        }
    )


def mi_through_air(mi_image: Any, mi_depth: Any, mi_airlight: Any, haze: Any = None) -> Any:
    """Apply aerial perspective to a rendered image, with a differentiable scale of its optical depth.

    Parameters
    ----------
    mi_image
        Radiance ``(H, W, 3)`` that leaves the terrain.
    mi_depth, mi_airlight
        Optical depth and airlight ``(H, W, 3)`` up to the terrain.
    haze
        Scale of the optical depth; ``None`` for 1.

    Returns
    -------
    mitsuba.TensorXf
        Radiance ``(H, W, 3)`` at the camera.
    """
    import drjit as dr
    import mitsuba as mi

    if haze is None:
        return mi_image * dr.exp(-mi_depth) + mi_airlight
    scale = mi.TensorXf(mi.Float(haze), shape=(1, 1, 1))
    # In a homogeneous medium airlight is proportional to 1 - exp(-optical depth).
    growth = (1.0 - dr.exp(-mi_depth * scale)) / dr.fmax(1.0 - dr.exp(-mi_depth), 1e-6)
    return mi_image * dr.exp(-mi_depth * scale) + mi_airlight * growth
