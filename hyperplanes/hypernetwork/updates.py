"""Forms of an update: how outputs of a hypernetwork become the update of one parameter of the target."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

__all__ = ["UPDATES", "FullUpdate", "LowRankUpdate", "ScalingUpdate"]


class FullUpdate(nn.Module):
    """Every number of the parameter is an output, as in the paper.

    Args:
        shape: of the parameter.
        rank: unused.
    """

    def __init__(self, shape: torch.Size, rank: int = 0) -> None:
        super().__init__()
        self.size = shape.numel()

    def forward(self, outputs: Float[Tensor, " size"], parameter: Tensor) -> Tensor:
        """The outputs in the parameter's shape."""
        return outputs.reshape(parameter.shape)


class ScalingUpdate(nn.Module):
    """One output a row: it scales the row of a weight matrix, and is added to the entry of a bias.

    With FiLM (Perez et al. 2018) this is a feature-wise affine modulation of what each layer computes, written as an
    update of its weights: delta W = diag(s) W, delta b = t.

    Args:
        shape: of the parameter.
        rank: unused.
    """

    def __init__(self, shape: torch.Size, rank: int = 0) -> None:
        super().__init__()
        self.size = shape[0]

    def forward(self, outputs: Float[Tensor, " row"], parameter: Tensor) -> Tensor:
        """diag(outputs) W of a matrix, the outputs of a bias."""
        return outputs if parameter.ndim == 1 else outputs[:, None] * parameter


class LowRankUpdate(nn.Module):
    """The scaling update and a product of thin matrices: delta W = diag(s) W + U V (as LoRA, Hu et al. 2022).

    U (row, rank) is an output; V (rank, column) is learned and the same for all objects.

    Args:
        shape: of the parameter.
        rank: of the product.
    """

    def __init__(self, shape: torch.Size, rank: int) -> None:
        super().__init__()
        self.rank = rank if len(shape) == 2 else 0
        self.size = shape[0] * (1 + self.rank)
        if self.rank:
            self.right = nn.Parameter(torch.randn(rank, shape[1]) / shape[1] ** 0.5)

    def forward(self, outputs: Float[Tensor, " size"], parameter: Tensor) -> Tensor:
        """diag(s) W + U V of a matrix, the outputs of a bias."""
        if not self.rank:
            return outputs
        scale, left = outputs.reshape(len(parameter), 1 + self.rank).split([1, self.rank], 1)
        return scale * parameter + left @ self.right


UPDATES: dict[str, type[FullUpdate] | type[ScalingUpdate] | type[LowRankUpdate]] = {
    "full": FullUpdate,
    "scaling": ScalingUpdate,
    "low_rank": LowRankUpdate,
}
