"""Sky models as declarations: what a file in ``sun_models/`` says, overrides from the command line, valid ranges."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, field_validator

from seasonscapes.bundled import bundled_path
from seasonscapes.declaration import Declaration, InputError, read_toml, validate
from seasonscapes.sky.atmosphere import (
    Atmosphere,
    aerosol_optical_depth_from_turbidity,
    aerosol_optical_depth_from_visibility,
    visibility_from_atmosphere,
)

Interval = Annotated[list[float], Field(min_length=2, max_length=2)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class Valid(Declaration):
    """Where a model holds, ``[low, high]`` each. A parameter that is not listed is one the model does not know.

    Parameters
    ----------
    sun_elevation_deg
        Of the apparent sun [deg].
    height_m
        Of the observer [m].
    turbidity, visibility_km, ozone_du
        Of the overrides.
    """

    sun_elevation_deg: Interval
    height_m: Interval
    turbidity: Interval | None = None
    visibility_km: Interval | None = None
    ozone_du: Interval | None = None

    @field_validator("*")
    @classmethod
    def _ordered(cls, value: list[float] | None) -> list[float] | None:
        if value is not None and not value[0] < value[1]:
            raise ValueError(f"expected [low, high], got {value}")
        return value


class Aerosol(Declaration):
    """Haze or dust: its vertical optical depth, how that falls with wavelength and height, how it scatters."""

    optical_depth_500nm: float = Field(ge=0.0, le=5.0)
    angstrom_exponent: float = Field(ge=-1.0, le=4.0)
    scale_height_m: float = Field(ge=50.0, le=20_000.0)
    single_scattering_albedo: Share
    asymmetry: float = Field(ge=0.0, le=0.85)


class Ozone(Declaration):
    """The ozone column, in Dobson units."""

    column_du: float = Field(ge=0.0, le=1000.0)


class GroundModel(Declaration):
    """What lies below the sky: its mean albedo, and the height of the lowland from which haze counts [m]."""

    albedo: Share
    height_m: float = Field(default=0.0, ge=-500.0, le=6000.0)


class SkyModel(Declaration):
    """What every sky model says.

    Parameters
    ----------
    name
        The file's stem, where the file does not say it.
    description, sources
        For people; where the numbers come from.
    ground, valid
        See `GroundModel`, `Valid`.
    cloudiness
        Share of the sky that clouds cover, in [0, 1]; see `sky.clouds`.
    """

    name: str = ""
    description: str
    sources: list[str] = Field(min_length=1)
    ground: GroundModel
    valid: Valid
    cloudiness: Share = 0.0


class AtmosphereModel(SkyModel):
    """Clear or hazy air at any hour, spectral and with multiple scattering (`sky.clear_sky`)."""

    kind: Literal["atmosphere"] = "atmosphere"
    aerosol: Aerosol
    ozone: Ozone


class OvercastModel(SkyModel):
    """A closed layer of cloud at any hour (`sky.overcast`)."""

    kind: Literal["overcast"] = "overcast"
    distribution: Literal["standard", "intermediate"] = "standard"
    visibility_km: float = Field(gt=0.0, le=300.0)


class HosekModel(SkyModel):
    """The Hosek-Wilkie sky, evaluated by the renderer (`rendering.hosek`)."""

    kind: Literal["hosek"] = "hosek"
    turbidity: float = Field(ge=1.0, le=10.0)


KINDS: dict[str, type[SkyModel]] = {"atmosphere": AtmosphereModel, "overcast": OvercastModel, "hosek": HosekModel}


def read_sky_model(name_or_path: str | Path) -> SkyModel:
    """A bundled sky model by its name (``clear``), or one from a TOML file.

    Raises
    ------
    InputError
        One line: no such model, or what is wrong in the file.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml" and not path.is_file():
        path = bundled_path("sun_models", str(name_or_path))
    table = read_toml(path)
    kind = table.get("kind")
    if kind not in KINDS:
        raise InputError(
            f"{path}: kind",
            "no such kind of sky model" if "kind" in table else "missing key",
            got=kind,
            expected="one of " + ", ".join(KINDS),
        )
    model = validate(table, KINDS[kind], where=path)
    return model if model.name else model.model_copy(update={"name": path.stem})


def with_overrides(
    model: SkyModel,
    *,
    turbidity: float | None = None,
    visibility_km: float | None = None,
    ozone_du: float | None = None,
    cloudiness: float | None = None,
) -> SkyModel:
    """The model with the flags of the command line applied.

    Parameters
    ----------
    turbidity
        ``(τ_gas + τ_haze) / τ_gas`` at sea level and 550 nm (Preetham et al. 1999).
    visibility_km
        Meteorological range at the height of the model's ground, 2 % contrast at 550 nm [km].
    ozone_du
        Ozone column [DU].
    cloudiness
        Share of the sky covered, in [0, 1].

    Raises
    ------
    InputError
        For a value outside the model's range, a parameter it does not know, or two that set the same thing.
    """
    given = {"turbidity": turbidity, "visibility_km": visibility_km, "ozone_du": ozone_du}
    for parameter, value in given.items():
        if value is not None:
            _check_override(model, parameter, value)
    if turbidity is not None and visibility_km is not None:
        raise InputError("--turbidity", "and --visibility-km both set the haze", cure="give one of them")
    if cloudiness is not None:
        if not 0.0 <= cloudiness <= 1.0:
            raise InputError("--cloudiness", "out of range", got=cloudiness, expected="0 to 1")
        if isinstance(model, OvercastModel):
            raise InputError(
                "--cloudiness",
                f"sky model '{model.name}' is a closed layer already",
                cure="choose a clear model, such as --sky clear",
            )
        model = model.model_copy(update={"cloudiness": float(cloudiness)})
    if isinstance(model, AtmosphereModel):
        return _hazed(model, turbidity, visibility_km, ozone_du)
    if isinstance(model, OvercastModel) and visibility_km is not None:
        return model.model_copy(update={"visibility_km": float(visibility_km)})
    if isinstance(model, HosekModel) and turbidity is not None:
        return model.model_copy(update={"turbidity": float(turbidity)})
    return model


def check_valid(model: SkyModel, sun_elevation_deg: float, height_m: float) -> None:
    """`InputError`, one line, where the sun or the observer is outside the model's range."""
    low, high = model.valid.sun_elevation_deg
    if not low <= sun_elevation_deg <= high:
        cure = "choose an atmosphere model, such as --sky clear" if isinstance(model, HosekModel) else None
        raise InputError(
            f"sky model '{model.name}'",
            f"the sun stands at {sun_elevation_deg:.2f}°",
            expected=f"{low:g}° to {high:g}°",
            cure=cure,
        )
    low, high = model.valid.height_m
    if not low <= height_m <= high:
        raise InputError(
            f"sky model '{model.name}'", f"the observer is at {height_m:.0f} m", expected=f"{low:g} to {high:g} m"
        )


def atmosphere_of(model: AtmosphereModel) -> Atmosphere:
    """The air that an atmosphere model declares."""
    return Atmosphere(
        aerosol_optical_depth_500nm=model.aerosol.optical_depth_500nm,
        angstrom_exponent=model.aerosol.angstrom_exponent,
        aerosol_scale_height_m=model.aerosol.scale_height_m,
        single_scattering_albedo=model.aerosol.single_scattering_albedo,
        asymmetry=model.aerosol.asymmetry,
        ozone_du=model.ozone.column_du,
        ground_albedo=model.ground.albedo,
        ground_height_m=model.ground.height_m,
    )


def visibility_km(model: SkyModel) -> float | None:
    """Meteorological range at the model's ground [km]; ``None`` for a model without air."""
    if isinstance(model, AtmosphereModel):
        return visibility_from_atmosphere(atmosphere_of(model), model.ground.height_m) / 1000.0
    return model.visibility_km if isinstance(model, OvercastModel) else None


def _check_override(model: SkyModel, parameter: str, value: float) -> None:
    flag, interval = "--" + parameter.replace("_", "-"), getattr(model.valid, parameter)
    if interval is None:
        raise InputError(flag, f"sky model '{model.name}' does not know it")
    low, high = interval
    if not low <= value <= high:
        raise InputError(
            flag, f"outside the range of sky model '{model.name}'", got=value, expected=f"{low:g} to {high:g}"
        )


def _hazed(
    model: AtmosphereModel, turbidity: float | None, visibility: float | None, ozone_du: float | None
) -> AtmosphereModel:
    aerosol, ozone = model.aerosol, model.ozone
    if turbidity is not None:
        depth = aerosol_optical_depth_from_turbidity(turbidity, angstrom_exponent=aerosol.angstrom_exponent)
    elif visibility is not None:
        depth = aerosol_optical_depth_from_visibility(
            1000.0 * visibility,
            height_m=model.ground.height_m,
            angstrom_exponent=aerosol.angstrom_exponent,
            aerosol_scale_height_m=aerosol.scale_height_m,
            ground_height_m=model.ground.height_m,
        )
    else:
        depth = aerosol.optical_depth_500nm
    if ozone_du is not None:
        ozone = ozone.model_copy(update={"column_du": float(ozone_du)})
    return model.model_copy(
        update={"aerosol": aerosol.model_copy(update={"optical_depth_500nm": depth}), "ozone": ozone}
    )
