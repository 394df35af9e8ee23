"""What an albedo says that the land looks like at an hour: it ties photographs together and guides their completion."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from seasonscapes.commands.talk import progress_bar

if TYPE_CHECKING:
    import numpy as np

    from seasonscapes.pipeline import Place
    from seasonscapes.sky.models import SkyModel
    from seasonscapes.terrain.surface import Texture

# Raised when equal inputs give another light.
_REVISION = 1
_RAYS = 64
# How far off an albedo from photographs is, relit [log]; it then says more about a picture's exposure than its sky does.
RELIT_SIGMA = 0.2


def expected_radiance(land: Place, albedo: Path, utc: datetime, model: SkyModel) -> Texture:
    """Radiance ``(R, S, 3)`` [cd/m²] that leaves every texel of an albedo file at an instant; kept in the workspace.

    ``weight`` is the albedo's own: 0 where no photograph had measured it. `InputError` where the file is none of this
    place's atlas.
    """
    from seasonscapes.pipeline import dated_albedos
    from seasonscapes.terrain.surface import load_texture, save_texture
    from seasonscapes.workspace import build_once

    (dated,) = dated_albedos(land, [(utc.date().isoformat(), str(albedo))])
    inputs = {"revision": _REVISION, "place": land.key, "albedo": dated.content, "time": utc.isoformat(), "sky": model}
    return build_once(
        land.workspace,
        f"{land.scene.name}/expected",
        inputs,
        suffix=".npz",
        save=save_texture,
        load=load_texture,
        build=lambda: _relit(land, dated.load(), utc, model),
    )


def albedo_error(albedo: Path) -> np.ndarray:
    """Relative standard error ``(R, S)`` of an albedo file; where it tells none, what albedos from photographs have."""
    import numpy as np

    with np.load(albedo, allow_pickle=False) as stored:
        values = stored["values"]
        sigma = stored["sigma"] if "sigma" in stored else np.full(values.shape[:2], np.inf, np.float32)
    relative = sigma / np.maximum(values[..., 1], 1e-3)
    return np.where(np.isfinite(relative), relative, RELIT_SIGMA).astype(np.float32)


def _relit(land: Place, texture: Texture, utc: datetime, model: SkyModel) -> Texture:
    import numpy as np

    from seasonscapes.daylight import land_light
    from seasonscapes.relighting.lit_texture import lit_texture
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.rendering.transport import SamplingOptions
    from seasonscapes.terrain.surface import Texture
    from seasonscapes.terrain.texels import texel_positions

    light, _ = land_light(land, model, utc)
    positions, _ = texel_positions(land.terrain, land.atlas.width_px, land.atlas.height_px)
    with progress_bar("relighting the albedo") as progress:
        lit = lit_texture(
            ray_scene(mi_mesh(land.terrain, texture.values)),
            positions,
            texture.values,
            light,
            sampling=SamplingOptions(subpixels=1, rays=_RAYS),
            progress=progress,
        )
    return Texture(lit.radiance.astype(np.float32), texture.weight)
