"""Flags that say where frames are rendered."""

from __future__ import annotations

import re
from dataclasses import dataclass

from cyclopts import Parameter

from seasonscapes.errors import InputError


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class WorkOptions:
    """Where frames are rendered."""

    cluster: str | None = None
    """local:N worker processes, tcp://HOST:PORT of a Dask scheduler, or slurm:FILE."""
    shard: str | None = None
    """Only the part i/N of the frames, with no film made; any number of machines share a workspace."""

    def check_cluster(self) -> None:
        """`InputError` about a description of no cluster."""
        if self.cluster is not None:
            from seasonscapes.cluster import check_cluster

            check_cluster(self.cluster)

    def part(self) -> tuple[int, int] | None:
        """The part i/N as two numbers."""
        if self.shard is None:
            return None
        match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", self.shard)
        if match is None or not 1 <= int(match[1]) <= int(match[2]):
            expected = "i/N with 1 ≤ i ≤ N, such as 3/8"
            raise InputError("--shard", "not a part of the whole", got=self.shard, expected=expected)
        return int(match[1]), int(match[2])
