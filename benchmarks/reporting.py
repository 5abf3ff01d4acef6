"""What every benchmark prints and writes: rows, the commit and the hardware they were measured on."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from pathlib import Path

import torch

__all__ = ["Row", "environment", "finish"]

Row = dict[str, str | float | int]


def environment() -> dict[str, object]:
    """The commit, the processor and the versions that a figure depends on."""
    here = Path(__file__).parent
    asked = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=here, capture_output=True, text=True)
    processor = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.split(":", 1)[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        processor = names[0] if names else processor
    return {
        "commit": asked.stdout.strip() or "unknown",
        "processor": processor,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def finish(name: str, rows: list[Row], json_file: Path | None) -> int:
    """Print the rows, one a line, and write them with their environment where asked.

    Args:
        name: of the benchmark.
        rows: what was measured; each has a "name".
        json_file: where to, or None.

    Returns:
        The exit code, 0.
    """
    for row in rows:
        numbers = (f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items())
        print("  ".join(numbers).removeprefix("name "))
    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        content = {"benchmark": name, **environment(), "rows": rows}
        json_file.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return 0
