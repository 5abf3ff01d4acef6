"""The loss that teaches a field to be empty outside the visual hull, which packed training never samples."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField
from hyperplanes.geometry.rays import Sphere
from hyperplanes.training.drawing import points_in

__all__ = ["emptiness_loss", "thin_opacity"]

EMPTINESS = 0.01  # weight beside the squared error of pixels


def thin_opacity(density: Float[Tensor, " point"], bounds: Sphere) -> Float[Tensor, " point"]:
    """The opacity of a layer a tenth of a radius thick, which does not depend on the unit of the world.

    Args:
        density: per world unit.
        bounds: of the scene.
    """
    return 1 - torch.exp(-density * bounds.radius / 10)


def emptiness_loss(field: AdaptedField, count: int, generator: torch.Generator) -> Tensor:
    """EMPTINESS times the mean `thin_opacity` of random points of the sphere, which counts where the hull rules it out.

    Args:
        field: whose densities, all of them, are asked.
        count: points of the sphere; those in the hull count as empty.
        generator: of the points.
    """
    bounds, device = field.occupancy.bounds, field.occupancy.occupied.device
    points = points_in(bounds, count, generator).to(device)
    points = points[~field.occupancy.contains(points)].to(field.dtype)
    opacity = [thin_opacity(density(points), bounds) for density in field.densities]
    return EMPTINESS * sum((each.sum() for each in opacity), torch.zeros((), device=device)) / count
