"""Just-in-time compilation of the CPU kernels by numba, with the machine code cached on disk."""

from __future__ import annotations

import atexit
import functools
import hashlib
import importlib
import os
import shutil
import stat
import tempfile
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from hyperplanes.utilities.machine.environment import cache_folder, has_amx, has_bfloat16_products
from hyperplanes.utilities.machine.locks import ForkSafeLock

__all__ = ["FASTMATH", "compile_function", "compile_kernel", "layers_module"]

FASTMATH = {"contract", "reassoc", "arcp", "nsz"}  # all but the flags that assume no NaN and no infinity

MACHINE_CODE_BYTES = 2**21
"""Approximate size of the machine code of all kernels, in bytes."""

LLVM_OF_BFLOAT16 = (20, 0, 0)
"""The first LLVM version tried that compiles bfloat16; 15 leaves a call of an AMX function that does not exist."""

_STRIDED = "T[::1], UniTuple(int64, 3)"  # a tensor of three dimensions as its memory and strides
_POINTS = "T[::1], int64, T[:, :, ::1], none, none"  # points, their pitch, matrices
_COORDINATES = f"none, int64, none, {_STRIDED}"  # none, their pitch, none, coordinates
_IMAGES = "T[:, :, :, ::1], uint32[::1], int64, int64, int64"  # planes, the same packed, bits, height, width
_SIGNATURES = {  # by module and function, without those of points; T is the dtype
    "lookup.forward.forward": f"{_IMAGES}, T, T, T[::1], T[::1], uint8[::1], boolean, int64[:, ::1]",
    "lookup.backward.backward": f"{_IMAGES}, T, {_STRIDED}, {_STRIDED}, T[::1], float64[:, ::1], int64[:, ::1]",
    "lookup.backward.image_backward": f"int64, int64, T, {_STRIDED}, int64, int64, T[::1], int64[:, ::1]",
    "hull.carving.carve": (
        "T[:, :, ::1], T[:, :, ::1], int32[:, :, ::1], T[::1], T, T, T, T, uint8[:, :, ::1], int64, int64"
    ),
    "visibility.choosing.choose": (
        "T[::1], T[::1], T[::1], T[::1], UniTuple(int64, 6), T[::1], int64[::1], T[::1], int64[::1], T[::1], T[::1], "
        "int64, int64"
    ),
    "visibility.describing.describe": (
        "T[:, ::1], T[:, ::1], T[::1], T[::1], T[::1], uint32[::1], T[:, :, :, ::1], UniTuple(int64, 9), T[::1], "
        "T[::1], T[:, ::1], T[::1], T[:, ::1], T[:, ::1], T[:, :, ::1], int64, int64"
    ),
    "voxels.marching.march": (
        "T[:, ::1], T[:, ::1], T[::1], T[::1], T, T[::1], T[::1], uint8[:, :, ::1], int64[::1], T[::1], int64[::1], "
        "int64, int64"
    ),
    "hull.hull_hits.hull_hits": (
        "T[:, ::1], T[:, ::1], T[::1], T[::1], T, T[::1], T[::1], uint8[:, :, ::1], T[::1], T[::1], "
        "UniTuple(int64, 4), T[::1], T[::1], int64, int64"
    ),
    "hull.centres.centres": ("T[::1], T[::1], UniTuple(int64, 4), T[::1], T, T[::1], uint8[:, :, ::1], int64, int64"),
    "hull.first_hits.first_hits": (
        "T[:, ::1], T[:, :, :, ::1], T[:, :, :], T[::1], T, T[::1], uint8[:, :, ::1], T[:, :, ::1], int64, int64"
    ),
    "hull.footprints.footprints": "T[:, ::1], T[:, :, ::1], T[:, :, ::1], T, T, boolean[:, :, ::1], int64, int64",
    "layers.single.layers": "T[:, :], T[::1], T[::1], UniTuple(int64, 3), T[:, ::1], int64, int64",
    "layers.bfloat16.layers": "T[:, :], int32[::1], T[::1], UniTuple(int64, 3), T[:, ::1], int64, int64",
    "layers.amx_bfloat16.layers": "T[:, :], int16[::1], T[::1], UniTuple(int64, 3), T[:, ::1], int64, int64",
    "layers.amx.layers": "T[:, :], int16[::1], T[::1], UniTuple(int64, 3), T[:, ::1], int64, int64",
}


@functools.cache
def layers_module(*, mixed_precision: bool = False) -> str | None:
    """The module of this package whose layer kernel is faster than PyTorch on this processor.

    Args:
        mixed_precision: whether factors may be rounded to bfloat16.

    Returns:
        "layers.amx" or "layers.amx_bfloat16" for AMX, "layers.bfloat16" for AVX-512's bfloat16 instructions,
        "layers.single" for AVX-512 alone; None without these or numba. All but the last need LLVM 20, and an
        environment that neither sets numba's target processor nor forbids AVX.
    """
    if not find_spec("numba"):
        return None
    from llvmlite.binding import get_host_cpu_features, llvm_version_info
    from numba.core import config

    told_otherwise = getattr(config, "CPU_NAME", None) or getattr(config, "CPU_FEATURES", None)
    for_this_processor = not told_otherwise and getattr(config, "ENABLE_AVX", True)
    if for_this_processor and llvm_version_info >= LLVM_OF_BFLOAT16:
        if has_amx():
            return "layers.amx_bfloat16" if mixed_precision else "layers.amx"
        if mixed_precision and has_bfloat16_products():
            return "layers.bfloat16"
    try:
        return "layers.single" if get_host_cpu_features().get("avx512f") else None
    except RuntimeError:  # a processor unknown to LLVM
        return None


@functools.cache
def compile_kernel(name: str, dtype: torch.dtype, points: str = "") -> Callable[..., None]:
    """A kernel of this package, compiled ahead of its first call.

    Args:
        name: module and function, one of the keys of `_SIGNATURES`.
        dtype: float32 or float64.
        points: "projected" or "given" for the kernels of lookup and sampling.
    """
    module, _, function = name.rpartition(".")
    kernels = importlib.import_module(f"hyperplanes.geometry.kernels.{module}")
    number = str(dtype).removeprefix("torch.")
    signature = {"": "", "projected": f"{_POINTS}, ", "given": f"{_COORDINATES}, "}[points] + _SIGNATURES[name]
    signature = signature.replace("T[", f"{number}[").replace("T,", f"{number},")
    return compile_function(getattr(kernels, function), f"void({signature})")


def compile_function(function: Callable[..., Any], signature: str | None = None) -> Callable[..., Any]:
    """A function compiled by numba, which releases the interpreter lock when called.

    Several threads that ask for it at once compile it once.

    Args:
        function: loops over NumPy arrays.
        signature: types of its arguments, compiled at once; without it they are those of the first call.
    """
    with _compiling:
        return _compiled(function, signature)


@functools.cache
def _compiled(function: Callable[..., Any], signature: str | None) -> Callable[..., Any]:
    from numba import njit
    from numba.core import config

    previous = getattr(config, "CACHE_DIR", "")
    setattr(config, "CACHE_DIR", _cache_folder())  # noqa: B010 - the module's attributes are not declared
    try:
        options = {"fastmath": FASTMATH, "error_model": "numpy", "nogil": True, "cache": True}
        if signature is None:
            return njit(**options)(function)
        with _one_at_a_time(Path(_cache_folder()) / f"{function.__module__}.{function.__name__}.lock"):
            return njit(signature, **options)(function)
    finally:
        setattr(config, "CACHE_DIR", previous)  # noqa: B010


_compiling = ForkSafeLock()  # numba's settings are those of the process


@contextmanager
def _one_at_a_time(path: Path) -> Generator[None]:
    """Of processes that start together, one compiles each kernel; the others wait and find it in the cache."""
    try:
        import fcntl
    except ImportError:  # Windows: each compiles its own
        yield
        return
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _is_private(folder: Path) -> bool:
    """Whether a folder, and no link to one, belongs to this user and others cannot write to it.

    A folder of this user that is open to others is closed to them.
    """
    if not hasattr(os, "getuid"):
        return True  # Windows: the profile's folders are private
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        return False
    if found.st_mode & 0o077:
        folder.chmod(0o700)
    return True


def _remove(folder: str, process: int) -> None:
    """Delete the folder of a process when it ends, but not when a fork of it ends."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)


@functools.cache
def _cache_folder() -> str:
    """The folder of cached machine code.

    Numba notices changes of the file that contains a function, not of the files of functions it calls: the folder's
    name contains a hash of all sources of this package.

    Numba unpickles its cache, which would run whatever somebody else put there: only this user may write to the folder.
    Where another user owns it, or the disk is full, this process takes a new folder of its own.
    """
    from numba.core import config

    sources = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.rglob("*.py")))
    base = getattr(config, "CACHE_DIR", "") or cache_folder()
    folder = Path(base) / "hyperplanes" / f"kernels-{hashlib.sha256(sources).hexdigest()[:12]}"
    try:
        folder.parent.parent.mkdir(parents=True, exist_ok=True)
        for part in (folder.parent, folder):
            part.mkdir(mode=0o700, exist_ok=True)
        if all(map(_is_private, (folder.parent, folder))):
            with tempfile.TemporaryFile(dir=folder) as file:
                file.write(bytes(MACHINE_CODE_BYTES))
                file.flush()
                return str(folder)
        problem = "it is not this user's alone"
    except OSError as error:
        problem = error.strerror or str(error)
    instead = tempfile.mkdtemp(prefix="hyperplanes-kernels-")
    atexit.register(_remove, instead, os.getpid())
    warnings.warn(f"{folder}: {problem}; kernels are compiled into {instead} for this process alone", stacklevel=2)
    return instead
