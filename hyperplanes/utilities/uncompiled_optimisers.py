"""The optimisers of torch.optim without torch._dynamo, which the first of them in a process imports (1.3 to 2 s).

It is imported to be told that the methods of optimisers are not to be compiled. Nothing here is compiled, so these are
the same methods without that decoration.
"""

from __future__ import annotations

from inspect import unwrap
from typing import Any

import torch
from torch.optim import Optimizer as _Optimizer

__all__ = ["SGD", "Adam", "Optimizer"]


class Optimizer(_Optimizer):
    """torch.optim.Optimizer; `step` of a subclass is to be decorated with `torch.no_grad`."""

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
