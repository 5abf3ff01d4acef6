"""The simplified NeRF of Tancik et al. 2021: one MLP that reads only the point, not the direction."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import relu

from hyperplanes.fields.base import MLPField, TargetConfig
from hyperplanes.fields.nerf import NeRF
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.rays import Sphere
from hyperplanes.parameters import Parameters

__all__ = ["SimplifiedNeRF"]

HIGHEST = 8.0  # binary logarithm of the highest frequency


class SimplifiedNeRF(NeRF):
    """F(x; theta) = (c, sigma), as in tancik/learnit for ShapeNet (Experiments/shapenet.ipynb).

    Sines and cosines of the point at `point_frequencies` frequencies from 1 to 256, `depth` layers without a skip
    connection, and one layer for colour and density, with ReLU for density. `direction_frequencies` and `density_scale`
    are not used.

    Raises:
        ValueError: no frequency, so that the point would not be read.
    """

    def __init__(self, config: TargetConfig) -> None:
        if config.point_frequencies < 1:  # the point itself is not an input
            raise ValueError("network.point_frequencies: expected at least 1 for simplified_nerf, got 0")
        super().__init__(config)
        width = config.width
        self.skip = 0
        layers = [nn.Linear(self.input_size if index == 0 else width, width) for index in range(config.depth)]
        del self.feature, self.view
        self.layers, self.colour = nn.ModuleList(layers), nn.Linear(width, 3)
        for layer in (*layers, self.colour):
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)
        nn.init.zeros_(self.density.bias)

    @property
    def input_size(self) -> int:
        """A sine and a cosine of three coordinates per frequency."""
        return 6 * self.config.point_frequencies

    def inputs(self, points: Float[Tensor, "point 3"], planes: ImagePlanes | None, bounds: Sphere) -> Tensor:
        """The encoded position in world units, relative to the centre of the scene."""
        count = self.config.point_frequencies
        frequencies = 2 ** torch.linspace(0, HIGHEST, count, dtype=points.dtype, device=points.device)
        angles = ((points - points.new_tensor(bounds.centre))[:, None] * frequencies[:, None]).flatten(1)
        return torch.cat([angles.sin(), angles.cos()], 1)

    def bind(self, parameters: Parameters, planes: ImagePlanes | None, bounds: Sphere | None = None) -> MLPField:
        """The field of these parameters."""
        return SimplifiedField(self, parameters, planes, bounds or Sphere())


@dataclass(frozen=True, repr=False)
class SimplifiedField(MLPField):
    """The field of a SimplifiedNeRF."""

    def density_of(self, hidden: Float[Tensor, "point width"]) -> Float[Tensor, " point"]:
        """The ReLU of the density's output, per world unit."""
        return relu(self.layer("density", hidden)[:, 0])

    def colour_of(
        self, hidden: Float[Tensor, "point width"], directions: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point 3"]:
        """The same from every direction."""
        return self._colour(hidden)

    def colours_along(
        self, hidden: Float[Tensor, "point width"], directions: Float[Tensor, "direction 3"]
    ) -> Float[Tensor, "point direction 3"]:
        """The same along every direction."""
        return self._colour(hidden)[:, None].expand(-1, len(directions), -1)

    def _colour(self, hidden: Float[Tensor, "point width"]) -> Float[Tensor, "point 3"]:
        return torch.sigmoid(self.layer("colour", hidden))
