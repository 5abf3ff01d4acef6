"""The loss that teaches a field to be empty outside the visual hull, which packed training never samples."""

from __future__ import annotations

import torch
from torch import Tensor

from hyperplanes.adaptation.base import AdaptedField

__all__ = ["emptiness_loss"]

EMPTINESS = 0.01  # weight beside the squared error of pixels


def emptiness_loss(field: AdaptedField, count: int, generator: torch.Generator) -> Tensor:
    """Mean opacity, a tenth of a radius thick, of random points of the sphere that the hull rules out.

    Args:
        field: whose densities, all of them, are asked.
        count: points of the sphere; those in the hull count as empty.
        generator: of the points.
    """
    bounds, device = field.occupancy.bounds, field.occupancy.occupied.device
    unit = torch.randn(count, 3, generator=generator)
    unit = unit / unit.norm(dim=1, keepdim=True) * torch.rand(len(unit), 1, generator=generator) ** (1 / 3)
    points = (unit * bounds.radius + torch.tensor(bounds.centre)).to(device)
    points = points[~field.occupancy.contains(points)].to(field.dtype)
    opacity = [1 - torch.exp(-density(points) * bounds.radius / 10) for density in field.densities]
    return EMPTINESS * sum((each.sum() for each in opacity), torch.zeros((), device=device)) / len(unit)
