"""Pictures on disk: exposure and tone curve, PNG, and OpenEXR files with all layers and their provenance."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes import exposure as exposures
from seasonscapes.errors import InputError
from seasonscapes.images import write_exr, write_png
from seasonscapes.photo_look import DAYLIGHT_RGB

if TYPE_CHECKING:
    from seasonscapes.gaussians.splat_view import SplatView
    from seasonscapes.rendering.radiance import RenderedView
    from seasonscapes.terrain.surface import Texture


WHITE_BALANCES = ("sun", "daylight", "none")


def develop(
    picture: RenderedView | SplatView | np.ndarray,
    *,
    exposure: str | float = "auto",
    look: str = "photo",
    white_balance: str = "sun",
) -> np.ndarray:
    """Turn scene-linear radiance into a picture for the screen: exposure, white balance and tone curve.

    Parameters
    ----------
    picture
        A rendered view, or radiance ``(H, W, 3)`` photometric linear Rec.709 [cd/m²].
    exposure
        ``"auto"`` (a camera's metering), ``"eye"`` (an adapted observer), or EV100 (15 is a sunny day).
    look
        ``"photo"`` (the contrast and white balance of a camera) or ``"neutral"`` (linear up to a shoulder).
    white_balance
        Of the look ``"photo"``: ``"sun"`` (the colour of the sun of a rendered view), ``"daylight"`` (5,500 K) or
        ``"none"``.

    Returns
    -------
    numpy.ndarray
        ``(H, W, 3)`` float32, display-linear Rec.709 in [0, 1]; `save_png` encodes it as sRGB.

    Raises
    ------
    ValueError
        For an unknown exposure.
    InputError
        For an unknown look or white balance.

    Examples
    --------
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> grey = ss.develop(np.full((4, 6, 3), 4000.0), exposure=15.0)
    >>> grey.shape, bool(0.0 < grey.mean() < 1.0)
    ((4, 6, 3), True)
    """
    radiance = picture if isinstance(picture, np.ndarray) else picture.radiance
    record = getattr(picture, "provenance", {})
    ev100 = exposures.exposure_ev100(radiance, exposure, look=look)
    white = balance_rgb(white_balance, record.get("white_rgb"))
    return exposures.develop(radiance, ev100, eye=exposure == "eye", look=look, white=white)


def balance_rgb(
    white_balance: str, sun_white: Sequence[float] | None = None, *, where: str = "--white-balance"
) -> tuple[float, float, float] | None:
    """The colour that becomes neutral: of ``sun`` the given one; `InputError` for an unknown white balance."""
    if white_balance not in WHITE_BALANCES:
        raise InputError(where, "unknown white balance", got=white_balance, expected=", ".join(WHITE_BALANCES))
    if white_balance == "daylight":
        return DAYLIGHT_RGB
    if white_balance == "none" or sun_white is None:
        return None
    red, green, blue = sun_white
    return red, green, blue


def save_png(path: str | Path, picture: np.ndarray, *, metadata: Mapping[str, str] | None = None) -> None:
    """Write a display-linear picture as an 8-bit sRGB PNG, atomically.

    Parameters
    ----------
    path
        A ``.png`` file; missing folders are made.
    picture
        ``(H, W, 3)`` display-linear Rec.709 in [0, 1], as `develop` returns it.
    metadata
        Text chunks of the file.

    Raises
    ------
    ValueError
        For arrays of another shape.

    Examples
    --------
    >>> import numpy as np, os, tempfile
    >>> import seasonscapes as ss
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     ss.save_png(f"{folder}/grey.png", np.full((4, 6, 3), 0.2))
    ...     sorted(os.listdir(folder))
    ['grey.png']
    """
    picture = np.asarray(picture)
    if picture.ndim != 3 or picture.shape[2] != 3:
        raise ValueError(f"save_png: got an array {picture.shape}, expected (H, W, 3)")
    write_png(path, picture, metadata=metadata)


def save_exr(
    path: str | Path,
    picture: RenderedView | np.ndarray,
    *,
    albedo: Texture | None = None,
    header: Mapping[str, Any] | None = None,
) -> None:
    """Write scene-linear radiance as OpenEXR: float32, absolute, with layers and provenance.

    Parameters
    ----------
    path
        An ``.exr`` file; missing folders are made.
    picture
        Radiance ``(H, W, 3)`` [cd/m²], or a rendered view: its radiance, surface radiance, coverage (alpha), depth [m],
        position [m, east-north-up], normal and texture coordinates become layers, and its provenance the header.
    albedo
        Of a rendered view: also write the albedo under each pixel, from this texture.
    header
        Further attributes.

    Examples
    --------
    >>> import numpy as np, os, tempfile
    >>> import seasonscapes as ss
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     ss.save_exr(f"{folder}/sky.exr", np.full((4, 6, 3), 3000.0))
    ...     sorted(os.listdir(folder))
    ['sky.exr']
    """
    if isinstance(picture, np.ndarray):
        write_exr(path, {"": picture}, header={"seasonscapes:units": "cd/m2", **(header or {})})
        return
    write_exr(path, view_layers(picture, albedo), header=view_header(picture.provenance) | dict(header or {}))


def view_layers(view: RenderedView, albedo: Texture | None = None) -> dict[str, np.ndarray]:
    """The layers of a rendered view by name; see `save_exr`."""
    from seasonscapes.terrain.surface import sample_texture

    gbuffer = view.gbuffer
    layers = {
        "": view.radiance,
        "surface": view.surface,
        "alpha": view.coverage,
        "depth": gbuffer.depth,
        "position": gbuffer.position,
        "normal": gbuffer.normal,
        "uv": np.nan_to_num(gbuffer.uv, nan=-1.0),
    }
    if albedo is not None:
        layers["albedo"] = sample_texture(albedo.values, gbuffer.uv)
    return layers


def view_header(record: dict) -> dict[str, Any]:
    """Attributes of an OpenEXR file from a view's provenance, the standard ones (date, GPS) among them."""
    header: dict[str, Any] = {
        "seasonscapes:provenance": record,
        "seasonscapes:units": "cd/m2, photometric linear Rec.709; depth is distance along the ray in m",
    }
    if "time_utc" in record:
        header |= {"capDate": record["time_utc"][:19].replace("-", ":").replace("T", " "), "utcOffset": 0.0}
    if "gps" in record:
        gps = record["gps"]
        header |= {"latitude": gps["latitude_deg"], "longitude": gps["longitude_deg"], "altitude": gps["height_m"]}
    names = ("gps", "frame", "world_from_camera", "intrinsics")
    return header | {f"seasonscapes:{name}": record[name] for name in names if name in record}


def png_metadata(record: dict) -> dict[str, str]:
    """Text chunks of a PNG from a record: the record as JSON, and the attribution as copyright."""
    return {"seasonscapes": json.dumps(record, default=float), "Copyright": record.get("attribution", "")}
