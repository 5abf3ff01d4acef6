"""Function transforms of PyTorch, which neither compiled kernels nor some of its own operations know."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd import forward_ad

__all__ = ["transform_of"]


def transform_of(*tensors: Tensor) -> str | None:
    """Which of PyTorch's function transforms these tensors are under; None while a graph is compiled."""
    if torch.compiler.is_compiling():
        return None
    if torch._C._are_functorch_transforms_active():
        return "torch.func transforms"
    if any(forward_ad.unpack_dual(value).tangent is not None for value in tensors):
        return "forward-mode derivatives"
    return None
