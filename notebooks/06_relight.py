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
# # Relighting: one view at any hour of any season
#
# Path tracing computes one instant at a time. Daylight coefficients are traced once for a view; each instant then is a
# matrix product and a few shadow rays, with the same number of bounces and without noise.

# %%
import matplotlib.pyplot as plt
import numpy as np

import seasonscapes as ss

# %% [markdown]
# Trace the view once. The result is kept in the workspace.

# %%
place = ss.load_place("small.toml")
camera = ss.camera(place, "unseen", size_px=(270, 180))
session = ss.relight_session(place, camera)

# %% [markdown]
# A day. Each picture is exposed as a camera would.

# %%
hours = ("06:00", "08:00", "11:00", "14:00", "16:30", "17:36")
views = [ss.relight(session, f"2024-09-18T{hour}Z") for hour in hours]
figure, axes = plt.subplots(2, 3, figsize=(14, 6.5))
for axis, hour, view in zip(axes.ravel(), hours, views, strict=True):
    axis.imshow(ss.srgb_from_linear(ss.develop(view)))
    axis.set_title(f"{hour} UTC")
    axis.axis("off")

# %% [markdown]
# Compared with path tracing, over the terrain. What remains is the noise of path tracing and the day of the albedo, which
# is interpolated between two days of the month here.

# %%
traced = ss.render(place, camera, "2024-09-18T11:00Z", spp=64)
pair = [ss.srgb_from_linear(ss.develop(view, exposure=14.5)) for view in (traced, views[2])]
print(ss.score(*pair, np.isfinite(traced.gbuffer.depth)))

# %% [markdown]
# Seasons: the same coefficients with the albedo of another day.

# %%
figure, axes = plt.subplots(1, 3, figsize=(14, 3.4))
for axis, day in zip(axes, ("2024-02-10", "2024-05-20", "2024-07-20"), strict=True):
    axis.imshow(ss.srgb_from_linear(ss.develop(ss.relight(session, f"{day}T11:00Z"))))
    axis.set_title(day)
    axis.axis("off")

# %% [markdown]
# A film is a session and a list of instants: one picture an hour here, or give a `.mp4` name.

# %%
pictures = ss.timelapse(session, [f"2024-09-18T{hour:02d}:00Z" for hour in range(5, 19)], "out/06_relight")
print(len(pictures), "pictures, the first is", pictures[0].name)
