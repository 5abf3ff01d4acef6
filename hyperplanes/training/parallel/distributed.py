"""Processes that share the objects of every step, by torch.distributed: they average gradients and stop together.

Lightning Fabric starts the processes and joins them to a group (`launching.py`). Its collectives (2.6.6) are not used:
- `all_reduce` sends a barrier and a message for every tensor. For the 79 gradients of `small` in two processes of one
  machine this takes 284 ms, while one message takes 13 ms.
- `broadcast` pickles its argument.
- `setup` averages gradients in the backward pass of a wrapped module. The gradients of Reptile and MAML are not made by
  a backward pass, and the losses of one step depend on several fields of the same weights.
The functions of torch.distributed, which Fabric calls, are used instead.

Each process renders its share of a step's objects. Weights, optimisers and random draws are the same in all processes,
so a single one can resume from any checkpoint. The first process writes files and validates on held-out objects.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor, distributed, nn

__all__ = ["ProcessEnded", "Processes", "check_shares", "other_processes"]

Value = TypeVar("Value")


class ProcessEnded(ValueError):
    """Another process of the training has ended; that process prints the reason."""


@contextmanager
def other_processes() -> Generator[None]:
    """A context that turns the errors of torch.distributed after the end of another process into `ProcessEnded`.

    Raises:
        ProcessEnded: another process has ended.
        RuntimeError: any other RuntimeError that is raised in the context.
    """
    try:
        yield
    except RuntimeError as error:
        if not isinstance(error, distributed.DistError) and "gloo" not in str(error):
            raise
        raise ProcessEnded("another process of this training has ended; see the message of that process") from error


def check_shares(tasks: int, reference_objects: int, processes: int) -> None:
    """Refuse numbers of objects that the processes cannot share evenly.

    Args:
        tasks: objects per step that are rendered.
        reference_objects: objects per step of which only the HyperPlanes are read.
        processes: the number of processes that share them.

    Raises:
        ValueError: a number of objects that is not a multiple of the number of processes.
    """
    for name, count in (("tasks", tasks), ("reference_objects", reference_objects)):
        if count % processes:
            nearest = math.ceil(count / processes) * processes
            raise ValueError(
                f"{name}: expected a multiple of the {processes} processes, got {count}; "
                f"give --training.{name.replace('_', '-')} {nearest}, or other --devices and --nodes"
            )


@dataclass(frozen=True)
class Processes:
    """The processes of this training.

    Attributes:
        rank: the index of this process, from 0.
        count: the number of processes.
    """

    rank: int = 0
    count: int = 1

    @classmethod
    def current(cls) -> Processes:
        """The processes of torch.distributed's default group; a single one if there is no group."""
        if not (distributed.is_available() and distributed.is_initialized()):
            return cls()
        return cls(distributed.get_rank(), distributed.get_world_size())

    @property
    def first(self) -> bool:
        """Whether this process writes files and reports."""
        return self.rank == 0

    def share(self, values: Sequence[Value]) -> Sequence[Value]:
        """The part of some values for this process. Parts are consecutive and equally long.

        >>> Processes(1, 2).share("abcdef")
        'def'

        Args:
            values: a sequence whose length is a multiple of the number of processes.
        """
        size = len(values) // self.count
        return values[self.rank * size : (self.rank + 1) * size]

    def mean(self, value: Tensor) -> Tensor:
        """The mean of a tensor over the processes."""
        if self.count == 1:
            return value
        total = value.clone()
        distributed.all_reduce(total)
        return total / self.count

    def average(self, parameters: Iterable[Tensor], loss: float, stopping: bool) -> tuple[float, bool]:
        """Replace the gradients by their means over all processes, in one exchange.

        Args:
            parameters: the parameters, the same in every process. If no process has a gradient of a parameter, it gets
                none.
            loss: the loss of this process.
            stopping: whether this process was requested to stop.

        Returns:
            The mean loss, and whether any process was requested to stop.
        """
        if self.count == 1:
            return loss, stopping
        known = list(parameters)
        present = [float(each.grad is not None) for each in known]
        parts = [(torch.zeros_like(each) if each.grad is None else each.grad).flatten() for each in known]
        everything = torch.cat([*parts, known[0].new_tensor([*present, loss, float(stopping)])])
        distributed.all_reduce(everything)
        everything /= self.count
        *means, flags, last = everything.split([*(each.numel() for each in known), len(known), 2])
        for parameter, mean, flag in zip(known, means, flags.tolist(), strict=True):
            parameter.grad = mean.view_as(parameter) if flag else None
        mean_loss, stops = last.tolist()
        return mean_loss, stops > 0

    def agree(self, model: nn.Module, step: int) -> None:
        """Copy the weights of the first process to all others, and check that all have done the same number of steps.

        Args:
            model: the model, with the same shapes in every process.
            step: the number of steps done.

        Raises:
            ValueError: the processes have done different numbers of steps.
        """
        if self.count == 1:
            return
        steps = torch.zeros(self.count, dtype=torch.int64, device=next(model.parameters()).device)
        steps[self.rank] = step
        distributed.all_reduce(steps)
        if len(steps.unique()) > 1:
            raise ValueError(
                f"step: expected one number of steps in all processes, got {steps.tolist()}; "
                "give an --out folder that every node can read"
            )
        for value in model.state_dict().values():
            if value.numel():
                distributed.broadcast(value, 0)
