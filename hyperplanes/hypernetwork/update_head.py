"""From codes to updates: the head of every hypernetwork."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import relu

from hyperplanes.hypernetwork.base import HyperNetwork
from hyperplanes.hypernetwork.configuration import ACTIVATIONS, HeadConfig
from hyperplanes.hypernetwork.standardisation import RunningStandardisation
from hyperplanes.hypernetwork.updates import UPDATES
from hyperplanes.hypernetwork.weights import LowRankReader
from hyperplanes.parameters import Parameters

__all__ = ["UpdateHead"]


class UpdateHead(HyperNetwork):
    """What hypernetworks end with: codes and theta become one tensor for each parameter of the chosen layers.

    Args:
        config: the shape.
        shapes: of the parameters of the target by name.

    Raises:
        ValueError: layers that the target does not have.
    """

    def __init__(self, config: HeadConfig, shapes: Mapping[str, torch.Size]) -> None:
        super().__init__()
        self.config = config
        known = {name.split(".")[-2] for name in shapes}
        chosen = known if config.layers == ("all",) else set(config.layers)
        if not chosen or chosen - known:
            expected = f"('all',) or some of {sorted(known)}"
            raise ValueError(f"layers: expected {expected}, got {sorted(chosen - known) or 'none'}")
        self.shapes = {name: shape for name, shape in shapes.items() if name.split(".")[-2] in chosen}

    def make_normalisation(self, shape: tuple[int, ...]) -> nn.Module:
        """The normalisation of codes of that shape."""
        return RunningStandardisation(shape) if self.config.code_normalisation == "running" else nn.Identity()

    def make_head(self, read: int, shapes: Mapping[str, torch.Size]) -> None:
        """The layers from `read` numbers an object, and from theta of all `shapes`, to the outputs."""
        config = self.config
        if config.weights_seen == "all":
            self.weights_code = LowRankReader(shapes, config.code)
        else:
            self.weights_code = nn.Linear(sum(shape.numel() for shape in self.shapes.values()), config.code)
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

    def updates_of(self, read: Float[Tensor, "object read"], theta: Mapping[str, Tensor]) -> list[Parameters]:
        """The updates of several objects, of what is read of each and of the target's parameters."""
        config = self.config
        activation = ACTIVATIONS[config.activation]
        # the code of the object beside that of theta, through the fully connected layers
        hidden = torch.cat([read, self._weights_read(theta).expand(len(read), -1)], 1)
        for layer in self.head:
            hidden = activation(layer(hidden))
        if config.centre:  # of unit length on average, as what Adam moves an output by grows with it
            hidden = self.standardise(hidden) / config.width**0.5
        # each parameter has an output layer of its own, and a form in which its update is written
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
