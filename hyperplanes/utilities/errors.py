"""Errors that say which object or file they are about."""

from __future__ import annotations

import difflib
import errno
import os
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager

__all__ = [
    "TRACEBACK_VARIABLE",
    "MissingPackageError",
    "did_you_mean",
    "is_memory",
    "nearest",
    "one_line",
    "prefix_errors",
    "rename_errors",
    "wants_traceback",
]

TRACEBACK_VARIABLE = "HYPERPLANES_TRACEBACK"


class MissingPackageError(RuntimeError):
    """A package that not everybody needs is not installed; the message says how to install it."""


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """The end of a message about an unknown name: the nearest one that there is, or nothing.

    >>> did_you_mean("hyperplane", ["hyperplanes", "nerf"])
    '; did you mean hyperplanes?'
    """
    close = difflib.get_close_matches(str(name), list(known), 1)
    return f"; did you mean {close[0]}?" if close else ""


def nearest(name: str, known: Sequence[str]) -> str:
    """What to say after an unknown name: the nearest one that there is, or all of them.

    >>> nearest("stpes", ["rays", "steps"])
    'did you mean steps?'
    """
    return did_you_mean(name, known).removeprefix("; ") or f"expected one of {', '.join(known)}"


@contextmanager
def prefix_errors(name: str) -> Generator[None]:
    """Puts a name before the message of every ValueError raised within.

    Raises:
        ValueError: as the one that was raised, with the name before it.
    """
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


@contextmanager
def rename_errors(argument: str, option: str) -> Generator[None]:
    """Puts the name that was typed in place of an argument's, with which a ValueError raised within begins.

    >>> with rename_errors("level", "--level"):
    ...     raise ValueError("level: expected more than 0")
    Traceback (most recent call last):
    ValueError: --level: expected more than 0

    Raises:
        ValueError: as the one that was raised.
    """
    try:
        yield
    except ValueError as error:
        if not str(error).startswith(f"{argument}: "):
            raise
        raise ValueError(f"{option}{str(error).removeprefix(argument)}") from error


def wants_traceback() -> bool:
    """Whether TRACEBACK_VARIABLE asks to be shown where errors came from."""
    return os.environ.get(TRACEBACK_VARIABLE, "") not in ("", "0")


def one_line(error: Exception) -> str:
    """What to say of an error with which a command ended: of wrong input, a full disk or too little memory."""
    if is_memory(error):
        found = " ".join(str(error).split("\n")[0].split()) or "none left"
        return f"expected enough memory, found {found}; ask for smaller or fewer pictures, voxels or processes"
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}expected room to write, found a full disk; free some and run the same command again"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror or error}; check the path and its permissions"
    return " ".join(str(error).split()) or type(error).__name__


def is_memory(error: Exception) -> bool:
    """Whether there was too little memory, for Python or for PyTorch, which says so in words."""
    return isinstance(error, MemoryError) or "can't allocate memory" in str(error) or "out of memory" in str(error)
