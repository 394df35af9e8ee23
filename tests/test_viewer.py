"""The page of a place: its files, its server, its light beside the renderer's, its pictures in a real browser."""

import base64
import hashlib
import http.client
import json
import re
import shutil
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from command_line import command
from places import SCENE, hill_heights, write_place, write_raster

import seasonscapes as ss
from seasonscapes.export.viewer_files import PAGE, load_scene, save_scene, single_file, viewer_files
from seasonscapes.frames import direction_from_angles, enu_from_geodetic, local_axes
from seasonscapes.sky.illumination import diffuse_horizontal_illuminance, luminance
from seasonscapes.workflows.illumination import given_sun_position, illumination_at
from seasonscapes.workflows.view_address import hazy_sky, read_address
from seasonscapes.workflows.viewer import first_view, serve_scene, write_folder
from seasonscapes.workflows.viewer_scene import SMALL, ViewerDetail, viewer_scene

ROOT = Path(__file__).parents[1]
TIME = "2024-07-20T08:00Z"
# 9° above the horizon: air and reflected light change much.
LOW_SUN = "2024-07-20T05:00Z"
sys.path.insert(0, str(ROOT / "benchmarks"))
from viewer_browser import chromium, open_page, prepare, radiance, served, shrunk, why_no_browser  # noqa: E402

sys.path.pop(0)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewer")
    return ss.load_place(write_place(folder / "land"), ss.Workspace(folder / "workspace"))


@pytest.fixture(scope="module")
def scene(place):
    return viewer_scene(place, sky=ss.sky_model("clear"), detail=SMALL)


@pytest.fixture(scope="module")
def folder(scene, place, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "page"
    write_folder(scene, path, first_view(place, "south", TIME))
    return path


class TestFiles:
    def test_the_page_names_nothing_outside_its_own_folder(self, folder):
        page = (folder / "index.html").read_text()
        named = re.findall(r'(?:src|href)="([^"]*)"', page)
        assert all(name == "data:," or (folder / name).is_file() for name in named), named
        assert "default-src 'none'" in page
        assert "unsafe" not in re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1]
        program = (folder / "viewer.js").read_text()
        # Names of XML, and what three.js says about itself in messages.
        addresses = set(re.findall(r"https?://[\w.]+", program)) - {"http://www.w3.org"}
        assert all(not re.search(rf'fetch\("{address}', program) for address in addresses)
        described = json.loads((folder / "scene.json").read_text())
        assert all((folder / each["file"]).is_file() for each in described["albedo"])
        assert described["attribution"] == "made by a test"

    def test_the_credit_of_the_data_stands_on_the_page_and_in_its_description(self, folder):
        assert '<p id="attribution">made by a test</p>' in (folder / "index.html").read_text()
        assert "made by a test" in (folder / "scene.json").read_text()

    def test_the_only_scripts_that_run_in_a_single_file_are_those_of_its_policy(self, scene):
        page = single_file(scene, view={"camera": "south"}).decode()
        policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1]
        for tag, directive in (("script", "script-src"), ("style", "style-src")):
            text = re.search(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)[1]
            digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
            assert f"{directive} 'sha256-{digest}'" in policy

    def test_text_of_the_scene_file_cannot_become_part_of_the_page(self, scene):
        from dataclasses import replace

        evil = '</script><script>alert(1)</script>"'
        hostile = replace(scene, about={**scene.about, "title": evil, "attribution": evil})
        for page in (viewer_files(hostile)["index.html"].decode(), single_file(hostile).decode()):
            assert "<script>alert" not in page

    def test_a_scene_that_was_kept_is_the_scene(self, scene, tmp_path):
        save_scene(scene, tmp_path / "kept")
        kept = load_scene(tmp_path / "kept")
        assert kept.about == scene.about
        assert [each.content for each in kept.albedo] == [each.content for each in scene.albedo]
        for name, values in scene.arrays.items():
            np.testing.assert_array_equal(kept.arrays[name], values)

    def test_a_folder_with_something_in_it_is_left_alone(self, scene, tmp_path):
        (tmp_path / "own.txt").write_text("mine")
        with pytest.raises(ss.InputError, match="is there already"):
            write_folder(scene, tmp_path, {})
        assert [each.name for each in tmp_path.iterdir()] == ["own.txt"]

    def test_heights_are_those_of_the_rendered_surface(self, scene, place):
        grid, stored = scene.about["grid"], scene.arrays["heights"].astype(float)
        rows, columns = np.nonzero(stored[5:-5:7, 5:-5:7])
        rows, columns = 5 + 7 * rows, 5 + 7 * columns
        east, north = grid["west_m"] + columns * grid["step_m"], grid["south_m"] + rows * grid["step_m"]
        up = grid["low_m"] + (stored[rows, columns] - 1.0) * grid["height_scale_m"]
        position = np.column_stack([east, north, up])
        assert np.abs(place.terrain.surface.up_at(position) - up).max() < 0.5


class TestServer:
    @pytest.fixture
    def page(self, scene):
        server, address, _ = serve_scene(scene, {})
        yield re.fullmatch(r"http://127\.0\.0\.1:(\d+)/([\w-]+)/", address).groups()
        server.shutdown()
        server.server_close()

    @staticmethod
    def ask(port, path, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", int(port), timeout=10)
        connection.putrequest("GET", path, skip_host=True)
        for name, value in ({"Host": f"127.0.0.1:{port}"} | headers).items():
            connection.putheader(name, value)
        connection.endheaders()
        reply = connection.getresponse()
        return reply.status, reply.read(), dict(reply.getheaders())

    def test_the_page_and_its_files_are_served_under_the_token(self, page, scene):
        port, token = page
        files = viewer_files(scene, view={"watched": True})
        for name in ("", *files):
            status, body, headers = self.ask(port, f"/{token}/{name}")
            assert (status, body) == (200, files[name or "index.html"])
            assert headers["Content-Security-Policy"].endswith("frame-ancestors 'none'")

    @pytest.mark.parametrize(
        ("path", "headers"),
        [
            ("/", {}),
            ("/scene.bin", {}),
            ("/{wrong}/scene.bin", {}),
            ("/{token}/scene.bin", {"Host": "evil.example"}),
            ("/{token}/scene.bin", {"Host": "127.0.0.1.evil.example:{port}"}),
            ("/{token}/scene.bin", {"Origin": "http://evil.example"}),
            ("/{token}/scene.bin", {"Origin": "null"}),
        ],
    )
    def test_strangers_are_refused(self, page, path, headers):
        port, token = page
        fill = {"token": token, "port": port, "wrong": token[::-1]}
        filled = {name: value.format(**fill) for name, value in headers.items()}
        assert self.ask(port, path.format(**fill), **filled)[0] == 403

    @pytest.mark.parametrize("name", ["../../etc/passwd", "%2e%2e/viewer.py", "nothing.js", "scene.bin/"])
    def test_there_are_no_other_files(self, page, name):
        port, token = page
        assert self.ask(port, f"/{token}/{name}")[0] == 404

    def test_the_server_knows_when_its_last_page_is_closed(self, scene):
        server, address, pages = serve_scene(scene, {})
        try:
            port, token = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/([\w-]+)/", address).groups()
            assert not pages.gone(0.0), "no page was opened yet"
            held = []
            for _ in range(2):
                connection = http.client.HTTPConnection("127.0.0.1", int(port), timeout=10)
                connection.request("GET", f"/{token}/open")
                held.append(connection.getresponse())
                assert held[-1].read(1) == b" "
            held[0].close()
            time.sleep(3.0)
            assert not pages.gone(0.0), "another is open"
            held[1].close()
            deadline = time.monotonic() + 20.0
            while not pages.gone(0.0) and time.monotonic() < deadline:
                time.sleep(0.1)
            assert pages.gone(0.0)
            assert not pages.gone(60.0), "it may be loaded again"
        finally:
            server.shutdown()
            server.server_close()


class TestAddress:
    TEXT = "http://127.0.0.1:8000/abc/#v=1&t=2024-09-18T17:05Z&cam=46.5405,7.98,1210.5,12.25,-8,60&ev=12.5&haze=2"

    def test_it_states_time_camera_exposure_and_haze(self):
        for text in (self.TEXT, self.TEXT.partition("#")[2], "#" + self.TEXT.partition("#")[2]):
            address = read_address(text)
            assert address.time == datetime(2024, 9, 18, 17, 5, tzinfo=UTC)
            assert (address.camera.height_m, address.camera.heading_deg, address.camera.pitch_deg) == (
                1210.5,
                12.25,
                -8.0,
            )
            assert (address.exposure, address.haze) == ("12.5", 2.0)

    @pytest.mark.parametrize(
        "text",
        [
            "",
            "http://127.0.0.1/",
            "#v=2&t=2024-09-18T17:05Z&cam=46,8,1000,0,0,60",
            "#v=1&cam=46,8,1000,0,0,60",
            "#v=1&t=2024-09-18T17:05&cam=46,8,1000,0,0,60",
            "#v=1&t=2024-09-18T17:05Z&cam=46,8,1000,0,0",
            "#v=1&t=2024-09-18T17:05Z&cam=99,8,1000,0,0,60",
            "#v=1&t=2024-09-18T17:05Z&cam=46,8,1000,0,0,60&ev=bright",
            "#v=1&t=2024-09-18T17:05Z&cam=46,8,1000,0,0,60&haze=nan",
            "#" + "&".join(["v=1"] * 40),
        ],
    )
    def test_what_is_none_is_refused_in_one_line(self, text):
        with pytest.raises(ss.InputError) as told:
            read_address(text)
        assert "\n" not in str(told.value)

    def test_haze_is_aerosol(self):
        clear = ss.sky_model("clear")
        assert hazy_sky(clear, 1.0) is clear
        assert hazy_sky(clear, 2.0).aerosol.optical_depth_500nm == 2.0 * clear.aerosol.optical_depth_500nm
        with pytest.raises(ss.InputError, match="states a haze"):
            hazy_sky(ss.sky_model("hosek"), 2.0)

    def test_render_takes_the_same_picture_from_an_address_as_from_flags(self, place, tmp_path):
        common = {"size": "24x16", "spp": 1, "sky": "hosek", "workspace": place.workspace.folder}
        text = self.TEXT.replace("&haze=2", "")
        command("render", place.path, at_url=text, output=tmp_path / "a.png", **common)
        command(
            *("render", place.path, "--at=46.5405,7.98,1210.5", "--heading", 12.25, "--pitch=-8", "--fov", 60),
            **{"time": "2024-09-18T17:05Z", "exposure": 12.5, "output": tmp_path / "b.png"} | common,
        )
        from seasonscapes.images import read_image_srgb

        np.testing.assert_array_equal(read_image_srgb(tmp_path / "a.png"), read_image_srgb(tmp_path / "b.png"))

    @pytest.mark.parametrize("flags", [{}, {"at_url": TEXT, "time": TIME}, {"at_url": TEXT, "exposure": 12}])
    def test_time_and_view_are_stated_once(self, place, tmp_path, flags):
        with pytest.raises(ss.InputError):
            command("render", place.path, output=tmp_path / "a.png", workspace=place.workspace.folder, **flags)


class TestPlaces:
    def test_skies_that_the_page_cannot_show_are_refused(self, place):
        for sky in (ss.sky_model("hosek"), ss.sky_model("overcast"), ss.sky_model("clear", cloudiness=0.5)):
            with pytest.raises(ss.InputError, match="cloudless"):
                viewer_scene(place, sky=sky)

    def test_a_large_raster_is_thinned_and_said_to_be(self, place, caplog):
        detail = ViewerDetail(40, 64, 64, 24, 12, 4, 256, 4, 16, light_heights=2)
        scene = viewer_scene(place, sky=ss.sky_model("clear"), detail=detail)
        assert max(scene.arrays["heights"].shape) <= 41
        assert "heights every 77.9 m of the raster's 12.5 m" in caplog.text

    def test_a_place_without_image_near_the_pole_has_a_page(self, place, tmp_path):
        text = SCENE.replace(
            "latitude_deg = 46.5405\nlongitude_deg = 7.98", "latitude_deg = 89.987\nlongitude_deg = 135.0"
        )
        text = re.sub(r"\[imagery\].*?\n\n", "", text, flags=re.DOTALL)
        (tmp_path / "pole.toml").write_text(text)
        write_raster(tmp_path / "dem.tif", hill_heights(), spacing_m=50.0, crs="EPSG:3995", origin=(-500.0, 2500.0))
        pole = ss.load_place(tmp_path / "pole.toml", place.workspace)
        detail = ViewerDetail(40, 64, 64, 24, 12, 4, 256, 4, 16, light_heights=2)
        scene = viewer_scene(pole, sky=ss.sky_model("clear"), detail=detail)
        assert (scene.arrays["heights"] > 0).mean() > 0.4
        assert len(scene.albedo) == 1


@pytest.fixture(scope="module")
def answers(folder, place, tmp_path_factory):
    """What the page's program computes, and what it was asked."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    suns = [given_sun_position(place, azimuth, elevation) for azimuth, elevation in SUNS]
    rng = np.random.default_rng(4)
    azimuth, elevation = rng.uniform(0.0, 360.0, 200), rng.uniform(0.5, 90.0, 200)
    directions = direction_from_angles(azimuth, elevation)
    geodetic = [(46.56, 7.99, 1500.0), (46.52, 7.9, 800.0)]
    questions = {
        "height_m": 1120.0,
        "suns": [
            {
                "azimuth": float(each.sun.azimuth_deg),
                "elevation": float(each.sun.elevation_deg),
                "direction": each.sun.direction.tolist(),
                "distance": float(each.sun.distance_au),
            }
            for each in suns
        ],
        "directions": directions.tolist(),
        "geodetic": geodetic,
    }
    asked = tmp_path_factory.mktemp("node") / "questions.json"
    asked.write_text(json.dumps(questions))
    script = ["node", str(ROOT / "tests" / "viewer_light.mjs"), str(folder), str(asked)]
    done = subprocess.run(script, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), suns, directions, geodetic


SUNS = [(120.0, -10.5), (140.0, -7.7), (95.0, -3.7), (200.0, 0.3), (80.0, 8.2), (180.0, 47.0)]


class TestLight:
    """The page's JavaScript against the renderer's own light, at suns between the knots of its tables."""

    @pytest.mark.parametrize("index", range(len(SUNS)))
    def test_sky_and_sun_are_those_of_the_renderer(self, answers, place, index):
        told, suns, directions, _ = answers
        at_camera = illumination_at(ss.sky_model("clear"), suns[index], 1120.0, workspace=place.workspace)
        on_terrain = illumination_at(
            ss.sky_model("clear"), suns[index], place.median_height_m, workspace=place.workspace
        )
        answer = told["answers"][index]
        sky = at_camera.aerial_perspective(np.full(len(directions), np.inf), directions)[1]
        away = directions @ suns[index].sun.direction < np.cos(np.radians(2.0))
        # The page adds the background of the night, which this airlight lacks.
        ours, theirs = luminance(np.array(answer["sky"]) - np.array(answer["night"])), luminance(sky)
        error = np.abs(ours - theirs)[away] / theirs[away]
        assert np.median(error) < 0.01
        assert np.percentile(error, 95) < 0.02
        level = luminance(diffuse_horizontal_illuminance(on_terrain.sky_radiance))
        assert luminance(np.array(answer["level"])) == pytest.approx(level, rel=0.02)
        if on_terrain.sun is not None:
            np.testing.assert_allclose(answer["direct"], on_terrain.sun.normal_illuminance_lx, rtol=0.02)

    def test_frames_are_those_of_the_renderer(self, answers, place):
        told, _, _, geodetic = answers
        for k, (latitude, longitude, height) in enumerate(geodetic):
            np.testing.assert_allclose(
                told["positions"][k], enu_from_geodetic(place.frame, latitude, longitude, height), atol=1e-6
            )
            np.testing.assert_allclose(told["back"][k], geodetic[k], atol=1e-8, rtol=1e-12)
            np.testing.assert_allclose(told["axes"][k], local_axes(place.frame, latitude, longitude), atol=1e-9)


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """The page's sources with what their lock file names, installed afresh."""
    for tool in ("node", "npm"):
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is not installed")
    source = tmp_path_factory.mktemp("sources") / "viewer"
    shutil.copytree(ROOT / "viewer", source, ignore=shutil.ignore_patterns("node_modules"))
    installed = subprocess.run(["npm", "ci", "--no-audit", "--no-fund"], cwd=source, capture_output=True, text=True)
    if installed.returncode and re.search(r"ENOTFOUND|EAI_AGAIN|ECONNREFUSED|ETIMEDOUT|ENETUNREACH", installed.stderr):
        pytest.skip("the registry of npm cannot be reached")
    assert installed.returncode == 0, installed.stderr
    return source


class TestBuild:
    def test_the_program_in_the_package_is_what_its_sources_build(self, sources, tmp_path):
        built = subprocess.run(["node", "build.mjs", str(tmp_path)], cwd=sources, capture_output=True, text=True)
        assert built.returncode == 0, built.stderr
        for name in ("viewer.js", "NOTICES.txt"):
            assert (tmp_path / name).read_bytes() == (PAGE / name).read_bytes(), f"{name}: run viewer/build.mjs"


@pytest.fixture(scope="module")
def browser():
    reason = why_no_browser()
    if reason is not None:
        pytest.skip(reason)
    with chromium() as running:
        yield running


@pytest.fixture(scope="module")
def page(browser, folder):
    with served(folder) as address:
        open_page(browser, address + "?still&size=96x72")
        prepare(browser)
        yield address


@pytest.mark.browser
class TestBrowser:
    def test_it_opens_without_network_faults_or_messages(self, browser, page):
        assert [entry["message"] for entry in browser.get_log("browser")] == []
        answers = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
        replies = [each["params"]["response"] for each in answers if each["method"] == "Network.responseReceived"]
        asked = [reply for reply in replies if not reply["url"].startswith("data:")]
        assert len(asked) >= 6
        assert all(reply["status"] == 200 and reply["url"].startswith(page) for reply in asked)
        assert not [each for each in answers if each["method"] == "Network.loadingFailed"]

    def test_its_picture_is_that_of_path_tracing(self, browser, page, place):
        when = datetime.fromisoformat(LOW_SUN)
        camera = ss.camera(place, "south", size_px=(48, 36))
        truth = ss.render(place, camera, LOW_SUN, spp=32)
        seen = {"camera": 0, "time": when.timestamp() * 1000.0, "frames": 2, "size": [96, 72]}
        image = shrunk(radiance(browser, **seen), 2)
        unlit = shrunk(radiance(browser, **seen, change={"shadows": 0, "bounce": 0, "air": 0}), 2)
        ground = truth.coverage > 0.99
        ratio = luminance(image[ground]) / luminance(truth.radiance[ground])
        assert np.median(ratio) == pytest.approx(1.0, abs=0.03)
        assert np.mean(np.abs(ratio - 1.0) < 0.12) > 0.85
        other = luminance(unlit[ground]) / luminance(truth.radiance[ground])
        assert np.mean(np.abs(other - 1.0)) > 2.0 * np.mean(np.abs(ratio - 1.0))
        sky = truth.coverage == 0.0
        assert np.median(np.abs(luminance(image[sky]) / luminance(truth.radiance[sky]) - 1.0)) < 0.01

    def test_sun_and_moon_stand_where_the_ephemeris_puts_them(self, browser, page, place):
        frame, height = place.frame, place.median_height_m
        for text in ("2024-01-25T17:00Z", "2024-07-20T03:50Z", "2031-11-03T12:00Z"):
            ours = ss.sun_moon_position(datetime.fromisoformat(text), frame.latitude_deg, frame.longitude_deg, height)
            script = "const t = Date.parse(arguments[0]); return [seasonscapes.ephemeris.sun(t), seasonscapes.ephemeris.moon(t)]"
            for theirs, body in zip(browser.execute_script(script, text), (ours.sun, ours.moon), strict=True):
                away = np.degrees(np.arccos(np.clip(np.dot(theirs["direction"], body.direction), -1.0, 1.0)))
                assert away < 0.02

    def test_the_address_brings_the_same_view_back(self, browser, page):
        script = """
          const s = seasonscapes; s.useCamera(0); s.setTime(Date.parse('2024-09-18T05:20Z')); s.setEv(9.5); s.setHaze(2);
          return s.command();
        """
        said = re.search(r'--at-url "(#[^"]*)"', browser.execute_script(script))[1]
        address = read_address(said)
        assert (address.time, address.exposure, address.haze) == (datetime(2024, 9, 18, 5, 20, tzinfo=UTC), "9.50", 2.0)
        browser.execute_script("location.hash = '#v=1'; location.hash = arguments[0]", said)
        again = "return seasonscapes.command()"
        assert said in browser.execute_script(again)

    def test_every_control_has_a_name_and_axe_finds_no_serious_fault(self, browser, folder, sources):
        with served(folder) as address:
            open_page(browser, address)
            browser.execute_script("seasonscapes.state.paused = true")
            for name in ("hour", "day", "haze", "ev"):
                assert browser.execute_script(
                    f"return document.getElementById('{name}').getAttribute('aria-valuetext')"
                )
            # Through the debugger's protocol: the page's own policy lets no other script in.
            browser.execute_script((sources / "node_modules" / "axe-core" / "axe.min.js").read_text())
            found = browser.execute_async_script("axe.run().then((r) => arguments[arguments.length - 1](r.violations))")
        serious = [each["id"] for each in found if each["impact"] in ("serious", "critical")]
        assert serious == [], [node["html"] for each in found for node in each["nodes"]]

    def test_one_file_opens_from_the_file_system(self, browser, scene, tmp_path):
        from seasonscapes.workflows.viewer import write_single_file

        write_single_file(scene, tmp_path / "page.html", {"time": TIME})
        browser.get_log("browser")
        open_page(browser, (tmp_path / "page.html").as_uri() + "?still&size=48x36")
        assert [entry["message"] for entry in browser.get_log("browser")] == []
