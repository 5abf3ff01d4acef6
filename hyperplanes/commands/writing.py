"""Verbs that write into a folder, of which one runs at a time there."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

from hyperplanes.utilities.processes import is_first_process

__all__ = ["writes_to"]


def writes_to(
    folder: Callable[[Any], Path], *, by_first_process: bool = False
) -> Callable[[Callable[[Any], int]], Callable[[Any], int]]:
    """A decorator of a verb's `run`: it fails at once where another process writes into the same folder.

    Args:
        folder: from a verb's arguments the folder that it writes into, as in `files.one_writer`.
        by_first_process: of several processes of one command, the first one alone writes.

    Returns:
        The decorator.
    """

    def decorate(run: Callable[[Any], int]) -> Callable[[Any], int]:
        @wraps(run)
        def locked(arguments: Any) -> int:
            from hyperplanes.files import one_writer

            if by_first_process and not is_first_process():
                return run(arguments)
            with one_writer(folder(arguments)):
                return run(arguments)

        return locked

    return decorate
