"""The hypernetwork of a configuration."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from hyperplanes.hypernetwork.base import HyperNetwork
from hyperplanes.hypernetwork.configuration import HyperNetworkConfig, VolumeHyperNetworkConfig
from hyperplanes.hypernetwork.images.autoencoder import Autoencoder, AutoencoderConfig
from hyperplanes.hypernetwork.images.image_hypernetwork import ImageHyperNetwork
from hyperplanes.hypernetwork.volume.volume_hypernetwork import VolumeHyperNetwork

__all__ = ["make_hypernetwork"]


def make_hypernetwork(
    config: HyperNetworkConfig | AutoencoderConfig,
    shapes: Mapping[str, torch.Size],
    reading_layers: tuple[str, ...],
    volume_size: tuple[int, int] | None,
) -> HyperNetwork:
    """The hypernetwork of a target network.

    Args:
        config: its shape.
        shapes: of the target's parameters by name.
        reading_layers: names of the target's layers that read a point.
        volume_size: channels and cells an axis of the volumes that it reads.
    """
    if isinstance(config, AutoencoderConfig):
        return Autoencoder(config, shapes, reading_layers)
    if isinstance(config, VolumeHyperNetworkConfig):
        assert volume_size is not None
        return VolumeHyperNetwork(shapes, *volume_size)
    return ImageHyperNetwork(config, shapes)
