"""Work in stages that survive an interruption: a stage is done once, and again when what it depends on has changed."""

from __future__ import annotations

import shutil
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyperplanes.utilities.checkpoints import CheckpointError, read_json
from hyperplanes.utilities.files import write_json

__all__ = ["Stage", "Stages"]


@dataclass(frozen=True)
class Stage:
    """One piece of work.

    Attributes:
        name: unique among the stages of a folder.
        settings: what decides the result, JSON-able; the settings of earlier stages it builds on included.
        outputs: files and folders it makes, relative to the folder; removed when the settings have changed.
    """

    name: str
    settings: Mapping[str, Any]
    outputs: Sequence[str]


class Stages:
    """What of a folder's work is done, kept in a JSON file there."""

    def __init__(self, folder: Path, record: str = "stages.json") -> None:
        self.folder = folder
        self.path = folder / record
        self._known: dict[str, Any] = {}
        if self.path.exists():
            self._known = read_json(self.path)
            if wrong := sorted(name for name, entry in self._known.items() if not _is_entry(entry)):
                raise CheckpointError(
                    f"{self.path}: expected settings, done and seconds of every stage, found others of {wrong[0]!r}; "
                    "remove the file, and all stages are done again"
                )

    def done(self, stage: Stage) -> bool:
        """Whether the stage was finished with these settings and its outputs are still there."""
        known = self._known.get(stage.name, {})
        there = all((self.folder / name).exists() for name in stage.outputs)
        return bool(known.get("done")) and known["settings"] == stage.settings and there

    def seconds(self, stage: Stage | str) -> float:
        """How long the stage has taken, over all interruptions."""
        name = stage if isinstance(stage, str) else stage.name
        return float(self._known.get(name, {}).get("seconds", 0.0))

    @contextmanager
    def work(self, stage: Stage) -> Generator[None]:
        """The time in which a stage is worked on; what was made with other settings goes first.

        Yields:
            Nothing; an exception leaves the stage unfinished, to be gone on with.
        """
        known = self._known.get(stage.name)
        if known is None or known["settings"] != stage.settings:
            for name in stage.outputs if known else ():
                _remove(self.folder / name)
            self._known[stage.name] = {"settings": stage.settings, "done": False, "seconds": 0.0}
        entry = self._known[stage.name]
        entry["done"] = False
        write_json(self.path, self._known)
        started = time.perf_counter()
        try:
            yield
            entry["done"] = True
        finally:
            entry["seconds"] += time.perf_counter() - started
            write_json(self.path, self._known)


def _is_entry(entry: object) -> bool:
    kinds = {"settings": dict, "done": bool, "seconds": int | float}
    return isinstance(entry, dict) and all(isinstance(entry.get(name), kind) for name, kind in kinds.items())


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
