"""Gaussians: the rasteriser against its twin, the discs against the path tracer, exports through their readers."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from test_rendering import FRAME, heightfield, looking_down, sun_at  # noqa: E402

from seasonscapes.cameras.pinhole import Camera  # noqa: E402
from seasonscapes.gaussians.rasterise import (  # noqa: E402
    Splats,
    choose_threads,
    rasterise,
    splat_colours,
    splats_from,
    view_weights,
)
from seasonscapes.gaussians.rasterise_twin import rasterise_twin  # noqa: E402

choose_threads(1)
CAMERA = Camera(24, 20, 26.0, 24.0, 12.5, 9.5, np.eye(4))


def some_splats(count: int, *, seed: int = 0, dtype=torch.float32) -> tuple[Splats, torch.Tensor]:
    rng = np.random.default_rng(seed)
    means = np.stack([rng.uniform(-6, 6, count), rng.uniform(-6, 6, count), rng.uniform(4, 20, count)], axis=1)
    columns = (means, rng.normal(size=(count, 4)), rng.uniform(-2.5, 0.3, (count, 3)), rng.uniform(-2, 4, count))
    return Splats(*(torch.as_tensor(c, dtype=dtype) for c in columns)), torch.as_tensor(rng.uniform(0, 1, (count, 3)), dtype=dtype)  # fmt: skip


def test_rasteriser_equals_its_twin():
    splats, colours = some_splats(150)
    image, coverage = rasterise(splats, colours, CAMERA)
    expected, expected_coverage = rasterise_twin(splats, colours, CAMERA)
    assert expected_coverage.max() > 0.9 and expected_coverage.min() < 0.5, "the scene must have both"
    assert float((image - expected).abs().max()) < 1e-4
    assert float((coverage - expected_coverage).abs().max()) < 1e-4


@pytest.mark.parametrize("cut", [1.0 / 255.0, 0.0])
def test_gradients_equal_the_twin_s(cut):
    grads = []
    for draw in (rasterise, rasterise_twin):
        splats, colours = some_splats(60, seed=1, dtype=torch.float64)
        leaves = [tensor.clone().requires_grad_() for tensor in (*splats, colours)]
        image, _ = draw(Splats(*leaves[:4]), leaves[4], CAMERA, alpha_cut=cut)
        weight = torch.as_tensor(np.random.default_rng(2).normal(size=tuple(image.shape)))
        (image * weight).sum().backward()
        grads.append([leaf.grad for leaf in leaves])
    for mine, theirs in zip(*grads, strict=True):
        assert float((mine - theirs).norm() / theirs.norm()) < 1e-3


def test_gradients_equal_finite_differences():
    """With the cut off, so that no pixel enters or leaves a splat."""
    splats, colours = some_splats(40, seed=3, dtype=torch.float64)
    rng = np.random.default_rng(4)
    leaves = [tensor.clone().requires_grad_() for tensor in (*splats, colours)]
    weight = torch.as_tensor(rng.normal(size=(20, 24, 3)))

    def value(parts) -> torch.Tensor:
        return (rasterise(Splats(*parts[:4]), parts[4], CAMERA, alpha_cut=0.0)[0] * weight).sum()

    value(leaves).backward()
    for number, leaf in enumerate(leaves):
        step = torch.as_tensor(rng.normal(size=tuple(leaf.shape)))
        sides = [value([p.detach() + (1e-6 * sign * step if k == number else 0.0) for k, p in enumerate(leaves)])
                 for sign in (1, -1)]  # fmt: skip
        difference = float(sides[0] - sides[1]) / 2e-6
        assert float((leaf.grad * step).sum()) == pytest.approx(difference, rel=1e-3)


def test_frozen_weights_give_the_same_picture():
    splats, colours = some_splats(150, seed=5)
    weights = view_weights(splats, CAMERA)
    image, coverage = rasterise(splats, colours, CAMERA)
    np.testing.assert_allclose(splat_colours(weights, colours.numpy()), image.numpy(), atol=2e-3)
    np.testing.assert_allclose(weights.coverage, coverage.numpy(), atol=2e-3)


def test_ties_in_depth_keep_their_order():
    """Two splats at one depth: the first one is in front, in both."""
    both = splats_from(
        np.array([[0.0, 0.0, 5.0]] * 2), np.array([[1.0, 0, 0, 0]] * 2), np.zeros((2, 3)), np.full(2, 6.0)
    )
    colours = torch.tensor([[1.0, 0, 0], [0, 1.0, 0]])
    for draw in (rasterise, rasterise_twin):
        red, green, _ = draw(both, colours, CAMERA)[0][9, 12]
        assert red > 0.9 > 0.1 > green


def test_no_splat_in_view_is_an_empty_picture():
    behind = splats_from(np.array([[0.0, 0.0, -5.0]]), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 3)), np.zeros(1))
    image, coverage = rasterise(behind, torch.ones(1, 3), CAMERA)
    assert float(image.abs().max()) == 0.0 and float(coverage.max()) == 0.0
    assert view_weights(behind, CAMERA).matrix.nnz == 0


def test_values_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="log_scales: 1 values are not finite"):
        splats_from(np.zeros((1, 3)), np.ones((1, 4)), np.array([[0.0, np.nan, 0.0]]), np.zeros(1))
    with pytest.raises(ValueError, match="one for each splat"):
        rasterise(some_splats(3)[0], torch.ones(2, 3), CAMERA)
