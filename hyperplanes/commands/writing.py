"""Verbs that write into a folder, of which one runs at a time there."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import Any

__all__ = ["writes_to"]


def writes_to(
    folder: Callable[[Any], Path], when: Callable[[Any], bool] = lambda arguments: True
) -> Callable[[Callable[[Any], int]], Callable[[Any], int]]:
    """A decorator of a verb's `run`: it fails at once where another process writes into the same folder.

    A folder that was not there before and that a failure leaves empty is removed again.

    Args:
        folder: from a verb's arguments the folder that it writes into, as in `files.one_writer`.
        when: whether this process writes there at all; of the processes of one training, the first one alone does.

    Returns:
        The decorator.
    """

    def decorate(run: Callable[[Any], int]) -> Callable[[Any], int]:
        @wraps(run)
        def locked(arguments: Any) -> int:
            from hyperplanes.utilities.files import one_writer

            if not when(arguments):
                return run(arguments)
            place = folder(arguments)
            made = [each for each in (place, *place.parents) if not each.exists()]
            try:
                with one_writer(place):
                    return run(arguments)
            except BaseException:
                with suppress(OSError):  # of a folder with something in it, and all above
                    for each in made:
                        each.rmdir()
                raise

        return locked

    return decorate
