"""Paths: exactly N views, passing their waypoints, twice differentiable, at constant speed, clear of the ground."""

import json
from itertools import pairwise

import numpy as np
import places
import pytest
from command_line import command
from PIL import Image
from scipy.spatial import cKDTree

from seasonscapes.cameras.path_file import load_path, read_reference_path, resize_camera, save_path, view_record
from seasonscapes.cameras.pinhole import Camera, camera_at, project, rotation_from_angles
from seasonscapes.cameras.trajectory import (
    CURVES,
    GroundClearance,
    cameras_along_path,
    curve_through,
    height_above_ground,
    lift_above_ground,
    roll_of,
    views_along,
)
from seasonscapes.errors import InputError, InvalidPath
from seasonscapes.frames import LocalFrame, enu_from_geodetic
from seasonscapes.workflows.camera_paths import Waypoint, waypoint_cameras
from seasonscapes.workflows.place import MeshOptions, find_scene, ground_height_m, load_place
from seasonscapes.workflows.views import camera_for, local_ground
from seasonscapes.workspace import Workspace

FRAME = LocalFrame(46.55, 7.98, 1000.0, 0.13)


def camera(place, heading_deg=0.0, pitch_deg=0.0, roll_deg=0.0, focal=80.0):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_angles(heading_deg, pitch_deg, roll_deg), place
    return Camera(96, 64, focal, focal, 48.0, 32.0, pose)


def waypoints():
    # Chords of very different lengths, and a sharp turn.
    return [
        camera([0, 0, 1000], 10, -5),
        camera([1500, 300, 1200], 80, -10),
        camera([1700, 700, 1250], 150, -15),
        camera([-500, 3000, 1500], 300, -20),
    ]


def places_of(views):
    return np.array([each.position_m for each in views])


# ---------------------------------------------------------------------------------------------- curves


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("curve", CURVES)
@pytest.mark.parametrize("count", [2, 3, 41])
def test_exactly_so_many_views_and_none_twice(curve, closed, count):
    views = cameras_along_path(waypoints(), count, curve=curve, closed=closed)
    assert len(views) == count
    apart = cKDTree(places_of(views)).query(places_of(views), k=2)[0][:, 1]
    assert apart.min() > 20.0
    np.testing.assert_allclose(views[0].world_from_camera, waypoints()[0].world_from_camera, atol=1e-9)
    if not closed:
        np.testing.assert_allclose(views[-1].world_from_camera, waypoints()[-1].world_from_camera, atol=1e-6)


@pytest.mark.parametrize("curve", CURVES)
def test_waypoints_are_passed_with_their_own_view(curve):
    line = curve_through(places_of(waypoints()), curve=curve)
    np.testing.assert_allclose(line.position(line.waypoints_at_m), places_of(waypoints()), atol=1e-6)
    # So many views that some fall on each waypoint: seen from there, the waypoint's own picture.
    for turn in ("smooth", "slerp"):
        views = views_along(line, waypoints(), 801, turn=turn)
        for known in waypoints():
            near = views[int(np.argmin(np.linalg.norm(places_of(views) - known.position_m, axis=1)))]
            apart = near.world_from_camera[:3, :3].T @ known.world_from_camera[:3, :3]
            assert np.degrees(np.arccos(np.clip((np.trace(apart) - 1.0) / 2.0, -1.0, 1.0))) < 0.8


@pytest.mark.parametrize("curve", CURVES)
def test_speed_is_constant_along_the_way(curve):
    line = curve_through(places_of(waypoints()), curve=curve)
    count = 60
    fine = line.position(np.linspace(0.0, line.length_m, (count - 1) * 200 + 1))
    steps = np.linalg.norm(np.diff(fine, axis=0), axis=1).reshape(count - 1, 200).sum(axis=1)
    # The chord over a linear path's corner is a little short.
    assert steps.max() / steps.min() - 1.0 < (1e-4 if curve == "spline" else 5e-3)
    assert line.length_m == pytest.approx(steps.sum(), rel=1e-4)


@pytest.mark.parametrize("closed", [False, True])
def test_a_spline_is_twice_continuously_differentiable_by_arc_length(closed):
    line = curve_through(places_of(waypoints()), closed=closed)
    joints = line.waypoints_at_m[1:-1]
    before, after = (line.derivatives(joints + side * 1e-5) for side in (-1.0, 1.0))
    for left, right in zip(before, after, strict=True):
        assert np.abs(left - right).max() < 1e-6
    if closed:
        ends = line.derivatives(np.array([0.0, line.length_m]))
        np.testing.assert_allclose(ends[0][0], ends[0][1], atol=1e-9)
        np.testing.assert_allclose(ends[1][0], ends[1][1], atol=1e-9)
    # And these are the derivatives: differences of positions say the same.
    s, h = np.linspace(50.0, line.length_m - 50.0, 301), 0.5
    low, middle, high = (line.position(s + side * h) for side in (-1.0, 0.0, 1.0))
    tangent, bend = line.derivatives(s)
    np.testing.assert_allclose((high - low) / (2 * h), tangent, atol=1e-5)
    np.testing.assert_allclose((high - 2 * middle + low) / h**2, bend, atol=2e-6)
    np.testing.assert_allclose(np.linalg.norm(tangent, axis=1), 1.0, rtol=1e-12)
    # A linear path turns at its waypoints.
    corner = curve_through(places_of(waypoints()), curve="linear")
    at = corner.waypoints_at_m[1:-1]
    assert np.abs(corner.derivatives(at - 1e-5)[0] - corner.derivatives(at + 1e-5)[0]).max() > 0.1


def test_smooth_turns_have_no_jerk_where_slerp_has():
    line = curve_through(places_of(waypoints()))

    ring = curve_through(places_of(waypoints()), closed=True)

    def jump(turn, closed=False):
        """Largest change of the turning rate between neighbouring views [rad per view]."""
        known = [*waypoints(), waypoints()[0]] if closed else waypoints()
        views = views_along(ring if closed else line, known, 801, turn=turn, closed=closed)
        rotations = [each.world_from_camera[:3, :3] for each in (views + views[:2] if closed else views)]
        steps = [a.T @ b for a, b in pairwise(rotations)]
        rates = np.array([(m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]) for m in steps]) / 2.0
        return np.abs(np.diff(rates, axis=0)).max()

    assert jump("smooth") < 0.05 * jump("slerp")
    # Where the ends of a closed path meet, too.
    assert jump("smooth", True) < 0.05 * jump("slerp", True)


def test_a_level_horizon_stays_level_and_roll_is_blended():
    for turn in ("smooth", "slerp"):
        views = cameras_along_path(waypoints(), 50, turn=turn)
        assert max(abs(roll_of(each.world_from_camera[:3, :3])) for each in views) < 1e-9
    rolled = cameras_along_path([camera([0, 0, 0], 0, 0, 10.0), camera([1000, 0, 0], 90, 0, 20.0)], 11)
    rolls = np.degrees([roll_of(each.world_from_camera[:3, :3]) for each in rolled])
    np.testing.assert_allclose(rolls, np.linspace(10.0, 20.0, 11), atol=1e-6)


def test_look_at_keeps_the_place_in_the_middle_and_lenses_blend():
    target = np.array([800.0, 900.0, 400.0])
    known = waypoints()
    known[-1] = camera([-500, 3000, 1500], focal=160.0)
    views = cameras_along_path(known, 25, look_at_m=target)
    for each in views:
        np.testing.assert_allclose(project(each, target)[0], [48.0, 32.0], atol=1e-6)
    assert views[-1].fx == pytest.approx(160.0)
    assert all(a.fx <= b.fx + 1e-9 for a, b in pairwise(views))
    with pytest.raises(InvalidPath, match="vertically above"):
        cameras_along_path([camera([0, 0, 100]), camera([100, 0, 100])], 3, look_at_m=np.array([50.0, 0.0, 0.0]))


def test_what_is_no_path_is_refused():
    with pytest.raises(InvalidPath, match="two waypoints"):
        cameras_along_path(waypoints()[:1], 5)
    with pytest.raises(InvalidPath, match="same place"):
        cameras_along_path([waypoints()[0], waypoints()[0], waypoints()[1]], 5)
    with pytest.raises(ValueError, match="at least 2 views"):
        cameras_along_path(waypoints(), 1)
    with pytest.raises(ValueError, match="expected one of spline, linear"):
        cameras_along_path(waypoints(), 5, curve="bezier")
    with pytest.raises(ValueError, match="expected one of smooth, slerp"):
        cameras_along_path(waypoints(), 5, turn="squash")


# ---------------------------------------------------------------------------------------------- clearance


def hill(places_en):
    return 900.0 + 500.0 * np.exp(-np.sum((places_en - [900.0, 150.0]) ** 2, axis=1) / 250.0**2)


def test_a_path_is_lifted_over_a_hill_and_stays_smooth():
    line = curve_through(places_of(waypoints()))
    lifted, most = lift_above_ground(line, hill, 60.0)
    s = np.linspace(0.0, lifted.length_m, 20001)
    assert height_above_ground(line.position(s), hill, 60.0).min() < 0.0
    assert height_above_ground(lifted.position(s), hill, 60.0).min() >= 60.0
    assert most > 60.0
    # Far from the hill nothing has moved, and the lift is vertical.
    np.testing.assert_allclose(lifted.at_parameter(line.knots[-1]), line.at_parameter(line.knots[-1]), atol=1e-6)
    u = lifted.parameter(s)
    np.testing.assert_array_equal(lifted.at_parameter(u)[:, :2], line.at_parameter(u)[:, :2])
    joints = np.concatenate([lifted.waypoints_at_m[1:-1], np.interp(lifted.lift.x[1:-1:7], *lifted.table)])
    before, after = (lifted.derivatives(joints + side * 1e-5)[1] for side in (-1.0, 1.0))
    assert np.abs(before - after).max() < 1e-6
    steps = np.linalg.norm(np.diff(lifted.position(s), axis=0), axis=1)
    assert steps.max() / steps.min() < 1.01


def test_the_lift_is_the_largest_height_added():
    line = curve_through(places_of(waypoints()))
    lifted, most = lift_above_ground(line, hill, 60.0)
    assert most == pytest.approx(lifted.lift(lifted.lift.x).max(), rel=1e-12)
    s = np.linspace(0.0, lifted.length_m, 20001)
    u = lifted.parameter(s)
    assert most == pytest.approx((lifted.at_parameter(u) - line.at_parameter(u))[:, 2].max(), abs=0.1)


def test_cameras_along_a_path_keep_their_clearance():
    views = cameras_along_path(waypoints(), 200, clearance=GroundClearance(hill, 60.0))
    assert height_above_ground(places_of(views), hill, 60.0).min() >= 60.0


def test_high_above_the_ground_nothing_is_lifted_and_off_the_land_there_is_none():
    line = curve_through(places_of(waypoints()) + np.array([0.0, 0.0, 2000.0]))
    same, most = lift_above_ground(line, hill, 60.0)
    assert same is line
    assert most == 0.0
    nowhere, most = lift_above_ground(line, lambda places_en: np.full(len(places_en), np.nan), 60.0)
    assert nowhere is line
    assert most == 0.0


@pytest.fixture(scope="module")
def alpine(tmp_path_factory):
    return load_place(find_scene("alpine"), Workspace(tmp_path_factory.mktemp("work")), options=MeshOptions())


@pytest.mark.parametrize("curve", CURVES)
def test_clearance_on_the_embedded_scene_by_rays(alpine, curve):
    """Rays straight down onto the mesh itself: nowhere lower than stated, where the bare path runs into the ground."""
    from seasonscapes.rendering.gbuffer import trace_rays
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh

    named = {
        name: camera_for(alpine, alpine.scene.camera(name), size_px=(96, 64))
        for name in ("aerial", "meadow", "lake", "ridge")
    }
    free = Waypoint(46.55, 7.95, ground_height_m(alpine, 46.55, 7.95, where="free") + 80.0)
    given = [named["aerial"], named["meadow"], named["lake"], free, named["ridge"]]
    known = waypoint_cameras(alpine, given, fov_deg=60.0, size_px=(96, 64))
    terrain = ray_scene(mi_mesh(alpine.terrain, np.full(3, 0.2)))

    def above(line):
        places_m = line.position(np.linspace(0.0, line.length_m, 4000))
        high = places_m + np.array([0.0, 0.0, 5000.0])
        down = np.broadcast_to([0.0, 0.0, -1.0], high.shape)
        return trace_rays(RenderScene(terrain.mi_scene, terrain.mi_terrain), high, down).depth - 5000.0

    bare = curve_through(places_of(known), curve=curve)
    line, most = lift_above_ground(bare, local_ground(alpine), 50.0)
    assert above(bare).min() < 0.0 < most
    assert above(line).min() >= 50.0
    views = views_along(line, known, 120)
    assert len(views) == 120
    ways = np.linalg.norm(np.diff(line.position(np.linspace(0.0, line.length_m, 119 * 100 + 1)), axis=0), axis=1)
    steps = ways.reshape(119, 100).sum(axis=1)
    assert steps.max() / steps.min() < 1.01


# ---------------------------------------------------------------------------------------------- files


def test_a_path_comes_back_from_its_file(tmp_path):
    views = cameras_along_path(waypoints(), 7)
    straight_down = camera([10.0, 20.0, 3000.0], 37.0, -90.0)
    rolled = camera([10.0, 20.0, 3000.0], 123.0, 15.0, -8.0)
    save_path(tmp_path / "p.json", [*views, straight_down, rolled], FRAME, note={"scene": "x"})
    again = load_path(tmp_path / "p.json", FRAME)
    for old, new in zip([*views, straight_down, rolled], again, strict=True):
        np.testing.assert_allclose(new.position_m, old.position_m, atol=1e-6)
        np.testing.assert_allclose(new.world_from_camera[:3, :3], old.world_from_camera[:3, :3], atol=1e-8)
        assert (new.fx, new.cy, new.width_px) == (old.fx, old.cy, old.width_px)
    # Angles are those that a person would give.
    made = camera_at(FRAME, 46.6, 8.02, 2100.0, heading_deg=140.0, pitch_deg=-12.0, roll_deg=3.0)
    told = view_record(made, FRAME)
    assert [told[k] for k in ("latitude_deg", "longitude_deg", "height_m", "heading_deg", "pitch_deg", "roll_deg")] == (
        pytest.approx([46.6, 8.02, 2100.0, 140.0, -12.0, 3.0], abs=1e-6)
    )
    # The file knows no frame: another one puts the same views at the same places on Earth.
    other = load_path(tmp_path / "p.json", LocalFrame(46.5, 8.1, 500.0, 0.13))
    assert view_record(other[3], LocalFrame(46.5, 8.1, 500.0, 0.13)) == pytest.approx(
        view_record(views[3], FRAME), abs=1e-6
    )
    small = resize_camera(views[0], (48, 16))
    far = views[0].position_m + views[0].world_from_camera[:3, :3] @ [3.0, 1.0, 10.0]
    np.testing.assert_allclose(project(small, far)[0], project(views[0], far)[0] * [0.5, 0.25])


def test_files_that_are_no_path(tmp_path):
    file = tmp_path / "p.json"
    for text, words in (
        ("{}", "is not a camera path file"),
        ('{"kind": "seasonscapes path"}', "not a valid camera path"),
        ("{", "p.json"),
        ('{"kind": "seasonscapes path", "size_px": [9, 9], "views": []}', "no views"),
        ('{"kind": "seasonscapes path", "size_px": [9, 9], "views": [{"fx": 1}]}', "latitude_deg"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=words):
            load_path(file, FRAME)


# The reference's own layout, with numbers of our own.
def reference_file(folder, interpolation="linear", numbers=(4, 6)):
    def record(longitude, latitude, height, heading_deg):
        heading = np.radians(heading_deg)
        # Columns: right, up, back in south, east, up.
        right = [np.sin(heading), np.cos(heading), 0.0]
        back = [np.cos(heading), -np.sin(heading), 0.0]
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([right, [0.0, 0.0, 1.0], back], axis=1)
        matrix[:3, 3] = longitude, latitude, height
        return {
            "wid": 3072.0,
            "hei": 2048.0,
            "cx": 1536.0,
            "cy": 1024.0,
            "fx": 1000.0,
            "fy": 1400.0,
            "k3 ": 0.0,
            "file_path": "",
            "transform_matrix": matrix.tolist(),
        }

    meta = {
        "mode": "waypoints",
        "waypoints": ["b", "a", "c"],
        "nbr_points": list(numbers),
        "interpolation": interpolation,
    }
    table = {
        "meta": meta,
        "a": record(8.00, 46.60, 1500.0, 0.0),
        "b": record(7.98, 46.58, 1300.0, 90.0),
        "c": record(8.03, 46.62, 2000.0, 0.0),
    }
    file = folder / "wayp.json"
    file.write_text(json.dumps(table))
    return file


def test_reference_waypoints_in_their_order(tmp_path):
    given = read_reference_path(reference_file(tmp_path), FRAME, kind="unrefined")
    assert (given.count, given.curve, len(given.cameras)) == (10, "linear", 3)
    np.testing.assert_allclose(given.cameras[0].position_m, enu_from_geodetic(FRAME, 46.58, 7.98, 1300.0), atol=1e-6)
    assert view_record(given.cameras[0], FRAME)["heading_deg"] == pytest.approx(90.0, abs=1e-6)
    assert read_reference_path(reference_file(tmp_path, "smooth"), FRAME).curve == "spline"
    file = reference_file(tmp_path, "wobbly")
    with pytest.raises(InputError, match="meta: not a list of waypoints"):
        read_reference_path(file, FRAME)


@pytest.mark.data
def test_the_published_trajectories(data_dir):
    folder = data_dir / "seasonscapes-config" / "transformation_matrices"
    if not folder.is_dir():
        pytest.skip(f"no trajectories of the reference at {folder}")
    waypoints_file = folder / "REGION_J" / "transforms_novelLaubH_wayp_linear.json"
    given = read_reference_path(waypoints_file, FRAME)
    theirs = read_reference_path(waypoints_file.with_name("transforms_novelLaubH_wayp_linear_all.json"), FRAME)
    assert (given.count, len(given.cameras), theirs.count, len(theirs.cameras)) == (355, 21, None, 355)
    ours = cameras_along_path(given.cameras, given.count, curve=given.curve)
    # Theirs stands still at each joint and changes its pace there; ours does neither, along the same lines.
    pace = np.linalg.norm(np.diff(places_of(theirs.cameras), axis=0), axis=1)
    assert np.count_nonzero(pace < 1e-3) == 19
    assert len(ours) == 355
    line = curve_through(places_of(given.cameras), curve="linear")
    apart = cKDTree(line.position(np.linspace(0.0, line.length_m, 40001))).query(places_of(theirs.cameras))[0]
    assert apart.max() < 5.0
    steps = np.linalg.norm(np.diff(places_of(ours), axis=0), axis=1)
    assert np.median(steps) == pytest.approx(steps.max(), rel=1e-6)
    for name, count in (("GRIND/transforms_novelLaubH_wayp_3", 40), ("REGION_J/transforms_novelLaubH_wayp_video", 400)):
        smooth = read_reference_path(folder / f"{name}.json", FRAME)
        assert (smooth.count, smooth.curve) == (count, "spline")
        assert len(cameras_along_path(smooth.cameras, smooth.count)) == count


# ---------------------------------------------------------------------------------------------- the verb


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.setenv("SEASONSCAPES_WORKSPACE", str(tmp_path / "work"))
    return places.write_place(tmp_path / "scene")


def test_the_verb_writes_a_path_and_a_map(scene, tmp_path, capsys):
    command(
        "path",
        scene,
        via=["south", "46.5505,7.9805,+60", "46.56,7.97,1500"],
        views=12,
        clearance_m=40.0,
        size="96x64",
        output=tmp_path / "p.json",
        map=tmp_path / "map.png",
        json=True,
    )
    record = json.loads(capsys.readouterr().out)
    assert record["views"] == 12
    assert record["lowest_above_ground_m"] >= 40.0
    land = load_place(scene)
    views = load_path(tmp_path / "p.json", land.frame)
    assert [len(views), views[0].width_px, views[0].height_px] == [12, 96, 64]
    assert view_record(views[0], land.frame)["heading_deg"] == pytest.approx(0.0, abs=1e-3)
    # The second waypoint looks towards the third: north-west.
    headings = [view_record(each, land.frame)["heading_deg"] for each in views]
    assert 300.0 < headings[-1] < 340.0
    shown = np.asarray(Image.open(tmp_path / "map.png")).astype(int)
    red = (shown[..., 0] > 180) & (shown[..., 1] < 110) & (shown[..., 2] < 100)
    # Drawn on the map, from the south edge to the north-west of the middle, and again in the profile.
    rows, columns = np.nonzero(red[:1200])
    assert rows.max() > 900
    assert rows[np.argmin(rows)] < 400
    assert columns.min() < 500
    assert red[1200:].any()


def test_the_verb_reads_reference_files(scene, tmp_path, capsys):
    file = reference_file(tmp_path)
    command("path", scene, reference=file, kind="unrefined", output=tmp_path / "p.json", clearance_m=0.0, json=True)
    record = json.loads(capsys.readouterr().out)
    assert (record["views"], record["curve"]) == (10, "linear")
    views = load_path(tmp_path / "p.json", load_place(scene).frame)
    assert (views[0].width_px, views[0].fx, views[0].fy) == (1536, pytest.approx(500.0), pytest.approx(700.0))


def test_the_verb_says_what_is_wrong(scene, tmp_path):
    for flags, words in (
        ({}, "give one of them"),
        ({"via": ["south"]}, "at least two waypoints"),
        ({"via": ["south", "nowhere"]}, "not a waypoint"),
        ({"via": ["south", "46.55,7.98,+50,north"]}, "not a heading"),
        ({"via": ["south", "99,7.98,+50"]}, "out of range"),
        ({"via": ["south", "47.9,7.98,+50"]}, "outside the elevation raster"),
        ({"via": ["south", "south"]}, "same place"),
        ({"via": ["south", "46.55,7.98,+50"], "curve": "bezier"}, "expected spline or linear"),
        ({"via": ["south", "46.55,7.98,+50"], "views": 1}, "--views"),
        ({"reference": tmp_path / "none.json"}, "none.json"),
    ):
        with pytest.raises(InputError, match=words):
            command("path", scene, output=tmp_path / "p.json", **flags)
    assert not (tmp_path / "p.json").exists()
