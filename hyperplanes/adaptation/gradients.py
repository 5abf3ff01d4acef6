"""Gradients of a loss that is a sum over parts, each part forward and backward by one thread."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.profiler import record_function

from hyperplanes.geometry.kernels.threads import parallel_map

__all__ = ["sum_present", "summed_gradients"]


def summed_gradients(
    loss: Callable[[int], Tensor], parts: int, variables: Sequence[Tensor], *, thread_safe: bool = True
) -> tuple[Tensor, list[Tensor | None]]:
    """The sum of the losses of some parts, and its gradients.

    On the CPU each part runs on one thread, forward and backward. Two threads that share every operation are slower
    than one where other processes keep the cores busy; with a part each they are not (`python -m benchmarks busy`). The
    parts are added in their order, so that the result does not depend on the number of threads.

    Args:
        loss: of one part, by its index. No two parts share a graph that begins before this call, since each is freed
            after its backward pass.
        parts: how many there are.
        variables: leaves of the graphs.
        thread_safe: several threads may call `loss` at once.

    Returns:
        The sum, without its history, and a gradient for every variable; None where no part depends on it.

    >>> x = torch.tensor([1.0, 2.0], requires_grad=True)
    >>> summed_gradients(lambda part: x[part] ** 2, 2, [x])
    (tensor(5.), [tensor([2., 4.])])
    """

    @torch.enable_grad()
    def of_part(part: int) -> tuple[Tensor, Sequence[Tensor | None]]:
        value = loss(part)
        with record_function("step:gradients"):
            return value.detach(), torch.autograd.grad(value, variables, allow_unused=True)

    run = parallel_map if thread_safe and all(value.device.type == "cpu" for value in variables) else map
    values, gradients = zip(*run(of_part, range(parts)), strict=True)
    return torch.stack(values).sum(), [sum_present(found) for found in zip(*gradients, strict=True)]


def sum_present(gradients: Sequence[Tensor | None]) -> Tensor | None:
    """The sum of those that there are; None where there is none."""
    found = [each for each in gradients if each is not None]
    return sum(found[1:], found[0]) if found else None
