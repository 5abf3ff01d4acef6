"""Where to compute: the choice of a device, and tasks that lie on it."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from hyperplanes.data.upright import upright_task
from hyperplanes.data.wrapper import TaskWrapper
from hyperplanes.views import Task

__all__ = ["TasksOnDevice", "choose_device"]


def choose_device(name: str) -> torch.device:
    """The device of that name; "auto" is a GPU where there is one.

    Raises:
        ValueError: a device that torch does not have here.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()  # which a meta tensor has none of
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device: expected auto, cpu or one that torch has here, got {name!r} ({reason})") from None
    return device


@dataclass(frozen=True)
class TasksOnDevice(TaskWrapper):
    """Tasks whose views lie on a device, in a world with y up.

    Attributes:
        device: where they go.
        up: the axis that points up in the data's world; where None, as the files of each object say, or y.
    """

    device: torch.device
    up: str | None = None

    def change(self, task: Task) -> Task:
        """The task on the device."""
        task = upright_task(task, self.up or task.support.up or "y")
        return Task(task.support.to(self.device), task.query.to(self.device), task.name)
