"""Albedo from photographs of ground that is not Lambertian: water tells none, snow's is found by how snow scatters."""

import json
from dataclasses import replace

import albedo_cases
import numpy as np
import places
import pytest

from seasonscapes.albedo import equations, haze
from seasonscapes.albedo.closed_form import solve_albedo
from seasonscapes.albedo.forward_model import ambient_on_texels, trace_texel_transport
from seasonscapes.albedo.ground_pixels import ground_pixels, without_water
from seasonscapes.albedo.haze import HazeFit
from seasonscapes.albedo.photographs import LINEAR, prepare_photographs
from seasonscapes.cameras.observation import Observation
from seasonscapes.errors import NoUsablePixels
from seasonscapes.frames import direction_from_angles
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.hosek import hosek_illumination
from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight
from seasonscapes.rendering.radiance import render_view
from seasonscapes.terrain.surface_classes import Snow
from seasonscapes.workflows.albedo_recovery import RecoveryOptions, _prepared, recover_albedo, texel_transport
from seasonscapes.workflows.illumination import sky_model
from seasonscapes.workflows.place import load_place, utc_at
from seasonscapes.workflows.season_recovery import _grouped_days
from seasonscapes.workflows.view_rendering import render
from seasonscapes.workflows.views import camera
from seasonscapes.workspace import Workspace

SAMPLING = SamplingOptions(shadow_samples=1, rays=128, clusters_per_receiver=64, clusters=1024, rank=24)


@pytest.fixture(scope="module")
def case():
    return albedo_cases.case()


@pytest.fixture(scope="module")
def photographs(case):
    return prepare_photographs(case.transport, *case.observations())


@pytest.fixture(scope="module")
def snowy(case):
    """The place under snow of albedo 0.8 that scatters as snow does, its transport, and photographs of it."""
    terrain = replace(case.terrain, snow=Snow())
    albedo = np.full_like(case.albedo, 0.8)
    mesh = mi_mesh(terrain, albedo)
    observations, lights = [], []
    # Each camera looks towards a low sun.
    for number, azimuth_deg in ((0, 240.0), (2, 110.0)):
        light = hosek_illumination(direction_from_angles(azimuth_deg, 10.0), shape=(64, 128))
        for view in (case.cameras[0], case.cameras[2]):
            image = render_view(relight(mesh, light), view, spp=64, seed=number).radiance
            moment = case.observations([number])[0][0].time
            observations.append(Observation(image, np.ones(image.shape[:2], bool), view, moment, "snow"))
            lights.append(light)
    transport = trace_texel_transport(terrain, albedo.shape[:2], sampling=SAMPLING)
    gains = [np.ones(3)] * len(observations)
    return transport, prepare_photographs(transport, observations, lights, gains=gains), albedo


def test_sunlit_snow_is_predicted_as_it_is_path_traced(snowy):
    """Taken for matt, snow before a low sun is up to half as bright as it is."""
    transport, photographs, albedo = snowy
    errors = []
    for photograph in photographs:
        row = equations.equations_of(photograph, LINEAR, albedo.size // 3)
        row.ambient = ambient_on_texels(transport, photograph.light, albedo)
        ground = ground_pixels(transport, photograph)
        assert ground is not None
        sunlit = row.usable[:, 0] & (photograph.footprints.lit[photograph.number] > 0.95)
        for factors in (None, ground.factors(albedo.reshape(-1, 3))):
            row.ground = factors
            model = equations.forward_product(row, albedo.reshape(-1, 3))[0] + row.airlight
            errors.append(np.abs(row.picture[sunlit] / model[sunlit] - 1.0).mean(axis=1))
    matt, factors = (np.concatenate(errors[first::2]) for first in (0, 1))
    assert len(matt) > 300
    assert factors.mean() < 0.5 * matt.mean()
    assert factors.mean() < 0.04


def test_the_albedo_of_snow_is_found_by_how_it_scatters(case, snowy):
    transport, photographs, albedo = snowy
    found = solve_albedo(transport, photographs, noise_model=LINEAR)
    matt = solve_albedo(case.transport, photographs, noise_model=LINEAR)
    seen = found.pixel_count > 4.0
    errors = [np.median(np.abs(fit.albedo[seen] - albedo[seen])) for fit in (found, matt)]
    assert errors[0] < 0.9 * errors[1]
    assert errors[0] < 0.03
    assert found.cost < 0.97 * matt.cost


def test_the_adjoint_of_snow_is_the_transpose(snowy):
    transport, photographs, albedo = snowy
    row = equations.equations_of(photographs[1], LINEAR, albedo.size // 3)
    ground = ground_pixels(transport, photographs[1])
    assert ground is not None
    row.ground = ground.factors(albedo.reshape(-1, 3))
    assert np.ptp(row.ground.luminaries[0]) > 0.2
    rng = np.random.default_rng(4)
    row.ambient = rng.uniform(1e3, 1e4, row.ambient.shape).astype(np.float32)
    a, r = rng.random(row.ambient.shape, np.float32), rng.random(row.picture.shape, np.float32)
    left = (equations.forward_product(row, a)[0].astype(float) * r).sum()
    assert left == pytest.approx((a.astype(float) * equations.adjoint(row, r)).sum(), rel=1e-4)
    # The diagonal against the response to single texels.
    row.weight = np.ones_like(row.picture)
    diagonal = equations.squared_adjoint(row)
    for texel in rng.choice(np.flatnonzero(diagonal[:, 1] > 0.0), 3):
        one = np.zeros_like(a)
        one[texel] = 1.0
        response = equations.forward_product(row, one)[0].astype(float)
        np.testing.assert_allclose((response**2).sum(axis=0), diagonal[texel], rtol=1e-3)


def test_water_tells_no_albedo(case, photographs):
    row, column = np.mgrid[0 : case.albedo.shape[0], 0 : case.albedo.shape[1]]
    counts = pixel_counts(photographs)
    at = np.unravel_index(np.argmax(counts), counts.shape)
    water = (np.hypot(row - at[0], column - at[1]) < 5.0).astype(np.float32)
    dry, share = without_water(photographs, water)
    assert 0.0 < share < 0.5
    assert len(dry) == len(photographs)
    assert len({id(each.footprints) for each in dry}) == len(case.cameras)
    for before, after in zip(photographs, dry, strict=True):
        wet = before.footprints.matrix(before.footprints.share) @ water.ravel()
        np.testing.assert_array_equal(after.footprints.pixel, before.footprints.pixel[wet <= 0.02])
    fit = solve_albedo(case.transport, dry, noise_model=LINEAR)
    inside = np.hypot(row - at[0], column - at[1]) < 3.0
    assert fit.information[inside].max() == 0.0
    # Elsewhere nothing is lost.
    away = (np.hypot(row - at[0], column - at[1]) > 9.0) & (fit.pixel_count > 2.0)
    assert albedo_cases.psnr(fit.albedo, case.albedo, away) > 30.0
    with pytest.raises(NoUsablePixels, match="water"):
        without_water(photographs, np.ones_like(water))


def pixel_counts(photographs):
    from seasonscapes.albedo.footprints import texel_pixel_count

    every = [(each.footprints, np.ones(len(each.footprints.pixel), bool)) for each in photographs[:3]]
    return texel_pixel_count(every)


# A camera above the lake that sees nothing else.
ABOVE_LAKE = """
[[camera]]
name = "lake"
latitude_deg = 46.5451
longitude_deg = 7.98
above_ground_m = 400.0
heading_deg = 0.0
pitch_deg = -88.0
fov_deg = 8.0
"""


def lake_place(folder, text=""):
    path = places.write_place(folder, places.SCENE + text + '\n[water]\nfile = "lakes.geojson"\n\n[snow]\n')
    ring = [[7.977, 46.5440], [7.983, 46.5440], [7.983, 46.5462], [7.977, 46.5462], [7.977, 46.5440]]
    (folder / "lakes.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    return load_place(path, Workspace(folder / "workspace"))


def test_a_photograph_of_water_alone_drops_out_with_its_sky_and_joins_a_season(tmp_path, monkeypatch, caplog):
    place = lake_place(tmp_path, ABOVE_LAKE)
    seen = []
    for name, day in (("lake", 2), ("south", 1), ("south", 3)):
        view, image = camera(place, name, size_px=(48, 32)), np.full((32, 48, 3), 0.3, np.float32)
        seen.append(Observation(image, np.ones((32, 48), bool), view, utc_at(place, f"2024-07-0{day}T12:00"), name))
    tried = []

    def fitted(transport, photographs, lights_of, **rest):
        tried.append([len(photographs), len(lights_of(30.0))])
        return HazeFit(30.0, {30.0: 0.0})

    monkeypatch.setattr(haze, "fit_visibility", fitted)
    transport, sky = texel_transport(place), sky_model("clear", cloudiness=0.0)
    prepared = _prepared(place, transport, seen, sky, RecoveryOptions(fit_haze=True), None)[0]
    assert [each.observation.webcam for each in prepared] == ["south", "south"]
    assert tried == [[2, 2]]
    with caplog.at_level("WARNING"):
        groups = _grouped_days(place, transport, seen, sky, None)
    assert sorted(day.day for group in groups for day in group) == [1, 2, 3]
    assert "2024-07-02 alone gives no albedo (it shows no ground)" in caplog.text


def test_recovery_completes_the_texels_of_water(tmp_path, caplog):
    place = lake_place(tmp_path)
    view = camera(place, "south", size_px=(72, 48))
    seen = []
    for hour in ("09", "15"):
        picture = render(place, view, f"2024-07-01T{hour}:00", sky="hosek", spp=16)
        mask = np.ones(picture.radiance.shape[:2], bool)
        image = (picture.radiance / np.percentile(picture.radiance, 99.9)).clip(0.0, 1.0)
        seen.append(Observation(image.astype(np.float32), mask, view, utc_at(place, f"2024-07-01T{hour}:00"), "south"))
    with caplog.at_level("INFO"):
        recovered = recover_albedo(place, seen, sky="hosek")
    assert 0.05 < recovered.facts["water_share"] < 0.6
    assert any("water:" in each.message for each in caplog.records)
    lake = place.terrain.water.mask == 1.0
    assert lake.sum() > 20
    assert set(np.unique(recovered.estimate.source[lake])) == {2}
    assert (recovered.estimate.source == 1).sum() > 100
    np.testing.assert_array_equal(recovered.texture.weight[lake], 0.0)
    assert np.isfinite(recovered.estimate.sigma[lake]).all()
