"""Declarative sky models: TOML files in ``sun_models/``, command-line overrides and valid ranges."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

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
UnitInterval = Annotated[float, Field(ge=0.0, le=1.0)]


class ValidRange(Declaration):
    """Valid ranges of a sky model, each ``[low, high]``; an override without range is not supported by the model.

    Parameters
    ----------
    sun_elevation_deg
        Apparent solar elevation [deg].
    height_m
        Height of the observer [m].
    turbidity, visibility_km, ozone_du
        Overrides, see `with_overrides`.
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
    """Aerosol (haze or dust) of an atmosphere model.

    Parameters
    ----------
    optical_depth_500nm
        Vertical optical depth at 500 nm.
    angstrom_exponent
        Ångström exponent of its wavelength dependence.
    scale_height_m
        Scale height of its density [m].
    single_scattering_albedo, asymmetry
        Single-scattering albedo and mean cosine of scattering.
    """

    optical_depth_500nm: float = Field(ge=0.0, le=5.0)
    angstrom_exponent: float = Field(ge=-1.0, le=4.0)
    scale_height_m: float = Field(ge=50.0, le=20_000.0)
    single_scattering_albedo: UnitInterval
    asymmetry: float = Field(ge=0.0, le=0.85)


class Ozone(Declaration):
    """Ozone of an atmosphere model.

    Parameters
    ----------
    column_du
        Vertical column [DU].
    """

    column_du: float = Field(ge=0.0, le=1000.0)


class GroundModel(Declaration):
    """Ground of a sky model.

    Parameters
    ----------
    albedo
        Mean albedo.
    height_m
        Height of the lowland, at which the aerosol column begins [m].
    """

    albedo: UnitInterval
    height_m: float = Field(default=0.0, ge=-500.0, le=6000.0)


class SkyModel(Declaration):
    """Fields common to all sky models.

    Parameters
    ----------
    name
        Name of the model; the file's stem if omitted.
    description, sources
        Human-readable description, and references of the numbers.
    ground, valid
        See `GroundModel` and `ValidRange`.
    cloudiness
        Cloud fraction in [0, 1]; see `sky.clouds`.
    """

    name: str = ""
    description: str
    sources: list[str] = Field(min_length=1)
    ground: GroundModel
    valid: ValidRange
    cloudiness: UnitInterval = 0.0

    @property
    def states_clouds(self) -> bool:
        """Whether the cloudiness was given, by the file or an override; 0 then says that the sky is clear."""
        return "cloudiness" in self.model_fields_set


class AtmosphereModel(SkyModel):
    """Clear or hazy atmosphere at any solar elevation, spectral with multiple scattering (`sky.clear_sky`).

    Parameters
    ----------
    kind
        ``atmosphere``.
    aerosol, ozone
        See `Aerosol` and `Ozone`.
    water_cm
        Precipitable water above the ground of the model [cm], which absorbs infrared: it determines watts, not light.
        Default: the U.S. Standard Atmosphere 1976.
    """

    kind: Literal["atmosphere"] = "atmosphere"
    aerosol: Aerosol
    ozone: Ozone
    water_cm: float = Field(default=1.42, ge=0.0, le=10.0)


class OvercastModel(SkyModel):
    """Closed cloud layer at any solar elevation (`sky.overcast`).

    Parameters
    ----------
    kind
        ``overcast``.
    distribution
        CIE standard overcast or CIE intermediate luminance distribution.
    visibility_km
        Meteorological range below the layer [km].
    """

    kind: Literal["overcast"] = "overcast"
    distribution: Literal["standard", "intermediate"] = "standard"
    visibility_km: float = Field(gt=0.0, le=300.0)


class HosekModel(SkyModel):
    """Hosek-Wilkie sky, evaluated by the renderer (`rendering.hosek`).

    Parameters
    ----------
    kind
        ``hosek``.
    turbidity
        Turbidity of the atmosphere.
    """

    kind: Literal["hosek"] = "hosek"
    turbidity: float = Field(ge=1.0, le=10.0)


KINDS: dict[str, type[SkyModel]] = {"atmosphere": AtmosphereModel, "overcast": OvercastModel, "hosek": HosekModel}


def read_sky_model(name_or_path: str | Path) -> SkyModel:
    """Read a sky model from a TOML file or from the bundled files.

    Parameters
    ----------
    name_or_path
        Name of a bundled model, such as ``clear``, or path of a TOML file.

    Returns
    -------
    SkyModel
        Validated model of the class in `KINDS`.

    Raises
    ------
    InputError
        If there is no such model, or the file is invalid.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml" and not path.is_file():
        path = bundled_path("sun_models", str(name_or_path))
    model = sky_model_from_table(read_toml(path), where=path)
    return model if model.name else model.model_copy(update={"name": path.stem})


def sky_model_from_table(table: dict[str, Any], *, where: str | Path) -> SkyModel:
    """Validate the tables of a sky model; `InputError`, which begins with ``where``, as in `read_sky_model`."""
    kind = table.get("kind")
    if kind not in tuple(KINDS):
        raise InputError(
            f"{where}: kind",
            "no such kind of sky model" if "kind" in table else "missing key",
            got=kind,
            expected="one of " + ", ".join(KINDS),
        )
    return validate(table, KINDS[kind], where=where)


def with_overrides(
    model: SkyModel,
    *,
    turbidity: float | None = None,
    visibility_km: float | None = None,
    ozone_du: float | None = None,
    cloudiness: float | None = None,
) -> SkyModel:
    """Apply overrides, such as those of the command line, to a sky model.

    Parameters
    ----------
    model
        Sky model.
    turbidity
        ``(τ_gas + τ_haze) / τ_gas`` at sea level and 550 nm (Preetham et al. 1999).
    visibility_km
        Meteorological range at the height of the model's ground, for a contrast of 2 % at 550 nm [km].
    ozone_du
        Ozone column [DU].
    cloudiness
        Cloud fraction in [0, 1].

    Returns
    -------
    SkyModel
        Copy of the model with the overrides applied.

    Raises
    ------
    InputError
        If a value is outside the model's valid range, the model does not support an override, or both turbidity and
        visibility are given.
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
                f"sky model '{model.name}' is a closed cloud layer already",
                cure="choose a clear model, such as --sky clear",
            )
        model = model.model_copy(update={"cloudiness": float(cloudiness)})
    if isinstance(model, AtmosphereModel):
        return _with_aerosol_and_ozone(model, turbidity, visibility_km, ozone_du)
    if isinstance(model, OvercastModel) and visibility_km is not None:
        return model.model_copy(update={"visibility_km": float(visibility_km)})
    if isinstance(model, HosekModel) and turbidity is not None:
        return model.model_copy(update={"turbidity": float(turbidity)})
    return model


def check_valid(model: SkyModel, sun_elevation_deg: float, height_m: float) -> None:
    """Check that sun and observer are within the valid range of a sky model.

    Parameters
    ----------
    model
        Sky model.
    sun_elevation_deg
        Apparent solar elevation [deg].
    height_m
        Height of the observer [m].

    Raises
    ------
    InputError
        If the sun or the observer is outside the model's range.
    """
    low, high = model.valid.sun_elevation_deg
    if not low <= sun_elevation_deg <= high:
        cure = "choose an atmosphere model, such as --sky clear" if isinstance(model, HosekModel) else None
        raise InputError(
            f"sky model '{model.name}'",
            f"the solar elevation is {sun_elevation_deg:.2f}°",
            expected=f"{low:g}° to {high:g}°",
            cure=cure,
        )
    low, high = model.valid.height_m
    if not low <= height_m <= high:
        raise InputError(
            f"sky model '{model.name}'", f"the observer is at {height_m:.0f} m", expected=f"{low:g} to {high:g} m"
        )


def atmosphere_from_model(model: AtmosphereModel) -> Atmosphere:
    """Convert an atmosphere model to the parameters of the radiative-transfer model.

    Parameters
    ----------
    model
        Atmosphere model.

    Returns
    -------
    Atmosphere
        Parameters of the atmosphere.
    """
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
    """Compute the meteorological range at the model's ground.

    Parameters
    ----------
    model
        Sky model.

    Returns
    -------
    float or None
        Meteorological range [km]; ``None`` for a model without aerial perspective.
    """
    if isinstance(model, AtmosphereModel):
        return visibility_from_atmosphere(atmosphere_from_model(model), model.ground.height_m) / 1000.0
    return model.visibility_km if isinstance(model, OvercastModel) else None


def _check_override(model: SkyModel, parameter: str, value: float) -> None:
    flag, interval = "--" + parameter.replace("_", "-"), getattr(model.valid, parameter)
    if interval is None:
        raise InputError(flag, f"sky model '{model.name}' does not support it")
    low, high = interval
    if not low <= value <= high:
        raise InputError(
            flag, f"outside the range of sky model '{model.name}'", got=value, expected=f"{low:g} to {high:g}"
        )


def _with_aerosol_and_ozone(
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
