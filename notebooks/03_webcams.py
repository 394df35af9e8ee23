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
# # Webcams: photographs, and the calibration of their pose
#
# Exposure, white balance, tone curve, noise and JPEG artefacts of a webcam are unknown, and GPS and compass give its pose
# only roughly. Here the true pose is known, so that the result can be checked.

# %%
import matplotlib.pyplot as plt
import numpy as np

import seasonscapes as ss

# %% [markdown]
# Photographs of four hours, rendered with full light transport and degraded as webcams degrade them.

# %%
place = ss.load_place("small.toml")
camera = ss.camera(place, "west", size_px=(300, 200))
times = [f"2024-09-11T{hour:02d}:00Z" for hour in (7, 9, 12, 15)]
sources = ss.synthetic_photographs(place, times, "out/03_webcams", cameras={"west": camera})
photographs = ss.open_photographs(place, sources.manifest, sources.calibrations, times)
figure, axes = plt.subplots(1, 4, figsize=(15, 3))
for axis, photograph in zip(axes, photographs, strict=True):
    axis.imshow(ss.srgb_from_linear(photograph.image))
    axis.set_title(f"{photograph.time:%H:%M} UTC")
    axis.axis("off")

# %% [markdown]
# The compass heading is 4° off. Twelve points, matched to half a pixel between photograph and terrain, two of them wrong,
# correct it.

# %%
rng = np.random.default_rng(1)
seen = ss.render(place, camera, times[1], spp=1).gbuffer
chosen = rng.permutation(np.argwhere((seen.depth > 250.0) & np.isfinite(seen.depth)))[:12]
pixel = chosen[:, ::-1] + 0.5 + rng.normal(0.0, 0.5, (12, 2))
pixel[:2] += 30.0
points = ss.Correspondences(pixel, seen.position[chosen[:, 0], chosen[:, 1]])
stated = place.scene.camera("west")
stated = stated.model_copy(update={"heading_deg": stated.heading_deg + 4.0})
station = ss.camera_station(place, ss.camera(place, stated, size_px=(300, 200)))
picture = np.uint8(255 * ss.srgb_from_linear(photographs[1].image))
solved = ss.calibrate(station, picture, points=points).solution
print(f"heading corrected by {solved.parameters[0] - stated.heading_deg:+.2f}° ± {solved.sigma['heading_deg']:.3f}°")
print(f"outliers: {', '.join(solved.outlier_names)}; residual of the others {solved.inlier_rms_px:.2f} px")

# %% [markdown]
# The skyline alone gives a similar heading without any matched point, and states how far it can be relied on.

# %%
by_skyline = ss.calibrate(station, picture, skyline=True)
print(f"heading corrected by {by_skyline.solution.parameters[0] - stated.heading_deg:+.2f}°")
print("doubts:", by_skyline.doubts or "none")

# %% [markdown]
# The photograph beside a render through the calibrated camera.

# %%
matched = ss.render(place, solved.view, times[1], spp=8)
figure, axes = plt.subplots(1, 2, figsize=(14, 4.6))
axes[0].imshow(picture)
axes[1].imshow(ss.srgb_from_linear(ss.develop(matched)))
for axis in axes:
    axis.axis("off")
