"""A hypernetwork that reads all views projected onto a grid over the scene, instead of images."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from hyperplanes.hypernetwork.base import HyperNetwork, Observed
from hyperplanes.hypernetwork.volume.volume_network import VolumeNetwork
from hyperplanes.parameters import Parameters

__all__ = ["VolumeHyperNetwork"]


class VolumeHyperNetwork(HyperNetwork):
    """H(V; delta), where V has all views projected onto a grid over the scene (`geometry.volume.volume_of`).

    `VolumeNetwork` outputs an update for every cell of the grid of features among the weights of the target; it is zero
    at initialisation. The number and order of the views do not matter. Updating other layers as well gained nothing
    (docs/image-based.md), so they are not updated, and theta is not read.

    Args:
        shapes: of the parameters by name; those of four dimensions are grids of features, with as many cells as V.
        channels: of V.
        side: cells of V an axis.
    """

    reads_volume: ClassVar[bool] = True

    def __init__(self, shapes: Mapping[str, torch.Size], channels: int, side: int) -> None:
        super().__init__()
        self.grids = {name: shape for name, shape in shapes.items() if len(shape) == 4}
        self.encoder = VolumeNetwork(channels, side, sum(shape[0] for shape in self.grids.values()))

    def forward(self, observed: Observed, theta: Mapping[str, Tensor]) -> list[Parameters]:
        """The update of the grids for each of several objects: one tensor for each grid, of its shape.

        Args:
            observed: the volumes of the objects.
            theta: the target's parameters, which are not read.
        """
        assert observed.volume is not None
        # one volume of features, split into the grids by channels
        features = self.encoder(observed.volume).split([shape[0] for shape in self.grids.values()], 1)
        return [Parameters(zip(self.grids, each, strict=True)) for each in zip(*features, strict=True)]
