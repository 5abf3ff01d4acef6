"""From a few images to the update of a network's weights."""

from typing import TypeAlias

from hyperplanes.hypernetwork.autoencoder import Autoencoder, AutoencoderConfig
from hyperplanes.hypernetwork.configuration import VOLUME, HyperNetworkConfig
from hyperplanes.hypernetwork.encoders import ConvNet, ResNet101
from hyperplanes.hypernetwork.hypernetwork import HyperNetwork
from hyperplanes.hypernetwork.volume_hypernetwork import VolumeHyperNetwork

__all__ = [
    "VOLUME",
    "Autoencoder",
    "AutoencoderConfig",
    "ConvNet",
    "HyperNetwork",
    "HyperNetworkConfig",
    "Reader",
    "ResNet101",
    "VolumeHyperNetwork",
]

Reader: TypeAlias = HyperNetwork | VolumeHyperNetwork | Autoencoder
"""What reads support views and writes an update of theta."""
