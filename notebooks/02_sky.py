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
# # Sky: the light of any instant
#
# Time and place give the positions of sun and moon; a model of the atmosphere gives the radiance of the sky.

# %%
import matplotlib.pyplot as plt
import numpy as np

import seasonscapes as ss

place = ss.load_place("small.toml")

# %% [markdown]
# The path of the sun on three days of the year.

# %%
for day in ("2024-03-21", "2024-06-21", "2024-12-21"):
    suns = [ss.sun_moon_position(f"{day}T{hour:02d}:00Z", 46.55, 7.98).sun for hour in range(4, 20)]
    suns = [sun for sun in suns if sun.elevation_deg > 0.0]
    plt.plot([sun.azimuth_deg for sun in suns], [sun.elevation_deg for sun in suns], "o-", label=day)
plt.xlabel("azimuth [°], clockwise from north")
plt.ylabel("apparent elevation [°]")
_ = plt.legend()

# %% [markdown]
# The sky as a fish-eye camera sees it, each exposed for itself: noon, low sun, twilight.

# %%
figure, axes = plt.subplots(1, 3, figsize=(13, 4.5))
for axis, hour in zip(axes, ("11:00", "17:00", "18:00"), strict=True):
    light = ss.illumination(place, f"2024-09-18T{hour}Z")
    axis.imshow(ss.srgb_from_linear(ss.dome_picture(light, 300)))
    axis.set_title(f"{hour} UTC")
    axis.axis("off")

# %% [markdown]
# Noon under other skies, with the illuminance of level ground.

# %%
figure, axes = plt.subplots(1, 3, figsize=(13, 4.5))
skies = {"clear": ss.sky_model("clear"), "hazy": ss.sky_model("clear", visibility_km=15.0), "overcast": "overcast"}
for axis, (name, sky) in zip(axes, skies.items(), strict=True):
    light = ss.illumination(place, "2024-07-20T11:30Z", sky=sky)
    axis.imshow(ss.srgb_from_linear(ss.dome_picture(light, 300)))
    axis.set_title(f"{name}: {light.global_horizontal_lx[1]:,.0f} lx")
    axis.axis("off")

# %% [markdown]
# Illuminance of level ground from noon to midnight, over ten decades and without a step at sunset. At night moonlight,
# stars and airglow remain.

# %%
hours = np.arange(11.0, 24.0, 0.5)
times = [f"2024-09-17T{int(hour):02d}:{int(60 * (hour % 1)):02d}Z" for hour in hours]
plt.semilogy(hours, [ss.illumination(place, time).global_horizontal_lx[1] for time in times])
plt.xlabel("hour, UTC")
plt.ylabel("lx (green)")
_ = plt.title("a night with a full moon")
