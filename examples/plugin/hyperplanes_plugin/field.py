"""A NeRF whose density is the same on both sides of the plane x = 0, as that of cars and chairs is."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from hyperplanes.fields import NeRF
from hyperplanes.geometry import ImagePlanes
from hyperplanes.geometry.rays import Sphere

__all__ = ["SymmetricNeRF"]


class SymmetricNeRF(NeRF):
    """F(|x|, y, z, d; theta) = (c, sigma)."""

    def inputs(self, points: Float[Tensor, "point 3"], planes: ImagePlanes | None, bounds: Sphere) -> Tensor:
        """What the first layer reads of world points: here the encoding of their mirror images at x >= 0."""
        left = points[:, :1] < bounds.centre[0]
        mirrored = points.clone()
        mirrored[:, :1] = points[:, :1].where(~left, 2 * bounds.centre[0] - points[:, :1])
        return super().inputs(mirrored, planes, bounds)
