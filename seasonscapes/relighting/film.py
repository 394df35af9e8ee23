"""Films: frames in, an H.264 file out, one frame in memory at a time."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from seasonscapes.images import atomic_path, srgb_from_linear


def write_film(
    path: Path, pictures: Iterable[np.ndarray], *, fps: float = 24.0, quality: int = 8, note: str = ""
) -> int:
    """Encode display-linear pictures ``(H, W, 3)`` in [0, 1] as an MP4 that browsers play; returns their number.

    Parameters
    ----------
    pictures
        All of one size; odd rows and columns at the lower and right rim are dropped, as H.264 wants even sizes.
    quality
        0 to 10.
    note
        Kept in the file as its comment.

    Raises
    ------
    ValueError
        Without any picture, or where sizes differ.
    """
    import imageio_ffmpeg

    count, writer, size = 0, None, None
    with atomic_path(path) as temporary:
        try:
            for picture in pictures:
                height, width = picture.shape[0] // 2 * 2, picture.shape[1] // 2 * 2
                if writer is None:
                    size = (width, height)
                    writer = imageio_ffmpeg.write_frames(
                        str(temporary),
                        size,
                        fps=fps,
                        quality=quality,
                        macro_block_size=2,
                        codec="libx264",
                        pix_fmt_out="yuv420p",
                        output_params=["-movflags", "+faststart", "-metadata", f"comment={note}"],
                    )
                    writer.send(None)
                if (width, height) != size:
                    raise ValueError(f"film: a picture of {width} × {height}, expected {size[0]} × {size[1]}")
                # Ordered noise of half a level hides the bands of a smooth sky; H.264 keeps enough of it.
                noise = np.random.default_rng(count).random((height, width, 1), np.float32)
                encoded = srgb_from_linear(picture[:height, :width]) * 255.0 + noise
                writer.send(np.ascontiguousarray(np.clip(encoded, 0.0, 255.0).astype(np.uint8)))
                count += 1
        finally:
            if writer is not None:
                writer.close()
        if count == 0:
            raise ValueError("film: no picture to encode")
    return count
