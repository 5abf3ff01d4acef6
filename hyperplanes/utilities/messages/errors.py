"""Error messages: names of objects and options in them, suggestions, and one line for the command line."""

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
    "listed",
    "nearest",
    "one_line",
    "prefix_errors",
    "rename_errors",
    "wants_traceback",
]

TRACEBACK_VARIABLE = "HYPERPLANES_TRACEBACK"
MOST_NAMES = 20  # in a message


class MissingPackageError(RuntimeError):
    """An optional package is not installed; the message says how to install it."""


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """The end of a message about an unknown name: the nearest known one, or nothing.

    >>> did_you_mean("hyperplane", ["hyperplanes", "nerf"])
    '; did you mean hyperplanes?'
    """
    close = difflib.get_close_matches(str(name), list(known), 1)
    return f"; did you mean {close[0]}?" if close else ""


def nearest(name: str, known: Sequence[str]) -> str:
    """The suggestion after an unknown name: the nearest known one, or all of them.

    >>> nearest("stpes", ["rays", "steps"])
    'did you mean steps?'
    """
    return did_you_mean(name, known).removeprefix("; ") or f"expected one of {', '.join(known)}"


def listed(names: Sequence[str]) -> str:
    """Names for a message: all of them, or the first ones and how many more there are.

    >>> listed(["a", "b"]), listed(["a"] * 22)[-15:]
    ('a, b', 'a, a and 2 more')
    """
    shown = ", ".join(names[:MOST_NAMES])
    return shown if len(names) <= MOST_NAMES else f"{shown} and {len(names) - MOST_NAMES} more"


@contextmanager
def prefix_errors(name: str) -> Generator[None]:
    """Prefix the message of every ValueError raised within with a name.

    Raises:
        ValueError: with the prefixed message.
    """
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


@contextmanager
def rename_errors(argument: str, option: str) -> Generator[None]:
    """Replace an argument's name at the start of ValueErrors raised within by that of the option.

    >>> with rename_errors("level", "--level"):
    ...     raise ValueError("level: expected more than 0")
    Traceback (most recent call last):
    ValueError: --level: expected more than 0

    Raises:
        ValueError: with the renamed argument.
    """
    try:
        yield
    except ValueError as error:
        if not str(error).startswith(f"{argument}: "):
            raise
        raise ValueError(f"{option}{str(error).removeprefix(argument)}") from error


def wants_traceback() -> bool:
    """Whether TRACEBACK_VARIABLE asks for tracebacks."""
    return os.environ.get(TRACEBACK_VARIABLE, "") not in ("", "0")


def one_line(error: Exception) -> str:
    """The message of an error that ended a command: wrong input, a full disk or too little memory."""
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
    """Whether Python or PyTorch, which says so in its message, ran out of memory."""
    return isinstance(error, MemoryError) or "can't allocate memory" in str(error) or "out of memory" in str(error)
