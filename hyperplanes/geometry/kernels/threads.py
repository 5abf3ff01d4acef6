"""A parallel for loop over compiled kernels.

The kernels release the interpreter lock, so a pool of Python threads runs them in parallel: it survives a fork (the
child starts a new pool), may be used from several threads at once, and follows `torch.set_num_threads`, none of which
holds for numba's own threading layers.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

__all__ = ["parallel_for"]

Result = TypeVar("Result")

_pools: dict[int, ThreadPoolExecutor] = {}


def parallel_for(work: Callable[[int, int], Result], total: int, chunk: int) -> list[Result]:
    """The results of work(start, stop) over 0..total in steps of `chunk`, in order, run by `torch.get_num_threads()`.

    The calling thread is one of them.

    Args:
        work: releases the interpreter lock where it takes long.
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


def _pool(size: int) -> ThreadPoolExecutor:
    if size not in _pools:
        _pools[size] = ThreadPoolExecutor(size, thread_name_prefix="hyperplanes-kernels")
    return _pools[size]


if hasattr(os, "register_at_fork"):  # a forked child has the pool's locks but not its threads
    os.register_at_fork(after_in_child=_pools.clear)
