# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Texture: webcams painted onto the terrain, and what none of them saw
#
# Three webcams paint one hour. A fourth place, where no webcam stands, judges.

# %%
from datetime import UTC, datetime, timedelta
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from seasonscapes.evaluation.figures import comparison_figure
from seasonscapes.evaluation.masks import terrain_mask
from seasonscapes.evaluation.metrics import score
from seasonscapes.evaluation.synthetic_webcams import WebcamInstant, WebcamOptions, webcam_series
from seasonscapes.exposure import develop, exposure_ev100
from seasonscapes.images import srgb_from_linear
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import build_scene, mi_mesh
from seasonscapes.rendering.radiance import apply_aerial_perspective, render_view
from seasonscapes.rendering.transport import SamplingOptions
from seasonscapes.sky.ephemeris import sun_position
from seasonscapes.sky.models import read_sky_model
from seasonscapes.terrain.surface import sample_texture
from seasonscapes.texturing.completion import CompletionOptions, complete
from seasonscapes.texturing.inputs import PaintingInput
from seasonscapes.texturing.painting import PaintTarget, paint_atlas
from seasonscapes.texturing.predictors import predictors_for
from seasonscapes.workflows.albedo_sources import albedo_for
from seasonscapes.workflows.illumination import illumination_for_camera
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import default_workspace

# %% [markdown]
# Pictures of a September morning, with all the faults of webcams.

# %%
place = load_place(Path("small.toml"), default_workspace(), options=MeshOptions(texel_m=25.0))
time, model = datetime(2024, 9, 11, 9, tzinfo=UTC), read_sky_model("clear")
albedo = albedo_for(place, time)
sampling = SamplingOptions(
    shadow_samples=4, albedo_samples=16, rays=64, clusters=1024, clusters_per_receiver=32, rank=24
)
shots, shown = [], []
for name in ("west", "middle", "south"):
    camera = camera_for(place, place.scene.camera(name), size_px=(210, 140))
    light, _ = illumination_for_camera(place, camera, model, time)
    instant, options = WebcamInstant(time, light, albedo.values), WebcamOptions(sampling=sampling)
    picture = webcam_series(place.terrain, name, camera, [instant], options=options)[0]
    shots.append(PaintingInput(picture.observation, light.aerial_perspective))
    shown.append(picture.encoded)
plt.figure(figsize=(14, 4))
plt.imshow(np.concatenate(shown, axis=1))
_ = plt.axis("off")

# %% [markdown]
# Each texel asks by ray which webcams see it. Their exposure, white balance, contrast and haze are made to agree.

# %%
land = ray_scene(mi_mesh(place.terrain, albedo.values))
painting = paint_atlas(shots, PaintTarget(place.terrain, place.atlas, land))
figure, axes = plt.subplots(1, 2, figsize=(12, 5))
axes[0].imshow(srgb_from_linear(develop(painting.texture.values, exposure_ev100(painting.texture.values))))
axes[1].imshow(painting.coverage, cmap="viridis")
axes[0].set_title(f"{np.mean(painting.texture.weight > 0):.0%} painted")
axes[1].set_title("webcams with a say")
for axis in axes:
    axis.axis("off")

# %% [markdown]
# What no webcam saw is learned from what the land tells of itself: relief, sun, and an image from above of another day.

# %%
at = (place.frame.latitude_deg, place.frame.longitude_deg)
day = [time + timedelta(hours=hour) for hour in range(-12, 12)]
guides = predictors_for(
    place.terrain,
    place.atlas,
    satellite=albedo_for(place, datetime(2024, 7, 23, tzinfo=UTC)),
    sun_direction=sun_position(time, *at).direction,
    day_suns=np.asarray(sun_position(day, *at).direction),
)
completed = {
    method: complete(painting.texture, guides, options=CompletionOptions(method, fast=True)).values
    for method in ("guided", "telea")
}
figure, axes = plt.subplots(1, 2, figsize=(12, 5))
for axis, (method, values) in zip(axes, completed.items(), strict=True):
    axis.imshow(srgb_from_linear(develop(values, exposure_ev100(values))))
    axis.set_title(method)
    axis.axis("off")

# %% [markdown]
# The place where no webcam stands: truth, ours, and completion as the reference implementation does it.

# %%
camera = camera_for(place, place.scene.camera("unseen"), size_px=(210, 140))
stage = build_scene(place.terrain, albedo.values, illumination_for_camera(place, camera, model, time)[0])
truth = render_view(stage, camera, spp=32)


def view(texture: np.ndarray) -> np.ndarray:
    surface = np.nan_to_num(sample_texture(texture, truth.gbuffer.uv))
    return apply_aerial_perspective(
        stage, camera, surface, np.isfinite(truth.gbuffer.depth).astype(np.float32), truth.gbuffer
    )


ev100, mask = exposure_ev100(truth.radiance), terrain_mask(truth.gbuffer.depth)
pictures = {"truth": truth.radiance} | {method: view(values) for method, values in completed.items()}
pictures = {name: srgb_from_linear(develop(radiance, ev100)) for name, radiance in pictures.items()}
for method in completed:
    print(method, score(pictures["truth"], pictures[method], mask))
plt.figure(figsize=(16, 4))
plt.imshow(comparison_figure(pictures, mask=mask))
_ = plt.axis("off")
