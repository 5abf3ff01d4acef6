"""The autoencoder: k images are encoded as one code, which is an input of the field."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import silu

from hyperplanes.hypernetwork.base import HyperNetwork, Observed
from hyperplanes.hypernetwork.encoders import ENCODERS, Choice, Encoder, Normalisation, encode_objects
from hyperplanes.hypernetwork.weights import random_matrix
from hyperplanes.parameters import Parameters
from hyperplanes.utilities.messages.arguments import checked_fields

__all__ = ["Autoencoder", "AutoencoderConfig"]


@checked_fields
@dataclass(frozen=True)
class AutoencoderConfig:
    """The shape of an encoder whose code the field reads (named, but not described, in HyperPlanes, Table 5).

    Attributes:
        views: number of images it reads.
        choice: which of the planes it reads: the "farthest" apart, or the "first".
        encoder: "convnet" or "resnet101".
        normalisation: of the encoder, as in `ImageHyperNetworkConfig`.
        code: length of the code of one image.
        latent: length of the code of an object.
    """

    views: Annotated[int, range(1, 1025)] = 5
    choice: Choice = "farthest"
    encoder: Encoder = "convnet"
    normalisation: Normalisation = "group"
    code: Annotated[int, range(1, 8193)] = 128
    latent: Annotated[int, range(1, 8193)] = 128


class Autoencoder(HyperNetwork):
    """E(I_1..I_k, d_1..d_k) = z, which is concatenated with the inputs of the field: F(x, z, d; theta).

    All objects share theta, without an update. A layer that reads [x, z] computes W [x, z] + b = W_x x + (W_z z + b),
    so the field gets the code as an offset of the biases of such layers. Objects with equal images get equal fields.
    """

    def __init__(self, config: AutoencoderConfig, shapes: Mapping[str, torch.Size], inputs: tuple[str, ...]) -> None:
        """An encoder, and the weights with which the field reads its code.

        Args:
            config: of the encoder.
            shapes: of the field's parameters by name.
            inputs: names of the layers that read a point, such as "layers.0".
        """
        super().__init__()
        self.config = config
        self.views, self.choice = config.views, config.choice
        self.encoder = ENCODERS[config.encoder](config.code, config.normalisation)
        self.latent = nn.Linear(config.views * (config.code + 3), config.latent)
        self.biases = tuple(name for name in shapes if any(name.endswith(f".{layer}.bias") for layer in inputs))
        readers = [nn.Linear(config.latent, shapes[name].numel(), bias=False) for name in self.biases]
        for reader in readers:
            reader.weight = random_matrix(reader.out_features, config.latent, config.latent)
        self.readers = nn.ModuleList(readers)

    def forward(self, observed: Observed, theta: Mapping[str, Tensor]) -> list[Parameters]:
        """W_z z for every layer that reads a point, named as its bias.

        Args:
            observed: the images of several objects with their viewing directions.
            theta: not read.

        Returns:
            For each object, the offsets of the biases.
        """
        assert observed.images is not None
        assert observed.directions is not None
        # z of each object, and the offsets for each layer
        codes = self.encode(observed.images, observed.directions)
        read = [reader(codes) for reader in self.readers]
        return [
            Parameters((name, shift[index]) for name, shift in zip(self.biases, read, strict=True))
            for index in range(len(codes))
        ]

    @property
    def activated(self) -> Sequence[nn.Module]:
        """The layer that computes the code of an object."""
        return [self.latent]

    def encode(
        self, images: Float[Tensor, "object view 3 height width"], directions: Float[Tensor, "object view 3"]
    ) -> Float[Tensor, "object latent"]:
        """The code z of each object."""
        # the codes of all images with their directions make the code of the object
        apart = self.config.normalisation == "batch_statistics" and not self.training
        codes = encode_objects(self.encoder, images, apart=apart)
        return silu(self.latent(torch.cat([codes, directions], -1).flatten(1)))
