"""Make the film of README: a September day on the bundled massif, every 15 minutes: ``python docs/make_film.py``.

Some minutes on two cores; the undeveloped frames are kept in the workspace, as those of every film are.
"""

from __future__ import annotations

import tempfile
from datetime import datetime, timedelta
from pathlib import Path

from PIL import Image

import seasonscapes as ss

FILM = Path(__file__).parent / "images" / "day.webp"
FIRST, LAST, STEP = datetime(2024, 9, 18, 6, 30), datetime(2024, 9, 18, 20, 30), timedelta(minutes=15)
SIZE_PX = (640, 400)


def main() -> None:
    """Render the frames and write them as an animated WebP."""
    place = ss.load_place("alpine")
    session = ss.relight_session(place, ss.camera(place, "aerial", size_px=SIZE_PX))
    times = [(FIRST + number * STEP).isoformat() for number in range((LAST - FIRST) // STEP + 1)]
    with tempfile.TemporaryDirectory() as folder:
        frames = [Image.open(path).convert("RGB") for path in ss.timelapse(session, times, folder)]
    # Every frame whole: differences to the frame before leave lines in smooth skies.
    frames[0].save(
        FILM, "WEBP", save_all=True, append_images=frames[1:], duration=120, loop=0, quality=72, method=6, kmax=1
    )
    print(f"{FILM}  ({len(frames)} frames, {FILM.stat().st_size / 1e6:.1f} MB)")


if __name__ == "__main__":
    main()
