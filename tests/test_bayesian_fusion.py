"""A base and painted texels: each counts as far as it is known."""

import cv2
import numpy as np
import pytest
from test_completion import SIDE, made_up_land, painted

from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.bayesian_fusion import fuse_with_albedo
from seasonscapes.texturing.completion import CompletionOptions, complete
from seasonscapes.texturing.predictors import stack_predictors
from seasonscapes.texturing.texel_weights import fit_variance_by_weight


@pytest.fixture(scope="module")
def land():
    """A truth, what was seen of it, relief, and a base that is twice too dark in one half and noisy."""
    truth, seen, predictors = made_up_land()
    relief = {
        name: predictors.values[..., n] for n, name in enumerate(predictors.names) if not name.startswith("satellite")
    }
    rng = np.random.default_rng(0)
    base = (
        truth
        * np.exp(0.1 * rng.standard_normal(truth.shape))
        * np.where(relief["elevation"] > 1500.0, 0.5, 1.0)[..., None]
    )
    return truth, seen, stack_predictors(relief), base.astype(np.float32)


def _error(values, truth, where):
    return float(np.sqrt(np.mean(np.log(np.maximum(values[where], 1e-4) / truth[where]) ** 2)))


def test_base_is_corrected_by_what_was_seen(land):
    truth, seen, predictors, base = land
    made = complete(painted(truth, seen), predictors, base=base)
    alone = complete(painted(truth, seen), predictors)
    hidden = ~seen
    assert _error(made.values, truth, hidden) < 0.3 * _error(base, truth, hidden)
    assert _error(made.values, truth, hidden) < 0.4 * _error(alone.values, truth, hidden)
    # All texels of one weight: none is known to scatter more than another, and all stay.
    np.testing.assert_allclose(made.values[seen], truth[seen], rtol=1e-3)
    z = np.sqrt(np.mean((made.values - truth)[hidden] ** 2) / np.mean(made.sigma[hidden] ** 2))
    assert 0.7 < z < 1.4, "sigma is the root mean square error, within what one draw of the land scatters"


def test_base_with_gaps(land):
    truth, seen, predictors, base = land
    torn = base.copy()
    torn[: SIDE // 4] = np.nan
    made = complete(painted(truth, seen), predictors, base=torn)
    gap = ~seen & (np.arange(SIDE) < SIDE // 4)[:, None]
    assert np.isfinite(made.values).all()
    learned = complete(painted(truth, seen), predictors)
    assert _error(made.values, truth, gap) < 1.3 * _error(learned.values, truth, gap)
    assert _error(made.values, truth, ~seen & ~gap) < 0.5 * _error(base, truth, ~seen & ~gap)


def test_badly_seen_texels_give_way_to_the_base(land):
    truth, seen, predictors, base = land
    rng = np.random.default_rng(1)
    weight = np.where(seen, np.exp(rng.uniform(-3.0, 3.0, seen.shape)), 0.0).astype(np.float32)
    noise = 0.15 / np.sqrt(np.maximum(weight, 1e-6))
    noisy = np.where(seen[..., None], truth * np.exp(noise[..., None] * rng.standard_normal(truth.shape)), 0.0)
    made = complete(Texture(noisy.astype(np.float32), weight), predictors, base=base)
    well, badly = weight > np.exp(2.0), seen & (weight < np.exp(-1.0))
    assert _error(made.values, truth, badly) < 0.6 * _error(noisy, truth, badly)
    assert _error(made.values, truth, well) < 1.2 * _error(noisy, truth, well)


def test_scatter_falls_with_weight():
    rng = np.random.default_rng(2)
    weight = np.exp(rng.uniform(-4.0, 4.0, 20_000))
    scatter = fit_variance_by_weight(np.sqrt(0.01 + 0.02 / weight)[:, None] * rng.standard_normal((20_000, 3)), weight)
    for at in (0.1, 1.0, 10.0):
        assert scatter(np.array([at]))[0] == pytest.approx(0.01 + 0.02 / at, rel=0.25)
        assert scatter.shrinkage(np.array([at]))[0] == pytest.approx(0.01 / (0.01 + 0.02 / at), rel=0.25)
    assert (fit_variance_by_weight(rng.standard_normal((500, 3)), np.ones(500)).shrinkage(np.ones(3)) == 1.0).all()


@pytest.mark.parametrize(("told", "nearer"), [(0.02, "base"), (0.6, "painting")])
def test_fusing_follows_the_error_that_is_told(land, told, nearer):
    truth, seen, predictors, _ = land
    rng = np.random.default_rng(3)
    weight = np.where(seen, np.exp(rng.uniform(-1.0, 1.0, seen.shape)), 0.0).astype(np.float32)
    error = {"base": told, "painting": 0.2}
    base = (truth * np.exp(error["base"] * rng.standard_normal(truth.shape))).astype(np.float32)
    shown = np.where(seen[..., None], truth * np.exp(error["painting"] * rng.standard_normal(truth.shape)), 0.0)
    made = fuse_with_albedo(
        Texture(shown.astype(np.float32), weight), base, np.full(seen.shape, told, np.float32), predictors
    )
    found, least = _error(made.values, truth, seen), min(error.values())
    assert found < 1.25 * least
    assert _error(made.values, {"base": base, "painting": shown}[nearer], seen) < 0.5 * max(error.values())
    np.testing.assert_array_equal(made.painted, seen)
    depth = cv2.distanceTransform((~seen).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    moved = np.abs(np.log(made.values / base)).mean(axis=2)
    assert moved[depth > 8.0].mean() < 0.7 * moved[(depth > 0.0) & (depth < 2.0)].mean(), (
        "deep in a hole the base stands"
    )
    assert (made.sigma[seen].mean()) < made.sigma[~seen].mean()


def test_nothing_painted_leaves_the_base(land):
    _, seen, predictors, base = land
    made = fuse_with_albedo(
        Texture(np.zeros_like(base), np.zeros(seen.shape, np.float32)), base, np.full(seen.shape, 0.1), predictors
    )
    np.testing.assert_array_equal(made.values, base)
    assert not made.painted.any()


def test_refuses(land):
    truth, seen, predictors, base = land
    with pytest.raises(ValueError, match="base"):
        complete(painted(truth, seen), predictors, base=base[:-1])
    with pytest.raises(ValueError, match="expected guided"):
        complete(painted(truth, seen), predictors, base=base, options=CompletionOptions("membrane"))
    with pytest.raises(ValueError, match="fuse"):
        fuse_with_albedo(painted(truth, seen), base[:-1], np.ones(seen.shape), predictors)
