"""The address of the page of a place: ``…#v=1&t=2024-09-18T17:05Z&cam=46.5979,7.9138,3870,141.3,-11,52&ev=auto``."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from urllib.parse import parse_qs, urlsplit

from seasonscapes.declaration import validate
from seasonscapes.errors import InputError
from seasonscapes.exposure import parse_exposure
from seasonscapes.scene import NamedCamera
from seasonscapes.sky.models import AtmosphereModel, SkyModel

_EXPECTED = "…#v=1&t=2024-09-18T17:05Z&cam=LAT,LON,HEIGHT,HEADING,PITCH,FOV"
_KEYS = ("latitude_deg", "longitude_deg", "height_m", "heading_deg", "pitch_deg", "fov_deg")


@dataclass(frozen=True)
class ViewAddress:
    """What the address of a page states; made by `read_address`.

    Parameters
    ----------
    camera
        The view.
    time
        Aware UTC.
    exposure
        ``"auto"``, or an EV100 as text.
    haze
        Factor of the aerosol's optical depth.
    """

    camera: NamedCamera
    time: datetime
    exposure: str
    haze: float


def read_address(text: str, *, where: str = "--at-url") -> ViewAddress:
    """Read the address of a page, or what stands behind its ``#``.

    Parameters
    ----------
    text
        The address.
    where
        What an error message calls it.

    Raises
    ------
    InputError
        For text that is no such address, or of a later version.

    Examples
    --------
    >>> from seasonscapes.workflows.view_address import read_address
    >>> read_address("http://127.0.0.1/#v=1&t=2024-09-18T17:05Z&cam=46.5979,7.9138,3870,141.3,-11,52").camera.fov_deg
    52.0
    """
    fragment = urlsplit(text).fragment or (text.lstrip("#") if text.lstrip("#").startswith("v=") else "")
    try:
        given = {key: values[-1] for key, values in parse_qs(fragment, max_num_fields=16).items()}
    except ValueError:
        given = {}
    if given.get("v") != "1":
        problem = "is of another version" if "v" in given else "is not the address of a view"
        raise InputError(where, problem, got=text[:200], expected=_EXPECTED)
    try:
        time = datetime.fromisoformat(given.get("t", ""))
        numbers = [float(part) for part in given.get("cam", "").split(",")]
        haze = float(given.get("haze", "1"))
    except ValueError:
        raise InputError(where, "states no time or no camera", got=text[:200], expected=_EXPECTED) from None
    if len(numbers) != len(_KEYS) or time.tzinfo is None or not 0.0 <= haze <= 20.0:
        raise InputError(where, "states no time in UTC or no camera", got=text[:200], expected=_EXPECTED)
    camera = validate({"name": "address", **dict(zip(_KEYS, numbers, strict=True))}, NamedCamera, where=where)
    exposure = given.get("ev", "auto")
    parse_exposure(exposure)
    return ViewAddress(camera, time.astimezone(UTC), exposure, haze)


def hazy_sky(model: SkyModel, haze: float, *, where: str = "--at-url") -> SkyModel:
    """A sky model with ``haze`` times its aerosol.

    Raises
    ------
    InputError
        For a model without aerosol.
    """
    if haze == 1.0:
        return model
    if not isinstance(model, AtmosphereModel):
        raise InputError(where, "states a haze", got=haze, expected="a model of the atmosphere", cure="drop --sky")
    depth = model.aerosol.optical_depth_500nm * haze
    return model.model_copy(update={"aerosol": model.aerosol.model_copy(update={"optical_depth_500nm": depth})})
