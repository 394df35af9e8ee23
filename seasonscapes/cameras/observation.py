"""Timestamped webcam images: manifest, consistency checks, and loading of single observations.

The manifest is a CSV file with one line per image: ``webcam,time_utc,path,bytes,sha256``. It is read without opening
image files (85,000 entries take a second); problems with single images are reported and not fatal.
"""

from __future__ import annotations

import csv
import hashlib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path, PurePath

import numpy as np

from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.cameras.webcam import Webcam
from seasonscapes.declaration import checked_name
from seasonscapes.errors import InputError, UnreadableImage
from seasonscapes.images import atomic_path, picture_size, read_image_linear, read_image_srgb
from seasonscapes.text_files import read_text

COLUMNS = ("webcam", "time_utc", "path", "bytes", "sha256")


@dataclass(frozen=True)
class Observation:
    """A scene-linear image of the scene with its camera and time.

    Parameters
    ----------
    image
        ``(H, W, 3)`` float32 scene-linear Rec.709.
    mask
        ``(H, W)`` bool, True for usable pixels.
    camera
        Calibrated camera or panorama.
    time
        Time of exposure, aware UTC.
    webcam
        Id of the webcam.
    pose_sigma
        Standard deviations of pose parameters, by the names of a calibration record; missing parameters are exact.

    Examples
    --------
    >>> from datetime import UTC, datetime
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> image, mask = np.full((32, 48, 3), 0.2, np.float32), np.ones((32, 48), bool)
    >>> ss.Observation(image, mask, camera, datetime(2024, 7, 20, 11, 30, tzinfo=UTC), "aerial").webcam
    'aerial'
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
        offset = self.time.utcoffset()
        if offset is None or offset.total_seconds() != 0:
            raise ValueError(f"Observation: time {self.time} is not UTC")


@dataclass(frozen=True, slots=True)
class ManifestRow:
    """One image of a manifest.

    Parameters
    ----------
    webcam
        Id of the webcam.
    time
        Time of exposure, aware UTC.
    path
        Image file, relative to the manifest's folder.
    bytes
        File size; ``None`` if unknown.
    sha256
        Hexadecimal SHA-256 checksum; empty if unknown.
    """

    webcam: str
    time: datetime
    path: str
    bytes: int | None = None
    sha256: str = ""


@dataclass(frozen=True, slots=True)
class PictureProblem:
    """A problem with one image.

    Parameters
    ----------
    kind
        One of: unreadable name, unknown webcam, ambiguous time, skipped time, missing, empty, truncated, unreadable,
        wrong size, changed, duplicate time, duplicate picture.
    path
        Image file, relative to its folder.
    detail
        Description for the report.
    """

    kind: str
    path: str
    detail: str


def duplicate_times(rows: Iterable[ManifestRow]) -> list[PictureProblem]:
    """Find rows that repeat the webcam and instant of an earlier row.

    Parameters
    ----------
    rows
        Rows of a manifest.

    Returns
    -------
    list of PictureProblem
        One problem of kind ``duplicate time`` per repeated row.
    """
    first: dict[tuple[str, datetime], ManifestRow] = {}
    problems = []
    for row in rows:
        other = first.setdefault((row.webcam, row.time), row)
        if other is not row:
            problems.append(PictureProblem("duplicate time", row.path, f"same webcam and time as {other.path}"))
    return problems


def write_manifest(path: Path, rows: Iterable[ManifestRow]) -> None:
    """Write a manifest as CSV, atomically; the inverse of `read_manifest`.

    Parameters
    ----------
    path
        File to write.
    rows
        Rows in order.
    """
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for row in rows:
            stamp = row.time.astimezone(UTC).isoformat().replace("+00:00", "Z")
            writer.writerow((row.webcam, stamp, row.path, "" if row.bytes is None else row.bytes, row.sha256))


def read_manifest(path: Path, *, allow_outside: bool = False) -> list[ManifestRow]:
    """Read a manifest, without opening images.

    Parameters
    ----------
    path
        CSV file with the columns ``webcam``, ``time_utc``, ``path`` and optionally ``bytes``, ``sha256``.
    allow_outside
        Permit images outside the manifest's folder.

    Returns
    -------
    list of ManifestRow
        Rows in the order of the file.

    Raises
    ------
    InputError
        The file is missing or not UTF-8, a column is missing, or a line is invalid: no time, a webcam that is no name
        (`declaration.checked_name`), or a path that leads out of the manifest's folder.
    """
    reader = csv.reader(read_text(path).splitlines())
    try:
        header = next(reader, None) or []
        missing = [name for name in COLUMNS[:3] if name not in header]
        if missing:
            raise InputError(path, f"column {missing[0]!r} is missing", expected=",".join(COLUMNS))
        columns = [header.index(name) if name in header else None for name in COLUMNS]
        rows = [_row(path, number, cells, columns) for number, cells in enumerate(reader, 2) if cells]
    except csv.Error as error:
        raise InputError(path, f"line {reader.line_num} is no row of a table: {error}") from None
    if not allow_outside:
        for number, row in enumerate(rows, 1):
            _require_below(row.path, f"{path}: row {number}")
    return rows


def _row(path: Path, number: int, cells: list[str], columns: list[int | None]) -> ManifestRow:
    try:
        webcam, stamp, name, size, digest = ("" if index is None else cells[index].strip() for index in columns)
        time = datetime.fromisoformat(stamp)
        if time.utcoffset() is None:
            raise ValueError(f"time_utc {stamp!r} has no offset")
        if not webcam or not name:
            raise ValueError("webcam or path is empty")
        return ManifestRow(checked_name(webcam), time.astimezone(UTC), name, int(size) if size else None, digest)
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: line {number}", str(error), cure="write e.g. 2024-09-01T10:00:00Z") from None


def _require_below(name: str, where: str) -> None:
    """`InputError` for a name that leads out of the folder that it is relative to."""
    if PurePath(name).is_absolute() or ".." in PurePath(name).parts or not name.isprintable():
        raise InputError(
            where,
            "leads outside the manifest's folder",
            got=name,
            cure="move the pictures below it, or pass --allow-outside",
        )


def check_pictures(
    rows: Sequence[ManifestRow], folder: Path, webcams: Sequence[Webcam], *, decode: bool = False
) -> list[PictureProblem]:
    """Check image files for existence, completeness, size, checksum and duplicates.

    Only headers and the last bytes are read, and checksums where the manifest has them or file sizes coincide.

    Parameters
    ----------
    rows
        Rows of a manifest.
    folder
        Folder that the paths are relative to.
    webcams
        Known webcams, with their image sizes.
    decode
        Whether to decode every image completely, which also detects damage in the middle of a file.

    Returns
    -------
    list of PictureProblem
        All problems found; at most one per file apart from duplicates.
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
        problem = _file_problem(folder / row.path, row, length, size_of[row.webcam], decode)
        if problem:
            problems.append(PictureProblem(problem[0], row.path, problem[1]))
        if length:
            by_length[length].append(row)
    for candidates in by_length.values():
        if len(candidates) > 1:
            problems += _duplicate_contents(candidates, folder)
    return problems


def _file_problem(
    file: Path, row: ManifestRow, length: int, size: tuple[int, int], decode: bool
) -> tuple[str, str] | None:
    """Kind and description of the first problem of a file."""
    if length == 0:
        return "empty", "0 bytes"
    try:
        *found, kind = picture_size(file)
        if decode:
            read_image_srgb(file)
    except UnreadableImage as error:
        return ("truncated" if "truncated" in str(error) else "unreadable"), str(error)
    with open(file, "rb") as stream:
        stream.seek(max(0, length - 64))
        tail = stream.read()
    if (kind == "JPEG" and b"\xff\xd9" not in tail) or (kind == "PNG" and b"IEND" not in tail):
        return "truncated", f"{length} bytes without the {kind} end marker"
    if tuple(found) != size:
        return "wrong size", f"{found[0]} x {found[1]} px; expected {size[0]} x {size[1]}"
    if row.bytes is not None and row.bytes != length:
        return "changed", f"{length} bytes; expected {row.bytes} from the manifest"
    if row.sha256 and file_sha256(file) != row.sha256:
        return "changed", "the checksum differs from the manifest's"
    return None


def _duplicate_contents(rows: Sequence[ManifestRow], folder: Path) -> list[PictureProblem]:
    first: dict[str, str] = {}
    problems = []
    for row in rows:
        other = first.setdefault(file_sha256(folder / row.path), row.path)
        if other != row.path:
            problems.append(
                PictureProblem(
                    "duplicate picture", row.path, f"same content as {other}; the webcam may have been frozen"
                )
            )
    return problems


def file_sha256(path: Path) -> str:
    """Compute the SHA-256 checksum of a file.

    Parameters
    ----------
    path
        File to read.

    Returns
    -------
    str
        Hexadecimal checksum.
    """
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def open_observation(row: ManifestRow, folder: Path, camera: Camera | Panorama) -> Observation:
    """Load the image of a manifest row as an observation with an all-true mask.

    Parameters
    ----------
    row
        Row of a manifest.
    folder
        Folder that the path is relative to.
    camera
        Calibrated camera or panorama of the webcam.

    Returns
    -------
    Observation
        The scene-linear image with camera and time.

    Raises
    ------
    InputError
        The file is missing, or its size differs from the camera's.
    UnreadableImage
        The file cannot be decoded.
    """
    path = folder / row.path
    try:
        image = read_image_linear(path)
    except FileNotFoundError:
        raise InputError(path, "no such picture") from None
    except UnreadableImage as error:
        raise UnreadableImage(f"{error}; download it again or remove it from the manifest") from None
    if image.shape[:2] != (camera.height_px, camera.width_px):
        raise InputError(
            path,
            "the image size differs from the camera's",
            got=f"{image.shape[1]} x {image.shape[0]}",
            expected=f"{camera.width_px} x {camera.height_px}",
        )
    return Observation(image, np.ones(image.shape[:2], bool), camera, row.time, row.webcam)


def webcam_of(name: str) -> str:
    """Return the webcam of a view.

    Parameters
    ----------
    name
        Name of a webcam, or of a view of its panorama (``webcam/view``).

    Returns
    -------
    str
        Id of the webcam.

    Examples
    --------
    >>> from seasonscapes.cameras.observation import webcam_of
    >>> webcam_of("mountain/3")
    'mountain'
    """
    return name.split("/", 1)[0]
