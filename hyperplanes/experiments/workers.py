"""Processes with one thread each, which run trainings side by side and evaluate objects.

The networks of an experiment are so small that two threads are hardly faster than one. Two processes on two cores take
1.95 times as many steps as one process: in the demonstration, a step of HyperPlanes takes 308 ms while
PointMultiPlaneNeRF is trained as well and 306 ms alone, and a step of PointMultiPlaneNeRF 204 ms and 194 ms.
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
from hyperplanes.utilities.machine.interrupts import interruptible

__all__ = ["Result", "Workers"]


Result = TypeVar("Result")
"""The result of a piece of work."""

PATIENCE = 2.0
"""Seconds to wait for workers before SIGTERM is sent to them. They may have received a signal as well, for example from
`timeout`, and a second one would end a training before its checkpoint is written."""

SAVING = 10.0
"""Seconds that workers have to write checkpoints after SIGTERM."""


class HasData(Protocol):
    """The object with which a process does its work, such as `engine.Runner`."""

    data: DataSets


class Workers:
    """A pool of processes, as a context. After an exception in the context, they are ended with SIGTERM.

    Args:
        count: the number of processes.
        make: makes the object with which a process does its work; it is pickled.

    Raises:
        ChildProcessError: at the end of the context, if a process was killed.
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
                child.terminate()  # does nothing to a process that has ended
            until = time.monotonic() + SAVING
            # a process may wait forever for the lock of the pool's queue if another died with it
            for child in children:
                child.join(max(0.0, until - time.monotonic()))
                child.kill()
        self._pool.shutdown()
        if isinstance(error, BrokenExecutor):
            raise ChildProcessError(
                f"workers: expected {self.count} processes to the end, found that one was killed or ended by itself, "
                "perhaps for lack of memory; run the same command again with fewer --workers to resume"
            ) from error

    def submit(self, folders: Mapping[str, Path], work: Callable[[Any], Result]) -> Future[Result]:
        """Do a piece of work in a process as soon as one is free.

        Args:
            folders: the folders of the data sets by class, because a worker generates none.
            work: called with the object that `make` made in the process. The function and its result are pickled.
        """
        pool = self._started()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # new processes inherit the mask
        try:
            return pool.submit(_do, folders, work)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            spawn = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.count, spawn, _start, (self._make,))
        return self._pool


_runner: HasData  # the object made by `make`, in a worker process


def _start(make: Callable[[], HasData]) -> None:
    global _runner
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent too, and the parent ends its workers
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    torch.set_num_threads(1)
    _runner = make()


def _do(folders: Mapping[str, Path], work: Callable[[Any], Result]) -> Result:
    _runner.data.generated |= folders  # given data sets, which the process knows, have precedence
    with interruptible():
        return work(_runner)
