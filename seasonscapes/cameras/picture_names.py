"""Photographs listed by the names of their files: layouts of folders, dates, and the cameras' clocks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from zoneinfo import ZoneInfo

from seasonscapes.cameras.observation import ManifestRow, PictureProblem, duplicate_times
from seasonscapes.cameras.webcam import Webcam
from seasonscapes.errors import InputError

# Tried in this order where no layout is given; the one that explains most files is taken. First that of the reference.
KNOWN_LAYOUTS = (
    "{day}/{time}/360/{webcam}",
    "{webcam}/{day}/{time}",
    "{webcam}/{day}T{time}",
    "{webcam}/{day}_{time}",
    "{webcam}_{day}T{time}",
    "{webcam}_{day}_{time}",
    "{day}T{time}",
    "{day}_{time}",
)
_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp"})
# Dates and times with one kind of separator or none; Z marks a time that is UTC already.
_PARTS = {
    "day": r"\d{4}(?P<dash>[-_]?)\d{2}(?P=dash)\d{2}",
    "time": r"\d{2}(?P<colon>[-:_]?)\d{2}(?:(?P=colon)\d{2})?Z?",
    "webcam": r"[^/]+?",
    "any": r"[^/]*",
}
_EXPECTED = "{day} and {time} once each, {webcam} once at most, {any} for anything"


def utc_from_camera_clock(naive: datetime, time_zone: str) -> datetime:
    """Convert the local time of a camera's clock to UTC.

    Parameters
    ----------
    naive
        Local time without offset.
    time_zone
        IANA name of the time zone.

    Returns
    -------
    datetime.datetime
        Aware UTC.

    Raises
    ------
    ValueError
        ``"ambiguous …"`` in the hour that is repeated at the end of daylight saving time, ``"skipped …"`` in the hour
        that is skipped at its start. An error of one hour would displace the sun by 15°.
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
    folder: Path, webcams: Sequence[Webcam], *, layout: str | None = None
) -> tuple[list[ManifestRow], list[PictureProblem]]:
    """List the images below a folder by their file names, without opening them.

    Parameters
    ----------
    folder
        Folder to scan recursively.
    webcams
        Known webcams, with their time zones.
    layout
        Pattern of the path of a picture below the folder. ``{day}`` is a date (2024-09-01, 2024_09_01 or 20240901),
        ``{time}`` a time of the camera's clock (12-00, 12-00-00, 12:00:00, 1200 or 120000; 120000Z is UTC), ``{webcam}``
        an id, which may be left out where there is one webcam, and ``{any}`` whatever else varies. Without a suffix all
        pictures count. Default: that of `KNOWN_LAYOUTS` which fits most files.

    Returns
    -------
    rows
        Images in order of webcam and time.
    problems
        File names that do not match the layout, unknown webcams, ambiguous or skipped local times, several images of
        one webcam and instant.

    Raises
    ------
    InputError
        The folder does not exist, or the layout lacks a placeholder, repeats one or holds an unknown one.
    """
    if not folder.is_dir():
        raise InputError(folder, "no such folder")
    suffixes = _SUFFIXES
    if layout is not None and Path(layout).suffix:
        suffixes = frozenset({Path(layout).suffix.lower()})
    files = [file for file in sorted(folder.rglob("*")) if file.suffix.lower() in suffixes]
    names = [file.relative_to(folder).as_posix() for file in files]
    only = webcams[0].id if len(webcams) == 1 else None
    chosen = _fitting_layout(names, only is not None) if layout is None else layout
    pattern = layout_pattern(chosen, webcam_may_be_missing=only is not None)
    zone_of = {webcam.id: webcam.time_zone for webcam in webcams}
    rows: list[ManifestRow] = []
    problems: list[PictureProblem] = []
    utc_of: dict[tuple[str, str, str], datetime | str] = {}
    for file, name in zip(files, names, strict=True):
        match = pattern.fullmatch(name)
        if not match:
            problems.append(PictureProblem("unreadable name", name, f"expected {chosen}"))
            continue
        webcam = match.groupdict().get("webcam", only)
        if webcam not in zone_of:
            problems.append(PictureProblem("unknown webcam", name, f"{webcam} is not in the scene"))
            continue
        key = (match["day"], match["time"], zone_of[webcam])
        if key not in utc_of:
            utc_of[key] = _utc_or_problem(*key)
        time = utc_of[key]
        if isinstance(time, str):
            kind = time.split(":")[0]
            kind = {"ambiguous": "ambiguous time", "skipped": "skipped time"}.get(kind, kind)
            problems.append(PictureProblem(kind, name, time))
            continue
        rows.append(ManifestRow(webcam, time, name, file.stat().st_size))
    rows.sort(key=lambda row: (row.webcam, row.time, row.path))
    return rows, problems + duplicate_times(rows)


def times_of_names(names: Sequence[str], webcams: Sequence[Webcam], time_zone: str) -> dict[str, datetime]:
    """Times of pictures by their names, in that layout of `KNOWN_LAYOUTS` which most of them have.

    Parameters
    ----------
    names
        Paths of the pictures, with ``/``.
    webcams
        Known webcams, in whose time zones their pictures' names are.
    time_zone
        IANA name of the zone of other pictures' names; names with ``Z`` are in UTC.

    Returns
    -------
    dict
        Time, aware UTC, of each name that states one.

    Raises
    ------
    InputError
        For a date that is none, or a local time that the change of clocks repeats or skips.

    Examples
    --------
    >>> from seasonscapes.cameras.picture_names import times_of_names
    >>> times_of_names(["2024-09-01T1200.jpg"], [], "Europe/Zurich")["2024-09-01T1200.jpg"].isoformat()
    '2024-09-01T10:00:00+00:00'
    """
    pattern = layout_pattern(_fitting_layout(names, single=True), webcam_may_be_missing=True)
    zone_of = {webcam.id: webcam.time_zone for webcam in webcams}
    other = webcams[0].time_zone if len(webcams) == 1 else time_zone
    found = {}
    for name in names:
        if (match := pattern.fullmatch(name)) is not None:
            zone = zone_of.get(match.groupdict().get("webcam", ""), other)
            time = _utc_or_problem(match["day"], match["time"], zone)
            if isinstance(time, str):
                raise InputError(name, time, cure="name it in UTC, with Z behind the time")
            found[name] = time
    return found


def layout_pattern(layout: str, *, webcam_may_be_missing: bool = False) -> re.Pattern[str]:
    """The regular expression of a layout of paths (see `scan_folder`).

    Raises
    ------
    InputError
        A placeholder is missing, repeated or unknown.
    """
    parts = re.split(r"\{(\w*)\}", layout)
    named = parts[1::2]
    needed = {"day", "time"} if webcam_may_be_missing else {"day", "time", "webcam"}
    once = [name for name in named if name != "any"]
    if not needed <= set(once) <= set(_PARTS) or len(once) != len(set(once)):
        expected = _EXPECTED if webcam_may_be_missing else _EXPECTED.replace("once at most", "once")
        raise InputError("--layout", "not a layout of paths", got=layout, expected=expected)
    expression = "".join(
        (_PARTS[part] if part == "any" else f"(?P<{part}>{_PARTS[part]})") if index % 2 else re.escape(part)
        for index, part in enumerate(parts)
    )
    suffix = "" if Path(layout).suffix else r"\.\w+"
    return re.compile(expression + suffix)


def _fitting_layout(names: Sequence[str], single: bool) -> str:
    """The known layout that most files have; the first one where none has."""
    known = [layout for layout in KNOWN_LAYOUTS if single or "{webcam}" in layout]
    patterns = {layout: layout_pattern(layout, webcam_may_be_missing=single) for layout in known}
    return max(known, key=lambda layout: sum(1 for name in names if patterns[layout].fullmatch(name)))


def _utc_or_problem(day: str, time: str, zone: str) -> datetime | str:
    """UTC of a local time in a file name, or a description of the problem."""
    digits, is_utc = re.sub(r"\D", "", day + time), time.endswith("Z")
    try:
        naive = datetime.strptime(digits, "%Y%m%d%H%M%S" if len(digits) == 14 else "%Y%m%d%H%M")
        return naive.replace(tzinfo=UTC) if is_utc else utc_from_camera_clock(naive, zone)
    except ValueError as error:
        text = str(error)
        return text if text.startswith(("ambiguous", "skipped")) else f"unreadable name: {text}"
