"""Land that is not Lambertian, found and fitted in classes; light of surrounding land in the air."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from seasonscapes.albedo.adjacency import Surroundings, scattered_upwards, without_surroundings
from seasonscapes.albedo.delighting import Air, DelightOptions, TexelIrradiance, delight_image
from seasonscapes.albedo.land_response import class_illuminance, land_classes

SHAPE = (120, 130)
SUN_LX, SKY_LX = np.array([80_000.0, 76_000.0, 68_000.0]), np.array([6_000.0, 8_000.0, 12_000.0])
COLOURS = np.array([[0.04, 0.07, 0.03], [0.30, 0.22, 0.12]])
EXPONENTS = (0.4, 1.3)


@pytest.fixture(scope="module")
def forest_and_fields() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Classes, albedo, cosine of incidence and radiance of rolling land whose two classes have exponents of their own."""
    rng = np.random.default_rng(3)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    cosine = 0.62 + 0.3 * np.sin(column / 9.0) * np.cos(row / 11.0)
    kind = (np.sin(column / 31.0 + 1.0) * np.sin(row / 23.0) > 0.1).astype(int)
    albedo = COLOURS[kind] * np.exp(0.05 * rng.normal(size=(*SHAPE, 1)) + 0.02 * rng.normal(size=(*SHAPE, 3)))
    response = np.empty(SHAPE)
    for number, exponent in enumerate(EXPONENTS):
        member = kind == number
        mean = cosine[member].mean()
        response[member] = mean * (cosine[member] / mean) ** exponent
    radiance = albedo / np.pi * (response[..., None] * SUN_LX + SKY_LX)
    return kind, albedo, cosine, radiance


def light_of(cosine: np.ndarray) -> TexelIrradiance:
    sun = (cosine[..., None] * SUN_LX).astype(np.float32)
    sky = np.broadcast_to(SKY_LX, (*SHAPE, 3)).astype(np.float32)
    ones, zero = np.ones(SHAPE, np.float32), np.zeros(SHAPE, np.int32)
    return TexelIrradiance(sun, ones, sky, np.zeros_like, SUN_LX * 0.62 + SKY_LX, zero)


def test_exponents_of_classes_return_and_their_albedo_knows_nothing_of_the_sun(forest_and_fields):
    kind, albedo, cosine, radiance = forest_and_fields
    light = light_of(cosine)
    effective, exponents = class_illuminance(radiance, light.sun, light.visibility, light.sky, kind)
    assert exponents == pytest.approx(np.repeat(np.array(EXPONENTS)[:, None], 3, axis=1), abs=0.08)
    found = np.pi * radiance / effective
    lambertian = np.pi * radiance / (light.sun + light.sky)
    for number in range(2):
        member = kind == number
        r = [abs(np.corrcoef(values[member, 1], cosine[member])[0, 1]) for values in (found, lambertian)]
        assert r[0] < 0.05
        assert r[1] > 0.4
        assert found[member].mean() == pytest.approx(albedo[member].mean(), rel=0.03)


def test_clouds_in_a_class_do_not_decide_its_exponent(forest_and_fields):
    kind, _, cosine, radiance = forest_and_fields
    light = light_of(cosine)
    cloudy = radiance.copy()
    # Over slopes that turn away from the sun, as cumulus may stand.
    cloud = (cosine < 0.45) & (kind == 0)
    assert 0.02 < cloud.mean() < 0.2
    cloudy[cloud] = 12_000.0
    _, exponents = class_illuminance(cloudy, light.sun, light.visibility, light.sky, kind)
    assert exponents[0] == pytest.approx(np.full(3, EXPONENTS[0]), abs=0.15)


def test_an_exponent_is_fitted_where_it_may_be_and_small_classes_stay_lambertian(forest_and_fields):
    kind, _, cosine, radiance = forest_and_fields
    light = light_of(cosine)
    other = radiance.copy()
    other[:60] *= cosine[:60, :, None] ** 2
    below = np.zeros(SHAPE, bool)
    below[60:] = True
    _, exponents = class_illuminance(other, light.sun, light.visibility, light.sky, kind, below)
    assert exponents[:, 1] == pytest.approx(np.array(EXPONENTS), abs=0.12)
    few = np.where(np.arange(SHAPE[1]) < 3, kind, -1)
    _, exponents = class_illuminance(radiance, light.sun, light.visibility, light.sky, few)
    assert (exponents == 1.0).all()


def test_classes_are_found_in_the_image_by_colour_alone(forest_and_fields):
    kind, _, cosine, radiance = forest_and_fields
    found = land_classes(radiance, np.ones(SHAPE, bool), 2)
    assert max((found == kind).mean(), (found != kind).mean()) > 0.99
    assert (land_classes(radiance, np.zeros(SHAPE, bool), 2) == -1).all()
    options = DelightOptions(radiance_per_unit=1.0, register=False, borders=None, fit_sky=False, land_class=2)
    light, clipped = light_of(cosine), np.zeros((*SHAPE, 3), bool)
    delit = delight_image(radiance, clipped, light, options=options)
    assert delit.exponents is not None
    assert sorted(delit.exponents[:, 1]) == pytest.approx(EXPONENTS, abs=0.1)
    assert len(delit.facts["class_exponents"]) == 2
    plain = delight_image(radiance, clipped, light, options=replace(options, land_class=None))
    assert plain.exponents is None
    assert "class_exponents" not in plain.facts


def test_light_of_surrounding_land_is_taken_out_of_a_dark_wood():
    shape, texel_km = (36, 40), 0.15
    albedo = np.full((*shape, 3), 0.3)
    albedo[12:24, 13:27] = 0.03
    straight, molecules = np.array([0.75, 0.7, 0.6]), np.array([0.06, 0.1, 0.2])
    by_molecules, by_haze = scattered_upwards(molecules, -np.log(straight) - molecules)
    assert (by_molecules + by_haze + straight < 1.0).all()
    # What every texel adds to every other, one by one.
    place = np.stack(np.mgrid[: shape[0], : shape[1]], axis=-1).reshape(-1, 2) * texel_km
    distance = np.hypot(*(place[:, None] - place).transpose(2, 0, 1))
    np.fill_diagonal(distance, 0.35 * texel_km)
    seen = albedo.reshape(-1, 3) * straight
    for share, parts in ((by_molecules, ((0.93, 0.08), (0.07, 1.1))), (by_haze, ((0.375, 0.2), (0.625, 1.83)))):
        weight = sum(a * b * np.exp(-b * distance) for a, b in parts) / distance
        seen += share * (weight @ albedo.reshape(-1, 3)) / weight.sum(axis=1, keepdims=True)
    seen, around = seen.reshape(albedo.shape), Surroundings(by_molecules, by_haze, 1000.0 * texel_km)
    level = seen / (straight + by_molecules + by_haze)
    assert level[18, 20].mean() > 1.6 * albedo[18, 20].mean()
    found = without_surroundings(seen, straight, around, np.ones(shape, bool))
    assert found[18, 20] == pytest.approx(albedo[18, 20], rel=0.2)
    assert np.abs(found - albedo).mean() < 0.15 * np.abs(level - albedo).mean()
    # The estimator does so where its air says it.
    ones, none = np.ones((*shape, 3), np.float32), np.zeros(shape, np.int32)
    light = TexelIrradiance(ones, ones[..., 0], 0.1 * ones, np.zeros_like, np.full(3, 1.1), none)
    options = DelightOptions(radiance_per_unit=1.1 / np.pi, register=False, air=Air(straight, np.zeros(3), around))
    delit = delight_image(
        seen, np.zeros(seen.shape, bool), light, options=replace(options, borders=None, fit_sky=False)
    )
    assert delit.albedo == pytest.approx(found, abs=1e-4)


def test_surroundings_of_a_large_image_are_averaged_in_cells():
    rng = np.random.default_rng(0)
    image = rng.uniform(0.5, 1.5, (900, 30, 3)).astype(np.float32)
    around = Surroundings(np.full(3, 0.05), np.full(3, 0.1), 2.0)
    straight = np.full(3, 0.8)
    found = without_surroundings(image, straight, around, np.ones(image.shape[:2], bool))
    expected = (image - 0.15 * image.mean() / 0.95) / 0.8
    assert np.abs(found - expected).mean() < 0.02
