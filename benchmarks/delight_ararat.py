"""Ararat row of the delighting benchmark: a winter Landsat image of unknown hour, with the shadow of the Ahora gorge.

The sun is found in the image. Scored is the step of brightness across the borders of large cast shadows, 2 to 4 texels to
either side: of the image as it is, of the corrections and of ours. Where land differs on both sides (a gorge's walls are
not its rim), a step remains that is no light.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt, label

from seasonscapes.albedo.corrections import CORRECTIONS, slopes_under
from seasonscapes.frames import direction_from_angles
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.irradiance import surface_at
from seasonscapes.rendering.mitsuba_scene import mi_mesh
from seasonscapes.terrain.texels import texel_positions
from seasonscapes.workflows.delighting import delit_imagery, image_sun
from seasonscapes.workflows.place import Place, load_place
from seasonscapes.workflows.scene_imagery import atlas_image

LEAST_SHADOW_TEXELS = 1000
NEAR_TEXELS = (2.0, 4.5)


def ararat_numbers(data: Path) -> dict[str, Any]:
    """The sun of the winter image, and steps across its shadow borders by every method."""
    folder = data / "ararat-landsat"
    if not folder.is_dir():
        reason = f"no such folder: {folder}; give --data"
        print(f"Ararat: not measured ({reason})")
        return {"ararat_border_step": None, "ararat_reason": reason}
    with tempfile.TemporaryDirectory() as workspace:
        scene = Path(workspace) / "ararat.toml"
        scene.write_text(
            f'name = "ararat"\n[elevation]\nfile = "{folder / "dem_aster_1arcsec.tif"}"\n'
            f'[imagery]\nfile = "{folder / "landsat_winter_30m.tif"}"\n',
            encoding="utf-8",
        )
        place = load_place(scene, allow_outside=True)
        image = atlas_image(place, place.scene.images[0], place.scene.confinement)
        found = image_sun(place, image)
        result = delit_imagery(place, (found.azimuth_deg, found.elevation_deg))
    lit, dark = shadow_sides(result.delit.visibility, result.delit.source > 0)
    sun = direction_from_angles(found.azimuth_deg, found.elevation_deg)
    values = {"ours": result.delit.albedo} | corrected(place, np.asarray(image.values), sun)
    steps = {name: border_step(brightness, lit, dark) for name, brightness in values.items()}
    print(
        f"Ararat in winter: sun {found.azimuth_deg:.1f}° ± {found.azimuth_sigma_deg:.1f}°, {found.elevation_deg:.1f}° ± "
        f"{found.elevation_sigma_deg:.1f}°, {'trusted' if found.trusted else 'not trusted'}; steps across shadow borders: "
        + ", ".join(f"{name} {step:+.2f}" for name, step in steps.items())
    )
    return {
        "ararat_sun_azimuth_deg": found.azimuth_deg,
        "ararat_sun_elevation_deg": found.elevation_deg,
        "ararat_sun_trusted": int(found.trusted),
        "ararat_border_texels": int(min(lit.sum(), dark.sum())),
        "ararat_border_step": abs(steps["ours"]),
        **{f"ararat_{name}_border_step": abs(step) for name, step in steps.items() if name != "ours"},
    }


def shadow_sides(visibility: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Texels ``(R, S)`` on the sunlit and on the shaded side of the borders of large shadows, as the image shows them."""
    numbered, _ = label(visibility < 0.3)  # pyright: ignore[reportGeneralTypeIssues]
    size = np.bincount(numbered.ravel())
    size[0] = 0
    shadow = size[numbered] >= LEAST_SHADOW_TEXELS
    inside, outside = (np.asarray(distance_transform_edt(part)) for part in (shadow, ~shadow))
    near = [(distance >= NEAR_TEXELS[0]) & (distance < NEAR_TEXELS[1]) for distance in (outside, inside)]
    return known & near[0] & (visibility > 0.9), known & near[1] & (visibility < 0.1)


def border_step(values: np.ndarray, lit: np.ndarray, dark: np.ndarray) -> float:
    """Median brightness of the sunlit over that of the shaded side less one half of their sum's, as in `delight`."""
    brightness = values.mean(axis=2)
    one, other = (float(np.nanmedian(brightness[side])) for side in (lit, dark))
    return (one - other) / (0.5 * (one + other))


def corrected(place: Place, values: np.ndarray, sun: np.ndarray) -> dict[str, np.ndarray]:
    """The image as it is, and by each correction ``(R, S, 3)``."""
    surface = ray_scene(mi_mesh(place.terrain, np.full(3, 0.3, np.float32)))
    position, _ = texel_positions(place.terrain, place.atlas.width_px, place.atlas.height_px)
    points, texel = surface_at(surface, position.reshape(-1, 3))
    slopes = slopes_under(np.asarray(points.normal), sun)
    result = {"as_it_is": values}
    for name, correct in CORRECTIONS.items():
        texture = np.full((values.shape[0] * values.shape[1], 3), np.nan)
        texture[texel] = correct(values.reshape(-1, 3)[texel], slopes)
        result[name] = texture.reshape(values.shape)
    return result
