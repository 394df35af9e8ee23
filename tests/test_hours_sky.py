"""Which pictures an asked sky takes: all ground in the sun, none of it, or any; patches of sunlight belong to the last alone."""

from dataclasses import replace

import numpy as np
import pytest

import seasonscapes as ss
from seasonscapes.errors import InputError

TIMES = ["2024-07-20T09:00", "2024-07-20T12:00", "2024-07-20T16:00"]
ASKED = "2024-07-20T14:00"


@pytest.fixture(scope="module")
def hours(tmp_path_factory):
    """Three sunny pictures, the second of which is said to have patches of sunlight alone, and the third none."""
    folder = tmp_path_factory.mktemp("hours")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SEASONSCAPES_WORKSPACE", str(folder / "workspace"))
        place = ss.load_place("alpine_small")
        camera = ss.camera(place, "aerial", size_px=(48, 32))
        made = ss.synthetic_photographs(place, TIMES, folder / "made", sky="hosek", cameras={"aerial": camera})
        found = ss.camera_hours(place, ss.open_photographs(place, made.manifest, made.calibrations, TIMES))
    assert found.shone.all()
    direct = np.array([found.fitted.direct[0], 0.1, 0.1])
    return replace(found, fitted=replace(found.fitted, direct=direct), shone=np.array([True, True, False]))


def _of_one(hours, number: int) -> np.ndarray:
    """The asked hour by one picture alone."""
    alone = np.arange(3) == number
    direct = np.where(alone, 0.9, 0.0)
    return replace(hours, fitted=replace(hours.fitted, direct=direct), shone=alone).at(ASKED, sky="sun")


def test_sun_takes_the_sunny_picture_and_no_sun_the_one_without(hours):
    np.testing.assert_array_equal(hours.at(ASKED, sky="sun"), _of_one(hours, 0))
    np.testing.assert_array_equal(hours.at(ASKED, sky="no sun"), _of_one(hours, 2))
    assert np.abs(hours.at(ASKED) - hours.at(ASKED, sky="sun")).max() > 1e-4


def test_patches_of_sunlight_are_told_and_taken_by_any_alone(hours):
    assert [each.sun_shone for each in hours.weather] == [True, True, False]
    patchy = replace(hours, fitted=replace(hours.fitted, direct=np.full(3, 0.1)), shone=np.ones(3, bool))
    for sky in ("sun", "no sun"):
        with pytest.raises(InputError, match="no picture has this sky"):
            patchy.at(ASKED, sky=sky)
    np.testing.assert_array_equal(patchy.at(ASKED), hours.at(ASKED))
