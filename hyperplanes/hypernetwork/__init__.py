"""From a few images to the update of a network's weights."""

from hyperplanes.hypernetwork.autoencoder import Autoencoder, AutoencoderConfig
from hyperplanes.hypernetwork.encoders import ConvNet, ResNet101
from hyperplanes.hypernetwork.hypernetwork import HyperNetwork, HyperNetworkConfig

__all__ = ["Autoencoder", "AutoencoderConfig", "ConvNet", "HyperNetwork", "HyperNetworkConfig", "ResNet101"]
