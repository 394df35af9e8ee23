"""A view that stands too near the Gaussians says so."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest

from seasonscapes.workflows.gaussian_views import _warn_of_coarse_discs


@pytest.mark.parametrize(("depth_m", "warned"), [(300.0, True), (5000.0, False), (np.inf, False)])
def test_discs_that_lie_far_apart_in_the_picture_are_doubted(depth_m, warned, caplog):
    model = SimpleNamespace(grid=SimpleNamespace(spacing_m=29.0))
    view = SimpleNamespace(coverage=np.ones((4, 6)), depth=np.full((4, 6), depth_m))
    with caplog.at_level(logging.WARNING):
        _warn_of_coarse_discs(model, SimpleNamespace(fx=700.0), view)
    assert ("68 pixels from each other" in caplog.text) == warned
