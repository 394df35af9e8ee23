"""Houses and a mast before a webcam: found without being told, and not painted on the land behind them."""

from dataclasses import replace

import numpy as np
import pytest

import seasonscapes as ss
from seasonscapes.evaluation.webcam_faults import add_foreground
from seasonscapes.sky.models import read_sky_model
from seasonscapes.texturing.painting import PaintOptions, paint_atlas
from seasonscapes.workflows.place import utc_at
from seasonscapes.workflows.synthetic_photographs import synthetic_observations

TIME = "2024-07-20T13:30"


@pytest.mark.slow
@pytest.mark.usefixtures("few_rays")
def test_what_stands_before_the_landscape_is_not_painted():
    place, model = ss.load_place("alpine_small"), read_sky_model("hosek")
    clean = synthetic_observations(place, [utc_at(place, TIME)], model, size_px=(240, 160))
    built = [
        replace(each, image=add_foreground(each.image, np.random.default_rng(number))[0])
        for number, each in enumerate(clean)
    ]
    options = PaintOptions()
    truth, contaminated, rejected = (
        ss.paint(place, photographs, sky=model, options=how).texture
        for photographs, how in ((clean, options), (built, options), (built, replace(options, foreground=True)))
    )
    known = truth.weight > 0.0

    def wrong(painted) -> np.ndarray:
        """Texels that are painted in quite another colour than without houses."""
        ratio = np.log(np.maximum(painted.values, 1.0) / np.maximum(truth.values, 1.0))
        return known & (painted.weight > 0.0) & (np.abs(ratio).max(axis=2) > 0.5)

    spoilt = wrong(contaminated)
    assert spoilt.sum() > 50, "houses are painted on the land where nobody looks for them"
    # Two webcams that hardly see the same land find the worst of it; more webcams find nearly all, see the benchmark.
    assert wrong(rejected)[spoilt].mean() < 0.9
    assert (rejected.weight[known & ~spoilt] > 0.0).mean() > 0.97, "the land stays"


def test_masks_are_asked_for_where_nobody_finds_them():
    with pytest.raises(ValueError, match="give the masks as rejects"):
        paint_atlas([], None, options=PaintOptions(foreground=True))
