"""A network that reads the gradient of an error and writes a step of gradient descent."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hyperplanes.hypernetwork.volume_network import VolumeNetwork

__all__ = ["LearnedStep"]


class LearnedStep(nn.Module):
    """A learned step of gradient descent on a grid of features.

    A network in place of a rate and an optimiser (Andrychowicz et al. 2016, "Learning to learn by gradient descent by
    gradient descent"; Flynn et al. 2019, "DeepView", for views of a scene). It is a U-Net like that of
    `VolumeHyperNetwork`, with weights of its own, and reads the gradient beside what that reads. Its first step is
    none. `training.learned_step` trains it after the model; it is no part of other trainings.

    Args:
        channels: numbers that the volume has of a cell.
        side: cells of the volume an axis.
        features: numbers that the grid has of a cell.
    """

    def __init__(self, channels: int, side: int, features: int) -> None:
        super().__init__()
        self.network = VolumeNetwork(channels + 2 * features + 1, side, features)
        self.rates = nn.Parameter(torch.zeros(features))
        self.requires_grad_(requires_grad=False)

    def forward(
        self,
        volume: Float[Tensor, "object channel x y z"],
        grid: Float[Tensor, "object feature x y z"],
        gradient: Float[Tensor, "object feature x y z"],
        error: Float[Tensor, " object"],
    ) -> Float[Tensor, "object feature x y z"]:
        """What is to be added to the grids of several objects.

        Args:
            volume: what all views of each object show (`geometry.volume.volume_of`).
            grid: features as they are.
            gradient: of the error, in these features; of any scale.
            error: mean squared error of rays of the views.
        """
        # its scale says more of the number of rays than of the object, and it has heavy tails
        scaled = gradient / gradient.square().mean((2, 3, 4), keepdim=True).sqrt().clamp_min(1e-12)
        scaled = scaled.sign() * scaled.abs().log1p()
        inside = (volume[:, :1] > 0) * (error.clamp_min(1e-6).log() / 4 + 1)[:, None, None, None, None]
        written = self.network(torch.cat([volume, grid, scaled, inside], 1))
        return written - self.rates[None, :, None, None, None] * scaled
