"""Processes of one thread each, in which trainings run side by side and objects are evaluated.

The networks of an experiment are so small that two threads take one training hardly further than one does. Two
processes on two cores make 1.95 times the steps of one: a step of the demonstration's HyperPlanes takes 308 ms beside
PointMultiPlaneNeRF and 306 alone, one of the latter 204 and 194.
"""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self, TypeVar

import torch

from hyperplanes.experiments.data_sets import DataSets
from hyperplanes.utilities.interrupts import interruptible

__all__ = ["Result", "Workers"]


class HasData(Protocol):
    """What a process does its work with: `experiments.engine.Runner`."""

    data: DataSets


Result = TypeVar("Result")
"""What a piece of work returns."""

PATIENCE = 2.0
"""Seconds in which workers end that were sent the signal as well, as by `timeout`: a second one would end a training
before its checkpoint is written."""

SAVING = 10.0
"""Seconds that they have for it."""


class Workers:
    """A pool of processes, which end with the context; what they were doing ends as after SIGTERM.

    Args:
        count: of processes.
        make: makes what a process does its work with; pickled.

    Raises:
        ChildProcessError: at the end of the context, where a process was killed within it.
    """

    def __init__(self, count: int, make: Callable[[], HasData]) -> None:
        self.count, self._make = count, make
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is None:
            return
        if kind is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            children, until = multiprocessing.active_children(), time.monotonic() + PATIENCE
            for child in children:
                child.join(max(0.0, until - time.monotonic()))
            for child in children:
                child.terminate()  # of those that have ended, nothing
            until = time.monotonic() + SAVING
            for child in children:  # one that ended with the lock of the pool's queue leaves others waiting for it
                child.join(max(0.0, until - time.monotonic()))
                child.kill()
        self._pool.shutdown()
        if isinstance(error, BrokenExecutor):
            raise ChildProcessError(
                f"workers: expected {self.count} processes to the end, found that one was killed or ended by itself, "
                "perhaps for want of memory; give fewer --workers, and the same command goes on"
            ) from error

    def submit(self, folders: Mapping[str, Path], work: Callable[[Any], Result]) -> Future[Result]:
        """Do a piece of work in a process, as soon as one is free.

        Args:
            folders: of the data sets by class; a worker generates none.
            work: called with what `make` made in the process; pickled, as its result is.
        """
        pool = self._started()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # of processes that this starts, too
        try:
            return pool.submit(_do, folders, work)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            spawn = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.count, spawn, _start, (self._make,))
        return self._pool


_runner: HasData  # of a worker process


def _start(make: Callable[[], HasData]) -> None:
    global _runner
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent too, which ends its workers
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    torch.set_num_threads(1)
    _runner = make()


def _do(folders: Mapping[str, Path], work: Callable[[Any], Result]) -> Result:
    _runner.data.generated |= folders  # given ones, which the process knows, go first
    with interruptible():
        return work(_runner)
