"""A picture of a Gaussian model at an instant: colours for its light, splats, the air in between, the sky behind."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.gaussians.appearance import Appearance, colours_at, fourier_embedding
from seasonscapes.gaussians.disc_transport import LightState, light_state, neighbourhood_mean
from seasonscapes.gaussians.model import GaussianModel
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

# Coverage from which a pixel counts as all terrain.
SOLID = 0.85
NOTHING_IN_VIEW = "the camera sees no Gaussian; does it look away, or stand inside the mountain?"
CUTS = SplatLimits(ALPHA_CUT, ALPHA_MOST, PIXEL_VARIANCE, NEAR_M, one_sided=True)


@dataclass(frozen=True)
class SplatView:
    """A rendered view, as `rendering.radiance.RenderedView`.

    Parameters
    ----------
    radiance
        ``(H, W, 3)`` [cd/m²]: splats through the air over the sky.
    surface
        ``(H, W, 3)`` radiance of the terrain before the air, weighted by ``coverage``.
    coverage
        ``(H, W)``.
    depth
        ``(H, W)`` mean distance of what is seen along the ray [m]; infinite where nothing is.
    """

    radiance: np.ndarray
    surface: np.ndarray
    coverage: np.ndarray
    depth: np.ndarray


def appearance_of(model: GaussianModel, *, albedo: np.ndarray | None = None, seed: int = 0) -> Appearance:
    """The model's appearance as a torch module, ready to colour or to train on.

    Parameters
    ----------
    albedo
        ``(N, 3)`` to use in place of the model's own dates, such as `GaussianModel.albedo_on` gives.
    """
    own = model.albedo if albedo is None else albedo[None]
    around = np.stack([neighbourhood_mean(model.means, one, model.plan.spacing_m) for one in own])
    embedding = model.features if model.features.shape[1] else fourier_embedding(model.means)
    codes = model.appearance.get("codes")
    appearance = Appearance(
        model.kind, own, around, model.transport, embedding, seed=seed, times=1 if codes is None else len(codes)
    )
    for name, parameter in appearance.named_parameters():
        if name != "embedding" and name in model.appearance:
            parameter.data.copy_(torch.as_tensor(model.appearance[name]))
    return appearance


def learned_numbers(appearance: Appearance) -> dict[str, np.ndarray]:
    """Everything that training may have changed, by name, as numpy; see `model.model_from`."""
    return {name: parameter.detach().numpy().copy() for name, parameter in appearance.named_parameters()}


def model_colours(model: GaussianModel, illumination: Illumination, day: float) -> tuple[np.ndarray, LightState]:
    """Colours ``(N, 3)`` of a light on a day of the year, and its state: radiance is colour × ``global_lx`` / π.

    Raises
    ------
    ValueError
        A dark light; a model of free codes, which knows no other instants than its own.
    """
    if model.kind == "code":
        raise ValueError("a model of free codes cannot be lit for another instant")
    state = light_state(model.transport, illumination, day)
    return colours_at(appearance_of(model, albedo=model.albedo_on(day)), state), state


def splats_of(model: GaussianModel, *, seen_from: np.ndarray | None = None) -> Splats:
    """The model's geometry as tensors; from a place ``(3,)``, discs that show it their backs are made transparent.

    A terrain's back is inside the mountain: what faces away is hidden by what does not, and need not be drawn.
    """
    logits = model.opacity_logits
    if seen_from is not None:
        away = np.einsum("nc,nc->n", model.means - seen_from.astype(np.float32), model.transport.normals) > 0.0
        logits = np.where(away, np.float32(-20.0), logits)
    return splats_from(model.means, model.quaternions, model.log_scales, logits)


def model_weights(model: GaussianModel, camera: Camera, *, subpixels: int = 2) -> ViewWeights:
    """Weights of a camera, for any light; `ValueError` where no Gaussian is in view."""
    weights = view_weights(splats_of(model, seen_from=camera.position_m), camera, subpixels=subpixels)
    if weights.matrix.nnz == 0:
        raise ValueError(NOTHING_IN_VIEW)
    return weights


def render_model(
    model: GaussianModel,
    camera: Camera,
    illumination: Illumination,
    day: float,
    *,
    weights: ViewWeights | None = None,
    colours: tuple[np.ndarray, LightState] | None = None,
    subpixels: int = 2,
    device: str = "cpu",
) -> SplatView:
    """The model seen by a camera under a light.

    Parameters
    ----------
    day
        Of the year, for the season.
    weights, colours
        From `model_weights` and `model_colours`, where one of them serves many pictures.
    subpixels
        Samples along a pixel's side, where ``weights`` are not given.
    device
        ``cpu``, or ``cuda`` through gsplat.
    """
    values, state = colours or model_colours(model, illumination, day)
    distance = np.linalg.norm(model.means - camera.position_m.astype(np.float32), axis=1)
    layers = np.concatenate([values * np.float32(state.global_lx / np.pi), distance[:, None]], axis=1)
    if weights is not None:
        drawn, covered = splat_colours(weights, layers), weights.coverage
    else:
        drawn, covered = draw_layers(model, camera, layers, subpixels=subpixels, device=device)
    # Discs meet with gaps of a few hundredths between them; the sky must not shine through a mountain.
    solid = np.clip(covered / SOLID, 0.0, 1.0)
    mean = drawn / np.maximum(covered, 1e-6)[..., None]
    depth = np.where(covered > 1e-3, mean[..., 3], np.inf)
    surface = mean[..., :3] * solid[..., None]
    radiance = composite_with_air(camera, illumination, surface, solid, depth)
    return SplatView(radiance, surface.astype(np.float32), solid.astype(np.float32), depth.astype(np.float32))


def draw_layers(
    model: GaussianModel, camera: Camera, layers: np.ndarray, *, subpixels: int = 1, device: str = "cpu"
) -> tuple[np.ndarray, np.ndarray]:
    """Blend layers ``(N, C)`` of the Gaussians: picture ``(H, W, C)`` and coverage ``(H, W)``, the quickest way there is.

    ``cpu`` goes through the renderer's vector units (`rendering.splatting`), or through torch where it has none.

    Raises
    ------
    ValueError
        Where no Gaussian is in view.
    """
    if device == "cuda":
        from seasonscapes.gaussians.rasterise_cuda import rasterise_cuda

        drawn, covered = rasterise_cuda(splats_of(model, seen_from=camera.position_m), torch.from_numpy(layers), camera)
        drawn, covered = drawn.detach().cpu().numpy(), covered.detach().cpu().numpy()
    elif use_backend().device == "scalar":
        weights = model_weights(model, camera, subpixels=subpixels)
        drawn, covered = splat_colours(weights, layers), weights.coverage
    else:
        fine = finer_camera(camera, subpixels)
        drawn, covered = splat_layers(upload_model(model), layers, fine, CUTS)
        shape = (camera.height_px, subpixels, camera.width_px, subpixels)
        drawn, covered = drawn.reshape(*shape, -1).mean((1, 3)), covered.reshape(shape).mean((1, 3))
    if not covered.any():
        raise ValueError(NOTHING_IN_VIEW)
    return drawn, covered


def upload_model(model: GaussianModel) -> DeviceSplats:
    """The model's geometry on the renderer's device, for `rendering.splatting.splat_layers`."""
    splats = splats_of(model)
    axes = rotations(splats.quaternions) * splats.log_scales.exp()[:, None, :]
    return upload_splats(model.means, axes.numpy(), torch.sigmoid(splats.opacity_logits).numpy())


def composite_with_air(
    camera: Camera, illumination: Illumination, surface: np.ndarray, coverage: np.ndarray, depth: np.ndarray
) -> np.ndarray:
    """Radiance ``(H, W, 3)`` at the camera: the surface through the air of its distance, and the open sky behind."""
    from seasonscapes.rendering.air_grid import open_sky, sky_grid

    image = surface.reshape(-1, 3).astype(np.float32)
    cover = coverage.ravel()
    shown = np.flatnonzero((cover > 0.0) & np.isfinite(depth.ravel()))
    if illumination.aerial_perspective is not None and len(shown):
        transmittance, airlight = _air(camera, illumination.aerial_perspective, shown, depth.ravel()[shown])
        image[shown] = image[shown] * transmittance + airlight * cover[shown, None]
    hole = np.flatnonzero(cover < 1.0)
    if len(hole):
        sky = open_sky(sky_grid(camera, hole), illumination, float(np.degrees(1.0 / camera.fx)))
        image[hole] += (1.0 - cover[hole, None]) * sky
    return image.reshape(surface.shape)


def _air(
    camera: Camera, air: AerialPerspective, pixel: np.ndarray, depth_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance and airlight ``(n, 3)`` of pixels: from a coarse grid, or one by one where there are no lanes."""
    from seasonscapes.rendering.air_grid import air_at, air_places

    if use_backend().device == "scalar":
        row, column = np.divmod(pixel, camera.width_px)
        transmittance, airlight = air(depth_m, ray_directions(camera, np.stack([column, row], axis=-1) + 0.5))
        return np.asarray(transmittance, np.float32), np.asarray(airlight, np.float32)
    none = (np.zeros(0, np.int64), np.zeros((0, 1), np.float32))
    return air_at(air_places(camera, pixel, depth_m, none), air)
