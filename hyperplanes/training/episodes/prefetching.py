"""A thread that prepares objects during training steps, so that no step waits for a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

from hyperplanes.utilities.tensors.lru_cache import LRUCache

__all__ = ["Prefetcher"]

Value = TypeVar("Value")


class Prefetcher(Generic[Value]):
    """Values by name: from a cache, from a thread that makes expected values in advance, or made at once.

    Only the calling thread changes the cache. An error in the thread is raised by `get` of the same name.

    Args:
        load: makes a value. It may run in the thread and in the calling thread at the same time.
        cache: keeps the values.
    """

    def __init__(self, load: Callable[[str], Value], cache: LRUCache[Value]) -> None:  # pyright: ignore[reportInvalidTypeArguments]
        self._load, self._cache = load, cache
        self._coming: dict[str, Future[Value]] = {}
        self._thread: ThreadPoolExecutor | None = None

    def expect(self, names: Iterable[str]) -> None:
        """Start making the values that are needed next; those in the cache are held until `get` returns them."""
        for name in names:
            if name in self._coming:
                continue
            kept = self._cache.get(name)
            if kept is not None:
                self._coming[name] = Future()
                self._coming[name].set_result(kept)
                continue
            if self._thread is None:
                self._thread = ThreadPoolExecutor(1, thread_name_prefix="hyperplanes-prefetch")
            self._coming[name] = self._thread.submit(self._load, name)

    def get(self, name: str) -> Value:
        """The value of a name, which is added to the cache."""
        value = self._cache.get(name)
        coming = self._coming.pop(name, None)
        if value is None:
            value = self._load(name) if coming is None else coming.result()
            self._cache.add(name, value)
        return value

    def close(self) -> None:
        """End the thread after its current value; values that it has not begun are cancelled."""
        if self._thread is not None:
            self._thread.shutdown(cancel_futures=True)
        self._thread = None
        self._coming.clear()
