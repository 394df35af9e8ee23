"""Albedos of a synthetic place on several days: made together, they are those made one by one."""

from datetime import date
from pathlib import Path

import pytest

import seasonscapes as ss
from seasonscapes.terrain.surface import load_texture
from seasonscapes.workflows import albedo_sources
from seasonscapes.workflows.albedo_sources import keep_synthetic_albedos, scene_albedo
from seasonscapes.workspace import Workspace

DAYS = (date(2024, 9, 16), date(2024, 10, 1), date(2024, 1, 16))


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Textures of the days, each made where it was asked for."""
    place = ss.load_place("alpine_small", Workspace(tmp_path_factory.mktemp("alone")))
    return [scene_albedo(place, day) for day in DAYS]


def kept(folder: Path) -> list[str]:
    return sorted(path.name[:13] for path in folder.rglob("albedo-day*.npz"))


def test_days_made_together_are_kept_and_those_made_alone(alone, tmp_path, monkeypatch):
    place = ss.load_place("alpine_small", Workspace(tmp_path))
    keep_synthetic_albedos(place, DAYS[:1])
    assert kept(tmp_path) == [], "one day alone is made where it is asked for"
    keep_synthetic_albedos(place, DAYS)
    assert kept(tmp_path) == ["albedo-day016", "albedo-day260", "albedo-day275"]
    made = []
    monkeypatch.setattr(albedo_sources, "synthetic_image", lambda *asked: made.append(asked))
    keep_synthetic_albedos(place, DAYS)
    for day, expected in zip(DAYS, alone, strict=True):
        texture = scene_albedo(place, day)
        assert texture.values.tobytes() == expected.values.tobytes()
        assert texture.weight.tobytes() == expected.weight.tobytes()
        assert texture.atlas_id == expected.atlas_id
    assert made == [], "what is kept is not made again"


def test_what_changed_after_it_was_written_is_made_again(alone, tmp_path):
    place = ss.load_place("alpine_small", Workspace(tmp_path))
    keep_synthetic_albedos(place, DAYS[:2])
    path = next(tmp_path.rglob("albedo-day260*.npz"))
    whole = path.read_bytes()
    path.write_bytes(whole[:-500] + bytes(500))
    assert scene_albedo(place, DAYS[0]).values.tobytes() == alone[0].values.tobytes()
    assert load_texture(path).values.tobytes() == alone[0].values.tobytes()
