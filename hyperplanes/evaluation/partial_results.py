"""A file with the scores that an evaluation has measured so far."""

from __future__ import annotations

import time
from pathlib import Path

from hyperplanes.evaluation.scores import ObjectScore
from hyperplanes.utilities.files.writing import write_json

__all__ = ["PartialResults"]


class PartialResults:
    """Writes the scores so far to NAME.partial.json beside the file NAME.json of `--json`, until that is written.

    Args:
        path: the file of `--json`; with None, nothing is written.
    """

    seconds = 10.0  # least time between two writes

    def __init__(self, path: Path | None) -> None:
        self.path = None if path is None else path.with_name(f"{path.stem}.partial.json")
        self._found: dict[str, dict[str, object]] = {}
        self._written = 0.0

    def add(self, method: str, seed: int, score: ObjectScore) -> None:
        """Add a score; the file is written at most every ten seconds."""
        row = f"{method}, seed {seed}" if seed else method
        self._found.setdefault(row, {})[score.name] = score.as_json()
        if self.path is not None and time.monotonic() - self._written > self.seconds:
            write_json(self.path, {row: {"objects": objects} for row, objects in self._found.items()})
            self._written = time.monotonic()

    def remove(self) -> None:
        """Delete the file."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)
