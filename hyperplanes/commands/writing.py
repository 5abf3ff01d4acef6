"""Verbs that write into a folder, of which one runs at a time there."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

__all__ = ["writes_to"]


def writes_to(
    folder: Callable[[Any], Path], when: Callable[[Any], bool] = lambda arguments: True
) -> Callable[[Callable[[Any], int]], Callable[[Any], int]]:
    """A decorator of a verb's `run`: it fails at once where another process writes into the same folder.

    Args:
        folder: from a verb's arguments the folder that it writes into, as in `files.one_writer`.
        when: whether this process writes there at all; of the processes of one training, the first one alone does.

    Returns:
        The decorator.
    """

    def decorate(run: Callable[[Any], int]) -> Callable[[Any], int]:
        @wraps(run)
        def locked(arguments: Any) -> int:
            from hyperplanes.files import one_writer

            if not when(arguments):
                return run(arguments)
            with one_writer(folder(arguments)):
                return run(arguments)

        return locked

    return decorate
