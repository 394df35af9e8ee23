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
# Discs on the terrain store their horizon, their visible part of the sky and their albedo, and learn the rest from lit
# surfaces. They are then lit for hours that were not among the training data.

# %%
import matplotlib.pyplot as plt
import numpy as np

import seasonscapes as ss

# %% [markdown]
# Train on eight instants through the year. `views=0` trains on the surface alone, which is quick.

# %%
place = ss.load_place("small.toml", options=ss.MeshOptions(texel_m=25.0))
options = ss.DistilOptions(discs=72, suns=8, dates=2, views=0, steps=250, picture_steps=0)
model = ss.distil(place, options=options)
print(f"{len(model.means):,} Gaussians")

# %% [markdown]
# An hour that was not among them: path-traced, and splatted from the model.

# %%
above = ss.Viewpoint(latitude_deg=46.5712, longitude_deg=7.98, height_m=4200.0, heading_deg=190.0, pitch_deg=-35.0)
camera = ss.camera(place, above, size_px=(240, 160))
time = "2024-09-11T07:30Z"
traced = ss.render(place, camera, time, spp=32)
splatted = ss.render_gaussians(model, place, camera, time)
both = (traced.coverage > 0.99) & (splatted.coverage > 0.5)
pair = [ss.srgb_from_linear(ss.develop(view, exposure=13.5)) for view in (traced, splatted)]
print(f"{ss.score(*pair, both).psnr_db:.1f} dB over the terrain that both show")

# %%
figure, axes = plt.subplots(1, 3, figsize=(15, 4))
pictures = {"path-traced": pair[0], "Gaussians": pair[1], "difference × 4": 4 * np.abs(pair[0] - pair[1])}
for axis, (name, picture) in zip(axes, pictures.items(), strict=True):
    axis.imshow(np.clip(picture * both[..., None], 0.0, 1.0))
    axis.set_title(name)
    axis.axis("off")

# %% [markdown]
# A day of the model; each picture takes a fraction of a second.

# %%
figure, axes = plt.subplots(1, 4, figsize=(16, 3))
for axis, hour in zip(axes, ("06:00", "09:00", "13:00", "17:00"), strict=True):
    view = ss.render_gaussians(model, place, camera, f"2024-09-11T{hour}Z")
    axis.imshow(ss.srgb_from_linear(ss.develop(view)))
    axis.set_title(f"{hour} UTC")
    axis.axis("off")

# %% [markdown]
# The command line knows two more models: `distill --appearance paper` learns its colours from frames of any hour by a network
# that sees viewing direction and a free embedding, as the SeasonScapes paper does, and `--appearance embedding` without the
# direction. Neither knows the sun: they show the hours of their frames, and blend between these.
