"""Tasks that are those of another data set, each changed in one way."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from hyperplanes.views import Task, Tasks, class_of

__all__ = ["TaskWrapper"]


@dataclass(frozen=True)
class TaskWrapper(ABC):
    """The objects, splits and classes of a data set, whose tasks are changed when they are read.

    Attributes:
        data: where the tasks come from; a wrapper itself, perhaps.
    """

    data: Tasks

    @abstractmethod
    def change(self, task: Task) -> Task:
        """The task that is shown in the place of one of `data`."""

    def names(self, split: str) -> Sequence[str]:
        """The objects of a split."""
        return self.data.names(split)

    def class_of(self, name: str) -> str:
        """The class of one object, as the data set states it."""
        return class_of(self.data, name)

    def task(self, name: str) -> Task:
        """One object, changed."""
        return self.change(self.data.task(name))
