"""``seasonscapes info``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from seasonscapes.commands.console import print_result


def info_command(artefact: Path, *, json: bool = False) -> None:
    """Print the provenance of a picture, texture, map, model, film or built artefact.

    Parameters
    ----------
    artefact
        A file that a command wrote, or one of the workspace, or a folder of daylight coefficients.
    json
        Print one machine-readable record.
    """
    from seasonscapes.workflows.provenance import provenance

    record = provenance(artefact)
    print_result(record, list(_lines(record)), as_json=json)


def _lines(record: dict, indent: str = "") -> Iterator[str]:
    for key, value in record.items():
        if isinstance(value, dict):
            yield f"{indent}{key}"
            yield from _lines(value, indent + "  ")
        else:
            yield f"{indent}{key:<24} {value}"
