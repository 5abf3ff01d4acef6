"""A network that reads the gradient of an error and outputs a step of gradient descent."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hyperplanes.hypernetwork.volume.volume_network import VolumeNetwork

__all__ = ["LearnedStep"]


class LearnedStep(nn.Module):
    """A learned step of gradient descent on a grid of features.

    A network replaces learning rate and optimiser (Andrychowicz et al. 2016, "Learning to learn by gradient descent by
    gradient descent"; Flynn et al. 2019, "DeepView", for views of a scene). It is a U-Net like that of
    `VolumeHyperNetwork`, with its own weights. At initialisation its step is zero. `training.learned_step` trains it
    after the model, and nothing else does.

    Args:
        side: cells of the grid an axis.
        features: number of features of a cell.
    """

    def __init__(self, side: int, features: int) -> None:
        super().__init__()
        self.network = VolumeNetwork(1 + 2 * features, side, features)
        self.rates = nn.Parameter(torch.zeros(features))
        self.requires_grad_(requires_grad=False)

    def forward(
        self,
        hull: Float[Tensor, "object 1 x y z"],
        grid: Float[Tensor, "object feature x y z"],
        gradient: Float[Tensor, "object feature x y z"],
    ) -> Float[Tensor, "object feature x y z"]:
        """What is to be added to the grids of several objects.

        Args:
            hull: share of each cell that the visual hull occupies, the first channel of `geometry.volume.volume_of`.
            grid: current features.
            gradient: of the error with respect to the features, of any scale.
        """
        # the scale of gradients depends more on the number of rays than on the object, and they have heavy tails
        scaled = gradient / gradient.square().mean((2, 3, 4), keepdim=True).sqrt().clamp_min(1e-12)
        scaled = scaled.sign() * scaled.abs().log1p()
        written = self.network(torch.cat([hull, grid, scaled], 1))
        return written - self.rates[None, :, None, None, None] * scaled
