"""Luminous efficacies of clear sunlight and skylight against SPECTRL2 and against a measured day."""

import numpy as np
import pvlib
import pytest

from seasonscapes.sky.atmosphere import Atmosphere
from seasonscapes.sky.broadband import _SPECTRUM, _Paths, _spectra, clear_efficacies_lm_w


@pytest.mark.parametrize("elevation_deg", [5.0, 25.0, 70.0])
def test_spectra_are_those_of_spectrl2(elevation_deg):
    """Direct and diffuse spectra, wavelength by wavelength, against pvlib's implementation."""
    zenith, depth = 90.0 - elevation_deg, 0.15
    expected = pvlib.spectrum.spectrl2(
        apparent_zenith=zenith,
        aoi=zenith,
        surface_tilt=0.0,
        ground_albedo=0.3,
        surface_pressure=90_000.0,
        relative_airmass=pvlib.atmosphere.get_relative_airmass(zenith),
        precipitable_water=0.8,
        ozone=0.32,
        aerosol_turbidity_500nm=depth,
        dayofyear=94,
        scattering_albedo_400nm=0.93,
        alpha=1.3,
        wavelength_variation_factor=0.0,
        aerosol_asymmetry_factor=0.68,
    )
    distance = pvlib.irradiance.get_extra_radiation(94, solar_constant=1.0, method="spencer")
    paths = _Paths(depth * (_SPECTRUM[:, 0] / 500.0) ** -1.3, 0.93, 0.8, 0.32, 900.0 / 1013.0)
    direct, diffuse = _spectra(paths, elevation_deg, 0.68, 0.3)
    for ours, key in ((direct, "dni"), (diffuse, "dhi")):
        np.testing.assert_allclose(ours * _SPECTRUM[:, 1] * distance, expected[key].ravel(), rtol=3e-4, atol=1e-9)


def test_water_vapour_raises_the_efficacy():
    """It absorbs watts and no lumens; what is left of the atmosphere of a high place has little of it."""
    dry, wet = (clear_efficacies_lm_w(Atmosphere(), 45.0, 500.0, water_cm=water)[0] for water in (0.2, 4.0))
    high = clear_efficacies_lm_w(Atmosphere(), 45.0, 3500.0, water_cm=4.0)[0]
    assert dry < high < wet
    assert wet / dry == pytest.approx(1.12, abs=0.04)


def test_the_sun_by_the_minute(data_dir, monkeypatch):
    """A cloudless day in Arizona: direct sunlight within 3 % of the pyrheliometer, with one fitted optical depth."""
    import importlib
    from pathlib import Path

    folder = data_dir / "light-series"
    if not folder.is_dir():
        pytest.skip(f"no measurements of light at {folder}")
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    bench = importlib.import_module("light_series")
    day = bench.midc(folder / "midc_raw_20181018.txt")
    sun = bench.sun_position(day.times, day.latitude_deg, day.longitude_deg, day.height_m)
    chosen = np.flatnonzero(bench.chosen_minutes(day, np.asarray(sun.elevation_deg)))
    assert len(chosen) > 500
    model = bench.station_model(day)
    fit, judged = chosen[::40], chosen[7::40]

    def error(depth: float, at: np.ndarray) -> float:
        return bench.rms(bench.our_direct(bench.with_depth(model, depth), day, sun, at), day.direct[at])

    depth = bench.fitted(lambda value: error(value, fit), 0.002, 0.6)
    assert 0.03 < depth < 0.09
    assert error(depth, judged) < 0.03
