"""How the hypernetwork reads theta: a code of the target's own weights (HyperPlanes, Eq. 7)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["LowRankReader", "random_matrix"]

RANK = 4


class LowRankReader(nn.Module):
    """Every weight of a network becomes one code, by few learned numbers.

    Of a matrix W (out x in) the products U W V are read, U (4 x out) and V (in x 4) being learned, 16 numbers; of a
    bias b as many, U b; grids of features are left out. A linear layer makes the code of all of them. At depth 8 and
    width 256 that is a hundred thousand learned numbers, where a linear layer over theta itself would take 80 million.

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
    """Normal values whose products with as many numbers as are summed stay as large as these.

    On the device "meta" there are none, as when a checkpoint is read: PyTorch would load its compiler for them, in a
    second.

    Args:
        rows: their number.
        columns: their number.
        summed: how many numbers a product adds up.
    """
    values = torch.empty(rows, columns)
    return nn.Parameter(values if values.is_meta else values.normal_().div_(summed**0.5))
