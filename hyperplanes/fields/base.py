"""What every target network has in common: an MLP of explicit parameters, bound to planes as a field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear, relu, softplus

from hyperplanes.fields.encoding import encode, encoded_size
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.rays import Sphere
from hyperplanes.parameters import Parameters

__all__ = ["Field", "Target", "TargetConfig"]

Inputs = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class TargetConfig:
    """The shape of a target network (HyperPlanes, Appendix B, has depth 8 and width 256).

    Attributes:
        depth: fully connected layers before the heads.
        width: of each of them.
        planes: number of ImagePlanes the network is made for.
        point_octaves: of the positional encoding of points.
        direction_octaves: of the positional encoding of viewing directions.
        density_scale: what the density head is multiplied with; an object of unit radius is a few voxels deep, so
            densities of tens are the rule.
    """

    depth: int = 8
    width: int = 256
    planes: int = 25
    point_octaves: int = 10
    direction_octaves: int = 4
    density_scale: float = 25.0


class Target(nn.Module):
    """F(x, z, d; theta) = (c, sigma): colour depends on the direction, density does not.

    The module holds theta; `bind` evaluates the network with any parameters of the same names and shapes. Subclasses
    say what the first layer reads.
    """

    def __init__(self, config: TargetConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width
        self.skip = config.depth // 2
        self.layers = nn.ModuleList()
        for index in range(config.depth):
            size = self.input_size if index == 0 else width
            self.layers.append(nn.Linear(size + (self.input_size if index == self.skip > 0 else 0), width))
        self.density = nn.Linear(width, 1)
        self.feature = nn.Linear(width, width)
        self.view = nn.Linear(width + encoded_size(config.direction_octaves), width // 2)
        self.colour = nn.Linear(width // 2, 3)
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)
        nn.init.constant_(self.density.bias, -2.0)

    @property
    def reading_layers(self) -> tuple[str, ...]:
        """The names of the layers that read a point: the first one and that of the skip connection."""
        return ("layers.0",) if self.skip == 0 else ("layers.0", f"layers.{self.skip}")

    @property
    def input_size(self) -> int:
        """How many numbers the first layer reads of a point."""
        raise TypeError(f"{type(self).__name__} does not say what it reads")

    def inputs(self, points: Float[Tensor, "point 3"], planes: ImagePlanes | None, bounds: Sphere) -> Tensor:
        """What the first layer reads of world points, (point, input_size)."""
        raise TypeError(f"{type(self).__name__} does not say what it reads")

    def bind(self, parameters: Parameters, planes: ImagePlanes | None, bounds: Sphere | None = None) -> Field:
        """The field that these parameters and planes make.

        Args:
            parameters: theta or theta + delta.
            planes: the support images; None for a network that reads none.
            bounds: the sphere of the scene, which the network sees as the unit sphere.

        Returns:
            A callable (points, directions) -> (colour, density).

        Raises:
            ValueError: another number of planes than the network was made for.
        """
        if planes is not None and len(planes) != self.config.planes:
            raise ValueError(f"planes: expected {self.config.planes}, got {len(planes)}")
        return Field(self, parameters, planes, bounds or Sphere())


@dataclass(frozen=True)
class Field:
    """A target network with its parameters and planes: what the renderer calls.

    Attributes:
        target: the network.
        parameters: its weights for this object.
        planes: the support images of this object.
        bounds: the sphere of the scene.
    """

    target: Target
    parameters: Parameters
    planes: ImagePlanes | None
    bounds: Sphere

    def __call__(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Colour in [0, 1] and density per world unit at points seen along unit directions."""
        hidden = self.hidden(points)
        return self.colour_of(hidden, directions), self.density_of(hidden)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per world unit alone."""
        return self.density_of(self.hidden(points))

    def hidden(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point width"]:
        """What the heads read; all that is expensive about a point."""
        inputs = self.target.inputs(points, self.planes, self.bounds)
        value = inputs
        for index in range(self.target.config.depth):
            if index == self.target.skip > 0:
                value = torch.cat([inputs, value], -1)
            value = relu(self._linear(f"layers.{index}", value))
        return value

    def density_of(self, hidden: Float[Tensor, "point width"]) -> Float[Tensor, " point"]:
        """The opacity head. Softplus, not NeRF's ReLU: it cannot die, and a hypernetwork moves its bias."""
        raw = self._linear("density", hidden)[:, 0]
        return softplus(raw) * (self.target.config.density_scale / self.bounds.radius)

    def colour_of(
        self, hidden: Float[Tensor, "point width"], directions: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point 3"]:
        """The colour head."""
        seen = encode(directions, self.target.config.direction_octaves)
        value = relu(self._linear("view", torch.cat([self._linear("feature", hidden), seen], -1)))
        return torch.sigmoid(self._linear("colour", value))

    def colours_along(
        self, hidden: Float[Tensor, "point width"], directions: Float[Tensor, "direction 3"]
    ) -> Float[Tensor, "point direction 3"]:
        """The colour head for every point in every direction; what does not depend on both is computed once."""
        width = self.target.config.width
        weight, bias = self.parameters["view.weight"], self.parameters["view.bias"]
        here = linear(self._linear("feature", hidden), weight[:, :width], bias)
        along = linear(encode(directions, self.target.config.direction_octaves), weight[:, width:])
        return torch.sigmoid(self._linear("colour", relu(here[:, None] + along)))

    def _linear(self, name: str, value: Tensor) -> Tensor:
        return linear(value, self.parameters[f"{name}.weight"], self.parameters[f"{name}.bias"])
