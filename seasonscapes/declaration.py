"""From a TOML file on disk to a validated model, with errors that a person can act on in one line."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from seasonscapes.errors import InputError

__all__ = ["Declaration", "InputError", "read_declaration", "read_toml", "validate"]


class Declaration(BaseModel):
    """Base of everything read from TOML: immutable, strict, and no unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=Declaration)


def read_toml(path: Path) -> dict:
    """The tables of a TOML file; `InputError` where it is missing or does not parse."""
    try:
        with open(path, "rb") as file:
            return tomllib.load(file)
    except FileNotFoundError:
        raise InputError(path, "no such file") from None
    except IsADirectoryError:
        raise InputError(path, "this is a folder", expected="a TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(path, f"not valid TOML: {error}") from None


def read_declaration(path: Path, model: type[Model]) -> Model:
    """Read and validate a TOML file.

    Raises
    ------
    InputError
        One line about the first thing that is wrong: unknown key (with a suggestion), missing key, wrong type or value.
    """
    return validate(read_toml(path), model, where=path)


def validate(table: dict, model: type[Model], *, where: str | Path) -> Model:
    """Validate tables that came from ``describe_position``; see `read_declaration`."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        # A misspelt key shows up twice, as unknown and as missing; the unknown one can name its cure.
        errors = sorted(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
        raise _input_error(errors[0], model, where) from None


def _input_error(first: dict, model: type[BaseModel], where: str | Path) -> InputError:
    location = [part for part in first["loc"] if not (isinstance(part, str) and part.startswith("function-"))]
    key = ".".join(f"[{part}]" if isinstance(part, int) else str(part) for part in location).replace(".[", "[")
    at = f"{where}: {key}" if key else f"{where}"
    if first["type"] == "extra_forbidden":
        known = sorted(_fields_at(model, location[:-1]))
        close = difflib.get_close_matches(str(location[-1]), known, n=1)
        cure = f"did you mean '{close[0]}'?" if close else None
        return InputError(at, "unknown key", expected="one of " + ", ".join(known) if known else None, cure=cure)
    if first["type"] == "missing":
        return InputError(at, "missing key", cure="add it to the file")
    if first["type"] == "value_error":
        return InputError(at, str(first["ctx"]["error"]))
    got = first["input"]
    return InputError(at, first["msg"], got=got if isinstance(got, (str, int, float, bool)) else type(got).__name__)


def _fields_at(model: type[BaseModel], location: list) -> list[str]:
    """Field names of the nested model that a pydantic error location leads to."""
    current: Any = model
    for part in location:
        if isinstance(part, int):
            continue
        field = getattr(current, "model_fields", {}).get(part)
        field = field or next((f for f in getattr(current, "model_fields", {}).values() if f.alias == part), None)
        if field is None:
            return []
        current = _model_within(field.annotation) or current
    return [field.alias or name for name, field in getattr(current, "model_fields", {}).items()]


def _model_within(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        if (found := _model_within(argument)) is not None:
            return found
    return None
