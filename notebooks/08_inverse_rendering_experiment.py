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
# # An inverse-rendering experiment
#
# Pictures under known light are rendered differentiably, and what is unknown follows their gradients. Here the albedo starts
# from plain grey and the exposures from wrong ones. It is a place to try one's own unknowns and losses: a callback
# sees every iteration, and any of Mitsuba's parameters can become an unknown.

# %%
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from seasonscapes.albedo.closed_form import solve_albedo
from seasonscapes.albedo.forward_model import trace_texel_transport
from seasonscapes.albedo.inverse import InverseOptions, refine_albedo
from seasonscapes.albedo.photographs import prepare_photographs
from seasonscapes.cameras.observation import Observation
from seasonscapes.evaluation.surfaces import albedo_error
from seasonscapes.images import srgb_from_linear
from seasonscapes.rendering.mitsuba_scene import build_scene
from seasonscapes.rendering.radiance import render_view
from seasonscapes.rendering.transport import SamplingOptions
from seasonscapes.sky.models import read_sky_model
from seasonscapes.workflows.albedo_sources import albedo_for
from seasonscapes.workflows.illumination import illumination_for_camera
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import default_workspace

# %% [markdown]
# Path-traced pictures of two webcams at two hours.

# %%
place = load_place(Path("small.toml"), default_workspace(), options=MeshOptions(texel_m=60.0))
day, model = datetime(2024, 9, 11, tzinfo=UTC), read_sky_model("clear")
truth = albedo_for(place, day).values
observations, lights = [], []
for name in ("west", "south"):
    camera = camera_for(place, place.scene.camera(name), size_px=(90, 60))
    for hour in (9, 14):
        time = day.replace(hour=hour)
        light, _ = illumination_for_camera(place, camera, model, time)
        image = render_view(build_scene(place.terrain, truth, light), camera, spp=32).radiance
        observations.append(Observation(image, np.ones(image.shape[:2], bool), camera, time, name))
        lights.append(light)

# %% [markdown]
# The closed form is the reference; the experiment begins from grey, with gains 20 % off.

# %%
land = trace_texel_transport(
    place.terrain,
    truth.shape[:2],
    sampling=SamplingOptions(shadow_samples=1, rays=64, clusters_per_receiver=32, clusters=1024, rank=24),
)
photographs = prepare_photographs(land, observations, lights, gains=[np.ones(3)] * len(lights))
closed = solve_albedo(land, photographs)
seen = closed.pixel_count >= 1.0
grey = replace(closed, albedo=np.full_like(truth, 0.2), gains=1.2 * closed.gains)
errors = []


def watch(state) -> None:
    errors.append(albedo_error(truth, state.values["albedo"], seen).mae)


options = InverseOptions(
    unknowns=("albedo", "log_gain"),
    levels=(4, 1),
    iterations=16,
    photographs_per_iteration=2,
    spp=4,
    check_every=8,
    steps={"albedo": 0.03, "log_gain": 0.02},
)
found = refine_albedo(place.terrain, land, photographs, grey, options=options, callbacks=[watch])
print(f"gains from {grey.gains.mean():.2f} to {found.fit.gains.mean():.2f} of the true ones")

# %%
figure, axes = plt.subplots(1, 2, figsize=(12, 4))
axes[0].semilogy([entry["loss"] for entry in found.history])
axes[0].set_xlabel("iteration")
axes[0].set_ylabel("loss")
axes[1].plot(errors)
axes[1].axhline(albedo_error(truth, closed.albedo, seen).mae, ls="--", label="closed form")
axes[1].set_ylabel("mean absolute error of albedo")
_ = axes[1].legend()

# %%
figure, axes = plt.subplots(1, 3, figsize=(15, 5))
for axis, (name, values) in zip(
    axes, {"truth": truth, "closed form": closed.albedo, "by gradients": found.fit.albedo}.items(), strict=True
):
    axis.imshow(srgb_from_linear(values * seen[..., None]))
    axis.set_title(name)
    axis.axis("off")
