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
# # A tour: any date and hour of a place
#
# A corner of a synthetic massif in the Bernese Oberland, whose albedo is known for every day of the year. With
# `ss.load_place("alpine")` it is the whole embedded scene, which takes some minutes the first time; with
# `ss.load_place("my_valley.toml")` it is a real valley.

# %%
import matplotlib.pyplot as plt

import seasonscapes as ss

# %% [markdown]
# Terrain and camera. The first time builds the massif; later it is read from the workspace.

# %%
place = ss.load_place("small.toml")
camera = ss.camera(place, "west", size_px=(384, 256))
print(f"{len(place.terrain.faces):,} triangles, texels of {place.atlas.texel_p50_m:.1f} m")

# %% [markdown]
# The sky of an evening in September, as a fish-eye camera sees it. Without a UTC offset the time is civil time at the place.

# %%
evening = "2024-09-18T19:05"
light = ss.illumination(place, evening)
plt.imshow(ss.srgb_from_linear(ss.dome_picture(light, 400)))
plt.title(f"sun {light.sun.elevation_deg:.1f}° above the horizon")
_ = plt.axis("off")

# %% [markdown]
# The view at that hour: path-traced radiance in cd/m², developed as a camera would.

# %%
view = ss.render(place, camera, evening, spp=16)
plt.figure(figsize=(9, 6))
plt.imshow(ss.srgb_from_linear(ss.develop(view)))
_ = plt.axis("off")

# %% [markdown]
# Distance along the ray of each pixel, in kilometres.

# %%
plt.imshow(view.gbuffer.depth / 1000.0, cmap="viridis")
_ = plt.colorbar(label="km")
