"""Reading of TOML files into validated pydantic models, with one-line error messages."""

from __future__ import annotations

import difflib
import re
import tomllib
import unicodedata
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, LiteralString, TypeVar, cast, get_args, get_origin

from pydantic import AfterValidator, BaseModel, ConfigDict, ModelWrapValidatorHandler, ValidationError
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from seasonscapes.errors import InputError
from seasonscapes.text_files import read_text

__all__ = [
    "Declaration",
    "InputError",
    "Name",
    "all_at_once",
    "checked_name",
    "read_declaration",
    "read_toml",
    "validate",
]

MOST_NAME_CHARACTERS = 64
MOST_TEXT_CHARACTERS = 2000
# Letters and digits of any script; no separator of paths, no control character, nothing hidden, nothing like a flag.
_NAME = re.compile(r"[^\W_](?:[\w .-]*[\w-])?")


def checked_name(value: str) -> str:
    """Return a name that files may be called after; `ValueError` for any other.

    A name begins with a letter or digit, holds letters, digits, ``-``, ``_``, ``.`` and blanks, does not end with a dot
    or blank, and is at most 64 characters and 128 bytes of UTF-8 long.

    Examples
    --------
    >>> from seasonscapes.declaration import checked_name
    >>> checked_name("Jungfraujoch 2")
    'Jungfraujoch 2'
    """
    fits = (
        len(value) <= MOST_NAME_CHARACTERS and len(value.encode("utf-8", "surrogatepass")) <= 2 * MOST_NAME_CHARACTERS
    )
    if not fits or not _NAME.fullmatch(value):
        shown = value if len(value) <= MOST_NAME_CHARACTERS else f"{value[:24]}… ({len(value)} characters)"
        raise ValueError(
            f"not a name: {shown!r}; expected letters, digits, '-', '_', '.' and blanks, "
            f"at most {MOST_NAME_CHARACTERS} characters, beginning with a letter or digit"
        )
    return value


def checked_text(value: str) -> str:
    """Return a text for people; `ValueError` for one that is very long or could steer a terminal."""
    if len(value) > MOST_TEXT_CHARACTERS:
        raise ValueError(f"a text of {len(value)} characters; expected at most {MOST_TEXT_CHARACTERS}")
    control = next((c for c in value if unicodedata.category(c) in ("Cc", "Cs") and c not in "\n\t"), None)
    if control is not None:
        raise ValueError(f"a control character in a text: {control!r}")
    return value


# A name in a file that may become part of a file's name, and a text that is shown and copied into files' metadata.
Name = Annotated[str, AfterValidator(checked_name)]
Text = Annotated[str, AfterValidator(checked_text)]


class Declaration(BaseModel):
    """Base class of models read from TOML: immutable, strictly typed, without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=Declaration)


def all_at_once(
    data: Any, validated: ModelWrapValidatorHandler[Model], problems: Callable[[Mapping[str, Any]], list[str]]
) -> Model:
    """Validate a table and report what is wrong with its keys together beside what is wrong with each.

    Parameters
    ----------
    data
        The table, or an instance that is valid already.
    validated
        Of a ``wrap`` validator.
    problems
        Returns a message for each contradiction between keys of the table.

    Raises
    ------
    ValidationError
        With all problems.
    """
    found: list[InitErrorDetails] = []
    if isinstance(data, Mapping):
        found = [
            InitErrorDetails(type=PydanticCustomError("value_error", "{error}", {"error": text}), input=None)
            for text in problems(data)
        ]
    try:
        model = validated(data)
    except ValidationError as error:
        for details in error.errors():
            kind = PydanticCustomError(
                cast(LiteralString, details["type"]), "{message}", {**details.get("ctx", {}), "message": details["msg"]}
            )
            found.append(InitErrorDetails(type=kind, loc=details["loc"], input=details["input"]))
        raise ValidationError.from_exception_data(error.title, found) from None
    if found:
        raise ValidationError.from_exception_data(type(model).__name__, found)
    return model


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Parameters
    ----------
    path
        TOML file.

    Returns
    -------
    dict
        Top-level keys and tables.

    Raises
    ------
    InputError
        If the file does not exist, is a folder, a pipe or a device, is too large, or is not valid TOML.
    """
    text = read_text(path)
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError(path, "not valid TOML: nested too deeply") from None
    except ValueError as error:  # TOMLDecodeError among them, and integers of too many digits
        raise InputError(path, f"not valid TOML: {error}") from None


def read_declaration(path: Path, model: type[Model]) -> Model:
    """Read and validate a TOML file.

    Parameters
    ----------
    path
        TOML file.
    model
        Model class to validate against.

    Returns
    -------
    Model
        Instance of ``model``.

    Raises
    ------
    InputError
        If the file cannot be read or does not fit the model. The message names all errors in one line: unknown keys
        (with a suggestion), missing keys, wrong types or wrong values.
    """
    return validate(read_toml(path), model, where=path)


def validate(table: dict[str, Any], model: type[Model], *, where: str | Path) -> Model:
    """Validate the tables of a TOML file.

    Parameters
    ----------
    table
        Keys and tables, from `read_toml`.
    model
        Model class to validate against.
    where
        File or argument named at the start of an error message.

    Returns
    -------
    Model
        Instance of ``model``.

    Raises
    ------
    InputError
        As in `read_declaration`, if the tables do not fit the model.
    """
    try:
        return model.model_validate(table)
    except ValidationError as error:
        found = sorted(error.errors(), key=lambda details: details["type"] != "extra_forbidden")
        problems = [_input_error(details, model, where, table) for details in found if not _misspelt(details, found)]
        if len(problems) == 1:
            raise problems[0] from None
        told = "; ".join(str(problem).removeprefix(f"{where}: ") for problem in problems)
        raise InputError(where, f"{len(problems)} problems: {told}") from None


def _misspelt(details: ErrorDetails, errors: list[ErrorDetails]) -> bool:
    """Whether a missing key is also reported as an unknown one beside it, under a similar name."""
    if details["type"] != "missing":
        return False
    *table, key = details["loc"]
    unknown = [each["loc"] for each in errors if each["type"] == "extra_forbidden"]
    beside = [str(location[-1]) for location in unknown if list(location[:-1]) == table]
    return bool(difflib.get_close_matches(str(key), beside, n=1))


def _input_error(details: ErrorDetails, model: type[BaseModel], where: str | Path, table: dict[str, Any]) -> InputError:
    location = [part for part in details["loc"] if not (isinstance(part, str) and part.startswith("function-"))]
    location = _as_written(location, table)
    key = ".".join(f"[{part}]" if isinstance(part, int) else str(part) for part in location).replace(".[", "[")
    at = f"{where}: {key}" if key else f"{where}"
    if details["type"] == "extra_forbidden":
        known = sorted(_fields_at(model, location[:-1]))
        close = difflib.get_close_matches(str(location[-1]), known, n=1)
        cure = f"did you mean '{close[0]}'?" if close else None
        return InputError(at, "unknown key", expected="one of " + ", ".join(known) if known else None, cure=cure)
    if details["type"] == "missing":
        return InputError(at, "missing key", expected=_expected_at(model, location), cure="add it to the file")
    if details["type"] == "value_error":
        return InputError(at, str(details.get("ctx", {})["error"]))
    got = details["input"]
    return InputError(at, details["msg"], got=got if isinstance(got, (str, int, float, bool)) else type(got).__name__)


def _expected_at(model: type[BaseModel], location: list[int | str]) -> str | None:
    """The values that a key may have, where they are few; ``None`` elsewhere."""
    owner = _model_at(model, location[:-1])
    field = None if owner is None else owner.model_fields.get(str(location[-1]))
    if field is None or get_origin(field.annotation) is not Literal:
        return None
    return "one of " + ", ".join(str(value) for value in get_args(field.annotation))


def _member(value: Any, part: Any) -> Any:
    """What a dictionary or list of TOML holds under a key or number; ``None`` where there is nothing."""
    if isinstance(value, dict):
        return value.get(part)
    return value[part] if isinstance(value, list) and isinstance(part, int) and part < len(value) else None


def _as_written(location: list[int | str], table: dict[str, Any]) -> list[int | str]:
    """A location without the numbers of arrays that the file has as a single table."""
    written: list[int | str] = []
    here: Any = table
    for part in location:
        if isinstance(part, int) and isinstance(here, dict):
            continue
        written.append(part)
        here = _member(here, part)
    return written


def _fields_at(model: type[BaseModel], location: list[int | str]) -> list[str]:
    """Field names of the nested model at a pydantic error location."""
    owner = _model_at(model, location)
    return [] if owner is None else [field.alias or name for name, field in owner.model_fields.items()]


def _model_at(model: type[BaseModel], location: list[int | str]) -> type[BaseModel] | None:
    """The nested model at a pydantic error location; ``None`` where an unknown key leads to it."""
    current = model
    for part in location:
        if isinstance(part, int):
            continue
        field = current.model_fields.get(part)
        field = field or next((f for f in current.model_fields.values() if f.alias == part), None)
        if field is None:
            return None
        current = _model_in(field.annotation) or current
    return current


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        if (found := _model_in(argument)) is not None:
            return found
    return None
