"""The hypernetwork that reads images: k of them, their viewing directions and theta make one update (Eq. 7)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import silu

from hyperplanes.hypernetwork.base import Observed
from hyperplanes.hypernetwork.configuration import ImageHyperNetworkConfig
from hyperplanes.hypernetwork.encoders import ENCODERS, encode_objects
from hyperplanes.hypernetwork.standardisation import RunningStandardisation
from hyperplanes.hypernetwork.update_head import UpdateHead
from hyperplanes.parameters import Parameters

__all__ = ["ImageHyperNetwork"]


class ImageHyperNetwork(UpdateHead):
    """H(I_1..I_k, d_1..d_k, theta; delta) = one tensor for each named parameter of the chosen layers.

    The outputs start at zero: an untrained hypernetwork changes nothing.
    """

    def __init__(self, config: ImageHyperNetworkConfig, shapes: Mapping[str, torch.Size]) -> None:
        super().__init__(config, shapes)
        self.config = config
        self.views, self.choice, self.resolution = config.views, config.choice, config.resolution
        self.encoder = ENCODERS[config.encoder](config.code, config.normalisation)
        concatenated = config.join == "concatenate"
        self.code_normalisation = self.make_normalisation(
            (config.views, config.code) if concatenated else (config.code,)
        )
        if not concatenated:
            self.place = nn.Linear(config.code + 3, config.code)
        self.make_head(config.views * (config.code + 3) if concatenated else config.code, shapes)

    def forward(self, observed: Observed, theta: Mapping[str, Tensor]) -> list[Parameters]:
        """The update of theta for the objects that these HyperPlanes show.

        Args:
            observed: the HyperPlanes of each of several objects with their viewing directions. Some may be missing only
                with join "mean", which takes any number of images.
            theta: the target's parameters.

        Returns:
            For each object one tensor a named parameter of the chosen layers, of its shape.

        Raises:
            ValueError: another number of images than the network was made for.
        """
        images, directions, config = observed.images, observed.directions, self.config
        assert images is not None
        assert directions is not None
        counts = {images.shape[-4], directions.shape[-2]}
        if counts != {config.views} if config.join == "concatenate" else len(counts) > 1 or 0 in counts:
            expected = config.views if config.join == "concatenate" else "as many"
            raise ValueError(
                f"HyperPlanes: expected {expected} images and directions, "
                f"got {images.shape[-4]} and {directions.shape[-2]}"
            )
        # codes of the images, joined with the directions; the head makes updates of them
        codes = self.encode(images, directions, observed.present)
        return self.updates_of(self._joined(codes, directions), theta)

    def standardised_codes(self, observed: Observed) -> Tensor | None:
        """The codes of the images in deviations of those of the training; None where they are not standardised so."""
        if not isinstance(self.code_normalisation, RunningStandardisation):
            return None
        assert observed.images is not None
        assert observed.directions is not None
        return self.encode(observed.images, observed.directions, observed.present)

    def encode(
        self,
        images: Float[Tensor, "object view 3 height width"],
        directions: Float[Tensor, "object view 3"],
        present: Bool[Tensor, "object view"] | None = None,
    ) -> Float[Tensor, "object ..."]:
        """The codes of the images: (object, view, code), or (object, code) of their mean."""
        # a code an image; with statistics of the batch, objects that are evaluated are batches of their own
        apart = self.config.normalisation == "batch_statistics" and not self.training
        codes = encode_objects(self.encoder, images, present, apart=apart)
        if self.config.join == "mean":
            if not self.config.see_directions:
                directions = torch.zeros_like(directions)
            # each image with its direction, then their mean over the images that there are
            codes = silu(self.place(torch.cat([codes, directions], -1)))
            weights = codes.new_ones(codes.shape[:2]) if present is None else present.to(codes)
            codes = (weights[..., None] * codes).sum(1) / weights.sum(1, keepdim=True)
        return self.code_normalisation(codes)

    def _joined(self, codes: Tensor, directions: Tensor) -> Float[Tensor, "object read"]:
        """What the head reads of the object: codes and viewing directions."""
        parts = [codes.flatten(1)]
        if self.config.join == "concatenate":
            seen = directions if self.config.see_directions else torch.zeros_like(directions)
            parts.append(seen.flatten(1))
        return torch.cat(parts, 1)
