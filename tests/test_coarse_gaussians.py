"""A view that stands too near the Gaussians says so."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.workflows.gaussian_views import _warn_of_coarse_discs

# Looks down on level ground from its height.
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("depth_m", "fine", "warned"),
    [(300.0, False, True), (300.0, True, False), (5000.0, False, False), (np.inf, False, False)],
)
def test_discs_that_lie_far_apart_in_the_picture_are_doubted(depth_m, fine, warned, caplog):
    """Those that the picture shows count: coarse ones beyond its edge do not."""
    height_m = depth_m if np.isfinite(depth_m) else 300.0
    near = np.stack([*np.meshgrid(*2 * [np.linspace(-20.0, 20.0, 12)]), np.zeros((12, 12))], axis=-1).reshape(-1, 3)
    far = near + np.array([3000.0, 0.0, 0.0])
    spacing_m = np.repeat(np.float32([3.6 if fine else 29.0, 29.0]), len(near))
    grid = SimpleNamespace(spacing_m=29.0)  # before its cells were quartered
    model = SimpleNamespace(means=np.concatenate([near, far]), spacing_m=spacing_m, grid=grid)
    pose = DOWN.copy()
    pose[2, 3] = height_m
    camera = Camera(6, 4, 700.0, 700.0, 3.0, 2.0, pose)
    view = SimpleNamespace(coverage=np.ones((4, 6)), depth=np.full((4, 6), depth_m))
    with caplog.at_level(logging.WARNING):
        _warn_of_coarse_discs(model, camera, view)
    assert ("Gaussians 29 m apart lie 68 pixels from each other" in caplog.text) == warned
    assert bool(caplog.text) == warned
