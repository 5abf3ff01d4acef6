"""The hypernetwork: k images, their viewing directions and theta make one update (HyperPlanes, Eq. 7)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import interpolate, silu

from hyperplanes.hypernetwork.configuration import ACTIVATIONS, HyperNetworkConfig
from hyperplanes.hypernetwork.encoders import ENCODERS, encode_objects
from hyperplanes.hypernetwork.update_writer import UpdateWriter
from hyperplanes.parameters import Parameters

__all__ = ["HyperNetwork"]


class HyperNetwork(UpdateWriter):
    """H(I_1..I_k, d_1..d_k, theta; delta) = one tensor for each named parameter of the chosen layers.

    The outputs start at zero: an untrained hypernetwork changes nothing.
    """

    def __init__(self, config: HyperNetworkConfig, shapes: Mapping[str, torch.Size]) -> None:
        super().__init__(config, shapes)
        self.encoder = ENCODERS[config.encoder](config.code, config.normalisation)
        concatenated = config.join == "concatenate"
        self.code_normalisation = self.make_normalisation(
            (config.views, config.code) if concatenated else (config.code,)
        )
        if not concatenated:
            self.place = nn.Linear(config.code + 3, config.code)
        self.make_head(config.views * (config.code + 3) if concatenated else config.code, shapes)

    def forward(
        self,
        images: Float[Tensor, "*object view 3 height width"],
        directions: Float[Tensor, "*object view 3"],
        theta: Mapping[str, Tensor],
        present: Bool[Tensor, "*object view"] | None = None,
    ) -> Parameters | list[Parameters]:
        """The update of theta for the object that these HyperPlanes show.

        Args:
            images: the k HyperPlanes of one object, or of each of several, RGB in [0, 1].
            directions: their unit viewing directions in the world.
            theta: the target's parameters.
            present: which of the images there are, for objects of different numbers of HyperPlanes; all where absent.
                Only with join "mean", which takes any number of images.

        Returns:
            One tensor a named parameter of the chosen layers, of its shape; a list of those for several objects.

        Raises:
            ValueError: another number of images than the network was made for.
        """
        config = self.config
        counts = {images.shape[-4], directions.shape[-2]}
        if counts != {config.views} if config.join == "concatenate" else len(counts) > 1 or 0 in counts:
            expected = config.views if config.join == "concatenate" else "as many"
            raise ValueError(
                f"HyperPlanes: expected {expected} images and directions, "
                f"got {images.shape[-4]} and {directions.shape[-2]}"
            )
        several = images.ndim == 5
        if not several:
            images, directions = images[None], directions[None]
        present = present if present is None or several else present[None]
        results = self.written(self._joined(self.encode(images, directions, present), directions), theta)
        return results if several else results[0]

    def encode(
        self,
        images: Float[Tensor, "object view 3 height width"],
        directions: Float[Tensor, "object view 3"],
        present: Bool[Tensor, "object view"] | None = None,
    ) -> Float[Tensor, "object ..."]:
        """The codes of the images before their activation: (object, view, code), or (object, code) of their mean."""
        read = images.flatten(0, 1)
        if self.config.resolution and read.shape[2:] != (self.config.resolution,) * 2:
            read = interpolate(read, (self.config.resolution,) * 2, mode="area")
        apart = self.config.normalisation == "batch_statistics" and not self.training
        codes = encode_objects(self.encoder, read.unflatten(0, images.shape[:2]), present, apart=apart)
        if self.config.join == "mean":
            if not self.config.see_directions:
                directions = torch.zeros_like(directions)
            codes = silu(self.place(torch.cat([codes, directions], -1)))
            weights = codes.new_ones(codes.shape[:2]) if present is None else present.to(codes)
            codes = (weights[..., None] * codes).sum(1) / weights.sum(1, keepdim=True)
        return self.code_normalisation(codes)

    def _joined(self, codes: Tensor, directions: Tensor) -> Float[Tensor, "object read"]:
        """What the head reads of the object: codes and viewing directions."""
        parts = [ACTIVATIONS[self.config.code_activation](codes).flatten(1)]
        if self.config.join == "concatenate":
            seen = directions if self.config.see_directions else torch.zeros_like(directions)
            parts.append(seen.flatten(1))
        return torch.cat(parts, 1)
