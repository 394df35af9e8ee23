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
# # Texture: webcams painted onto the terrain, and completion of what none of them saw
#
# Three webcams paint the texture of one hour. The view from a fourth position, where no webcam stands, is the test.

# %%
import matplotlib.pyplot as plt
import numpy as np

import seasonscapes as ss

# %% [markdown]
# Photographs of a September morning, with all the faults of webcams.

# %%
place = ss.load_place("small.toml", options=ss.MeshOptions(texel_m=25.0))
time = "2024-09-11T09:00Z"
cameras = {name: ss.camera(place, name, size_px=(210, 140)) for name in ("west", "middle", "south")}
sources = ss.synthetic_photographs(place, [time], "out/04_texture", cameras=cameras)
photographs = ss.open_photographs(place, sources.manifest, sources.calibrations, time)
plt.figure(figsize=(14, 4))
plt.imshow(np.concatenate([ss.srgb_from_linear(each.image) for each in photographs], axis=1))
_ = plt.axis("off")

# %% [markdown]
# Rays decide which webcams see each texel. Exposure, white balance, contrast and haze are fitted so that they agree.

# %%
painting = ss.paint(place, photographs)
figure, axes = plt.subplots(1, 2, figsize=(12, 5))
axes[0].imshow(ss.srgb_from_linear(ss.develop(painting.texture.values)))
axes[1].imshow(painting.coverage, cmap="viridis")
axes[0].set_title(f"{np.mean(painting.texture.weight > 0):.0%} painted")
axes[1].set_title("number of webcams")
for axis in axes:
    axis.axis("off")

# %% [markdown]
# The rest is predicted by regression on relief, sun and an orthoimage of another day. OpenCV's Telea inpainting, which the
# paper's code uses, is the comparison.

# %%
methods = ("guided", "telea")
completed = {
    method: ss.complete(place, painting.texture, time, options=ss.CompletionOptions(method, fast=True)).values
    for method in methods
}
figure, axes = plt.subplots(1, 2, figsize=(12, 5))
for axis, method in zip(axes, methods, strict=True):
    axis.imshow(ss.srgb_from_linear(ss.develop(completed[method])))
    axis.set_title(method)
    axis.axis("off")

# %% [markdown]
# The view without a webcam: the truth, and both completions through the air of that hour, at one exposure.

# %%
camera = ss.camera(place, "unseen", size_px=(210, 140))
truth = ss.render(place, camera, time, spp=32)
views = {"truth": truth} | {name: ss.textured_view(place, completed[name], camera, time) for name in methods}
pictures = {name: ss.srgb_from_linear(ss.develop(view, exposure=14.0)) for name, view in views.items()}
figure, axes = plt.subplots(1, 3, figsize=(16, 4))
for axis, (name, picture) in zip(axes, pictures.items(), strict=True):
    axis.imshow(picture)
    axis.set_title(f"{name}  {ss.score(pictures['truth'], picture, np.isfinite(truth.gbuffer.depth)).psnr_db:.1f} dB")
    axis.axis("off")
