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
# # Terrain: from a raster to a mesh with a texture
#
# `small.toml` names a small synthetic massif; a real place names a GeoTIFF instead, and all of this stays the same.

# %%
from datetime import UTC, datetime
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from seasonscapes.cameras.pinhole import camera_at
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh
from seasonscapes.workflows.albedo_sources import albedo_for
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workspace import default_workspace

# %% [markdown]
# The elevation raster, as hillshade. Heights are in the raster's own vertical datum.

# %%
place = load_place(Path("small.toml"), default_workspace())
heights = place.elevation.values[..., 0]
down, across = np.gradient(heights, place.elevation.transform.a)
light = np.array([-1.0, 1.0, 1.2]) / np.linalg.norm([-1.0, 1.0, 1.2])
shade = (-across * light[0] + down * light[1] + light[2]) / np.sqrt(1.0 + across**2 + down**2)
plt.imshow(np.clip(shade, 0, 1), cmap="gray")
plt.title(f"{heights.min():.0f} to {heights.max():.0f} m")
_ = plt.axis("off")

# %% [markdown]
# The mesh is as fine as its error bound asks for: flat ground needs few triangles. Coordinates are east, north and up in
# metres about the scene's centre, through the ellipsoid, so that the Earth's curvature comes by itself.

# %%
bounds_m = [20.0, 10.0, 5.0, 2.0]
counts = [
    len(load_place(Path("small.toml"), default_workspace(), options=MeshOptions(max_error_m=bound)).terrain.faces)
    for bound in bounds_m
]
plt.loglog(bounds_m, counts, "o-")
plt.xlabel("error bound [m]")
plt.ylabel("triangles")
_ = plt.title(f"the default has {len(place.terrain.faces):,}")

# %% [markdown]
# The texture atlas: every triangle has its texels, and none overlap. Texels on steep ground are stretched.

# %%
atlas = place.atlas
print(
    f"{atlas.width_px} x {atlas.height_px} texels, median side {atlas.texel_p50_m:.1f} m, 99th percentile {atlas.texel_p99_m:.1f} m"
)

# %% [markdown]
# Albedo through the year. A synthetic place knows its own truth: forest, meadow, rock, glacier, and snow that comes and goes.

# %%
figure, axes = plt.subplots(1, 4, figsize=(14, 4))
for axis, month in zip(axes, (1, 4, 7, 10), strict=True):
    axis.imshow(np.clip(albedo_for(place, datetime(2024, month, 15, tzinfo=UTC)).values, 0, 1) ** (1 / 2.2))
    axis.set_title(f"{month:02d}-15")
    axis.axis("off")

# %% [markdown]
# Rays tell what a camera sees: distance, normal, and where in the texture.

# %%
camera = camera_at(
    place.frame, 46.5712, 7.98, 3200.0, heading_deg=180.0, pitch_deg=-18.0, fov_deg=60.0, size_px=(420, 280)
)
land = ray_scene(mi_mesh(place.terrain, np.full(3, 0.3)))
seen = trace_gbuffer(RenderScene(land.mi_scene, land.mi_terrain), camera)
figure, axes = plt.subplots(1, 2, figsize=(12, 4))
shown = axes[0].imshow(seen.depth / 1000.0)
figure.colorbar(shown, ax=axes[0], label="km")
axes[1].imshow(0.5 + 0.5 * np.nan_to_num(seen.normal))
for axis in axes:
    axis.axis("off")
