"""Held-out splits for evaluation, and the check that no evaluated image was used as an input (data leakage)."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from seasonscapes.cameras.observation import Observation, webcam_of
from seasonscapes.errors import SeasonscapesError
from seasonscapes.images import srgb_from_linear

PURPOSES = ("painting", "guidance", "training", "evaluation")
KINDS = ("picture", "view", "hour")


class LeakageError(SeasonscapesError, ValueError):
    """An image to be evaluated was used as an input of the evaluated result."""


@dataclass(frozen=True)
class PictureUse:
    """Use of an image.

    Parameters
    ----------
    webcam
        Id of the webcam; a suffix after a slash denotes a view of the same panorama.
    time
        Time with a UTC offset; compared as an instant.
    purpose
        One of `PURPOSES`: painting, guidance, training or evaluation.
    content
        SHA-256 of the pixels (`content_hash`), or ``None``.

    Raises
    ------
    ValueError
        If the purpose is unknown or the time has no offset.
    """

    webcam: str
    time: datetime
    purpose: str
    content: str | None = None

    def __post_init__(self):
        if self.purpose not in PURPOSES:
            raise ValueError(f"PictureUse: got purpose {self.purpose!r}, expected one of {', '.join(PURPOSES)}")
        if self.time.tzinfo is None:
            raise ValueError(f"PictureUse: {self.webcam} at {self.time}: the time has no UTC offset")

    @property
    def instant(self) -> datetime:
        """Time in UTC."""
        return self.time.astimezone(UTC)


def picture_use(observation: Observation, purpose: str) -> PictureUse:
    """Describe the use of an observation, with the hash of its content.

    Parameters
    ----------
    observation
        Image with webcam and time.
    purpose
        One of `PURPOSES`.

    Returns
    -------
    PictureUse
        Use of the observation.
    """
    return PictureUse(observation.webcam, observation.time, purpose, observation_hash(observation))


def content_hash(levels: np.ndarray) -> str:
    """Compute the SHA-256 of decoded pixels, which is independent of file name and lossless format.

    Parameters
    ----------
    levels
        Image ``(H, W, 3)`` uint8.

    Returns
    -------
    str
        Hexadecimal digest of shape and pixels.

    Raises
    ------
    ValueError
        If the array has another type or number of dimensions.
    """
    levels = np.ascontiguousarray(levels)
    if levels.dtype != np.uint8 or levels.ndim != 3:
        raise ValueError(f"content_hash: got {levels.dtype} of shape {levels.shape}, expected uint8 (H, W, 3)")
    return hashlib.sha256(repr(levels.shape).encode() + levels.tobytes()).hexdigest()


def observation_hash(observation: Observation) -> str:
    """Compute the `content_hash` of the 8-bit image that an observation was decoded from.

    Parameters
    ----------
    observation
        Image, scene-linear.

    Returns
    -------
    str
        Hexadecimal digest.
    """
    levels = np.round(255.0 * srgb_from_linear(np.nan_to_num(observation.image)))
    return content_hash(levels.astype(np.uint8))


def file_content_hash(path: Path) -> str:
    """Compute the `content_hash` of an image file, reduced to 8 bits.

    Parameters
    ----------
    path
        Image file.

    Returns
    -------
    str
        Hexadecimal digest.
    """
    from seasonscapes.images import read_image_linear

    return content_hash(np.round(255.0 * srgb_from_linear(read_image_linear(path))).astype(np.uint8))


def held_out_views(webcams: Sequence[str], count: int, *, seed: int = 0) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Split webcams at random into those to use and those to evaluate; views of one panorama stay together.

    Parameters
    ----------
    webcams
        Names of webcams or of views (``webcam/view``).
    count
        Number of webcams to hold out.
    seed
        Seed of the random selection.

    Returns
    -------
    used, held_out : tuple of str
        Names in the order of ``webcams``.

    Raises
    ------
    ValueError
        If one of the two parts would be empty.
    """
    names = sorted({webcam_of(name) for name in webcams})
    if not 1 <= count < len(names):
        raise ValueError(f"held_out_views: got {count} of {len(names)} webcams, expected 1 to {len(names) - 1}")
    held_out = set(np.random.default_rng(seed).choice(names, count, replace=False).tolist())
    return (
        tuple(name for name in webcams if webcam_of(name) not in held_out),
        tuple(name for name in webcams if webcam_of(name) in held_out),
    )


def held_out_times(
    times: Sequence[datetime], every: int, *, first: int = 1
) -> tuple[tuple[datetime, ...], tuple[datetime, ...]]:
    """Split times into those to use and those to evaluate: every ``every``-th time in order is held out.

    With ``first`` ≥ 1 the earliest time is used, so that no evaluated time precedes all used ones.

    Parameters
    ----------
    times
        Distinct times.
    every
        Period of the held-out times, at least 2.
    first
        Index of the first held-out time.

    Returns
    -------
    used, held_out : tuple of datetime
        Times in order.

    Raises
    ------
    ValueError
        If no time would be held out, ``every`` is less than 2, or times coincide.
    """
    ordered = sorted(times)
    held_out = ordered[first::every] if every >= 2 else []
    if not held_out or len(set(ordered)) != len(ordered):
        raise ValueError(
            f"held_out_times: got every = {every} and {len(ordered)} times, expected distinct times and every ≥ 2"
        )
    return tuple(time for time in ordered if time not in held_out), tuple(held_out)


def check_no_leakage(evaluated: Sequence[PictureUse], used: Sequence[PictureUse], *, kind: str = "picture") -> None:
    """Check that no image to be evaluated was used for painting, guidance or training.

    Parameters
    ----------
    evaluated
        Images to be evaluated.
    used
        Images that were used.
    kind
        Criterion. ``picture``: neither the same pixels nor the same webcam at the same instant; ``view``: in addition
        not the same webcam at any time; ``hour``: in addition not any webcam at the same instant.

    Raises
    ------
    LeakageError
        If a pair of images violates the criterion; the message lists all pairs.
    ValueError
        If the criterion is unknown.
    """
    if kind not in KINDS:
        raise ValueError(f"check_no_leakage: got kind {kind!r}, expected one of {', '.join(KINDS)}")
    leaks = [
        f"{image.webcam} at {image.instant.isoformat()} was used for {other.purpose} ({reason})"
        for image in evaluated
        for other in used
        if (reason := _leak(image, other, kind))
    ]
    if leaks:
        raise LeakageError("evaluation images that are not held out: " + "; ".join(dict.fromkeys(leaks)))


def _leak(evaluated: PictureUse, used: PictureUse, kind: str) -> str | None:
    """Reason why a pair of images violates the criterion, or ``None``."""
    if evaluated.content is not None and evaluated.content == used.content:
        return "the same pixels"
    same_webcam = webcam_of(evaluated.webcam) == webcam_of(used.webcam)
    same_time = evaluated.instant == used.instant
    if same_webcam and same_time:
        return "the same webcam and instant"
    if kind == "view" and same_webcam:
        return f"the same webcam, at {used.instant.isoformat()}"
    if kind == "hour" and same_time:
        return f"the same instant, at {used.webcam}"
    return None
