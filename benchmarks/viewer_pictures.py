"""Pictures of the page of a place beside path-traced ones: dawn, noon, dusk, a full moon, a winter's day.

    python benchmarks/viewer_pictures.py FOLDER [--scene SCENE] [--camera NAME] [--size WxH] [--spp N]

Each picture shows what the page draws in a headless Chromium on the left and what ``render`` makes of the same view and
instant on the right, both at their own automatic exposure.
"""

from __future__ import annotations

import argparse
import base64
import io
import tempfile
from datetime import datetime
from pathlib import Path

import numpy as np
from PIL import Image
from viewer_browser import chromium, open_page, served, why_no_browser

import seasonscapes as ss
from seasonscapes.images import srgb8_from_linear
from seasonscapes.rendering.backend import use_backend
from seasonscapes.workflows.place import utc_at
from seasonscapes.workflows.viewer import write_folder
from seasonscapes.workflows.viewer_scene import nearest_date, viewer_scene

INSTANTS = {
    "dawn": "2024-07-16T06:10",
    "noon": "2024-07-16T13:30",
    "dusk": "2024-09-16T19:50",
    "full-moon": "2024-09-18T01:20",
    "winter": "2024-01-16T14:30",
}
SHOW = """
const [camera, time, size] = arguments, done = arguments[arguments.length - 1];
const s = seasonscapes, r = s.renderer;
(async () => {
  s.state.paused = true;
  r.resize(...size);
  s.useCamera(camera);
  s.setTime(time, s.sharp);
  await s.state.arriving;
  for (let round = 0; round < 2; round++) {
    r.reset();
    for (let k = 0; k < 16; k++) r.draw(s.controls.camera.height);
    s.expose();
  }
  r.show();
  done([r.gl.domElement.toDataURL("image/png"), r.state.ev]);
})().catch((error) => done(String(error.stack)));
"""


def page_picture(browser, camera: int, time: datetime, size: tuple[int, int]) -> np.ndarray:
    """8-bit picture ``(H, W, 3)`` of the page."""
    answer = browser.execute_async_script(SHOW, camera, time.timestamp() * 1000.0, list(size))
    if isinstance(answer, str):
        raise RuntimeError(answer)
    content = base64.b64decode(answer[0].partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scene", default="alpine")
    parser.add_argument("--camera", default=None)
    parser.add_argument("--size", default="480x320")
    parser.add_argument("--spp", type=int, default=64)
    options = parser.parse_args()
    reason = why_no_browser()
    if reason is not None:
        raise SystemExit(f"benchmarks/viewer_pictures.py: {reason}")
    width, height = (int(side) for side in options.size.split("x"))
    use_backend()
    place = ss.load_place(options.scene)
    scene = viewer_scene(place, sky=ss.sky_model("clear"))
    name = options.camera or place.scene.cameras[0].name
    number = [view.name for view in place.scene.cameras].index(name)
    camera = ss.camera(place, name, size_px=(width, height))
    options.folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "page"
        write_folder(scene, folder, {})
        with served(folder) as address, chromium() as browser:
            open_page(browser, address + "?still&size=96x64")
            for label, text in INSTANTS.items():
                instant = utc_at(place, text)
                shown = page_picture(browser, number, instant, (width, height))
                albedo = ss.scene_albedo(place, nearest_date(scene, instant.date()))
                view = ss.render(place, camera, text, albedo=albedo, spp=options.spp, engine="path")
                pair = np.concatenate([shown, srgb8_from_linear(ss.develop(view))], axis=1)
                Image.fromarray(pair).save(options.folder / f"viewer-{label}.jpg", quality=88)
                print(label, instant.isoformat(), flush=True)


if __name__ == "__main__":
    main()
