"""``seasonscapes lpips``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.console import message, print_result
from seasonscapes.commands.outputs import check_output
from seasonscapes.errors import InputError


def lpips_command(
    network: Path, linear: Path, /, *, output: Annotated[Path, Parameter(name=["--output", "-o"])], json: bool = False
) -> None:
    """Join the published weights of LPIPS to the one file that `evaluate --lpips` reads. Nothing is downloaded.

    Parameters
    ----------
    network
        torchvision's AlexNet, alexnet-owt-7be5be79.pth.
    linear
        The authors' linear layers: lpips-*.whl as pip downloads it, or the file lpips/weights/v0.1/alex.pth in it.
    output
        .safetensors file to write.
    json
        Print one machine-readable record.
    """
    from importlib.util import find_spec

    check_output(output, (".safetensors",))
    if find_spec("torch") is None or find_spec("safetensors") is None:
        raise InputError("lpips", "needs PyTorch and safetensors", cure="pip install 'seasonscapes[gaussians]'")
    from seasonscapes.evaluation.lpips import PUBLISHED, join_lpips

    found = join_lpips(network, linear, output)
    other = [
        str(path)
        for path, key in ((network, "alexnet_sha256"), (linear, "linear_sha256"))
        if found[key] != PUBLISHED[key]
    ]
    if other:
        message(f"not the published weights: {' and '.join(other)}; evaluate says so beside its scores")
    record = {"file": str(output), **found, "published": not other}
    print_result(record, [f"wrote {output}" + ("" if other else ", from the published weights")], as_json=json)
