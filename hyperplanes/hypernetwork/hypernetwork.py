"""The hypernetwork: k images, their viewing directions and theta make one update (HyperPlanes, Eq. 7)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import relu

from hyperplanes.hypernetwork.encoders import ENCODERS
from hyperplanes.hypernetwork.weights import LowRankReader
from hyperplanes.parameters import Parameters

__all__ = ["HyperNetwork", "HyperNetworkConfig"]


@dataclass(frozen=True)
class HyperNetworkConfig:
    """The shape of a hypernetwork.

    Attributes:
        views: k, the number of HyperPlanes it reads.
        encoder: "convnet" (ShapeNet 128) or "resnet101" (ShapeNet 200).
        normalisation: of the encoder: "batch" as in the paper, or "group", which does the same in training and use.
        code: length of the code of one image.
        depth: fully connected layers of the head before its outputs.
        width: of each of them.
        layers: which layers of the target are updated; the colour and opacity layers by default, ("all",) for every
            one of them, as an ablation.
        see_weights: theta is an input.
        weights_seen: how much of it: "updated", the weights of the layers that are updated, or "all". The paper says
            theta. It is the same for every object, so in use its code is a constant and tells nothing of the object;
            in training it lets the update follow the weights it is added to, which are the updated ones.
        see_directions: the viewing directions are an input.
        gain: what the outputs are multiplied with.
    """

    views: int = 5
    encoder: str = "convnet"
    normalisation: str = "batch"
    code: int = 128
    depth: int = 3
    width: int = 256
    layers: tuple[str, ...] = ("colour", "density")
    see_weights: bool = True
    weights_seen: str = "updated"
    see_directions: bool = True
    gain: float = 1.0


class HyperNetwork(nn.Module):
    """H(I_1..I_k, d_1..d_k, theta; delta) = one tensor for each named parameter of the chosen layers.

    The outputs start at zero: an untrained hypernetwork changes nothing.
    """

    def __init__(self, config: HyperNetworkConfig, shapes: Mapping[str, torch.Size]) -> None:
        super().__init__()
        if config.encoder not in ENCODERS:
            raise ValueError(f"encoder: expected one of {sorted(ENCODERS)}, got {config.encoder!r}")
        if config.weights_seen not in ("updated", "all"):
            raise ValueError(f"weights_seen: expected 'updated' or 'all', got {config.weights_seen!r}")
        self.config = config
        known = {name.split(".")[-2] for name in shapes}
        chosen = known if config.layers == ("all",) else set(config.layers)
        if not chosen or chosen - known:
            expected = f"('all',) or some of {sorted(known)}"
            raise ValueError(f"layers: expected {expected}, got {sorted(chosen - known) or 'none'}")
        self.shapes = {name: shape for name, shape in shapes.items() if name.split(".")[-2] in chosen}
        self.encoder = ENCODERS[config.encoder](config.code, config.normalisation)
        if config.weights_seen == "all":
            self.weights_code = LowRankReader(shapes, config.code)
        else:
            self.weights_code = nn.Linear(sum(shape.numel() for shape in self.shapes.values()), config.code)
        sizes = [config.views * (config.code + 3) + config.code] + [config.width] * config.depth
        self.head = nn.ModuleList(nn.Linear(a, b) for a, b in zip(sizes, sizes[1:], strict=False))
        outputs = [nn.Linear(config.width, shape.numel()) for shape in self.shapes.values()]
        self.outputs = nn.ModuleList(outputs)
        for output in outputs:
            nn.init.zeros_(output.weight)
            nn.init.zeros_(output.bias)

    def forward(
        self,
        images: Float[Tensor, "view 3 height width"],
        directions: Float[Tensor, "view 3"],
        theta: Mapping[str, Tensor],
    ) -> Parameters:
        """The update of theta that these HyperPlanes ask for.

        Args:
            images: the k HyperPlanes, RGB in [0, 1].
            directions: their unit viewing directions in the world.
            theta: the target's parameters.

        Returns:
            One tensor a named parameter of the chosen layers, of its shape.

        Raises:
            ValueError: another number of images than the network was made for.
        """
        if len(images) != self.config.views or len(directions) != self.config.views:
            raise ValueError(
                f"HyperPlanes: expected {self.config.views} images and directions, "
                f"got {len(images)} and {len(directions)}"
            )
        codes = self.encoder(images)
        seen = directions if self.config.see_directions else torch.zeros_like(directions)
        if not self.config.see_weights:
            theta = {name: torch.zeros_like(value) for name, value in theta.items()}
        if isinstance(self.weights_code, LowRankReader):
            weights = self.weights_code(theta)
        else:
            weights = self.weights_code(torch.cat([theta[name].flatten() for name in self.shapes]))
        value = torch.cat([relu(codes).flatten(), seen.flatten(), relu(weights)])[None]
        for layer in self.head:
            value = relu(layer(value))
        return Parameters(
            (name, (output(value) * self.config.gain).reshape(shape))
            for (name, shape), output in zip(self.shapes.items(), self.outputs, strict=True)
        )
