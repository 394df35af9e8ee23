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
# # An inverse-rendering experiment: haze and heading from one photograph
#
# `ss.differentiable_scene` is the Mitsuba scene of a place whose albedo, sun, sky, haze, exposure and camera rotation can
# be differentiated, together with every parameter that Mitsuba itself exposes.

# %%
import drjit as dr
import matplotlib.pyplot as plt

import seasonscapes as ss

# %% [markdown]
# A photograph in thicker air than we believe, from a camera that is turned by 0.8°.

# %%
place = ss.load_place("small.toml", options=ss.MeshOptions(texel_m=60.0))
stated = place.scene.camera("west")
turned = stated.model_copy(update={"heading_deg": stated.heading_deg + 0.8})
time, size_px = "2024-09-11T09:00Z", (120, 80)
photograph = ss.differentiable_scene(place, ss.camera(place, turned, size_px=size_px), time)
photograph = dr.detach(photograph.render({"haze": 1.6}, spp=256, seed=9))
scene = ss.differentiable_scene(place, ss.camera(place, stated, size_px=size_px), time)

# %% [markdown]
# Adam on the squared error of the logarithm, which weighs near and far alike.

# %%
optimizer = scene.optimizer({"haze": 1.0, "heading_deg": 0.0}, step=0.05)
history = []
for iteration in range(60):
    image = scene.render(dict(optimizer), spp=16, seed=iteration)
    loss = dr.mean(dr.square(dr.log(image.array) - dr.log(photograph.array)))
    dr.backward(loss)
    optimizer.step()
    history.append((loss[0], optimizer["haze"][0], optimizer["heading_deg"][0]))
losses, haze, heading = zip(*history, strict=True)
print(f"haze {haze[-1]:.2f} of 1.60, heading {heading[-1]:.2f}° of 0.80°")

# %%
figure, axes = plt.subplots(1, 3, figsize=(14, 3.5))
for axis, (name, values) in zip(axes, {"loss": losses, "haze": haze, "heading [°]": heading}.items(), strict=True):
    axis.plot(values)
    axis.set_title(name)
    axis.set_xlabel("iteration")

# %% [markdown]
# What is left between the photograph and the fitted render.

# %%
fitted = scene.render(dict(optimizer), spp=64).numpy()
pair = [ss.srgb_from_linear(ss.develop(image, exposure=14.0)) for image in (photograph.numpy(), fitted)]
figure, axes = plt.subplots(1, 2, figsize=(12, 4))
for axis, name, picture in zip(axes, ("photograph", "fitted"), pair, strict=True):
    axis.imshow(picture)
    axis.set_title(name)
    axis.axis("off")

# %% [markdown]
# Albedo is not recovered this way: gradients of path tracing are noisy, and Adam, which knows no curvature, was measured to
# return the closed form's albedo or a worse one. `ss.recover_albedo(..., options=ss.RecoveryOptions(method="differentiable"))`
# differentiates the daylight coefficients instead, exactly and without new rays; this scene is for what those do not hold.
