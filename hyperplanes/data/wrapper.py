"""A data set whose tasks are those of another data set with a change."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from hyperplanes.views import Task, Tasks, class_of

__all__ = ["TaskWrapper"]


@dataclass(frozen=True)
class TaskWrapper(ABC):
    """The objects, splits and classes of another data set, whose tasks are changed when they are read.

    Attributes:
        data: the other data set, which may be a wrapper itself.
    """

    data: Tasks

    @abstractmethod
    def change(self, task: Task) -> Task:
        """The changed task that replaces a task of `data`."""

    def names(self, split: str) -> Sequence[str]:
        """The objects of a split."""
        return self.data.names(split)

    def class_of(self, name: str) -> str:
        """The class of one object, as the data set states it."""
        return class_of(self.data, name)

    def task(self, name: str) -> Task:
        """One object, changed."""
        return self.change(self.data.task(name))
