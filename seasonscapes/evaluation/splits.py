"""What is held out, and the proof that it was: no picture that is scored may have been used to make what is scored."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from seasonscapes.cameras.observation import Observation
from seasonscapes.images import srgb_from_linear

PURPOSES = ("painting", "guidance", "training", "evaluation")
KINDS = ("picture", "view", "hour")


class LeakageError(ValueError):
    """A picture that is to be scored was used to make what is scored."""


@dataclass(frozen=True)
class PictureUse:
    """A picture and what it is used for.

    Parameters
    ----------
    webcam
        Its id; what follows a slash is a part of the same panorama.
    time
        Aware; compared as an instant.
    purpose
        painting, guidance, training or evaluation.
    content
        SHA-256 of its pixels (`content_hash`), where they are at hand.
    """

    webcam: str
    time: datetime
    purpose: str
    content: str | None = None

    def __post_init__(self):
        if self.purpose not in PURPOSES:
            raise ValueError(f"Use: purpose {self.purpose!r}, expected one of {', '.join(PURPOSES)}")
        if self.time.tzinfo is None:
            raise ValueError(f"Use: {self.webcam} at {self.time}: the time has no offset")

    @property
    def instant(self) -> datetime:
        return self.time.astimezone(UTC)


def use_of(observation: Observation, purpose: str) -> PictureUse:
    """How an observation is used, with its content."""
    return PictureUse(observation.webcam, observation.time, purpose, observation_hash(observation))


def content_hash(levels: np.ndarray) -> str:
    """SHA-256 of a picture's decoded bytes ``(H, W, 3)`` uint8, so that a copy under another name or as PNG is the same."""
    levels = np.ascontiguousarray(levels)
    if levels.dtype != np.uint8 or levels.ndim != 3:
        raise ValueError(f"content_hash: {levels.dtype} of shape {levels.shape}, expected uint8 (H, W, 3)")
    return hashlib.sha256(repr(levels.shape).encode() + levels.tobytes()).hexdigest()


def observation_hash(observation: Observation) -> str:
    """`content_hash` of the 8-bit picture that an observation was decoded from."""
    levels = np.round(255.0 * srgb_from_linear(np.nan_to_num(observation.image)))
    return content_hash(levels.astype(np.uint8))


def file_content_hash(path: Path) -> str:
    """`content_hash` of a picture file, of 8 bits or reduced to them."""
    from seasonscapes.images import read_image_linear

    return content_hash(np.round(255.0 * srgb_from_linear(read_image_linear(path))).astype(np.uint8))


def held_out_views(webcams: Sequence[str], count: int, *, seed: int = 0) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Webcams to paint with, and ``count`` webcams to score at, drawn at random; views of a panorama stay together.

    Raises
    ------
    ValueError
        Nothing would be left on one of the sides.
    """
    names = sorted({webcam_of(name) for name in webcams})
    if not 1 <= count < len(names):
        raise ValueError(f"held_out_views: {count} of {len(names)} webcams, expected 1 to {len(names) - 1}")
    chosen = set(np.random.default_rng(seed).choice(names, count, replace=False).tolist())
    return (
        tuple(name for name in webcams if webcam_of(name) not in chosen),
        tuple(name for name in webcams if webcam_of(name) in chosen),
    )


def held_out_hours(
    times: Sequence[datetime], every: int, *, first: int = 1
) -> tuple[tuple[datetime, ...], tuple[datetime, ...]]:
    """Times to use, and times to score at: of all in order every ``every``-th, beginning with number ``first``.

    With ``first`` ≥ 1 the day's first hour is used, so that what is scored lies between hours that were seen.
    """
    ordered = sorted(times)
    out = ordered[first::every] if every >= 2 else []
    if not out or len(set(ordered)) != len(ordered):
        raise ValueError(
            f"held_out_hours: every {every} of {len(ordered)} times, expected different times and every ≥ 2"
        )
    return tuple(time for time in ordered if time not in out), tuple(out)


def webcam_of(name: str) -> str:
    """The webcam that a view's name belongs to: ``mountain/3`` is view 3 of the panorama ``mountain``."""
    return name.split("/", 1)[0]


def refuse_leaks(evaluated: Sequence[PictureUse], used: Sequence[PictureUse], *, kind: str = "picture") -> None:
    """Raise `LeakageError` where a picture that is to be scored was used for painting, guidance or training.

    Parameters
    ----------
    kind
        ``picture``: neither the same pixels nor the same webcam at the same instant. ``view``: nor that webcam at any
        time. ``hour``: nor any webcam at that instant.

    Raises
    ------
    Leak
        Names each offending pair.
    """
    if kind not in KINDS:
        raise ValueError(f"refuse_leaks: kind {kind!r}, expected one of {', '.join(KINDS)}")
    found = [
        f"{one.webcam} at {one.instant.isoformat()} was used for {other.purpose} ({why})"
        for one in evaluated
        for other in used
        if (why := _leak(one, other, kind))
    ]
    if found:
        raise LeakageError("evaluation pictures that are not held out: " + "; ".join(dict.fromkeys(found)))


def _leak(one: PictureUse, other: PictureUse, kind: str) -> str | None:
    if one.content is not None and one.content == other.content:
        return "the same pixels"
    same_webcam, same_time = webcam_of(one.webcam) == webcam_of(other.webcam), one.instant == other.instant
    if same_webcam and same_time:
        return "the same webcam and instant"
    if kind == "view" and same_webcam:
        return f"the same webcam, at {other.instant.isoformat()}"
    if kind == "hour" and same_time:
        return f"the same instant, at {other.webcam}"
    return None
