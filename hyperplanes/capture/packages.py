"""Import the packages of the extra `photos` when they are needed."""

from __future__ import annotations

import os
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from hyperplanes.utilities.machine.interrupts import interrupt_behind, keep_handlers

__all__ = ["is_installed", "require", "stated_threads"]


def is_installed(name: str) -> bool:
    """Whether a package is installed, without importing it."""
    return find_spec(name) is not None


def stated_threads() -> int:
    """The number of threads that OMP_NUM_THREADS states, the first if it is a list; 0 if it states none."""
    stated = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()
    return int(stated) if stated.isdigit() else 0


def require(name: str, purpose: str) -> Any:
    """A module of a package of the extra `photos`. Signal handlers, which pycolmap's import changes, are restored.

    Args:
        name: of the module.
        purpose: what the package does here, for the message.

    Returns:
        The module.

    Raises:
        ValueError: the package is not installed, or cannot be imported.
    """
    try:
        with keep_handlers():
            return import_module(name)
    except Exception as error:  # pycolmap raises RuntimeError after an ImportError or an interrupt
        if (interrupt := interrupt_behind(error)) is not None:
            raise interrupt from None
        absent = isinstance(error, ModuleNotFoundError) and error.name == name
        found = "none" if absent else " ".join(str(error.__cause__ or error).split())
        missing = f"expected the package {name}, which {purpose}, found {found}"
        raise ValueError(f"{missing}; pip install 'hyperplanes[photos]'") from error
