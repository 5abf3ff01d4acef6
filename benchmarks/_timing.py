"""Measuring that benchmarks share: interleaved repetitions, ratios with their spread, peak memory, copy bandwidth."""

from __future__ import annotations

import argparse
import os
import statistics
import time
import tracemalloc
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import torch

from hyperplanes.data.devices import choose_device
from hyperplanes.utilities.timing import clock

__all__ = [
    "Times",
    "add_device_option",
    "copy_bandwidth",
    "interleaved",
    "peak_bytes",
    "ratio",
    "table",
    "timed",
    "without",
]

os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # the profiler announces itself on every start otherwise


@dataclass
class Times:
    """Of one way, by round.

    Attributes:
        wall: seconds that passed.
        processor: seconds that all threads of this process computed; less disturbed by others on the machine.
    """

    wall: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)


def interleaved(
    ways: dict[str, Callable[[], object]], repeats: int, seconds: float = 60.0, row: int = 1
) -> dict[str, Times]:
    """The times of every way, each in turn, so that all meet the same disturbances.

    Args:
        ways: by name; each is run once before, unmeasured.
        seconds: no further round is begun after this time.
        row: runs in a row that make one turn, whose mean counts; what is called again and again in real work finds its
            memory and its caches warm, which a single run after another way does not.

    Returns:
        Times of each way.
    """
    for run in ways.values():
        run()
    times = {name: Times() for name in ways}
    names, end = list(ways), time.perf_counter() + seconds
    for turn in range(repeats):
        if turn and time.perf_counter() > end:
            break
        for name in names[turn % len(names) :] + names[: turn % len(names)]:
            begun, computed = time.perf_counter(), time.process_time()
            for _ in range(row):
                ways[name]()
            times[name].wall.append((clock() - begun) / row)
            times[name].processor.append((time.process_time() - computed) / row)
    return times


def add_device_option(parser: argparse.ArgumentParser, default: str) -> None:
    """Adds --device, a name of PyTorch; one that is not here ends the program with a line."""

    def known(name: str) -> str:
        try:
            return str(choose_device(name))
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    parser.add_argument("--device", type=known, default=default, help="what computes (default: %(default)s)")


def timed(run: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a call, all that it left to a GPU included, and what it returned."""
    begun = clock()
    result = run()
    return clock() - begun, result


def ratio(reference: list[float], ours: list[float]) -> dict[str, float]:
    """How many times faster ours is: median and quartiles over the rounds, each round compared with itself."""
    rounds = sorted(theirs / mine for theirs, mine in zip(reference, ours, strict=True))
    quartiles = statistics.quantiles(rounds, n=4, method="inclusive") if len(rounds) > 1 else rounds * 3
    return dict(zip(("speedup_low", "speedup", "speedup_high"), quartiles, strict=True))


def peak_bytes(run: Callable[[], object], device: str = "cpu") -> int:
    """The most memory that PyTorch and NumPy held for one run, beyond what was there before, results included."""
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats()
        held = torch.cuda.memory_allocated()
        run()
        return torch.cuda.max_memory_allocated() - held
    tracemalloc.start()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        kept = run()
        arrays = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    assert profile.profiler is not None
    events: Any = profile.profiler.kineto_results
    changes = [(event.start_ns(), event.nbytes()) for event in events.events() if event.name() == "[memory]"]
    del kept
    held = peak = 0
    for _, change in sorted(changes):
        held += change
        peak = max(peak, held)
    return peak + arrays


def copy_bandwidth(megabytes: int = 512, device: str = "cpu") -> float:
    """Bytes a second, read and written together, of the best of five copies of a large array."""
    source = torch.ones(megabytes << 18, device=device)
    target = torch.empty_like(source)
    times = interleaved({"copy": lambda: target.copy_(source)}, 5)["copy"]
    return 2 * source.numel() * 4 / min(times.wall)


def table(rows: list[dict[str, Any]], columns: list[str]) -> str:
    """The rows as text, one column each."""
    cells = [columns] + [[_text(row.get(column)) for column in columns] for row in rows]
    widths = [max(len(line[index]) for line in cells) for index in range(len(columns))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in cells)


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def without(owner: type, check: str) -> AbstractContextManager[object]:
    """While it lasts, a kernel is not used.

    Args:
        owner: the class that uses it.
        check: its method that says whether the kernel takes something; it says no.
    """
    return patch.object(owner, check, lambda *_: False)
