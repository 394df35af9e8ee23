"""A headless Chromium that shows a page of a place with WebGL, for benchmarks/viewer.py and tests."""

from __future__ import annotations

import base64
import functools
import http.server
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

# SwiftShader draws on processors; newer versions of Chromium use it only where both flags ask for it.
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--hide-scrollbars",
    "--window-size=1280,800",
)


def why_no_browser() -> str | None:
    """Why no Chromium can be started here; ``None`` where it can."""
    if not (shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")):
        return "no Chromium found"
    if not shutil.which("chromedriver"):
        return "no chromedriver found"
    try:
        import selenium  # noqa: F401
    except ImportError:
        return "selenium is not installed"
    return None


@contextmanager
def chromium(*, offline: bool = True) -> Iterator:
    """A running browser; with ``offline`` it reaches this machine alone."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = str(
        shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    )
    for flag in FLAGS:
        options.add_argument(flag)
    if offline:
        options.add_argument("--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(str(shutil.which("chromedriver"))))
    browser.set_script_timeout(300)
    try:
        yield browser
    finally:
        browser.quit()


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        pass


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Address of a folder that Python's own server serves, as ``python -m http.server`` does."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()


def processor_s(browser) -> float:
    """Processor seconds of the browser's processes so far."""
    import psutil

    processes = psutil.Process(browser.service.process.pid).children(recursive=True)
    return sum(sum(process.cpu_times()[:4]) for process in processes)


def open_page(browser, address: str, *, seconds: float = 120.0, until: str = "ready") -> float:
    """Open a page and wait until its picture is finished; the seconds from its address to its first picture.

    ``until="first"`` waits for the first picture alone.

    Raises
    ------
    RuntimeError
        Where the page tells a failure (no WebGL context among them), or nothing in time.
    """
    start = time.perf_counter()
    browser.get(address)
    while time.perf_counter() - start < seconds:
        data = browser.execute_script("return {...document.body.dataset}")
        if "failed" in data:
            raise RuntimeError(f"the page cannot show the place: {data['failed']}")
        if until in data:
            device = browser.execute_script("return seasonscapes.renderer.device")
            if not device:
                raise RuntimeError("the page has no WebGL context")
            return float(data["first"]) / 1000.0
        time.sleep(0.05)
    raise RuntimeError(f"the page showed nothing within {seconds:g} s")


PREPARE = """
const done = arguments[arguments.length - 1];
window.measure = async ({camera, time, frames, size, change, sunOnly, divider}) => {
  const s = seasonscapes, r = s.renderer;
  s.state.paused = true;
  const known = {shadows: 1, bounce: 1, air: 1, ...(change || {})};
  r.ground.uniforms.uShadows.value = known.shadows;
  r.ground.uniforms.uAirOn.value = sunOnly ? 0 : known.air;
  r.diffuse.uniforms.uBounceScale.value = sunOnly ? 0 : known.bounce;
  if (size && (r.gl.domElement.width !== size[0] || r.gl.domElement.height !== size[1])) r.resize(...size);
  if (camera !== undefined) s.useCamera(camera);
  if (time !== undefined) s.setTime(time, s.sharp);
  await s.state.arriving;
  if (divider !== undefined) await s.setDivider(divider);
  if (sunOnly) for (const v of r.shared.uSky.value) v.set(0, 0, 0);
  r.relight();
  r.reset();
  for (let k = 0; k < frames; k++) r.draw(s.controls.camera.height);
  const {width, height, pixels} = r.readRadiance();
  const rgb = new Float32Array(width * height * 3);
  for (let k = 0; k < width * height; k++) for (let c = 0; c < 3; c++) rgb[3 * k + c] = pixels[4 * k + c];
  const bytes = new Uint8Array(rgb.buffer);
  let text = '';
  for (let k = 0; k < bytes.length; k += 32768) text += String.fromCharCode(...bytes.subarray(k, k + 32768));
  return [width, height, btoa(text)];
};
done(true);
"""


def prepare(browser) -> None:
    """Define what `radiance` calls; once for each opened page."""
    browser.execute_async_script(PREPARE)


def radiance(browser, **what) -> np.ndarray:
    """Radiance ``(H, W, 3)`` [cd/m²] of the page at a camera and a time, see `PREPARE`."""
    script = "const done = arguments[1]; measure(arguments[0]).then(done, (e) => done(String(e && e.stack || e)));"
    answer = browser.execute_async_script(script, what)
    if isinstance(answer, str):
        raise RuntimeError(answer)
    width, height, text = answer
    values = np.frombuffer(base64.b64decode(text), np.float32).reshape(height, width, 3)
    return values[::-1].astype(np.float64)


def shrunk(image: np.ndarray, factor: int) -> np.ndarray:
    """Mean of blocks of pixels."""
    height, width = (size // factor for size in image.shape[:2])
    return image.reshape(height, factor, width, factor, -1).mean(axis=(1, 3))
