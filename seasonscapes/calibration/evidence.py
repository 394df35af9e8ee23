"""Evidence of a camera resection: point correspondences and prior standard deviations of the unknowns."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame, enu_from_geodetic, geodetic_from_enu
from seasonscapes.images import atomic_path
from seasonscapes.text_files import read_text

POINT_COLUMNS = ("name", "x_px", "y_px", "latitude_deg", "longitude_deg", "height_m")


@dataclass(frozen=True)
class Correspondences:
    """Image points and the world points that they correspond to.

    Parameters
    ----------
    pixel
        Image coordinates ``(N, 2)`` [px]: x right, y down, origin at the top left corner of the image.
    position_m
        World coordinates ``(N, 3)``, east-north-up [m].
    names
        One name per point, for reports; ``"1"``, ``"2"``, … if omitted.

    Raises
    ------
    ValueError
        If the shapes do not match, or a coordinate is NaN or infinite.

    Examples
    --------
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> points = ss.Correspondences(np.array([[120.5, 80.0]]), np.array([[310.0, 2050.0, 2890.0]]))
    >>> points.names
    ('1',)
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
        invalid = ~(np.isfinite(pixel).all(1) & np.isfinite(position).all(1))
        if invalid.any():
            raise ValueError(f"Correspondences: point {names[int(np.argmax(invalid))]} holds NaN or infinity")
        object.__setattr__(self, "pixel", pixel)
        object.__setattr__(self, "position_m", position)
        object.__setattr__(self, "names", names)

    def __len__(self) -> int:
        return len(self.pixel)


def select_points(points: Correspondences, index: np.ndarray | Sequence[int] | slice) -> Correspondences:
    """Return a subset of the correspondences.

    Parameters
    ----------
    points
        Correspondences of N points.
    index
        Indices ``(K,)``, boolean mask ``(N,)`` or slice.

    Returns
    -------
    Correspondences
        The K selected points with their names.
    """
    selected = np.arange(len(points))[index]
    return Correspondences(
        points.pixel[selected], points.position_m[selected], tuple(points.names[i] for i in selected)
    )


@dataclass(frozen=True)
class Priors:
    """Standard deviations of the Gaussian priors about the start values: 0 fixes an unknown, infinity omits its prior.

    Parameters
    ----------
    heading_deg, tilt_deg, roll_deg
        Angles [deg].
    horizontal_m, vertical_m
        Position: east and north each, and up [m].
    focal
        Scale of the field of view, relative. The width of a full-circle panorama is fixed; there the scale applies to
        the rows only.
    k1
        Radial distortion coefficient (perspective cameras only).
    horizon_px
        Row of a panorama's horizon [px]: a lens pitched on a level rotation axis shifts it (panoramas only).

    Raises
    ------
    ValueError
        If a standard deviation is negative or NaN.
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
        """Standard deviations ``(9,)`` in the order of `PARAMETERS`."""
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
    """Read correspondences from a CSV file with the columns `POINT_COLUMNS`.

    Parameters
    ----------
    path
        CSV file with a header line; positions are geodetic WGS 84 coordinates.
    frame
        Local frame of the returned positions.

    Returns
    -------
    Correspondences
        The points in file order; a point without a name is numbered.

    Raises
    ------
    InputError
        If the file or a column is missing, or a line (which the message names) holds no valid point.
    """
    try:
        rows = list(csv.DictReader(read_text(path).splitlines()))
    except csv.Error as error:
        raise InputError(path, f"not a table: {error}") from None
    pixel, geodetic, names = [], [], []
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
        geodetic.append(values[2:])
        names.append(row.get("name") or str(number - 1))
    geodetic = np.array(geodetic).reshape(-1, 3)
    position = enu_from_geodetic(frame, geodetic[:, 0], geodetic[:, 1], geodetic[:, 2])
    return Correspondences(np.array(pixel).reshape(-1, 2), position.reshape(-1, 3), tuple(names))


def write_points(path: Path, points: Correspondences, frame: LocalFrame) -> None:
    """Write correspondences to a CSV file that `read_points` reads; the file appears atomically.

    Parameters
    ----------
    path
        File to write.
    points
        Correspondences, positions in ``frame``.
    frame
        Local frame; the file holds geodetic WGS 84 coordinates.
    """
    latitude, longitude, height = geodetic_from_enu(frame, points.position_m)
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(POINT_COLUMNS)
        for i, name in enumerate(points.names):
            x, y = points.pixel[i]
            writer.writerow(
                (name, f"{x:.3f}", f"{y:.3f}", f"{latitude[i]:.9f}", f"{longitude[i]:.9f}", f"{height[i]:.4f}")
            )
