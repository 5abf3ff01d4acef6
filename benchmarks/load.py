"""How busy other processes keep the machine, which every figure of speed depends on."""

from __future__ import annotations

import os
import time
from functools import cache
from pathlib import Path

__all__ = ["LIMIT", "OF_SPEED", "load_at_start", "measure_load"]

LIMIT = 0.3  # cores that others may use beside a measurement that is kept
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
    """What `measure_load` found when this was first called, which is before the benchmark's own work."""
    return measure_load()


def measure_load(seconds: float = 1.0) -> float:
    """Cores that are busy while this process sleeps; the load average of a minute where Linux does not tell."""
    if not STATISTICS.exists():
        return os.getloadavg()[0]
    before, begun = _busy_ticks(), time.perf_counter()
    time.sleep(seconds)
    passed = time.perf_counter() - begun
    return (_busy_ticks() - before) / os.sysconf("SC_CLK_TCK") / passed


def _busy_ticks() -> int:
    """Clock ticks of all cores in which something ran: user, nice, system, interrupts, stolen."""
    user, nice, system, _, _, interrupt, soft, stolen, *_ = map(int, STATISTICS.read_text().splitlines()[0].split()[1:])
    return user + nice + system + interrupt + soft + stolen
