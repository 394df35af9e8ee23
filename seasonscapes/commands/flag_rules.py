"""What flags were given, and how a condition on them is stated."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath

# Flags that were given, with their values; those of a switch are empty.
Given = Mapping[str, str]


@dataclass(frozen=True)
class Condition:
    """Flags that do something only where others are given so.

    Parameters
    ----------
    flags
        The flags.
    needs
        In words: what they need.
    holds
        Whether it is so.
    """

    flags: tuple[str, ...]
    needs: str
    holds: Callable[[Given], bool]


def beside(flag: str) -> Callable[[Given], bool]:
    return lambda given: flag in given


def no(flag: str) -> Callable[[Given], bool]:
    return lambda given: flag not in given


def named(flag: str, *values: str, default: str) -> Callable[[Given], bool]:
    return lambda given: given.get(flag, default) in values


def written_as(*suffixes: str, default: str) -> Callable[[Given], bool]:
    return lambda given: PurePath(given.get("--output", default)).suffix.lower() in suffixes


def given_flags(tokens: Sequence[str]) -> dict[str, str]:
    """The flags among a verb's tokens, by their long names, with their values.

    Examples
    --------
    >>> from seasonscapes.commands.flag_rules import given_flags
    >>> given_flags(["a.toml", "--fps=12", "-o", "a.mp4", "--json"])
    {'--fps': '12', '--output': 'a.mp4', '--json': ''}
    """
    given: dict[str, str] = {}
    name = None
    for token in tokens:
        if token == "--":
            break
        if token == "-o" or token.startswith("--"):
            name, _, value = token.partition("=")
            name = "--output" if name == "-o" else name.replace("_", "-")
            given[name] = value
        elif name is not None:
            given[name] = given[name] or token
            name = None
    return given
