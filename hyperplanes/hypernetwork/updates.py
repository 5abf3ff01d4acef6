"""Forms of an update: from outputs of a hypernetwork to the update of one parameter of the target."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hyperplanes.hypernetwork.weights import random_matrix

__all__ = ["UPDATES", "FullUpdate", "LowRankUpdate"]


class FullUpdate(nn.Module):
    """Every element of the parameter is an output, as in the paper.

    Args:
        shape: of the parameter.
        rank: unused.
    """

    def __init__(self, shape: torch.Size, rank: int = 0) -> None:
        super().__init__()
        self.size = shape.numel()

    def forward(self, outputs: Float[Tensor, " size"], parameter: Tensor) -> Tensor:
        """The outputs in the shape of the parameter."""
        return outputs.reshape(parameter.shape)


class LowRankUpdate(nn.Module):
    """Rows are scaled, and a product of thin matrices is added: delta W = diag(s) W + U V, delta b = t.

    s and t modulate a layer as in FiLM (Perez et al. 2018), and U V is as in LoRA (Hu et al. 2022): U (row, rank) is an
    output, V (rank, column) is learned and shared by all objects.

    Args:
        shape: of the parameter.
        rank: of the product.
    """

    def __init__(self, shape: torch.Size, rank: int) -> None:
        super().__init__()
        if len(shape) > 2:
            expected = "update: expected 'full' for layers with a grid of features"
            raise ValueError(f"{expected}, {tuple(shape)}, got 'low_rank'; name other layers")
        self.rank = rank if len(shape) == 2 else 0
        self.size = shape[0] * (1 + self.rank)
        if self.rank:
            self.right = random_matrix(rank, shape[1], shape[1])

    def forward(self, outputs: Float[Tensor, " size"], parameter: Tensor) -> Tensor:
        """diag(s) W + U V for a matrix, the outputs for a bias."""
        if not self.rank:
            return outputs
        scale, left = outputs.reshape(len(parameter), 1 + self.rank).split([1, self.rank], 1)
        return scale * parameter + left @ self.right


UPDATES: dict[str, type[FullUpdate] | type[LowRankUpdate]] = {"full": FullUpdate, "low_rank": LowRankUpdate}
