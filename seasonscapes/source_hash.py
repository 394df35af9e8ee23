"""A hash of the source code that makes an artefact, so that an edit or an upgrade rebuilds what it may change."""

from __future__ import annotations

import hashlib
import json
import marshal
import os
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path
from types import CodeType
from typing import Any

from seasonscapes.user_cache import user_cache_folder

_PACKAGE = Path(__file__).parent
_ROOT = _PACKAGE.name
# Read at once: an upgrade must not lend its name to what the code before it found.
_OWN_SOURCE = Path(__file__).read_text(encoding="utf-8")


@lru_cache(maxsize=64)
def source_hash(*modules: str) -> str:
    """Hash the source of modules together with all modules of this package that they import, directly or indirectly.

    Imports inside functions count; imports for type checking do not. Comments, docstrings and layout do not change the
    hash; another minor version of Python does. Two versions of the program with equal hashes compute equal results for
    equal inputs (apart from third-party packages, which are not hashed).

    Parameters
    ----------
    *modules
        Dotted names below ``seasonscapes``, such as ``"terrain.mesh"``.

    Returns
    -------
    str
        16 hexadecimal digits.

    Raises
    ------
    ValueError
        Where a module does not exist.

    Examples
    --------
    >>> from seasonscapes.source_hash import source_hash
    >>> len(source_hash("terrain.mesh"))
    16
    """
    digest = hashlib.sha256()
    for module in sorted(imported_modules(*modules)):
        digest.update(f"{module}:{_facts(module)[0]}\n".encode())
    _keep_facts()
    return digest.hexdigest()[:16]


def imported_modules(*modules: str) -> frozenset[str]:
    """The modules themselves and every module of the package in the transitive closure of their imports."""
    found: set[str] = set()
    pending = list(modules)
    while pending:
        module = pending.pop()
        if module not in found:
            found.add(module)
            pending += _facts(module)[1]
    return frozenset(found)


def _path(module: str) -> Path:
    path = _PACKAGE.joinpath(*module.split("."))
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    raise ValueError(f"source_hash: {_ROOT}.{module} does not exist")


_TYPE_CHECKING = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t]+.*\n|\n)+", re.MULTILINE)


@cache
def _facts(module: str) -> tuple[str, tuple[str, ...]]:
    """Hash of a module's code, and the modules of the package that it imports anywhere in it.

    Compiling two hundred modules takes most of a second. What they gave is kept in the user's cache, and taken from there
    while the file has the size, times and inode that it had then.
    """
    about = _path(module).stat()
    state = [about.st_size, about.st_mtime_ns, about.st_ctime_ns, about.st_ino]
    kept = _kept().get(module)
    if kept is None or kept[0] != state:
        code = _code(module)
        kept = [state, _code_hash(code), list(_imports(code))]
        _kept()[module] = kept
        _new.append(module)
    return kept[1], tuple(kept[2])


# Modules whose facts are not in the file yet.
_new: list[str] = []


def _facts_path() -> Path:
    """Where facts are kept; another interpreter, and another installation, has another file."""
    installation = hashlib.sha256(str(_PACKAGE).encode()).hexdigest()[:12]
    return user_cache_folder() / f"modules-{sys.implementation.cache_tag}-{installation}.json"


@cache
def _made_by() -> str:
    """Name of everything but a module's own file that its facts depend on: this file, the interpreter, and which modules there are."""
    about = (sys.version, _OWN_SOURCE, sorted(_modules()))
    return hashlib.sha256(repr(about).encode()).hexdigest()


@cache
def _kept() -> dict[str, list[Any]]:
    """State of the file, hash and imports by module, as they were kept; nothing where they are of other code, or damaged."""
    try:
        stored = json.loads(_facts_path().read_text(encoding="utf-8"))
        if stored["made_by"] != _made_by():
            return {}
        return {module: [state, code, imports] for module, (state, code, imports) in stored["modules"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError):
        return {}


def _keep_facts() -> None:
    if not _new:
        return
    _new.clear()
    # Where nothing can be kept, modules are compiled again next time: no result depends on it.
    with suppress(OSError, RuntimeError):
        path = _facts_path()
        temporary = path.with_suffix(f".{os.getpid()}.part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_text(json.dumps({"made_by": _made_by(), "modules": _kept()}), encoding="utf-8")
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def _code(module: str) -> CodeType:
    """The module compiled without docstrings and without its imports for type checking; three times quicker than `ast`."""
    source = _TYPE_CHECKING.sub("", _path(module).read_text(encoding="utf-8"))
    return compile(source, module, "exec", dont_inherit=True, optimize=2)


def _code_hash(code: CodeType) -> str:
    # Version 2 of the format has no back references, whose use depends on reference counts.
    return hashlib.sha256(marshal.dumps(_without_positions(code), 2)).hexdigest()


def _without_positions(code: CodeType) -> CodeType:
    constants = tuple(_without_positions(each) if isinstance(each, CodeType) else each for each in code.co_consts)
    return code.replace(co_linetable=b"", co_firstlineno=1, co_filename="", co_consts=constants)


def _imports(code: CodeType) -> tuple[str, ...]:
    """Modules of the package that a module imports, anywhere in its code."""
    names = set(_names(code))
    packages = {name for name in names if name == _ROOT or name.startswith(f"{_ROOT}.")}
    # In ``from package import module`` both names stand apart in the bytecode.
    dotted = packages | {f"{package}.{name}" for package in packages for name in names if "." not in name}
    inner = (name.removeprefix(_ROOT).removeprefix(".") for name in dotted)
    return tuple(sorted(name for name in inner if name and name in _modules()))


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


@cache
def _modules() -> frozenset[str]:
    """Names of all modules of the package, from one walk, since thousands of names are looked up."""
    files = (path.relative_to(_PACKAGE).with_suffix("") for path in _PACKAGE.rglob("*.py"))
    parts = (file.parts[:-1] if file.name == "__init__" else file.parts for file in files)
    return frozenset(".".join(names) for names in parts)
