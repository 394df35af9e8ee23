"""What was written is whole, and what is read is what was written: films, frames, built artefacts, files of others."""

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from seasonscapes.relighting.film import write_video
from seasonscapes.relighting.frame_file import is_whole_frame, load_frame, save_frame
from seasonscapes.workflows.frame_claims import frames_claimed

FILM = """import sys, numpy as np
from pathlib import Path
from seasonscapes.errors import InputError
from seasonscapes.relighting.film import write_video
rng = np.random.default_rng(0)
try:
    write_video(Path(sys.argv[1]), (rng.random((64, 96, 3), np.float32) for _ in range(30)))
except InputError as error:
    sys.exit(f"told: {error}")
"""


def flipped(path: Path, at: float = 0.5) -> None:
    """Change one bit of a file."""
    content = bytearray(path.read_bytes())
    content[int(at * len(content))] ^= 0x10
    path.write_bytes(content)


# --------------------------------------------------------------------------------------------------- films


def test_a_film_that_cannot_be_encoded_is_told_and_leaves_no_file(tmp_path):
    film = tmp_path / "film.mp4"
    small = subprocess.run(
        [sys.executable, "-c", FILM, str(film)],
        capture_output=True,
        text=True,
        # No file may grow beyond 4 kB: the encoder ends as on a full disk.
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)),
    )
    assert small.returncode == 1
    assert small.stderr.startswith("told: ")
    assert "could not be encoded" in small.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_film_keeps_what_was_there_where_its_images_fail(tmp_path):
    def images(count):
        yield from (np.full((8, 8, 3), 0.5, np.float32) for _ in range(count))
        raise KeyboardInterrupt

    film = tmp_path / "film.mp4"
    film.write_bytes(b"yesterday's")
    for count in (0, 1, 3):
        with pytest.raises(KeyboardInterrupt):
            write_video(film, images(count))
    assert film.read_bytes() == b"yesterday's"
    assert list(tmp_path.iterdir()) == [film]


# -------------------------------------------------------------------------------------------------- frames


def test_a_damaged_frame_is_not_taken_for_a_whole_one(tmp_path):
    path = tmp_path / "frame.exr"
    radiance = np.random.default_rng(0).random((24, 32, 3), np.float32) * 4000.0
    save_frame(path, radiance, metered_ev100=12.0, provenance={"scene": "x"})
    assert is_whole_frame(path)
    assert np.allclose(load_frame(path)[0], radiance, rtol=1e-3)
    whole = path.read_bytes()
    for at in np.linspace(0.0, 0.999, 60):
        path.write_bytes(whole)
        flipped(path, at)
        # A bit that no pixel and no field depends on may be another.
        if is_whole_frame(path):
            assert np.array_equal(load_frame(path)[0], load_frame_of(whole, tmp_path))
    for cut in (0, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        assert not is_whole_frame(path)
    assert not is_whole_frame(tmp_path)
    assert not is_whole_frame(tmp_path / "none.exr")


def load_frame_of(content: bytes, folder: Path) -> np.ndarray:
    (folder / "whole.exr").write_bytes(content)
    return load_frame(folder / "whole.exr")[0]


def test_frames_that_another_film_needs_are_left_to_it(tmp_path):
    folder, names = tmp_path / "frames-1", ["a.exr", "b.exr", "c.exr"]
    with frames_claimed(folder, names[:2]) as first, frames_claimed(folder, names[1:]) as second:
        for name in names:
            (folder / name).write_text(name)
        first.sweep()
        assert sorted(path.name for path in folder.glob("*.exr")) == ["b.exr", "c.exr"]
        second.sweep()
        assert not list(folder.glob("*.exr"))
    assert not folder.exists()


def test_the_claim_of_a_killed_film_ends_with_it(tmp_path):
    folder = tmp_path / "frames-1"
    script = (
        "import sys, time; from pathlib import Path; from seasonscapes.workflows.frame_claims import frames_claimed\n"
        "with frames_claimed(Path(sys.argv[1]), ['a.exr']):\n    print('here', flush=True)\n    time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", script, str(folder)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "here\n"
        (folder / "a.exr").write_text("a")
        with frames_claimed(folder, ["a.exr"]) as mine:
            mine.sweep()
            assert (folder / "a.exr").is_file(), "the other one lives"
            process.kill()
            process.wait()
            mine.sweep()
    assert not folder.exists()
