"""Rasterisation on CUDA with gsplat (Apache-2.0), which is imported only when used."""

from __future__ import annotations

import torch

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.errors import InputError
from seasonscapes.gaussians.rasterise import NEAR_M, PIXEL_VARIANCE, Splats


def rasterise_cuda(
    splats: Splats, colours: torch.Tensor, camera: Camera, *, pixel_variance: float = PIXEL_VARIANCE
) -> tuple[torch.Tensor, torch.Tensor]:
    """Blend colours front to back over black on the GPU, as `rasterise.rasterise`; differentiable.

    Parameters
    ----------
    splats
        N Gaussians.
    colours
        ``(N, C)``.
    camera
        The view.
    pixel_variance
        Variance added to each splat [px²].

    Returns
    -------
    tuple of torch.Tensor
        Picture ``(H, W, C)`` and coverage ``(H, W)``, on the GPU.

    Raises
    ------
    InputError
        If there is no CUDA device, or gsplat is not installed.
    """
    if not torch.cuda.is_available():
        raise InputError("--device", "no CUDA device found", got="cuda", cure="use --device cpu")
    try:
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]
    except ImportError:
        cure = "pip install 'seasonscapes[gsplat]', or use --device cpu"
        raise InputError("--device", "the CUDA rasteriser needs gsplat", got="cuda", cure=cure) from None
    device = torch.device("cuda")
    pose = torch.as_tensor(camera.world_from_camera, dtype=torch.float64)
    # Relative to the camera, because float32 loses centimetres some kilometres from the origin.
    means = (splats.means.double() - pose[:3, 3].to(splats.means.device)).float().to(device)
    view = torch.eye(4, device=device)
    view[:3, :3] = pose[:3, :3].T.float()
    intrinsics = torch.tensor(
        [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]], device=device
    )
    image, coverage, _ = rasterization(
        means,
        splats.quaternions.to(device),
        splats.log_scales.exp().to(device),
        torch.sigmoid(splats.opacity_logits).to(device),
        colours.to(device),
        view[None],
        intrinsics[None],
        camera.width_px,
        camera.height_px,
        near_plane=NEAR_M,
        far_plane=1e7,
        eps2d=pixel_variance,
        packed=False,
    )
    return image[0], coverage[0, ..., 0]
