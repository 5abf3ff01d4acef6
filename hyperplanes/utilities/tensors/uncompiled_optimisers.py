"""The optimisers of torch.optim without importing torch._dynamo, which takes 1.3 to 2 s in each process.

PyTorch imports it to exclude the methods of optimisers from compilation. Nothing is compiled here, so these are the
same methods without that decorator.
"""

from __future__ import annotations

from inspect import unwrap
from typing import Any

import torch
from torch.optim import Optimizer as _Optimizer

__all__ = ["SGD", "Adam", "Optimizer"]


class Optimizer(_Optimizer):
    """torch.optim.Optimizer; decorate `step` of subclasses with `torch.no_grad`."""

    add_param_group: Any = unwrap(_Optimizer.add_param_group)
    zero_grad: Any = unwrap(_Optimizer.zero_grad)
    state_dict: Any = unwrap(_Optimizer.state_dict)
    load_state_dict: Any = unwrap(_Optimizer.load_state_dict)


class Adam(Optimizer, torch.optim.Adam):
    """torch.optim.Adam."""

    step: Any = torch.no_grad()(unwrap(torch.optim.Adam.step))


class SGD(Optimizer, torch.optim.SGD):
    """torch.optim.SGD."""

    step: Any = torch.no_grad()(unwrap(torch.optim.SGD.step))
