"""Verbs that write into a folder, of which one runs at a time there."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hyperplanes.commands.console import Console

__all__ = ["check_output", "keep_if_possible", "refuse_checkpoint", "writes_to"]

READ = re.compile(
    r"(manifest|model|training|transforms|diagnostics|initial)([-_]\w+)?\.json|.*_splits\.json|config\.yaml"
)
"""Names of files that this program reads as a model, a training or a data set."""

WEIGHTS = re.compile(r"(model|training-\d+)\.safetensors")


def keep_if_possible(path: Path, keep: Callable[[], None], console: Console) -> None:
    """Keep what was computed for another time; where that fails it is there all the same, and a warning says so.

    Args:
        path: where it is kept.
        keep: writes it.
        console: of the warning.
    """
    try:
        keep()
    except OSError as error:
        console.warn(f"{path}: not kept for another time: {error}")


def refuse_checkpoint(out: Path, checkpoint: Path) -> None:
    """One line where what is made of a model would take the place of a model.

    Args:
        out: a folder for a checkpoint, or a file of weights.
        checkpoint: the model that is read.

    Raises:
        ValueError: the folder of the model that is read or of a training, or a file of a checkpoint.
    """
    from hyperplanes.adaptation.checkpoints import checkpoint_folder, find_checkpoints

    if out.suffix == ".safetensors":
        taken = WEIGHTS.fullmatch(out.name) is not None and (out.parent / "model.json").exists()
    else:
        models = (checkpoint_folder(checkpoint), *find_checkpoints([checkpoint]).values())
        taken = out.resolve() in {path.resolve() for path in models} or (out / "training.json").exists()
    if taken:
        raise ValueError(f"--out: expected a place of its own, got {out}, where a trained model is; name another")


def check_output(option: str, path: Path | None) -> None:
    """One line, before anything is computed, where a file cannot be written or is one that this program reads.

    Args:
        option: the name of the option.
        path: the file, or None.

    Raises:
        ValueError: a folder, a file where its folder should be, a folder that may not be written to, or a file of a
            model, a training or a data set.
    """
    if path is None:
        return
    if path.is_dir():
        raise ValueError(f"--{option}: expected the name of a file to write, got {path}, a folder; name a file in it")
    above = next(each for each in path.absolute().parents if each.exists())
    if not above.is_dir():
        raise ValueError(f"--{option}: expected a file in a folder, got {path}, and {above} is a file; name another")
    if not os.access(above, os.W_OK | os.X_OK):
        raise ValueError(f"--{option}: expected a folder that may be written to, got {above}; name another")
    if path.exists() and READ.fullmatch(path.name):
        raise ValueError(
            f"--{option}: expected a file of its own, got {path}, which is read as a model, a training or a data set; "
            "name another"
        )


def writes_to(
    folder: Callable[[Any], Path],
    when: Callable[[Any], bool] = lambda arguments: True,
    check: Callable[[Any], None] = lambda arguments: None,
) -> Callable[[Callable[[Any], int]], Callable[[Any], int]]:
    """A decorator of a verb's `run`: it fails at once where another process writes into the same folder.

    A folder that was not there before and that a failure leaves empty is removed again.

    Args:
        folder: from a verb's arguments the folder that it writes into, as in `utilities.writing.one_writer`.
        when: whether this process writes there at all; of the processes of one training, the first one alone does.
        check: what raises where the folder may not be written into, before it is made.

    Returns:
        The decorator.
    """

    def decorate(run: Callable[[Any], int]) -> Callable[[Any], int]:
        @wraps(run)
        def locked(arguments: Any) -> int:
            from hyperplanes.utilities.writing import one_writer

            check(arguments)
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
