"""Objects made ready by a thread while steps of training are taken, so that no step waits for a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

from hyperplanes.utilities.lru_cache import LRUCache

__all__ = ["Prefetcher"]

Value = TypeVar("Value")


class Prefetcher(Generic[Value]):
    """Values by name from a cache, from a thread that was told what is coming, or made at once.

    Only the calling thread changes the cache. An error of the thread is raised where its value is asked for.

    Args:
        load: makes a value; called in one thread beside the calling one, so both may run it at a time.
        cache: keeps values.
    """

    def __init__(self, load: Callable[[str], Value], cache: LRUCache[Value]) -> None:  # pyright: ignore[reportInvalidTypeArguments]
        self._load, self._cache = load, cache
        self._coming: dict[str, Future[Value]] = {}
        self._thread: ThreadPoolExecutor | None = None

    def expect(self, names: Iterable[str]) -> None:
        """Begin with what will be asked for next, and hold what is kept of it until then."""
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
        """The value of that name; it is kept for later where there is room."""
        value = self._cache.get(name)
        coming = self._coming.pop(name, None)
        if value is None:
            value = self._load(name) if coming is None else coming.result()
            self._cache.add(name, value)
        return value

    def close(self) -> None:
        """Let the thread end after what it is doing; what it had not begun is forgotten."""
        if self._thread is not None:
            self._thread.shutdown(cancel_futures=True)
        self._thread = None
        self._coming.clear()
