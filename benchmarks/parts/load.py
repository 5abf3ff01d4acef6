"""The load of the machine by other processes, which affects every measured time."""

from __future__ import annotations

import os
import time
from functools import cache
from pathlib import Path

__all__ = ["LIMIT", "OF_SPEED", "load_at_start", "measure_load"]

LIMIT = 0.3  # cores that other processes may use when rows are written
OF_SPEED = frozenset(
    {
        "adapting",
        "baked",
        "busy",
        "generation",
        "gpu",
        "lookup",
        "rendering",
        "small",
        "splats",
        "steps",
        "training",
        "visibility",
    }
)
"""Benchmarks whose figures depend on the load."""

STATISTICS = Path("/proc/stat")


@cache
def load_at_start() -> float:
    """The result of `measure_load` at the first call, before the work of the benchmark begins."""
    return measure_load()


def measure_load(seconds: float = 1.0) -> float:
    """The number of cores that are busy while this process sleeps; without /proc/stat, the load average of a minute."""
    if not STATISTICS.exists():
        return os.getloadavg()[0]
    before, begun = _busy_ticks(), time.perf_counter()
    time.sleep(seconds)
    passed = time.perf_counter() - begun
    return (_busy_ticks() - before) / os.sysconf("SC_CLK_TCK") / passed


def _busy_ticks() -> int:
    """Busy clock ticks of all cores so far: user, nice, system, interrupts, soft interrupts, stolen."""
    user, nice, system, _, _, interrupt, soft, stolen, *_ = map(int, STATISTICS.read_text().splitlines()[0].split()[1:])
    return user + nice + system + interrupt + soft + stolen
