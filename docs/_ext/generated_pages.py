"""Pages that are made of the program itself at every build: commands, public names, keys of scene files and sky models.

They go to ``docs/_generated`` (included by pages) and ``docs/reference/api`` (pages of their own); neither is in git.
"""

from __future__ import annotations

import inspect
import re
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from cyclopts import App
from numpydoc.docscrape import NumpyDocString
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined
from sphinx.application import Sphinx

import seasonscapes
from seasonscapes.declaration import Declaration

DOCS = Path(__file__).parents[1]
# Name of a key's unit, by the suffix of the key.
UNITS = {"_deg": "°", "_m": "m", "_km": "km", "_px": "px", "_du": "DU"}


# ------------------------------------------------------------------------------------------------ public names


def public_names() -> Iterator[tuple[str, list[str]]]:
    """Yield the groups of public names: the comments of ``_MODULES`` in ``seasonscapes/__init__.py``."""
    source = Path(seasonscapes.__file__).read_text(encoding="utf-8")
    table = source.split("_MODULES = {", 1)[1].split("\n}", 1)[0]
    group, names = "", []
    for line in table.splitlines():
        if comment := re.fullmatch(r"\s*# (.+)", line):
            if names:
                yield group, names
            group, names = comment[1], []
        elif name := re.match(r'\s*"(\w+)":', line):
            names.append(name[1])
    yield group, names


def api_pages() -> dict[str, str]:
    """Return the pages of the public names, one a group, by file name."""
    pages = {}
    for number, (group, names) in enumerate(public_names(), 1):
        lines = [f"# {group[0].upper()}{group[1:]}", "", "```{eval-rst}"]
        for name in names:
            thing = getattr(seasonscapes, name)
            kind = "autoclass" if inspect.isclass(thing) else "autofunction"
            lines += [f".. {kind}:: seasonscapes.{name}"]
            if inspect.isclass(thing) and not issubclass(thing, BaseException):
                # Inherited members of pydantic and of exceptions are not ours.
                lines += ["   :members:", "   :exclude-members: model_config"]
            lines += [""]
        lines += ["```", ""]
        slug = re.sub(r"\W+", "-", group.lower()).strip("-")
        pages[f"{number:02d}-{slug}.md"] = "\n".join(lines)
    return pages


def link_public_names(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Turn `Name` in docstrings into a link where the name is public, and into literal text elsewhere."""

    def link(match: re.Match[str]) -> str:
        target = match[1].removeprefix("ss.").removesuffix("()")
        if target in seasonscapes.__all__:
            return f":py:obj:`~seasonscapes.{target}`"
        return f"``{match[1]}``"

    for number, line in enumerate(lines):
        lines[number] = re.sub(r"(?<![`:\w])`([^`<>\s][^`<>]*)`(?![`_])", link, line)


# ------------------------------------------------------------------------------------------------ command line


def command_line() -> App:
    """Return the application of all commands."""
    from seasonscapes.commands.application import app

    return app


def command_page() -> str:
    """Return the reference of all commands, as cyclopts describes them."""
    text = command_line().generate_docs(output_format="markdown", recursive=True, heading_level=1)
    first = text.index("## seasonscapes ")
    return "\n".join(verb_table()) + "\n\n" + text[first:].replace("**Parameters**:", "")


def verb_table() -> list[str]:
    """Return a table of all verbs with what they do, each linked to its section."""
    application, rows = command_line(), ["| command | what it does |", "|---|---|"]
    for name in application:
        if not name.startswith("-"):
            rows.append(f"| [`{name}`](#seasonscapes-{name}) | {application[name].help.splitlines()[0]} |")
    return rows


# ------------------------------------------------------------------------------------------------ declarations


def type_text(annotation: Any) -> str:
    """Return a type as a reader of TOML thinks of it."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return ", ".join(f"`{value!r}`".replace("'", '"') for value in arguments)
    if origin in (Union, types.UnionType):
        return " or ".join(type_text(each) for each in arguments if each is not type(None))
    if origin is list:
        return f"list of {type_text(arguments[0])}"
    if hasattr(annotation, "__metadata__") or (origin is not None and arguments):
        return type_text(arguments[0])
    if inspect.isclass(annotation) and issubclass(annotation, Declaration):
        return "table"
    return {float: "number", int: "whole number", str: "text", bool: "true or false"}[annotation]


def range_text(field: FieldInfo) -> str:
    """Return the bounds that a field is checked against."""
    bounds: dict[str, Any] = {}
    for constraint in field.metadata:
        for key in ("ge", "gt", "le", "lt", "min_length", "max_length", "pattern"):
            value = getattr(constraint, key, None)
            if value is not None:
                bounds[key] = value
    # A union keeps the constraints of its members in its arguments.
    for member in get_args(field.annotation):
        for constraint in getattr(member, "__metadata__", ()):
            for inner in getattr(constraint, "metadata", [constraint]):
                for key in ("ge", "gt", "le", "lt", "min_length", "max_length"):
                    if getattr(inner, key, None) is not None:
                        bounds[key] = getattr(inner, key)
    if "min_length" in bounds and bounds["min_length"] == bounds.get("max_length"):
        return f"{bounds['min_length']} values"
    low = f"{bounds['ge']:,g} ≤" if "ge" in bounds else f"{bounds['gt']:,g} <" if "gt" in bounds else ""
    high = f"≤ {bounds['le']:,g}" if "le" in bounds else f"< {bounds['lt']:,g}" if "lt" in bounds else ""
    if low and high:
        return f"{low} … {high}"
    if low:
        return f"{'≥' if 'ge' in bounds else '>'} {low.split()[0]}"
    return high


def described(model: type[Declaration]) -> dict[str, str]:
    """Return the description of every parameter of a model's numpydoc docstring, inherited ones included."""
    descriptions: dict[str, str] = {}
    for ancestor in reversed(model.__mro__):
        if issubclass(ancestor, Declaration) and ancestor is not Declaration and ancestor.__doc__:
            parameters = NumpyDocString(inspect.cleandoc(ancestor.__doc__))["Parameters"]
            for parameter in parameters:
                # Where several keys share a description, it is repeated.
                for name in (parameter.name or parameter.type).split(","):
                    descriptions[name.strip()] = " ".join(parameter.desc)
    return descriptions


def key_table(model: type[Declaration], prefix: str = "", nested: bool = True) -> list[str]:
    """Return the rows of a table of keys, those of nested tables after their own."""
    rows, descriptions = [], described(model)
    for name, field in model.model_fields.items():
        key = field.alias or name
        inner = next((each for each in _models(field.annotation)), None)
        if inner is not None:
            if nested and get_origin(field.annotation) is not list:
                rows += key_table(inner, f"{prefix}{key}.")
            continue
        unit = next((f"[{unit}]" for suffix, unit in UNITS.items() if name.endswith(suffix)), "")
        default = "**required**" if field.is_required() else _default(field)
        # The unit has its place beside the type.
        text = re.sub(r" \[(deg|m|km|px|DU)\](?=[.,;]|$)", "", descriptions[name])
        text = re.sub(r"``|`", "`", text).replace("|", "\\|")
        value = ", ".join(filter(None, (f"{type_text(field.annotation)} {unit}".strip(), range_text(field), default)))
        rows.append(f"| `{prefix}{key}` | {value} | {text} |")
    return rows


def _models(annotation: Any) -> Iterator[type[Declaration]]:
    if inspect.isclass(annotation) and issubclass(annotation, Declaration):
        yield annotation
    for each in get_args(annotation):
        yield from _models(each)


def _default(field: FieldInfo) -> str:
    value = field.default if field.default is not PydanticUndefined else field.default_factory()  # type: ignore[misc]
    return "optional" if value is None or value == "" or value == [] else f"default `{value}`"


HEADER = ["| key | value | meaning |", "|---|---|---|"]


def key_page() -> dict[str, str]:
    """Return the tables of keys of scene files and sky models, by file name."""
    from seasonscapes.cameras.webcam import Webcam
    from seasonscapes.scene import Imagery, NamedCamera, SceneFile
    from seasonscapes.sky.models import KINDS, SkyModel
    from seasonscapes.terrain.raster_tables import FinerHeights, FinerImage

    pages = {
        "scene_keys.md": "\n".join(HEADER + key_table(SceneFile)) + "\n",
        "imagery_keys.md": "\n".join(HEADER + key_table(Imagery)) + "\n",
        "finer_heights_keys.md": "\n".join(HEADER + key_table(FinerHeights)) + "\n",
        "finer_image_keys.md": "\n".join(HEADER + key_table(FinerImage)) + "\n",
        "camera_keys.md": "\n".join(HEADER + key_table(NamedCamera)) + "\n",
        "webcam_keys.md": "\n".join(HEADER + key_table(Webcam)) + "\n",
        "sky_keys.md": "\n".join(HEADER + key_table(SkyModel)) + "\n",
    }
    common = {row.split("|")[1] for row in key_table(SkyModel)}
    for kind, model in KINDS.items():
        own = [row for row in key_table(model) if row.split("|")[1] not in common]
        pages[f"sky_keys_{kind}.md"] = "\n".join(HEADER + own) + "\n"
    return pages


# ------------------------------------------------------------------------------------------------ writing


def write(app: Sphinx) -> None:
    """Write all pages whose content changed, so that an unchanged page is not read again; remove others."""
    pages = {DOCS / "_generated" / name: text for name, text in key_page().items()}
    pages[DOCS / "_generated" / "cli.md"] = command_page()
    pages |= {DOCS / "reference" / "api" / name: text for name, text in api_pages().items()}
    for folder in (DOCS / "_generated", DOCS / "reference" / "api"):
        folder.mkdir(exist_ok=True)
        for stale in set(folder.glob("*.md")) - set(pages):
            stale.unlink()
    for path, text in pages.items():
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("builder-inited", write)
    app.connect("autodoc-process-docstring", link_public_names, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
