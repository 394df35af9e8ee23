"""The picker: its functions, its server's manners, and the page itself in headless Chromium from click to file."""

import json
import shutil
import urllib.error
import urllib.request
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from seasonscapes.calibration.annotation import (
    AnnotationSession,
    add_match,
    position_at,
    project_to_photograph,
    remove_last_match,
    save_session,
    session_state,
    solve_session,
)
from seasonscapes.calibration.annotation_page import serve_session
from seasonscapes.calibration.calibration_file import read_calibration
from seasonscapes.calibration.evidence import Priors, read_points
from seasonscapes.calibration.pose_model import parameters_of_view, project_with_parameters
from seasonscapes.calibration.terrain_view import march_terrain_view, scaled_view, trace_terrain_view
from seasonscapes.errors import ImageSizeMismatch, InputError
from seasonscapes.evaluation.calibration_pictures import picture_trial

SIZE = (640, 427)


@pytest.fixture(scope="module")
def trial():
    return picture_trial(np.random.default_rng(2), size_px=SIZE, covered=0.0, heading_error_deg=4.0)


@pytest.fixture
def session(trial, tmp_path):
    look = partial(march_terrain_view, rasters=trial.rasters, frame=trial.frame, nearest_m=120.0)
    return AnnotationSession(
        "HUT",
        trial.image,
        trial.start,
        trial.frame,
        look,
        tmp_path,
        priors=Priors(horizontal_m=10.0, vertical_m=10.0, focal=0.02),
    )


def true_pixel(trial, position):
    return project_with_parameters(trial.truth, np.eye(3), parameters_of_view(trial.truth, np.eye(3)), position[None])[
        0
    ][0]


def good_places(session, trial, count):
    """Terrain pixels whose point also lies in the photograph, spread over the picture."""
    rng, found = np.random.default_rng(1), []
    height, width = session.terrain_view.distance_m.shape
    while len(found) < count:
        at = rng.uniform([5, 5], [width - 5, height - 5])
        if not np.isfinite(session.terrain_view.position_m[int(at[1]), int(at[0])]).all():
            continue
        pixel = true_pixel(trial, position_at(session, at))
        if (
            5 < pixel[0] < SIZE[0] - 5
            and 5 < pixel[1] < SIZE[1] - 5
            and all(np.abs(at - other).max() > 60 for other in found)
        ):
            found.append(at)
    return found


def test_what_is_picked_is_the_first_surface_and_the_sky_is_refused(session, trial):
    seen = np.argwhere(np.isfinite(session.terrain_view.distance_m))[::997]
    places = np.array([position_at(session, (x + 0.5, y + 0.5)) for y, x in seen])
    pixels, _ = project_with_parameters(
        session.rendered_view, np.eye(3), parameters_of_view(session.rendered_view, np.eye(3)), places
    )
    off_px = np.abs(pixels - (seen[:, ::-1] + 0.5)).max(axis=1)
    # The march's steps of 0.45 % of the distance are some pixels of ground that is seen from above.
    assert np.median(off_px) < 1.5
    assert off_px.max() < 7.0
    y, x = seen[5]
    sky = np.argwhere(~np.isfinite(session.terrain_view.distance_m))[0]
    with pytest.raises(ValueError, match="is sky"):
        add_match(session, (5, 5), (sky[1], sky[0]))
    assert project_to_photograph(session, (sky[1], sky[0])) is None
    with pytest.raises(ValueError, match="outside the photograph"):
        add_match(session, (SIZE[0] + 9, 5), (x, y))
    with pytest.raises(ValueError, match="no match to remove"):
        remove_last_match(session)
    with pytest.raises(ImageSizeMismatch, match="the image is 639 x 427 px"):
        replace(session, image=session.image[:, 1:])


def test_pairs_solve_to_the_truth_and_are_saved(session, trial):
    for at in good_places(session, trial, 8):
        add_match(session, true_pixel(trial, position_at(session, at)), at)
    before = [np.subtract(p["projected"], p["photo"]) for p in session_state(session)["pairs"]]
    solve_session(session)
    after = [np.subtract(p["projected"], p["photo"]) for p in session_state(session)["pairs"]]
    assert np.abs(before).max() > 20.0
    assert np.abs(after).max() < 0.05
    heading = parameters_of_view(trial.truth, np.eye(3))[0]
    assert session.solution.parameters[0] == pytest.approx(heading, abs=0.02)
    points, record = save_session(session)
    assert len(read_points(points, trial.frame)) == 8
    again = read_calibration(record)
    assert np.allclose(again.view.world_from_camera, session.solution.view.world_from_camera, atol=1e-12)
    assert (again.webcam, again.frame) == ("HUT", trial.frame)
    record.write_text(json.dumps({"webcam": "HUT"}))
    with pytest.raises(InputError, match="not a calibration record"):
        read_calibration(record)


def test_a_renderer_can_take_the_marchers_place(session, trial):
    """`trace_terrain_view` hands over rays and takes a G-buffer: here the marcher's own, ray by ray."""
    view = scaled_view(trial.start, 64)
    seen = march_terrain_view(view, trial.rasters, trial.frame, nearest_m=120.0)

    class Hit:
        depth, normal, position = seen.distance_m, seen.normal, seen.position_m

    given = {}

    def trace(origin, direction):
        given["shape"], given["unit"] = direction.shape, np.linalg.norm(direction, axis=-1)
        return Hit

    assert np.array_equal(trace_terrain_view(view, trace).distance_m, seen.distance_m)
    assert given["shape"] == (view.height_px, 64, 3)
    assert np.allclose(given["unit"], 1.0)


def test_the_server_answers_only_here_and_only_with_its_token(session):
    server, address = serve_session(session)
    try:
        assert server.server_address[0] == "127.0.0.1"
        root = address.split("?")[0]
        assert b"<canvas" in urllib.request.urlopen(address).read()
        for request in (
            root,
            root + "?token=wrong",
            urllib.request.Request(root + "state", b"{}"),
            urllib.request.Request(address, headers={"Host": "evil.example"}),
        ):
            with pytest.raises(urllib.error.HTTPError) as error:
                urllib.request.urlopen(request)
            assert error.value.code == 403
        token = {"X-Token": address.split("=")[1]}
        for path, body, message in (
            ("solve", b"{}", "at least 3 are needed"),
            ("pick", b"{}", "not a request"),
            ("pick", b"[", "not valid JSON"),
        ):
            with pytest.raises(urllib.error.HTTPError) as error:
                urllib.request.urlopen(urllib.request.Request(root + path, body, headers=token))
            assert message in json.loads(error.value.read())["error"]
    finally:
        server.shutdown()


@pytest.fixture
def browser():
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    binary = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if not binary or not driver:
        pytest.skip("no Chromium with chromedriver found")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for flag in (
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--window-size=1400,700",
    ):
        options.add_argument(flag)
    chrome = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    yield chrome
    chrome.quit()


def test_the_page_from_click_to_file_in_chromium(session, trial, browser):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.ui import WebDriverWait

    def data(name):
        return browser.execute_script(f"return document.body.dataset.{name}")

    def until(condition):
        WebDriverWait(browser, 60).until(lambda _: condition())

    def click(pane, at):
        x, y = browser.execute_script(f"return panes.{pane}.toScreen([{at[0]}, {at[1]}])")
        canvas = browser.find_element(By.ID, pane)
        middle = canvas.size["width"] / 2, canvas.size["height"] / 2
        ActionChains(browser).move_to_element_with_offset(
            canvas, round(x - middle[0]), round(y - middle[1])
        ).click().perform()

    def press(name):
        browser.find_element(By.ID, name).click()

    def message():
        return browser.find_element(By.ID, "message").text

    server, address = serve_session(session)
    try:
        browser.get(address)
        until(lambda: data("photo") == "ready" and data("terrain") == "ready")
        places = good_places(session, trial, 7)
        for number, at in enumerate(places, 1):
            click("photo", true_pixel(trial, position_at(session, at)))
            until(lambda: "same feature in the terrain" in message())
            click("terrain", at)
            until(lambda n=number: data("pairs") == str(n))
        # A click into the sky of the terrain is answered, not taken.
        sky = np.argwhere(~np.isfinite(session.terrain_view.distance_m))
        y, x = sky[len(sky) // 3]
        click("photo", (100, 100))
        click("terrain", (x, y))
        until(lambda: "is sky" in message())
        assert data("pairs") == "7"
        press("undo")  # the half pair
        press("undo")
        until(lambda: data("pairs") == "6")
        press("solve")
        until(lambda: data("solved") == "true")
        until(lambda: "heading" in message())
        # Half a screen pixel of clicking is what remains.
        error = abs(session.solution.parameters[0] - parameters_of_view(trial.truth, np.eye(3))[0])
        assert error < 0.15
        # Live reprojection: hovering shows where a point of the terrain falls in the photograph.
        until(lambda: browser.execute_script("return panes.terrain.image.complete"))
        ActionChains(browser).move_to_element_with_offset(browser.find_element(By.ID, "terrain"), 0, 40).perform()
        until(lambda: browser.execute_script("return cursor !== null"))
        stretched = (
            "return Object.values(panes).some(p => p.canvas.width !== p.canvas.clientWidth || "
            "p.canvas.height !== p.canvas.clientHeight)"
        )
        until(lambda: not browser.execute_script(stretched))
        press("save")
        until(lambda: data("saved") == "yes")
        assert read_calibration(session.folder / "HUT_calibration.json").webcam == "HUT"
        assert len(read_points(session.folder / "HUT_points.csv", trial.frame)) == 6
        browser.save_screenshot(str(session.folder / "page.png"))
        assert (session.folder / "page.png").stat().st_size > 10_000
    finally:
        server.shutdown()
