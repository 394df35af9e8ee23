"""Light on the terrain pixels of a fixed camera, from a view's daylight coefficients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seasonscapes.albedo.picture_conditions import ViewLight
from seasonscapes.rendering.receivers import incident_light, light_clusters
from seasonscapes.rendering.relit_view import RelightableView, sun_cosine
from seasonscapes.rendering.sun_visibility import raised_rays
from seasonscapes.sky.illumination import Illumination, Luminary

# Below this cosine of incidence, visibility is that of ground rougher than the heights: this share of it sees the sun.
_GRAZING, _TURNED_AWAY, _TURNED_AWAY_VISIBLE = 0.15, 0.02, 0.3


def view_light(view: RelightableView, clear: Illumination, overcast: Illumination) -> ViewLight:
    """Light of one instant on the terrain pixels of a view, under a clear sky and under clouds.

    Parameters
    ----------
    view
        The view's coefficients.
    clear, overcast
        Light of the instant under either sky.

    Returns
    -------
    ViewLight
        Relative to the mean light of each sky over the pixels.

    Raises
    ------
    ValueError
        Where the illumination states no time.
    """
    if clear.time is None:
        raise ValueError("view_light: the illumination states no time")
    sky, bounce = incident_light(view.receivers, light_clusters(view.clusters, clear))
    cloud_sky, cloud_bounce = incident_light(view.receivers, light_clusters(view.clusters, overcast))
    clouds = cloud_sky + cloud_bounce
    direction, direct = np.array([0.0, 0.0, -1.0]), np.zeros(3)
    visible = np.zeros(len(sky), np.float32)
    lit = np.zeros(len(sky), np.float32)
    if clear.sun is not None and clear.sun.direction[2] > 0.0:
        direction = np.asarray(clear.sun.direction, float)
        direct = np.maximum(np.asarray(clear.sun.normal_illuminance_lx, float), 0.0) / np.pi
        lit = sun_cosine(view, clear.sun)
        visible = _visible_share(view, lit, direction)
    mean = float((lit[:, None] * direct + sky + bounce).mean())
    day = clear.time.timetuple().tm_yday
    return ViewLight(direct / mean, visible, direction, (sky + bounce) / mean, clouds / float(clouds.mean()), day)


def sun_visible(view: RelightableView, sun: Luminary) -> np.ndarray:
    """Share ``(n,)`` of the ground in each pixel of a view that sees the sun, as in `view_light`; 0 below the horizon."""
    if sun.direction[2] <= 0.0:
        return np.zeros(len(view.coefficients.pixel), np.float32)
    return _visible_share(view, sun_cosine(view, sun), np.asarray(sun.direction, float))


def _visible_share(view: RelightableView, lit: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """The share that sees the sun, of its mean cosine × visibility and its direction."""
    cosine = view_normals(view) @ direction
    visible = np.clip(lit / np.maximum(cosine, _GRAZING), 0.0, 1.0)
    return np.where(cosine > _TURNED_AWAY, visible, _TURNED_AWAY_VISIBLE).astype(np.float32)


def view_raised(view: RelightableView, height_m: float) -> RelightableView:
    """A view whose ground receives sunlight as if it lay higher by ``height_m`` [m] below the same ridges."""
    return replace(view, rays=raised_rays(view.rays, height_m))


def view_normals(view: RelightableView) -> np.ndarray:
    """Unit normals ``(n, 3)`` of the heights in the terrain pixels, east-north-up."""
    normal = np.asarray(view.coefficients.normal, float)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)


def view_distances_km(view: RelightableView) -> np.ndarray:
    """Distance ``(n,)`` of the terrain in the pixels [km]."""
    origin = np.asarray(view.coefficients.sample_origin, np.float32)
    weight = np.asarray(view.coefficients.sample_weight, np.float32)
    away = np.linalg.norm(origin - view.coefficients.camera.position_m.astype(np.float32), axis=2)
    return (away * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-6) / 1000.0


def view_heights_m(view: RelightableView) -> np.ndarray:
    """Height ``(n,)`` of the terrain in the pixels above the frame's origin [m]."""
    height = np.asarray(view.coefficients.sample_origin, np.float32)[..., 2]
    weight = np.asarray(view.coefficients.sample_weight, np.float32)
    return (height * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-6)
