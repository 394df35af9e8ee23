"""Detail of images that are finer than the texels of the atlas, laid over the albedo.

The albedo of a texel is multiplied by the image divided by the image's mean over texels. So its mean over a texel stays, to
whatever date, recovery or painting it belongs, and where an image ends no border of colours stands. Each image has several
levels, the finest about the camera; coarser ones lie around it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from seasonscapes.rendering.backend import aligned
from seasonscapes.rendering.grid_placement import GridPlacement
from seasonscapes.terrain.surface_classes import ImageDetail, ImageLevel

# Darkest mean that is divided by, and the largest factor: what stands out more is an error of the image.
_LEAST_MEAN, _MOST_FACTOR = 0.004, 6.0
_MOST_ALBEDO = 0.95


class DeviceImages:
    """Images of a terrain on the Dr.Jit device.

    Parameters
    ----------
    images
        As the terrain states them, the coarsest first.
    """

    def __init__(self, images: Sequence[ImageDetail]) -> None:
        self._images = [(_texture(image.mean), [_Level(level) for level in image.levels]) for image in images]

    def applied(self, albedo: Any, uv: Any, position: Any, texel_m: Any, active: Any = True) -> tuple[Any, Any]:
        """Albedo with the detail of the images, and the side of its finest texels.

        Parameters
        ----------
        albedo
            ``mi.Color3f``: of the atlas.
        uv
            ``mi.Point2f``: texture coordinates of the atlas, row 0 at 0.
        position
            ``mi.Point3f`` [m].
        texel_m
            Side of the texels of the atlas [m].
        active
            ``mi.Bool``.
        """
        import drjit as dr
        import mitsuba as mi

        factor, size = mi.Color3f(1.0), mi.Float(texel_m)
        for mi_mean, levels in self._images:
            colour, share = levels[0].sample(position, active)
            here = active & (share > 0.0)
            texel = mi.Float(levels[0].texel_m)
            for level in levels[1:]:
                finer, weight = level.sample(position, here)
                colour += weight * (finer - colour)
                texel += weight * (level.texel_m - texel)
            mean = mi.Color3f(*(mi.Float(value) for value in mi_mean.eval(uv, here)))
            relative = dr.minimum(colour / dr.maximum(mean, _LEAST_MEAN), _MOST_FACTOR)
            factor += share * (relative - factor)
            size += share * (texel - size)
        return dr.minimum(albedo * factor, dr.maximum(albedo, _MOST_ALBEDO)), size


class _Level:
    """An `ImageLevel` on the Dr.Jit device."""

    def __init__(self, level: ImageLevel) -> None:
        self._mi_texture = _texture(level.values)
        self._placement = GridPlacement(level.to_node, level.domain, level.values.shape[:2], level.rim_nodes)
        self.texel_m = level.texel_m

    def sample(self, position: Any, active: Any) -> tuple[Any, Any]:
        """Colour ``mi.Color3f`` and its share ``mi.Float``, 0 beyond the rim."""
        import drjit as dr
        import mitsuba as mi

        uv = self._placement.uv(position)
        inside = self._placement.share(uv)
        within = active & (inside > 0.0)
        red, green, blue, share = (mi.Float(value) for value in self._mi_texture.eval(uv, within))
        return mi.Color3f(red, green, blue), dr.select(within, inside * share, 0.0)


def _texture(values: np.ndarray) -> Any:
    import drjit as dr
    import mitsuba as mi

    return mi.Texture2f16(  # pyright: ignore[reportCallIssue]
        mi.TensorXf16(aligned(values, np.float16)), use_accel=False, wrap_mode=dr.WrapMode.Clamp
    )
