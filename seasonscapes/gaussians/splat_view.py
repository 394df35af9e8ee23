"""Rendering of a Gaussian model at an instant: colours under its light, splatting, aerial perspective, and sky."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.errors import NoTerrainInView
from seasonscapes.gaussians.appearance import Appearance, colours_at, fourier_embedding
from seasonscapes.gaussians.disc_transport import LightState, light_state, neighbourhood_mean
from seasonscapes.gaussians.land_shadows import DiscShadows
from seasonscapes.gaussians.model import GaussianModel, LearnedParameters
from seasonscapes.gaussians.rasterise import (
    ALPHA_CUT,
    ALPHA_MOST,
    NEAR_M,
    PIXEL_VARIANCE,
    Splats,
    ViewWeights,
    rotations,
    splat_colours,
    splats_from,
    view_weights,
)
from seasonscapes.rendering.backend import use_backend
from seasonscapes.rendering.splatting import DeviceSplats, SplatLimits, finer_camera, splat_layers, upload_splats
from seasonscapes.sky.illumination import AerialPerspective, Illumination

# Coverage from which on a pixel is treated as entirely terrain.
FULL_COVERAGE = 0.85
NOTHING_IN_VIEW = "no Gaussian in the camera's view; it may face away from the terrain or be inside the mountain"
SPLAT_LIMITS = SplatLimits(ALPHA_CUT, ALPHA_MOST, PIXEL_VARIANCE, NEAR_M, one_sided=True)


@dataclass(frozen=True)
class RasterOptions:
    """Options of rasterisation.

    Parameters
    ----------
    subpixels
        Samples along a pixel's side; not used on CUDA.
    device
        ``cpu``, or ``cuda`` with gsplat.
    """

    subpixels: int = 2
    device: str = "cpu"


@dataclass(frozen=True)
class SplatView:
    """A rendered view, as `rendering.radiance.RenderedView`.

    Parameters
    ----------
    radiance
        ``(H, W, 3)`` [cd/m²] at the camera: terrain with aerial perspective, over the sky.
    surface
        ``(H, W, 3)`` [cd/m²] radiance of the terrain before aerial perspective, weighted by ``coverage``.
    coverage
        ``(H, W)`` fraction of each pixel that is terrain.
    depth
        ``(H, W)`` mean distance of the splats along the ray [m]; infinite where there are none.
    provenance
        Plain values about the view.
    """

    radiance: np.ndarray
    surface: np.ndarray
    coverage: np.ndarray
    depth: np.ndarray
    provenance: dict[str, Any] = field(default_factory=dict)


def appearance_of(model: GaussianModel, *, albedo: np.ndarray | None = None, seed: int = 0) -> Appearance:
    """Restore the appearance of a model as a torch module.

    Parameters
    ----------
    model
        Relightable model.
    albedo
        ``(N, 3)`` in place of the model's dated albedos, for example from `GaussianModel.albedo_on`.
    seed
        Seed of network weights that the model does not contain.

    Returns
    -------
    Appearance
        Module with the model's learned parameters.
    """
    dated = model.albedo if albedo is None else albedo[None]
    surroundings = np.stack([neighbourhood_mean(model.means, values, model.spacing_m) for values in dated])
    embedding = model.features if model.features.shape[1] else fourier_embedding(model.means)
    codes = model.appearance.get("codes")
    times = 1 if codes is None else len(codes)
    appearance = Appearance(model.kind, dated, surroundings, model.transport, embedding, seed=seed, times=times)
    for name, parameter in appearance.named_parameters():
        if name != "embedding" and name in model.appearance:
            parameter.data.copy_(torch.as_tensor(model.appearance[name]))
    return appearance


def learned_parameters(appearance: Appearance) -> LearnedParameters:
    """Copy the trainable parameters of an appearance to numpy, for `model.model_from`.

    Parameters
    ----------
    appearance
        Trained module.

    Returns
    -------
    LearnedParameters
        Kind of the appearance, and arrays by parameter name.
    """
    arrays = {name: parameter.detach().numpy().copy() for name, parameter in appearance.named_parameters()}
    return LearnedParameters(appearance.kind, arrays)


def model_colours(
    model: GaussianModel, illumination: Illumination, day: float, *, shadows: DiscShadows | None = None
) -> tuple[np.ndarray, LightState]:
    """Compute the colours of all Gaussians under a light.

    Parameters
    ----------
    model
        Relightable model of N Gaussians.
    illumination
        Sun, moon and sky.
    day
        Day of the year, for the albedo.
    shadows
        From `land_shadows.disc_shadows`: cast shadows are traced; by the discs' horizons if omitted.

    Returns
    -------
    tuple of (numpy.ndarray, LightState)
        Colours ``(N, 3)`` and the light's state; radiance is colour × ``global_lx`` / π [cd/m²].

    Raises
    ------
    ValueError
        If the light is dark, or the model has free codes, which are defined at its training times only.
    """
    if model.kind == "code":
        raise ValueError("model_colours: a model with free codes cannot be relit for another instant")
    state = light_state(model.transport, illumination, day)
    visible = shadows.visible_share(state) if shadows else None
    return colours_at(appearance_of(model, albedo=model.albedo_on(day)), state, visible=visible), state


def splats_of(model: GaussianModel, *, viewpoint_m: np.ndarray | None = None) -> Splats:
    """Return the geometry of a model as tensors, with back-face culling.

    Parameters
    ----------
    model
        N Gaussians.
    viewpoint_m
        ``(3,)`` position of a camera, ENU [m]: discs that face away from it become transparent, as they are hidden
        inside the mountain. If omitted, all discs are kept.

    Returns
    -------
    Splats
        float32 tensors.
    """
    logits = model.opacity_logits
    if viewpoint_m is not None:
        facing_away = np.einsum("nc,nc->n", model.means - viewpoint_m.astype(np.float32), model.facing) > 0.0
        logits = np.where(facing_away, np.float32(-20.0), logits)
    return splats_from(model.means, model.quaternions, model.log_scales, logits)


def model_weights(model: GaussianModel, camera: Camera, *, subpixels: int = 2) -> ViewWeights:
    """Compute the blending weights of a camera, valid for any light.

    Parameters
    ----------
    model
        N Gaussians.
    camera
        The view.
    subpixels
        Samples along a pixel's side.

    Returns
    -------
    ViewWeights
        ``(H W, N)``.

    Raises
    ------
    NoTerrainInView
        If no Gaussian is in view.
    """
    weights = view_weights(splats_of(model, viewpoint_m=camera.position_m), camera, subpixels=subpixels)
    if weights.matrix.nnz == 0:
        raise NoTerrainInView(NOTHING_IN_VIEW)
    return weights


def render_model(
    model: GaussianModel,
    camera: Camera,
    illumination: Illumination,
    day: float,
    *,
    weights: ViewWeights | None = None,
    colours: tuple[np.ndarray, LightState] | None = None,
    raster: RasterOptions | None = None,
) -> SplatView:
    """Render a Gaussian model for a camera under a light.

    Parameters
    ----------
    model
        Relightable model.
    camera
        The view.
    illumination
        Sun, moon, sky and aerial perspective.
    day
        Day of the year, for the albedo.
    weights, colours
        Results of `model_weights` and `model_colours`, if one of them is reused for many pictures.
    raster
        Subpixels and device of the rasteriser, if ``weights`` are not given; defaults if omitted.

    Returns
    -------
    SplatView
        Radiance, surface radiance, coverage and depth.

    Raises
    ------
    NoTerrainInView
        If no Gaussian is in view.
    ValueError
        If the light is dark, or the model has free codes.
    InputError
        If CUDA is requested but not available.
    """
    raster = raster or RasterOptions()
    values, state = colours or model_colours(model, illumination, day)
    distance = np.linalg.norm(model.means - camera.position_m.astype(np.float32), axis=1)
    layers = np.concatenate([values * np.float32(state.global_lx / np.pi), distance[:, None]], axis=1)
    if weights is not None:
        blended, coverage = splat_colours(weights, layers), weights.coverage
    else:
        blended, coverage = draw_layers(model, camera, layers, raster)
    # Neighbouring discs leave gaps of a few per cent, through which the sky must not shine.
    solid = np.clip(coverage / FULL_COVERAGE, 0.0, 1.0)
    mean = blended / np.maximum(coverage, 1e-6)[..., None]
    depth = np.where(coverage > 1e-3, mean[..., 3], np.inf)
    surface = mean[..., :3] * solid[..., None]
    radiance = composite_with_air(camera, illumination, surface, solid, depth)
    return SplatView(radiance, surface.astype(np.float32), solid.astype(np.float32), depth.astype(np.float32))


def draw_layers(
    model: GaussianModel, camera: Camera, layers: np.ndarray, raster: RasterOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Blend layers of the Gaussians with the fastest rasteriser of a device.

    ``cpu`` uses the renderer's vectorised backend (`rendering.splatting`), or torch on the scalar variant.

    Parameters
    ----------
    model
        N Gaussians.
    camera
        The view.
    layers
        ``(N, C)`` values to blend.
    raster
        Subpixels and device of the rasteriser.

    Returns
    -------
    tuple of numpy.ndarray
        Picture ``(H, W, C)``, blended over zero, and coverage ``(H, W)``.

    Raises
    ------
    NoTerrainInView
        If no Gaussian is in view.
    InputError
        If CUDA is requested but not available.
    """
    if raster.device == "cuda":
        from seasonscapes.gaussians.rasterise_cuda import rasterise_cuda

        splats = splats_of(model, viewpoint_m=camera.position_m)
        cuda_picture, cuda_coverage = rasterise_cuda(splats, torch.from_numpy(layers), camera)
        blended, coverage = cuda_picture.detach().cpu().numpy(), cuda_coverage.detach().cpu().numpy()
    elif use_backend().device == "scalar":
        weights = model_weights(model, camera, subpixels=raster.subpixels)
        blended, coverage = splat_colours(weights, layers), weights.coverage
    else:
        subpixels = raster.subpixels
        fine = finer_camera(camera, subpixels)
        blended, coverage = splat_layers(upload_model(model), layers, fine, SPLAT_LIMITS)
        shape = (camera.height_px, subpixels, camera.width_px, subpixels)
        blended, coverage = blended.reshape(*shape, -1).mean((1, 3)), coverage.reshape(shape).mean((1, 3))
    if not coverage.any():
        raise NoTerrainInView(NOTHING_IN_VIEW)
    return blended, coverage


def upload_model(model: GaussianModel) -> DeviceSplats:
    """Copy the geometry of a model to the rendering device.

    Parameters
    ----------
    model
        N Gaussians.

    Returns
    -------
    rendering.splatting.DeviceSplats
        Input of `rendering.splatting.splat_layers`.
    """
    splats = splats_of(model)
    axes = rotations(splats.quaternions) * splats.log_scales.exp()[:, None, :]
    return upload_splats(model.means, axes.numpy(), torch.sigmoid(splats.opacity_logits).numpy())


def composite_with_air(
    camera: Camera, illumination: Illumination, surface: np.ndarray, coverage: np.ndarray, depth: np.ndarray
) -> np.ndarray:
    """Apply aerial perspective to a surface and composite it over the open sky.

    Parameters
    ----------
    camera
        The view.
    illumination
        Sky, sun, moon, and optionally aerial perspective.
    surface
        ``(H, W, 3)`` radiance before aerial perspective, weighted by coverage [cd/m²].
    coverage
        ``(H, W)``.
    depth
        ``(H, W)`` distance along the ray [m]; infinite where there is no terrain.

    Returns
    -------
    numpy.ndarray
        ``(H, W, 3)`` float32 radiance at the camera [cd/m²].
    """
    from seasonscapes.rendering.air_grid import sky_grid, sky_pixel_radiance

    image = surface.reshape(-1, 3).astype(np.float32)
    flat_coverage = coverage.ravel()
    terrain = np.flatnonzero((flat_coverage > 0.0) & np.isfinite(depth.ravel()))
    if illumination.aerial_perspective is not None and len(terrain):
        transmittance, airlight = _air(camera, illumination.aerial_perspective, terrain, depth.ravel()[terrain])
        image[terrain] = image[terrain] * transmittance + airlight * flat_coverage[terrain, None]
    open_pixels = np.flatnonzero(flat_coverage < 1.0)
    if len(open_pixels):
        sky = sky_pixel_radiance(sky_grid(camera, open_pixels), illumination, float(np.degrees(1.0 / camera.fx)))
        image[open_pixels] += (1.0 - flat_coverage[open_pixels, None]) * sky
    return image.reshape(surface.shape)


def _air(
    camera: Camera, air: AerialPerspective, pixel: np.ndarray, depth_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance and airlight ``(n, 3)`` of pixels: from a coarse grid, or pixel by pixel on the scalar variant."""
    from seasonscapes.rendering.air_grid import air_grid, interpolate_air

    if use_backend().device == "scalar":
        row, column = np.divmod(pixel, camera.width_px)
        transmittance, airlight = air(depth_m, ray_directions(camera, np.stack([column, row], axis=-1) + 0.5))
        return np.asarray(transmittance, np.float32), np.asarray(airlight, np.float32)
    no_mixed_pixels = (np.zeros(0, np.int64), np.zeros((0, 1), np.float32))
    return interpolate_air(air_grid(camera, pixel, depth_m, *no_mixed_pixels), air)
