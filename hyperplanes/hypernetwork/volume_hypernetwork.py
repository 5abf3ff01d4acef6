"""A hypernetwork that reads what all views show on a grid over the scene, instead of images one by one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from hyperplanes.hypernetwork.base import Observed
from hyperplanes.hypernetwork.configuration import VolumeHyperNetworkConfig
from hyperplanes.hypernetwork.standardisation import RunningStandardisation
from hyperplanes.hypernetwork.update_head import UpdateHead
from hyperplanes.hypernetwork.volume_network import VolumeNetwork
from hyperplanes.parameters import Parameters

__all__ = ["VolumeHyperNetwork"]


class VolumeHyperNetwork(UpdateHead):
    """H(V, theta; delta), where V is what all views show on a grid over the scene (`geometry.volume.volume_of`).

    A grid of features among the weights of the target gets an update for every cell, from the convolutions of
    `VolumeNetwork`; all other layers get theirs from its code, as in `HyperNetwork`. Neither the number of the views
    nor their order matters. The outputs start at zero here too. `centre` is of the other layers: the update of a grid
    has a part that all objects share.

    Args:
        config: the shape.
        shapes: of the parameters by name; those of four dimensions are grids of features, with as many cells as V.
        channels: numbers that V has of a cell.
        side: cells of V an axis.

    Raises:
        ValueError: layers that the target does not have.
    """

    reads_volume: ClassVar[bool] = True

    def __init__(
        self, config: VolumeHyperNetworkConfig, shapes: Mapping[str, torch.Size], channels: int, side: int
    ) -> None:
        super().__init__(config, shapes)
        self.grids = {name: shape for name, shape in self.shapes.items() if len(shape) == 4}
        self.shapes = {name: shape for name, shape in self.shapes.items() if name not in self.grids}
        self.encoder = VolumeNetwork(channels, side, config.code, sum(shape[0] for shape in self.grids.values()))
        self.code_normalisation = self.make_normalisation((config.code,))
        self.make_head(config.code, shapes)

    def forward(self, observed: Observed, theta: Mapping[str, Tensor]) -> list[Parameters]:
        """The update of theta for each of several objects.

        Args:
            observed: the volumes of the objects.
            theta: the target's parameters.

        Returns:
            For each object one tensor a named parameter of the chosen layers, of its shape.
        """
        assert observed.volume is not None
        codes, features = self.encoder(observed.volume)
        updates = self.updates_of(self.code_normalisation(codes), theta)
        for update, cells in zip(updates, features, strict=True):
            update.update(zip(self.grids, cells.split([shape[0] for shape in self.grids.values()]), strict=True))
        return updates

    def standardised_codes(self, observed: Observed) -> Tensor | None:
        """The codes of the volumes in deviations of those of the training; None where they are not standardised so."""
        if not isinstance(self.code_normalisation, RunningStandardisation):
            return None
        assert observed.volume is not None
        return self.code_normalisation(self.encoder(observed.volume)[0])
