"""A record of the work done in a folder, which is repeated only if its settings have changed."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hyperplanes.utilities.files.checkpoints import CheckpointError, read_json
from hyperplanes.utilities.files.writing import write_json

__all__ = ["Record", "plain"]


class Record:
    """The settings, the completion and the duration of every piece of work, in a JSON file.

    Args:
        path: the file.

    Raises:
        CheckpointError: the file has invalid entries.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._known: dict[str, Any] = read_json(path) if path.exists() else {}
        if wrong := sorted(name for name, entry in self._known.items() if not _is_entry(entry)):
            raise CheckpointError(
                f"{path}: expected settings, done and seconds of every stage, found others of {wrong[0]!r}; "
                "remove the file, and all stages are done again"
            )

    def done(self, name: str, settings: Mapping[str, Any], *outputs: Path) -> bool:
        """Whether the work was finished with these settings and its outputs are still there."""
        known = self._known.get(name, {})
        return bool(known.get("done")) and known["settings"] == plain(settings) and all(p.exists() for p in outputs)

    def seconds(self, name: str) -> float:
        """The seconds that the work has taken, over all interruptions."""
        return float(self._known.get(name, {}).get("seconds", 0.0))

    @contextmanager
    def working(self, name: str, settings: Mapping[str, Any], *outputs: Path) -> Generator[None]:
        """A context for a piece of work. After an exception it is not done, and a later call resumes it.

        Args:
            name: the name of the work.
            settings: all settings on which the result depends, as values for JSON.
            outputs: files and folders, which are removed first if they were made with other settings.
        """
        known = self._known.get(name)
        if known is None or known["settings"] != plain(settings):
            for path in outputs if known else ():
                _remove(path)
            self._known[name] = {"settings": plain(settings), "done": False, "seconds": 0.0}
        entry = self._known[name]
        entry["done"] = False
        write_json(self.path, self._known)
        started = time.perf_counter()
        try:
            yield
            entry["done"] = True
        finally:
            entry["seconds"] += time.perf_counter() - started
            write_json(self.path, self._known)


def plain(settings: Mapping[str, Any]) -> Any:
    """Settings as a JSON file would return them, for comparison with those read from one."""
    return json.loads(json.dumps(settings))


def _is_entry(entry: object) -> bool:
    kinds = {"settings": dict, "done": bool, "seconds": int | float}
    return isinstance(entry, dict) and all(isinstance(entry.get(name), kind) for name, kind in kinds.items())


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
