"""The image that a scene file names, resampled into the place's atlas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.scene import Imagery
from seasonscapes.terrain.raster_files import Confinement
from seasonscapes.workflows.nested_images import finer_images, whole_image
from seasonscapes.workflows.place import Place

# Values above these shares of the full scale are clipped: the last levels of 8-bit sRGB and linear files.
_CLIPPED = {"srgb": 0.975, "linear": 0.996}


@dataclass(frozen=True)
class AtlasImage:
    """An image in a place's atlas.

    Parameters
    ----------
    values
        ``(R, S, 3)`` float32 linear Rec.709, 1 at the file's full scale; 0 where the image does not reach.
    weight
        ``(R, S)`` float32 share of the texel that the image covers.
    clipped
        ``(R, S, 3)`` bool: values at the upper end of the file's range.
    """

    values: np.ndarray
    weight: np.ndarray
    clipped: np.ndarray


def atlas_image(place: Place, imagery: Imagery, confinement: Confinement | None = None) -> AtlasImage:
    """Read an image and resample it into the place's atlas; see `terrain.imagery`.

    Texels that it does not reach at all take the mean of its finer parts, where these do.

    Parameters
    ----------
    place
        The place.
    imagery
        File and encoding: the scene's, or one of its kind.
    confinement
        Where the files of the raster may lie; by default where those of the scene may.

    Raises
    ------
    InputError
        Where the image is none, or covers none of the terrain.
    """
    from seasonscapes.terrain.imagery import bake_imagery, read_imagery
    from seasonscapes.terrain.raster import bounds_geographic

    # Imagery far finer than the texels is averaged while it is read.
    image = read_imagery(
        imagery.paths,
        bounds_deg=bounds_geographic(place.elevation),
        bands=tuple(imagery.bands) if imagery.bands else None,
        finest_m=0.5 * place.atlas.texel_p50_m,
        encoding=imagery.encoding,
        full_scale=imagery.full_scale,
        confinement=confinement or place.scene.confinement,
    )
    texture = bake_imagery(place.terrain, place.atlas, image)
    for part in finer_images(place) if imagery.finer else []:
        mean = whole_image(place, part).mean
        empty = (texture.weight == 0.0) & (mean.weight > 0.0)
        texture.values[empty], texture.weight[empty] = mean.values[empty], mean.weight[empty]
    clipped = (texture.values >= _CLIPPED[imagery.encoding]) & (texture.weight[..., None] > 0.0)
    return AtlasImage(texture.values, texture.weight, clipped)
