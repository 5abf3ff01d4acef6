"""Measurements that benchmarks share: interleaved repetitions, ratios with quartiles, peak memory, copy bandwidth."""

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
from hyperplanes.utilities.machine.timing import clock

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

os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # otherwise the profiler prints a line on every start


@dataclass
class Times:
    """The times of one implementation, one entry per round.

    Attributes:
        wall: wall time in seconds.
        processor: processor time of all threads of this process, in seconds; other processes disturb it less.
    """

    wall: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)


def interleaved(
    ways: dict[str, Callable[[], object]], repeats: int, seconds: float = 60.0, row: int = 1
) -> dict[str, Times]:
    """Measure several implementations alternately, so that other processes disturb all of them equally.

    Args:
        ways: the implementations by name. Each is first called once without being measured.
        repeats: the largest number of rounds. A round measures each implementation once.
        seconds: no round starts later than this.
        row: number of consecutive calls per measurement, of which the mean is taken. In real work, a function that is
            called repeatedly finds its memory and caches warm. A single call after another implementation does not.

    Returns:
        The times of each implementation, per call.
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
    """Add the option --device, the name of a PyTorch device; argparse reports one that this machine does not have."""

    def known(name: str) -> str:
        try:
            return str(choose_device(name))
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    parser.add_argument("--device", type=known, default=default, help="a PyTorch device (default: %(default)s)")


def timed(run: Callable[[], Any]) -> tuple[float, Any]:
    """The wall time of a call in seconds, including the work that it queued on a GPU, and its result."""
    begun = clock()
    result = run()
    return clock() - begun, result


def ratio(reference: list[float], ours: list[float]) -> dict[str, float]:
    """The speedup of `ours` over `reference` in each round: its median and quartiles over the rounds."""
    rounds = sorted(theirs / mine for theirs, mine in zip(reference, ours, strict=True))
    quartiles = statistics.quantiles(rounds, n=4, method="inclusive") if len(rounds) > 1 else rounds * 3
    return dict(zip(("speedup_low", "speedup", "speedup_high"), quartiles, strict=True))


def peak_bytes(run: Callable[[], object], device: str = "cpu") -> int:
    """The peak memory in bytes that PyTorch and NumPy allocate during a call, including its results."""
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
    """Bytes read and written per second, in the fastest of five copies of a large array."""
    source = torch.ones(megabytes << 18, device=device)
    target = torch.empty_like(source)
    times = interleaved({"copy": lambda: target.copy_(source)}, 5)["copy"]
    return 2 * source.numel() * 4 / min(times.wall)


def table(rows: list[dict[str, Any]], columns: list[str]) -> str:
    """The rows as a text table with aligned columns."""
    cells = [columns] + [[_text(row.get(column)) for column in columns] for row in rows]
    widths = [max(len(line[index]) for line in cells) for index in range(len(columns))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in cells)


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def without(owner: type, check: str) -> AbstractContextManager[object]:
    """A context in which a class does not use its kernel.

    Args:
        owner: the class.
        check: its method that returns whether the kernel supports an input; in the context it returns False.
    """
    return patch.object(owner, check, lambda *_: False)
