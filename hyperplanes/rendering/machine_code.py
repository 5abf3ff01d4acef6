"""Loops compiled for the CPU where numba is there."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

__all__ = ["machine_code"]


@functools.cache
def machine_code(function: Callable[..., Any]) -> Callable[..., Any] | None:
    """The function compiled, without the interpreter's lock and kept on disk, or None where numba is missing."""
    try:
        import numba
    except ImportError:
        return None
    return numba.njit(fastmath=True, error_model="numpy", nogil=True, cache=True)(function)
