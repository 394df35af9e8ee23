"""Which Mitsuba variant runs here, and which libLLVM it stands on; numpy to Mitsuba and back.

Dr.Jit's LLVM backend *aborts the process* with an old libLLVM ("Cannot select … fminimum", LLVM 14 and 15 on AVX-512
machines), so the library is chosen and its version read before a variant is set.
"""

from __future__ import annotations

import ctypes
import glob
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from seasonscapes.declaration import InputError

# LLVM 14 and 15 were seen to abort; LLVMGetVersion itself exists from 16 on, so older ones cannot even be asked.
OLDEST_LLVM = 16
LLVM_CURE = "install one: 'apt-get install libllvm19' (Debian 12, Ubuntu 24.04), 'brew install llvm@19' (macOS)"
VARIANTS = {"cuda": "cuda_ad_rgb", "llvm": "llvm_ad_rgb", "scalar": "scalar_rgb"}


@dataclass(frozen=True)
class Library:
    """A libLLVM on this machine; ``version`` is ``(0, 0, 0)`` where it is too old to tell."""

    path: str
    version: tuple[int, int, int]

    @property
    def usable(self) -> bool:
        return self.version[0] >= OLDEST_LLVM


@dataclass(frozen=True)
class Backend:
    """The variant that would be used, why, and the library beneath it."""

    device: str
    variant: str
    reason: str
    library: Library | None = None


def library_version(path: str) -> tuple[int, int, int]:
    """Version that a libLLVM says of itself, ``(0, 0, 0)`` for those too old to say; `OSError` if it does not load."""
    library = ctypes.CDLL(path)
    if not hasattr(library, "LLVMGetVersion"):
        return (0, 0, 0)
    parts = [ctypes.c_uint() for _ in range(3)]
    library.LLVMGetVersion(*(ctypes.byref(part) for part in parts))
    return tuple(part.value for part in parts)  # type: ignore[return-value]


def _candidate_paths() -> list[str]:
    """Paths of libLLVM on this machine, the likeliest to work first (newest by file name)."""
    patterns = [
        "/usr/lib/*-linux-gnu/libLLVM*.so*",
        "/lib/*-linux-gnu/libLLVM*.so*",
        "/usr/lib/llvm-*/lib/libLLVM*.so*",
        "/usr/lib64/libLLVM*.so*",
        "/usr/lib64/llvm*/lib/libLLVM*.so*",
        "/usr/lib/libLLVM*.so*",
        "/usr/local/lib/libLLVM*.so*",
        "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
        "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
        os.path.join(sys.prefix, "lib", "libLLVM*.so*"),
    ]
    found = {os.path.realpath(path) for pattern in patterns for path in glob.glob(pattern)}

    def by_version(path: str) -> int:
        numbers = re.findall(r"(\d+)", os.path.basename(path)) or re.findall(r"llvm[@-]?(\d+)", path)
        return int(numbers[0]) if numbers else 0

    return sorted(found, key=lambda path: (-by_version(path), path))


@cache
def find_llvm() -> Library | None:
    """The libLLVM that Dr.Jit should load: ``DRJIT_LIBLLVM_PATH`` where set, else the newest usable one.

    Returns the best *unusable* one when there is nothing better, so that it can be named; ``None`` if there is none.
    """
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    best: Library | None = None
    for path in [given] if given else _candidate_paths():
        try:
            library = Library(path, library_version(path))
        except OSError:
            library = Library(path, (0, 0, 0))
        if library.usable:
            return library
        best = best or library
    return best


@cache
def cuda_devices() -> int:
    """Number of CUDA devices that the driver reports; 0 without a driver."""
    for name in ("libcuda.so.1", "nvcuda.dll"):
        try:
            driver = ctypes.CDLL(name)
        except OSError:
            continue
        count = ctypes.c_int()
        if driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0:
            return count.value
    return 0


def choose_backend(device: str = "auto") -> Backend:
    """The backend for ``auto``, ``cuda``, ``llvm`` or ``scalar``, without loading Mitsuba.

    Raises
    ------
    InputError
        When a device is asked for by name and cannot work here.
    """
    _check_name(device)
    gpus = cuda_devices()
    if device == "cuda" and gpus == 0:
        raise InputError("--device", "no CUDA device found", got="cuda", cure="use --device llvm, or auto")
    if device == "cuda" or (device == "auto" and gpus > 0):
        return Backend("cuda", VARIANTS["cuda"], f"{gpus} CUDA device{'s' * (gpus > 1)} found")
    if device == "scalar":
        return Backend("scalar", VARIANTS["scalar"], "asked for by name; forward rendering only")
    library = find_llvm()
    if library is not None and library.usable:
        why = "no CUDA device" if device == "auto" else "asked for by name"
        return Backend("llvm", VARIANTS["llvm"], f"{why}; libLLVM {'.'.join(map(str, library.version))}", library)
    problem = "no libLLVM found" if library is None else f"libLLVM at {library.path} is older than {OLDEST_LLVM}"
    if device == "llvm":
        raise InputError("--device", problem, got="llvm", cure=LLVM_CURE)
    return Backend("scalar", VARIANTS["scalar"], f"{problem}; slower, and nothing that needs gradients works", library)


def _check_name(device: str) -> None:
    if device not in ("auto", *VARIANTS):
        raise InputError("--device", "unknown device", got=device, expected="auto, cuda, llvm or scalar")


_active: Backend | None = None


def use_backend(device: str | None = None, *, gradients: bool = False) -> Backend:
    """Set Mitsuba's variant once per process and return what was set.

    ``device`` left out means ``SEASONSCAPES_DEVICE`` or ``auto``. A second call returns the active backend.

    Raises
    ------
    InputError
        When the device cannot work here, when gradients are needed and only ``scalar`` is there, or when another
        device was already set in this process.
    """
    global _active
    _check_name(device or "auto")
    if _active is None:
        chosen = choose_backend(device or os.environ.get("SEASONSCAPES_DEVICE", "auto"))
        if chosen.device == "llvm" and chosen.library is not None:
            os.environ["DRJIT_LIBLLVM_PATH"] = chosen.library.path
        import mitsuba as mi

        mi.set_variant(chosen.variant)
        mi.set_log_level(mi.LogLevel.Error)
        _active = chosen
    elif device not in (None, "auto", _active.device):
        raise InputError("--device", f"this process already renders on {_active.device}", got=device)
    if gradients and _active.device == "scalar":
        raise InputError("--device", "this needs gradients, which the scalar variant does not have", cure=LLVM_CURE)
    return _active


def to_numpy(values: Any) -> np.ndarray:
    """A numpy copy of a Mitsuba/Dr.Jit array with the axis of components last, ``(N,)`` or ``(N, C)`` float32.

    Dr.Jit numbers its axes (component, lane); numpy code of this package wants (lane, component).
    """
    array = np.array(values)
    return array.T.copy() if array.ndim == 2 else array


def point3(values: np.ndarray) -> Any:
    """Positions or directions ``(N, 3)`` as ``mi.Point3f`` lanes (JIT variants)."""
    import mitsuba as mi

    return mi.Point3f(*(mi.Float(np.ascontiguousarray(values[:, axis], np.float32)) for axis in range(3)))


def probe_in_child(device: str = "auto", *, timeout_s: float = 120.0) -> tuple[bool, str]:
    """Render a white furnace in a child process, so that even an aborting library cannot hurt this one.

    Returns whether it worked and one line about it.
    """
    command = [sys.executable, "-m", "seasonscapes.rendering.probe", device]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        return False, f"no answer within {timeout_s:.0f} s"
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines() or ["no output"]
    if done.returncode < 0:
        return False, f"the process died of signal {-done.returncode}: {lines[-1]}"
    return done.returncode == 0, lines[-1]
