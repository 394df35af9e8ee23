"""Reference rasteriser: evaluates every splat at every pixel, one after the other. For small pictures and tests."""

from __future__ import annotations

import torch

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.gaussians.rasterise import ALPHA_CUT, ALPHA_MOST, NEAR_M, PIXEL_VARIANCE, Splats


def rasterise_reference(
    splats: Splats,
    colours: torch.Tensor,
    camera: Camera,
    *,
    alpha_cut: float = ALPHA_CUT,
    pixel_variance: float = PIXEL_VARIANCE,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Blend colours front to back over black, as `rasterise.rasterise`, in the precision of the splats.

    Parameters
    ----------
    splats
        N Gaussians.
    colours
        ``(N, C)``.
    camera
        The view.
    alpha_cut
        Opacity below which a splat is not drawn.
    pixel_variance
        Variance added to each splat [px²].

    Returns
    -------
    tuple of torch.Tensor
        Picture ``(H, W, C)`` and coverage ``(H, W)``.
    """
    dtype = splats.means.dtype
    pose = torch.as_tensor(camera.world_from_camera, dtype=dtype)
    x, y = torch.meshgrid(torch.arange(camera.width_px) + 0.5, torch.arange(camera.height_px) + 0.5, indexing="xy")
    pixel = torch.stack([x, y], dim=-1).to(dtype)
    local = (splats.means - pose[:3, 3]) @ pose[:3, :3]
    image = torch.zeros(camera.height_px, camera.width_px, colours.shape[1], dtype=dtype)
    transmittance = torch.ones(camera.height_px, camera.width_px, dtype=dtype)
    for i in torch.argsort(local[:, 2].detach(), stable=True).tolist():
        if local[i, 2] <= NEAR_M:
            continue
        centre, covariance = _ellipse(splats, i, local[i], pose, camera)
        offset = pixel - centre
        inverse = torch.linalg.inv(covariance + pixel_variance * torch.eye(2, dtype=dtype))
        power = -0.5 * torch.einsum("hwi,ij,hwj->hw", offset, inverse, offset)
        alpha = (torch.sigmoid(splats.opacity_logits[i]) * power.exp()).clamp(max=ALPHA_MOST)
        alpha = torch.where(alpha >= alpha_cut, alpha, torch.zeros_like(alpha))
        image = image + (transmittance * alpha)[..., None] * colours[i]
        transmittance = transmittance * (1.0 - alpha)
    return image, 1.0 - transmittance


def _ellipse(
    splats: Splats, i: int, local: torch.Tensor, pose: torch.Tensor, camera: Camera
) -> tuple[torch.Tensor, torch.Tensor]:
    """Centre ``(2,)`` and covariance ``(2, 2)`` of one splat in the picture, by the Jacobian of the projection."""
    w, x, y, z = splats.quaternions[i] / splats.quaternions[i].norm()
    rotation = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
        ]
    )
    covariance = rotation @ torch.diag(splats.log_scales[i].exp() ** 2) @ rotation.T
    a, b, depth = local
    u = (a / depth).clamp(-0.65 * camera.width_px / camera.fx, 0.65 * camera.width_px / camera.fx)
    v = (b / depth).clamp(-0.65 * camera.height_px / camera.fy, 0.65 * camera.height_px / camera.fy)
    zero = torch.zeros_like(depth)
    jacobian = torch.stack(
        [
            torch.stack([camera.fx / depth, zero, -camera.fx * u / depth]),
            torch.stack([zero, camera.fy / depth, -camera.fy * v / depth]),
        ]
    )
    project = jacobian @ pose[:3, :3].T
    centre = torch.stack([camera.fx * a / depth + camera.cx, camera.fy * b / depth + camera.cy])
    return centre, project @ covariance @ project.T
