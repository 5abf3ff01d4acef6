"""Hypernetworks: from images or a volume of an object to an update of the weights of a target network."""

from hyperplanes.hypernetwork.base import HyperNetwork, Observed
from hyperplanes.hypernetwork.configuration import (
    KINDS,
    HyperNetworkConfig,
    ImageHyperNetworkConfig,
    VolumeHyperNetworkConfig,
)
from hyperplanes.hypernetwork.encoders import ConvNet, ResNet101
from hyperplanes.hypernetwork.images.autoencoder import Autoencoder, AutoencoderConfig
from hyperplanes.hypernetwork.images.image_hypernetwork import ImageHyperNetwork
from hyperplanes.hypernetwork.learned_step import LearnedStep
from hyperplanes.hypernetwork.volume.volume_hypernetwork import VolumeHyperNetwork

__all__ = [
    "KINDS",
    "Autoencoder",
    "AutoencoderConfig",
    "ConvNet",
    "HyperNetwork",
    "HyperNetworkConfig",
    "ImageHyperNetwork",
    "ImageHyperNetworkConfig",
    "LearnedStep",
    "Observed",
    "ResNet101",
    "VolumeHyperNetwork",
    "VolumeHyperNetworkConfig",
]
