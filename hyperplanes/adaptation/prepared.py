"""What adapting to an object needs of its support views, and does not depend on weights."""

from __future__ import annotations

from dataclasses import dataclass, replace

from jaxtyping import Float, Int
from torch import Tensor

from hyperplanes.geometry.image_planes import ImagePlanes
from hyperplanes.geometry.occupancy import Occupancy
from hyperplanes.geometry.visibility import VisibilityPlanes
from hyperplanes.views import Views

__all__ = ["Prepared"]


@dataclass(frozen=True)
class Prepared:
    """The support side of one object, computed once.

    Attributes:
        views: the support views in the order of the model's rig, one a plane; as given where any order will do.
        planes: the same as the field reads them.
        occupancy: the visual hull of all support masks.
        volume: what the planes show on a grid over the scene, for a hypernetwork that reads it.
    """

    views: Views
    planes: ImagePlanes | VisibilityPlanes
    occupancy: Occupancy
    volume: Float[Tensor, "channel x y z"] | None = None

    def hiding(self, views: Int[Tensor, " hidden"]) -> Prepared:
        """The same object, of which some views show the field nothing.

        Args:
            views: their indices.
        """
        return replace(self, planes=self.planes.hiding(views))
