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
# # Webcams: what they deliver, and where they look
#
# A webcam's picture has an exposure, a white balance, a tone curve, noise and JPEG that nobody knows, and a pose that GPS
# and compass know roughly. Here the truth is known, so that each can be judged.

# %%
from datetime import UTC, datetime
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.overlay import draw_overlay
from seasonscapes.calibration.resection import resect
from seasonscapes.cameras.panorama import panorama_from_angles, split_panorama
from seasonscapes.evaluation.splits import check_no_leakage, held_out_times, picture_use
from seasonscapes.evaluation.synthetic_webcams import WebcamInstant, webcam_series
from seasonscapes.evaluation.webcam_faults import CLEAN, SEVERE, TYPICAL, PoseSigmas, degrade, perturb_pose
from seasonscapes.sky.models import read_sky_model
from seasonscapes.workflows.albedo_sources import albedo_for
from seasonscapes.workflows.illumination import illumination_for_camera
from seasonscapes.workflows.place import load_place
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import default_workspace

# %% [markdown]
# Four hours of one webcam, at full physics.

# %%
place = load_place(Path("small.toml"), default_workspace())
camera = camera_for(place, place.scene.camera("west"), size_px=(300, 200))
hours = []
for hour in (7, 9, 12, 15):
    time = datetime(2024, 9, 11, hour, tzinfo=UTC)
    hours.append(
        WebcamInstant(
            time,
            illumination_for_camera(place, camera, read_sky_model("clear"), time)[0],
            albedo_for(place, time).values,
        )
    )
pictures = webcam_series(place.terrain, "west", camera, hours)
figure, axes = plt.subplots(1, 4, figsize=(15, 3))
for axis, picture in zip(axes, pictures, strict=True):
    axis.imshow(picture.encoded)
    axis.set_title(f"{picture.observation.time:%H:%M} UTC, {picture.development.exposure_error_ev:+.2f} EV")
    axis.axis("off")

# %% [markdown]
# The same radiance through a good, a typical and a bad webcam.

# %%
figure, axes = plt.subplots(1, 3, figsize=(13, 3.2))
for axis, (name, faults) in zip(axes, {"clean": CLEAN, "typical": TYPICAL, "severe": SEVERE}.items(), strict=True):
    axis.imshow(degrade(pictures[1].radiance, faults, np.random.default_rng(5))[0])
    axis.set_title(name)
    axis.axis("off")

# %% [markdown]
# GPS and compass are off by 5 m and some degrees. Twelve points, clicked to half a pixel in picture and terrain, two of them
# wrong, put that right.

# %%
rng = np.random.default_rng(1)
start, off = perturb_pose(camera, PoseSigmas(5.0, 5.0, 4.0, 1.0, 1.0, 0.02), rng)
truth = pictures[1].gbuffer
chosen = rng.permutation(np.argwhere(np.isfinite(truth.depth) & (truth.depth > 250.0)))[:12]
pixel = chosen[:, ::-1] + 0.5 + rng.normal(0.0, 0.5, (12, 2))
pixel[:2] += 30.0
points = Correspondences(pixel, truth.position[chosen[:, 0], chosen[:, 1]])
solved = resect(start, points, priors=Priors(horizontal_m=5.0, vertical_m=5.0, focal=0.02))
print(f"heading was off by {off['heading_deg']:+.2f}°; outliers: {np.flatnonzero(solved.outlier).tolist()}")
print(f"{solved.inlier_rms_px:.2f} px; heading ± {solved.sigma['heading_deg']:.3f}°")
plt.figure(figsize=(9, 6))
plt.imshow(draw_overlay(pictures[1].encoded, solved, points=points))
_ = plt.axis("off")

# %% [markdown]
# A panorama is cut into perspective views that share one pose.

# %%
panorama = panorama_from_angles(
    "cylindrical", (3600, 500), horizontal_fov_deg=360.0, vertical_fov_deg=45.0, pose=camera.world_from_camera
)
print([f"{view.width_px} x {view.height_px}" for view in split_panorama(panorama)])

# %% [markdown]
# What is judged must not have been used: hours are held out, and a leak is refused by webcam, instant and pixels.

# %%
used, held = held_out_times([hour.time for hour in hours], 2)
painting = [picture_use(picture.observation, "painting") for picture in pictures if picture.observation.time in used]
judged = [picture_use(picture.observation, "evaluation") for picture in pictures if picture.observation.time in held]
check_no_leakage(judged, painting, kind="hour")
try:
    check_no_leakage([picture_use(pictures[0].observation, "evaluation")], painting)
except ValueError as leak:
    print(leak)
