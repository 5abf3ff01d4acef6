"""Just-in-time compilation of the CPU kernels by numba, with the machine code cached on disk."""

from __future__ import annotations

import functools
import hashlib
import importlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

__all__ = ["FASTMATH", "compile_function", "compile_kernel"]

FASTMATH = {"contract", "reassoc", "arcp", "nsz"}  # all flags but those that assume neither NaN nor infinity

_IMAGES = "T[:, :, :, ::1], uint32[::1], int64, int64, int64"  # planes, the same packed, bits, height, width
_LOOKUP = "T[::1], int64, {views}T[:, :, ::1], {images}, "
_FLAT = "T[::1], UniTuple(int64, 3)"  # a tensor of three dimensions as its memory and strides
_SIGNATURES = {  # by module and function; T is the dtype
    "lookup_forward.forward": _LOOKUP + "T, T, T[::1], T[::1], uint8[::1], int64, int64",
    "lookup_backward.backward": _LOOKUP + "T, {flat}, {flat}, T[::1], float64[:, ::1], int64, int64, int64",
    "lookup_backward.image_backward": "T[::1], int64, {views}T[:, :, ::1], int64, int64, T, {flat}, int64, int64, "
    "T[::1], int64, int64, int64",
    "sample.sample": "{images}, T, {flat}, T[::1], int64, int64, int64, int64, int64",
    "sample.sample_backward": "{images}, {flat}, {flat}, T[::1], int64, T[::1], int64, int64, int64, int64, int64",
    "carving.carve": "T[:, :, ::1], T[:, :, ::1], int32[:, :, ::1], T[::1], T, T, T, uint8[:, :, ::1], int64, int64",
}


@functools.cache
def compile_kernel(name: str, dtype: torch.dtype, chosen: bool = False) -> Callable[..., None]:
    """A kernel of this folder, compiled ahead of its first call.

    Args:
        name: module and function, one of the keys of `_SIGNATURES`.
        dtype: float32 or float64.
        chosen: the variant in which each point has its own planes.
    """
    module, function = name.split(".")
    kernels = importlib.import_module(f"hyperplanes.geometry.kernels.{module}")
    signature = _SIGNATURES[name].format(views="int64[:, ::1], " if chosen else "", flat=_FLAT, images=_IMAGES)
    number = str(dtype).removeprefix("torch.")
    signature = signature.replace("T[", f"{number}[").replace("T,", f"{number},")
    compiled = compile_function(getattr(kernels, f"{function}_chosen" if chosen else function), f"void({signature})")
    assert compiled is not None
    return compiled


@functools.cache
def compile_function(function: Callable[..., Any], signature: str | None = None) -> Callable[..., Any] | None:
    """A function compiled without the interpreter lock, or None where numba is not installed.

    Args:
        function: loops over NumPy arrays.
        signature: types of its arguments, compiled at once; without it they are those of the first call.
    """
    try:
        from numba import njit
        from numba.core import config
    except ImportError:
        return None
    previous = getattr(config, "CACHE_DIR", "")
    setattr(config, "CACHE_DIR", _cache_folder())  # noqa: B010 - the module's attributes are not declared
    try:
        options = {"fastmath": FASTMATH, "error_model": "numpy", "nogil": True, "cache": True}
        return njit(signature, **options)(function) if signature else njit(**options)(function)
    finally:
        setattr(config, "CACHE_DIR", previous)  # noqa: B010


@functools.cache
def _cache_folder() -> str:
    """The folder of cached machine code.

    Numba notices a change of the file that a function stands in, not of the files of functions it calls: a hash of all
    sources of this folder is part of the name.
    """
    from numba.core import config

    sources = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    base = getattr(config, "CACHE_DIR", "") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "hyperplanes" / f"kernels-{hashlib.sha256(sources).hexdigest()[:12]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return str(folder)
    except OSError:
        return tempfile.mkdtemp(prefix="hyperplanes-kernels-")
