"""MultiPlaneNeRF and PointMultiPlaneNeRF: fields that look colours up in images (HyperPlanes, Eqs. 3 and 4)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.fields.base import Target
from hyperplanes.fields.encoding import encode, encoded_size
from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.rays import Sphere

__all__ = ["MultiPlaneNeRF", "PointMultiPlaneNeRF"]


def plane_features(points: Float[Tensor, "point 3"], planes: ImagePlanes) -> Float[Tensor, "point five_planes"]:
    """z(x, I): the colours and coordinates of a point on every plane, 5 n numbers, all in [-1, 1].

    Where a point is not seen, the lookup's background colour and clamped coordinate stand; a hidden plane is zeros.
    """
    found = planes.lookup(points)
    # colours from [0, 1] to [-1, 1], as coordinates are
    colours, coordinates = 2 * found.colours - 1, found.coordinates
    # what a masked plane shows is left out
    if planes.masked is not None:
        shown = ~planes.masked[:, None]
        colours, coordinates = colours * shown, coordinates * shown
    # all planes' colours, then all planes' coordinates
    return torch.cat([colours.flatten(1), coordinates.flatten(1)], -1)


class MultiPlaneNeRF(Target):
    """F(z, d, I; theta) = (c, sigma): the network sees the planes, not the point."""

    @property
    def input_size(self) -> int:
        """Three colours and two coordinates a plane."""
        return 5 * self.config.planes

    def inputs(self, points: Float[Tensor, "point 3"], planes: ImagePlanes | None, bounds: Sphere) -> Tensor:
        """z(x, I)."""
        if planes is None:
            raise ValueError("planes: expected ImagePlanes, got None")
        return plane_features(points, planes)


class PointMultiPlaneNeRF(MultiPlaneNeRF):
    """F(x, z, d, I; theta) = (c, sigma): the network sees the point as well."""

    @property
    def input_size(self) -> int:
        """Z and the encoded point."""
        return super().input_size + encoded_size(self.config.point_frequencies)

    def inputs(self, points: Float[Tensor, "point 3"], planes: ImagePlanes | None, bounds: Sphere) -> Tensor:
        """z(x, I) and the encoded position in the unit sphere."""
        here = encode(bounds.normalise(points), self.config.point_frequencies)
        return torch.cat([super().inputs(points, planes, bounds), here], -1)
