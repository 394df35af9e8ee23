"""What a calibration rests on: points matched by hand, and how far each unknown is trusted beforehand."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame, enu_from_geodetic, geodetic_from_enu
from seasonscapes.images import atomic_path

POINT_COLUMNS = ("name", "x_px", "y_px", "latitude_deg", "longitude_deg", "height_m")


@dataclass(frozen=True)
class Correspondences:
    """Matched points: where each is in the picture and in the world.

    Parameters
    ----------
    pixel
        ``(N, 2)`` x right, y down, origin at the picture's top left corner [px].
    position_m
        ``(N, 3)`` east-north-up [m].
    names
        One for each, for reports; numbered when left out.
    """

    pixel: np.ndarray
    position_m: np.ndarray
    names: tuple[str, ...] = ()

    def __post_init__(self):
        pixel, position = np.asarray(self.pixel, float), np.asarray(self.position_m, float)
        if pixel.ndim != 2 or pixel.shape[1] != 2 or position.shape != (len(pixel), 3):
            raise ValueError(
                f"Correspondences: pixel {pixel.shape} and position {position.shape}, expected (N, 2), (N, 3)"
            )
        names = tuple(self.names) or tuple(str(i + 1) for i in range(len(pixel)))
        if len(names) != len(pixel):
            raise ValueError(f"Correspondences: {len(names)} names for {len(pixel)} points")
        bad = ~(np.isfinite(pixel).all(1) & np.isfinite(position).all(1))
        if bad.any():
            raise ValueError(f"Correspondences: point {names[int(np.argmax(bad))]} holds NaN or infinity")
        object.__setattr__(self, "pixel", pixel)
        object.__setattr__(self, "position_m", position)
        object.__setattr__(self, "names", names)

    def __len__(self) -> int:
        return len(self.pixel)


def take(points: Correspondences, index) -> Correspondences:
    """Some of the points, by index or mask."""
    keep = np.arange(len(points))[index]
    return Correspondences(points.pixel[keep], points.position_m[keep], tuple(points.names[i] for i in keep))


@dataclass(frozen=True)
class Priors:
    """One standard deviation of each unknown about its start: 0 holds it fixed, infinity leaves it to the evidence.

    Parameters
    ----------
    heading_deg, tilt_deg, roll_deg
        Angles [deg].
    horizontal_m, vertical_m
        Position, each of east and north, and up [m].
    focal
        Field-of-view scale, relative. The width of a full circle is known; there it scales the rows alone.
    k1
        Radial term (perspective cameras only).
    horizon_px
        Row of a panorama's own horizon: a lens pitched on a level axis moves it (panoramas only).
    """

    heading_deg: float = np.inf
    tilt_deg: float = np.inf
    roll_deg: float = np.inf
    horizontal_m: float = 10.0
    vertical_m: float = 10.0
    focal: float = np.inf
    k1: float = 0.0
    horizon_px: float = 0.0

    def __post_init__(self):
        if any(np.isnan(value) or value < 0 for value in self.sigmas):
            raise ValueError(f"Priors: standard deviations must not be negative or NaN: {self}")

    @property
    def sigmas(self) -> np.ndarray:
        """In the order of `PARAMETERS`, ``(9,)``."""
        return np.array(
            [
                self.heading_deg,
                self.tilt_deg,
                self.roll_deg,
                self.horizontal_m,
                self.horizontal_m,
                self.vertical_m,
                self.focal,
                self.k1,
                self.horizon_px,
            ],
            float,
        )


# The unknowns of a calibration, in order. `focal` is the logarithm of the field-of-view scale, `horizon_px` an offset.
PARAMETERS = ("heading_deg", "tilt_deg", "roll_deg", "east_m", "north_m", "up_m", "focal", "k1", "horizon_px")


def read_points(path: Path, frame: LocalFrame) -> Correspondences:
    """Read ``name,x_px,y_px,latitude_deg,longitude_deg,height_m``; `InputError` names the line that is wrong."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except FileNotFoundError:
        raise InputError(path, "no such file") from None
    pixel, place, names = [], [], []
    for number, row in enumerate(rows, 2):
        try:
            values = [float(row[column]) for column in POINT_COLUMNS[1:]]
            if not np.isfinite(values).all():
                raise ValueError("NaN or infinity")
        except KeyError as error:
            raise InputError(path, f"column {error} is missing", expected=",".join(POINT_COLUMNS)) from None
        except (TypeError, ValueError) as error:
            raise InputError(f"{path}: line {number}", f"not a point: {error}") from None
        pixel.append(values[:2])
        place.append(values[2:])
        names.append(row.get("name") or str(number - 1))
    place = np.array(place).reshape(-1, 3)
    position = enu_from_geodetic(frame, place[:, 0], place[:, 1], place[:, 2])
    return Correspondences(np.array(pixel).reshape(-1, 2), position.reshape(-1, 3), tuple(names))


def write_points(path: Path, points: Correspondences, frame: LocalFrame) -> None:
    """Write what `read_points` reads, atomically."""
    latitude, longitude, height = geodetic_from_enu(frame, points.position_m)
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(POINT_COLUMNS)
        for i, name in enumerate(points.names):
            x, y = points.pixel[i]
            writer.writerow(
                (name, f"{x:.3f}", f"{y:.3f}", f"{latitude[i]:.9f}", f"{longitude[i]:.9f}", f"{height[i]:.4f}")
            )
