"""Stages of a long task, with results in files: a stage that is done is not repeated while its inputs stay the same."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyperplanes.utilities.files.encoding import sha256
from hyperplanes.utilities.files.reading import DataError, read_json
from hyperplanes.utilities.files.writing import write_json

__all__ = ["Stages", "fingerprint"]


def fingerprint(*inputs: object) -> str:
    """A short hash of the inputs.

    Args:
        inputs: values that JSON can hold; others are replaced by their `str`.
    """
    return sha256(json.dumps(inputs, sort_keys=True, default=str).encode())[:16]


@dataclass(frozen=True)
class Stages:
    """The working folder of a task.

    Attributes:
        folder: that holds the results.
    """

    folder: Path

    def begin(self, name: str, key: str) -> dict[str, Any] | None:
        """The result of a stage, if it is done with the same inputs; otherwise its folder is prepared.

        Files that were made from other inputs are deleted. Those of an interrupted stage with the same inputs are kept.

        Args:
            name: of the stage; its files lie in a folder of that name.
            key: fingerprint of its inputs.

        Returns:
            The result that `finish` was given; None if the stage has to be done or completed.
        """
        record = self._read(name)
        if record.get("key") == key and record.get("done") and isinstance(record.get("result"), dict):
            return record["result"]
        if record.get("key") != key:
            self._path(name).unlink(missing_ok=True)  # first, so that an interruption leaves no record of deleted files
            shutil.rmtree(self.folder / name, ignore_errors=True)
            (self.folder / name).mkdir(parents=True)
            write_json(self._path(name), {"key": key, "done": False})
        return None

    def finish(self, name: str, key: str, result: dict[str, Any]) -> dict[str, Any]:
        """Record that a stage is done.

        Args:
            name: of the stage.
            key: as given to `begin`.
            result: that `begin` will return.

        Returns:
            The result.
        """
        write_json(self._path(name), {"key": key, "done": True, "result": result})
        return result

    def key(self, name: str) -> str:
        """The fingerprint of the inputs with which a stage was last begun; empty if it never was."""
        return self._read(name).get("key", "")

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.json"

    def _read(self, name: str) -> dict[str, Any]:
        try:
            return read_json(self._path(name))
        except DataError:
            return {}
