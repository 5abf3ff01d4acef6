"""Locks that do not block a forked process, in which the threads that held them do not exist."""

from __future__ import annotations

import os
from threading import RLock

__all__ = ["ForkSafeLock"]


class ForkSafeLock:
    """A reentrant lock of a module, for `with`. A forked child replaces it if another thread of the parent holds it.

    >>> lock = ForkSafeLock()
    >>> with lock, lock:
    ...     print("once more")
    once more
    """

    def __init__(self) -> None:
        self._lock = RLock()
        if hasattr(os, "register_at_fork"):  # not on Windows
            os.register_at_fork(after_in_child=self._renew)

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *error: object) -> None:
        self._lock.release()

    def _renew(self) -> None:
        if self._lock.acquire(blocking=False):  # free, or held by the thread that forked
            self._lock.release()
        else:
            self._lock = RLock()
