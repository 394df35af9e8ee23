"""Timestamped pictures: the manifest that lists them, its checks, and one of them opened.

The manifest is a CSV a person can read, one line a picture: ``webcam,time_utc,path,bytes,sha256``. It is read without
opening a single picture, so that 85,000 of them take a second; what is wrong with some is reported, never fatal.
"""

from __future__ import annotations

import csv
import hashlib
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np

from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.cameras.webcam import Webcam
from seasonscapes.declaration import InputError
from seasonscapes.images import atomic_path, read_image_linear

COLUMNS = ("webcam", "time_utc", "path", "bytes", "sha256")
# The folder layout of the reference repository; each name stands for one part of a path.
REFERENCE_LAYOUT = "{day}/{time}/360/{webcam}.jpg"
_PARTS = {"day": r"\d{4}-\d{2}-\d{2}", "time": r"\d{2}[-:]\d{2}(?:[-:]\d{2})?", "webcam": r"[^/]+"}


@dataclass(frozen=True)
class Observation:
    """A picture of the scene, ready for use.

    Parameters
    ----------
    image
        ``(H, W, 3)`` float32 scene-linear Rec.709.
    mask
        ``(H, W)`` bool, True = usable.
    camera
        The calibrated view.
    time
        Aware, UTC.
    webcam
        Id of the webcam it came from.
    pose_sigma
        Standard deviations of the pose by the names of a calibration record; missing ones count as exact.
    """

    image: np.ndarray
    mask: np.ndarray
    camera: Camera | Panorama
    time: datetime
    webcam: str
    pose_sigma: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self):
        size = (self.camera.height_px, self.camera.width_px)
        if self.image.shape != (*size, 3) or self.mask.shape != size:
            raise ValueError(f"Observation: image {self.image.shape} and mask {self.mask.shape}, camera {size}")
        if self.time.utcoffset() is None or self.time.utcoffset().total_seconds() != 0:
            raise ValueError(f"Observation: time {self.time} is not UTC")


@dataclass(frozen=True, slots=True)
class ManifestRow:
    """One picture that exists somewhere: ``path`` relative to the manifest's folder; size and checksum when known."""

    webcam: str
    time: datetime
    path: str
    bytes: int | None = None
    sha256: str = ""


@dataclass(frozen=True, slots=True)
class PictureProblem:
    """What is wrong with one picture.

    ``kind`` is one of: unreadable name, unknown webcam, ambiguous time, skipped time, missing, empty, truncated,
    unreadable, wrong size, changed, duplicate time, duplicate picture.
    """

    kind: str
    path: str
    detail: str


def utc_from_camera_clock(naive: datetime, time_zone: str) -> datetime:
    """UTC of a camera's wall time.

    Raises
    ------
    ValueError
        ``"ambiguous …"`` in the hour that daylight saving repeats, ``"skipped …"`` in the one it leaves out: a guess
        would put the sun 15° off.
    """
    zone = ZoneInfo(time_zone)
    early, late = (naive.replace(tzinfo=zone, fold=fold) for fold in (0, 1))
    if early.utcoffset() != late.utcoffset():
        exists = early.astimezone(UTC).astimezone(zone).replace(tzinfo=None) == naive
        kind = "ambiguous" if exists else "skipped"
        raise ValueError(
            f"{kind}: {naive.isoformat()} {'happens twice' if exists else 'does not exist'} in {time_zone}"
        )
    return early.astimezone(UTC)


def scan_folder(
    folder: Path, webcams: Sequence[Webcam], *, layout: str = REFERENCE_LAYOUT
) -> tuple[list[ManifestRow], list[PictureProblem]]:
    """List the pictures below a folder by their names alone; no picture is opened.

    Parameters
    ----------
    layout
        Path pattern of ``{day}`` (2024-09-01), ``{time}`` (12-00-00, camera clock) and ``{webcam}``.

    Returns
    -------
    tuple
        Rows in order of webcam and time, and problems: names that do not fit, unknown webcams, times that daylight
        saving skips or repeats, two pictures of one webcam and instant.
    """
    if not folder.is_dir():
        raise InputError(folder, "no such folder")
    zone_of = {webcam.id: webcam.time_zone for webcam in webcams}
    parts = re.split(r"\{(day|time|webcam)\}", layout)
    pattern = re.compile("".join(f"(?P<{p}>{_PARTS[p]})" if i % 2 else re.escape(p) for i, p in enumerate(parts)))
    if set(parts[1::2]) != set(_PARTS):
        raise ValueError(f"layout {layout!r} needs each of {{day}}, {{time}} and {{webcam}} once")
    suffix = Path(layout).suffix.lower()
    rows, problems, resolved = [], [], {}
    for file in sorted(folder.rglob("*")):
        if file.suffix.lower() != suffix:
            continue
        name = file.relative_to(folder).as_posix()
        match = pattern.fullmatch(name)
        if not match:
            problems.append(PictureProblem("unreadable name", name, f"expected {layout}"))
            continue
        if match["webcam"] not in zone_of:
            problems.append(PictureProblem("unknown webcam", name, f"{match['webcam']} is not in the scene"))
            continue
        key = (match["day"], match["time"], zone_of[match["webcam"]])
        if key not in resolved:
            resolved[key] = _resolve(*key)
        if isinstance(resolved[key], str):
            kind = resolved[key].split(":")[0]
            problems.append(
                PictureProblem(
                    {"ambiguous": "ambiguous time", "skipped": "skipped time"}.get(kind, kind), name, resolved[key]
                )
            )
            continue
        rows.append(ManifestRow(match["webcam"], resolved[key], name, file.stat().st_size))
    rows.sort(key=lambda row: (row.webcam, row.time, row.path))
    return rows, problems + duplicate_times(rows)


def _resolve(day: str, time: str, zone: str) -> datetime | str:
    try:
        return utc_from_camera_clock(datetime.fromisoformat(f"{day}T{time.replace('-', ':')}"), zone)
    except ValueError as error:
        text = str(error)
        return text if text.startswith(("ambiguous", "skipped")) else f"unreadable name: {text}"


def duplicate_times(rows: Iterable[ManifestRow]) -> list[PictureProblem]:
    """Rows that repeat an earlier row's webcam and instant."""
    first: dict = {}
    problems = []
    for row in rows:
        other = first.setdefault((row.webcam, row.time), row)
        if other is not row:
            problems.append(PictureProblem("duplicate time", row.path, f"same webcam and time as {other.path}"))
    return problems


def write_manifest(path: Path, rows: Iterable[ManifestRow]) -> None:
    """Write the CSV, atomically; the inverse of `read_manifest`."""
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            stamp = row.time.astimezone(UTC).isoformat().replace("+00:00", "Z")
            writer.writerow((row.webcam, stamp, row.path, "" if row.bytes is None else row.bytes, row.sha256))


def read_manifest(path: Path) -> list[ManifestRow]:
    """Rows of a manifest; no picture is opened. `InputError` names the line that does not parse."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            header = next(reader, None)
            missing = [name for name in COLUMNS[:3] if name not in (header or [])]
            if missing:
                raise InputError(path, f"column {missing[0]!r} is missing", expected=",".join(COLUMNS))
            place = [header.index(name) if name in header else None for name in COLUMNS]
            return [_row(path, number, cells, place) for number, cells in enumerate(reader, 2) if cells]
    except FileNotFoundError:
        raise InputError(path, "no such file") from None
    except UnicodeDecodeError as error:
        raise InputError(path, f"not UTF-8 text: {error}") from None


def _row(path: Path, number: int, cells: list[str], place: list[int | None]) -> ManifestRow:
    try:
        webcam, stamp, name, size, digest = ("" if index is None else cells[index].strip() for index in place)
        time = datetime.fromisoformat(stamp)
        if time.utcoffset() is None:
            raise ValueError(f"time_utc {stamp!r} has no offset")
        if not webcam or not name:
            raise ValueError("webcam or path is empty")
        return ManifestRow(webcam, time.astimezone(UTC), name, int(size) if size else None, digest)
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: line {number}", str(error), cure="write e.g. 2024-09-01T10:00:00Z") from None


def check_pictures(
    rows: Sequence[ManifestRow], folder: Path, webcams: Sequence[Webcam], *, decode: bool = False
) -> list[PictureProblem]:
    """Look at the pictures' files: there, whole, of the webcam's size, and each a different one.

    Only headers and last bytes are read; equal contents are looked for among files of equal length. ``decode`` opens
    every picture in full, which also finds damage in the middle.
    """
    size_of = {webcam.id: (webcam.width_px, webcam.height_px) for webcam in webcams}
    problems = duplicate_times(rows)
    by_length = defaultdict(list)
    for row in rows:
        if row.webcam not in size_of:
            problems.append(PictureProblem("unknown webcam", row.path, f"{row.webcam} is not in the scene"))
            continue
        try:
            length = (folder / row.path).stat().st_size
        except FileNotFoundError:
            problems.append(PictureProblem("missing", row.path, "no such file"))
            continue
        fault = _fault(folder / row.path, row, length, size_of[row.webcam], decode)
        if fault:
            problems.append(PictureProblem(fault[0], row.path, fault[1]))
        if length:
            by_length[length].append(row)
    for same in by_length.values():
        if len(same) > 1:
            problems += _equal_contents(same, folder)
    return problems


def _fault(file: Path, row: ManifestRow, length: int, size: tuple[int, int], decode: bool) -> tuple[str, str] | None:
    from PIL import Image

    if length == 0:
        return "empty", "0 bytes"
    try:
        with Image.open(file) as picture:
            found, kind = picture.size, picture.format
            if decode:
                picture.load()
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        return ("truncated" if "truncated" in str(error) else "unreadable"), str(error)
    with open(file, "rb") as stream:
        stream.seek(max(0, length - 64))
        tail = stream.read()
    if (kind == "JPEG" and b"\xff\xd9" not in tail) or (kind == "PNG" and b"IEND" not in tail):
        return "truncated", f"{length} bytes end without the {kind} end marker"
    if found != size:
        return "wrong size", f"{found[0]} x {found[1]} px, the webcam has {size[0]} x {size[1]}"
    if row.bytes is not None and row.bytes != length:
        return "changed", f"{length} bytes, the manifest says {row.bytes}"
    if row.sha256 and file_sha256(file) != row.sha256:
        return "changed", "the checksum differs from the manifest's"
    return None


def _equal_contents(rows: Sequence[ManifestRow], folder: Path) -> list[PictureProblem]:
    first: dict[str, str] = {}
    problems = []
    for row in rows:
        other = first.setdefault(file_sha256(folder / row.path), row.path)
        if other != row.path:
            problems.append(
                PictureProblem("duplicate picture", row.path, f"same content as {other}: the camera stood still?")
            )
    return problems


def file_sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def open_observation(row: ManifestRow, folder: Path, camera: Camera | Panorama) -> Observation:
    """Open one picture of a perspective view; `InputError` where it is missing, damaged or of another size."""
    path = folder / row.path
    try:
        image = read_image_linear(path)
    except FileNotFoundError:
        raise InputError(path, "no such picture") from None
    except ValueError:
        raise InputError(
            path, "not a readable picture", cure="fetch it again, or take it out of the manifest"
        ) from None
    if image.shape[:2] != (camera.height_px, camera.width_px):
        raise InputError(
            path,
            "the picture has another size than its camera",
            got=f"{image.shape[1]} x {image.shape[0]}",
            expected=f"{camera.width_px} x {camera.height_px}",
        )
    return Observation(image, np.ones(image.shape[:2], bool), camera, row.time, row.webcam)
