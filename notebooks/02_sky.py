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
# Where sun and moon stand follows from time and place; what the sky sends follows from a model of the atmosphere.

# %%
from datetime import UTC, datetime, timedelta

import matplotlib.pyplot as plt
import numpy as np

from seasonscapes.exposure import exposure_ev100
from seasonscapes.images import srgb_from_linear
from seasonscapes.sky.ephemeris import sun_position
from seasonscapes.sky.illumination import global_horizontal_illuminance
from seasonscapes.sky.models import read_sky_model
from seasonscapes.sky.report import dome_picture
from seasonscapes.workflows.illumination import illumination_at, sun_moon_position
from seasonscapes.workspace import default_workspace

LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M = 46.55, 7.98, 2000.0

# %% [markdown]
# The sun's path on three days of the year.

# %%
for month in (3, 6, 12):
    hours = [datetime(2024, month, 21, tzinfo=UTC) + timedelta(minutes=20 * k) for k in range(72)]
    sun = sun_position(hours, LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M)
    up = np.asarray(sun.elevation_deg) > 0
    plt.plot(np.asarray(sun.azimuth_deg)[up], np.asarray(sun.elevation_deg)[up], label=f"{month:02d}-21")
plt.xlabel("azimuth [°], clockwise from north")
plt.ylabel("apparent elevation [°]")
_ = plt.legend()


# %%
def light(model: str, time: datetime):
    moment = sun_moon_position(time, LATITUDE_DEG, LONGITUDE_DEG, HEIGHT_M)
    return illumination_at(
        read_sky_model(model), moment, HEIGHT_M, workspace=default_workspace(), with_aerial_perspective=False
    )


# %% [markdown]
# Domes as a fish-eye sees them, each exposed for itself: noon, low sun, twilight.

# %%
figure, axes = plt.subplots(1, 3, figsize=(13, 4.5))
for axis, hour in zip(axes, (11.0, 17.0, 18.0), strict=True):
    sky = light("clear", datetime(2024, 9, 18, tzinfo=UTC) + timedelta(hours=hour))
    axis.imshow(srgb_from_linear(dome_picture(sky, 300)))
    axis.set_title(f"{hour:04.1f} h UTC")
    axis.axis("off")

# %% [markdown]
# The same noon under other airs.

# %%
noon = datetime(2024, 7, 20, 11, 30, tzinfo=UTC)
figure, axes = plt.subplots(1, 2, figsize=(9, 4.5))
for axis, model in zip(axes, ("clear", "overcast"), strict=True):
    sky = light(model, noon)
    axis.imshow(srgb_from_linear(dome_picture(sky, 300)))
    axis.set_title(f"{model}: {global_horizontal_illuminance(sky)[1]:,.0f} lx")
    axis.axis("off")

# %% [markdown]
# Illuminance on level ground from noon to midnight, over ten decades, without a step at sunset: night is moonlight, stars
# and airglow.

# %%
times = [datetime(2024, 9, 17, 11, tzinfo=UTC) + timedelta(minutes=30 * k) for k in range(26)]
lux = [global_horizontal_illuminance(light("clear", time))[1] for time in times]
plt.semilogy([time.hour + time.minute / 60 for time in times[:-1]], lux[:-1])
plt.xlabel("hour, UTC")
plt.ylabel("lx (green)")
_ = plt.title("a full-moon night")

# %% [markdown]
# Exposure that a camera's meter would choose for the dome, in EV at ISO 100.

# %%
print({f"{time:%H:%M}": round(exposure_ev100(light("clear", time).sky_radiance), 1) for time in times[::6]})
