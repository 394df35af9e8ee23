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
# # Terrain: from an elevation raster to a mesh with a texture atlas
#
# `small.toml` names a small synthetic massif. A real place names a GeoTIFF instead; everything below stays the same.

# %%
import matplotlib.pyplot as plt
import numpy as np

import seasonscapes as ss

# %% [markdown]
# The elevation raster as a hillshade. Heights are in the raster's own vertical datum.

# %%
place = ss.load_place("small.toml")
heights = place.elevation.values[..., 0]
down, across = np.gradient(heights, place.elevation.transform.a)
towards_light = np.array([-1.0, 1.0, 1.2]) / np.linalg.norm([-1.0, 1.0, 1.2])
shade = -across * towards_light[0] + down * towards_light[1] + towards_light[2]
plt.imshow(np.clip(shade / np.sqrt(1.0 + across**2 + down**2), 0, 1), cmap="gray")
plt.title(f"{heights.min():.0f} to {heights.max():.0f} m")
_ = plt.axis("off")

# %% [markdown]
# The mesh is simplified to an error bound: flat ground needs few triangles. Coordinates are east, north and up in metres
# about the scene's origin, computed through the ellipsoid, so that they include the Earth's curvature.

# %%
bounds_m = [20.0, 10.0, 5.0, 2.0]
places = [ss.load_place("small.toml", options=ss.MeshOptions(max_error_m=bound)) for bound in bounds_m]
plt.loglog(bounds_m, [len(each.terrain.faces) for each in places], "o-")
plt.xlabel("error bound [m]")
plt.ylabel("triangles")
_ = plt.title(f"the default has {len(place.terrain.faces):,}")

# %% [markdown]
# The texture atlas: every triangle has texels of its own, and none overlap. Texels on steep ground are stretched.

# %%
atlas = place.atlas
print(f"{atlas.width_px} x {atlas.height_px} texels")
print(f"median side {atlas.texel_p50_m:.1f} m, 99th percentile {atlas.texel_p99_m:.1f} m")

# %% [markdown]
# Albedo through the year. A synthetic place has a true albedo for every day: forest, meadow, rock, glacier and seasonal
# snow.

# %%
figure, axes = plt.subplots(1, 4, figsize=(14, 4))
for axis, month in zip(axes, (1, 4, 7, 10), strict=True):
    axis.imshow(ss.srgb_from_linear(ss.scene_albedo(place, f"2024-{month:02d}-15").values))
    axis.set_title(f"{month:02d}-15")
    axis.axis("off")

# %% [markdown]
# A rendered view also holds its G-buffer: distance, position, normal and texture coordinates of each pixel.

# %%
above = ss.Viewpoint(latitude_deg=46.5712, longitude_deg=7.98, height_m=3200.0, heading_deg=180.0, pitch_deg=-18.0)
seen = ss.render(place, ss.camera(place, above, size_px=(420, 280)), "2024-07-15T13:00", spp=1).gbuffer
figure, axes = plt.subplots(1, 2, figsize=(12, 4))
shown = axes[0].imshow(seen.depth / 1000.0)
figure.colorbar(shown, ax=axes[0], label="km")
axes[1].imshow(0.5 + 0.5 * np.nan_to_num(seen.normal))
for axis in axes:
    axis.axis("off")
