"""Gaussians seen from a webcam's own place: discs follow its pixels, and none nearby lies over its picture."""

import json

import numpy as np
import pytest

pytest.importorskip("torch")

import places

import seasonscapes as ss
from seasonscapes.calibration.evidence import PARAMETERS
from seasonscapes.evaluation.metrics import psnr_db
from seasonscapes.gaussians.disc_density import coarsening, footprints, refined_surfels, surfels_for
from seasonscapes.gaussians.surfels import terrain_surfels
from seasonscapes.images import srgb_from_linear
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh
from seasonscapes.workflows.disc_cameras import calibrated_disc_cameras, scene_disc_cameras

TIME = "2024-07-20T12:00Z"
WEBCAM = """[[webcam]]
id = "hut"
latitude_deg = 46.5445
longitude_deg = 7.98
above_ground_m = 3.0
projection = "perspective"
heading_deg = 20.0
tilt_deg = -4.0
horizontal_fov_deg = 60.0
width_px = 144
height_px = 96
time_zone = "Europe/Zurich"
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A hill with fields of 50 m in two colours, and a webcam 3 m above ground; no camera."""
    folder = tmp_path_factory.mktemp("hut")
    path = places.write_place(folder, places.SCENE.split("[[camera]]")[0] + WEBCAM)
    fields = np.random.default_rng(3).random((61, 61, 1)) < 0.5
    image = np.where(fields, [0.45, 0.3, 0.15], [0.08, 0.16, 0.1])
    places.write_raster(folder / "image.tif", image, spacing_m=50.0)
    return ss.load_place(path, ss.Workspace(folder / "work"), options=ss.MeshOptions(texel_m=25.0))


@pytest.fixture(scope="module")
def own(place):
    (camera,) = scene_disc_cameras(place, (144, 96)).values()
    return camera


@pytest.fixture(scope="module")
def stage(place):
    mesh = mi_mesh(place.terrain, np.full(3, 0.3))
    return RenderScene(ray_scene(mesh).mi_scene, mesh)


def test_gaussians_show_what_a_webcam_sees(place, own):
    """As the mesh does, from its place and from 20 m above it; 125 m apart everywhere they have 12 dB less of the detail."""
    options = ss.DistilOptions(
        discs=24, suns=1, dates=1, views=1, view_px=128, steps=1, picture_steps=0, refine_discs=False
    )
    model = ss.distil(place, sky="hosek", options=options)
    for above_m, least_db in ((0.0, 30.0), (20.0, 28.0)):
        pose = np.array(own.world_from_camera)
        pose[2, 3] += above_m
        camera = ss.Camera(144, 96, own.fx, own.fy, own.cx, own.cy, pose, place.frame)
        mesh = ss.render(place, camera, TIME, sky="hosek")
        splats = ss.render_gaussians(model, place, camera, TIME, sky="hosek")
        land = mesh.coverage > 0.999
        pictures = [srgb_from_linear(ss.develop(each.radiance, exposure=14.5)) for each in (mesh, splats)]
        assert land.mean() > 0.5
        assert psnr_db(*pictures, land) > least_db


def test_a_bound_makes_all_discs_that_follow_pixels_larger(place, own, stage):
    coarse = terrain_surfels(place.terrain, 125.0)
    place_m, side_m = footprints(stage, [own], grazing=True)
    whole = refined_surfels(place.terrain, coarse, place_m, side_m)
    most = len(whole.means) // 3
    factor = coarsening(coarse, place_m, side_m, most)
    assert factor > 1.0
    assert len(refined_surfels(place.terrain, coarse, place_m, factor * side_m).means) <= most
    assert len(refined_surfels(place.terrain, coarse, place_m, factor / 2.0**0.75 * side_m).means) > most
    assert coarsening(coarse, place_m, side_m, 10**7) == 1.0
    # No cell is quartered for a pixel where not even the discs of the grid are allowed.
    assert coarsening(coarse, place_m, side_m, 1) * side_m.min() >= coarse.grid.spacing_m


def test_discs_around_a_camera_are_small_for_their_distance(place, own, stage):
    """Behind it too: one that spans a large angle blends over the picture from beside it."""
    found = surfels_for(place.terrain, terrain_surfels(place.terrain, 125.0), stage, [own], 8.0, 500)
    distance_m = np.linalg.norm(found.means - own.position_m, axis=1)
    least_m = found.grid.spacing_m / 64.0
    large = found.spacing_m > np.maximum(0.3 * distance_m, least_m)
    behind = (found.means - own.position_m) @ own.world_from_camera[:3, 2] < 0.0
    # Land that no ray from the camera's place meets, beyond a brow, may lie coarse.
    assert large.mean() < 0.01
    assert (behind & (distance_m < 60.0)).sum() > 20


def test_ground_that_is_seen_at_a_grazing_angle_needs_fewer_discs(stage, own):
    (place_m, across_m), (same_m, ground_m) = (footprints(stage, [own], grazing=grazing) for grazing in (False, True))
    np.testing.assert_array_equal(place_m, same_m)
    assert (ground_m >= across_m).all()
    assert 1.5 < np.median(ground_m / across_m) < 8.0


def test_records_give_the_views_of_webcams(place, own, tmp_path):
    facts = {
        "webcam": "hut",
        "projection": "perspective",
        "size_px": [576, 384],
        **{key: 4.0 * float(getattr(own, key)) for key in ("fx", "fy", "cx", "cy")},
        "k1": 0.0,
        "world_from_camera": own.world_from_camera.tolist(),
        "sigma": dict.fromkeys(PARAMETERS, 0.0),
        "frame": {
            "latitude_deg": place.frame.latitude_deg,
            "longitude_deg": place.frame.longitude_deg,
            "height_m": place.frame.height_m,
            "refraction_k": place.frame.refraction_k,
        },
    }
    path = tmp_path / "hut_calibration.json"
    path.write_text(json.dumps(facts))
    ((name, camera),) = calibrated_disc_cameras(place, [path], 144 * 96).items()
    assert (name, camera.width_px, camera.height_px) == ("hut", 144, 96)
    assert camera.fx == pytest.approx(own.fx)
    np.testing.assert_allclose(camera.world_from_camera, own.world_from_camera, atol=1e-9)
