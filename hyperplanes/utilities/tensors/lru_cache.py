"""A least-recently-used cache that is bounded in bytes."""

from __future__ import annotations

from collections import OrderedDict
from typing import Generic, Protocol, TypeVar, runtime_checkable

__all__ = ["LRUCache"]


@runtime_checkable
class _Sized(Protocol):
    @property
    def nbytes(self) -> int: ...


Value = TypeVar("Value", bound=_Sized)


class LRUCache(Generic[Value]):
    """Values by name; the least recently used are dropped when the total exceeds a number of bytes.

    Args:
        budget: most bytes.
        keep_last: keep the newest value even if it alone exceeds the budget; otherwise it is not stored.
    """

    def __init__(self, budget: int, *, keep_last: bool = False) -> None:
        self.budget = budget
        self.keep_last = keep_last
        self.nbytes = 0
        self._values: OrderedDict[str, Value] = OrderedDict()

    def get(self, name: str) -> Value | None:
        """The value of that name, if still stored."""
        if name in self._values:
            self._values.move_to_end(name)
        return self._values.get(name)

    def add(self, name: str, value: Value) -> None:
        """Store a value."""
        if name in self._values:
            self.nbytes -= self._values.pop(name).nbytes
        if value.nbytes > self.budget and not self.keep_last:
            return
        self._values[name] = value
        self.nbytes += value.nbytes
        while self.nbytes > self.budget and len(self._values) > int(self.keep_last):
            self.nbytes -= self._values.popitem(last=False)[1].nbytes
