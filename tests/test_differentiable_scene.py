"""The differentiable scene of a place: an experiment that a researcher would write, and its gradients."""

import drjit as dr
import numpy as np
import pytest

import seasonscapes as ss

TIME = "2024-07-20T17:30"


@pytest.fixture(scope="module")
def scene():
    place = ss.load_place("alpine_small")
    return ss.differentiable_scene(place, ss.camera(place, "aerial", size_px=(96, 64)), TIME)


def test_haze_and_heading_are_fitted_to_a_photograph():
    place = ss.load_place("alpine_small")
    stated = place.scene.camera("aerial")
    turned = stated.model_copy(update={"heading_deg": stated.heading_deg + 0.8})
    taken_from = ss.differentiable_scene(place, ss.camera(place, turned, size_px=(96, 64)), TIME)
    photograph = dr.detach(taken_from.render({"haze": 1.6}, spp=128, seed=99))

    scene = ss.differentiable_scene(place, ss.camera(place, stated, size_px=(96, 64)), TIME)
    optimizer = scene.optimizer({"haze": 1.0, "heading_deg": 0.0})
    for iteration in range(60):
        image = scene.render(dict(optimizer), spp=16, seed=iteration)
        dr.backward(dr.mean(dr.square((image - photograph) / (photograph + 100.0)), axis=None))
        optimizer.step()

    # Traced from the other camera itself, not resampled: the two agree up to noise and interpolation.
    assert optimizer["haze"][0] == pytest.approx(1.6, abs=0.1)
    assert optimizer["heading_deg"][0] == pytest.approx(0.8, abs=0.1)


@pytest.mark.parametrize(
    ("name", "at", "step"), [("sun", 1.0, 0.05), ("sky", 1.0, 0.05), ("haze", 1.2, 0.05), ("log_gain", 0.1, 0.05)]
)
def test_gradients_equal_finite_differences(scene, name, at, step):
    def mean(value):
        return dr.mean(scene.render({name: value}, spp=8, seed=3).array)[0]

    optimizer = scene.optimizer({name: at})
    # Image and gradient use different samples: their expectations agree, so many samples are averaged.
    gradients = []
    for seed in range(4):
        dr.backward(dr.mean(scene.render(dict(optimizer), spp=16, seed=seed).array))
        gradients.append(dr.grad(optimizer[name])[0])
        dr.clear_grad(optimizer[name])
    expected = (mean(at + step) - mean(at - step)) / (2.0 * step)
    scene.render({name: {"log_gain": 0.0}.get(name, 1.0)}, spp=1)
    assert np.mean(gradients) == pytest.approx(expected, rel=0.03)


def test_an_unknown_name_is_refused(scene):
    with pytest.raises(ValueError, match="'fog', expected one of"):
        scene.render({"fog": 1.0}, spp=1)
