"""The hypernetwork: k images, their viewing directions and theta make one update (HyperPlanes, Eq. 7)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import interpolate, relu, silu

from hyperplanes.hypernetwork.encoders import CHOICES, ENCODERS, NORMALISATIONS
from hyperplanes.hypernetwork.standardisation import RunningStandardisation
from hyperplanes.hypernetwork.updates import UPDATES
from hyperplanes.hypernetwork.weights import LowRankReader
from hyperplanes.parameters import Parameters

__all__ = ["HyperNetwork", "HyperNetworkConfig"]

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {"relu": relu, "silu": silu, "none": lambda value: value}
CODE_NORMALISATIONS = ("none", "layer", "running")
JOINS = ("concatenate", "mean")
WEIGHTS_SEEN = ("updated", "all")


@dataclass(frozen=True)
class HyperNetworkConfig:
    """The shape of a hypernetwork. `docs/hypernetwork.md` has what each choice is worth in dB.

    Attributes:
        views: k, the number of HyperPlanes it reads; the most it reads with a field that takes any number of views.
        choice: which k of the n planes they are: the "farthest" apart, or the "first".
        resolution: pixels a side that HyperPlanes are resized to before they are encoded, so that pictures of every
            size are read alike; 0 leaves them as they are.
        encoder: "convnet" (ShapeNet 128) or "resnet101" (ShapeNet 200).
        normalisation: of the encoder: "batch" as in the paper, by running statistics in use; "batch_statistics", by the
            statistics of the HyperPlanes at hand in use too, as the published code does; or "group", image by image.
        code: length of the code of one image.
        code_activation: applied to the codes: "none", or "relu".
        code_normalisation: of the codes before that: "running" standardises them by running statistics over objects,
            "layer" each over its own entries, "none" leaves them.
        join: how the codes of k images become one: "concatenate" as in the paper, or "mean", in which case each code is
            joined with its viewing direction first and the order of the images does not matter.
        depth: fully connected layers of the head before its outputs.
        width: of each of them.
        activation: of the head: "relu" as in the paper, or "silu".
        layers: which layers of the target are updated: ("colour", "density") as in the paper, or ("all",).
        update: how outputs become an update: "full" as in the paper, "scaling" or "low_rank"; see `updates`.
        rank: of "low_rank" updates.
        see_weights: theta is an input.
        weights_seen: how much of it: "updated", the weights of the layers that are updated, or "all". The paper says
            theta. It is the same for every object, so it carries no information about the object; in training it lets
            the update follow the weights it is added to.
        see_directions: the viewing directions are an input.
        centre: what the output layers read is standardised by running statistics over objects, and they have no bias:
            the update has mean zero over objects, so that what is the same for every object can only go into theta.
        gain: what the outputs are multiplied with.
    """

    views: Annotated[int, range(1, 1025)] = 5
    choice: str = "farthest"
    resolution: Annotated[int, range(8193)] = 0
    encoder: str = "convnet"
    normalisation: str = "batch"
    code: Annotated[int, range(1, 8193)] = 128
    code_activation: str = "none"
    code_normalisation: str = "running"
    join: str = "concatenate"
    depth: Annotated[int, range(1, 257)] = 3
    width: Annotated[int, range(1, 8193)] = 256
    activation: str = "relu"
    layers: tuple[str, ...] = ("colour", "density")
    update: str = "full"
    rank: Annotated[int, range(1, 1025)] = 4
    see_weights: bool = True
    weights_seen: str = "updated"
    see_directions: bool = True
    centre: bool = True
    gain: float = 1.0

    def __post_init__(self) -> None:
        for name, known in (
            ("choice", CHOICES),
            ("encoder", ENCODERS),
            ("normalisation", NORMALISATIONS),
            ("code_activation", ACTIVATIONS),
            ("code_normalisation", CODE_NORMALISATIONS),
            ("join", JOINS),
            ("activation", ACTIVATIONS),
            ("update", UPDATES),
            ("weights_seen", WEIGHTS_SEEN),
        ):
            if getattr(self, name) not in known:
                expected = ", ".join(map(repr, known))
                raise ValueError(f"{name}: expected one of {expected}, got {getattr(self, name)!r}")


class HyperNetwork(nn.Module):
    """H(I_1..I_k, d_1..d_k, theta; delta) = one tensor for each named parameter of the chosen layers.

    The outputs start at zero: an untrained hypernetwork changes nothing.
    """

    def __init__(self, config: HyperNetworkConfig, shapes: Mapping[str, torch.Size]) -> None:
        super().__init__()
        self.config = config
        known = {name.split(".")[-2] for name in shapes}
        chosen = known if config.layers == ("all",) else set(config.layers)
        if not chosen or chosen - known:
            expected = f"('all',) or some of {sorted(known)}"
            raise ValueError(f"layers: expected {expected}, got {sorted(chosen - known) or 'none'}")
        self.shapes = {name: shape for name, shape in shapes.items() if name.split(".")[-2] in chosen}
        self.encoder = ENCODERS[config.encoder](config.code, config.normalisation)
        code_shape = (config.views, config.code) if config.join == "concatenate" else (config.code,)
        self.code_normalisation: nn.Module = nn.Identity()
        if config.code_normalisation == "running":
            self.code_normalisation = RunningStandardisation(code_shape)
        elif config.code_normalisation == "layer":
            self.code_normalisation = nn.LayerNorm(config.code, elementwise_affine=False)
        if config.join == "mean":
            self.place = nn.Linear(config.code + 3, config.code)
        if config.weights_seen == "all":
            self.weights_code = LowRankReader(shapes, config.code)
        else:
            self.weights_code = nn.Linear(sum(shape.numel() for shape in self.shapes.values()), config.code)
        read = config.views * (config.code + 3) if config.join == "concatenate" else config.code
        sizes = [read + config.code] + [config.width] * config.depth
        self.head = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:], strict=False))
        updates = [UPDATES[config.update](shape, config.rank) for shape in self.shapes.values()]
        self.updates = nn.ModuleList(updates)
        self.standardise = RunningStandardisation((config.width,)) if config.centre else nn.Identity()
        self.outputs = nn.ModuleList(nn.Linear(config.width, update.size, bias=not config.centre) for update in updates)
        for parameter in self.outputs.parameters():
            nn.init.zeros_(parameter)

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
        hidden = self._joined(self.encode(images, directions, present), directions, theta)
        activation = ACTIVATIONS[config.activation]
        for layer in self.head:
            hidden = activation(layer(hidden))
        if config.centre:  # of unit length on average, as what Adam moves an output by grows with it
            hidden = self.standardise(hidden) / config.width**0.5
        outputs = [output(hidden) * config.gain for output in self.outputs]
        results = [
            Parameters(
                (name, update(output[index], theta[name]))
                for name, update, output in zip(self.shapes, self.updates, outputs, strict=True)
            )
            for index in range(len(images))
        ]
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
        codes = self.encoder(read).unflatten(0, images.shape[:2])
        if self.config.join == "mean":
            if not self.config.see_directions:
                directions = torch.zeros_like(directions)
            codes = silu(self.place(torch.cat([codes, directions], -1)))
            weights = codes.new_ones(codes.shape[:2]) if present is None else present.to(codes)
            codes = (weights[..., None] * codes).sum(1) / weights.sum(1, keepdim=True)
        return self.code_normalisation(codes)

    def _joined(self, codes: Tensor, directions: Tensor, theta: Mapping[str, Tensor]) -> Float[Tensor, "object input"]:
        """What the head reads: codes, viewing directions and the code of theta."""
        config = self.config
        if not config.see_weights:
            theta = {name: torch.zeros_like(value) for name, value in theta.items()}
        if isinstance(self.weights_code, LowRankReader):
            weights = self.weights_code(theta)
        else:
            weights = self.weights_code(torch.cat([theta[name].flatten() for name in self.shapes]))
        parts = [ACTIVATIONS[config.code_activation](codes).flatten(1)]
        if config.join == "concatenate":
            seen = directions if config.see_directions else torch.zeros_like(directions)
            parts.append(seen.flatten(1))
        return torch.cat([*parts, relu(weights).expand(len(codes), -1)], 1)
