"""Checks of output files and folders, and a lock so that one process at a time writes into a folder."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hyperplanes.commands.output.console import Console

__all__ = ["check_output", "keep_if_possible", "refuse_checkpoint", "refuse_foreign", "writes_to"]

READ = re.compile(
    r"(manifest|model|training|transforms|diagnostics|initial)([-_]\w+)?\.json|object\.json|.*_splits\.json|config\.yaml"
)
"""Names of files that are read as a part of a model, a training or a data set."""

TRAINING = {"config.yaml", "initial.json", "model.json", "model.safetensors", "training.json"}
"""Files of which a folder of a training has at least one."""

WEIGHTS = re.compile(r"(model|training-\d+)\.safetensors")


def keep_if_possible(path: Path, keep: Callable[[], None], console: Console) -> None:
    """Write a result to the disk cache; if that fails, warn and continue.

    Args:
        path: the file or folder in the cache, for the warning.
        keep: writes it.
        console: prints the warning.
    """
    try:
        keep()
    except OSError as error:
        console.warn(f"{path}: not kept for later commands: {error}")


def refuse_checkpoint(out: Path, checkpoint: Path) -> None:
    """Refuse an output that would replace a trained model.

    Args:
        out: a folder for a checkpoint, or a safetensors file.
        checkpoint: the model that is read.

    Raises:
        ValueError: the output is the folder of that model or of a training, or a file of a checkpoint.
    """
    from hyperplanes.adaptation.checkpoints import checkpoint_folder, find_checkpoints

    if out.suffix == ".safetensors":
        taken = WEIGHTS.fullmatch(out.name) is not None and (out.parent / "model.json").exists()
    else:
        models = (checkpoint_folder(checkpoint), *find_checkpoints([checkpoint]).values())
        taken = out.resolve() in {path.resolve() for path in models} or (out / "training.json").exists()
    if taken:
        raise ValueError(f"--out: expected a path without a trained model, got {out}, where one is; name another")


def refuse_foreign(out: Path) -> None:
    """Refuse a folder for a training that has files, but none of a training.

    Args:
        out: the folder; it need not exist.

    Raises:
        DataError: such a folder.
    """
    from hyperplanes.utilities.files.reading import DataError

    names = {path.name for path in out.iterdir()} - {".lock"} if out.is_dir() else set()
    if names and names.isdisjoint(TRAINING):
        found = ", ".join(sorted(names)[:3])
        raise DataError(out, "an empty folder or that of a training", found, "name another one")


def check_output(option: str, path: Path | None) -> None:
    """Refuse an output file that cannot be written, or that would replace a file of a model, training or data set.

    Args:
        option: the name of the option, without dashes.
        path: the file; None is accepted.

    Raises:
        ValueError: a folder, a path below a file, a folder without write permission, or a file of a model, a training
            or a data set.
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
    """A decorator for the `run` of a verb, which fails at once if another process writes into the same folder.

    If the verb fails, folders that were created and are empty are removed again.

    Args:
        folder: returns the folder that the verb writes into, as in `files.writing.one_writer`, from its arguments.
        when: whether this process writes there. Of the processes of one training, only the first one does.
        check: called before the folder is created; it raises if the folder may not be written into.

    Returns:
        The decorator.
    """

    def decorate(run: Callable[[Any], int]) -> Callable[[Any], int]:
        @wraps(run)
        def locked(arguments: Any) -> int:
            from hyperplanes.utilities.files.writing import one_writer

            check(arguments)
            if not when(arguments):
                return run(arguments)
            place = folder(arguments)
            made = [each for each in (place, *place.parents) if not each.exists()]
            try:
                with one_writer(place):
                    return run(arguments)
            except BaseException:
                with suppress(OSError):  # a folder that is not empty stays, with all folders above it
                    for each in made:
                        each.rmdir()
                raise

        return locked

    return decorate
