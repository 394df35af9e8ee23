"""Selection of the Mitsuba variant and of its libLLVM, and conversions between numpy and Mitsuba arrays.

Dr.Jit's LLVM backend *aborts the process* with an old libLLVM ("Cannot select … fminimum", LLVM 14 and 15 on AVX-512
machines). The library is therefore chosen, and its version read, before a variant is set.
"""

from __future__ import annotations

import ctypes
import glob
import logging
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from seasonscapes.declaration import InputError

log = logging.getLogger(__name__)

# LLVM 14 and 15 abort; LLVMGetVersion exists from LLVM 16 on, so that older libraries do not report a version.
OLDEST_LLVM = 16
LLVM_CURE = "install one: 'apt-get install libllvm19' (Debian 12, Ubuntu 24.04), 'brew install llvm@19' (macOS)"
# Of an AVX-512 register, the widest that LLVM vectorises for [bytes].
_ALIGNMENT = 64
VARIANTS = {"cuda": "cuda_ad_rgb", "llvm": "llvm_ad_rgb", "scalar": "scalar_rgb"}


@dataclass(frozen=True)
class Library:
    """A libLLVM on this machine.

    Parameters
    ----------
    path
        File of the shared library.
    version
        Major, minor and patch; ``(0, 0, 0)`` if the library is too old to report one or cannot be loaded.
    """

    path: str
    version: tuple[int, int, int]

    @property
    def usable(self) -> bool:
        """Whether the version is recent enough for Dr.Jit."""
        return self.version[0] >= OLDEST_LLVM


@dataclass(frozen=True)
class Backend:
    """A Mitsuba variant, the reason for choosing it, and its libLLVM.

    Parameters
    ----------
    device
        ``cuda``, ``llvm`` or ``scalar``.
    variant
        Name of the Mitsuba variant.
    reason
        Why this device was chosen, for display.
    library
        The libLLVM that was found; ``None`` for CUDA, on explicit request of ``scalar``, or if there is none.
    library_problem
        Why LLVM could not be used where it was wanted; empty otherwise.
    """

    device: str
    variant: str
    reason: str
    library: Library | None = None
    library_problem: str = ""


def library_version(path: str) -> tuple[int, int, int]:
    """Return the version that a libLLVM reports.

    Parameters
    ----------
    path
        File of the shared library.

    Returns
    -------
    tuple of int
        Major, minor and patch; ``(0, 0, 0)`` for libraries older than LLVM 16, which do not report a version.

    Raises
    ------
    OSError
        If the library cannot be loaded.
    """
    library = ctypes.CDLL(path)
    if not hasattr(library, "LLVMGetVersion"):
        return (0, 0, 0)
    major, minor, patch = (ctypes.c_uint() for _ in range(3))
    library.LLVMGetVersion(*(ctypes.byref(part) for part in (major, minor, patch)))
    return major.value, minor.value, patch.value


def _candidate_paths() -> list[str]:
    """Paths of libLLVM on this machine, newest by file name first."""
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
    """Return the libLLVM that Dr.Jit should load: ``DRJIT_LIBLLVM_PATH`` if set, else the newest usable one.

    Returns
    -------
    Library or None
        Without a usable library the newest unusable one, so that messages can name it; ``None`` if there is none.
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
    """Count the CUDA devices that the driver reports.

    Returns
    -------
    int
        Number of devices, 0 without a driver.
    """
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
    """Choose a backend without loading Mitsuba.

    Parameters
    ----------
    device
        ``auto`` (first available of CUDA, LLVM and scalar), ``cuda``, ``llvm`` or ``scalar``.

    Returns
    -------
    Backend
        The chosen device, its Mitsuba variant and the reason.

    Raises
    ------
    InputError
        If the device is unknown, or is requested explicitly and not available on this machine.
    """
    _check_name(device)
    gpus = cuda_devices()
    if device == "cuda" and gpus == 0:
        raise InputError("--device", "no CUDA device found", got="cuda", cure="use --device llvm, or auto")
    if device == "cuda" or (device == "auto" and gpus > 0):
        return Backend("cuda", VARIANTS["cuda"], f"{gpus} CUDA device{'s' * (gpus > 1)} found")
    if device == "scalar":
        return Backend("scalar", VARIANTS["scalar"], "requested explicitly; forward rendering only")
    library = find_llvm()
    if library is not None and library.usable:
        reason = "no CUDA device" if device == "auto" else "requested explicitly"
        return Backend("llvm", VARIANTS["llvm"], f"{reason}; libLLVM {'.'.join(map(str, library.version))}", library)
    problem = "no libLLVM found" if library is None else f"libLLVM at {library.path} is older than {OLDEST_LLVM}"
    if device == "llvm":
        raise InputError("--device", problem, got="llvm", cure=LLVM_CURE)
    return Backend("scalar", VARIANTS["scalar"], f"{problem}; slower, and without gradients", library, problem)


def _check_name(device: str) -> None:
    if device not in ("auto", *VARIANTS):
        raise InputError("--device", "unknown device", got=device, expected="auto, cuda, llvm or scalar")


_active: Backend | None = None


def use_backend(device: str | None = None, *, gradients: bool = False) -> Backend:
    """Set Mitsuba's variant once per process and return the active backend.

    Parameters
    ----------
    device
        ``auto``, ``cuda``, ``llvm`` or ``scalar``; by default the environment variable ``SEASONSCAPES_DEVICE``, else
        ``auto``. Later calls return the backend that the first call has set.
    gradients
        Require a variant with automatic differentiation.

    Returns
    -------
    Backend
        The active backend.

    Raises
    ------
    InputError
        If the device is not available, if ``gradients`` are required and the variant is scalar, or if another device
        is already active in this process.
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
        if chosen.device == "scalar" and chosen.library_problem:
            log.warning("renderer: the scalar variant, since %s: much slower; %s", chosen.library_problem, LLVM_CURE)
    elif device not in (None, "auto", _active.device):
        raise InputError("--device", f"the device of this process is already {_active.device}", got=device)
    if gradients and _active.device == "scalar":
        raise InputError("--device", "gradients are required, and the scalar variant has none", cure=LLVM_CURE)
    return _active


def to_numpy(values: Any) -> np.ndarray:
    """Copy a Mitsuba or Dr.Jit array to numpy, with the component axis last.

    Parameters
    ----------
    values
        Dr.Jit array of N lanes, whose own axis order is (component, lane).

    Returns
    -------
    numpy.ndarray
        ``(N,)`` or ``(N, C)``, float32 for Mitsuba's floats.
    """
    import drjit as dr

    if dr.depth_v(values) < 2:
        return np.array(values)
    # Component by component: Dr.Jit would compile a kernel that joins them for each number of lanes.
    components = list(values)
    dr.eval(components)
    # As they lie in Dr.Jit's memory: joining them is the only copy.
    return np.stack(np.broadcast_arrays(*map(np.asarray, components)), axis=-1)


def aligned(values: np.ndarray, dtype: Any = np.float32) -> np.ndarray:
    """Return values as memory that Dr.Jit can take over, its beginning aligned.

    Dr.Jit reads numpy's memory where it lies, and compiles a kernel of its own for each pattern of aligned and unaligned
    inputs; where numpy's arrays begin is chance. All kernels would be compiled anew time and again, for most of the
    time of a small picture.

    Parameters
    ----------
    values
        Any shape.
    dtype
        Of the result.

    Returns
    -------
    numpy.ndarray
        Contiguous, of the same shape, beginning at a multiple of 64 bytes; a copy where the values do not.
        Otherwise it may share the caller's memory, which must not be written to while Dr.Jit may still read it.

    Examples
    --------
    >>> import numpy as np
    >>> from seasonscapes.rendering.backend import aligned
    >>> aligned(np.arange(9)[1:]).ctypes.data % 64
    0
    """
    values = np.ascontiguousarray(values, dtype)
    if values.ctypes.data % _ALIGNMENT == 0:
        return values
    memory = np.empty(values.nbytes + _ALIGNMENT, np.uint8)
    first = -memory.ctypes.data % _ALIGNMENT
    result = memory[first : first + values.nbytes].view(values.dtype).reshape(values.shape)
    result[...] = values
    return result


def point3(values: np.ndarray) -> Any:
    """Convert positions or directions to Mitsuba lanes (vectorised variants only).

    Parameters
    ----------
    values
        ``(N, 3)``.

    Returns
    -------
    mi.Point3f
        N lanes of float32.
    """
    import mitsuba as mi

    return mi.Point3f(*(mi.Float(aligned(values[:, axis])) for axis in range(3)))


def probe_in_child(device: str = "auto", *, timeout_s: float = 120.0) -> tuple[bool, str]:
    """Run the test render of `probe` in a child process, so that an aborting library does not end this one.

    Parameters
    ----------
    device
        See `choose_backend`.
    timeout_s
        The child process is ended after this time [s].

    Returns
    -------
    success
        Whether the test render succeeded.
    message
        One line about its result, or the error.
    """
    command = [sys.executable, "-m", "seasonscapes.rendering.probe", device]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        return False, f"the test render did not finish within {timeout_s:.0f} s"
    lines = (result.stdout if result.returncode == 0 else result.stderr).strip().splitlines() or ["no output"]
    if result.returncode < 0:
        return False, f"the test render was ended by signal {-result.returncode}: {lines[-1]}"
    return result.returncode == 0, lines[-1]
