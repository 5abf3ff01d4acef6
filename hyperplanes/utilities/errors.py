"""Errors that say which object or file they are about."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

__all__ = ["prefix_errors"]


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
