"""Stages of a long task whose results lie in files: what was done with the same inputs is not done again."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hyperplanes.utilities.encoding import sha256
from hyperplanes.utilities.files import DataError, read_json
from hyperplanes.utilities.writing import write_json

__all__ = ["Stages", "fingerprint"]


def fingerprint(*inputs: object) -> str:
    """A short text that changes when one of the inputs does.

    Args:
        inputs: what JSON can hold; other values count by their text.
    """
    return sha256(json.dumps(inputs, sort_keys=True, default=str).encode())[:16]


@dataclass(frozen=True)
class Stages:
    """The working folder of a task.

    Attributes:
        folder: what holds the results.
    """

    folder: Path

    def begin(self, name: str, key: str) -> dict[str, Any] | None:
        """What a stage left behind when it was last done with the same inputs.

        Files of the stage that were made from other inputs are deleted, those of an interrupted one with these stay.

        Args:
            name: of the stage; its files lie in a folder of that name.
            key: fingerprint of its inputs.

        Returns:
            What `finish` was given; None where the stage has to be done, or done to its end.
        """
        record = self._read(name)
        if record.get("key") == key and record.get("done") and isinstance(record.get("result"), dict):
            return record["result"]
        if record.get("key") != key:
            shutil.rmtree(self.folder / name, ignore_errors=True)
            (self.folder / name).mkdir(parents=True)
            write_json(self._path(name), {"key": key, "done": False})
        return None

    def finish(self, name: str, key: str, result: dict[str, Any]) -> dict[str, Any]:
        """Note that a stage is done.

        Args:
            name: of the stage.
            key: as `begin` was given it.
            result: what `begin` will return.
        """
        write_json(self._path(name), {"key": key, "done": True, "result": result})
        return result

    def key(self, name: str) -> str:
        """The fingerprint of the inputs that a stage was last begun with; empty where it never was."""
        return self._read(name).get("key", "")

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.json"

    def _read(self, name: str) -> dict[str, Any]:
        try:
            return read_json(self._path(name))
        except DataError:
            return {}
