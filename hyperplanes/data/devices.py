"""The choice of a device, and data sets whose tasks are moved to it."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from hyperplanes.data.upright import upright_task
from hyperplanes.data.wrapper import TaskWrapper
from hyperplanes.views import Task

__all__ = ["TasksOnDevice", "choose_device"]


def choose_device(name: str) -> torch.device:
    """The device of that name; "auto" is a GPU if there is one, otherwise the CPU.

    Raises:
        ValueError: PyTorch has no such device on this machine.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()  # fails on the device meta, whose tensors have no data
    except (RuntimeError, AssertionError) as error:
        kind, reason = name.partition(":")[0], str(error).splitlines()[0]
        why = f" ({reason})" if kind in ("cuda", "mps", "xpu") else ""  # of other names, torch lists all its types
        raise ValueError(f"device: expected auto, cpu or one that torch has here, got {name!r}{why}") from None
    return device


@dataclass(frozen=True)
class TasksOnDevice(TaskWrapper):
    """Tasks whose views are moved to a device and rotated into a world with y up.

    Attributes:
        device: to which the views are moved.
        up: the direction that points up in the world of the data. None takes the one that the files of each object
            state, or y.
    """

    device: torch.device
    up: str | None = None

    def change(self, task: Task) -> Task:
        """The task on the device."""
        task = upright_task(task, self.up or task.support.up or "y")
        return Task(task.support.to(self.device), task.query.to(self.device), task.name)
