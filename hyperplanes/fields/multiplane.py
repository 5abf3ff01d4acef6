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


def plane_features(points: Float[Tensor, "point 3"], planes: ImagePlanes) -> list[Float[Tensor, "number point"]]:
    """z(x, I): the colours of a point on all planes, and its coordinates there, 5 n numbers, all in [-1, 1].

    Each row has one number of all points, as the lookup writes it: transposing it would take as long as the lookup. For
    a plane that does not see a point, these are the background colour and clamped coordinates; a masked plane gives 0.
    """
    found = planes.lookup(points)
    colours, coordinates = found.colours.permute(1, 2, 0), found.coordinates.permute(1, 2, 0)
    # colours from [0, 1] to [-1, 1], as coordinates are
    colours = 2 * colours - 1
    # masked planes give 0
    if planes.masked is not None:
        shown = ~planes.masked[:, None, None]
        colours, coordinates = colours * shown, coordinates * shown
    return [colours.flatten(0, 1), coordinates.flatten(0, 1)]


class MultiPlaneNeRF(Target):
    """F(z, d, I; theta) = (c, sigma): the network sees the planes, not the point."""

    @property
    def input_size(self) -> int:
        """Three colours and two coordinates per plane."""
        return 5 * self.config.planes

    def inputs(self, points: Float[Tensor, "point 3"], planes: ImagePlanes | None, bounds: Sphere) -> Tensor:
        """z(x, I)."""
        return torch.cat(plane_features(points, _given(planes))).T


class PointMultiPlaneNeRF(MultiPlaneNeRF):
    """F(x, z, d, I; theta) = (c, sigma): the network sees the point as well."""

    @property
    def input_size(self) -> int:
        """Z and the encoded point."""
        return super().input_size + encoded_size(self.config.point_frequencies)

    def inputs(self, points: Float[Tensor, "point 3"], planes: ImagePlanes | None, bounds: Sphere) -> Tensor:
        """z(x, I) and the encoded position in the unit sphere."""
        here = encode(bounds.normalise(points).T.contiguous(), self.config.point_frequencies, dim=0)
        return torch.cat([*plane_features(points, _given(planes)), here]).T


def _given(planes: ImagePlanes | None) -> ImagePlanes:
    if planes is None:
        raise ValueError("planes: expected ImagePlanes, got None")
    return planes
