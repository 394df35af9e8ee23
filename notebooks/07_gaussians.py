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
# # Gaussians: relit renders distilled into splats
#
# Discs on the terrain know their horizon, their share of the sky and their albedo, and learn what is left from lit
# surfaces. They then answer for hours that they have not seen.

# %%
from datetime import UTC, datetime, timedelta
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from seasonscapes.gaussians.appearance import Appearance, colours_at, fourier_embedding
from seasonscapes.gaussians.disc_transport import (
    light_state,
    neighbourhood_mean,
    surfel_irradiance,
    trace_disc_transport,
)
from seasonscapes.gaussians.rasterise import set_torch_threads, splat_colours, view_weights
from seasonscapes.gaussians.surfels import surfel_albedo, terrain_surfels
from seasonscapes.gaussians.training import Schedule, surface_targets, train
from seasonscapes.gaussians.training_views import front_facing_splats, overview_cameras
from seasonscapes.images import srgb_from_linear
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import mi_mesh
from seasonscapes.rendering.relit_view import relight_view, relightable_view
from seasonscapes.rendering.transport import SamplingOptions, trace_view
from seasonscapes.sky.models import read_sky_model
from seasonscapes.workflows.albedo_sources import albedo_for
from seasonscapes.workflows.illumination import illumination_at, sun_moon_position
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workspace import default_workspace

set_torch_threads(1)

# %% [markdown]
# Discs, one for every 75 m of ground, and how light reaches them.

# %%
place = load_place(Path("small.toml"), default_workspace(), options=MeshOptions(texel_m=25.0))
day = datetime(2024, 9, 11, tzinfo=UTC)
texture = albedo_for(place, day).values
land = ray_scene(mi_mesh(place.terrain, texture))
surfels = terrain_surfels(place.terrain, 75.0)
albedo = surfel_albedo(surfels, texture)
around = neighbourhood_mean(surfels.means, albedo, surfels.grid.spacing_m)
transport = trace_disc_transport(land, surfels, albedo, rays=64)
print(f"{len(albedo):,} discs, mean sky-view factor {transport.open_sky.mean():.2f}")

# %% [markdown]
# Lessons: eight hours through the year.

# %%
model, at = read_sky_model("clear"), (place.frame.latitude_deg, place.frame.longitude_deg)


def lit(time: datetime):
    light = illumination_at(model, sun_moon_position(time, *at), 2000.0, workspace=place.workspace)
    return light, light_state(transport, light, float(time.timetuple().tm_yday))


lessons_at = [
    datetime(2024, month, 11, hour, tzinfo=UTC)
    for month, hour in ((1, 11), (3, 8), (4, 15), (5, 6), (6, 12), (7, 17), (9, 9), (10, 14))
]
lights, states = zip(*(lit(time) for time in lessons_at), strict=True)
targets = surface_targets(states, [0] * len(states), albedo[None], surfel_irradiance(land, surfels, lights, rays=64))
appearance = Appearance(
    "full", albedo[None], around[None], transport, fourier_embedding(surfels.means), times=len(states)
)
losses = train(appearance, targets, schedule=Schedule(surface_steps=250))
plt.semilogy(np.convolve(losses, np.ones(20) / 20, "valid"))
plt.xlabel("step")
_ = plt.ylabel("loss")

# %% [markdown]
# An hour between the lessons, from a camera above: relit from daylight coefficients, and splatted. The error is over pixels
# that are all land.

# %%
camera = overview_cameras(place.terrain, 1, size_px=160, first_deg=200.0)[0]
light, state = lit(day + timedelta(hours=7.5))
ready = relightable_view(
    land,
    trace_view(
        land,
        camera,
        SamplingOptions(
            shadow_samples=4, albedo_samples=16, rays=128, clusters=2048, clusters_per_receiver=32, rank=24
        ),
    ),
)
truth = relight_view(ready, light).surface * np.float32(np.pi / state.global_lx)
weights = view_weights(front_facing_splats(surfels, camera), camera, subpixels=2)
splats = splat_colours(weights, colours_at(appearance, state)) / np.maximum(weights.coverage, 1e-3)[..., None]
pair = [srgb_from_linear(picture) for picture in (truth, splats)]
solid = (ready.coverage > 0.999) & (weights.coverage > 0.5)
print(f"{-10 * np.log10(np.mean((pair[0] - pair[1])[solid] ** 2)):.1f} dB")
figure, axes = plt.subplots(1, 3, figsize=(14, 5))
for axis, (name, picture) in zip(
    axes,
    {
        "relit": pair[0],
        "splats": pair[1] * solid[..., None],
        "difference × 4": 4 * np.abs(pair[0] - pair[1]) * solid[..., None],
    }.items(),
    strict=True,
):
    axis.imshow(np.clip(picture, 0, 1))
    axis.set_title(name)
    axis.axis("off")
