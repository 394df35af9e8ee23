"""H.264 encoding of image sequences, with one image in memory at a time."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from seasonscapes.images import atomic_path, srgb_from_linear


def write_video(
    path: Path, images: Iterable[np.ndarray], *, fps: float = 24.0, quality: int = 8, comment: str = ""
) -> int:
    """Encode images as an MP4 file (H.264, 4:2:0) that browsers can play.

    Parameters
    ----------
    path
        Output file, written atomically.
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
    """
    import imageio_ffmpeg

    count, writer, size = 0, None, (0, 0)
    with atomic_path(path) as temporary:
        try:
            for image in images:
                height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
                if writer is None:
                    size = (width, height)
                    writer = imageio_ffmpeg.write_frames(
                        str(temporary),
                        size,
                        fps=fps,  # pyright: ignore[reportArgumentType]  # FFmpeg accepts fractions
                        quality=quality,
                        macro_block_size=2,
                        codec="libx264",
                        pix_fmt_out="yuv420p",
                        output_params=["-movflags", "+faststart", "-metadata", f"comment={comment}"],
                    )
                    writer.send(None)
                if (width, height) != size:
                    raise ValueError(
                        f"write_video: got an image of {width} × {height} pixels, expected {size[0]} × {size[1]}"
                    )
                # Dithering against banding in smooth skies; enough of it remains after compression.
                noise = np.random.default_rng(count).random((height, width, 1), np.float32)
                encoded = srgb_from_linear(image[:height, :width]) * 255.0 + noise
                writer.send(np.ascontiguousarray(np.clip(encoded, 0.0, 255.0).astype(np.uint8)))
                count += 1
        finally:
            if writer is not None:
                writer.close()
        if count == 0:
            raise ValueError("write_video: got no images, expected at least one")
    return count
