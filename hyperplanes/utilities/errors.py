"""Errors that say which object or file they are about."""

from __future__ import annotations

import difflib
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager

__all__ = ["MissingPackageError", "did_you_mean", "nearest", "prefix_errors", "rename_errors"]


class MissingPackageError(RuntimeError):
    """A package that not everybody needs is not installed; the message says how to install it."""


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """The end of a message about an unknown name: the nearest one that there is, or nothing.

    >>> did_you_mean("hyperplane", ["hyperplanes", "nerf"])
    '; did you mean hyperplanes?'

    Args:
        name: what was given.
        known: what there is.
    """
    close = difflib.get_close_matches(str(name), list(known), 1)
    return f"; did you mean {close[0]}?" if close else ""


def nearest(name: str, known: Sequence[str]) -> str:
    """What to say after an unknown name: the nearest one that there is, or all of them.

    >>> nearest("stpes", ["rays", "steps"])
    'did you mean steps?'

    Args:
        name: what was given.
        known: what there is.
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

    Args:
        argument: of the function that is called.
        option: of the command line.

    Raises:
        ValueError: as the one that was raised.
    """
    try:
        yield
    except ValueError as error:
        if not str(error).startswith(f"{argument}: "):
            raise
        raise ValueError(f"{option}{str(error).removeprefix(argument)}") from error
