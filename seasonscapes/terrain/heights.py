"""Numbers of an elevation raster as heights: their unit, and values that no land has."""

from __future__ import annotations

import logging
import os
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.terrain.crs import geodetic_from_map, horizontal_crs
from seasonscapes.terrain.placement import cell_sides_m, centre_deg

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

    from seasonscapes.terrain.surface import Raster

log = logging.getLogger(__name__)

# From the shore of the Dead Sea (-430 m) to above Mount Everest (8,849 m). Heights in feet or centimetres and
# undeclared nodata values usually exceed this range somewhere.
PLAUSIBLE_ELEVATION_M = (-500.0, 9000.0)
UNITS_M = {
    "metre": 1.0,
    "foot": 0.3048,
    "US survey foot": 1200.0 / 3937.0,
    "yard": 0.9144,
    "fathom": 1.8288,
    "kilometre": 1000.0,
    "decimetre": 0.1,
    "centimetre": 0.01,
    "millimetre": 0.001,
}
_ALIASES = {
    "metre": "m metre metres meter meters mt",
    "foot": "ft foot feet international_foot international_feet",
    "US survey foot": "us_ft ft_us ftus usft us_foot us_feet us_survey_foot us_survey_feet us_survey_ft sfoot survey_foot "
    "foot_us u.s._survey_foot",
    "yard": "yd yard yards",
    "fathom": "fath fathom fathoms",
    "kilometre": "km kilometre kilometres kilometer kilometers",
    "decimetre": "dm decimetre decimetres decimeter decimeters",
    "centimetre": "cm centimetre centimetres centimeter centimeters",
    "millimetre": "mm millimetre millimetres millimeter millimeters",
}
_UNIT_OF = {alias: unit for unit, aliases in _ALIASES.items() for alias in aliases.split()}
# Boxes (south, west, north, east) that hold all land above 4,900 m: High Asia, the Andes, Alaska and Yukon, the
# Caucasus with Ararat and Damavand, East Africa, the volcanoes of Mexico.
_HIGHEST_ELSEWHERE_M = 4900.0
_HIGH_LAND_DEG = (
    (20.0, 60.0, 52.0, 112.0),
    (-42.0, -84.0, 13.0, -58.0),
    (58.0, -156.0, 66.0, -134.0),
    (34.0, 38.0, 46.0, 60.0),
    (-6.0, 26.0, 3.0, 42.0),
    (16.0, -104.0, 22.0, -94.0),
)
_FEET_CURE = 'if they are feet, state it: [elevation] unit = "foot" or "US survey foot"; if not, unit = "metre"'


def declared_unit(source: DatasetReader, band: int, path: str) -> str | None:
    """The unit of heights that a file declares by its band or its vertical CRS, as a key of `UNITS_M`.

    Returns
    -------
    str or None
        ``None`` where the file declares none.

    Raises
    ------
    InputError
        A unit that is no length, or two that contradict each other.
    """
    text = (source.units[band - 1] or "").strip()
    by_band = _UNIT_OF.get(text.lower().replace("-", "_").replace(" ", "_"))
    if text and by_band is None:
        raise InputError(
            path,
            "heights in an unknown unit",
            got=text,
            expected=", ".join(UNITS_M),
            cure='state it: [elevation] unit = "metre"',
        )
    by_crs = _vertical_unit(source, path)
    if by_band and by_crs and by_band != by_crs:
        raise InputError(
            path,
            "the band and the vertical CRS declare different units of height",
            got=f"{by_band} and {by_crs}",
            cure=f'state the right one: [elevation] unit = "{by_crs}"',
        )
    return by_band or by_crs


def to_metres(values: np.ndarray, unit: str | None, where: str | os.PathLike[str]) -> np.ndarray:
    """Heights in a unit of `UNITS_M` converted to metres, which is told; ``None`` counts as metres."""
    if unit is None or unit == "metre":
        return values
    log.warning("%s: heights in the unit %s, converted to metres", os.fspath(where), unit)
    return (values * UNITS_M[unit]).astype(np.float32)


def _vertical_unit(source: DatasetReader, path: str) -> str | None:
    """Unit of the vertical axis of a compound or three-dimensional CRS."""
    from pyproj import CRS

    if source.crs is None:
        return None
    crs = CRS.from_user_input(source.crs.to_wkt())
    axes = [axis for part in (crs.sub_crs_list or [crs]) for axis in part.axis_info]
    vertical = next((axis for axis in axes if axis.direction in ("up", "down")), None)
    if vertical is None:
        return None
    if vertical.direction == "down":
        raise InputError(path, "the vertical CRS counts depths, downwards", got=crs.name, expected="heights, upwards")
    factor = vertical.unit_conversion_factor
    unit = min(UNITS_M, key=lambda name: abs(UNITS_M[name] / factor - 1.0))
    if abs(UNITS_M[unit] / factor - 1.0) > 1e-7:
        raise InputError(path, "heights in an unknown unit", got=vertical.unit_name, expected=", ".join(UNITS_M))
    return unit


def check_height_band(source: DatasetReader, band: int, path: str) -> None:
    """Raise `InputError` for a band of colours."""
    from rasterio.enums import ColorInterp

    if source.colorinterp[band - 1] == ColorInterp.palette:
        raise InputError(
            path,
            "a picture with a colour table, not heights",
            cure="take the raster of heights that it was drawn from, or drop the table: gdal_edit.py -colorinterp_1 gray",
        )


def check_heights(raster: Raster, where: str | os.PathLike[str], *, unit: str | None, nodata: float | None) -> None:
    """Refuse heights that no land has, and doubt in words those that hardly any has.

    Parameters
    ----------
    raster
        Heights ``(H, W, 1)`` [m], NaN where there is no data.
    where
        File, for the message.
    unit
        The unit that the file or the scene declares; ``None`` where it is a guess that they are metres.
    nodata
        The value that the scene file states to mean no data; stated, zeros among mountains are heights.

    Raises
    ------
    InputError
        Heights outside −500 … 9000 m, white noise, or zeros among mountains that mean no data.
    """
    heights = raster.values[..., 0]
    known = np.isfinite(heights)
    if not known.any():
        return
    low, high = float(heights[known].min()), float(heights[known].max())
    # A few spikes, which are told as such, do not make a land high.
    summit = float(np.partition(heights[known], -6)[-6:].min()) if known.sum() > 64 else high
    if low < PLAUSIBLE_ELEVATION_M[0] or high > PLAUSIBLE_ELEVATION_M[1]:
        raise InputError(
            os.fspath(where),
            "heights outside the range of land elevations",
            got=f"{low:g} … {high:g}",
            expected=f"{PLAUSIBLE_ELEVATION_M[0]:g} … {PLAUSIBLE_ELEVATION_M[1]:g} m",
            cure="check unit (metres), band, and that the file declares its nodata value",
        )
    spacing_m = float(np.mean(cell_sides_m(raster)))
    _check_noise(heights, spacing_m, where)
    if nodata is None:
        _check_zeros(heights, known, spacing_m, where)
    _doubt_spikes(raster, spacing_m, where)
    if unit is None:
        _doubt_feet(raster, summit, spacing_m, where)


def _check_noise(heights: np.ndarray, spacing_m: float, where: str | os.PathLike[str]) -> None:
    """Of white noise, neighbours differ as much as any two samples do; of land, far less."""
    squares = [np.diff(heights, axis=axis).astype(np.float64) ** 2 for axis in (0, 1)]
    count = sum(int(np.isfinite(square).sum()) for square in squares)
    if count < 128:
        return
    step = sum(float(np.nansum(square)) for square in squares) / count
    variance = float(np.nanvar(heights.astype(np.float64)))
    if step <= spacing_m**2 or step <= 0.7 * 2.0 * variance:
        return
    doubt = InputError(
        os.fspath(where),
        "noise, not heights: neighbouring samples have nothing to do with each other",
        got=f"steps of {np.sqrt(step):.0f} m between samples {spacing_m:.3g} m apart",
        cure="check the band, the data type and the byte order of the file",
    )
    if step > (5.0 * spacing_m) ** 2:
        raise doubt
    log.warning("%s", doubt)


def _check_zeros(heights: np.ndarray, known: np.ndarray, spacing_m: float, where: str | os.PathLike[str]) -> None:
    """Exact zeros whose whole rim is high above them are no lowland or sea but missing data."""
    zero = heights == 0.0
    if not zero.any() or zero[known].all():
        return
    from scipy import ndimage

    labels, count = ndimage.label(zero, structure=np.ones((3, 3), int))  # pyright: ignore[reportGeneralTypeIssues]
    grown = ndimage.maximum_filter(labels, 3)
    rim = (grown > 0) & ~zero & known
    lowest = ndimage.minimum(np.abs(heights), np.where(rim, grown, 0), np.arange(1, count + 1))
    touched = np.isin(np.arange(1, count + 1), grown[rim])
    holes = np.flatnonzero(touched & (np.asarray(lowest) > max(50.0, 2.0 * spacing_m))) + 1
    if len(holes):
        cells = int(np.isin(labels, holes).sum())
        raise InputError(
            os.fspath(where),
            "heights of exactly 0 among mountains are probably missing data",
            got=f"{cells} samples ({100.0 * cells / heights.size:.2g} %)",
            cure="declare them: [elevation] nodata = 0, or gdal_edit.py -a_nodata 0 FILE; if they are heights, state "
            "another value, such as nodata = -9999",
        )


def _doubt_spikes(raster: Raster, spacing_m: float, where: str | os.PathLike[str]) -> None:
    """Warn of single samples far above or below all their neighbours."""
    heights = raster.values[..., 0]
    if min(heights.shape) < 3:
        return
    above, below = np.full_like(heights, -np.inf), np.full_like(heights, np.inf)
    padded = np.pad(heights, 1, constant_values=np.nan)
    rows, columns = heights.shape
    for down in range(3):
        for across in range(3):
            if (down, across) != (1, 1):
                neighbour = padded[down : down + rows, across : across + columns]
                np.fmax(above, neighbour, out=above)
                np.fmin(below, neighbour, out=below)
    with np.errstate(invalid="ignore"):
        excess = np.maximum(heights - above, below - heights)
    excess[~np.isfinite(excess)] = 0.0
    count = int((excess > max(100.0, 4.0 * spacing_m)).sum())
    if count:
        row, column = np.unravel_index(int(np.argmax(excess)), excess.shape)
        x, y = raster.transform * (float(column) + 0.5, float(row) + 0.5)
        latitude, longitude = (float(v) for v in geodetic_from_map(raster.crs, x, y))
        log.warning(
            "%s: %d single samples stand out from all their neighbours, one by %.0f m at %.5f, %.5f: probably errors; "
            "repair them or mark them as nodata",
            os.fspath(where),
            count,
            float(excess[row, column]),
            latitude,
            longitude,
        )


def _doubt_feet(raster: Raster, high: float, spacing_m: float, where: str | os.PathLike[str]) -> None:
    """Warn where heights of no declared unit are more likely feet than metres."""
    height, width = raster.values.shape[:2]
    latitude, longitude = centre_deg(raster.crs, raster.transform, width, height)
    crs = horizontal_crs(raster.crs)
    in_high_land = any(s <= latitude <= n and w <= longitude <= e for s, w, n, e in _HIGH_LAND_DEG)
    reason = ""
    if crs.is_projected and "foot" in crs.axis_info[0].unit_name.lower():
        reason = "its map is in feet, and the unit of its heights is not declared"
    elif high > _HIGHEST_ELSEWHERE_M and not in_high_land:
        reason = f"no land there is as high as {high:.0f} m"
    elif spacing_m >= 5.0 and min(height, width) >= 8 and (steep := _steep_share(raster, spacing_m)) > 0.25:
        reason = f"{100.0 * steep:.0f} % of the land is steeper than 60°"
    if reason:
        log.warning("%s: the heights look like feet (%s); %s", os.fspath(where), reason, _FEET_CURE)


def _steep_share(raster: Raster, spacing_m: float) -> float:
    """Share of a raster's cells with a slope above 60°."""
    down, across = np.gradient(raster.values[..., 0], spacing_m)
    slope = np.hypot(down, across)
    return float(np.mean(slope[np.isfinite(slope)] > np.tan(np.radians(60.0)))) if np.isfinite(slope).any() else 0.0
