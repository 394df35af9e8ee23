"""Delighting of a single image: shadows whose borders lie elsewhere, shifts, clipped texels, unknown skies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from seasonscapes.albedo.delighting import (
    COMPLETED,
    NOTHING,
    SHADED,
    SUNLIT,
    Air,
    DelightOptions,
    TexelIrradiance,
    delight_image,
)
from seasonscapes.albedo.registration import shifted_back, texture_shift
from seasonscapes.albedo.shadow_borders import BorderModel, refined_visibility
from seasonscapes.albedo.sky_factor import fitted_sky_factor
from seasonscapes.errors import NoUsablePixels

SUN_LX, SKY_LX = np.array([80_000.0, 76_000.0, 68_000.0]), np.array([11_000.0, 14_000.0, 20_000.0])


def texture(shape: tuple[int, int] = (96, 112), seed: int = 4) -> np.ndarray:
    """Patches of land with a fine grain, ``(R, S, 3)``."""
    rng = np.random.default_rng(seed)
    patches = np.digitize(gaussian_filter(rng.normal(size=shape), 9.0) * 25.0, [-0.8, 0.6])
    colours = np.array([[0.10, 0.16, 0.06], [0.30, 0.28, 0.25], [0.20, 0.18, 0.12]])
    return (colours[patches] * np.exp(0.06 * rng.normal(size=shape))[..., None]).astype(np.float32)


def hill_light(shape: tuple[int, int] = (96, 112)) -> tuple[TexelIrradiance, np.ndarray]:
    """Light on a rolling ground, and its true visibility: a round shadow; the prediction lies 3 texels off."""
    row, column = np.mgrid[: shape[0], : shape[1]].astype(float)
    cosine = 0.7 + 0.2 * np.sin(column / 9.0) * np.cos(row / 11.0)

    def disc(centre: tuple[float, float]) -> np.ndarray:
        distance = np.hypot(row - centre[0], column - centre[1])
        return np.clip(distance - 24.0, 0.0, 1.0).astype(np.float32)

    sun = (cosine[..., None] * SUN_LX).astype(np.float32)
    sky = np.broadcast_to(SKY_LX, (*shape, 3)).astype(np.float32)
    light = TexelIrradiance(
        sun, disc((48.0, 59.0)), sky, lambda albedo: 0.1 * albedo * sun, SUN_LX + SKY_LX, np.zeros(shape, np.int32)
    )
    return light, disc((48.0, 56.0))


def lit(albedo: np.ndarray, light: TexelIrradiance, visibility: np.ndarray) -> np.ndarray:
    """Radiance ``(R, S, 3)`` [cd/m²]."""
    return albedo / np.pi * (visibility[..., None] * light.sun + light.sky + light.bounce(albedo))


def test_shadow_borders_follow_the_image_where_the_prediction_is_three_texels_off():
    light, true = hill_light()
    albedo = texture()
    radiance = lit(albedo, light, true)
    ambient = light.sky + light.bounce(np.full_like(albedo, 0.25))
    visibility, deviation = refined_visibility(
        np.log(np.pi * radiance), light.sun, ambient, light.visibility, light.chart
    )
    before, after = (int((np.abs(values - true) > 0.4).sum()) for values in (light.visibility, visibility))
    assert before > 250
    assert after < 0.25 * before
    assert deviation[48, 56] < 0.05


def test_the_land_around_may_be_left_out_of_the_cost():
    light, true = hill_light()
    image = lit(texture(), light, true)
    ambient = np.maximum(light.sky, 1e-3).astype(np.float32)
    known = (np.log(np.maximum(np.pi * image, 1e-3)), light.sun, ambient, light.visibility, light.chart)
    for land in (0.0, 4.0):
        visibility, _ = refined_visibility(*known, model=BorderModel(land=land))
        assert np.isfinite(visibility).all()
        assert np.abs(visibility - true).mean() < np.abs(light.visibility - true).mean()


def test_the_albedo_of_a_lit_image_returns_without_its_shadow():
    light, true = hill_light()
    albedo = texture()
    image = lit(albedo, light, true) / 20_000.0
    delit = delight_image(
        image, np.zeros(image.shape, bool), light, options=DelightOptions(radiance_per_unit=20_000.0, register=False)
    )
    error = delit.albedo / albedo - 1.0
    assert np.abs(error).mean() < 0.03
    assert np.median(error[true == 0.0]) == pytest.approx(0.0, abs=0.05)
    assert set(np.unique(delit.source)) == {SUNLIT, SHADED}
    # The refinement is what removes the ghost.
    ghost = delight_image(
        image,
        np.zeros(image.shape, bool),
        light,
        options=DelightOptions(radiance_per_unit=20_000.0, register=False, borders=None),
    )
    moved = np.abs(light.visibility - true) > 0.5
    assert np.abs(error)[moved].mean() < 0.3 * np.abs(ghost.albedo / albedo - 1.0)[moved].mean()


def test_a_sky_of_other_strength_is_found_from_the_shadow_itself():
    light, true = hill_light()
    radiance = lit(texture(), light, true)
    # Bluer than assumed, too.
    true_factor = np.array([1.2, 1.3, 1.5], np.float32)
    assumed = light.sky / true_factor
    factor = fitted_sky_factor(radiance, light.sun, true, assumed, light.bounce(texture()), light.chart)
    assert factor == pytest.approx(true_factor, rel=0.15)
    assert factor[2] / factor[0] > 1.12


def test_clipped_texels_are_completed_in_the_colour_of_their_neighbours():
    light, true = hill_light()
    albedo = np.full((96, 112, 3), (0.3, 0.24, 0.2), np.float32)
    albedo[10:14, 90:96] *= 1.6
    image = lit(albedo, light, true) / 20_000.0
    limit = 0.9 * image[10:14, 90:96, 0].min()
    clipped = image > limit
    delit = delight_image(
        np.minimum(image, limit), clipped, light, options=DelightOptions(radiance_per_unit=20_000.0, register=False)
    )
    assert (delit.source[10:14, 90:96] == COMPLETED).all()
    assert delit.albedo[11:13, 91:95] == pytest.approx(albedo[11:13, 91:95], rel=0.06)
    assert np.median(delit.sigma[10:14, 90:96]) > 3.0 * np.median(delit.sigma[delit.source == SUNLIT])


def test_air_before_the_ground_is_taken_out():
    light, true = hill_light()
    albedo = texture()
    air = Air(np.array([0.9, 0.87, 0.8]), np.array([300.0, 500.0, 900.0]))
    image = lit(albedo, light, true) * air.transmittance + air.airlight
    options = DelightOptions(radiance_per_unit=1.0, register=False, air=air)
    delit = delight_image(image, np.zeros(image.shape, bool), light, options=options)
    assert np.abs(delit.albedo / albedo - 1.0).mean() < 0.04


def test_an_image_of_unknown_exposure_takes_its_scale_from_level_ground():
    light, true = hill_light()
    albedo = texture()
    radiance = lit(albedo, light, true)
    image = radiance / (0.5 * light.level_lx / np.pi)
    delit = delight_image(image, np.zeros(image.shape, bool), light, options=DelightOptions(register=False))
    assert np.median(delit.albedo / albedo) == pytest.approx(1.0, abs=0.02)
    assert delit.facts["radiance_per_unit_cd_m2"] == pytest.approx(list(0.5 * light.level_lx / np.pi), rel=1e-4)


def test_a_shift_of_a_fraction_of_a_texel_is_found_and_removed():
    rng = np.random.default_rng(1)
    relief = np.exp(gaussian_filter(rng.normal(size=(160, 140)), 3.0) * 4.0)
    image = (relief * np.exp(0.05 * rng.normal(size=relief.shape)))[..., None]
    moved = shifted_back(image, (-0.4, 1.3))
    known = np.isfinite(moved).all(axis=2)
    shift = texture_shift(np.nan_to_num(moved[..., 0], nan=1.0), relief, known)
    assert shift == pytest.approx((0.4, -1.3), abs=0.15)
    back = shifted_back(moved, shift)[10:-10, 10:-10, 0]
    assert np.abs(back / relief[10:-10, 10:-10] - 1.0).mean() < 0.05
    noise = np.exp(rng.normal(size=relief.shape))
    assert texture_shift(noise, relief, np.ones(relief.shape, bool)) is None


def test_an_image_off_the_surface_is_refused():
    light, _ = hill_light()
    image = np.full((96, 112, 3), np.nan)
    with pytest.raises(NoUsablePixels, match="no value"):
        delight_image(image, np.zeros(image.shape, bool), light)
    image[:, :50] = 0.2
    delit = delight_image(image, np.zeros(image.shape, bool), light)
    assert (delit.source[:, 60:] == NOTHING).all()
    assert np.isinf(delit.sigma[:, 60:]).all()


def test_where_no_light_falls_the_standard_error_stays_that_of_an_unknown_albedo():
    light, true = hill_light()
    image = lit(texture(), light, true) / 20_000.0
    dark = replace(light, sun=1e-6 * light.sun, sky=1e-4 * light.sky)
    options = DelightOptions(radiance_per_unit=20_000.0, register=False, borders=None, fit_sky=False)
    sigma = delight_image(image, np.zeros(image.shape, bool), dark, options=options).sigma
    assert sigma.max() <= 1.0
    assert np.median(sigma) > 0.5
