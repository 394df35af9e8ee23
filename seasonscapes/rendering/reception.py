"""What arrives at receivers under a given light: coefficients times sky, and the senders' radiance looked up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.rendering.gather import Occluder
from seasonscapes.rendering.senders import Reception, Senders, node_radiance
from seasonscapes.rendering.sky_patches import patch_radiance, sky_patches
from seasonscapes.rendering.smoothing import Neighbours, mi_neighbours, mi_smoothed
from seasonscapes.rendering.sun_visibility import SunRays, cosine_seen, sun_rays
from seasonscapes.sky.illumination import Illumination, Luminary, luminance

# A moon (or a setting sun) that is this much fainter than the rest of the light casts no shadow that could be seen.
FAINT = 1e-4


@dataclass(frozen=True)
class ReadyReception:
    """A `Reception` on the device, column by column: every lane reads its own receiver in one sweep.

    ``mi_smoothing`` are passes over neighbours for what senders send, see `smoothing`; none for loose points.
    """

    mi_direct: list[Any]
    mi_sender_pairs: list[Any]
    mi_share: Any
    mi_smoothing: list[tuple[list[Any], list[Any]]]


@dataclass(frozen=True)
class ReadySenders:
    """`Senders` on the device, and shadow rays from their places."""

    senders: Senders
    reception: ReadyReception
    rays: SunRays


def ready_reception(reception: Reception, smoothing: list[Neighbours] | None = None) -> ReadyReception:
    """Copy to the device; half precision stays half."""
    import drjit as dr
    import mitsuba as mi

    listed = np.asarray(reception.sender).astype(np.uint32)
    direct = [mi.Float16(np.ascontiguousarray(column)) for column in np.asarray(reception.direct).T]
    pairs = [mi.UInt32(listed[:, k] | (listed[:, k + 1] << np.uint32(16))) for k in range(0, listed.shape[1], 2)]
    share = mi.Float(np.asarray(reception.share, np.float32) / listed.shape[1])
    dr.eval(direct, pairs, share)
    return ReadyReception(direct, pairs, share, [mi_neighbours(around) for around in smoothing or []])


def ready_senders(terrain: Occluder, senders: Senders) -> ReadySenders:
    """Senders ready for any light."""
    points = senders.points
    rays = sun_rays(terrain, points.origin, points.normal, points.outward, np.ones(points.origin.shape[:2]))
    return ReadySenders(senders, ready_reception(senders.reception), rays)


def arriving(ready: ReadyReception, sky: np.ndarray, sent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance / π from the sky and from senders, ``(N, 3)`` each.

    Parameters
    ----------
    sky
        ``(r, 3)``: ``from_sky.T @ patch radiances``.
    sent
        ``(M, 3)`` radiance of the senders.
    """
    import drjit as dr
    import mitsuba as mi

    mi_sky = mi.Float(np.ascontiguousarray(sky, np.float32).ravel())
    # Four floats a row are one aligned load.
    table = np.zeros((2 * len(sent), 4), np.float32)
    table[:, :3] = node_radiance(sent)
    mi_sent = mi.Float(table.ravel())
    direct = [mi.Float(0.0)] * 3
    for k, column in enumerate(ready.mi_direct):
        wide = mi.Float(column)
        direct = [dr.fma(wide, dr.gather(mi.Float, mi_sky, 3 * k + c), direct[c]) for c in range(3)]
    total = mi.Vector4f(0.0)
    for pair in ready.mi_sender_pairs:
        total += dr.gather(mi.Vector4f, mi_sent, pair & 0xFFFF) + dr.gather(mi.Vector4f, mi_sent, pair >> 16)
    # A basis of few directions may dip below zero where almost nothing arrives.
    direct = [dr.fmax(channel, 0.0) for channel in direct]
    bounced = [total[c] * ready.mi_share for c in range(3)]
    for around in ready.mi_smoothing:
        bounced = mi_smoothed(bounced, around)
    dr.eval(direct, bounced)
    return tuple(np.stack([np.array(channel) for channel in part], axis=-1) for part in (direct, bounced))  # type: ignore[return-value]


def luminaries(illumination: Illumination) -> list[Luminary]:
    """Sun and moon where they are bright enough to matter beside the sky."""
    patches = sky_patches("tregenza")
    sky = patch_radiance(patches, illumination.sky_radiance)
    faint = FAINT * float(luminance((sky * patches.solid_angle_sr[:, None]).sum(axis=0)))
    both = (illumination.sun, illumination.moon)
    return [body for body in both if body is not None and luminance(body.normal_illuminance_lx) > faint]


def light_senders(ready: ReadySenders, illumination: Illumination) -> tuple[np.ndarray, np.ndarray]:
    """The sky in the basis of directions ``(r, 3)`` and the radiance of the senders ``(M, 3)`` [cd/m²] under a light."""
    senders = ready.senders
    sky = patch_radiance(sky_patches(senders.patches), illumination.sky_radiance)
    sky = (senders.from_sky.T @ sky).astype(np.float32)
    if senders.bounces == 0:
        return sky, np.zeros((1, 3), np.float32)
    albedo = senders.points.albedo
    mean_albedo = albedo.mean(axis=1)
    direct, _ = arriving(ready.reception, sky, np.zeros((len(albedo), 3), np.float32))
    sent = direct * mean_albedo
    for body in luminaries(illumination):
        cosine = cosine_seen(ready.rays, body)
        sent += (cosine[..., None] * albedo).mean(axis=1) * (np.asarray(body.normal_illuminance_lx, np.float32) / np.pi)
    total = sent
    for _ in range(senders.bounces - 1):
        total = sent + mean_albedo * arriving(ready.reception, 0.0 * sky, total)[1]
    return sky, total.astype(np.float32)
