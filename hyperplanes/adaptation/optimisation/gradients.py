"""Gradients of a loss that is a sum of parts, with one thread for the forward and backward pass of each part."""

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

    On the CPU each part runs forward and backward on one thread. Two threads that share each operation are slower than
    one if other processes keep the cores busy; with one part each they are not (`python -m benchmarks busy`). The parts
    are added in order, so the result does not depend on the number of threads.

    Args:
        loss: of one part, by its index. Parts must not share a graph that was built before this call, since each graph
            is freed after its backward pass.
        parts: their number.
        variables: leaves of the graphs.
        thread_safe: whether several threads may call `loss` at once.

    Returns:
        The sum, detached, and a gradient for each variable; None if no part depends on it.

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
    """The sum of the gradients that are not None; None if all are."""
    found = [each for each in gradients if each is not None]
    return sum(found[1:], found[0]) if found else None
