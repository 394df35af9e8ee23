"""Refinement of the discs: small changes of place, size, direction and opacity, learned from pictures.

Discs that follow from the terrain's mesh alone are blended with a blur and with a bias: the nearer of two neighbours covers the
other one. Both are corrected by changes within the tangent plane and along the normal, for all suns together. Discs stay tangent
to the terrain, so that their light transport holds, and near their cell: every change is bounded (`surfels.CHANGES`).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.gaussians.rasterise import Splats, rasterise, rotations
from seasonscapes.gaussians.surfels import CHANGES, Surfels
from seasonscapes.rendering.splatting import finer_camera

# Coverage that refinement keeps, so that no sky shines through the ground (`splat_view.FULL_COVERAGE`), and the weight of the
# squared lack of it.
_COVERAGE, _COVERAGE_WEIGHT = 0.9, 2.0


class DiscGeometry(nn.Module):
    """Changes of N discs, all zero at first.

    Parameters
    ----------
    surfels
        The discs as the terrain gives them.
    fixed
        ``(N,)`` bool, discs that stay as they are; none if omitted.

    Examples
    --------
    >>> from seasonscapes.gaussians.surfels import terrain_surfels
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> geometry = DiscGeometry(terrain_surfels(place.terrain, 400.0))
    >>> geometry.offset.shape[1], float(geometry.twist.detach().abs().sum())
    (3, 0.0)
    """

    def __init__(self, surfels: Surfels, fixed: np.ndarray | None = None) -> None:
        super().__init__()
        self.fixed = None if fixed is None else torch.as_tensor(fixed)
        self.spacing_m = torch.as_tensor(surfels.spacing_m)[:, None]
        self.base = Splats(
            *(
                torch.as_tensor(values)
                for values in (surfels.means, surfels.quaternions, surfels.log_scales, surfels.opacity_logits)
            )
        )
        self.axes, self.facing = rotations(self.base.quaternions), torch.as_tensor(surfels.facing)
        self.offset, self.stretch, self.twist, self.opacity = (
            nn.Parameter(torch.zeros(len(surfels.means), columns)) for columns, _ in CHANGES.values()
        )

    def splats(self, camera: Camera) -> Splats:
        """The discs as splats for a camera, those that face away from it transparent; differentiable in the changes."""
        base = self.base
        means = base.means + self.spacing_m * torch.einsum("nij,nj->ni", self.axes, self.offset)
        log_scales = base.log_scales + nn.functional.pad(self.stretch, (0, 1))
        away = ((means.detach() - torch.as_tensor(camera.position_m.astype(np.float32))) * self.facing).sum(1) > 0.0
        logits = torch.where(away, -20.0, base.opacity_logits + self.opacity[:, 0])
        return Splats(means, turned(base.quaternions, self.twist[:, 0]), log_scales, logits)

    @torch.no_grad()
    def keep_within_limits(self) -> None:
        """Clip the changes to those that `surfels.CHANGES` allows, and undo those of fixed discs, in place."""
        for name, (_, limit) in CHANGES.items():
            changes = getattr(self, name)
            changes.clamp_(-limit, limit)
            if self.fixed is not None:
                changes[self.fixed] = 0.0


def turned(quaternions: torch.Tensor, twist: torch.Tensor) -> torch.Tensor:
    """Turn discs within their planes.

    Parameters
    ----------
    quaternions
        ``(N, 4)`` wxyz.
    twist
        ``(N,)`` angle about the third axis [rad].

    Returns
    -------
    torch.Tensor
        ``(N, 4)`` wxyz.
    """
    w, x, y, z = quaternions.unbind(1)
    c, s = (0.5 * twist).cos(), (0.5 * twist).sin()
    return torch.stack([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], dim=1)


def normalised_picture(
    splats: Splats, colours: torch.Tensor, camera: Camera, *, subpixels: int = 2
) -> tuple[torch.Tensor, torch.Tensor]:
    """Draw splats for a camera, averaged over sub-pixels and over the part of each pixel that they cover.

    Parameters
    ----------
    splats
        N splats.
    colours
        ``(N, C)``.
    camera
        The view.
    subpixels
        Samples along a pixel's side.

    Returns
    -------
    tuple of torch.Tensor
        Picture ``(H, W, C)`` and coverage ``(H, W)``.
    """
    fine, covered = rasterise(splats, colours, finer_camera(camera, subpixels))
    shape = (camera.height_px, subpixels, camera.width_px, subpixels)
    picture, coverage = fine.reshape(*shape, -1).mean((1, 3)), covered.reshape(shape).mean((1, 3))
    return picture / coverage.clamp(min=1e-3)[..., None], coverage


def uncovered_loss(coverage: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Weighted mean square of what pixels of terrain lack of coverage.

    Parameters
    ----------
    coverage
        ``(H, W)``.
    mask
        ``(H, W)`` bool, True = all terrain.

    Returns
    -------
    torch.Tensor
        Scalar loss.
    """
    lack = (_COVERAGE - coverage).clamp(min=0.0)
    return _COVERAGE_WEIGHT * (lack * lack * mask).sum() / mask.sum().clamp(min=1)
