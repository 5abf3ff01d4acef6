"""The output of every benchmark: rows, with the commit and the hardware that they were measured on."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.parts.load import load_at_start
from hyperplanes.utilities.files.writing import finite, write_whole
from hyperplanes.utilities.machine.environment import environment

__all__ = ["Row", "finish", "write_rows"]

Row = dict[str, str | float | int]


def finish(name: str, rows: list[Row], json_file: Path | None, device: str = "cpu") -> int:
    """Print the rows, one per line, and write them with their environment if a file is given.

    Args:
        name: of the benchmark.
        rows: the results; each has a "name".
        json_file: the file to write.
        device: of the measurement.

    Returns:
        The exit code, 0.
    """
    for row in rows:
        numbers = (f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items())
        print("  ".join(numbers).removeprefix("name "))
    if json_file is not None:
        write_rows(name, rows, json_file, device)
    return 0


def write_rows(name: str, rows: list[Row], json_file: Path, device: str = "cpu", **about: object) -> None:
    """Write rows with the commit, the hardware, the load, and further entries."""
    machine = environment() | {"load": round(load_at_start(), 2)}
    content = {"benchmark": name, "device": device, **machine, **about, "rows": rows}
    write_whole(json_file, (json.dumps(finite(content), indent=2) + "\n").encode())
