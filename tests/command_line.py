"""Commands as functions: arguments become tokens of the real command line; exceptions pass through."""

from __future__ import annotations

from seasonscapes.cli import run


def command(name: str, *positional: object, **flags: object) -> None:
    """Run ``seasonscapes name``; ``times_utc=3`` is ``--times-utc 3``, ``fast=True`` is ``--fast``, lists repeat a flag."""
    tokens = [name, *map(str, positional)]
    for flag, value in flags.items():
        option = "--" + flag.rstrip("_").replace("_", "-")
        values = value if isinstance(value, (list, tuple)) else [value]
        for each in values:
            if each is True:
                tokens.append(option)
            elif each is False:
                tokens.append("--no-" + option[2:])
            elif each is not None:
                tokens += [option, str(each)]
    run(tokens)
