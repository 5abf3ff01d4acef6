"""Processes that share the objects of every step, by torch.distributed: gradients averaged, stops and errors agreed on.

Lightning Fabric starts the processes and joins them (`launching.py`). Its collectives (2.6.6) do not serve:
`all_reduce` sends a barrier and a message for every tensor, 284 ms for the 79 gradients of `small` in two processes of
one machine where one message takes 13 ms; `broadcast` pickles what it sends; `setup` averages gradients in the backward
pass of a wrapped module, and those of Reptile and MAML are made by no backward pass, while the losses of one step go
through several fields of the same weights. What is used here are the functions of torch.distributed that they call.

Each process renders its share of a step's objects. Weights, optimisers and draws are the same in all of them, so each
could go on alone from any checkpoint. The first one writes files and validates on held-out objects.
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
    """Another process of the training ended, which says why itself."""


@contextmanager
def other_processes() -> Generator[None]:
    """Turns what torch.distributed raises when another process has gone into `ProcessEnded`.

    Raises:
        ProcessEnded: another process has gone.
        RuntimeError: any other that was raised within.
    """
    try:
        yield
    except RuntimeError as error:
        if not isinstance(error, distributed.DistError) and "gloo" not in str(error):
            raise
        raise ProcessEnded("another process of this training has ended; its own message says why") from error


def check_shares(tasks: int, reference_objects: int, processes: int) -> None:
    """Refuse numbers of objects that the processes cannot share evenly.

    Args:
        tasks: objects a step that are rendered.
        reference_objects: objects a step of which only the HyperPlanes are read.
        processes: that share them.

    Raises:
        ValueError: a number that cannot be divided.
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
        rank: which one this is, from 0.
        count: how many there are.
    """

    rank: int = 0
    count: int = 1

    @classmethod
    def current(cls) -> Processes:
        """Those of torch.distributed's default group; a single one where there is none."""
        if not (distributed.is_available() and distributed.is_initialized()):
            return cls()
        return cls(distributed.get_rank(), distributed.get_world_size())

    @property
    def first(self) -> bool:
        """Whether this is the one that writes and reports."""
        return self.rank == 0

    def share(self, values: Sequence[Value]) -> Sequence[Value]:
        """The part of some values that is this process's: as long as everyone else's, one after the other.

        >>> Processes(1, 2).share("abcdef")
        'def'

        Args:
            values: a multiple of the number of processes.
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
        """Put the mean of the gradients of all processes in the place of each, in one exchange.

        Args:
            parameters: the same in every process; one that no process has a gradient of is left without.
            loss: of this process.
            stopping: whether it is asked to stop.

        Returns:
            The mean loss, and whether any process is asked to stop.
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
        """Have all processes begin with the weights of the first one, after the same number of steps.

        Args:
            model: of the same shape everywhere.
            step: steps done.

        Raises:
            ValueError: another number of steps elsewhere.
        """
        if self.count == 1:
            return
        steps = torch.zeros(self.count, dtype=torch.int64, device=next(model.parameters()).device)
        steps[self.rank] = step
        distributed.all_reduce(steps)
        if len(steps.unique()) > 1:
            raise ValueError(
                f"step: expected one number of steps in all processes, got {steps.tolist()}; "
                "--out is to be a folder that every node sees"
            )
        for value in model.state_dict().values():
            if value.numel():
                distributed.broadcast(value, 0)
