"""The loss that teaches a field to be empty outside the visual hull, which packed training never samples."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.profiler import record_function

from hyperplanes.geometry.rays import Sphere
from hyperplanes.training.episodes.drawing import points_in
from hyperplanes.training.forward import ForwardOutput

__all__ = ["EmptinessLoss", "thin_opacity"]


def thin_opacity(density: Float[Tensor, " point"], bounds: Sphere) -> Float[Tensor, " point"]:
    """The opacity of a layer a tenth of a radius thick, which does not depend on the unit of the world.

    Args:
        density: per world unit.
        bounds: of the scene.
    """
    return 1 - torch.exp(-density * bounds.radius / 10)


@dataclass(frozen=True)
class EmptinessLoss:
    """The mean `thin_opacity` of random points of the sphere, of which those in the hull count as empty.

    Attributes:
        points: of the sphere, an object and step.
        weight: beside the squared error of pixels.
    """

    points: int
    weight: float = 0.01

    def __call__(self, output: ForwardOutput) -> Tensor:
        """The opacity outside the hull of one object, of its field and of its proposal."""
        field = output.field
        bounds, device = field.occupancy.bounds, field.occupancy.occupied.device
        with record_function("step:emptiness"):
            points = points_in(bounds, self.points, output.generator).to(device)
            points = points[~field.occupancy.contains(points)].to(field.dtype)
            opacity = [thin_opacity(density(points), bounds) for density in field.densities]
            return self.weight * sum((each.sum() for each in opacity), torch.zeros((), device=device)) / self.points
