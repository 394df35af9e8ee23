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
# # Albedo: the reflectance of the ground, without its light
#
# Photographs of several hours, whose sun and sky are known, determine the albedo: what is shaded at one hour is sunlit at
# another.

# %%
import matplotlib.pyplot as plt
import numpy as np

import seasonscapes as ss

# %% [markdown]
# Two webcams at four hours; exposures and white balances are unknown.

# %%
place = ss.load_place("small.toml", options=ss.MeshOptions(texel_m=40.0))
cameras = {name: ss.camera(place, name, size_px=(180, 120)) for name in ("west", "south")}
times = [f"2024-09-11T{hour:02d}:00Z" for hour in (7, 10, 13, 15)]
sources = ss.synthetic_photographs(place, times, "out/05_albedo", cameras=cameras)
photographs = ss.open_photographs(place, sources.manifest, sources.calibrations, times)
figure, axes = plt.subplots(2, 4, figsize=(14, 5))
for axis, photograph in zip(axes.ravel(), sorted(photographs, key=lambda each: each.webcam), strict=True):
    axis.imshow(ss.srgb_from_linear(photograph.image))
    axis.axis("off")

# %% [markdown]
# The light on every texel and the texels under every pixel are traced; albedo and exposures then follow from one robust,
# sparse least-squares problem.

# %%
estimate = ss.recover_albedo(place, photographs).estimate
truth = ss.scene_albedo(place, "2024-09-11").values
measured = estimate.source == 1
error = np.abs(estimate.albedo - truth)[measured].mean()
print(f"{measured.mean():.0%} of the atlas measured; mean absolute error there {error:.3f}")

# %%
figure, axes = plt.subplots(1, 3, figsize=(15, 5))
pictures = {"truth": truth, "recovered": estimate.albedo, "error × 4": 4 * np.abs(estimate.albedo - truth)}
for axis, (name, values) in zip(axes, pictures.items(), strict=True):
    axis.imshow(ss.srgb_from_linear(values * measured[..., None]))
    axis.set_title(name)
    axis.axis("off")

# %% [markdown]
# Its standard error, and the reason for it: texels that no photograph shows in sunlight are less certain.

# %%
figure, axes = plt.subplots(1, 2, figsize=(12, 5))
shown = axes[0].imshow(np.where(measured, estimate.sigma, np.nan), vmax=0.1)
figure.colorbar(shown, ax=axes[0], label="standard error")
shown = axes[1].imshow(estimate.sunlit)
figure.colorbar(shown, ax=axes[1], label="photographs in sunlight")
for axis in axes:
    axis.axis("off")

# %% [markdown]
# Here light, air and response were known. Where they are not, `method="differentiable"` makes haze, exposures, each camera's
# response, clouds before the sun and poses unknowns beside the albedo, with exact derivatives through the daylight coefficients;
# the closed form is its start, and stays where held-out photographs are explained no better.

# %%
options = ss.RecoveryOptions(method="differentiable")
joint = ss.recover_albedo(place, photographs, options=options)
both = measured & (joint.estimate.source == 1)
errors = [np.abs(each.albedo - truth)[both].mean() for each in (estimate, joint.estimate)]
print(f"mean absolute error: closed form {errors[0]:.4f}, differentiable {errors[1]:.4f}")
print(f"visibility {joint.facts['visibility_km']} km; kept: {joint.facts['joint']['accepted']}")

# %% [markdown]
# `seasonscapes run` groups the photographs of many days by the snow and colours that they show, recovers one dated albedo for
# each season, and lets what it painted from the photographs back in.
