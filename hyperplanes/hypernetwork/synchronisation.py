"""Statistics over the objects of a step that are distributed over processes; without others, a process has them all.

The processes are those of the default group of torch.distributed. In training, all must call these functions equally
often and in the same order; in evaluation nothing is exchanged.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, distributed, nn

__all__ = ["BatchNorm2d", "gather_objects", "is_shared", "sum_over_processes"]


def is_shared() -> bool:
    """Whether there are other processes."""
    return distributed.is_available() and distributed.is_initialized() and distributed.get_world_size() > 1


class _Sum(torch.autograd.Function):
    """The sum over processes; the losses of all processes count, so the gradient is the sum of theirs."""

    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        total = value.clone(memory_format=torch.contiguous_format)
        distributed.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        total = gradient.clone(memory_format=torch.contiguous_format)
        distributed.all_reduce(total)
        return total


def sum_over_processes(value: Tensor) -> Tensor:
    """The sum over processes, with its gradient."""
    return _Sum.apply(value)  # pyright: ignore[reportReturnType]


def gather_objects(values: Tensor) -> tuple[Tensor, slice]:
    """The values of the objects of all processes.

    Args:
        values: (object, ...) of the objects of this process; all processes have the same number.

    Returns:
        The values of all processes in order, with their gradient, and the slice of those of this process.
    """
    if not is_shared():
        return values, slice(None)
    rank, count = distributed.get_rank(), len(values)
    own = slice(rank * count, (rank + 1) * count)
    padded = values.new_zeros(distributed.get_world_size() * count, *values.shape[1:])
    padded[own] = values
    return sum_over_processes(padded), own


class BatchNorm2d(nn.BatchNorm2d):
    """Batch normalisation with statistics over the images of all processes in training.

    torch.nn.SyncBatchNorm does the same, but only on GPUs.
    """

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002 - torch's name
        """As torch.nn.BatchNorm2d; ValueError if the statistics would be those of a single value."""
        if not self.training or not is_shared():
            if (self.training or not self.track_running_stats) and input.numel() == input.shape[1]:
                kind = "batch" if self.track_running_stats else "batch_statistics"
                raise ValueError(
                    "hypernetwork.normalisation or autoencoder.normalisation: expected 'group' for one small image "
                    f"at a time, got {kind!r}, which needs more than one value per channel; or use more images, with "
                    "views or training.tasks"
                )
            return super().forward(input)
        axes = (0, 2, 3)
        # mean and variance over the batches of all processes
        count = sum_over_processes(input.new_tensor(float(input.numel() // input.shape[1])))
        mean = sum_over_processes(input.sum(axes)) / count
        centred = input - mean[:, None, None]
        variance = sum_over_processes(centred.square().sum(axes)) / count
        if self.track_running_stats:
            assert self.running_mean is not None
            assert self.running_var is not None
            assert self.num_batches_tracked is not None
            assert self.momentum is not None
            with torch.no_grad():
                self.num_batches_tracked += 1
                self.running_mean.lerp_(mean, self.momentum)
                self.running_var.lerp_(variance * count / (count - 1), self.momentum)
        scale = torch.rsqrt(variance + self.eps) * self.weight
        return centred * scale[:, None, None] + self.bias[:, None, None]
