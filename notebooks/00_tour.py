# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A tour: any date and hour of a place
#
# A corner of a synthetic massif in the Bernese Oberland, whose albedo is known for every day of the year. With
# `find_scene("alpine")` instead of `Path("small.toml")` it is the whole embedded scene, which takes some minutes the first
# time.

# %%
from datetime import UTC, datetime
from pathlib import Path

import matplotlib.pyplot as plt

from seasonscapes.exposure import develop, exposure_ev100
from seasonscapes.images import srgb_from_linear
from seasonscapes.rendering.mitsuba_scene import build_scene
from seasonscapes.rendering.radiance import render_view
from seasonscapes.sky.models import read_sky_model
from seasonscapes.sky.report import dome_picture
from seasonscapes.workflows.albedo_sources import albedo_for
from seasonscapes.workflows.illumination import illumination_at, illumination_for_camera, sun_moon_position
from seasonscapes.workflows.place import load_place
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import default_workspace

# %% [markdown]
# Terrain and camera. The first time builds the massif; later it is read from the workspace.

# %%
place = load_place(Path("small.toml"), default_workspace())
camera = camera_for(place, place.scene.camera(None), size_px=(384, 256))
print(f"{len(place.terrain.faces):,} triangles, texels of {place.atlas.texel_p50_m:.1f} m")

# %% [markdown]
# The sky of an evening in September, as a map of the dome.

# %%
evening = datetime(2024, 9, 18, 17, 5, tzinfo=UTC)
moment = sun_moon_position(evening, place.frame.latitude_deg, place.frame.longitude_deg)
sky = illumination_at(read_sky_model("clear"), moment, 1500.0, workspace=place.workspace)
plt.imshow(srgb_from_linear(dome_picture(sky, 400)))
plt.title(f"sun at {moment.sun.elevation_deg:.1f}°")
_ = plt.axis("off")
# %% [markdown]
# The view at that hour: radiance in cd/m², developed as a camera would.

# %%
light, _ = illumination_for_camera(place, camera, read_sky_model("clear"), evening)
view = render_view(build_scene(place.terrain, albedo_for(place, evening).values, light), camera, spp=16)
plt.figure(figsize=(9, 6))
plt.imshow(srgb_from_linear(develop(view.radiance, exposure_ev100(view.radiance))))
_ = plt.axis("off")
# %% [markdown]
# What each pixel sees: distance along the ray, in kilometres.

# %%
plt.imshow(view.gbuffer.depth / 1000.0, cmap="viridis")
_ = plt.colorbar(label="km")
