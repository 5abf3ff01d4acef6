"""How a hypernetwork reads theta: a code of the weights of the target (HyperPlanes, Eq. 7)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["LowRankReader", "random_matrix"]

RANK = 4


class LowRankReader(nn.Module):
    """One code for all weights of a network, with few learned parameters.

    Each matrix W (out x in) is projected to U W V, 16 numbers, with learned U (4 x out) and V (in x 4), each bias b to
    U b, also 16; grids of features are left out. A linear layer computes the code from these. At depth 8 and width 256
    this has a hundred thousand parameters; a linear layer over theta itself would have 80 million.

    Args:
        shapes: of the parameters by name.
        code: length of the code.
    """

    def __init__(self, shapes: Mapping[str, torch.Size], code: int) -> None:
        super().__init__()
        self.names = tuple(name for name, shape in shapes.items() if len(shape) <= 2)
        self.left, self.right = nn.ParameterList(), nn.ParameterList()
        for shape in (shapes[name] for name in self.names):
            rows = RANK if len(shape) == 2 else RANK**2
            self.left.append(random_matrix(rows, shape[0], shape[0]))
            columns = (shape[1], RANK) if len(shape) == 2 else (1, 1)
            self.right.append(random_matrix(*columns, columns[0]))
        self.code = nn.Linear(RANK**2 * len(self.names), code)

    def forward(self, theta: Mapping[str, Tensor]) -> Float[Tensor, " code"]:
        """The code of these weights."""
        read = [
            left @ theta[name].reshape(left.shape[1], -1) @ right
            for name, left, right in zip(self.names, self.left, self.right, strict=True)
        ]
        return self.code(torch.cat([each.flatten() for each in read]))


def random_matrix(rows: int, columns: int, summed: int) -> nn.Parameter:
    """A matrix of normal values with variance 1 / `summed`, which keeps the scale of its products.

    On the device "meta", as when a checkpoint is read, it has no values: drawing them would make PyTorch load its
    compiler, which takes a second.

    Args:
        rows: number of rows.
        columns: number of columns.
        summed: number of terms in each sum of a product.
    """
    values = torch.empty(rows, columns)
    return nn.Parameter(values if values.is_meta else values.normal_().div_(summed**0.5))
