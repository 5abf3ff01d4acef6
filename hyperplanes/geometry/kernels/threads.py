"""Parallel work in threads: ranges of compiled kernels, and parts of a computation in PyTorch.

Both release the interpreter lock, so pools of Python threads run them in parallel: they survive a fork (the child
starts new ones), may be used from several threads at once, and follow `torch.set_num_threads`; numba's own
threading layers do none of this.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from threading import Barrier, Lock
from typing import TypeVar

import torch

__all__ = ["map_long_parts", "parallel_for", "parallel_map", "run_concurrently"]

Part = TypeVar("Part")
Result = TypeVar("Result")
Other = TypeVar("Other")

_pools: dict[tuple[int, str], ThreadPoolExecutor] = {}
_single: dict[int, ThreadPoolExecutor] = {}  # their threads run each PyTorch operation on one thread
_making = Lock()
_second = Lock()  # held while `run_concurrently` runs two computations


def parallel_for(work: Callable[[int, int], Result], total: int, chunk: int) -> list[Result]:
    """The results of work(start, stop) over 0..total in steps of `chunk`, in order, run by `torch.get_num_threads()`.

    The calling thread is one of them.

    Args:
        work: releases the interpreter lock during long computations.
        total: length of the range.
        chunk: length of the part that one call works on.

    >>> parallel_for(lambda start, stop: stop - start, 10, 4)
    [4, 4, 2]
    """
    starts = iter(range(0, total, chunk))
    threads = min(torch.get_num_threads(), -(-total // chunk))

    def run(starts: Iterable[int]) -> list[tuple[int, Result]]:
        return [(start, work(start, min(start + chunk, total))) for start in starts]

    futures = [_pool(threads - 1).submit(run, starts) for _ in range(threads - 1)]
    results = run(starts)
    for future in futures:
        results += future.result()
    return [result for _, result in sorted(results, key=lambda pair: pair[0])]


def parallel_map(work: Callable[[Part], Result], parts: Sequence[Part]) -> Iterator[Result]:
    """The results of work(part), in order, without gradients, by `torch.get_num_threads()` threads on the CPU.

    Each operation of PyTorch runs on one thread: OpenMP's threads would wait for each other after each operation, these
    threads only at the end. The result of a part does not depend on the number of threads.

    Args:
        work: may be called from several threads at once, and needs neither gradients nor autocast.
        parts: of the work, each long enough (a millisecond) for its start to be negligible.

    Yields:
        The result of each part.

    >>> list(parallel_map(torch.get_num_threads, [])), sum(parallel_map(lambda part: part.sum(), torch.ones(6, 2)))
    ([], tensor(12.))
    """
    threads = min(torch.get_num_threads(), len(parts))
    if threads < 2 or torch.is_autocast_enabled("cpu"):
        yield from map(work, parts)
        return

    @torch.no_grad()  # a setting of each thread
    def run(part: Part) -> Result:
        return work(part)

    futures = [_single_pool(threads).submit(run, part) for part in parts]
    try:
        for future in futures:
            yield future.result()
    finally:
        for future in futures:
            future.cancel()


def map_long_parts(work: Callable[[Part], Result], parts: Sequence[Part], device: torch.device) -> list[Result]:
    """The results of a few long parts, in order, by `parallel_map` where that keeps all threads busy.

    On other devices, and with more threads than parts, the parts run one after the other on all threads.

    Args:
        work: as in `parallel_map`.
        parts: of the work.
        device: where it is done.
    """
    alone = device.type != "cpu" or torch.get_num_threads() > len(parts)
    return list(map(work, parts) if alone else parallel_map(work, parts))


@torch.no_grad()
def run_concurrently(
    one: Callable[[], Result], other: Callable[[], Other], device: torch.device
) -> tuple[Result, Other]:
    """The results of two computations in several steps each, whose parts `parallel_map` runs; without gradients.

    While one of them waits for its last part, or runs what is not parallel, parts of the other run. On other devices,
    with one thread, and where two such computations run already, they run one after the other. An error in one is
    raised when the other has ended, too.

    Args:
        one: like the work of `parallel_map`; run by the calling thread.
        other: likewise; run by another thread.
        device: where both are done.
    """
    threads = torch.get_num_threads()
    alone = device.type != "cpu" or threads < 2 or torch.is_autocast_enabled("cpu")
    if alone or not _second.acquire(blocking=False):
        return one(), other()

    @torch.no_grad()  # a setting of each thread
    def beside() -> Other:
        torch.get_num_threads()  # or the thread would take the global number at its first operation
        torch.set_num_threads(threads)
        return other()

    try:
        future = _pool(1, "second").submit(beside)
        try:
            return one(), future.result()
        finally:
            wait([future])
    finally:
        _second.release()


def _single_pool(size: int) -> ThreadPoolExecutor:
    with _making:
        if size not in _single:
            pool = ThreadPoolExecutor(size, "hyperplanes-parts", _run_operations_alone)
            started = Barrier(size + 1)
            for _ in range(size):
                pool.submit(started.wait)
            started.wait()
            torch.set_num_threads(torch.get_num_threads())  # new threads take the number that was set last
            _single[size] = pool
        return _single[size]


def _run_operations_alone() -> None:
    torch.get_num_threads()  # or the thread would take the global number at its first operation
    torch.set_num_threads(1)


def _pool(size: int, purpose: str = "kernels") -> ThreadPoolExecutor:
    with _making:
        if (size, purpose) not in _pools:
            _pools[size, purpose] = ThreadPoolExecutor(size, f"hyperplanes-{purpose}")
        return _pools[size, purpose]


def _forget() -> None:
    global _making, _second
    _making, _second = Lock(), Lock()
    _pools.clear()
    _single.clear()


if hasattr(os, "register_at_fork"):  # a forked child has the pool's locks but not its threads
    os.register_at_fork(after_in_child=_forget)
