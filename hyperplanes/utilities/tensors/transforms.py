"""Uses of tensors that compiled kernels do not support: derivatives, function transforms, graph capture."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.autograd import forward_ad

__all__ = [
    "are_plain",
    "is_transformed",
    "outside_transforms",
    "transform_of",
    "wants_values_alone",
    "without_derivatives",
]


def transform_of(*tensors: Tensor) -> str | None:
    """The kind of PyTorch's transforms these tensors are under, if any; None while a graph is compiled."""
    if torch.compiler.is_compiling():
        return None
    if torch._C._are_functorch_transforms_active():
        return "torch.func transforms"
    if any(forward_ad.unpack_dual(value).tangent is not None for value in tensors):
        return "forward-mode derivatives"
    return None


def are_plain(*tensors: Tensor) -> bool:
    """Whether the memory of these tensors can be read now: no graph is compiled or traced, and no transform is active.

    Gradients may be required.
    """
    if torch.compiler.is_compiling() or torch.jit.is_tracing():  # pyright: ignore[reportPrivateImportUsage]
        return False
    return not transform_of(*tensors)


def wants_values_alone(*tensors: Tensor) -> bool:
    """Whether only values are to be computed from these tensors: no derivatives, no graph."""
    if torch.is_grad_enabled() and any(value.requires_grad for value in tensors):
        return False
    return are_plain(*tensors)


@contextmanager
def without_derivatives() -> Generator[None, None, None]:
    """As `torch.no_grad`, for forward-mode derivatives, too."""
    with torch.no_grad(), forward_ad._set_fwd_grad_enabled(False):
        yield


def is_transformed(*tensors: Tensor) -> bool:
    """Whether a transform of `torch.func` wraps one of these tensors; others are constants to it."""
    return any(is_functorch_wrapped_tensor(value) for value in tensors)


@contextmanager
def outside_transforms() -> Generator[None, None, None]:
    """Suspend the transforms of `torch.func`; only for constants (see `is_transformed`)."""
    if not torch._C._are_functorch_transforms_active():
        yield
        return
    with torch._C._DisableFuncTorch():
        yield
