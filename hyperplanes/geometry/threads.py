"""Sharing a compiled kernel's work between threads.

The kernels release the interpreter lock, so plain threads do: they live through a fork (the child gets a new pool), can
be used from several threads at once, and follow `torch.set_num_threads`, none of which holds for numba's own layers.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

__all__ = ["share"]

Result = TypeVar("Result")

_pools: dict[int, ThreadPoolExecutor] = {}


def share(work: Callable[[int, int], Result], total: int, chunk: int) -> list[Result]:
    """The results of work(start, stop) over 0..total in steps of `chunk`, in order, the caller's thread included.

    Args:
        work: releases the interpreter lock where it matters.
        total: how much there is.
        chunk: how much of it one call takes.

    >>> share(lambda start, stop: stop - start, 10, 4)
    [4, 4, 2]
    """
    starts = iter(range(0, total, chunk))
    threads = min(torch.get_num_threads(), -(-total // chunk))

    def some(starts: Iterable[int]) -> list[tuple[int, Result]]:
        return [(start, work(start, min(start + chunk, total))) for start in starts]

    futures = [_pool(threads - 1).submit(some, starts) for _ in range(threads - 1)]
    results = some(starts)
    for future in futures:
        results += future.result()
    return [result for _, result in sorted(results, key=lambda pair: pair[0])]


def _pool(size: int) -> ThreadPoolExecutor:
    if size not in _pools:
        _pools[size] = ThreadPoolExecutor(size, thread_name_prefix="hyperplanes-lookup")
    return _pools[size]


if hasattr(os, "register_at_fork"):  # a forked child has the pool's locks but not its threads
    os.register_at_fork(after_in_child=_pools.clear)
