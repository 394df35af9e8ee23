"""H.264 encoding of image sequences, with one image in memory at a time."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from fractions import Fraction
from functools import cache
from pathlib import Path

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path, srgb_from_linear

# Of x264's: at this quality the files are as large as those of its default, in a third of the time and with 3 dB more
# deviation from the pictures, of which none is visible (49 dB).
_PRESET = "veryfast"
# Of the table of levels: reading it takes half of the time of the powers of every pixel.
_STEPS = 65535


def write_video(
    path: Path, images: Iterable[np.ndarray], *, fps: float = 24.0, quality: int = 8, comment: str = ""
) -> int:
    """Encode images as an MP4 file (H.264, 4:2:0) that browsers can play.

    Parameters
    ----------
    path
        Output file, written atomically: it appears when the encoder has finished and all of its images are in it.
    images
        Display-linear images ``(H, W, 3)`` in [0, 1], all of the same size. H.264 requires even sizes: an odd last row
        or column is dropped.
    fps
        Frames per second.
    quality
        0 to 10.
    comment
        Comment in the metadata of the file.

    Returns
    -------
    int
        Number of encoded images.

    Raises
    ------
    ValueError
        If there is no image, or the sizes differ.
    InputError
        If the encoder fails, such as on a full disk; no file is left then.
    """
    count, encoder, size = 0, None, (0, 0)
    with atomic_path(path) as temporary, tempfile.TemporaryFile() as messages:
        try:
            for image in images:
                height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
                if encoder is None:
                    size = (width, height)
                    command = _command(temporary, size, fps, quality, comment)
                    # In a session of its own: Ctrl-C reaches this program alone, which then ends the encoder.
                    encoder = subprocess.Popen(
                        command, stdin=subprocess.PIPE, stdout=messages, stderr=messages, start_new_session=True
                    )
                if (width, height) != size:
                    raise ValueError(
                        f"write_video: got an image of {width} × {height} pixels, expected {size[0]} × {size[1]}"
                    )
                # Dithering against banding in smooth skies; enough of it remains after compression.
                noise = np.random.default_rng(count).random((height, width, 1), np.float32)
                assert encoder.stdin is not None
                encoder.stdin.write(_levels(image[:height, :width], noise).tobytes())
                count += 1
            if encoder is None:
                raise ValueError("write_video: got no images, expected at least one")
            # Closes its input, which ends the encoding, and waits for its end.
            encoder.communicate()
            code = encoder.returncode
        except BrokenPipeError:
            # The encoder ended before it had all images.
            code = None if encoder is None else encoder.wait()
        finally:
            if encoder is not None:
                encoder.kill()
                encoder.wait()
                assert encoder.stdin is not None
                with suppress(OSError):
                    encoder.stdin.close()
        if code != 0 or _frame_count(temporary) != count:
            messages.seek(0)
            told = messages.read().decode(errors="replace").strip().splitlines()
            raise InputError(
                path,
                f"the film could not be encoded: {told[-1] if told else f'the encoder ended with code {code}'}",
                cure="see whether the disk is full, then start again",
            )
    return count


def _levels(image: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """sRGB levels ``(H, W, 3)``, uint8, of display-linear values with dithering noise ``(H, W, 1)`` in [0, 1)."""
    import cv2  # slow to load

    steps = np.multiply(image, np.float32(_STEPS), dtype=np.float32)
    np.clip(steps, 0.0, _STEPS, out=steps)
    steps += 0.5
    levels = _level_table().take(steps.astype(np.uint16))
    # Three channels in memory: numpy takes several times as long to broadcast along the last axis.
    levels += cv2.merge([noise, noise, noise])
    return np.minimum(levels, 255.0, out=levels).astype(np.uint8)


@cache
def _level_table() -> np.ndarray:
    """sRGB levels, 0 to 255, of ``_STEPS + 1`` equidistant values from 0 to 1: neighbours differ by 0.05 at most."""
    return np.asarray(srgb_from_linear(np.linspace(0.0, 1.0, _STEPS + 1)) * 255.0, np.float32)


def _command(output: Path, size: tuple[int, int], fps: float, quality: int, comment: str) -> list[str]:
    import imageio_ffmpeg

    # Constant rate factor of x264: 0 is lossless, 51 the worst.
    rate_factor = int((1.0 - quality / 10.0) * 51.0)
    return [
        *(imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}"),
        *("-r", str(Fraction(fps).limit_denominator()), "-i", "-"),
        *("-an", "-c:v", "libx264", "-preset", _PRESET, "-pix_fmt", "yuv420p", "-crf", str(rate_factor)),
        *("-movflags", "+faststart", "-metadata", f"comment={comment}", str(output)),
    ]


def _frame_count(path: Path) -> int:
    """Number of images in a film; 0 where it cannot be read."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path), "-map", "0:v:0", "-c", "copy"]
    done = subprocess.run([*command, "-f", "null", "-progress", "-", "-"], capture_output=True, text=True)
    frames = [int(line[6:]) for line in done.stdout.splitlines() if line.startswith("frame=")]
    return frames[-1] if done.returncode == 0 and frames else 0
