"""Machine code of the CPU kernels, made once and kept on disk."""

from __future__ import annotations

import functools
import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from numba import njit
from numba.core import config

from hyperplanes.geometry import kernels_carving, kernels_cpu, kernels_gradient, kernels_sampling

__all__ = ["compiled"]

_IMAGES = "T[:, :, :, ::1], uint32[::1], int64, int64, int64"  # planes, the same packed, bits, height, width
_LOOKUP = "T[::1], int64, {views}T[:, :, ::1], {images}, "
_FLAT = "T[::1], UniTuple(int64, 3)"  # a tensor of three dimensions as its memory and strides
_SIGNATURES = {
    "forward": _LOOKUP + "T, T, T[::1], T[::1], uint8[::1], int64, int64",
    "backward": _LOOKUP + "T, {flat}, {flat}, T[::1], float64[:, ::1], int64, int64, int64",
    "image_backward": "T[::1], int64, {views}T[:, :, ::1], int64, int64, T, {flat}, int64, int64, T[::1], "
    "int64, int64, int64",
    "sample": "{images}, T, {flat}, T[::1], int64, int64, int64, int64, int64",
    "sample_backward": "{images}, {flat}, {flat}, T[::1], int64, T[::1], int64, int64, int64, int64, int64",
    "carve": "T[:, :, ::1], T[:, :, ::1], int32[:, :, ::1], T[::1], T, T, T, uint8[:, :, ::1], int64, int64",
}
_MODULES = {
    "forward": kernels_cpu,
    "backward": kernels_gradient,
    "image_backward": kernels_gradient,
    "sample": kernels_sampling,
    "sample_backward": kernels_sampling,
    "carve": kernels_carving,
}
_SOURCES = (
    "vector_memory.py",
    "blocks.py",
    "interpolation.py",
    "kernels_cpu.py",
    "kernels_gradient.py",
    "kernels_sampling.py",
    "kernels_carving.py",
)


def _cache_folder() -> str:
    """Where machine code is kept.

    Numba notices a change of the file that a kernel stands in, not of the files it calls: so all sources are in the
    folder's name.
    """
    here = Path(__file__).parent
    sources = b"".join((here / name).read_bytes() for name in _SOURCES)
    base = getattr(config, "CACHE_DIR", "") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "hyperplanes" / f"kernels-{hashlib.sha256(sources).hexdigest()[:12]}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return str(folder)
    except OSError:
        return tempfile.mkdtemp(prefix="hyperplanes-kernels-")


@functools.cache
def compiled(name: str, dtype: str, chosen: bool = False) -> Callable[..., None]:
    """A kernel for one kind of numbers.

    Args:
        name: "forward", "backward", "image_backward", "sample", "sample_backward" or "carve".
        dtype: "float32" or "float64".
        chosen: whether each point brings its own planes.
    """
    function = getattr(_MODULES[name], f"{name}_chosen" if chosen else name)
    signature = _SIGNATURES[name].format(views="int64[:, ::1], " if chosen else "", flat=_FLAT, images=_IMAGES)
    signature = signature.replace("T[", f"{dtype}[").replace("T,", f"{dtype},")
    options = {"fastmath": {"contract", "reassoc", "arcp", "nsz"}, "error_model": "numpy", "nogil": True}
    kept = getattr(config, "CACHE_DIR", "")
    setattr(config, "CACHE_DIR", _cache_folder())  # noqa: B010 - the module's attributes are not declared
    try:
        return njit(f"void({signature})", cache=True, **options)(function)
    finally:
        setattr(config, "CACHE_DIR", kept)  # noqa: B010
