"""From a few images to the update of a network's weights."""

from hyperplanes.hypernetwork.encoders import ConvNet, ResNet101
from hyperplanes.hypernetwork.hypernetwork import HyperNetwork, HyperNetworkConfig

__all__ = ["ConvNet", "HyperNetwork", "HyperNetworkConfig", "ResNet101"]
