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
# # Albedo: what the land is, without the light
#
# Pictures of several hours, the sun and the sky known, tell the land's albedo: shadows of one hour are sunlit in another.

# %%
from datetime import UTC, datetime
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from seasonscapes.albedo.closed_form import solve_albedo
from seasonscapes.albedo.forward_model import trace_texel_transport
from seasonscapes.albedo.photographs import EIGHT_BIT, prepare_photographs
from seasonscapes.albedo.standard_error import texel_sigma, times_sunlit
from seasonscapes.evaluation.surfaces import albedo_error
from seasonscapes.evaluation.synthetic_webcams import WebcamInstant, WebcamOptions, webcam_series
from seasonscapes.evaluation.webcam_faults import WebcamFaults
from seasonscapes.images import srgb_from_linear
from seasonscapes.rendering.transport import SamplingOptions
from seasonscapes.sky.models import read_sky_model
from seasonscapes.workflows.albedo_sources import albedo_for
from seasonscapes.workflows.illumination import illumination_for_camera
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import default_workspace

# %% [markdown]
# Two webcams, four hours, exposures and white balances unknown.

# %%
place = load_place(Path("small.toml"), default_workspace(), options=MeshOptions(texel_m=40.0))
day, model = datetime(2024, 9, 11, tzinfo=UTC), read_sky_model("clear")
truth = albedo_for(place, day).values
sampling = SamplingOptions(
    shadow_samples=4, albedo_samples=16, rays=64, clusters=1024, clusters_per_receiver=32, rank=24
)
observations, lights, shown = [], [], []
for name in ("west", "south"):
    camera = camera_for(place, place.scene.camera(name), size_px=(180, 120))
    times = [day.replace(hour=hour) for hour in (7, 10, 13, 15)]
    hours = [WebcamInstant(time, illumination_for_camera(place, camera, model, time)[0], truth) for time in times]
    options = WebcamOptions(WebcamFaults(tone_strength=0.0), sampling=sampling)
    pictures = webcam_series(place.terrain, name, camera, hours, options=options)
    observations += [picture.observation for picture in pictures]
    lights += [hour.illumination for hour in hours]
    shown.append(np.concatenate([picture.encoded for picture in pictures], axis=1))
plt.figure(figsize=(14, 5))
plt.imshow(np.concatenate(shown))
_ = plt.axis("off")

# %% [markdown]
# Light on every texel and the texels under every pixel are traced; then albedo and gains follow from one robust, sparse
# least-squares problem.

# %%
land = trace_texel_transport(
    place.terrain,
    truth.shape[:2],
    sampling=SamplingOptions(shadow_samples=1, rays=64, clusters_per_receiver=32, clusters=1024, rank=24),
)
photographs = prepare_photographs(land, observations, lights)
fit = solve_albedo(land, photographs, noise_model=EIGHT_BIT)
seen = fit.pixel_count >= 1.0
print(albedo_error(truth, fit.albedo, seen))

# %%
figure, axes = plt.subplots(1, 3, figsize=(15, 5))
for axis, (name, values) in zip(
    axes, {"truth": truth, "recovered": fit.albedo, "error × 4": 4 * np.abs(fit.albedo - truth)}.items(), strict=True
):
    axis.imshow(srgb_from_linear(values * seen[..., None]))
    axis.set_title(name)
    axis.axis("off")

# %% [markdown]
# How well it is known, and why: texels that no picture shows in sunlight are known worse.

# %%
figure, axes = plt.subplots(1, 2, figsize=(12, 5))
sigma = texel_sigma(fit)
shown = axes[0].imshow(np.where(np.isfinite(sigma), sigma, np.nan), vmax=0.1)
figure.colorbar(shown, ax=axes[0], label="standard deviation")
shown = axes[1].imshow(times_sunlit(photographs))
figure.colorbar(shown, ax=axes[1], label="pictures in sunlight")
for axis in axes:
    axis.axis("off")
