"""A hash of the source code that makes an artefact, so that an edit or an upgrade rebuilds what it may change."""

from __future__ import annotations

import hashlib
import marshal
import re
from collections.abc import Iterator
from functools import cache, lru_cache
from pathlib import Path
from types import CodeType

_PACKAGE = Path(__file__).parent
_ROOT = _PACKAGE.name


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
        digest.update(f"{module}:{_code_hash(module)}\n".encode())
    return digest.hexdigest()[:16]


def imported_modules(*modules: str) -> frozenset[str]:
    """The modules themselves and every module of the package in the transitive closure of their imports."""
    found: set[str] = set()
    pending = list(modules)
    while pending:
        module = pending.pop()
        if module not in found:
            found.add(module)
            pending += _imports(module)
    return frozenset(found)


def _path(module: str) -> Path:
    path = _PACKAGE.joinpath(*module.split("."))
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    raise ValueError(f"source_hash: {_ROOT}.{module} does not exist")


_TYPE_CHECKING = re.compile(r"^if TYPE_CHECKING:\n(?:[ \t]+.*\n|\n)+", re.MULTILINE)


@cache
def _code(module: str) -> CodeType:
    """The module compiled without docstrings and without its imports for type checking; three times quicker than `ast`."""
    source = _TYPE_CHECKING.sub("", _path(module).read_text(encoding="utf-8"))
    return compile(source, module, "exec", dont_inherit=True, optimize=2)


@cache
def _code_hash(module: str) -> str:
    # Version 2 of the format has no back references, whose use depends on reference counts.
    return hashlib.sha256(marshal.dumps(_without_positions(_code(module)), 2)).hexdigest()


def _without_positions(code: CodeType) -> CodeType:
    constants = tuple(_without_positions(each) if isinstance(each, CodeType) else each for each in code.co_consts)
    return code.replace(co_linetable=b"", co_firstlineno=1, co_filename="", co_consts=constants)


@cache
def _imports(module: str) -> tuple[str, ...]:
    """Modules of the package that one module imports, anywhere in its code."""
    names = set(_names(_code(module)))
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
