"""The hypernetwork that reads images: from k images, their viewing directions and theta to one update (Eq. 7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import relu, silu

from hyperplanes.hypernetwork.base import HyperNetwork, Observed
from hyperplanes.hypernetwork.configuration import ACTIVATIONS, ImageHyperNetworkConfig
from hyperplanes.hypernetwork.encoders import ENCODERS, encode_objects
from hyperplanes.hypernetwork.images.standardisation import RunningStandardisation
from hyperplanes.hypernetwork.updates import UPDATES
from hyperplanes.hypernetwork.weights import LowRankReader
from hyperplanes.parameters import Parameters

__all__ = ["ImageHyperNetwork"]


class ImageHyperNetwork(HyperNetwork):
    """H(I_1..I_k, d_1..d_k, theta; delta) = one tensor for each named parameter of the chosen layers.

    Outputs are zero at initialisation: an untrained hypernetwork changes nothing.

    Args:
        config: the shape.
        shapes: of the parameters of the target by name.

    Raises:
        ValueError: layers that the target does not have.
    """

    def __init__(self, config: ImageHyperNetworkConfig, shapes: Mapping[str, torch.Size]) -> None:
        super().__init__()
        self.config = config
        self.views, self.choice, self.resolution = config.views, config.choice, config.resolution
        # the layers that are updated
        known = {name.split(".")[-2] for name in shapes}
        chosen = known if config.layers == ("all",) else set(config.layers)
        if not chosen or chosen - known:
            expected = f"('all',) or some of {sorted(known)}"
            raise ValueError(f"layers: expected {expected}, got {sorted(chosen - known) or 'none'}")
        self.shapes = {name: shape for name, shape in shapes.items() if name.split(".")[-2] in chosen}
        # codes of the images, and of the object
        self.encoder = ENCODERS[config.encoder](config.code, config.normalisation)
        concatenated = config.join == "concatenate"
        shape = (config.views, config.code) if concatenated else (config.code,)
        running = config.code_normalisation == "running"
        self.code_normalisation = RunningStandardisation(shape) if running else nn.Identity()
        if not concatenated:
            self.place = nn.Linear(config.code + 3, config.code)
        # a code of theta
        if config.weights_seen == "all":
            self.weights_code = LowRankReader(shapes, config.code)
        else:
            self.weights_code = nn.Linear(sum(shape.numel() for shape in self.shapes.values()), config.code)
        # the head, from both codes to the outputs
        read = config.views * (config.code + 3) if concatenated else config.code
        sizes = [read + config.code] + [config.width] * config.depth
        self.head = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:], strict=False))
        updates = [UPDATES[config.update](shape, config.rank) for shape in self.shapes.values()]
        self.updates = nn.ModuleList(updates)
        self.standardise = RunningStandardisation((config.width,)) if config.centre else nn.Identity()
        self.outputs = nn.ModuleList(nn.Linear(config.width, update.size, bias=not config.centre) for update in updates)
        for parameter in self.outputs.parameters():
            nn.init.zeros_(parameter)

    @property
    def activated(self) -> Sequence[nn.Module]:
        """The layers of the head."""
        return list(self.head)

    def forward(self, observed: Observed, theta: Mapping[str, Tensor]) -> list[Parameters]:
        """The update of theta for each object.

        Args:
            observed: the HyperPlanes of several objects with their viewing directions. Some may be missing only with
                join "mean", which takes any number of images.
            theta: the target's parameters.

        Returns:
            For each object, one tensor for each named parameter of the chosen layers, of its shape.

        Raises:
            ValueError: a number of images other than `config.views`, with join "concatenate".
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
        # codes of the images, joined with the directions, are the input of the head
        codes = self.encode(images, directions, observed.present)
        return self._updates_of(self._joined(codes, directions), theta)

    def standardised_codes(self, observed: Observed) -> Tensor | None:
        """The codes of the images, standardised over the training; None if they are not standardised."""
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
        # a code per image; with batch statistics, each object is a batch of its own in evaluation
        apart = self.config.normalisation == "batch_statistics" and not self.training
        codes = encode_objects(self.encoder, images, present, apart=apart)
        if self.config.join == "mean":
            if not self.config.see_directions:
                directions = torch.zeros_like(directions)
            # each code with its direction, then their mean over the images that are present
            codes = silu(self.place(torch.cat([codes, directions], -1)))
            weights = codes.new_ones(codes.shape[:2]) if present is None else present.to(codes)
            codes = (weights[..., None] * codes).sum(1) / weights.sum(1, keepdim=True)
        return self.code_normalisation(codes)

    def _joined(self, codes: Tensor, directions: Tensor) -> Float[Tensor, "object read"]:
        """The inputs of the head: codes and viewing directions."""
        parts = [codes.flatten(1)]
        if self.config.join == "concatenate":
            seen = directions if self.config.see_directions else torch.zeros_like(directions)
            parts.append(seen.flatten(1))
        return torch.cat(parts, 1)

    def _updates_of(self, read: Float[Tensor, "object read"], theta: Mapping[str, Tensor]) -> list[Parameters]:
        """The updates of several objects from the inputs of the head and the target's parameters."""
        config = self.config
        activation = ACTIVATIONS[config.activation]
        # the codes of the object and of theta, through the fully connected layers
        hidden = torch.cat([read, self._weights_read(theta).expand(len(read), -1)], 1)
        for layer in self.head:
            hidden = activation(layer(hidden))
        if config.centre:  # of unit length on average, since the change of an output by an Adam step grows with it
            hidden = self.standardise(hidden) / config.width**0.5
        # each parameter has its own output layer and form of update
        outputs = [output(hidden) for output in self.outputs]
        return [
            Parameters(
                (name, update(output[index], theta[name]))
                for name, update, output in zip(self.shapes, self.updates, outputs, strict=True)
            )
            for index in range(len(read))
        ]

    def _weights_read(self, theta: Mapping[str, Tensor]) -> Float[Tensor, " code"]:
        """The code of theta."""
        if not self.config.see_weights:
            theta = {name: torch.zeros_like(value) for name, value in theta.items()}
        if isinstance(self.weights_code, LowRankReader):
            return relu(self.weights_code(theta))
        return relu(self.weights_code(torch.cat([theta[name].flatten() for name in self.shapes])))
