"""``seasonscapes doctor``."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import subprocess
import sys

from seasonscapes import __version__
from seasonscapes.commands.console import print_result
from seasonscapes.rendering.backend import LLVM_CURE, choose_backend, cuda_devices, find_llvm, probe_in_child

# What each extra of the package brings, by the module that shows it is there.
EXTRAS = {
    "gaussians": "torch",
    "gsplat": "gsplat",
    "diffusion": "diffusers",
    "cluster": "distributed",
    "data": "pystac_client",
    "usd": "pxr",
}


def doctor_command(*, json: bool = False) -> None:
    """Report what this machine can do: Python, renderer, libLLVM, extras (imported), and a short test render.

    Never crashes: the test render runs in a process of its own, and a libLLVM that would abort is named instead.

    Parameters
    ----------
    json
        Print one machine-readable record.
    """
    backend = choose_backend("auto")
    library = find_llvm()
    works, line = probe_in_child("auto")
    faults = {name: _import_fault(module) for name, module in EXTRAS.items()}
    extras = {name: fault is None for name, fault in faults.items()}
    versions = {name: _version(name) for name in ("mitsuba", "drjit", "numpy", "rasterio", "torch")}
    record = {
        "seasonscapes": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpus": os.cpu_count(),
        "variant": backend.variant,
        "reason": backend.reason,
        "cuda_devices": cuda_devices(),
        "libllvm": None if library is None else library.path,
        "libllvm_version": None if library is None or not library.usable else ".".join(map(str, library.version)),
        "libllvm_usable": library is not None and library.usable,
        "versions": versions,
        "extras": extras,
        "extras_faults": {name: fault for name, fault in faults.items() if fault is not None},
        "test_render": works,
        "test_render_note": line,
    }
    llvm = "not found" if library is None else library.path
    if library is not None:
        llvm += (
            f" ({record['libllvm_version']})" if library.usable else " (too old: it would abort the process; not used)"
        )
    lines = [
        f"seasonscapes  {__version__} on Python {record['python']}, {os.cpu_count()} CPUs, {record['platform']}",
        f"renderer      {backend.variant}: {backend.reason}",
        f"libLLVM       {llvm}",
        "packages      " + ", ".join(f"{name} {version or 'absent'}" for name, version in versions.items()),
        "extras        " + ", ".join(f"{name} {fault or 'yes'}" for name, fault in faults.items()),
        f"test render   {'works' if works else 'FAILED'}: {line}",
    ]
    if backend.device == "scalar":
        lines.append(f"advice        {LLVM_CURE}")
    print_result(record, lines, as_json=json)
    if not works:
        sys.exit(1)


def _import_fault(module: str) -> str | None:
    """Why a module cannot be imported, by importing it in a process of its own; ``None`` where it can."""
    if importlib.util.find_spec(module) is None:
        return "no"
    try:
        result = subprocess.run(
            [sys.executable, "-c", f"import {module}"], capture_output=True, text=True, timeout=120.0, check=False
        )
    except subprocess.TimeoutExpired:
        return "BROKEN (its import did not end within 120 s)"
    if result.returncode == 0:
        return None
    lines = result.stderr.strip().splitlines() or [f"ended by {result.returncode}"]
    return f"BROKEN ({lines[-1]})"


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
