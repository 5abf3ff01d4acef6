"""NeRF: a field that reads only the point and the direction (HyperPlanes, Eq. 1)."""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from hyperplanes.fields.base import Target
from hyperplanes.fields.encoding import encode, encoded_size
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.rays import Sphere
from hyperplanes.views import Views

__all__ = ["NeRF"]


class NeRF(Target):
    """F(x, d; theta) = (c, sigma)."""

    reads_planes: ClassVar[bool] = False

    @property
    def input_size(self) -> int:
        """The encoded point."""
        return encoded_size(self.config.point_frequencies)

    def inputs(self, points: Float[Tensor, "point 3"], planes: ImagePlanes | None, bounds: Sphere) -> Tensor:
        """The encoded position in the unit sphere."""
        return encode(bounds.normalise(points), self.config.point_frequencies)

    def planes_of(self, views: Views, occupancy: Occupancy) -> None:
        """None: the network reads no image."""
