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
# # Relighting: one view, any hour, any season
#
# Path tracing answers one instant at a time. Daylight coefficients are traced once for a view; each instant then is a
# product of matrices and a few shadow rays, with the same bounces and without noise.

# %%
import time as clock
from datetime import UTC, datetime, timedelta
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from seasonscapes.evaluation.masks import terrain_mask
from seasonscapes.evaluation.metrics import score
from seasonscapes.exposure import develop, exposure_ev100
from seasonscapes.images import srgb_from_linear
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import build_scene, mi_mesh, set_albedo
from seasonscapes.rendering.radiance import render_view
from seasonscapes.rendering.relit_view import cluster_albedo, relight_view, relightable_view, with_albedo
from seasonscapes.rendering.transport import SamplingOptions, trace_view, view_albedo
from seasonscapes.sky.models import read_sky_model
from seasonscapes.workflows.albedo_sources import albedo_for
from seasonscapes.workflows.illumination import illumination_for_camera
from seasonscapes.workflows.place import load_place
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import default_workspace


def shown(radiance: np.ndarray) -> np.ndarray:
    return srgb_from_linear(develop(radiance, exposure_ev100(radiance)))


# %% [markdown]
# Trace the view once.

# %%
place = load_place(Path("small.toml"), default_workspace())
camera = camera_for(place, place.scene.camera("unseen"), size_px=(270, 180))
autumn = datetime(2024, 9, 18, tzinfo=UTC)
land = ray_scene(mi_mesh(place.terrain, albedo_for(place, autumn).values))
start = clock.perf_counter()
coefficients = trace_view(
    land,
    camera,
    SamplingOptions(shadow_samples=4, albedo_samples=16, rays=128, clusters=2048, clusters_per_receiver=32, rank=24),
)
ready = relightable_view(land, coefficients)
print(f"traced in {clock.perf_counter() - start:.1f} s")

# %% [markdown]
# A day. Each frame is exposed as a camera would.

# %%
model = read_sky_model("clear")
hours = [autumn + timedelta(hours=hour) for hour in (6.0, 8.0, 11.0, 14.0, 16.5, 17.6)]
lights = [illumination_for_camera(place, camera, model, hour)[0] for hour in hours]
start = clock.perf_counter()
views = [relight_view(ready, light) for light in lights]
print(f"{(clock.perf_counter() - start) / len(views):.2f} s a frame")
figure, axes = plt.subplots(2, 3, figsize=(14, 6.5))
for axis, hour, view in zip(axes.ravel(), hours, views, strict=True):
    axis.imshow(shown(view.radiance))
    axis.set_title(f"{hour:%H:%M} UTC")
    axis.axis("off")

# %% [markdown]
# Against path tracing, over the land: what is left is its noise.

# %%
traced = render_view(build_scene(place.terrain, albedo_for(place, autumn).values, lights[2]), camera, spp=64)
ev100 = exposure_ev100(traced.radiance)
pair = [srgb_from_linear(develop(radiance, ev100)) for radiance in (traced.radiance, views[2].radiance)]
print(score(*pair, terrain_mask(traced.gbuffer.depth)))

# %% [markdown]
# Seasons: the same coefficients with another day's colours.

# %%
figure, axes = plt.subplots(1, 3, figsize=(14, 3.4))
for axis, (month, day) in zip(axes, ((2, 10), (5, 20), (7, 20)), strict=True):
    noon = datetime(2024, month, day, 11, tzinfo=UTC)
    colours = albedo_for(place, noon).values
    set_albedo(land, colours)
    clothed = with_albedo(ready, view_albedo(land, coefficients), cluster_albedo(coefficients, colours))
    axis.imshow(shown(relight_view(clothed, illumination_for_camera(place, camera, model, noon)[0]).radiance))
    axis.set_title(f"{noon:%d %B}")
    axis.axis("off")
