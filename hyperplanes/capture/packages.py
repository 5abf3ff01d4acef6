"""Packages of the extra `photos`, imported when they are needed."""

from __future__ import annotations

import os
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from hyperplanes.utilities.interrupts import interrupt_behind, keep_handlers

__all__ = ["is_installed", "require", "stated_threads"]


def is_installed(name: str) -> bool:
    """Whether a package can be imported; it is not imported."""
    return find_spec(name) is not None


def stated_threads() -> int:
    """How many threads OMP_NUM_THREADS allows, the first of its numbers; 0 where it says nothing."""
    stated = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    return int(stated) if stated.isdigit() else 0


def require(name: str, purpose: str) -> Any:
    """A package of the extra `photos`; signals are handled as before, which pycolmap's import would change.

    Args:
        name: of its module.
        purpose: what it does here, for the message.

    Raises:
        ValueError: it is not installed, or cannot be imported.
    """
    try:
        with keep_handlers():
            return import_module(name)
    except Exception as error:  # pycolmap raises a RuntimeError in answer to an ImportError, or to an interrupt
        if (interrupt := interrupt_behind(error)) is not None:
            raise interrupt from None
        found = " ".join(str(error.__cause__ or error).split())
        missing = f"expected the package {name}, which {purpose}, found {found}"
        raise ValueError(f"{missing}; pip install 'hyperplanes[photos]'") from error
